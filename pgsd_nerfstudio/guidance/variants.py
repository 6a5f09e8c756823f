"""Kinds of score distillation: which texts the video prior is asked about, and how its predictions become one gradient.

With a = sqrt(alpha_bar), s = sqrt(1 - alpha_bar), x_t = a x0 + s eps and v = a eps - s x0, every prediction of noise is
eps_hat = s x_t + a v_hat. Differences of predictions are a (v_1 - v_2): alpha_bar = 0 at the last timestep is no trouble.

    sds     w [eps_neg + g (eps_text - eps_neg) - eps]       Poole et al., "DreamFusion" (2022), eq. 3
    nfsd    w [g (eps_text - eps_0) + delta_D]               Katzir et al., "Noise-Free Score Distillation" (2023)
            delta_D = eps_0 below t*, where the prior's guess of the noise is all noise; else eps_0 - eps_flaws
    bridge  first sds, then w g (eps_target - eps_source)    McAllister et al., "Rethinking Score Distillation" (2024)

eps_0 is the prediction for the empty text.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Float
from torch import Tensor

Role = Literal["text", "negative", "empty", "flaws", "target", "source"]
"""What a text is for. text: what is wanted; negative: what is not; empty: nothing said; flaws: how bad videos look (nfsd);
target: what is wanted, in high quality, and source: the same with the flaws that stage one leaves (bridge)."""
Embeddings = Mapping[Role, Float[Tensor, "1 l d"]]
Variant = Literal["sds", "nfsd", "bridge"]
Omega = Literal["sds", "uniform", "fantasia3d", "paper_code"]
Rule = Literal["sds", "nfsd_fine", "nfsd", "bridge"]
"""What one step does: nfsd_fine is NFSD below t*; bridge is Bridge-SDS in stage two, before it is sds."""

ASKED: dict[Rule, tuple[Role, ...]] = {
    "sds": ("negative", "text"),
    "nfsd_fine": ("text", "empty"),
    "nfsd": ("text", "empty", "flaws"),
    "bridge": ("target", "source"),
}
"""Texts that the prior is asked about, in the order in which it gets them."""
RULES: dict[Variant, tuple[Rule, ...]] = {"sds": ("sds",), "nfsd": ("nfsd_fine", "nfsd"), "bridge": ("sds", "bridge")}
CLEAR = 0.5  # alpha_bar from which on latents hold at least as much picture as noise


class Noised(NamedTuple):
    """Latents on which noise was put."""

    latents: Float[Tensor, "1 lt c lh lw"]
    noise: Float[Tensor, "1 lt c lh lw"]
    noisy: Float[Tensor, "1 lt c lh lw"]
    a: float
    """sqrt(alpha_bar), the share of the latents."""
    s: float
    """sqrt(1 - alpha_bar), the share of the noise."""


def noised(latents: Float[Tensor, "1 lt c lh lw"], alpha_bar: float, generator: torch.Generator) -> Noised:
    """Put Gaussian noise on latents.

    Args:
        latents: clean ones.
        alpha_bar: share of signal power that is left, 0..1.
        generator: source of the noise, which is drawn on its device: a CPU generator gives every device the same.
    """
    a, s = alpha_bar**0.5, (1.0 - alpha_bar) ** 0.5
    noise = torch.randn(latents.shape, generator=generator).to(latents)
    return Noised(latents, noise, a * latents + s * noise, a, s)


def roles_of(variant: Variant) -> tuple[Role, ...]:
    """Every text that a training with this variant will ask about.

    Raises:
        ValueError: there is no such variant; the message names the known ones.
    """
    if variant not in RULES:
        raise ValueError(f"the variant of distillation must be one of {', '.join(RULES)}, got {variant!r}")
    asked = {role for rule in RULES[variant] for role in ASKED[rule]}
    return tuple(role for role in get_args(Role) if role in asked)


def require_roles(variant: Variant, embeddings: Embeddings) -> None:
    """Check that embeddings are complete, before the first step and not where the missing one is needed.

    Raises:
        ValueError: embeddings are missing that the variant needs; the message names them.
    """
    missing = [role for role in roles_of(variant) if role not in embeddings]
    if missing:
        found = ", ".join(embeddings) or "none"
        raise ValueError(
            f"{variant} needs embeddings of {', '.join(roles_of(variant))}, found {found}: {', '.join(missing)} missing; "
            "guidance.prompts gives the texts"
        )


def rule_at(variant: Variant, timestep: int, threshold: int, progress: float | None, start: float) -> Rule:
    """What one step of a training does.

    Args:
        variant: kind of score distillation.
        timestep: noise level of the step.
        threshold: timestep t* of nfsd.
        progress: share of the training that is done, 0..1; only bridge needs it.
        start: share of the training after which bridge is in stage two.

    Raises:
        ValueError: bridge has not been told its progress in 0..1, or the variant is unknown.
    """
    if variant == "nfsd":
        return "nfsd_fine" if timestep < threshold else "nfsd"
    if variant == "bridge":
        if progress is None or not 0.0 <= progress <= 1.0:
            raise ValueError(f"bridge needs the progress of training as a share in 0..1 (step / steps), got {progress}")
        return "bridge" if progress >= start else "sds"
    return RULES[variant][0]


def weight_on_v(omega: Omega, a: float, s: float) -> float:
    """Weight of a difference of v-predictions: that of the difference of noises times a, without a division.

    Raises:
        ValueError: there is no such omega; the message names the known ones.
    """
    weights = {"sds": s * s * a, "uniform": a, "fantasia3d": s * s * a * a, "paper_code": s * s * s}
    if omega not in weights:
        raise ValueError(f"omega must be one of {', '.join(weights)}, got {omega!r}")
    return weights[omega]


def weight_on_noise(omega: Omega, a: float, s: float) -> float:
    """Weight of a prediction of noise that stands alone, as in NFSD below t*.

    Raises:
        ValueError: omega is paper_code, whose weight s^3 / a grows without bound, where alpha_bar is below 0.5.
    """
    if omega == "paper_code":
        if a * a < CLEAR:
            raise ValueError(
                f"nfsd with omega paper_code needs alpha_bar >= {CLEAR:g} below its threshold, found {a * a:.3g}; "
                "use a smaller nfsd_threshold (90 by default) or another omega"
            )
        return s * s * s / a
    return {"sds": s * s, "uniform": 1.0, "fantasia3d": s * s * a}[omega]


def direction(
    rule: Rule, v: Mapping[Role, Float[Tensor, "1 lt c lh lw"]], state: Noised, scale: float, omega: Omega
) -> Float[Tensor, "1 lt c lh lw"]:
    """The gradient on latents, from the v-predictions for the texts of `ASKED[rule]`.

    Args:
        rule: what this step does.
        v: predictions, at least float32: scales of 100 leave the range of half precision.
        state: the noised latents.
        scale: g of the formulas above.
        omega: weight of the timestep.
    """
    _, noise, noisy, a, s = state
    weight = weight_on_v(omega, a, s)
    if rule == "sds":
        return weight * (v["negative"] + scale * (v["text"] - v["negative"]) - (a * noise - s * state.latents))
    if rule == "bridge":
        return (weight * scale) * (v["target"] - v["source"])
    wanted = scale * (v["text"] - v["empty"])
    if rule == "nfsd":
        return weight * (wanted + v["empty"] - v["flaws"])
    return weight * wanted + weight_on_noise(omega, a, s) * (s * noisy + a * v["empty"])
