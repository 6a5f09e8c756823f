"""What a Request makes of an Effect: the knobs of a built-in weather, turned as far as its laws allow.

Sizes: a particle shall look wider by the factor, and nothing else of it shall change (`fall_speed` and `amount` are for that).
Snow has power laws over the diameter, and its spectrum is one of melted flakes, so the flake itself is enlarged: s times as
wide, with the mass and the fall speed of the flake of which it is an enlarged copy. That is loose, as petals, leaves and
feathers are, and the fits of Locatelli & Hobbs are still only used where they were made. Rain, sand and fog have laws that know
the true diameter: drops above 7 mm break up (Beard 1976), the spectra of rain, blown sand and fog end at 6, 2 and 0.2 mm, and
sizes moved towards such an end would not grow by the factor. There the diameters stay, and the Gaussian that shows a drop, a
grain or a parcel is scaled instead.
"""

from __future__ import annotations

from dataclasses import replace

from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import EFFECTS, Appearance, Effect, StateLook, Wind
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import INTENSITIES, Emission, Material
from pgsd_nerfstudio.effects.request import Request, Rgb
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse

GLITTER_TONES, GLITTER_OPACITIES = 0.20, 0.60
"""Spreads of brightness and opacity where all particles glitter. An initial look keeps brightness within 0.80-1, where contrast
is greatest at 0.20: a third of the particles are at its dull end, a fifth stand out with 0.95 or more. At 0.60 a third of the
snowflakes are opaque and the rest fade."""
HAZE_SHARE, MATTER_SHARE = 0.35, 0.6
"""Part of the way from the base's haze to the colour of what flies. Between flakes and drops it is mostly the same air; fog and
dust are the haze themselves."""


def applied(request: Request, *, base: Effect | None = None) -> Effect:
    """The effect that a request asks for; what it says nothing about stays as the base has it.

    - `rgb`: colour of what flies, and of what has landed where `landed_rgb` says no other; haze and sky
      take HAZE_SHARE of it, those of fog and sand MATTER_SHARE.
    - `landed_rgb`: colour of what has landed.
    - `size`: see the module.
    - `amount`: precipitation times it, or visibility divided by it, within INTENSITIES. Fog, whose parcels stand for droplets
      of a given extinction, gets more parcels if they are smaller or hold more, so that none has to be darker than opaque.
    - `opacity`: of every particle, at most 1. What takes its opacity from its extinction (fog) keeps it.
    - `glitter`: nothing here reflects, so to sparkle is to differ: brightness and opacity in the air vary more from particle to
      particle, from the base's spreads (0) to GLITTER_TONES and GLITTER_OPACITIES (1).
    - `fall_speed`: factor of the law of fall speeds. At the same precipitation slower particles are closer together.
    - `wind`: mean wind, turbulence and the eddies below it. Gusts are a share of the mean wind and grow with it.
    - `tumbling`: speed of the swaying at the same rate, so wider circles. What does not sway by itself (all but snow) stays so.
    - `accumulates`: False lets what would stay vanish where it lands: no cover, no opacity. True changes nothing:
      snow and sand gather anyway, rain and fog do not (see `remarks`).
    - `prompt`: as it is. `name` stays that of the base: the paper's physics is looked up by it.

    Args:
        base: the effect whose knobs are turned, instead of the built-in one that the request names
            (snowfall, if it names none).
    """
    base = base or _base_of(request)
    return replace(
        base,
        emission=_emission(request, base),
        material=_material(request, base.material),
        wind=_wind(request, base.wind),
        surface=_surface(request, base.surface),
        appearance=_appearance(request, base),
        haze=_haze(request, base),
        ambience=_ambience(request, base),
        prompt=request.prompt,
    )


def remarks(request: Request, *, base: Effect | None = None) -> tuple[str, ...]:
    """One sentence for each part of a request that `applied` cannot follow, or not in full."""
    base = base or _base_of(request)
    emission, said = base.emission, list[str]()
    wanted, given = _wanted_intensity(request, emission), _intensity(request, emission)
    if given != wanted:
        low, high = INTENSITIES[emission.kind]
        said.append(
            f"amount {request.amount:g} would be {wanted:g} {emission.unit}: {given:g} it is, {base.name} has {low:g}-{high:g}"
        )
    if request.opacity != 1 and base.appearance.active.opacity is None:
        said.append(f"opacity {request.opacity:g} changes nothing: how opaque {base.name} is follows from its amount")
    if request.tumbling != 1 and base.wind.flutter == 0:
        said.append(f"tumbling {request.tumbling:g} changes nothing: {base.name} does not sway by itself")
    if request.accumulates and base.surface.landing != "stays":
        does = "wets what it hits" if base.surface.landing == "wets" else "flows along surfaces"
        said.append(f"nothing will gather: {base.name} {does}")
    return tuple(said)


