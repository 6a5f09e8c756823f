"""What the weather is: the options that `pgsd preview`, `pgsd simulate` and `ns-train pgsd-weather` share, and their Effect.

The text under each field is its --help; lines end there where a sentence may, since tyro keeps the breaks. Factors are applied
as those of a request are (application.py); numbers with a unit take the place of what effect or words say. Turbulence follows
the mean wind: over given ground both are proportional to the friction velocity (Panofsky & Dutton, "Atmospheric Turbulence",
1984).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pgsd_nerfstudio.effects.effect import full_name
from pgsd_nerfstudio.effects.matter import CONTRASTS, Visibility

if TYPE_CHECKING:
    from pgsd_nerfstudio.effects.effect import Effect, Wind
    from pgsd_nerfstudio.effects.haze import Haze
    from pgsd_nerfstudio.effects.language_model import Understanding
    from pgsd_nerfstudio.effects.request import Rgb
    from pgsd_nerfstudio.effects.surface_response import SurfaceResponse
    from pgsd_nerfstudio.effects.timeline import Timeline

RANGES: dict[str, tuple[float, float, str]] = {
    "wind": (0.0, 40.0, " m/s"),  # hurricanes begin at 33
    "wind_direction": (-360.0, 360.0, " degrees"),
    "haze": (0.0, 20.0, ""),
    "accumulation_speedup": (0.001, 100_000.0, ""),
}
"""Least and greatest value, and its unit; amount and size have a request's, the rest is judged by the parts of an Effect."""
WATER = ("puddles", "ripples", "mirror", "drips")  # what rain leaves, each of which can be switched off


