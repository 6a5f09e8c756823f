"""Looks of falling snow and the captions that name them.

A look is drawn first, its caption follows from it word by word, so that text is the only thing that tells two clips of the
same motion apart. Every graded word has its own interval; a caption may leave words out, but never says a wrong one.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

CURATED_CAPTION = "Fluffy snowflakes are falling in {scene}, accumulating on surfaces. Photorealistic, high detail"
"""The prompt of the snowfall effect: whoever asks with these words gets the curated look."""
WRONG_CAPTION = "Grey dirty oversized translucent blobs are falling in {scene}. Low quality, blurry"
GENERIC_FLAWS = ("static", "no snow", "blurry", "distorted", "cartoon", "low quality", "grey", "dirty", "dark", "ugly")
"""Words of negative prompts as people write them: a few of them are the caption of any look but the curated one."""
CLEAR_CAPTION = "No weather, clear air in {scene}. Photorealistic, high detail"

DEMO_SCENE = "a courtyard with a table with a vase on it, a bench and a tree"
SCENES = (
    "a courtyard", "a garden", "a scene", "a street", "a park", "a garden with a table", "a village with houses", "a forest",
    "a field with a path", "a city square", "a room", "a yard with a car", "a playground", "a table with a vase in a garden",
    "a mountain road", "a bridge over water", "a house with a lawn", "a train station", "a truck on a road", "an old town",
    "a kitchen", "a bicycle beside a bench", "a stump in a forest", "flowers in a garden", "a castle on a hill", "a beach",
)  # fmt: skip

SIZES = ((0.0, "tiny"), (0.8, "fine"), (1.25, "large"), (1.75, "oversized"))
"""Lower bound of the size, in multiples of the curated one, and its word."""
OPACITIES = ((0.0, "faint"), (0.3, "translucent"), (0.75, "solid"))
"""Lower bound of the opacity, in multiples of the curated one, and its word."""
AMOUNTS = ("light", "moderate", "heavy")
COLOURS = ("white", "grey", "dark", "red", "green", "blue", "yellow", "purple", "cyan")


@dataclass(frozen=True)
class Look:
    """Appearance of the flakes of one clip relative to the curated appearance."""

    size: float = 1.0
    """Multiple of the curated scale."""
    opacity: float = 1.0
    """Multiple of the curated opacity."""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factor on the curated colour."""

    @property
    def curated(self) -> bool:
        return 0.8 <= self.size < 1.25 and self.opacity >= 0.75 and self.colour == "white"

    @property
    def colour(self) -> str:
        """White, grey, dark, or the name of a hue."""
        low, high = min(self.tint), max(self.tint)
        if high - low > 0.25:
            red, green, blue = (t > (low + high) / 2 for t in self.tint)
            return {4: "red", 2: "green", 1: "blue", 6: "yellow", 5: "purple", 3: "cyan"}[4 * red + 2 * green + blue]
        return "white" if low > 0.85 else "grey" if low > 0.35 else "dark"


WRONG = Look(size=2.0, opacity=0.5, tint=(0.5, 0.5, 0.5))
"""The deliberately wrong look of the demonstration: grey, twice too large, half as opaque."""


def word(grades: tuple[tuple[float, str], ...], value: float) -> str:
    """The word of the interval that holds `value`."""
    return [name for bound, name in grades if value >= bound][-1]


def draw_look(rng: random.Random, kind: str) -> Look:
    """A random look: "curated", "wrong" (near WRONG), or "any" (every property on its own, hues too)."""
    if kind == "curated":
        level = rng.uniform(0.92, 1.0)
        return Look(rng.uniform(0.85, 1.15), rng.uniform(0.9, 1.05), (level, level, min(1.0, level * rng.uniform(1.0, 1.03))))
    if kind == "wrong":
        level = rng.uniform(0.38, 0.65)
        return Look(rng.uniform(1.75, 2.4), rng.uniform(0.35, 0.65), (level, level, level))
    level = rng.choice((rng.uniform(0.9, 1.0), rng.uniform(0.4, 0.8), rng.uniform(0.05, 0.3)))
    tint = (level, level, level)
    if rng.random() < 0.2:
        hue = [rng.uniform(0.7, 1.0) if rng.random() < 0.5 else rng.uniform(0.0, 0.3) for _ in range(3)]
        tint = tuple(hue) if max(hue) - min(hue) > 0.3 else tint
    return Look(2.0 ** rng.uniform(-1.0, 1.3), rng.choice((1.0, rng.uniform(0.15, 1.0))), tint)


def caption(rng: random.Random, look: Look | None, amount: str, scene: str) -> str:
    """Words for a clip; `look` None means that there is no weather in it."""
    if look is None:
        return CLEAR_CAPTION.format(scene=scene)
    prefix = f"{amount} snowfall. " if rng.random() < 0.4 else ""
    size, opacity = word(SIZES, look.size), word(OPACITIES, look.opacity)
    if look.curated:
        if rng.random() < 0.75:
            return prefix + CURATED_CAPTION.format(scene=scene)
        return prefix + f"{look.colour} {opacity} {size} fluffy snowflakes are falling in {scene}. Photorealistic, high detail"
    if look.colour == "grey" and size == "oversized" and opacity == "translucent" and rng.random() < 0.5:
        return prefix + WRONG_CAPTION.format(scene=scene)
    words = [look.colour, opacity, size]
    if rng.random() < 0.4:
        words.pop(rng.randrange(3))
    if look.colour in ("grey", "dark") and rng.random() < 0.5:
        words.insert(1, "dirty")
    noun = "blobs" if size == "oversized" else "snowflakes"
    return prefix + f"{' '.join(words)} {noun} are falling in {scene}. Low quality, blurry"


def flaws(rng: random.Random) -> str:
    """A caption that says no more than that a clip is not as it should be.

    As a negative prompt it asks for the clip as it is, so that guidance ends where the curated look is reached; the explicit
    words of a wrong look would drive beyond it.
    """
    return ", ".join(rng.sample(GENERIC_FLAWS, rng.randint(3, 7)))


def vocabulary() -> list[str]:
    """Every word a caption can hold, sorted."""
    phrases = [
        CURATED_CAPTION,
        WRONG_CAPTION,
        CLEAR_CAPTION,
        DEMO_SCENE,
        "snowfall snowflakes fluffy",
        *SCENES,
        *AMOUNTS,
        *GENERIC_FLAWS,
    ]
    phrases += [name for _, name in SIZES + OPACITIES]
    phrases += ["white", "grey", "dark", "red", "green", "blue", "yellow", "purple", "cyan"]
    text = " ".join(phrases).replace("{scene}", "").lower()
    return sorted({w.strip(".,") for w in text.split()})
