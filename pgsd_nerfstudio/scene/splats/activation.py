"""What every splat must hold: finite Gaussians of sizes that can be drawn, near the origin.

Readers decode files to `Gaussians` whose values are activated (linear scales, opacities in 0..1) and not yet checked. An
opacity logit of +inf or -inf is an opacity of 1 or 0, a log scale of -inf a flat Gaussian: valid, and written by converters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0

# Beyond these a value is damage, and its cube soon no float32 any more.
FARTHEST = 1e9  # scene units: a centre from the middle of the scene, and a standard deviation
LENGTHS = (1e-12, 1e12)  # of quaternions, which are normalised
STRONGEST = 1e6  # coefficient of a spherical harmonic; a colour of 1 has 1.8

ROUNDING = 0.01
"""Largest rounding of a centre to float32, in median sizes of the Gaussians, at which a scene stays where it is."""

CLEANING = "splat-transform IN --filter-nan OUT removes such Gaussians, else write the file again"


def checked(path: Path, gaussians: Gaussians) -> tuple[Gaussians, Float64[Tensor, "3"]]:
    """Gaussians in float32 with unit quaternions, and the offset that was taken from their centres.

    Args:
        path: the file, for messages.
        gaussians: as decoded; centres may be float64.

    Raises:
        SceneError: there are none, or a value is NaN, infinite or absurd.
    """
    if len(gaussians) == 0:
        raise SceneError(f"{path} is an empty scene: it holds 0 Gaussians")
    lengths = gaussians.quats.square().sum(dim=1).sqrt()
    _refuse_outside(path, "centres", gaussians.means, -torch.inf, torch.inf)
    _refuse_outside(path, "scales", gaussians.scales, 0.0, FARTHEST)
    _refuse_outside(path, "opacities", gaussians.opacities, 0.0, 1.0)
    _refuse_outside(path, "colours", gaussians.colors, -STRONGEST, STRONGEST)
    _refuse_outside(path, "quaternions' lengths", lengths, *LENGTHS)
    offset = _offset(gaussians)
    means = (gaussians.means.double() - offset).float() if offset.any() else gaussians.means.float()
    _refuse_outside(path, "distances from the middle", means, -FARTHEST, FARTHEST)
    return replace(gaussians, means=means, quats=gaussians.quats / lengths[:, None]), offset


def harmonics(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """The constant spherical harmonic that shows as `rgb` (0..1) from everywhere."""
    return ((rgb - 0.5) / SH_C0)[:, None]


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """The parts of a splat as one set, with harmonics of the highest degree among them.

    Args:
        parts: at least one, colours as spherical harmonics.

    Raises:
        ValueError: some of them are antialiased and others are not.
    """
    most = max(part.colors.shape[1] for part in parts)
    padded = [torch.nn.functional.pad(part.colors, (0, 0, 0, most - part.colors.shape[1])) for part in parts]
    return concatenate([replace(part, colors=colors) for part, colors in zip(parts, padded, strict=True)])


def smoothed(
    scales: Float[Tensor, "n 3"], opacities: Float[Tensor, " n"], deviations: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Scales and opacities with the 3D smoothing filter of Yu et al. ("Mip-Splatting", 2024, eq. 9) made part of them.

    A Gaussian convolved with one of standard deviation f has s' = sqrt(s^2 + f^2); its peak falls as its volume grows.

    Args:
        scales: before the filter.
        opacities: before the filter.
        deviations: of the filter at each Gaussian, in scene units.
    """
    wide = torch.hypot(scales, deviations[:, None])
    kept = torch.where(wide > 0, scales / wide, 1.0)  # 0 / 0: a flat Gaussian without a filter stays as it is
    return wide, opacities * kept.prod(dim=1)


def _offset(gaussians: Gaussians) -> Float64[Tensor, "3"]:
    """The middle of the scene in whole units if it lies so far away that float32 rounds there what can be seen, else zero."""
    some = slice(None, None, max(1, len(gaussians) // 10_000))
    middle = gaussians.means[some].double().median(dim=0).values
    size = float(gaussians.scales[some].amax(dim=1).median())
    if float(middle.abs().max()) * torch.finfo(torch.float32).eps / 2 <= ROUNDING * size:
        return torch.zeros(3, dtype=torch.float64)
    return middle.round()


def _refuse_outside(path: Path, name: str, values: Tensor, least: float, most: float) -> None:
    smallest, largest = values.aminmax()  # NaN where there is one
    if smallest >= least and largest <= most and torch.isfinite(smallest) and torch.isfinite(largest):
        return
    if bad := int((~torch.isfinite(values)).sum()):
        raise SceneError(f"{path}: {bad} values of its {name} are NaN or infinite; {CLEANING}")
    bad = int(((values < least) | (values > most)).sum())
    raise SceneError(
        f"{path}: {bad} values of its {name} lie outside {least:g} to {most:g} "
        f"(found {smallest:.3g} to {largest:.3g}); {CLEANING}"
    )
