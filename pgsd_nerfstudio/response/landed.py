"""Collided particles in the light of their place: like the cover around them, they are darker and bluer under less sky."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.effects.appearance import InitialLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.light import under_sky

NEIGHBOURS = 8  # frozen Gaussians whose share of the sky is averaged, since it is noisy by the number of rays


def in_place(look: InitialLook, history: ParticleHistory, answer: Answer, metric: Float[Tensor, "n 3"]) -> InitialLook:
    """The look with the colours of collided particles in the light of their place.

    Args:
        look: of all particles, as `initial_look` returns it.
        history: of the same particles; their rest positions are in metres.
        answer: tells which share of the sky each frozen Gaussian sees.
        metric: centres in metres of the Gaussians of `answer`.
    """
    known = (~answer.exposure.loose).nonzero()[:, 0].cpu()
    collided = history.collided.nonzero()[:, 0].cpu()
    if answer.effect.ambience is None or len(known) == 0 or len(collided) == 0:
        return look
    at = history.rest_positions.cpu()[collided].numpy()
    _, nearest = KDTree(metric.cpu()[known].numpy()).query(at, min(NEIGHBOURS, len(known)))
    sky = answer.exposure.sky.cpu()[known][torch.from_numpy(nearest).reshape(len(collided), -1)].mean(1)
    rgb = look.collided.rgb.clone()
    here = collided.to(rgb.device)
    rgb[here] = encoded(linear(rgb[here]) * under_sky(sky.to(rgb)))
    return replace(look, collided=replace(look.collided, rgb=rgb))