def _base_of(request: Request) -> Effect:
    return EFFECTS[request.base or "snowfall"]


def _enlarges(material: Material) -> bool:
    """Whether the particles themselves can have any size."""
    return material.speed_law == "power"


def _wanted_intensity(request: Request, emission: Emission) -> float:
    return emission.intensity * request.amount if emission.precipitates else emission.intensity / request.amount


def _intensity(request: Request, emission: Emission) -> float:
    low, high = INTENSITIES[emission.kind]
    return min(max(_wanted_intensity(request, emission), low), high)


def _emission(request: Request, base: Effect) -> Emission:
    emission = replace(base.emission, intensity=_intensity(request, base.emission))
    if _enlarges(base.material):
        emission = replace(emission, smallest=emission.smallest * request.size, largest=emission.largest * request.size)
    if emission.most is not None and not emission.precipitates and base.appearance.active.opacity is None:
        # Opacity of a parcel: its extinction over its area, which cannot go beyond 1. Fewer than the base has would be lumps.
        denser = base.emission.intensity / emission.intensity
        emission = replace(emission, most=round(emission.most * max(1.0, denser / request.size**2)))
    return emission


def _material(request: Request, material: Material) -> Material:
    material = replace(material, speed_factor=material.speed_factor * request.fall_speed)
    if not _enlarges(material):
        return material
    # Mass and speed at s D are what they were at D.
    return replace(
        material,
        mass_milligram=material.mass_milligram * request.size**-material.mass_exponent,
        speed_at_1mm=material.speed_at_1mm * request.size**-material.speed_exponent,
    )


def _wind(request: Request, wind: Wind) -> Wind:
    return replace(
        wind,
        speed=wind.speed * request.wind,
        turbulence=wind.turbulence * request.wind,
        diffusivity=wind.diffusivity * request.wind,  # speed times length of the eddies
        flutter=wind.flutter * request.tumbling,
    )


def _surface(request: Request, surface: SurfaceResponse) -> SurfaceResponse:
    if request.accumulates is False:
        surface = replace(surface, accumulates=False)
    return replace(surface, landing="vanishes", splash=None) if _vanishes(request, surface) else surface


def _vanishes(request: Request, surface: SurfaceResponse) -> bool:
    """Whether what would stay is wanted gone."""
    return request.accumulates is False and surface.landing == "stays"


def _appearance(request: Request, base: Effect) -> Appearance:
    looks = base.appearance
    active, collided = (_look(request, state) for state in (looks.active, looks.collided))
    if active.scale_m is None and not _enlarges(base.material):
        active = replace(active, scale_per_diameter=_times(active.scale_per_diameter, request.size))
    active = replace(
        active,
        rgb=request.rgb or active.rgb,
        tone_spread=_towards(active.tone_spread, GLITTER_TONES, request.glitter),
        opacity_spread=_towards(active.opacity_spread, GLITTER_OPACITIES, request.glitter),
    )
    collided = replace(collided, rgb=request.landed_rgb or request.rgb or collided.rgb)
    if _vanishes(request, base.surface):
        collided = replace(collided, opacity=0.0)
    return replace(looks, active=active, collided=collided)


def _haze(request: Request, base: Effect) -> Haze | None:
    return None if base.haze is None else replace(base.haze, rgb=_tinted(base.haze.rgb, request, base))


def _ambience(request: Request, base: Effect) -> Ambience | None:
    return None if base.ambience is None else replace(base.ambience, sky=_tinted(base.ambience.sky, request, base))


def _tinted(own: Rgb, request: Request, base: Effect) -> Rgb:
    if request.rgb is None:
        return own
    share = HAZE_SHARE if base.emission.precipitates else MATTER_SHARE
    red, green, blue = (a + share * (b - a) for a, b in zip(own, request.rgb, strict=True))
    return red, green, blue


def _look(request: Request, state: StateLook) -> StateLook:
    """What holds in the air and landed alike."""
    opacity = None if state.opacity is None else min(state.opacity * request.opacity, 1.0)
    scale_m = None if state.scale_m is None else _times(state.scale_m, request.size)
    return replace(state, opacity=opacity, scale_m=scale_m)


def _times(axes: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    long, short, thin = axes
    return long * factor, short * factor, thin * factor


def _towards(least: float, most: float, share: float) -> float:
    return least + share * max(most - least, 0.0)
