"""Particles in the light of the weather, slow ones at their own size, and collided ones where they can lie.

Like the cover around them, collided particles are darker under less sky. Where the layer of cover lies they vanish in it, and
none is shown on what is too steep to hold it, in shelter from what falls, or on shreds of the surface that nothing carries.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.effects.appearance import InitialLook
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics.bodies import DRIPPED, SLID, SPLASHED
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.layer_making import CARRIES, Carriers
from pgsd_nerfstudio.response.light import received
from pgsd_nerfstudio.response.patchiness import fallen_until_hidden
from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.gaussians import Gaussians

NEIGHBOURS = 8  # frozen Gaussians whose share of the sky is averaged, since it is noisy by the number of rays
TOO_STEEP = 10.0  # degrees above the slope that holds all particles over which they are shown less and less
SHELTERED = 0.15, 0.35  # mass that a place catches, relative to the open, between which particles are shown more and more
WITHIN = 2.0  # distances between pieces of the layer within which it hides a particle
SNOW = 0.8  # linear light of flakes that count as white, relative to white
AGAINST_SKY = 0.97  # light of a white flake relative to that of an overcast sky behind it


def in_place(look: InitialLook, history: ParticleHistory, answer: Answer, metric: Gaussians) -> InitialLook:
    """The look with active particles in the light of the weather and collided ones in that of their place.

    Args:
        look: of all particles, as `initial_look` returns it.
        history: of the same particles; their rest positions are in metres.
        answer: tells which share of the sky each frozen Gaussian sees, and where the layer lies.
        metric: the Gaussians of `answer` in metres.
    """
    look = _slow_ones(_under_clouds(look, answer), history, answer)
    known = (~answer.exposure.loose).nonzero()[:, 0].cpu()
    collided = history.collided.nonzero()[:, 0].cpu()
    if answer.effect.surface.landing != "stays" or len(known) == 0 or len(collided) == 0:
        return look
    metric, at = metric.to("cpu"), history.rest_positions.cpu()[collided].clone()
    at[:, 2] -= history.rest_covers.cpu()[collided]  # the place on the bare surface
    _, nearest = KDTree(metric.means[known].numpy()).query(at.numpy(), min(NEIGHBOURS, len(known)))
    nearest = known[torch.from_numpy(nearest).reshape(len(collided), -1)]
    sky, catches = (values.cpu()[nearest].mean(1) for values in (answer.exposure.sky, answer.exposure.catches))
    low, high = SHELTERED
    carriers = Carriers.of(at, metric)
    shown = ((catches - low) / (high - low)).clamp(0, 1) * _held(history.rest_quats.cpu()[collided], answer)
    shown = shown * (carriers.share > CARRIES)
    rgb, opacity = look.collided.rgb.clone(), look.collided.opacity.clone()
    here = collided.to(rgb.device)
    opacity[here] *= shown.to(opacity)
    if answer.effect.ambience is not None:
        rgb[here] = encoded(linear(rgb[here]) * received(sky.to(rgb))[:, None])
    buried = torch.full_like(opacity, math.inf)
    buried[here] = _buried(at, answer).to(opacity)
    return replace(look, collided=replace(look.collided, rgb=rgb, opacity=opacity), buried=buried)


def _under_clouds(look: InitialLook, answer: Answer) -> InitialLook:
    """White flakes are slightly darker than the sky that lights them; a coloured one takes its share of that light."""
    ambience = answer.effect.ambience
    if ambience is None or answer.effect.emission.kind != "snowflakes":
        return look
    own = linear(look.active.rgb)
    white = own.amax(1, keepdim=True).median().clamp_min(SNOW)  # ash and leaves are darker than snow and stay so
    light = AGAINST_SKY * linear(torch.tensor(answer.effect.haze.rgb if answer.effect.haze else ambience.sky).to(own))
    return replace(look, active=replace(look.active, rgb=encoded(own / white * light).clamp_max(1.0)))


def _slow_ones(look: InitialLook, history: ParticleHistory, answer: Answer) -> InitialLook:
    """Drops that come loose from an edge, and grains and flakes that slide, are slow and not smeared, so that they are seen at
    their own size; drawn as legibly as what flies they would be balls of centimetres."""
    factor = answer.effect.appearance.area_factor
    if factor == 1:
        return look
    slow = ((history.kinds & (DRIPPED | SLID)) > 0) & ((history.kinds & SPLASHED) == 0)
    scales = torch.where(slow[:, None], look.active.scales / factor**0.5, look.active.scales)
    return replace(look, active=replace(look.active, scales=scales))


def _held(quats: Float[Tensor, "n 4"], answer: Answer) -> Float[Tensor, " n"]:
    """1 where a surface holds particles, 0 where it is too steep; by their orientation at rest."""
    up = rotations.unitquat_to_rotmat(quats.roll(-1, 1))[:, 2, 2]
    slope = torch.rad2deg(torch.arccos(up.clamp(-1, 1)))
    return ((answer.effect.surface.holds_degrees + TOO_STEEP - slope) / TOO_STEEP).clamp(0, 1)


def _buried(at: Float[Tensor, "n 3"], answer: Answer) -> Float[Tensor, " n"]:
    """Second from which the layer hides particles that lie at points in metres; inf where it never does."""
    layer, effect = answer.layer, answer.effect
    if layer is None or len(layer) == 0 or not effect.surface.accumulates or answer.edits is not None:
        return torch.full((len(at),), math.inf)
    layer = layer.to("cpu")
    apart, piece = KDTree(layer.points.numpy()).query(at.numpy())
    piece = torch.from_numpy(piece)
    needed = fallen_until_hidden(layer.rate(effect)[piece], layer.rank[piece], effect.surface.hides)
    second = _second_of(effect.timeline, needed)
    return torch.where(torch.from_numpy(apart) < WITHIN * layer.spacing[piece], second, math.inf)


def _second_of(timeline: Timeline, fallen: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Second by which so many seconds of full weather have fallen; inf where they never do."""
    ramp = torch.sqrt(2 * fallen * timeline.onset)
    second = torch.where(fallen <= timeline.onset / 2, ramp, fallen + timeline.onset / 2)
    return torch.where(second <= timeline.ends, second, math.inf)
