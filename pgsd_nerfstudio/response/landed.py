"""Landed particles in the light of where they lie: as the layer around them, darker and bluer where less of the sky is seen."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.effects.appearance import InitialLook
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.light import encoded, linear, under_sky

NEIGHBOURS = 8  # frozen Gaussians whose view of the sky is averaged; single ones vary by their rays


def in_place(look: InitialLook, history: ParticleHistory, answer: Answer, metric: Float[Tensor, "n 3"]) -> InitialLook:
    """The look with the landed particles' colours in the light of their place.

    Args:
        metric: places in metres of the frozen Gaussians that `answer` is of.
    """
    known = (~answer.exposure.loose).nonzero()[:, 0].cpu()
    landed = history.collided.nonzero()[:, 0].cpu()
    if answer.effect.ambience is None or len(known) == 0 or len(landed) == 0:
        return look
    at = history.rest_positions.cpu()[landed].numpy()
    _, nearest = KDTree(metric.cpu()[known].numpy()).query(at, min(NEIGHBOURS, len(known)))
    sky = answer.exposure.sky.cpu()[known][torch.from_numpy(nearest).reshape(len(landed), -1)].mean(1)
    rgb = look.collided.rgb.clone()
    here = landed.to(rgb.device)
    rgb[here] = encoded(linear(rgb[here]) * under_sky(sky.to(rgb)))
    return replace(look, collided=replace(look.collided, rgb=rgb))
