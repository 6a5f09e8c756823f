"""The layer of snow or sand that lies on the scene: Gaussians of its own, with a thickness and a light of its own.

Its pieces lie on the scene's surface (`layer_making`). They appear in the order of their rank, so that the layer begins as
crisp patches, and are lifted by the cover's depth as it grows. Where the surface ends they are tilted outwards, which rounds
the rim.

Its light is that of matt matter under an even sky (`light.received`). Fresh snow of
fine grains reflects more than 95 % of the visible light (Wiscombe & Warren, "A model for the spectral albedo of snow. I: Pure
snow", 1980, fig. 8), with the soot that falls outside the polar regions 80-90 % (Warren & Wiscombe, "II: Snow containing
atmospheric aerosols", 1980). The colour of the cover in the open is Appearance.collided.rgb.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.coating import falling_mass
from pgsd_nerfstudio.response.light import received
from pgsd_nerfstudio.response.patchiness import covered_share, hidden_share
from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians

OPAQUE = 0.985  # opacity of a piece in full; three of them overlap everywhere
WIDTH = 0.62  # standard deviation of a piece along the surface, relative to the distance between pieces
BUD = 0.55  # width of a piece that appears, relative to its full width
HEIGHT = 0.38  # standard deviation of a piece across the surface, relative to its thickness
THINNEST = 0.0015  # m; standard deviation of a piece across the surface, at least
FAINTEST = 1 / 255  # share of a piece below which no rasterizer draws it
RIM = 0.6  # tangent of the tilt at a straight edge of the surface


@dataclass(frozen=True, eq=False)
class Layer:
    """L pieces of cover on the surface of a scene, in the metric frame."""

    points: Float[Tensor, "l 3"]
    """Places on the bare surface in metres."""
    normals: Float[Tensor, "l 3"]
    """Unit normals of the layer."""
    spacing: Float[Tensor, " l"]
    """Distance to the next pieces in metres."""
    catches: Float[Tensor, " l"]
    """Mass that a piece catches relative to an open horizontal area of the same size."""
    slope: Float[Tensor, " l"]
    """Slope of the bare surface in degrees."""
    rank: Float[Tensor, " l"]
    """Order in which the pieces appear, 0..1."""
    bears: Float[Tensor, " l"]
    """Greatest thickness in metres that what lies below can bear: stems and leaves on edge hold little caps and no slab."""
    sky: Float[Tensor, " l"]
    """Share of the sky that a piece sees, weighted by the cosine to its normal."""
    tone: Float[Tensor, " l"]
    """Factor on the light of a piece, about 1: the grain of the layer."""
    host: Int[Tensor, " l"]
    """Index of the frozen Gaussian on which a piece lies."""
    frame: Frame
    """Metric frame of the scene."""

    def __len__(self) -> int:
        return len(self.points)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors by field name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "frame"}

    def to(self, device: torch.device | str) -> Layer:
        """The same layer on another device."""
        return Layer(**{name: tensor.to(device) for name, tensor in self.tensors.items()}, frame=self.frame)

    def on(self, which: Tensor, total: int) -> Layer:
        """The pieces that lie on some of the frozen Gaussians.

        Args:
            which: those Gaussians, by mask or by index.
            total: number of frozen Gaussians so far.
        """
        places = torch.full((total,), -1, device=self.host.device)
        chosen = torch.arange(total, device=self.host.device)[which]
        places[chosen] = torch.arange(len(chosen), device=self.host.device)
        host = places[self.host]
        kept = Layer(**{name: tensor[host >= 0] for name, tensor in self.tensors.items()}, frame=self.frame)
        return replace(kept, host=host[host >= 0])

    def rate(self, effect: Effect) -> Float[Tensor, " l"]:
        """Growth of the thickness in metres per second of full weather; 0 where the slope holds nothing."""
        response = effect.surface
        ramp = max(response.slips_degrees - response.holds_degrees, 1e-6)
        holds = ((response.slips_degrees - self.slope) / ramp).clamp(0, 1)
        return falling_mass(effect) * (response.accumulation_speedup / response.layer_density) * self.catches * holds

    def thickness(self, effect: Effect, seconds: float) -> Float[Tensor, " l"]:
        """Thickness in metres at a second; a film where the surface is steeper than the angle of repose, and no more than it
        bears."""
        thickest = torch.where(self.slope > effect.surface.repose_degrees, effect.surface.film, self.bears)
        return torch.minimum(self.rate(effect) * effect.timeline.fallen(seconds), thickest)

    def grown(self, effect: Effect, seconds: float) -> tuple[Int[Tensor, " k"], Float[Tensor, " k"], Float[Tensor, " k"]]:
        """Pieces that are there at a second: their indices, how far each has appeared (0..1), and the thickness in metres."""
        if not effect.surface.accumulates:
            return self.host.new_zeros(0), self.sky.new_zeros(0), self.sky.new_zeros(0)
        thickness = self.thickness(effect, seconds)
        shown = hidden_share(covered_share(thickness, effect.surface.hides), self.rank)
        there = (shown > FAINTEST).nonzero()[:, 0]
        return there, shown[there], thickness[there]

    def gaussians(self, there: Tensor, shown: Tensor, thickness: Tensor, like: Gaussians) -> Gaussians:
        """Pieces as Gaussians in scene units, without colour.

        Args:
            there: indices [k] of the pieces, as from `grown`.
            shown: [k] how far each has appeared.
            thickness: [k] in metres.
            like: the frozen scene; the result has the form of its colours.
        """
        normals = self.normals[there]
        wide = WIDTH * self.spacing[there] * (BUD + (1 - BUD) * shown)
        across = (HEIGHT * thickness).clamp_min(THINNEST)
        metric = Gaussians(
            self.points[there] + 0.5 * thickness[:, None] * normals,
            upright(normals),
            torch.stack([wide, wide, torch.minimum(across, wide)], 1),
            OPAQUE * shown,
            like.colors.new_zeros(len(there), 3),
        )
        placed = self.frame.gaussians_to_scene(metric)
        colors = like.colors.new_zeros(len(there), *like.colors.shape[1:])
        return replace(placed, colors=colors, antialiased=like.antialiased)

    def light(self, there: Int[Tensor, " k"], rgb: tuple[float, float, float]) -> Float[Tensor, "k 3"]:
        """Linear light of pieces.

        Args:
            there: indices of the pieces.
            rgb: sRGB of the cover in the open.
        """
        white = linear(torch.tensor(rgb).to(self.points))
        return white * (self.tone[there] * received(self.sky[there]))[:, None]


def upright(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Rotations (wxyz) that turn the z axis into unit normals by the shortest way."""
    x, y, z = normals.unbind(1)
    # Half way between (0, 0, 1) and the normal; a normal straight down is turned about x.
    down = z < -1 + 1e-6
    quats = torch.stack([1 + z, -y, x, torch.zeros_like(x)], 1)
    quats[down] = torch.tensor([0.0, 1.0, 0.0, 0.0]).to(normals)
    return rotations.quat_normalize(quats)
