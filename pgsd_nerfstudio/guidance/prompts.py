"""Texts that the video prior is asked about, for each kind of score distillation; each is encoded once.

The words against flaws are those published with the methods: NFSD's negative text in Katzir et al. (2023), the suffixes of
Bridge-SDS in the code of McAllister et al. (2024). They were written for clear portraits of single things. Some of them name
what a weather is and are left out (`BELONGS`), else the prior would lead away from the very thing it is asked for.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.guidance.variants import Role, Variant, roles_of

NFSD_FLAWS = (
    "unrealistic",
    "blurry",
    "low quality",
    "out of focus",
    "ugly",
    "low contrast",
    "dull",
    "dark",
    "low-resolution",
    "gloomy",
)
BRIDGE_FLAWS = (
    "oversaturated",
    "smooth",
    "pixelated",
    "cartoon",
    "foggy",
    "hazy",
    "blurry",
    "bad structure",
    "noisy",
    "malformed",
)
BRIDGE_QUALITIES = "detailed high resolution, high quality, sharp"

_VEIL = frozenset({"foggy", "hazy", "low contrast"})  # what hangs in the air takes contrast from what is behind it
_OVERCAST = frozenset({"dull", "gloomy"})  # the sun is gone
BELONGS: dict[str, frozenset[str]] = {
    # Nothing far away is sharp or structured in fog: it is a smooth veil in flat light.
    "fog": _VEIL | _OVERCAST | {"blurry", "out of focus", "smooth"},
    # Rain darkens sky and wet ground, and veils the distance; it is no fog, but is seen as one from afar.
    "rainfall": _VEIL | _OVERCAST | {"dark"},
    # Dust is a dense veil that takes the light and the sharpness of what is behind it; flying grains look like noise.
    "sandstorm": _VEIL | _OVERCAST | {"dark", "blurry", "noisy"},
    # Flakes all over the picture look like noise and veil the distance, under a grey sky. The ground is bright: dark is a flaw.
    "snowfall": _VEIL | _OVERCAST | {"noisy"},
}
"""Words of the published lists that name what an effect is, by effect; they are no flaws of it."""


@dataclass(frozen=True, kw_only=True)
class Prompts:
    """The texts of one training, by role."""

    text: str
    """What is wanted."""
    negative: str
    """What is not wanted, as the effect has it."""
    flaws: str
    """How a bad video looks, for NFSD."""
    target: str
    """What is wanted, in high quality, for Bridge-SDS."""
    source: str
    """What is wanted, with the flaws that stage one leaves, for Bridge-SDS."""
    empty: str = ""
    """The empty text, for NFSD."""

    def needed(self, variant: Variant) -> dict[Role, str]:
        """The texts that a variant asks about; the others need not be encoded.

        Raises:
            ValueError: there is no such variant.
        """
        return {role: getattr(self, role) for role in roles_of(variant)}


@runtime_checkable
class Listener(Protocol):
    """What encodes texts."""

    def encode_prompt(self, texts: Sequence[str]) -> Float[Tensor, "n l d"]: ...


def prompts_for(effect: str, prompt: str, negative_prompt: str, description: str) -> Prompts:
    """All texts for an effect in a scene.

    Words of the published lists of flaws are left out that name what the effect is:

    - fog: foggy, hazy, low contrast, dull, gloomy, blurry, out of focus, smooth
    - rainfall: foggy, hazy, low contrast, dull, gloomy, dark
    - sandstorm: foggy, hazy, low contrast, dull, gloomy, dark, blurry, noisy
    - snowfall: foggy, hazy, low contrast, dull, gloomy, noisy
    - an effect of another name: all of these, since any of them may be what it is

    So are, for every effect, words that the prompt itself asks for, such as "cartoon snowflakes". The effect's own negative
    prompt was written for it and stays as it is.

    Args:
        effect: name of the effect, such as "snowfall".
        prompt: what is wanted; {scene} stands for the description and need not occur.
        negative_prompt: what is not wanted.
        description: of the scene, such as "a garden with a table".
    """
    text = prompt.replace("{scene}", description)
    start = text.rstrip(" .,")
    source = ", ".join((start, *_without(BRIDGE_FLAWS, effect, text)))
    flaws = ", ".join(_without(NFSD_FLAWS, effect, text))
    target = f"{start}, {BRIDGE_QUALITIES}"
    return Prompts(text=text, negative=negative_prompt, flaws=flaws, target=target, source=source)


def embed_texts(prior: Listener, texts: Mapping[Role, str]) -> dict[Role, Float[Tensor, "1 l d"]]:
    """Embeddings by role, in one pass of the text encoder; the caller keeps them for the whole training."""
    return dict(zip(texts, prior.encode_prompt(list(texts.values())).split(1), strict=True))


def _without(flaws: Sequence[str], effect: str, text: str) -> list[str]:
    belongs = BELONGS.get(effect, frozenset().union(*BELONGS.values()))
    return [flaw for flaw in flaws if flaw not in belongs and not re.search(rf"\b{re.escape(flaw)}\b", text, re.IGNORECASE)]
