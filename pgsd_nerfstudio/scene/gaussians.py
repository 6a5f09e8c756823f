"""A set of 3D Gaussians, the record that all rooms share.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023). The values are activated (linear scales,
opacities in 0..1); checkpoints store logarithms and logits instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians; all tensors share device and dtype."""

    means: Float[Tensor, "n 3"]
    """Centres in scene units, or in metres where the owner says so."""
    quats: Float[Tensor, "n 4"]
    """Rotations as wxyz quaternions of any length; who reads them normalises them."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the three axes, in the units of the means."""
    opacities: Float[Tensor, " n"]
    """Peak opacities, 0..1."""
    colors: Tensor
    """[N, 3] plain RGB in 0..1, or [N, K, 3] spherical harmonics with K = (degree + 1)^2, as in splatfacto."""
    displacements: Float[Tensor, "n 3"] | None = None
    """Displacement of each Gaussian while the shutter is open, centred on its mean, in the same units; rendered as motion blur.
    None: nothing moves."""
    antialiased: bool = field(default=False, kw_only=True)
    """Whether opacities are those before the blur of a pixel: the blur then takes from a Gaussian's peak what it adds to its
    area (Yu et al., "Mip-Splatting", 2024; gsplat's rasterize_mode "antialiased"). False: the blur leaves them as they are."""
    whole: bool = field(default=False, kw_only=True)
    """Whether a peak rises by the smallest alpha that a rasterizer draws, so that no light is lost to this threshold, however
    faint a Gaussian is. False: as trained scenes are drawn, which have learned to do without that light."""

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"Gaussians.{name} must have shape {shape}, found {found}")
        if self.displacements is not None and tuple(self.displacements.shape) != (n, 3):
            raise ValueError(f"Gaussians.displacements must have shape {(n, 3)}, found {tuple(self.displacements.shape)}")
        if self.colors.shape[0] != n or self.colors.shape[-1] != 3 or self.colors.ndim not in (2, 3):
            raise ValueError(f"Gaussians.colors must be [{n}, 3] or [{n}, K, 3], found {tuple(self.colors.shape)}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int | None:
        """Degree of the spherical harmonics, None where the colours are plain RGB."""
        return None if self.colors.ndim == 2 else round(self.colors.shape[1] ** 0.5) - 1

    @property
    def tensors(self) -> dict[str, Any]:
        """All tensors that are not None, by field name."""
        return {f.name: tensor for f in fields(self) if isinstance(tensor := getattr(self, f.name), Tensor)}

    @property
    def device(self) -> torch.device:
        return self.means.device

    def to(self, *args, **kwargs) -> Gaussians:
        """The same Gaussians on another device or in another dtype; arguments as for `Tensor.to`."""
        return replace(self, **{name: tensor.to(*args, **kwargs) for name, tensor in self.tensors.items()})

    def detach(self) -> Gaussians:
        return replace(self, **{name: tensor.detach() for name, tensor in self.tensors.items()})

    def select(self, which: Bool[Tensor, " n"] | Int[Tensor, " m"]) -> Gaussians:
        """The chosen Gaussians, by mask or by index."""
        return replace(self, **{name: tensor[which] for name, tensor in self.tensors.items()})

    def check_finite(self) -> None:
        """Refuse values that are not finite.

        Raises:
            ValueError: a field holds a NaN or infinity; the message names the first such field.
        """
        for name, tensor in self.tensors.items():
            # The sum reads the tensor once and is not finite if a value is not. It may overflow too, so the values are counted.
            if not torch.isfinite(tensor.sum()) and (bad := int((~torch.isfinite(tensor)).sum())):
                raise ValueError(f"{bad} values of the Gaussians' {name} are NaN or infinite")

    @staticmethod
    def empty(device: torch.device | str = "cpu") -> Gaussians:
        """No Gaussians, plain RGB."""
        return Gaussians(*(torch.zeros(0, *shape, device=device) for shape in ((3,), (4,), (3,), (), (3,))))


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """Join several sets of the same kind of colour (all RGB, or all of one SH degree) in their order.

    Raises:
        ValueError: some of them are antialiased or whole and others are not.
    """
    drawn = {(part.antialiased, part.whole) for part in parts}
    if len(drawn) > 1:
        raise ValueError("Gaussians that are antialiased (or whole) and such that are not cannot be joined to one set")
    antialiased, whole = drawn.pop() if drawn else (False, False)
    flags = "antialiased", "whole"
    joined = {f.name: [getattr(part, f.name) for part in parts] for f in fields(Gaussians) if f.name not in flags}
    still = [moved is None for moved in joined["displacements"]]
    joined["displacements"] = [torch.zeros_like(p.means) if p.displacements is None else p.displacements for p in parts]
    tensors: dict[str, Any] = {n: torch.cat(t) for n, t in joined.items() if n != "displacements" or not all(still)}
    return Gaussians(**tensors, antialiased=antialiased, whole=whole)
