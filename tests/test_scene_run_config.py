"""config.yml as data: what nerfstudio's own reader makes of it, without importing or calling anything that the file names."""

from pathlib import Path

import pytest
import yaml

from pgsd_nerfstudio.scene.run_config import Record, entry, read_run_config
from pgsd_nerfstudio.scene.scene import SceneError

HEAD = "!!python/object:nerfstudio.engine.trainer.TrainerConfig\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "config.yml"
    path.write_text(text)
    return path


def same(ours, theirs) -> bool:
    """Whether a record holds what the object of nerfstudio's reader holds."""
    if isinstance(ours, Record):
        if not ours:
            return ours.python == f"{theirs.__module__}.{theirs.__qualname__}"
        if ours.keys() == {"arguments"}:
            return ours["arguments"] == [theirs.value] and ours.python == f"{type(theirs).__module__}.{type(theirs).__name__}"
        return ours.python == f"{type(theirs).__module__}.{type(theirs).__name__}" and same(dict(ours), vars(theirs))
    if isinstance(ours, dict):
        return ours.keys() == theirs.keys() and all(same(ours[key], theirs[key]) for key in ours)
    if isinstance(ours, list | tuple):
        return type(ours) is type(theirs) and len(ours) == len(theirs) and all(map(same, ours, theirs))
    return type(ours) is type(theirs) and ours == theirs


@pytest.mark.parametrize("method", ["splatfacto", "nerfacto", "nerfacto-huge"])
def test_a_config_holds_what_nerfstudio_reads_in_it(tmp_path: Path, method: str):
    from nerfstudio.configs.method_configs import method_configs

    path = written(tmp_path, yaml.dump(method_configs[method]))
    ours, theirs = read_run_config(path), yaml.load(path.read_text(), Loader=yaml.Loader)
    assert same(ours, theirs)
    assert entry(ours, "max_num_iterations") == theirs.max_num_iterations
    assert entry(ours, "pipeline", "nothing", "here") is None


def test_nothing_that_a_config_names_is_imported_or_called(tmp_path: Path):
    evidence = tmp_path / "evidence"
    path = written(
        tmp_path,
        f"{HEAD}data: !!python/object/apply:os.mkdir [{evidence}]\n"
        f"machine: !!python/object/new:pathlib.Path.mkdir [{evidence}]\n"
        f"viewer: !!python/object/apply:subprocess.check_output {{args: [mkdir, {evidence}]}}\n"
        "logging: !!python/name:antigravity.nothing ''\nprompt: !!python/module:this ''\n",
    )
    config = read_run_config(path)
    assert not evidence.exists()
    assert config["data"].python == "os.mkdir" and config["data"]["arguments"] == [str(evidence)]


def test_a_class_that_is_gone_is_still_read(tmp_path: Path):
    text = (
        f"{HEAD}pipeline: !!python/object:gone.Pipeline\n  model: !!python/object:gone.Model {{rasterize_mode: antialiased}}\n"
    )
    config = read_run_config(written(tmp_path, text))
    assert entry(config, "pipeline", "model", "rasterize_mode") == "antialiased"
    assert config["pipeline"].python == "gone.Pipeline"


@pytest.mark.parametrize(
    "text",
    [
        *("", "just words", "- [", "a: 1", "\x00", HEAD, f"{HEAD}- a", f"{HEAD}a: 2024-99-99", f"{HEAD}a: !!timestamp x"),
        *(f"{HEAD}a: &x [*x]\nb: !!python/tuple [&y [*y]]", f"{HEAD}? [a, b]\n: 1\n? {{}}\n: 2", f"{HEAD}a: !!nothing x"),
        *(f"{HEAD}a: {'[' * 5000}", f"{HEAD}a: {'1' * 10_000}", f"{HEAD}a: !!int x", f"{HEAD}b: {'x' * 1_000_001}"),
        f"{HEAD}a: &a {{b: 1}}\nc: {{<<: [*a, *a]}}",
    ],
)
def test_what_is_no_config_is_refused_in_a_sentence(text: str, tmp_path: Path):
    with pytest.raises(SceneError, match=r"config\.yml"):
        read_run_config(written(tmp_path, text))
