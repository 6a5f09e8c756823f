"""What a weather is: pure configuration, no tensors, no code that runs.

An Effect says what is emitted, what it is made of, how the air moves, what happens on contact, how it looks and what a video
model is told about it. `effect("snowfall")` hands out the built-in ones; `dataclasses.replace` turns a knob.
Lengths in metres, speeds in m/s, seconds, unless a name says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.matter import Dense, Emission, Material
from pgsd_nerfstudio.effects.surface_response import SurfaceResponse
from pgsd_nerfstudio.effects.timeline import Timeline


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
    diffusivity: float = 0.0
    """Eddy diffusivity in m^2/s of the turbulence below `smallest_eddy`: what is carried by it walks at random, sqrt(2 K t)
    along each axis. For fog; what falls hardly feels it."""


@dataclass(frozen=True, kw_only=True)
class StateLook:
    """Look of all particles in one state, before anything is learned. Spreads are relative standard deviations."""

    scale_m: tuple[float, float, float] | None = None
    """Standard deviations of the Gaussian along its three axes (third: the thin one); None: from each particle's size."""
    scale_per_diameter: tuple[float, float, float] = (0.30, 0.24, 0.14)
    """In the air, where `scale_m` is None."""
    scale_spread: float = 0.15
    opacity: float | None = 0.85
    """None: from the extinction of the droplets that a particle stands for, so that many of them obey Beer-Lambert."""
    opacity_spread: float = 0.10
    fades_below: float = 0.0
    """Diameter in metres below which opacity falls with the particle's area; 0: never. A rasterizer draws nothing thinner than
    a pixel, so that spray would shine like drops."""
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
    timeline: Timeline = field(default_factory=Timeline)
    surface: SurfaceResponse = field(default_factory=SurfaceResponse)
    dense: Dense | None = None
    """What it is where much of it moves together on a surface; None: particles never feel each other."""
    appearance: Appearance = field(default_factory=Appearance)
    haze: Haze | None = None
    """What hangs in the air as far as one can see; None: clear air."""
    ambience: Ambience | None = None
    """How the light of the whole scene follows; None: it stays as it is."""
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
    """The effect of that name, with another intensity (in the effect's own unit) or shutter time (seconds) if given.

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
