"""What is seen through the gaps of the frozen scene: its background, behind the air of the place.

Foliage and thin surfaces of splats are never quite opaque, and the capture has its background behind them, mostly black. The
air before such a gap is that before the surface around it. Only where the frozen scene hides little, the sky of the weather
opens.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.rendering.medium import Medium
from pgsd_nerfstudio.rendering.moment import Gaps, Viewpoint
from pgsd_nerfstudio.response.airlight import thinned
from pgsd_nerfstudio.response.patchiness import smooth_step
from pgsd_nerfstudio.response.sky import overcast, reach

LEAST = 0.05  # share of the light in a gap below which nothing is seen through it; a white sky would add a twentieth
OPEN = (0.3, 0.9)  # share of the light between which a gap is more and more open sky


def behind_gaps(
    own: Float[Tensor, "3"],
    view: Viewpoint,
    gaps: Gaps,
    medium: Medium | None,
    effect: Effect,
    share: float,
    up: Float[Tensor, "3 3"],
    metres_per_unit: float,
) -> Float[Tensor, "h w 3"]:
    """The background of a picture, sRGB.

    Args:
        own: sRGB of the background without weather.
        view: the camera.
        gaps: of the frozen scene.
        medium: the air; None: it is clear.
        effect: the weather; its ambience gives the sky.
        share: share of the full weather, 0..1.
        up: scene axes to metric axes.
        metres_per_unit: metres per scene unit.
    """
    seen = gaps.light > LEAST
    found = own.expand(view.height, view.width, 3).clone()
    if not bool(seen.any()):
        return found
    y, x = seen.nonzero().unbind(1)
    flat = torch.stack([x + 0.5 - view.K[0, 2], y + 0.5 - view.K[1, 2]], 1).to(own) / view.K.diagonal()[:2]
    local = torch.cat([flat, torch.ones_like(flat[:, :1])], 1)
    rays = normalize(local, dim=1) @ view.viewmat[:3, :3]
    height = (rays @ up.T.to(rays))[:, 2]
    low, high = OPEN
    opened = smooth_step((gaps.light[seen] - low) / (high - low)).to(own)
    light = linear(own).expand(len(rays), 3)
    if medium is not None:
        units = gaps.depth[seen].to(own) * local.norm(dim=1)
        way = medium.optical_depth(view.center + units[:, None] * rays, *view)
        light = medium.mixed(light, thinned(way, units * metres_per_unit, effect)[:, None])
    into = (opened > 0).nonzero()[:, 0]
    sky, height = linear(own).expand(len(into), 3), height[into]
    if effect.ambience is not None:
        sky = torch.lerp(sky, overcast(height, effect.ambience.sky), share * effect.ambience.clouds)
    if medium is not None:
        far = view.center + (reach(height) / metres_per_unit)[:, None] * rays[into]
        sky = medium.mixed(sky, medium.optical_depth(far, *view)[:, None])
    light = light.index_copy(0, into, torch.lerp(light[into], sky, opened[into, None]))
    found[y, x] = encoded(light)
    return found
