"""Read a scene from a splatfacto run, its config.yml, a checkpoint, a splat of any format, or the built-in demo."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.capture import Capture
from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.frame import CAMERA_HEIGHT, Frame, direction, estimate_frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.level import upright
from pgsd_nerfstudio.scene.orbit import VIEWS, orbit
from pgsd_nerfstudio.scene.scene import Known, Scene
from pgsd_nerfstudio.scene.source import check_source, source_of
from pgsd_nerfstudio.scene.source_views import RunCameras, views_of
from pgsd_nerfstudio.scene.splats.reading import read_splat

Up = str | tuple[float, float, float]
"""The name of an axis (x, y, z, -x, -y, -z), or a direction in scene axes."""

# Names of files and folders that do not describe the scene in them.
NAMELESS = {"data", "pointcloud", "splat", "scene", "output", "outputs", "export", "exports", "images", "nerfstudio"}
HIGH, LOW = 50.0, 0.1  # m: cameras that stand higher above the ground or lower are doubted; a drone flies at 100 m,
HIGHEST, LOWEST = 1000.0, 0.01  # m: but not at 1,000 m, and no camera sees anything from less than a centimetre


def read_scene(
    path: str | Path,
    data: str | Path | None = None,
    *,
    metres_per_unit: float | None = None,
    description: str | None = None,
    up: Up | None = None,
    camera: Literal["orbit"] | None = None,
    run_cameras: RunCameras | None = None,
) -> Scene:
    """Read a scene with its cameras and its metric frame. Whether cameras and splat fit each other is not looked at here.

    Args:
        path: what holds the splat; this and the next five as for `weather.loading.load_scene`.
        data: what holds its cameras.
        metres_per_unit: length of a scene unit.
        description: name of the scene in prompts.
        up: which way is up.
        camera: "orbit" makes cameras.
        run_cameras: function that reads the cameras of a run with the run's own dataparser; None: the installed one (entry
            point group `pgsd_nerfstudio.run_cameras`), which imports nerfstudio only then.

    Raises:
        SceneError: the input cannot be used; the sentence says why and what to do.
        TypeError: an argument is of another type.
    """
    check_source(path, data, metres_per_unit, up, camera)
    known: Known = (metres_per_unit, None if up is None else direction(up))
    if str(path) == "demo":
        return _demo(known, description)
    source = source_of(Path(path).expanduser())
    splat = read_splat(source.splat)
    if camera == "orbit":
        capture, (cameras, direction_up, remark) = None, _made(source.splat, splat.gaussians, known[1])
        known, remarks = (metres_per_unit, direction_up), [remark]
    else:
        capture, remarks = views_of(source, None if data is None else Path(data).expanduser(), run_cameras, splat.offset)
        cameras = capture.cameras()
        remarks += _missing(capture)
    frame = _frame(source.splat, cameras, splat.gaussians, known)
    return Scene(
        source.name or "scene",
        splat.gaussians,
        cameras,
        frame,
        () if capture is None else capture.photographs,
        description or _described(source.name),
        offset=splat.offset,
        placements=() if capture is None else capture.placements,
        known=known,
        remarks=(*remarks, *_doubts(cameras, frame, metres_per_unit)),
    )


def _demo(known: Known, description: str | None) -> Scene:
    from pgsd_nerfstudio.scene.demo import demo_scene

    scene = demo_scene()
    if known[1] is not None:
        scene = replace(scene, frame=estimate_frame(scene.cameras, scene.gaussians, *known))
    elif known[0] is not None:
        frame = replace(scene.frame, metres_per_unit=known[0], source=f"{scene.frame.source}; scale as given")
        scene = replace(scene, frame=frame)
    remarks = tuple(_doubts(scene.cameras, scene.frame, known[0]))
    return replace(scene, description=description or scene.description, known=known, remarks=remarks)


def _made(
    splat: Path, gaussians: Gaussians, up: tuple[float, float, float] | None
) -> tuple[Cameras, tuple[float, float, float], str]:
    """Cameras for a splat that has none, the direction that is up, and what is to be said."""
    said = "up as given"
    if up is None:
        found = upright(gaussians)
        if found is None:
            raise SceneError(
                f"no plane in {splat} stands out as the ground: pass up= too (x, y, z, -x, -y, -z or three numbers)"
            )
        up = direction(found.tolist())
        said = f"up is across its largest plane ({', '.join(f'{value:.2f}' for value in up)}); if that is wrong, pass up="
    cameras = orbit(gaussians, torch.tensor(up, dtype=torch.float64))
    return (
        cameras,
        up,
        f"there are no cameras: {VIEWS} are made on an orbit around the middle of the splat; {said}; its scale is a guess, so "
        "pass metres_per_unit= if it is known",
    )


def _frame(splat: Path, cameras: Cameras, gaussians: Gaussians, known: Known) -> Frame:
    try:
        return estimate_frame(cameras, gaussians, *known)
    except (ValueError, RuntimeError) as error:  # a scale that is zero or infinite, a system that cannot be solved
        raise SceneError(f"{splat} and its cameras give no metric frame ({error}): pass metres_per_unit= and up=") from error


def _missing(capture: Capture) -> list[str]:
    """What is to be said of photographs that are not on disk."""
    gone = [photograph.path for photograph in capture.photographs if not photograph.there]
    if not gone:
        return []
    count = len(capture.photographs)
    if len(gone) == count:
        return [f"none of the {count} photographs is there, such as {gone[0]}: nothing is compared with them"]
    return [f"{len(gone)} of the {count} photographs are missing, such as {gone[0]}"]


def _doubts(cameras: Cameras, frame: Frame, metres_per_unit: float | None) -> list[str]:
    """What is to be said of a given scale that puts the cameras where nobody stands.

    Raises:
        SceneError: no camera can be where they are.
    """
    height = float(frame.to_metric(cameras.centers)[:, 2].median())
    if metres_per_unit is None or LOW <= height <= HIGH:
        return []
    stand = f"{height:,.0f}" if height >= 100 else f"{height:.3g}"
    where = f"at {metres_per_unit:g} m per unit the cameras stand {stand} m above the ground"
    usual = metres_per_unit * CAMERA_HEIGHT / height
    if LOWEST <= height <= HIGHEST or usual <= 0:
        hint = f" (at {usual:.3g} m per unit they would stand {CAMERA_HEIGHT:g} m above it)" if usual > 0 else ""
        return [f"{where}: is the scale right{hint}?"]
    raise SceneError(
        f"{where}, where no camera can be: leave metres_per_unit= out to have the scale estimated, or pass {usual:.3g}, with "
        f"which they stand {CAMERA_HEIGHT:g} m above it"
    )


def _described(name: str) -> str:
    """The name with its article ("a garden") if it is a plain word that describes the scene, else "a scene"."""
    if not name.isalpha() or name.lower() in NAMELESS:
        return "a scene"
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name.lower()}"
