"""NFSD and Bridge-SDS against their published expressions, against densities whose modes are known, and what texts they use."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from pgsd_nerfstudio.guidance import (
    DistillationConfig,
    TimestepSchedule,
    distill,
    distill_clip,
    embed_texts,
    prompts_for,
    regularization_scale,
    roles_of,
)
from pgsd_nerfstudio.guidance.prompts import BELONGS, BRIDGE_FLAWS, NFSD_FLAWS
from pgsd_nerfstudio.laboratory.tiny_cogvideox import scheduler_2b

SHAPE = (1, 3, 4, 5, 6)
ALPHAS = scheduler_2b().alphas_cumprod.double()
BELIEFS = {
    "text": (0.4, 0.7),
    "negative": (-0.2, 0.9),
    "empty": (0.1, 1.1),
    "flaws": (-0.5, 1.3),
    "target": (0.5, 0.6),
    "source": (-0.1, 0.8),
}
"""Mean and deviation of the clips that each text describes."""
OMEGAS: list[Any] = ["sds", "uniform", "fantasia3d", "paper_code"]


def embeddings(beliefs=BELIEFS) -> Any:
    return {role: torch.tensor([[belief]]) for role, belief in beliefs.items()}


class Prior:
    """The exact denoiser of Gaussian data; an embedding is [mean, deviation]. It writes down what it is asked."""

    def __init__(self):
        self.alphas_cumprod, self.asked = ALPHAS, []

    def predict_v(self, noisy, timestep, text_embeddings):
        self.asked.append(text_embeddings)
        ab = self.alphas_cumprod[timestep]
        a, s = ab.sqrt(), (1 - ab).sqrt()
        mean, sigma = text_embeddings.double().reshape(-1, 2, 1, 1, 1, 1).unbind(1)
        away = (noisy.double() - a * mean) / (ab * sigma**2 + 1 - ab)
        return (a * s * away - s * (mean + a * sigma**2 * away)).float()


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def gradient(config, timestep, latents, seed=3, prior=None, told=None, progress=1.0):
    return distill(
        prior or Prior(),
        latents,
        told or embeddings(),
        None,
        timestep,
        config=config,
        generator=seeded(seed),
        progress=progress,
    ).gradient


def published(variant, timestep, latents, scale, seed=3):
    """The bracket of the publications in noise, in float64: conditional scores of Gaussians, no v anywhere."""
    ab = ALPHAS[timestep]
    a, s = ab.sqrt(), (1 - ab).sqrt()
    eps = torch.randn(SHAPE, generator=seeded(seed)).double()
    x_t = a * latents.double() + s * eps
    # Noise is -s times the score of N(a mean, ab sigma^2 + s^2).
    e = SimpleNamespace(**{role: s * (x_t - a * m) / (ab * d**2 + s**2) for role, (m, d) in BELIEFS.items()})
    if variant == "sds":
        return e.negative + scale * (e.text - e.negative) - eps
    if variant == "bridge":
        return scale * (e.target - e.source)
    return scale * (e.text - e.empty) + (e.empty if timestep < 90 else e.empty - e.flaws)


@pytest.mark.parametrize("timestep", [20, 89, 90, 300, 740, 980])
@pytest.mark.parametrize("omega", OMEGAS)
@pytest.mark.parametrize("variant", ["sds", "nfsd", "bridge"])
def test_every_variant_is_its_published_expression(variant, omega, timestep):
    latents, ab = torch.randn(SHAPE, generator=seeded(5)), ALPHAS[timestep]
    weight = {"sds": 1 - ab, "uniform": 1.0, "fantasia3d": ab.sqrt() * (1 - ab), "paper_code": (1 - ab) ** 1.5 / ab.sqrt()}
    truth = weight[omega] * published(variant, timestep, latents, 7.0)
    config = DistillationConfig(
        variant=variant, omega=omega, guidance_scale=7.0, nfsd_scale=7.0, bridge_scale=7.0, max_rms=math.inf
    )
    found = gradient(config, timestep, latents)
    # Predictions in float32, whose difference from the noise has few digits left where it is small against both.
    assert float((found - truth).norm() / truth.norm()) < 1e-4


@pytest.mark.parametrize("variant", ["sds", "nfsd", "bridge"])
def test_at_pure_noise_only_means_are_known(variant):
    """alpha_bar = 0 at t = 999: the prior can only tell its texts' means; weights in noise vanish, in latents they do not."""
    latents = torch.randn(SHAPE, generator=seeded(5)).double()
    mean = SimpleNamespace(**{role: m for role, (m, _) in BELIEFS.items()})
    limits = {
        "sds": latents - (mean.negative + 7.0 * (mean.text - mean.negative)),
        "nfsd": torch.full_like(latents, -(7.0 * (mean.text - mean.empty) + mean.empty - mean.flaws)),
        "bridge": torch.full_like(latents, -7.0 * (mean.target - mean.source)),
    }
    assert ALPHAS[999] == 0
    for omega in OMEGAS:
        config = DistillationConfig(
            variant=variant, omega=omega, guidance_scale=7.0, nfsd_scale=7.0, bridge_scale=7.0, max_rms=math.inf
        )
        truth = limits[variant] if omega == "paper_code" else torch.zeros_like(latents)
        torch.testing.assert_close(gradient(config, 999, latents).double(), truth, rtol=1e-5, atol=1e-5)