@dataclass(frozen=True, kw_only=True)
class EffectOptions:
    """What the weather is; `resolve` gives the Effect."""

    effect: str = "snowfall"
    """Which weather: snowfall, rainfall, fog or sandstorm; snow, rain and sand are understood too."""
    weather: str | None = None
    """The weather in words, in place of --effect: "purple snow", "glittering yellow sand, no wind", "magic particles".
    A built-in reader understands many words and says which; with --llm a language model is asked, and may be told anything."""
    llm: str | None = None
    """Language model that turns the words into numbers, as PROVIDER:NAME (openai:gpt-4o-mini, anthropic:NAME).
    Needs pip install 'pgsd-nerfstudio[llm]', and its key in the environment (OPENAI_API_KEY, ANTHROPIC_API_KEY, ...).
    It is asked once and its answer is kept. If it cannot be asked, the built-in reader answers instead and says so."""
    llm_url: str | None = None
    """Address of a server that speaks the protocol of OpenAI or Anthropic, such as http://127.0.0.1:8000/v1 (then vllm:NAME).
    By default the provider's own, or what OPENAI_BASE_URL, ANTHROPIC_BASE_URL, ... say."""
    intensity: float | None = None
    """How much: snow and rain in mm/h of water (heavy snow 3, heavy rain 20).
    Fog and sand as visibility in metres (dense fog 50); by default that follows how far away the scene's background is."""
    visibility: Visibility = "optical-range"
    """What visibility means: optical-range is that of weather services and roads, at which 5 % of the contrast are left
    (extinction ln 20 / visibility); koschmieder has 2 % left (ln 50 / visibility): for the same number thicker air."""
    amount: float = 1.0
    """Factor on how much, 0.1-5: 2 doubles snow and rain, and halves the visibility of fog and sand."""
    size: float = 1.0
    """Factor on the width of flakes, drops, grains and wisps, 0.2-5. How many there are and how fast they fall stays."""
    wind: float | None = None
    """Mean wind in m/s at 2 m above the ground, 0-40; gusts and turbulence follow it. By default what effect or words say."""
    wind_direction: float | None = None
    """Where the wind blows to, in degrees counted from the x axis of the scene towards y.
    By default the effect's own, which for sand is across the view."""
    color: str | None = None
    """Colour of what flies and of what has landed, and a third of the haze's: #8040c0, purple, "dusty rose".
    It tints matter: purple snow is nearly as bright as snow, yellow sand is ochre. Petals and confetti have it exactly.
    By default what effect or words say."""
    haze: float = 1.0
    """Factor on the opacity of the air between the particles, 0-20; 0 is clear air."""
    haze_color: str | None = None
    """Colour of that air, which what is far away takes on: #c0c8d0, lavender. By default what effect or words say."""
    onset: float | None = None
    """Seconds within which the weather comes, from a clear start; 0: all of it is there in the first frame.
    By default the effect's own."""
    ends: float | None = None
    """Second after which nothing new comes. By default the effect's own; the built-in ones do not end."""
    accumulation: tyro.conf.FlagConversionOff[bool] = True
    """Whether what lands stays, gathers and wets. False: it vanishes, surfaces stay bare and dry."""
    accumulation_speedup: float | None = None
    """Time lapse of cover and puddles: what lands counts as so many times as much. By default the effect's own (snow and rain
    800, sand 60)."""
    puddles: tyro.conf.FlagConversionOff[bool] = True
    """Whether rain stands where the ground is level or hollow."""
    ripples: tyro.conf.FlagConversionOff[bool] = True
    """Whether drops make rings on standing water."""
    mirror: tyro.conf.FlagConversionOff[bool] = True
    """Whether wet and standing surfaces mirror the scene; False: an even sky alone."""
    drips: tyro.conf.FlagConversionOff[bool] = True
    """Whether water drips from the edges of tables and benches."""
    ambience: tyro.conf.FlagConversionOff[bool] = True
    """Whether light and sky follow the weather. False: they stay as captured."""
    exposure: float | None = None
    """Shutter time in seconds: active particles are smeared by speed times this (a film camera: 0.02).
    By default the effect's own, which for snow is 0, no motion blur."""
    legibility: float | None = None
    """Factor on the area of all that flies, 1-1000. At 1 it takes as much light as in nature: right for data sets and for
    comparisons, but rain is then next to invisible. By default the effect's own, chosen by looking, and more where a
    scene has little air before its background; said if it is not 1."""

    def __post_init__(self) -> None:
        # Stored options, and the commands that are made of them, have one name for one weather.
        object.__setattr__(self, "effect", full_name(self.effect))

    def resolve(self, cache_dir: Path | None = None) -> tuple[Effect, list[str]]:
        """The effect of these options, and what is to be said about it: how the words were read, what cannot be done.

        Args:
            cache_dir: folder of what language models answered; the common cache if none is given.

        Raises:
            ValueError: an option cannot be used, or the words name nothing that could be in the air; one sentence says why.
            OSError: the answer of a language model cannot be written.
        """
        return self.resolve_understood(self.understand(cache_dir))

    def understand(self, cache_dir: Path | None = None) -> Understanding | None:
        """What the words for the weather ask for, None without words; raises as `resolve`."""
        self.check()
        return None if self.weather is None else _asked(self.weather, self.llm, self.llm_url, cache_dir)

    def resolve_understood(self, understanding: Understanding | None) -> tuple[Effect, list[str]]:
        """The effect asked for, with all other options applied, and what is to be said about it; raises as `resolve`."""
        self.check()
        effect, said = self._base(understanding)
        # Words and options are applied one after the other: their factors multiply.
        effect, lacks = self._factors(effect, dyed=understanding is not None and understanding.request.dyed)
        said += [*lacks, *self._lacks(effect)]
        effect = replace(
            effect,
            wind=self._wind(effect),
            timeline=self._timeline(effect.timeline),
            surface=self._surface(effect.surface),
            emission=replace(effect.emission, visibility=self.visibility),
            haze=self._haze(effect.haze),
            ambience=effect.ambience if self.ambience else None,
            adaptation=effect.adaptation if self.wind_direction is None else replace(effect.adaptation, wind_across=False),
        )
        if self.legibility is not None:
            effect = effect.with_legibility(self.legibility)
        return effect, [*said, *legible(effect)]

    def check(self) -> None:
        """Refuse what can be refused without asking anyone.

        Raises:
            ValueError: two options do not go together, or a number is out of its range.
        """
        from pgsd_nerfstudio.effects.connection import check_model
        from pgsd_nerfstudio.effects.request import LIMITS

        if self.weather is not None and self.effect != EffectOptions.effect:
            raise ValueError(
                f"--weather stands in place of --effect, got both {self.weather!r} and {self.effect}: leave out one"
            )
        if self.llm is not None and self.weather is None:
            raise ValueError(f"--llm {self.llm} needs words to ask about: add --weather, such as --weather 'purple snow'")
        if self.llm_url is not None and self.llm is None:
            raise ValueError(f"--llm-url {self.llm_url} needs the name of a model there: add --llm PROVIDER:NAME")
        if self.llm is not None:
            check_model(self.llm, self.llm_url)
        if self.visibility not in CONTRASTS:
            raise ValueError(f"--visibility must be {' or '.join(CONTRASTS)}, got {self.visibility!r}")
        for name, (low, high, unit) in {**RANGES, **{name: (*LIMITS[name], "") for name in ("amount", "size")}}.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"--{name.replace('_', '-')} must lie in {low:g}-{high:g}{unit}, got {value:g}")

    def _base(self, understanding: Understanding | None) -> tuple[Effect, list[str]]:
        """The effect of that name or of those words, at the intensity and exposure that are given."""
        from pgsd_nerfstudio.effects.application import applied, remarks
        from pgsd_nerfstudio.effects.effect import effect as named

        if understanding is None:
            return named(self.effect, intensity=self.intensity, exposure=self.exposure), []
        request, said = understanding.request, [understanding.remark]
        if self.intensity is not None and request.amount != 1:
            said.append(f"--intensity {self.intensity:g} takes the place of amount {request.amount:g}")
            request = replace(request, amount=1.0)
        effect = applied(request)
        said += remarks(request)
        if self.intensity is not None:
            effect = effect.with_intensity(self.intensity)
        if self.exposure is not None:
            effect = replace(effect, appearance=replace(effect.appearance, exposure=self.exposure))
        return effect, said

    def _factors(self, effect: Effect, *, dyed: bool) -> tuple[Effect, tuple[str, ...]]:
        """The options that a request has too; only what the video model is told stays. `dyed`: as in a request."""
        from pgsd_nerfstudio.effects.application import applied, remarks
        from pgsd_nerfstudio.effects.request import Request

        rgb = None if self.color is None else colour_of("color", self.color)
        accumulates = None if self.accumulation else False
        request = Request(
            base=None,
            rgb=rgb,
            dyed=dyed,
            amount=float(self.amount),
            size=float(self.size),
            accumulates=accumulates,
            prompt="{scene}",
        )
        return replace(applied(request, base=effect), prompt=effect.prompt), remarks(request, base=effect)

    def _wind(self, effect: Effect) -> Wind:
        from pgsd_nerfstudio.effects.effect import EFFECTS

        wind = effect.wind
        if self.wind is not None:
            # Of the effect without words, which may have asked for still air: nothing in proportion to that can be found.
            own = EFFECTS[effect.name].wind
            factor = self.wind / own.speed if own.speed > 0 else 1.0
            wind = replace(wind, speed=self.wind, turbulence=factor * own.turbulence, diffusivity=factor * own.diffusivity)
        if self.wind_direction is not None:
            wind = replace(wind, direction_degrees=self.wind_direction)
        return wind

    def _timeline(self, timeline: Timeline) -> Timeline:
        given = {"onset": self.onset, "ends": self.ends}
        return replace(timeline, **{name: value for name, value in given.items() if value is not None})

    def _surface(self, surface: SurfaceResponse) -> SurfaceResponse:
        if self.accumulation_speedup is not None:
            surface = replace(surface, accumulation_speedup=self.accumulation_speedup)
        water = {name: getattr(surface, name) and getattr(self, name) for name in WATER}
        surface = replace(surface, **water)
        if not self.accumulation and surface.landing == "wets":
            surface = replace(surface, landing="vanishes")  # drops still splash
        return surface

    def _haze(self, haze: Haze | None) -> Haze | None:
        rgb = None if self.haze_color is None else colour_of("haze-color", self.haze_color)
        return None if haze is None else replace(haze, amount=haze.amount * self.haze, rgb=rgb or haze.rgb)

    def _lacks(self, effect: Effect) -> Iterator[str]:
        """What the effect has no use for."""
        if effect.haze is None and (self.haze not in (0, 1) or self.haze_color is not None):
            yield f"--haze and --haze-color change nothing: the air between the particles of {effect.name} is clear"
        if self.visibility != EffectOptions.visibility and effect.emission.precipitates:
            yield f"--visibility {self.visibility} changes nothing: {effect.name} is measured in {effect.emission.unit}"
        surface = effect.surface
        stands = surface.landing == "wets" and surface.puddles and self.puddles
        gathers = surface.accumulates if surface.landing == "stays" else stands
        if self.accumulation_speedup is not None and not gathers:
            lapse = f"--accumulation-speedup {self.accumulation_speedup:g}"
            yield f"{lapse} changes nothing: {effect.name} leaves no layer and no puddles here"


