"""Apply a Request to an Effect: its factors change a built-in weather as far as the laws of that weather allow.

The factor `size` makes a particle look wider and changes nothing else; `fall_speed` and `amount` do that. Snow has power laws
of the diameter, and its spectrum is one of melted flakes, so the flake itself is enlarged: it is s times as wide and keeps its
mass and its fall speed. Such a flake is loose, like petals, leaves and feathers, and the fits of Locatelli & Hobbs are still
used only where they were made. The laws of rain, sand and fog need the true diameter: drops above 7 mm break up (Beard 1976),
and the spectra of rain, blown sand and fog end at 6, 2 and 0.2 mm, so that sizes near the end would not grow by the factor. For
these the diameters stay, and the Gaussian that shows a drop, a grain or a parcel is scaled instead.
"""

from __future__ import annotations

from dataclasses import replace

from pgsd_nerfstudio.effects.adaptation import Adaptation
from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.effect import EFFECTS, Appearance, Effect, StateLook, Wind
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import INTENSITIES, Emission, Material
from pgsd_nerfstudio.effects.request import Request, Rgb
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse
from pgsd_nerfstudio.effects.tint import in_matter, mixed_evenly

HAZE_SHARE, MATTER_SHARE = 0.35, 0.6
"""Part of the way from the base's haze colour to the same one dyed or tinted as the particles are. Between flakes and drops the
haze is mostly plain air; fog and dust are the haze themselves, but even black smoke scatters some light."""