def test_the_threshold_of_nfsd_has_stable_diffusions_signal_to_noise_ratio_at_200():
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    there = (1 - betas).cumprod(0)[200]
    snr, here = there / (1 - there), DistillationConfig().nfsd_threshold
    ratios = (ALPHAS / (1 - ALPHAS) / snr).log().abs()
    assert int(ratios.argmin()) == here == 90


@pytest.mark.parametrize(
    ("variant", "timestep", "progress", "roles"),
    [
        ("sds", 300, None, ["negative", "text"]),
        ("nfsd", 89, None, ["text", "empty"]),
        ("nfsd", 90, None, ["text", "empty", "flaws"]),
        ("bridge", 300, 0.499, ["negative", "text"]),
        ("bridge", 300, 0.5, ["target", "source"]),
    ],
)
def test_the_prior_is_asked_once_and_only_about_the_texts_of_the_step(variant, timestep, progress, roles):
    prior, told = Prior(), embeddings()
    gradient(DistillationConfig(variant=variant), timestep, torch.randn(SHAPE), prior=prior, progress=progress)
    assert len(prior.asked) == 1
    torch.testing.assert_close(prior.asked[0], torch.cat([told[role] for role in roles]))


def test_stage_one_of_bridge_is_sds_to_the_bit():
    latents, told = torch.randn(SHAPE), embeddings()
    bridge = gradient(DistillationConfig(variant="bridge"), 300, latents, progress=0.2)
    sds = distill(
        Prior(), latents, told["text"], told["negative"], 300, config=DistillationConfig(), generator=seeded(3)
    ).gradient
    assert torch.equal(bridge, sds)


def test_scales_are_those_of_the_publications():
    config = DistillationConfig()
    assert (config.guidance_scale, config.nfsd_scale, config.bridge_scale, config.bridge_start) == (100.0, 7.5, 30.0, 0.5)
    latents = torch.randn(SHAPE, generator=seeded(5))
    cases: list[Any] = [("nfsd", 300, 7.5), ("nfsd", 50, 7.5), ("bridge", 300, 30.0), ("sds", 300, 100.0)]
    for variant, timestep, scale in cases:
        truth = (1 - ALPHAS[timestep]) * published(variant, timestep, latents, scale)
        found = gradient(DistillationConfig(variant=variant, max_rms=math.inf), timestep, latents)
        assert float((found - truth).norm() / truth.norm()) < 1e-4


