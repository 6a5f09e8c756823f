"""Open a scene and see that its splat and its cameras fit each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.loading import Up, read_scene
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.scene.source_views import RunCameras
from pgsd_nerfstudio.weather.agreement import agreed


def load_scene(
    path: str | Path,
    data: str | Path | None = None,
    *,
    metres_per_unit: float | None = None,
    description: str | None = None,
    up: Up | None = None,
    camera: Literal["orbit"] | None = None,
    trust_cameras: bool = False,
    run_cameras: RunCameras | None = None,
) -> Scene:
    """Load a scene with its cameras and its metric frame.

    Where photographs are there, renders of some views are compared with them. If they do not look alike, the cameras are tried
    at the places where splats of such a capture are found; `Scene.remarks` says what was done.

    Args:
        path: "demo", a splatfacto run folder, its config.yml, a .ckpt of it, a splat of any format that is read (.ply, .spz and
            others), or the output folder of Inria's trainer.
        data: where the cameras of a splat are: a transforms.json, a COLMAP reconstruction, a cameras.json of Inria's trainer,
            the folder of one of them, or a splatfacto run. For a run it replaces the run's own data, and the run's
            dataparser_transforms.json moves the poses.
        metres_per_unit: length of a scene unit; None: it is estimated.
        description: name of the scene in prompts ("a garden"); None: it is made from the name of the file.
        up: which way is up: "x", "-y" and so on, or three numbers in scene axes; None: it is estimated.
        camera: "orbit" makes cameras around the middle of a splat that has none.
        trust_cameras: whether to compare nothing and take the cameras as they are.
        run_cameras: function that reads the cameras of a run with the run's own dataparser; None: the installed one (entry
            point group `pgsd_nerfstudio.run_cameras`), which imports nerfstudio only then.

    Raises:
        SceneError: the input cannot be used, or the cameras do not fit the splat; the sentence says why and what to do.
        TypeError: an argument is of another type.
    """
    scene = read_scene(
        path, data, metres_per_unit=metres_per_unit, description=description, up=up, camera=camera, run_cameras=run_cameras
    )
    if trust_cameras or not scene.photographed():
        return replace(scene, trusted=True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return agreed(scene, choose_rasterizer(scene.gaussians.to(device), device), device)
