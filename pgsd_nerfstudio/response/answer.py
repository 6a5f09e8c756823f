"""The answer of the frozen scene to a weather: the change of its look, as a function of its Gaussians and of time.

The tensors of the scene are never changed. The changes apply in this order: edited pictures if there are some, the light of the
weather, water that darkens and mirrors, the cover that hides, the haze between camera and surface.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.rendering.moment import Gaps, Viewpoint
from pgsd_nerfstudio.response.airlight import thinned
from pgsd_nerfstudio.response.backdrop import behind_gaps
from pgsd_nerfstudio.response.coating import Coating
from pgsd_nerfstudio.response.cover_light import cover_light
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.layer import Layer
from pgsd_nerfstudio.response.sky import EVEN, overcast, reach
from pgsd_nerfstudio.response.weather_light import in_weather
from pgsd_nerfstudio.response.wet_light import darkened, mirrored_sky, under_water, wet_share
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate

if TYPE_CHECKING:
    from pgsd_nerfstudio.physics.record.history import ParticleHistory
    from pgsd_nerfstudio.rendering.medium import Medium
    from pgsd_nerfstudio.response.edits import Edits
    from pgsd_nerfstudio.response.haze_field import HazeField
    from pgsd_nerfstudio.response.puddles import Puddles, PuddlesNow

OPAQUE_UNDER = 1.5  # a full cover adds the opacity of this many more Gaussians in the same place
WIDER_UNDER = 0.25  # relative increase of the scales under a full cover, which closes the gaps between blades and stones

_numbers = itertools.count()
R = TypeVar("R")


@dataclass(frozen=True, eq=False)
class Answer:
    """The change of N frozen Gaussians under a weather; all tensors are on one device."""

    effect: Effect
    exposure: Exposure
    coating: Coating
    softening: Float[Tensor, "n 3"] | None
    """Factors on linear red, green and blue in full weather, when clouds take the sun; None if no sun was found."""
    up: Float[Tensor, "3 3"]
    """Scene axes to metric axes."""
    metres_per_unit: float
    haze: HazeField | None = None
    edits: Edits | None = None
    seconds: float = 10.0
    """Second at which the edited pictures are reached in full."""
    puddles: Puddles | None = None
    """Water that stands, mirrors and ripples; None: wet surfaces mirror the even sky."""
    sky: Float[Tensor, " n"] | None = None
    """Share of each Gaussian that is sky, 0..1; None: none is."""
    layer: Layer | None = None
    """Cover that lies on the surface of the scene as Gaussians of its own; None: there is none."""
    number: int = field(default_factory=lambda: next(_numbers))
    """Number of this object in the process, by which caches tell answers apart."""

    def at(self, seconds: float) -> Shown | None:
        """The answer at a second; None if it changes no bit of the scene."""
        medium = self.haze.at(seconds) if self.haze is not None else None
        hidden, wet = self.coating.hidden(seconds), self.coating.wet(seconds)
        shown = Shown(self, seconds, medium, hidden, wet)
        return shown if shown.changes else None

    def to(self, device: torch.device | str) -> Answer:
        """The same answer on another device."""
        layer = None if self.layer is None else self.layer.to(device)
        return self._each(lambda tensor: tensor.to(device), up=self.up.to(device), layer=layer)

    def select(self, which: Tensor) -> Answer:
        """The answer of some of the Gaussians, by mask or by index."""
        layer = None if self.layer is None else self.layer.on(which, len(self.exposure.sky))
        return self._each(lambda tensor: tensor[which], layer=layer)

    def beside(self, sharpness: float | None) -> Answer:
        """The same answer with a haze that leaves out what the particles of a simulation take (HazeField.beside).

        Args:
            sharpness: of the simulation.
        """
        haze = None if self.haze is None else self.haze.beside(self.effect, sharpness)
        return replace(self, haze=haze, number=next(_numbers))

    def struck_by(self, history: ParticleHistory) -> Answer:
        """The same answer with the rings of a simulation's drops on its standing water."""
        if self.puddles is None:
            return self
        return replace(self, puddles=self.puddles.struck_by(history), number=next(_numbers))

    def thicker(self, factor: float) -> Answer:
        """The same answer with the extinction of its haze multiplied by `factor`."""
        if self.haze is None or factor == 1.0:
            return self
        return replace(self, haze=replace(self.haze, extinction=self.haze.extinction * factor), number=next(_numbers))

    def _each(self, change: Callable[[Tensor], Tensor], **others: Any) -> Answer:
        return replace(
            self,
            exposure=_mapped(self.exposure, change),
            coating=_mapped(self.coating, change),
            edits=None if self.edits is None else _mapped(self.edits, change),
            softening=None if self.softening is None else change(self.softening),
            sky=None if self.sky is None else change(self.sky),
            puddles=None if self.puddles is None else self.puddles.each(change),
            number=next(_numbers),
            **others,
        )

    def share_of_edits(self, seconds: float) -> Float[Tensor, " n"]:
        """Share of the edits that each Gaussian shows, 0..1. It grows with the Gaussian's cover, or with the weather if it has
        no cover."""
        final, now = self.coating.hidden(self.seconds), self.coating.hidden(seconds)
        timeline = self.effect.timeline
        overall = timeline.fallen(seconds) / max(timeline.fallen(self.seconds), 1e-9)
        return torch.where(final > 0.02, now / final.clamp_min(0.02), min(overall, 1.0)).clamp(0, 1)