@pytest.mark.parametrize(
    ("variant", "timestep", "shares"),
    [
        ("sds", 300, {"text": 3.0, "negative": -2.0}),
        ("nfsd", 300, {"text": 3.0, "empty": -2.0, "flaws": -1.0}),
        ("nfsd", 80, {"text": 3.0, "empty": -2.0}),
        ("bridge", 300, {"target": 1.0, "source": -1.0}),
    ],
)
def test_descent_finds_the_mode_of_the_density_that_the_variant_stands_for(variant, timestep, shares):
    """prod p_r(x_t)^shares is Gaussian; its mode is the mean of the texts' means, weighted with share / variance."""
    ab = ALPHAS[timestep]
    weight = {role: share / (ab * BELIEFS[role][1] ** 2 + 1 - ab) for role, share in shares.items()}
    mode = float(sum(w * BELIEFS[role][0] for role, w in weight.items()) / sum(weight.values()))
    config = DistillationConfig(variant=variant, omega="uniform", guidance_scale=3.0, nfsd_scale=3.0, bridge_scale=10.0)
    prior, told, rng = Prior(), embeddings(), seeded(2)
    latents, total = torch.full(SHAPE, -1.0), 0.0
    for step in range(900):
        found = distill(prior, latents, told, None, timestep, config=config, generator=rng, progress=1.0)
        latents = latents - 0.05 * found.gradient
        total += float(latents.mean()) * (step >= 400) / 500
    assert total == pytest.approx(mode, abs=0.03)
    assert abs(mode + 1.0) > 1.0 and abs(mode - BELIEFS["text"][0]) > 0.1


@pytest.mark.parametrize("variant", ["nfsd", "bridge"])
def test_texts_that_narrow_down_one_thing_lead_to_it_in_a_whole_training(variant):
    """Annealed timesteps, adaptive weights of a motion prior that wants something else, own scales and stages."""
    nested = {"text": 0.3, "negative": 1.0, "empty": 0.8, "flaws": 1.2, "target": 0.3, "source": 0.8}
    told = embeddings({role: (0.7, sigma) for role, sigma in nested.items()})
    prior, schedule, rng, steps = Prior(), TimestepSchedule(), seeded(2), 600
    config, total = DistillationConfig(variant=variant, guidance_scale=1.0), 0.0
    latents = torch.full(SHAPE, -3.0, requires_grad=True)
    optimizer = torch.optim.Adam([latents], lr=0.05)
    for step in range(steps):
        timestep = schedule.sample(step, steps, rng)
        found = distill(prior, latents, told, None, timestep, config=config, generator=rng, frames=9, progress=step / steps)
        optimizer.zero_grad()
        drift = 0.01 * regularization_scale("adaptive", found.loss) * (latents - 1.3).norm(dim=2).mean()
        ((found.gradient * latents).sum() + drift).backward()
        optimizer.step()
        total += float(latents.detach().mean()) * (step >= 450) / 150
    assert total == pytest.approx(0.7, abs=0.1)


def test_missing_texts_are_named_before_the_first_step():
    told = embeddings()
    with pytest.raises(
        ValueError, match="nfsd needs embeddings of text, empty, flaws, found text, negative: empty, flaws missing"
    ):
        distill(
            Prior(), torch.randn(SHAPE), told["text"], told["negative"], 20,
            config=DistillationConfig(variant="nfsd"), generator=seeded(),
        )  # fmt: skip
    with pytest.raises(ValueError, match="give None for the negative one"):
        distill(Prior(), torch.randn(SHAPE), told, told["negative"], 20, config=DistillationConfig(), generator=seeded())


@pytest.mark.parametrize("progress", [None, -0.1, 1.1, math.nan])
def test_bridge_must_know_how_far_training_is(progress):
    with pytest.raises(ValueError, match="bridge needs the progress of training"):
        gradient(DistillationConfig(variant="bridge"), 300, torch.randn(SHAPE), progress=progress)


def test_a_threshold_in_the_noise_is_refused_where_its_weight_would_grow_without_bound():
    config = DistillationConfig(variant="nfsd", nfsd_threshold=1000, omega="paper_code")
    with pytest.raises(ValueError, match=r"needs alpha_bar >= 0.5 below its threshold, found 0"):
        gradient(config, 999, torch.randn(SHAPE))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"nfsd_scale": math.inf}, "nfsd_scale must be finite"),
        ({"nfsd_threshold": -1}, "must not be negative, got -1"),
        ({"bridge_start": 1.5}, "in 0-1, got 1.5"),
    ],
)
def test_settings_out_of_range_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        DistillationConfig(**wrong)


@pytest.mark.mistyped
def test_unknown_kinds_are_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="one of sds, nfsd, bridge, got 'vsd'"):
        gradient(DistillationConfig(variant="vsd"), 300, torch.randn(SHAPE))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="one of sds, uniform, fantasia3d, paper_code, got 'x0'"):
        gradient(DistillationConfig(omega="x0"), 300, torch.randn(SHAPE))  # type: ignore[arg-type]


