"""What a weather is: pure configuration, no tensors, no code that runs.

An Effect says what is emitted, what it is made of, how the air moves, what happens on contact, how it looks and what a video
model is told about it. `effect("snowfall")` hands out the built-in ones; `dataclasses.replace` turns a knob.
Lengths in metres, speeds in m/s, seconds, unless a name says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace


@dataclass(frozen=True, kw_only=True)
class Emission:
    """How much falls, and in which sizes."""

    intensity: float
    """Precipitation rate in mm/h of liquid water (light snow < 1, moderate 1-2.5, heavy > 2.5)."""
    smallest: float = 0.001
    """Smallest diameter that is simulated, in metres; what is smaller carries little water and is not seen."""
    largest: float = 0.012
    """Largest diameter, in metres; the fits of fall speed and mass end there."""
    importance: float = 1.5
    """Where not every real particle can be simulated, larger ones are preferred: chance ~ diameter ** importance."""

    def __post_init__(self) -> None:
        if not 0.0 < self.intensity <= 100.0:
            raise ValueError(f"intensity must lie in 0-100 mm/h of water, got {self.intensity:g}; heavy snow is about 3")
        if not 0.0 < self.smallest < self.largest:
            raise ValueError(f"diameters must satisfy 0 < smallest < largest, got {self.smallest:g} and {self.largest:g} m")


@dataclass(frozen=True, kw_only=True)
class Material:
    """Mass and fall speed as power laws of the diameter in millimetres."""

    mass_milligram: float
    """Mass of a particle of 1 mm diameter, in milligrams."""
    mass_exponent: float
    speed_at_1mm: float
    """Terminal speed of a particle of 1 mm diameter, in m/s."""
    speed_exponent: float


@dataclass(frozen=True, kw_only=True)
class Wind:
    """Moving air: a mean wind with gusts, and turbulence without divergence."""

    speed: float = 0.6
    """Mean wind at `reference_height`, in m/s."""
    direction_degrees: float = 25.0
    """Where the wind blows to, counted from the x axis towards y."""
    reference_height: float = 2.0
    """Height above ground at which `speed` holds; below, the logarithmic profile slows the wind."""
    roughness: float = 0.03
    """Roughness length of the ground in metres (0.03: short grass)."""
    gustiness: float = 0.35
    """Standard deviation of the gusts, as a share of the mean wind."""
    gust_seconds: float = 4.0
    """How long a gust typically lasts."""
    turbulence: float = 0.18
    """Root mean square of each component of the turbulent velocity, in m/s."""
    largest_eddy: float = 3.0
    smallest_eddy: float = 0.35
    """Wavelengths of the turbulence, in metres; energy falls off as the -5/3 power in between."""
    modes: int = 32
    """Fourier modes of the turbulence, each free of divergence by itself; a multiple of 16 fills the vector units."""
    flutter: float = 0.12
    """Sideways speed of the swaying that each flake does on its own, in m/s."""
    flutter_hertz: float = 1.6
    """Typical rate of that swaying."""


@dataclass(frozen=True, kw_only=True)
class SurfaceResponse:
    """What happens on contact."""

    holds_degrees: float = 50.0
    """Up to this slope every particle stays."""
    slips_degrees: float = 80.0
    """From this slope none stays; in between the chance falls linearly."""
    settle: float = 0.006
    """Height at which a landed particle rests above the surface, so that it is not drawn into it."""
    probe: float = 0.12
    """Largest radius over which a landed particle may spread; less where the surface ends or bends before."""


@dataclass(frozen=True, kw_only=True)
class StateLook:
    """Look of all particles in one state, before anything is learned. Spreads are relative standard deviations."""

    scale_m: tuple[float, float, float] | None = None
    """Standard deviations of the Gaussian along its three axes (third: the thin one); None: from each particle's size."""
    scale_per_diameter: tuple[float, float, float] = (0.30, 0.24, 0.14)
    """In the air, where `scale_m` is None."""
    scale_spread: float = 0.15
    opacity: float = 0.85
    opacity_spread: float = 0.10
    rgb: tuple[float, float, float] = (0.95, 0.97, 1.0)
    tone_spread: float = 0.04
    """Variation of brightness from particle to particle; brightness stays within 0.80-1."""
    settle_seconds: float = 0.0
    """How long a particle takes after contact to take on this look."""


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """The two looks of a particle: in the air and on the surface."""

    active: StateLook = field(default_factory=StateLook)
    collided: StateLook = field(default_factory=StateLook)
    exposure: float = 0.0
    """How long the shutter is open, in seconds: what flies is smeared along its way by speed times exposure. 0 freezes it, as
    snow is mostly shown; rain and sand show streaks at 1/50 s."""
    accumulation_speedup: float = 800.0
    """Time lapse of the cover: a landed particle stands for this many times the water that it and the real particles it
    represents bring. 10 s of moderate snow would leave 0.04 mm; with 800 they leave 3 cm, the cover of two hours."""
    layer_density: float = 100.0
    """Density of the fresh layer in kg/m^3; 100 makes 1 cm of snow from 1 mm of water."""
    layer_thickness: float = 0.010
    """Thickness in metres of what one particle leaves; its area follows from its volume, so that the cover does not depend on
    how many particles were affordable."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.exposure <= 1.0:
            raise ValueError(f"exposure must lie in 0-1 s, got {self.exposure:g}; a film camera has about 0.02")


@dataclass(frozen=True, kw_only=True)
class Effect:
    """One weather."""

    name: str
    emission: Emission
    material: Material
    wind: Wind = field(default_factory=Wind)
    surface: SurfaceResponse = field(default_factory=SurfaceResponse)
    appearance: Appearance = field(default_factory=Appearance)
    prompt: str
    """What a video model is told; {scene} stands for the description of the scene."""
    negative_prompt: str = ""

    def prompt_for(self, description: str) -> str:
        """The prompt with the scene's description in its place, e.g. "a garden"."""
        return self.prompt.format(scene=description)


EFFECTS: dict[str, Effect] = {}
"""Every effect that has a name; filled by the modules that describe them."""


def register(new: Effect) -> Effect:
    """Make an effect known under its name."""
    EFFECTS[new.name] = new
    return new


def effect(name: str, *, intensity: float | None = None, exposure: float | None = None) -> Effect:
    """The effect of that name, with another intensity (mm/h of water) or shutter time (seconds) if given.

    Raises:
        ValueError: there is none, then the message names the known ones; or a number is out of its range.
    """
    if name not in EFFECTS:
        raise ValueError(f"there is no effect {name!r}; known are: {', '.join(sorted(EFFECTS))}")
    chosen = EFFECTS[name]
    if intensity is not None:
        chosen = replace(chosen, emission=replace(chosen.emission, intensity=intensity))
    if exposure is not None:
        chosen = replace(chosen, appearance=replace(chosen.appearance, exposure=exposure))
    return chosen
