"""Puddles: the frozen Gaussians under standing water, what they mirror, and the rings of drops that are drawn on it.

Water mirrors by Fresnel's law; rings tilt its surface and with it the mirrored direction. A Gaussian shows the slope at its
centre, averaged over its own size. Rings are often finer than the Gaussians of a pavement, so those near a camera are also
drawn themselves, as arcs (`ring_arcs`), with the light that the water there sends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.physics.ground.standing_water import Pools, StandingWater, depth_over
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.rendering.moment import Viewpoint
from pgsd_nerfstudio.response.coating import falling_mass, rained
from pgsd_nerfstudio.response.crowns import crowned, crowns_of
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.impacts import Impacts
from pgsd_nerfstudio.response.light import leafy, mirrored
from pgsd_nerfstudio.response.mirrored_scene import MirroredScene
from pgsd_nerfstudio.response.ring_arcs import arcs_of
from pgsd_nerfstudio.response.ripples import Ripples, tilted
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate

WATER = 1000.0  # kg/m^3
FULL = 0.0006  # m of water under which nothing of the ground stands out
GREEN = 0.4  # likeness to leaves (light.leafy) of ground that water does not cover
SUNK = 0.03  # m; Gaussians this near to the ground are part of it
SMOOTH_FILM = 0.45  # light that a film on wet level ground mirrors, relative to standing water
STEEP, LEVEL = 0.75, 0.95  # upward part of a normal up to which no film mirrors, and from which it does in full
FILLED = 0.5  # weight of the upward direction in the normal of a film
ROUGH = 0.08  # standard deviation of a film's normal along each axis, before it is normalised
LEAST_MIRRORED = 0.004  # share of mirrored light below which no ray is cast
LEAST_WAVES = 0.05  # of the slopes of rings that is left, below which a Gaussian is still
SHORT_WAVES = 500.0  # 1/m; wave number by which the slopes of rings are averaged over the size of a Gaussian
LOWEST = 0.01  # sine of the least height above the horizon from which water mirrors light
NEXT = 0.08  # m; the ground of an arc is the Gaussian within this distance
LEAST_SHARE = 0.2  # of standing water on which a ring is drawn
TOWARDS = 0.06  # m by which arcs are drawn nearer to the camera than the ground, whose Gaussians overlap them


@dataclass(frozen=True, eq=False)
class Puddles:
    """Standing water among N frozen Gaussians."""

    effect: Effect
    frame: Frame
    """Of the scene."""
    ground: StandingWater
    scene: MirroredScene
    points: Float[Tensor, "n 3"]
    """Centres of the Gaussians, metres."""
    rgb: Float[Tensor, "n 3"]
    """Their sRGB without weather."""
    sizes: Float[Tensor, " n"]
    """Middle standard deviation of each Gaussian, metres."""
    film: Float[Tensor, " n"]
    """Light that a film of water on each Gaussian mirrors, relative to standing water."""
    facing: Float[Tensor, "n 3"]
    """Unit normals of such films."""
    basin: Int[Tensor, " n"]
    """Hollow in whose ground each Gaussian lies, -1 for none."""
    floor: Float[Tensor, " n"]
    """Height of the ground below each Gaussian above the level plane, metres."""
    bottom: KDTree
    """Of the Gaussians that are the ground of hollows, in metres along x and y."""
    bottom_ids: Int[ndarray, " b"]
    """Their numbers."""
    impacts: Impacts | None = None
    """Of the drops of a simulation; None: nothing falls."""
    ripples: Ripples | None = None
    """Rings of these drops; None: still water."""

    @staticmethod
    def of(
        effect: Effect,
        frame: Frame,
        metric: Gaussians,
        exposure: Exposure,
        ground: StandingWater,
        scene: MirroredScene,
    ) -> Puddles:
        """The puddles of a scene under an effect.

        Args:
            effect: the weather.
            frame: of the scene.
            metric: the frozen Gaussians in metres, with plain RGB.
            exposure: of the Gaussians.
            ground: its hollows.
            scene: the surroundings that water mirrors.
        """
        at = metric.means.double().numpy()
        basin, floor = ground.under(at[:, :2])
        part = np.abs(at[:, 2] - ground.height(at[:, :2], floor)) < SUNK
        # Blades of grass stand out of water that stands between them.
        part &= ~exposure.loose.numpy() & (leafy(linear(metric.colors)).numpy() < GREEN)
        bottom = np.flatnonzero(part & (basin >= 0) & (metric.opacities.numpy() > 0.3))
        level = ((exposure.normals[:, 2] - STEEP) / (LEVEL - STEEP)).clamp(0, 1) * ~exposure.loose
        # A film is smoother than the ground below it, whose normals in a capture are rough by themselves.
        rough = ROUGH * torch.randn(len(metric), 3, generator=torch.Generator().manual_seed(0))
        facing = exposure.normals + FILLED * torch.tensor([0.0, 0.0, 1.0]) + rough
        return Puddles(
            effect=effect,
            frame=frame,
            ground=ground,
            scene=scene,
            points=metric.means,
            rgb=metric.colors,
            sizes=metric.scales.sort(dim=1).values[:, 1],
            film=SMOOTH_FILM * level * (1 - leafy(linear(metric.colors))),
            facing=torch.nn.functional.normalize(facing, dim=1),
            basin=torch.from_numpy(np.where(part, basin, -1)),
            floor=torch.from_numpy(floor).float(),
            bottom=KDTree(at[bottom, :2] if len(bottom) else np.zeros((1, 2))),
            bottom_ids=bottom,
        )

    def each(self, change: Callable[[Tensor], Tensor]) -> Puddles:
        """The puddles of other Gaussians or on another device.

        Args:
            change: turns a tensor with a row for each Gaussian into that of the others.
        """
        count = len(self.points)
        kept = change(torch.arange(count, device=self.points.device)).cpu().numpy()
        number = np.full(count, -1)
        number[kept] = np.arange(len(kept))
        left = number[self.bottom_ids] >= 0 if len(self.bottom_ids) else np.zeros(0, bool)
        tensors = {name: change(getattr(self, name)) for name in ("points", "rgb", "sizes", "film", "facing", "basin", "floor")}
        bottom = KDTree(np.asarray(self.bottom.data)[left]) if left.any() else self.bottom
        return replace(self, **tensors, bottom=bottom, bottom_ids=number[self.bottom_ids[left]])

    def struck_by(self, history: ParticleHistory) -> Puddles:
        """The same puddles with the rings and crowns of a simulation's drops."""
        impacts = Impacts.of(history)
        return replace(self, impacts=impacts, ripples=Ripples.of(impacts, self.ground, self.effect.material))

    def seen(self, points: Float[Tensor, "m 3"], directions: Float[Tensor, "m 3"], weather: float) -> Float[Tensor, "m 3"]:
        """Linear light that water mirrors: that of the scene, or of the even sky alone.

        Args:
            points: of the water, metres.
            directions: metric unit vectors away from it.
            weather: share of the full weather, 0..1.
        """
        ambience = self.effect.ambience
        if self.effect.surface.mirror:
            return self.scene.seen(points, directions, ambience, weather)
        return linear(torch.tensor((ambience or Ambience()).sky)).to(points).expand(len(points), 3)

    @cached_property
    def nearest(self) -> KDTree:
        """Of all Gaussians, in metres."""
        return KDTree(self.points.numpy(force=True))

    @property
    def rippling(self) -> bool:
        """Whether drops make rings."""
        return self.effect.surface.puddles and self.effect.surface.ripples

    def mirrored(self, cosine: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """Share of light that water mirrors, from the cosine to its normal: at a legibility of 1 Fresnel's law, else its
        product with the root of the legibility, at most 1."""
        sheen = self.effect.appearance.legibility**0.5
        return (sheen * mirrored(cosine)).clamp_max(1.0) * (cosine > 0)

    def at(self, seconds: float) -> PuddlesNow:
        """The puddles at a second."""
        fallen = falling_mass(self.effect) / WATER * rained(self.effect, seconds) * self.effect.surface.accumulation_speedup
        pools = self.ground.after(fallen)
        depth = depth_over(pools, self.basin.numpy(force=True), self.floor.numpy(force=True))
        share = torch.from_numpy(shown(depth)).to(self.floor) * self.effect.surface.puddles
        return PuddlesNow(self, seconds, pools, share)


@dataclass(frozen=True, eq=False)
class PuddlesNow:
    """Puddles at one moment."""

    puddles: Puddles
    seconds: float
    pools: Pools
    share: Float[Tensor, " n"]
    """Share of each Gaussian that is under standing water, 0..1."""

    def mirror(
        self, ids: Int[Tensor, " m"], towards: Float[Tensor, "m 3"], wet: Float[Tensor, " m"], weather: float
    ) -> tuple[Float[Tensor, "m 3"], Float[Tensor, " m"]]:
        """Linear light that wet Gaussians mirror, and the share of light that water does not let through from below.

        Args:
            ids: numbers of the Gaussians.
            towards: metric unit vectors to the camera.
            wet: share of each that is wet, 0..1.
            weather: share of the full weather, 0..1.
        """
        puddles = self.puddles
        light, kept = torch.zeros_like(towards), torch.zeros_like(towards[:, 0])
        under = self.share[ids].to(towards) * wet
        smooth = torch.maximum(wet * puddles.film[ids].to(towards), under)
        some = (smooth > LEAST_MIRRORED).nonzero()[:, 0]
        ids, towards, smooth = ids[some], towards[some], smooth[some]
        facing = puddles.facing[ids].to(towards)
        pooled = (under[some] > 0).nonzero()[:, 0]
        facing[pooled] = torch.tensor([0.0, 0.0, 1.0]).to(towards)
        if puddles.ripples is not None and puddles.rippling and len(pooled):
            which = ids[pooled]
            # Waves shorter than a Gaussian tilt its halves against each other.
            own = torch.exp(-((SHORT_WAVES * puddles.sizes[which]) ** 2) / 2)
            fine = own > LEAST_WAVES
            places = puddles.points[which[fine], :2].double().numpy(force=True)
            slopes = puddles.ripples.slopes(places, self.seconds) * own[fine, None].double().numpy(force=True)
            facing[pooled[fine]] = tilted(slopes).to(towards)
        share = smooth * puddles.mirrored((facing * towards).sum(1))
        bright = (share > LEAST_MIRRORED).nonzero()[:, 0]
        away = reflected(towards[bright], facing[bright])
        seen = puddles.seen(puddles.points[ids[bright]], away, weather).to(towards)
        light[some[bright]] = share[bright, None] * seen
        kept[some] = share
        return light, kept

    def drawn(self, view: Viewpoint, below: Below, weather: float) -> Gaussians | None:
        """The rings and crowns of drops near a camera as Gaussians in scene units; None if it sees none.

        Args:
            view: the camera, in scene units.
            below: gives the ground.
            weather: share of the full weather, 0..1.
        """
        puddles = self.puddles
        one = Cameras(view.viewmat.cpu().float()[None], view.K.cpu().float()[None], view.width, view.height)
        camera = puddles.frame.cameras_to_metric(one)
        parts = [self._rings(camera, below, weather), self._crowns(camera, below)]
        found = [part for part in parts if part is not None and len(part)]
        return puddles.frame.gaussians_to_scene(concatenate(found)).to(view.viewmat.device) if found else None

    def _rings(self, camera: Cameras, below: Below, weather: float) -> Gaussians | None:
        """The rings near a camera in metres."""
        puddles = self.puddles
        if puddles.ripples is None or not puddles.rippling or len(puddles.bottom_ids) == 0:
            return None
        arcs = arcs_of(puddles.ripples, self.seconds, camera, float(puddles.ground.level[0]))
        basin, floor = puddles.ground.under(arcs.places)
        depth = depth_over(self.pools, basin, floor)
        share = shown(depth)
        away, nearest = puddles.bottom.query(arcs.places, distance_upper_bound=NEXT)
        kept = (share > LEAST_SHARE) & np.isfinite(away)
        if not kept.any():
            return None
        arcs, share = arcs.select(kept), share[kept]
        z = puddles.ground.height(arcs.places, (floor + np.maximum(depth, 0))[kept])
        points = torch.from_numpy(np.concatenate([arcs.places, z[:, None]], 1)).float()
        normals = tilted(arcs.slopes)
        towards = torch.nn.functional.normalize(camera.centers[0] - points, dim=1)
        cosine = (normals * towards).sum(1)
        fresnel = puddles.mirrored(cosine)
        seen = puddles.seen(points, reflected(towards, normals), weather)
        ground = linear(below(torch.from_numpy(puddles.bottom_ids[nearest[kept]])).cpu())
        light = (1 - fresnel)[:, None] * ground + fresnel[:, None] * seen
        return arcs.gaussians(points + TOWARDS * towards, torch.from_numpy(share).float(), encoded(light))

    def _crowns(self, camera: Cameras, below: Below) -> Gaussians | None:
        """The crowns near a camera in metres."""
        puddles, splash = self.puddles, self.puddles.effect.surface.splash
        if puddles.impacts is None or splash is None:
            return None
        young = crowned(puddles.impacts, self.seconds, camera)
        _, struck = puddles.nearest.query(young.places)
        ground = linear(below(torch.from_numpy(struck).to(puddles.points.device)).cpu())
        sky = linear(torch.tensor((puddles.effect.ambience or Ambience()).sky))
        return crowns_of(young, self.seconds, ground, sky, splash.diameter, puddles.effect.appearance.legibility)


Below = Callable[[Int[Tensor, " k"]], Float[Tensor, "k 3"]]
"""sRGB of frozen Gaussians under the weather without what they mirror, by their numbers."""


def shown(depth: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """Share of the ground that shows as standing water, from its depth in metres: 0 where dry, 1 from `FULL` on."""
    part = np.clip(depth / FULL, 0, 1)
    return part * part * (3 - 2 * part)


def reflected(towards: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Unit directions from which mirrors send light towards a camera; never from below the horizon.

    Args:
        towards: unit vectors to the camera.
        normals: unit normals of the mirrors.
    """
    away = 2 * (normals * towards).sum(1, keepdim=True) * normals - towards
    away[:, 2] = away[:, 2].clamp_min(LOWEST)
    return torch.nn.functional.normalize(away, dim=1)