def applied(request: Request, *, base: Effect | None = None) -> Effect:
    """The effect that follows a request. A field at its default changes nothing; the others act as follows.

    - `rgb`: tints the active particles, and the collided ones if `landed_rgb` is None, as far as their matter takes a colour
      (tint.py); if `dyed`, it is their colour. Haze and sky of fog and sand go the same way by MATTER_SHARE, those of
      tinted snow and rain by HAZE_SHARE.
    - `landed_rgb`: the same for the collided particles alone.
    - `colourful`: each particle has a hue of its own; a layer of cover has the common colour.
    - `size`: see the docstring of the module.
    - `amount`: precipitation is multiplied by it, visibility is divided by it, within INTENSITIES. The parcels of fog stand for
      droplets of a given extinction: if they are smaller or hold more, there are more of them, so that none needs an opacity
      above 1.
    - `opacity`: factor for every particle, up to an opacity of 1. Fog takes its opacity from its extinction and keeps it.
    - `glitter`, `glow`, `twinkle`: what active particles do with light as time goes by (StateLook has the same fields, with the
      greater of the base's and the request's values). Droplets of fog have no facets and never glitter.
    - `fall_speed`: factor of the law of fall speeds. At the same precipitation slower particles are closer together.
    - `wind`: factor of mean wind, turbulence and eddy diffusivity. Gusts are a share of the mean wind and grow with it.
    - `tumbling`: factor of the speed of swaying at the same frequency, so that the circles are wider. Only snow sways by
      itself.
    - `accumulates`: False makes particles vanish where they would stay, without cover and without opacity. True changes
      nothing: snow and sand accumulate anyway, rain and fog never do (see `remarks`).
    - `prompt`: replaces that of the base. The name stays that of the base, since the paper's physics is chosen by it.

    Args:
        request: the factors and colours.
        base: the effect that they apply to; None: the built-in one that the request names, or snowfall if it names none.
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
        adaptation=_adaptation(request, base.adaptation),
        prompt=request.prompt,
    )


def remarks(request: Request, *, base: Effect | None = None) -> tuple[str, ...]:
    """One sentence for each part of a request that `applied` cannot follow in full.

    Args:
        request: the factors and colours.
        base: as for `applied`.
    """
    base = base or _base_of(request)
    emission, sentences = base.emission, list[str]()
    wanted, possible = _wanted_intensity(request, emission), _intensity(request, emission)
    if possible != wanted:
        low, high = INTENSITIES[emission.kind]
        sentences.append(
            f"amount {request.amount:g} would be {wanted:g} {emission.unit}, but {base.name} takes {low:g}-{high:g}: "
            f"{possible:g} is used"
        )
    if request.opacity != 1 and base.appearance.active.opacity is None:
        sentences.append(f"opacity {request.opacity:g} changes nothing: the opacity of {base.name} follows from its amount")
    if request.glitter and not _has_facets(base):
        sentences.append(f"glitter {request.glitter:g} changes nothing: droplets of {base.name} have no facets")
    if request.tumbling != 1 and base.wind.flutter == 0:
        sentences.append(f"tumbling {request.tumbling:g} changes nothing: {base.name} does not sway by itself")
    if request.accumulates and base.surface.landing != "stays":
        does = "wets surfaces" if base.surface.landing == "wets" else "flows along surfaces"
        sentences.append(f"nothing will accumulate: {base.name} {does}")
    return tuple(sentences)


def _base_of(request: Request) -> Effect:
    return EFFECTS[request.base or "snowfall"]


def _enlarges(material: Material) -> bool:
    """Whether the laws of a material hold for enlarged particles."""
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
        # The opacity of a parcel is its extinction over its area, at most 1. Fewer parcels than the base has would look lumpy.
        denser = base.emission.intensity / emission.intensity
        emission = replace(emission, most=round(emission.most * max(1.0, denser / request.size**2)))
    return emission


def _material(request: Request, material: Material) -> Material:
    material = replace(material, speed_factor=material.speed_factor * request.fall_speed)
    if not _enlarges(material):
        return material
    # A particle of the diameter s D has the mass and the speed that D had before.
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
    """Whether the request makes particles vanish that would stay."""
    return request.accumulates is False and surface.landing == "stays"


def _appearance(request: Request, base: Effect) -> Appearance:
    looks = base.appearance
    active, collided = (_look(request, state) for state in (looks.active, looks.collided))
    if active.scale_m is None and not _enlarges(base.material):
        active = replace(active, scale_per_diameter=_times(active.scale_per_diameter, request.size))
    active = replace(
        active,
        rgb=_coloured(active.rgb, request.rgb, request, base),
        glitter=max(active.glitter, request.glitter) if _has_facets(base) else active.glitter,
        glow=max(active.glow, request.glow),
        twinkle_hertz=max(active.twinkle_hertz, request.twinkle),
    )
    collided = replace(collided, rgb=_coloured(collided.rgb, request.landed_rgb or request.rgb, request, base))
    if _vanishes(request, base.surface):
        collided = replace(collided, opacity=0.0)
    return replace(looks, active=active, collided=collided)


def _haze(request: Request, base: Effect) -> Haze | None:
    return None if base.haze is None else replace(base.haze, rgb=_hazy(base.haze.rgb, request, base))


def _adaptation(request: Request, adaptation: Adaptation) -> Adaptation:
    if adaptation.visibility is None:
        return adaptation
    return replace(adaptation, visibility=min(max(adaptation.visibility / request.amount, 0.2), 100.0))


def _ambience(request: Request, base: Effect) -> Ambience | None:
    return None if base.ambience is None else replace(base.ambience, sky=_hazy(base.ambience.sky, request, base))


def _hazy(own: Rgb, request: Request, base: Effect) -> Rgb:
    # Petals, confetti and magic are few: the air between them is plain.
    if request.rgb is None or (request.dyed and base.emission.precipitates):
        return own
    share = HAZE_SHARE if base.emission.precipitates else MATTER_SHARE
    return mixed_evenly(own, _coloured(own, request.rgb, request, base), share)


def _coloured(own: Rgb, wanted: Rgb | None, request: Request, base: Effect) -> Rgb:
    if wanted is None:
        return own
    return wanted if request.dyed else in_matter(own, wanted, base.emission.kind)


def _has_facets(base: Effect) -> bool:
    return base.emission.kind != "fog droplets"


def _look(request: Request, state: StateLook) -> StateLook:
    """The changes that active and collided particles share."""
    opacity = None if state.opacity is None else min(state.opacity * request.opacity, 1.0)
    scale_m = None if state.scale_m is None else _times(state.scale_m, request.size)
    # One colour that is asked for takes the place of all hues.
    colourful = request.colourful or (state.colourful and request.rgb is None)
    return replace(state, opacity=opacity, scale_m=scale_m, colourful=colourful)


def _times(axes: tuple[float, float, float], factor: float) -> tuple[float, float, float]:
    long, short, thin = axes
    return long * factor, short * factor, thin * factor
