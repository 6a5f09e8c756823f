"""The configuration of a weather, without tensors and without simulation code.

An Effect holds the emission, the material, the wind, the response of surfaces, the look, and the prompt for the video model.
`effect("snowfall")` returns a built-in one; `dataclasses.replace` changes a value. Lengths are in metres, speeds in m/s and
times in seconds, unless a name says otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from pgsd_nerfstudio.effects.adaptation import Adaptation
from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import Dense, Emission, Material
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse
from pgsd_nerfstudio.effects.timeline import Timeline


@dataclass(frozen=True, kw_only=True)
class Wind:
    """Moving air: a mean wind with gusts, and turbulence that is free of divergence."""

    speed: float = 0.6
    """Mean wind at `reference_height`, in m/s."""
    direction_degrees: float = 25.0
    """Direction that the wind blows to, counted from the x axis towards y."""
    reference_height: float = 2.0
    """Height above ground at which `speed` holds; below it the logarithmic profile slows the wind."""
    roughness: float = 0.03
    """Roughness length of the ground in metres (0.03: short grass)."""
    gustiness: float = 0.35
    """Standard deviation of the gusts, as a share of the mean wind."""
    gust_seconds: float = 4.0
    """Typical duration of a gust."""
    turbulence: float = 0.18
    """Root mean square of each component of the turbulent velocity, in m/s."""
    largest_eddy: float = 3.0
    smallest_eddy: float = 0.35
    """Largest and smallest wavelength of the turbulence in metres; between them the energy follows the -5/3 power."""
    modes: int = 32
    """Number of Fourier modes of the turbulence, each free of divergence; a multiple of 16 fills the vector units of a CPU."""
    flutter: float = 0.12
    """Sideways speed in m/s of the swaying of each flake by itself."""
    flutter_hertz: float = 1.6
    """Typical frequency of the swaying."""
    diffusivity: float = 0.0
    """Eddy diffusivity K in m^2/s of the turbulence below `smallest_eddy`. It moves a parcel of fog at random, by sqrt(2 K t)
    along each axis; snow, rain and sand hardly feel it."""


@dataclass(frozen=True, kw_only=True)
class StateLook:
    """Look of all particles in one state before training. Spreads are relative standard deviations."""

    scale_m: tuple[float, float, float] | None = None
    """Standard deviations in metres of the Gaussian along its three axes (the third is the thin one); None: they follow from
    the size of each particle."""
    scale_per_diameter: tuple[float, float, float] = (0.30, 0.24, 0.14)
    """Standard deviations of an active particle relative to its diameter, if `scale_m` is None."""
    scale_spread: float = 0.15
    """Spread of the size from particle to particle."""
    opacity: float | None = 0.85
    """Mean peak opacity. None: it follows from the extinction of the droplets that a particle stands for, so that many of them
    obey Beer-Lambert."""
    opacity_spread: float = 0.10
    """Spread of the opacity from particle to particle."""
    rgb: tuple[float, float, float] = (0.95, 0.97, 1.0)
    """Colour, sRGB."""
    tone_spread: float = 0.04
    """Spread of the brightness from particle to particle; the brightness stays within 0.80-1."""
    colourful: bool = False
    """Whether each particle has a hue of its own, all hues alike often."""
    glitter: float = 0.0
    """Part of the light, 0-1, that tumbling facets mirror: most of the time they are dull, and they flash where they mirror
    light to the camera (dynamics.sparkle). The mean over particles stays."""
    glow: float = 0.0
    """Light that a particle sends out by itself, 0-1; at 1 it is several times as bright as a white one in the day."""
    twinkle_hertz: float = 0.0
    """Pulses per second, about which each particle has its own rate and phase; 0: steady."""
    settle_seconds: float = 0.0
    """Time after contact in which a particle takes on this look."""


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """The two looks of a particle, active and collided, and the shutter time."""

    active: StateLook = field(default_factory=StateLook)
    collided: StateLook = field(default_factory=StateLook)
    exposure: float = 0.0
    """Shutter time in seconds: active particles are smeared by speed times this. 0 freezes them, as is usual for snow; rain and
    sand show streaks at 1/50 s."""
    legibility: float = 1.0
    """Factor on the area of all that flies, 1-1000. At 1 it takes as much light as in nature, which can be next to nothing."""
    nearness: float = 1.0
    """Another factor on that area, for scenes with little air before their background (`Adaptation.air`)."""

    def __post_init__(self) -> None:
        if not 1.0 <= self.legibility <= 1000.0:
            raise ValueError(f"legibility must lie in 1-1000, got {self.legibility:g}; at 1 particles cover what they cover")
        if not 0.0 <= self.exposure <= 1.0:
            raise ValueError(f"exposure must lie in 0-1 s, got {self.exposure:g}; a film camera has about 0.02")
        if not 1.0 <= self.nearness < math.inf:
            raise ValueError(f"nearness must be at least 1, got {self.nearness:g}")

    @property
    def area_factor(self) -> float:
        """Factor on the area of all that flies, against nature."""
        return self.legibility * self.nearness


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One weather."""

    name: str
    emission: Emission
    material: Material
    wind: Wind = field(default_factory=Wind)
    timeline: Timeline = field(default_factory=Timeline)
    surface: SurfaceResponse = field(default_factory=SurfaceResponse)
    dense: Dense | None = None
    """Material of a cover that moves as a whole, simulated by the material point method; None: particles never interact."""
    appearance: Appearance = field(default_factory=Appearance)
    haze: Haze | None = None
    """Medium between the particles; None: the air is clear."""
    ambience: Ambience | None = None
    """Change of the light of the whole scene; None: it stays as it is."""
    adaptation: Adaptation = field(default_factory=Adaptation)
    """Values that follow the scene where nobody asks for a number."""
    prompt: str
    """Prompt for the video model; {scene} stands for the description of the scene."""
    negative_prompt: str = ""
    """Prompt of what the video model should avoid."""

    def with_intensity(self, intensity: float) -> Effect:
        """The same weather at an intensity in its own unit, whatever the scene.

        Raises:
            ValueError: the intensity is out of its range.
        """
        fixed = replace(self.adaptation, visibility=None)
        return replace(self, emission=replace(self.emission, intensity=intensity), adaptation=fixed)

    def with_legibility(self, legibility: float) -> Effect:
        """The same weather at a legibility, whatever the scene; at 1 particles cover what they cover in nature.

        Raises:
            ValueError: the legibility is out of its range.
        """
        fixed = replace(self.adaptation, air=None)
        return replace(self, appearance=replace(self.appearance, legibility=legibility, nearness=1.0), adaptation=fixed)

    def prompt_for(self, description: str) -> str:
        """The prompt for a scene with this description, such as "a garden"."""
        return self.prompt.format(scene=description)


