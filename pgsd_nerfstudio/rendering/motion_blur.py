"""How opacities follow the size of a footprint: motion blur, the blur of a pixel, and the smallest alpha that is drawn.

A Gaussian that moves while the shutter is open becomes a longer, fainter Gaussian.

A uniform distribution of length l has the variance l^2 / 12 (Johnson, Kotz and Balakrishnan, "Continuous Univariate
Distributions" 2, 1995, section 26.2). A Gaussian that moves by d at constant speed is, averaged over the exposure, convolved
with such a distribution along d, so its covariance is exactly

    Sigma' = Sigma + d d^T / 12.

The sum of a Gaussian's alpha over the pixels is proportional to its opacity times sqrt(det S), S its covariance on the image
plane. The exposure does not change this sum, hence opacity' = opacity sqrt(det S / det S'). Two things are approximate: the
profile along the streak is a bell instead of a plateau with soft ends, and each Gaussian is averaged by itself, before those in
front of it cover it.

What is antialiased keeps its sum of alpha under the blur of a pixel in the same way: its opacity takes the factor
sqrt(det S0 / det S), S0 its covariance on the image plane without the blur (Yu et al., "Mip-Splatting", 2024, section 4.2).

A rasterizer draws no alpha below a threshold a. Of a Gaussian of peak o and profile g it then draws the ellipse o g >= a, where
the integral of alpha is 2 pi sqrt(det S) (o - a). What is whole therefore has the peak o + a: its integral is that of all of it
again, and so is its sum over pixels on average over the places of its centre within a pixel. The fainter it is the smaller is
the ellipse, and the seldomer it meets the centre of a pixel, where its alpha then is a.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.ewa import covariances
from pgsd_nerfstudio.scene.gaussians import Gaussians


def stretched_covariances(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """Covariances in space averaged over the exposure, in scene units squared; without displacements those of `covariances`."""
    still, moved = covariances(gaussians), gaussians.displacements
    return still if moved is None else still + moved[:, :, None] * moved[:, None, :] / 12.0


def footprint_opacities(
    gaussians: Gaussians,
    to_image: Float[Tensor, "n 2 3"],  # as of `perspective_jacobians`, from the axes of the means
    blur: float,  # pixels squared
    threshold: float,  # smallest alpha that is drawn of what is whole
) -> Float[Tensor, " n"]:
    """Opacities on the image plane: averaged over the exposure of what moves, under the blur of what is antialiased, and with
    the threshold on top for what is whole."""
    opacities = gaussians.opacities
    if gaussians.displacements is not None or gaussians.antialiased:
        opacities = _of_footprint(gaussians, to_image, blur)
    return torch.where(opacities > 0, opacities + threshold, opacities) if gaussians.whole else opacities


def _of_footprint(gaussians: Gaussians, to_image: Float[Tensor, "n 2 3"], blur: float) -> Float[Tensor, " n"]:
    """Opacities averaged over the exposure of what moves, and under the blur of what is antialiased."""
    opacities = gaussians.opacities
    sharp = to_image @ covariances(gaussians) @ to_image.mT
    blurred = sharp + blur * torch.eye(2).to(sharp)
    if gaussians.antialiased:
        area, blurred_area = determinants(sharp), determinants(blurred)
        # What has no area, such as a disc seen edge-on, takes no light; the root has no gradient there.
        seen = area > 0
        opacities = opacities * torch.where(seen, (torch.where(seen, area, 1.0) / blurred_area).sqrt(), 0.0)
    if gaussians.displacements is not None:
        opacities = opacities * dimming(blurred, (to_image @ gaussians.displacements[:, :, None])[:, :, 0])
    return opacities


def determinants(matrices: Float[Tensor, "n 2 2"]) -> Float[Tensor, " n"]:
    """Determinants of symmetric matrices."""
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2


def dimming(
    covariances: Float[Tensor, "n 2 2"],  # pixels squared, without motion, blur included
    displacements: Float[Tensor, "n 2"],  # pixels
) -> Float[Tensor, " n"]:
    """The factor sqrt(det S / det S') of the opacities."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    u, v = displacements.unbind(-1)
    # A Gaussian without area, which is possible with a blur of zero, becomes invisible through this bound instead of 0 / 0.
    area = (a * c - b * b).clamp_min(1e-12)
    # det S' = det S + d^T adj(S) d / 12 (matrix determinant lemma); computed from S' of a thin streak it would cancel to noise.
    gain = (c * u * u - 2.0 * b * u * v + a * v * v) / (12.0 * area)
    return torch.rsqrt(1.0 + gain.clamp_min(0.0))