def legible(effect: Effect) -> list[str]:
    """What is to be said about how much more of a view particles take than in nature; nothing while that follows the scene."""
    factor = effect.appearance.area_factor
    if factor == 1 or effect.adaptation.air is not None:
        return []
    return [
        f"what flies is drawn with {factor:g} times its area, {factor**0.5:.2g} times as wide (--legibility 1: as in nature)"
    ]


@lru_cache(maxsize=64)
def _asked(weather: str, llm: str | None, llm_url: str | None, cache_dir: Path | None) -> Understanding:
    """Asks no more than once in a process, also where nobody can be reached."""
    from pgsd_nerfstudio.effects.language_model import request_for

    return request_for(weather, model=llm, base_url=llm_url, cache_dir=cache_dir, reader_fallback=True)


def colour_of(flag: str, text: str) -> Rgb:
    """The colour, sRGB in 0-1, that is written as #rgb, #rrggbb or by its name in CSS or the XKCD survey.

    Raises:
        ValueError: it is no such colour; `flag` is where it was given.
    """
    from matplotlib.colors import CSS4_COLORS, XKCD_COLORS, to_rgb

    from pgsd_nerfstudio.effects.vocabulary import colour

    name = " ".join(text.lower().split())
    found = to_rgb(name) if re.fullmatch(r"#([0-9a-f]{3}|[0-9a-f]{6})", name) else colour(name)
    if found is None:
        # The well-known names first: "purpel" is nearer to "purply", but was hardly meant so.
        known = ([*CSS4_COLORS], [each.removeprefix("xkcd:") for each in XKCD_COLORS])
        close = [each for names in known for each in difflib.get_close_matches(name, names, cutoff=0.75) if colour(each)]
        guess = f"; was {close[0]!r} meant?" if close else ""
        raise ValueError(f"--{flag} must be a colour such as #8040c0 or purple, got {text!r}{guess}")
    return found