@dataclass(frozen=True, eq=False)
class Shown:
    """The answer at one moment, in the form of rendering.moment.Moment."""

    answer: Answer
    seconds: float
    medium: Medium | None
    hidden: Float[Tensor, " n"]
    """Share of each Gaussian that the cover hides, 0..1."""
    wet: Float[Tensor, " n"]
    """Share of each Gaussian that is wet, 0..1."""

    @property
    def key(self) -> bytes:
        """Name of this moment; moments with equal keys look the same."""
        return f"answer {self.answer.number} at {self.seconds:.6f}".encode()

    @property
    def changes(self) -> bool:
        """Whether the scene looks different from the frozen scene."""
        coated = bool((self.hidden > 0).any()) or bool((self.wet > 0).any()) or self.pieces is not None
        lights = self.answer.effect.ambience is not None and self.share > 0
        return coated or lights or self.medium is not None or (self.answer.edits is not None and self.seconds > 0)

    @property
    def share(self) -> float:
        """Share of the full weather, 0..1."""
        return self.answer.effect.timeline.share(self.seconds)

    @cached_property
    def thickness(self) -> Float[Tensor, " n"]:
        """Thickness of the cover on each Gaussian in metres."""
        return self.answer.coating.thickness(self.seconds)

    @cached_property
    def pieces(self) -> tuple[Int[Tensor, " k"], Float[Tensor, " k"], Float[Tensor, " k"]] | None:
        """Pieces of the layer that are there, as `Layer.grown`; None if there are none or if edited pictures show the cover."""
        if self.answer.layer is None or self.answer.edits is not None:
            return None
        grown = self.answer.layer.grown(self.answer.effect, self.seconds)
        return grown if len(grown[0]) else None

    @cached_property
    def puddles(self) -> PuddlesNow | None:
        """The puddles of the moment; None if the effect leaves none."""
        return None if self.answer.puddles is None else self.answer.puddles.at(self.seconds)

    def adds(self, view: Viewpoint) -> Gaussians | None:
        """The rings and crowns of drops near a camera, in scene units; None if it sees none.

        Args:
            view: the camera.
        """
        puddles = self.answer.puddles
        if puddles is None or self.puddles is None or self.share == 0:
            return None
        return self.puddles.drawn(view, lambda ids: self.lit(puddles.rgb[ids], ids, None), self.share)

    def altered(self, frozen: Gaussians) -> Gaussians:
        """The frozen Gaussians with the edits; without edits they are wider and more opaque under a cover, and followed by the
        pieces of the layer."""
        if self.answer.edits is not None:
            return self.answer.edits.applied(frozen, self.answer.share_of_edits(self.seconds))
        if not bool((self.hidden > 0).any()) and self.pieces is None:
            return frozen
        opacities = 1 - (1 - frozen.opacities) ** (1 + OPAQUE_UNDER * self.hidden)
        wider = replace(frozen, opacities=opacities, scales=frozen.scales * (1 + WIDER_UNDER * self.hidden[:, None]))
        if self.answer.layer is None or self.pieces is None:
            return wider
        return concatenate([wider, self.answer.layer.gaussians(*self.pieces, like=frozen)])

    def frozen_colors(
        self, rgb: Float[Tensor, "m 3"], means: Float[Tensor, "m 3"], ids: Int[Tensor, " m"], view: Viewpoint
    ) -> Float[Tensor, "m 3"]:
        """Colours of frozen Gaussians as a view shows them.

        Args:
            rgb: sRGB from the direction of the view, without weather.
            means: centres in scene units.
            ids: indices of these Gaussians in the scene as `altered` returns it.
            view: the camera.
        """
        away = view.center - means
        metres = away.norm(dim=1) * self.answer.metres_per_unit
        along = torch.nn.functional.normalize(away, dim=1)
        towards = along @ self.answer.up.T.to(means)
        light = self._light(linear(rgb), ids, towards)
        if self.medium is None:
            return encoded(light)
        sky = self._sky(ids) > 0.5
        distant = view.center - (reach(-towards[:, 2]) / self.answer.metres_per_unit)[:, None] * along
        way = self.medium.optical_depth(torch.where(sky[:, None], distant, means), *view)
        near = thinned(way, metres, self.answer.effect)
        return encoded(self.medium.mixed(light, torch.where(sky, way, near)[:, None]))

    def _sky(self, ids: Int[Tensor, " m"]) -> Float[Tensor, " m"]:
        """Share of sky of Gaussians of the scene as `altered` returns it."""
        if self.answer.sky is None:
            return torch.zeros(len(ids), device=ids.device)
        total = len(self.answer.sky)
        return torch.where(ids < total, self.answer.sky[ids.clamp_max(total - 1)], 0.0)

    def moving_colors(self, rgb: Float[Tensor, "n 3"], means: Float[Tensor, "n 3"], view: Viewpoint) -> Float[Tensor, "n 3"]:
        """Colours of particles as a view shows them through the haze; arguments as for `frozen_colors`. They are small, so all
        the light that the air scatters is lost to them."""
        return rgb if self.medium is None else self.medium.through(rgb, means, view.viewmat, view.K, view.width, view.height)

    def background(self, own: Float[Tensor, "3"], view: Viewpoint, gaps: Gaps) -> Tensor:
        """The background behind the haze, [3] if nothing of the weather changes it, else [h, w, 3].

        Args:
            own: sRGB of the background without weather.
            view: the camera.
            gaps: of the frozen scene, through which the background is seen.
        """
        answer = self.answer
        if self.medium is None and (answer.effect.ambience is None or self.share == 0):
            return own
        return behind_gaps(own, view, gaps, self.medium, answer.effect, self.share, answer.up, answer.metres_per_unit)

    def lit(self, rgb: Float[Tensor, "m 3"], ids: Int[Tensor, " m"], towards: Float[Tensor, "m 3"] | None) -> Tensor:
        """Colours [m, 3] of frozen Gaussians with light, water and cover of the moment, without haze.

        Args:
            rgb: sRGB without weather.
            ids: indices of these Gaussians in the scene as `altered` returns it.
            towards: metric unit vectors to the camera; None: wet surfaces mirror nothing.
        """
        return encoded(self._light(linear(rgb), ids, towards))

    def _light(self, light: Float[Tensor, "m 3"], ids: Int[Tensor, " m"], towards: Float[Tensor, "m 3"] | None) -> Tensor:
        total = len(self.hidden)
        if self.answer.layer is None or self.pieces is None:
            return self._scene_light(light, ids, towards)
        own, lying = ((ids < total).nonzero()[:, 0], (ids >= total).nonzero()[:, 0])  # faster than two masks
        scene = self._scene_light(light[own], ids[own], None if towards is None else towards[own])
        layer = self.answer.layer.light(self.pieces[0], self.answer.effect.appearance.collided.rgb)
        found = torch.empty_like(light).index_copy_(0, own, scene)
        return found.index_copy_(0, lying, layer[ids[lying] - total].to(light))

    def _scene_light(self, light: Float[Tensor, "m 3"], ids: Int[Tensor, " m"], towards: Float[Tensor, "m 3"] | None) -> Tensor:
        effect, exposure, edited = self.answer.effect, self.answer.exposure, self.answer.edits is not None
        # Edited pictures already show light, water and cover; only the mirror, which depends on the camera, is added.
        if effect.ambience is not None and not edited:
            softening = self.answer.softening
            light = in_weather(light, effect.ambience, self.share, None if softening is None else softening[ids])
        if effect.surface.landing == "wets":
            # Water that stands has run there from where it fell.
            soaked = self.wet if self.puddles is None else torch.maximum(self.wet, self.puddles.share.to(self.wet))
            wet = wet_share(light, soaked[ids])
            if not edited:
                light = darkened(light, wet)
                light = light if self.puddles is None else under_water(light, self.puddles.share[ids].to(light) * wet[:, 0])
            if towards is not None and self.puddles is not None:
                mirror, kept = self.puddles.mirror(ids, towards, wet[:, 0], self.share)
                light = light * (1 - kept[:, None]) + mirror
            elif towards is not None:
                sky = (effect.ambience or Ambience()).sky
                light = light + wet * mirrored_sky(exposure.normals[ids], exposure.level[ids], exposure.sky[ids], towards, sky)
        if edited:
            return light
        if effect.ambience is not None and self.answer.sky is not None:
            height = torch.full_like(light[:, 0], EVEN) if towards is None else -towards[:, 2]
            clouded = (self.share * effect.ambience.clouds * self.answer.sky[ids, None]).to(light)
            light = torch.lerp(light, overcast(height, effect.ambience.sky), clouded)
        cover = cover_light(light, self.thickness[ids], exposure.sky[ids], effect.appearance.collided.rgb)
        return torch.lerp(light, cover, self.hidden[ids, None].to(light))


def _mapped(record: R, change: Callable[[Tensor], Tensor]) -> R:
    """A copy of a dataclass with `change` applied to its tensors."""
    found = {f.name: getattr(record, f.name) for f in fields(record)}  # type: ignore[arg-type]
    return replace(record, **{name: change(value) for name, value in found.items() if isinstance(value, Tensor)})  # type: ignore[type-var]
