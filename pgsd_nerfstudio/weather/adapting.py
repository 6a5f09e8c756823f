"""An effect as a scene has it: what nobody asked for follows the distance of what its cameras see and the way they look."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects import Effect
from pgsd_nerfstudio.effects.adaptation import Adaptation
from pgsd_nerfstudio.effects.matter import INTENSITIES
from pgsd_nerfstudio.effects.options import legible
from pgsd_nerfstudio.scene.camera_path import choose_views
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.weather.prepared_scene import PreparedScene

VIEWS = 5  # cameras that are asked for their background
WIDTH = 96  # pixels
BEHIND = 0.7  # share of a picture that is nearer than its background
SOLID = 0.5  # accumulation from which a pixel shows something
FAR = 12.0  # m; rain's particles are drawn up to about here
MOST = 4.0  # nearness


def adapted(effect: Effect, prepared: PreparedScene) -> tuple[Effect, list[str]]:
    """The effect with all that follows the scene, and what is to be said about it.

    Args:
        effect: the weather; `adaptation` says what follows.
        prepared: the scene.
    """
    asked, said = effect.adaptation, []
    shown = prepared.scene.cameras[torch.tensor(choose_views(prepared.scene.cameras, prepared.scene.frame))]
    if asked.wind_across:
        effect = replace(effect, wind=replace(effect.wind, direction_degrees=_across(prepared, shown)))
    if asked.visibility is not None and not effect.emission.precipitates:
        behind = background_distance(prepared)
        if behind is not None:
            low, high = INTENSITIES[effect.emission.kind]
            visibility = float(np.clip(_round(asked.visibility * behind), low, high))
            effect = replace(effect, emission=replace(effect.emission, intensity=visibility))
            said.append(
                f"visibility {visibility:g} m, {asked.visibility:g} times the distance of the background ({behind:.1f} m); "
                "--intensity sets another"
            )
    if asked.air is not None:
        found = air_before(prepared)
        more = _round(min(max(asked.air / found, 1.0), MOST))
        effect = replace(effect, appearance=replace(effect.appearance, nearness=more), adaptation=Adaptation())
        why = f", {more:g} times more than usual: only {found:.1f} m of air lie before what is seen" if more > 1 else ""
        said += [sentence + why for sentence in legible(effect)]
    return replace(effect, adaptation=Adaptation()), said


def background_distance(prepared: PreparedScene) -> float | None:
    """Median over some views of the distance in metres of what is in the background; None where nothing is seen.

    Args:
        prepared: the scene.
    """
    solid = (seen[torch.isfinite(seen)] for seen in _distances(prepared))
    found = [float(metres.quantile(BEHIND)) for metres in solid if len(metres)]
    return float(np.median(found)) if found else None


def air_before(prepared: PreparedScene) -> float:
    """Mean over the pixels of some views of the metres of air before what is seen, of which no more than FAR count: beyond,
    hardly any flake or drop is told apart.

    Args:
        prepared: the scene.
    """
    return float(torch.cat(_distances(prepared)).clamp_max(FAR).mean())


def _distances(prepared: PreparedScene) -> list[Float[Tensor, " n"]]:
    """Depths in metres of what the pixels of some small pictures show; inf where they show nothing solid."""
    cameras, metres = prepared.scene.cameras, prepared.scene.frame.metres_per_unit
    chosen = sorted({round(i) for i in np.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras)))})
    found = []
    for index in chosen:
        camera = cameras[index]
        height = max(2, round(WIDTH * camera.height / camera.width))
        with torch.no_grad():
            picture = prepared.rasterizer.render(camera.resized(WIDTH, height).to(prepared.device), None, None, None)
        depths = torch.where(picture.accumulation[0] > SOLID, metres * picture.depth[0].float(), math.inf)
        found.append(depths.flatten().cpu())
    return found


def _across(prepared: PreparedScene, cameras: Cameras) -> float:
    """Direction in degrees of what is on the right of cameras, on average."""
    frame = prepared.scene.frame
    right = cameras.viewmats[:, 0, :3].double().cpu() @ frame.rotation.cpu().double().T
    x, y = right.sum(0)[:2].tolist()
    return math.degrees(math.atan2(y, x))


def _round(metres: float) -> float:
    """Two digits: more would promise too much."""
    digits = 1 - math.floor(math.log10(max(metres, 1e-6)))
    return round(metres, digits)
