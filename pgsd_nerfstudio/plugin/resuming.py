"""Going on with a training: with the weather and the field it was begun with, and only where something is left to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pgsd_nerfstudio.plugin.checkpoints import checkpoint_in, read_checkpoint
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.plugin.options import RunOptions, check_version
from pgsd_nerfstudio.plugin.places import found
from pgsd_nerfstudio.scene.run_config import Record, entry, read_run_config
from pgsd_nerfstudio.scene.scene import SceneError

GROUPS = ("scene", "weather", "simulation", "answer", "motion", "guidance", "clips", "learning")
# What another value of makes another weather, or another field than the checkpoint holds; the rest may change on the way.
SETTLED_GROUPS = ("scene", "weather", "simulation", "answer")
SETTLED_OPTIONS = ("dynamics", "motion")
SEVERAL = 4  # differences that are named; more are counted


@dataclass(frozen=True)
class Resumed:
    """A training that goes on."""

    step: int
    """Number in the checkpoint's name."""
    run_folder: Path | None
    """Of the run that it goes on from; None where its config.yml is not beside the checkpoints."""
    remarks: tuple[str, ...]
    """What should be said of it."""


def resumed(options: RunOptions, load_dir: Path | None, load_step: int | None, load_checkpoint: Path | None) -> Resumed | None:
    """What a training goes on from, by nerfstudio's flags of these names; None: it begins anew.

    Args:
        options: of the training that goes on.
        load_dir: folder of checkpoints.
        load_step: which of them; None: the newest.
        load_checkpoint: a checkpoint by itself.

    Raises:
        RunError: there is no such checkpoint, it is damaged, it was made with other options, or has done all steps already.
    """
    if load_dir is None and load_checkpoint is None:
        return None
    path = checkpoint_in(load_dir, load_step) if load_dir is not None else load_checkpoint
    assert path is not None
    done = int(read_checkpoint(path)["step"]) + 1
    if options.training_steps <= done:
        raise RunError(
            f"nothing is left to train: {path} has done {done} steps, and this command ends at {options.training_steps}; "
            f"to go on, ask for more with --steps {2 * done}"
        )
    folder = path.resolve().parent.parent
    if not (folder / "config.yml").is_file():
        remark = f"{folder / 'config.yml'} is missing: whether {path.name} was trained for the same weather is not known"
        return Resumed(done - 1, None, (remark,))
    record = entry(_config_of(folder), "run")
    check_version(entry(record, "version"))
    changes = {name: change for group in GROUPS for name, change in _changes(options, record, group, folder).items()}
    settled = [change for name, change in changes.items() if _is_settled(name)]
    if settled:
        raise RunError(
            f"the run {folder} was begun for something else: {_several(settled)}; give the same options as then, or begin anew "
            "without --load-dir"
        )
    remarks = (f"goes on with other options than before: {_several(list(changes.values()))}",) if changes else ()
    return Resumed(done - 1, folder, remarks)


def _config_of(folder: Path) -> Record:
    try:
        return read_run_config(folder / "config.yml")
    except SceneError as error:
        raise RunError(str(error)) from error


def _changes(options: RunOptions, record: Any, group: str, folder: Path) -> dict[str, str]:
    """Flags of a group that have another value than in the record of a run: each by "group.flag", with both values in words."""
    now, default = _flat(asdict(getattr(options, group))), _flat(asdict(getattr(RunOptions.unset(), group)))
    then = default | {name: value for name, value in _flat(entry(record, group) or {}).items() if name in default}
    if group == "scene":
        # Where it lies may change: whether it is the same is seen once it is opened.
        places = {name: found(then[name], folder) for name in ("load_scene", "data") if isinstance(then[name], Path)}
        then |= {name: place or now[name] for name, place in places.items() if str(then[name]) != "demo"}
    if group == "learning":
        then["steps"] = now["steps"]
    # In the record stands also what was settled where nothing was asked for.
    different = [name for name in now if now[name] != then[name] and not (group == "clips" and now[name] is None)]
    return {f"{group}.{name}": f"--{name.replace('_', '-')} is {now[name]}, was {then[name]}" for name in different}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Options by the names of their flags; lists, which YAML makes of some tuples, as tuples."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = tuple(value) if isinstance(value, list) else value
    return flat


def _is_settled(name: str) -> bool:
    group, _, flag = name.partition(".")
    return group in SETTLED_GROUPS or (group == "motion" and flag.split(".")[0] in SETTLED_OPTIONS)


def _several(changes: list[str]) -> str:
    more = f" and {len(changes) - SEVERAL} more" if len(changes) > SEVERAL else ""
    return ", ".join(changes[:SEVERAL]) + more
