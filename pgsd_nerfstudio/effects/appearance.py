"""The look of particles before training: curated numbers of the Effect, varied from particle to particle.

An active particle takes its size from the diameter that the physics drew for it: near flakes cover several pixels, far ones are
faint dots. A collided flake spreads into a small thin patch, which vanishes in the scene's layer of cover where there is one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.special import spence
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect, StateLook
from pgsd_nerfstudio.effects.matter import Array

VIVID = 0.85  # saturation (HSV) of particles of all hues
BURIAL = 0.3  # s in which a layer hides a collided particle
WIDEST = 0.02  # m; standard deviation of a collided particle along the surface, at most


@runtime_checkable
class Particles(Protocol):
    """The properties of simulated particles that a look depends on; `physics.ParticleHistory` has them."""

    @property
    def ends(self) -> Int[Tensor, " p"]: ...
    @property
    def diameters(self) -> Float[Tensor, " p"]: ...
    @property
    def represents(self) -> Float[Tensor, " p"]: ...
    @property
    def rest_extents(self) -> Float[Tensor, " p"]: ...
    @property
    def fps(self) -> float: ...

    def __len__(self) -> int: ...


@dataclass(frozen=True)
class ParticleLook:
    """Appearance of P particles in one state."""

    opacity: Float[Tensor, " p"]
    scales: Float[Tensor, "p 3"]
    """Standard deviations in metres; the third axis is the thin one, and along the surface normal of a collided particle."""
    rgb: Float[Tensor, "p 3"]
    """sRGB, 0..1."""

    def select(self, which: Tensor) -> ParticleLook:
        """The look of the chosen particles, by mask or by index."""
        return ParticleLook(self.opacity[which], self.scales[which], self.rgb[which])

    def fainter(self, factor: Float[Tensor, " p"]) -> ParticleLook:
        """The same look with the opacities multiplied by a factor in 0..1."""
        return ParticleLook(self.opacity * factor, self.scales, self.rgb)

    def to(self, device: torch.device | str) -> ParticleLook:
        return ParticleLook(self.opacity.to(device), self.scales.to(device), self.rgb.to(device))


@dataclass(frozen=True)
class InitialLook:
    """Appearance of every particle, active and collided."""

    active: ParticleLook
    collided: ParticleLook
    settle_seconds: float
    """Time after contact in which a particle changes from the first look to the second."""
    buried: Float[Tensor, " p"] | None = None
    """Second from which a layer of cover hides each collided particle, inf if none does; None: there is no layer."""

    def select(self, ids: Int[Tensor, " n"]) -> InitialLook:
        """The look of the chosen particles."""
        buried = None if self.buried is None else self.buried[ids]
        return InitialLook(self.active.select(ids), self.collided.select(ids), self.settle_seconds, buried)

    def to(self, device: torch.device | str) -> InitialLook:
        buried = None if self.buried is None else self.buried.to(device)
        return InitialLook(self.active.to(device), self.collided.to(device), self.settle_seconds, buried)

    def collided_at(self, particles: Particles, frame: int, ids: Int[Tensor, " n"]) -> ParticleLook:
        """The look of collided particles, each of which spreads from its flake to its patch within `settle_seconds`, and
        vanishes when a layer hides it, or soon after contact if that lies there already.

        Args:
            particles: all particles, of which `ends` and `fps` are read.
            frame: index of the frame.
            ids: indices of the collided particles that are asked for.
        """
        flake, patch = self.active.select(ids), self.collided.select(ids)
        age = (frame - particles.ends[ids] + 1).clamp_min(0) / particles.fps
        if self.buried is not None:
            since = torch.minimum(frame / particles.fps - self.buried[ids], age.to(self.buried))
            left = (1 - since / BURIAL).clamp(0, 1).to(patch.opacity)
            flake, patch = flake.fainter(left), patch.fainter(left)
        if self.settle_seconds <= 0:
            return patch
        grown = (age / self.settle_seconds).clamp(0, 1).to(patch.opacity)
        grown = (grown * (2 - grown))[:, None]  # fast at first, as the radius of a patch whose area grows at a constant rate
        # The thin axis is thin from the start, since a flake lies flat on contact.
        start = torch.minimum(flake.scales, patch.scales)
        return ParticleLook(
            torch.lerp(flake.opacity, patch.opacity, grown[:, 0]),
            torch.lerp(start, patch.scales, grown),
            torch.lerp(flake.rgb, patch.rgb, grown),
        )


def initial_look(effect: Effect, particles: Particles, *, seed: int = 0) -> InitialLook:
    """The look of every particle before training; the same seed gives the same look.

    Args:
        effect: its appearance, material and surface response are read.
        particles: the simulated particles.
        seed: of the variation between particles.

    Returns:
        The look on the device of the particles.
    """
    generator = torch.Generator().manual_seed(seed)
    looks, diameters = effect.appearance, particles.diameters.cpu().float()
    wider = math.sqrt(looks.area_factor)
    active = _look(looks.active, wider * _flake_scales(looks.active, diameters), generator)
    if looks.active.opacity is None:
        shadow = particles.represents.cpu() * 0.5 * math.pi * diameters**2  # extinction cross-section, twice the geometric one
        # Parcels of all sizes are equally dense: each holds droplets in proportion to the area that it covers.
        area = active.scales.prod(1) ** (2 / 3)
        shadow = shadow.mean() * area / area.mean() if len(area) else shadow
        active = ParticleLook(opacity_of_extinction(shadow, active.scales), active.scales, active.rgb)
    collided = _look(looks.collided, _patch_scales(effect, diameters, particles.represents.cpu()), generator)
    # A patch is not wider than the surface around it, so that it does not hang over the edge of a table, and never so wide that
    # it would look like a ball of wool: the answer of the scene draws the cover.
    widest = (particles.rest_extents.cpu() / REACH).clamp(0.004, WIDEST)
    scales = torch.cat([torch.minimum(collided.scales[:, :2], widest[:, None]), collided.scales[:, 2:]], 1)
    scales[:, 2] = torch.minimum(scales[:, 2], 0.5 * scales[:, :2].amin(1))
    collided = ParticleLook(collided.opacity, scales, collided.rgb)
    return InitialLook(active, collided, looks.collided.settle_seconds).to(particles.diameters.device)


def opacity_of_extinction(cross_section: Float[Tensor, " p"], scales: Float[Tensor, "p 3"]) -> Float[Tensor, " p"]:
    """Opacity with which a Gaussian takes as much light out of a view as a black area that is spread over it.

    Many such Gaussians then obey Beer-Lambert. The optical depth -ln(1 - a g) of a splat a g, g = exp(-r^2 / 2), integrates to
    2 pi s^2 Li2(a) (particles are drawn whole, see `Gaussians`); s is the geometric mean of the axes.

    Args:
        cross_section: black area in m^2.
        scales: standard deviations in metres.
    """
    wanted = cross_section.double() / (2 * math.pi * scales.double().prod(1) ** (2 / 3))
    opacity = np.linspace(0.0, 0.99, 4096)
    depth = spence(1 - opacity)  # Li2(z) = spence(1 - z)
    return torch.from_numpy(np.interp(wanted.numpy(), depth, opacity)).float()


REACH = 1.7  # standard deviations at which a patch of opacity 0.6 has faded to 0.14 and seems to end


def _flake_scales(state: StateLook, diameters: Float[Tensor, " p"]) -> Float[Tensor, "p 3"]:
    if state.scale_m is not None:
        return torch.tensor(state.scale_m).expand(len(diameters), 3)
    return diameters[:, None] * torch.tensor(state.scale_per_diameter)


def _patch_scales(effect: Effect, diameters: Float[Tensor, " p"], represents: Float[Tensor, " p"]) -> Float[Tensor, "p 3"]:
    """A patch has the volume of the cover that it stands for: (2 pi)^(3/2) times the product of its standard deviations."""
    if effect.appearance.collided.scale_m is not None:
        return torch.tensor(effect.appearance.collided.scale_m).expand(len(diameters), 3)
    thickness = effect.surface.layer_thickness
    flat = (layer_volume(effect, diameters, represents) / (2 * math.pi * thickness)).sqrt()
    thin = thickness / math.sqrt(2 * math.pi)
    return torch.stack([flat, flat, torch.full_like(flat, thin)], 1)


def layer_volume(effect: Effect, diameters: Array, represents: Array) -> Array:  # [p]
    """Volume in m^3 of the cover that collided particles stand for.

    Args:
        effect: its material and surface response are read.
        diameters: [p] in metres, arrays or tensors.
        represents: [p] number of real particles that each simulated one stands for.
    """
    layer = effect.surface
    volumes: Any = represents * effect.material.mass(diameters) * (layer.accumulation_speedup / layer.layer_density)
    return volumes


def _look(state: StateLook, base: Float[Tensor, "p 3"], generator: torch.Generator) -> ParticleLook:
    normal = torch.randn(base.shape[0], 5, generator=generator)
    # One draw varies the whole size, a weaker one the ratio of the flat axes, since flakes are not discs.
    shape = 0.5 * state.scale_spread * normal[:, 1]
    log = state.scale_spread * normal[:, :1] + torch.stack([shape, -shape, torch.zeros_like(shape)], 1)
    opacity = ((state.opacity or 0.0) * (1 + state.opacity_spread * normal[:, 2])).clamp(0.05, 0.98)
    tone = (1 - state.tone_spread * normal[:, 3].abs()).clamp(0.80, 1.0)
    tint = 1 + 0.012 * normal[:, 4:5] * torch.tensor([-1.0, 0.0, 1.0])  # slightly bluish or warm
    rgb = (torch.tensor(state.rgb) * tone[:, None] * tint).clamp(0.0, 1.0)
    if state.colourful:
        rgb = rgb * all_hues(len(rgb))
    return ParticleLook(opacity, base * torch.exp(log), rgb)


def all_hues(count: int) -> Float[Tensor, "p 3"]:
    """Vivid sRGB colours, one for each of `count` particles: their hues follow each other by the golden ratio."""
    turns = torch.arange(count, dtype=torch.float64)[:, None] * ((5**0.5 - 1) / 2) + torch.tensor([0.0, 2 / 3, 1 / 3])
    full = (6.0 * (torch.remainder(turns, 1.0) - 0.5).abs() - 1.0).clamp(0.0, 1.0)
    return (1.0 - VIVID + VIVID * full).float()
