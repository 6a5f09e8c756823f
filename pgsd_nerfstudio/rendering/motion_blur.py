"""Gaussians that move while the shutter is open, as Gaussians again: the streak of each and how much fainter it is.

A uniform distribution of length l has the variance l^2 / 12 (Johnson, Kotz and Balakrishnan, "Continuous Univariate
Distributions" 2, 1995, section 26.2). What moves by d at constant speed is, averaged over the exposure, the Gaussian convolved
with such a distribution along d, so its second moment is exactly

    Sigma' = Sigma + d d^T / 12.

The sum of a Gaussian's alpha over the pixels is proportional to its opacity times sqrt(det S), S its covariance on the image
plane; that the exposure does not change it gives opacity' = opacity sqrt(det S / det S'). What is approximate is the profile
along the streak, a bell instead of a plateau with soft ends, and that the average is taken before what lies in front is.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.rendering.ewa import covariances
from pgsd_nerfstudio.scene.gaussians import Gaussians


def stretched_covariances(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    """Second moments in space averaged over the exposure; those of the still Gaussians where nothing moves."""
    still, moved = covariances(gaussians), gaussians.displacements
    return still if moved is None else still + moved[:, :, None] * moved[:, None, :] / 12.0


def dimming(
    covariances: Float[Tensor, "n 2 2"],  # pixels squared, without motion, blur included
    displacements: Float[Tensor, "n 2"],  # pixels
) -> Float[Tensor, " n"]:
    """sqrt(det S / det S'), what the opacities are multiplied with."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    u, v = displacements.unbind(-1)
    # Without area, which takes a blur of zero, there is nothing to spread: bounded, it ends invisible and not as 0 / 0.
    area = (a * c - b * b).clamp_min(1e-12)
    # det S' = det S + d^T adj(S) d / 12 (matrix determinant lemma): of a thin streak the entries of S' would cancel to noise.
    gain = (c * u * u - 2.0 * b * u * v + a * v * v) / (12.0 * area)
    return torch.rsqrt(1.0 + gain.clamp_min(0.0))
