"""Load a scene from a splatfacto run, its config.yml, a checkpoint, a 3DGS .ply, or the built-in demo."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.capture import in_run, read_capture
from pgsd_nerfstudio.scene.frame import estimate_frame
from pgsd_nerfstudio.scene.scene import Scene, SceneError
from pgsd_nerfstudio.scene.splats.checkpoint import read_checkpoint
from pgsd_nerfstudio.scene.splats.ply import read_ply

RunCameras = Callable[[Path], tuple[Cameras, tuple[Path, ...]]]
"""Function from the config.yml of a run to its cameras (in the coordinates of the splat) and photographs."""

# Names of files and folders that do not describe the scene in them.
NAMELESS = {"data", "pointcloud", "splat", "scene", "output", "outputs", "export", "exports", "images", "nerfstudio"}


def load_scene(
    path: str | Path,
    data: str | Path | None = None,
    *,
    metres_per_unit: float | None = None,
    description: str | None = None,
    run_cameras: RunCameras | None = None,
) -> Scene:
    """Load a scene with its cameras and its metric frame.

    Args:
        path: "demo", a splatfacto run folder, its config.yml, a .ckpt of it, or a 3DGS .ply.
        data: a transforms.json, its folder, or a splatfacto run. A .ply needs it: the .ply is taken to be in the coordinates of
            the poses there, or in those of the run, as ns-export writes it. For a run it replaces the run's own data, and the
            run's dataparser_transforms.json moves the poses.
        metres_per_unit: length of a scene unit; None: it is estimated.
        description: name of the scene in prompts ("a garden"); None: it is made from the name of the file.
        run_cameras: function that reads the cameras of a run with the run's own dataparser; None: the installed one (entry
            point group `pgsd_nerfstudio.run_cameras`), which imports nerfstudio only then.

    Raises:
        SceneError: the input cannot be used; the sentence says why and what to do.
    """
    check_source(path, data, metres_per_unit)
    if str(path) == "demo":
        return _demo(metres_per_unit, description)
    path, data = Path(path).expanduser(), None if data is None else Path(data).expanduser()
    if path.suffix.lower() == ".ply":
        gaussians = read_ply(path)
        cameras, images = _ply_cameras(path, data, run_cameras)
        name = path.stem
    else:
        checkpoint, run = _checkpoint(path)
        gaussians = read_checkpoint(checkpoint)
        cameras, images = _run_cameras(run, data, run_cameras)
        name = run.parent.parent.name if run.parent.name == "splatfacto" else run.name
    frame = estimate_frame(cameras, gaussians, metres_per_unit)
    return Scene(name or "scene", gaussians, cameras, frame, images, description or _described(name))


def check_source(path: str | Path, data: str | Path | None, metres_per_unit: float | None) -> None:
    """Refuse what `load_scene` can refuse without opening anything; its arguments have the same names.

    Raises:
        SceneError: there is no such scene or data, or the scale is not a positive number.
    """
    if metres_per_unit is not None and not 0 < metres_per_unit < math.inf:
        raise SceneError(f"metres per scene unit must be a positive number, got {metres_per_unit:g}")
    if str(path) != "demo" and not Path(path).expanduser().exists():
        raise SceneError(f"no scene at {path}: expected a splatfacto run folder, config.yml, .ckpt or .ply, or the word demo")
    if data is not None and not Path(data).expanduser().exists():
        raise SceneError(f"no data at {data}: expected nerfstudio's transforms.json or its folder")


def _demo(metres_per_unit: float | None, description: str | None) -> Scene:
    from pgsd_nerfstudio.scene.demo import demo_scene

    scene = demo_scene()
    if metres_per_unit is not None:
        frame = replace(scene.frame, metres_per_unit=metres_per_unit, source=f"{scene.frame.source}; scale as given")
        scene = replace(scene, frame=frame)
    return scene if description is None else replace(scene, description=description)


def _checkpoint(path: Path) -> tuple[Path, Path]:
    """The newest checkpoint of a run folder, config.yml or .ckpt, and the run's folder."""
    if path.suffix == ".ckpt":
        return path, path.resolve().parent.parent
    run = path.resolve() if path.is_dir() else path.resolve().parent
    if path.is_file() and path.name != "config.yml":
        raise SceneError(f"{path} is no scene: expected a splatfacto run folder, config.yml, .ckpt or .ply, or the word demo")
    if run.parent.name == "pgsd-weather":
        raise SceneError(
            f"{path} is a run of pgsd-weather, which holds a weather and no scene: ns-viewer and ns-render show it; "
            "for another weather pass the scene that it was trained on"
        )
    checkpoints = sorted((run / "nerfstudio_models").glob("step-*.ckpt"))
    if not checkpoints:
        raise SceneError(f"{run} is no trained run: expected nerfstudio_models/step-*.ckpt in it, found none")
    return checkpoints[-1], run


def _ply_cameras(path: Path, data: Path | None, run_cameras: RunCameras | None) -> tuple[Cameras, tuple[Path, ...]]:
    if data is None:
        raise SceneError(f"{path} holds no cameras: pass --data with the transforms.json that it was trained on")
    config = data / "config.yml" if data.is_dir() else data
    if config.name == "config.yml" and config.is_file() and not (data / "transforms.json").is_file():
        return _run_cameras(config.resolve().parent, None, run_cameras)
    return read_capture(data)


def _run_cameras(run: Path, data: Path | None, run_cameras: RunCameras | None) -> tuple[Cameras, tuple[Path, ...]]:
    if data is not None:
        cameras, images = read_capture(data)
        return in_run(cameras, data, run / "dataparser_transforms.json"), images
    config = run / "config.yml"
    if not config.is_file():
        raise SceneError(f"cameras are missing: there is no {config}; pass --data with the transforms.json it was trained on")
    run_cameras = run_cameras or _installed_reader()
    if run_cameras is None:
        raise SceneError(f"only nerfstudio reads the cameras of {run}; pass --data with the transforms.json it was trained on")
    cameras, images = run_cameras(config)
    if len(cameras) == 0:
        raise SceneError(f"{config} leads to data without cameras; pass --data with the transforms.json it was trained on")
    return cameras, images


def _installed_reader() -> RunCameras | None:
    """What reads the cameras of a run; an entry point, so that this room does not know nerfstudio."""
    return next((point.load() for point in entry_points(group="pgsd_nerfstudio.run_cameras")), None)


def _described(name: str) -> str:
    """The name with its article ("a garden") if it is a plain word that describes the scene, else "a scene"."""
    if not name.isalpha() or name.lower() in NAMELESS:
        return "a scene"
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name.lower()}"


__all__ = ["RunCameras", "Scene", "SceneError", "load_scene"]