@pytest.mark.mistyped
def test_a_clip_takes_variants_too():
    """Through an encoder that halves: the gradient on pixels is half that on latents, shared by the frames."""
    told, clip = embeddings(), torch.rand(3, 4, 5, 6, generator=seeded(1))
    prior: Any = Prior()
    prior.encode = lambda pixels: (0.5 * pixels)[None]
    config = DistillationConfig(variant="bridge")
    found = distill_clip(prior, clip, told, None, 300, config=config, generator=seeded(3), progress=0.9)
    torch.testing.assert_close(found.gradient, 0.5 / 3 * gradient(config, 300, 0.5 * clip[None], progress=0.9)[0])


def words(text):
    return {word.strip() for word in text.split(",")}


@pytest.mark.parametrize(
    ("effect", "never"),
    [
        ("fog", {"foggy", "hazy", "low contrast", "blurry", "smooth"}),
        ("sandstorm", {"foggy", "hazy", "dark", "gloomy", "low contrast"}),
        ("rainfall", {"dark", "gloomy", "dull"}),
        ("snowfall", {"noisy", "foggy", "hazy"}),
        ("ash rain of one's own", {"foggy", "hazy", "dark", "gloomy", "noisy"}),
    ],
)
def test_no_flaw_names_what_the_effect_is(effect, never):
    found = prompts_for(effect, "It comes down on {scene}.", "static", "a garden")
    assert not never & (words(found.flaws) | words(found.source))
    assert {"unrealistic", "low quality", "ugly"} <= words(found.flaws)
    assert {"cartoon", "oversaturated", "malformed", "bad structure"} <= words(found.source)


def test_what_does_not_name_an_effect_is_kept_in_the_published_order():
    found = prompts_for("snowfall", "Snow in {scene}", "no snow", "a garden")
    assert found.flaws == "unrealistic, blurry, low quality, out of focus, ugly, dark, low-resolution"
    assert found.source == "Snow in a garden, oversaturated, smooth, pixelated, cartoon, blurry, bad structure, malformed"
    assert found.target == "Snow in a garden, detailed high resolution, high quality, sharp"
    assert (found.text, found.negative, found.empty) == ("Snow in a garden", "no snow", "")


def test_the_lists_are_the_published_ones():
    assert ", ".join(NFSD_FLAWS) == (
        "unrealistic, blurry, low quality, out of focus, ugly, low contrast, dull, dark, low-resolution, gloomy"
    )
    assert ", ".join(BRIDGE_FLAWS) == (
        "oversaturated, smooth, pixelated, cartoon, foggy, hazy, blurry, bad structure, noisy, malformed"
    )
    assert all(word in {*NFSD_FLAWS, *BRIDGE_FLAWS} for belongs in BELONGS.values() for word in belongs)


def test_what_the_prompt_itself_asks_for_is_no_flaw():
    found = prompts_for("snowfall", "Cartoon snow falls on {scene}.", "", "a Dark forest")
    assert "dark" not in words(found.flaws) and "cartoon" not in words(found.source)
    assert found.source.startswith("Cartoon snow falls on a Dark forest, oversaturated")


def test_built_in_effects_are_known_by_name():
    from pgsd_nerfstudio.effects import EFFECTS

    assert set(BELONGS) == {"snowfall", "rainfall", "fog", "sandstorm"} <= set(EFFECTS)


def test_only_the_texts_of_the_variant_are_encoded_and_all_at_once():
    calls = []

    def encode_prompt(texts):
        calls.append(list(texts))
        return torch.arange(len(texts)).reshape(-1, 1, 1).float()

    texts = prompts_for("snowfall", "Snow in {scene}", "no snow", "a garden").needed("nfsd")
    listener: Any = SimpleNamespace(encode_prompt=encode_prompt)
    found = embed_texts(listener, texts)
    assert tuple(found) == roles_of("nfsd") == ("text", "empty", "flaws")
    assert calls == [["Snow in a garden", "", texts["flaws"]]]
    assert [float(e) for e in found.values()] == [0.0, 1.0, 2.0] and found["text"].shape == (1, 1, 1)