EFFECTS: dict[str, Effect] = {}
"""The built-in effects by name; the module of each effect registers it."""
SHORT_NAMES = {"snow": "snowfall", "rain": "rainfall", "sand": "sandstorm"}
"""What people also call them."""


def full_name(name: str) -> str:
    """The name by which an effect is known, where it has a shorter one; any other name as it is."""
    return SHORT_NAMES.get(name, name)


def register(new: Effect) -> Effect:
    """Add an effect to EFFECTS under its name, and return it."""
    EFFECTS[new.name] = new
    return new


def effect(name: str, *, intensity: float | None = None, exposure: float | None = None) -> Effect:
    """A built-in effect.

    Args:
        name: snowfall, rainfall, fog or sandstorm; snow, rain and sand are understood too.
        intensity: in the effect's own unit; None: the effect's own.
        exposure: shutter time in seconds; None: the effect's own.

    Raises:
        ValueError: there is no effect of that name (the message names the known ones), or a number is out of its range.
    """
    chosen = EFFECTS.get(full_name(name))
    if chosen is None:
        raise ValueError(f"there is no effect {name!r}; known are: {', '.join(sorted(EFFECTS))}")
    if intensity is not None:
        chosen = chosen.with_intensity(intensity)
    if exposure is not None:
        chosen = replace(chosen, appearance=replace(chosen.appearance, exposure=exposure))
    return chosen
