"""Make the puddles of a scene, keep them as tensors, and make them again from these."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.clock import domain_of
from pgsd_nerfstudio.physics.ground.standing_water import StandingWater
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.mirrored_scene import MirroredScene
from pgsd_nerfstudio.response.puddles import Puddles
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh


def water_of(
    scene: Scene, metric: Gaussians, surface: SurfaceMesh, effect: Effect, sky: Float[Tensor, " n"], *, seed: int
) -> dict[str, Tensor]:
    """What a scene's puddles are made of, for `puddles_of`; nothing where no water wets or no surface is known.

    Args:
        scene: the frozen scene.
        metric: its Gaussians in metres, with plain RGB, as the clouds of the full weather light them.
        surface: its mesh in metres.
        effect: the weather.
        sky: share of each Gaussian that is sky, 0..1.
        seed: of the unevenness of the ground.
    """
    if effect.surface.landing != "wets" or len(surface.triangles) == 0:
        return {}
    ground = StandingWater.of(surface, domain_of(scene), unevenness=effect.surface.unevenness, seed=seed)
    # Cameras of a capture stand in the open.
    middle = scene.frame.to_metric(scene.cameras.centers[:1].float())[0]
    return _tensors(ground, MirroredScene.of(metric, surface, middle, sky))


def stored_water(puddles: Puddles) -> dict[str, Tensor]:
    """The tensors of `water_of` from which puddles were made."""
    return _tensors(puddles.ground, puddles.scene)


def _tensors(ground: StandingWater, mirrored: MirroredScene) -> dict[str, Tensor]:
    return {
        "ground": torch.from_numpy(ground.ground),
        "under_sky": torch.from_numpy(ground.under_sky),
        "place": torch.tensor([*ground.lower, ground.cell, *ground.level], dtype=torch.float64),
        "vertices": mirrored.surface.vertices,
        "triangles": mirrored.surface.triangles,
        "light": mirrored.light,
        "far": mirrored.far,
        "open": mirrored.open,
    }


def puddles_of(
    tensors: dict[str, Tensor], scene: Scene, metric: Gaussians, effect: Effect, exposure: Exposure
) -> Puddles | None:
    """The puddles of a scene; None if `water_of` found nothing.

    Args:
        tensors: of `water_of`.
        scene: the frozen scene.
        metric: its Gaussians in metres, with plain RGB.
        effect: the weather.
        exposure: of the Gaussians.
    """
    if not tensors:
        return None
    place = tensors["place"].numpy().astype(np.float64)
    under_sky = tensors["under_sky"].numpy()
    ground = StandingWater.on(tensors["ground"].numpy(), place[:2], float(place[2]), place[3:], under_sky)
    surface = SurfaceMesh(tensors["vertices"], tensors["triangles"])
    mirrored = MirroredScene(surface, tensors["light"], tensors["far"], tensors["open"])
    return Puddles.of(effect, scene.frame, metric, exposure, ground, mirrored)
