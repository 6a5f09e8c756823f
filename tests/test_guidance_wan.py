"""Wan as a video prior against diffusers' own pipeline and schedulers, and against Gaussians, where everything is known."""

import math
import shutil
from pathlib import Path

import pytest
import torch
from guidance_prior import rewrite, there_and_back
from wan_tiny import tiny_wan

from pgsd_nerfstudio.guidance import DistillationConfig, PriorError, distill_clip
from pgsd_nerfstudio.guidance.tiny_vae import TinyEncoder
from pgsd_nerfstudio.guidance.wan import WanPrior, alpha_bar, v_from_flow
from pgsd_nerfstudio.guidance.wan_parts import cleaned

PROMPT, NEGATIVE = "snow is falling in a garden", "no snow"


@pytest.fixture(scope="module")
def pipeline():
    return tiny_wan()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory, pipeline) -> Path:
    folder = tmp_path_factory.mktemp("prior") / "tiny"
    pipeline.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def prior(tiny) -> WanPrior:
    return WanPrior.load(tiny, frames=9)


@pytest.fixture(scope="module")
def exact(tiny) -> WanPrior:
    """The same in float64."""
    return WanPrior.load(tiny, dtype=torch.float64, frames=9)


@pytest.fixture
def broken(tiny, tmp_path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(tiny, tmp_path / "broken"))


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def random_clip(frames: int = 9, height: int = 32, width: int = 48, seed: int = 0) -> torch.Tensor:
    return torch.rand(frames, 3, height, width, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("frames", "height", "width"), [(9, 32, 48), (13, 48, 16)])
def test_prediction_is_that_of_diffusers_pipeline(prior, pipeline, monkeypatch, frames, height, width):
    """At a guidance scale of 6, where the prediction meets the scheduler; Wan's noisy latents are n times ours."""
    noisy = random(1, 4, (frames - 1) // 4 + 1, height // 8, width // 8)
    seen = {}

    def step(flow, t, latents, **_):
        seen[int(t)] = flow
        return (latents,)

    monkeypatch.setattr(pipeline.scheduler, "step", step)
    pipeline(PROMPT, NEGATIVE, height, width, frames, 2, guidance_scale=6.0, latents=noisy, output_type="latent")
    assert len(seen) == 2
    both = prior.encode_prompt([NEGATIVE, PROMPT])
    for t, truth in seen.items():
        sigma = t / 1000
        n = math.hypot(1 - sigma, sigma)
        ours = noisy.transpose(1, 2) / n
        v_negative, v_text = prior.predict_v(ours, t, both).split(1)
        flow = (v_negative + 6.0 * (v_text - v_negative) - (1 - 2 * sigma) * ours) / n
        assert flow.shape == truth.transpose(1, 2).shape
        torch.testing.assert_close(flow.transpose(1, 2), truth, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("t", [20, 300, 740, 980, 999])
def test_the_guess_of_the_clean_latents_is_that_of_diffusers_euler_step(prior, pipeline, t):
    """One step of its scheduler for rectified flows, from the sigma of t to 0; ours is a x_t - s v, a of `alphas_cumprod`."""
    from diffusers import FlowMatchEulerDiscreteScheduler

    scheduler = FlowMatchEulerDiscreteScheduler()
    scheduler.set_timesteps(sigmas=[t / 1000])
    assert scheduler.timesteps.tolist() == pytest.approx([t])
    text, clean, noise = prior.encode_prompt([PROMPT]), random(1, 3, 4, 4, 6), random(1, 3, 4, 4, 6, seed=1)
    theirs = scheduler.scale_noise(clean, scheduler.timesteps, noise).transpose(1, 2)
    flow = pipeline.transformer(theirs, torch.tensor([t]), text, return_dict=False)[0]
    truth = scheduler.step(flow, scheduler.timesteps[0], theirs)[0].transpose(1, 2)
    a, s = prior.alphas_cumprod[t].sqrt(), (1 - prior.alphas_cumprod[t]).sqrt()
    noisy = (a * clean + s * noise).float()
    torch.testing.assert_close((a * noisy - s * prior.predict_v(noisy, t, text)).float(), truth, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shift", [1.0, 3.0, 12.0])
def test_alpha_bar_of_a_timestep_is_that_of_diffusers_schedule_whatever_its_shift(prior, shift):
    """Its timesteps are 1000 sigma, rounded down."""
    scheduler = tiny_wan(flow_shift=shift).scheduler
    scheduler.set_timesteps(50)
    assert prior.alphas_cumprod.shape == (1000,) and prior.alphas_cumprod.dtype == torch.float64
    for t, sigma in zip(scheduler.timesteps.tolist(), scheduler.sigmas[:-1].tolist(), strict=True):
        a, s = prior.alphas_cumprod[t].sqrt(), (1 - prior.alphas_cumprod[t]).sqrt()
        assert float(s / (a + s)) == pytest.approx(t / 1000, abs=1e-12)
        assert 0 <= sigma - float(s / (a + s)) < 1e-3 + 1e-6


def test_alpha_bar_ends_at_a_thousandth_of_signal_and_follows_the_length_of_the_schedule(prior, tiny):
    assert prior.alphas_cumprod[0] == 1 and prior.alphas_cumprod[500] == pytest.approx(0.5, abs=1e-12)
    assert float(prior.alphas_cumprod[999].sqrt()) == pytest.approx(0.001, rel=2e-3)
    assert (prior.alphas_cumprod.diff() < 0).all()
    other = WanPrior(tiny, prior.transformer, prior.vae, 500, 9)
    assert other.alphas_cumprod.shape == (500,) and other.alphas_cumprod[250] == pytest.approx(0.5, abs=1e-12)


@pytest.mark.parametrize("sigma", [0.001, 0.02, 0.3, 0.5, 0.74, 0.98, 0.999, 1.0])
def test_velocity_of_gaussian_data_is_the_best_guess_in_closed_form(sigma):
    """Data of mean m and variance q: the best guesses of eps - x0 from y and of v from x_t are regressions on one number."""
    m, q = 0.7, 2.3
    ab = float(alpha_bar(torch.tensor(sigma, dtype=torch.float64)))
    a, s = math.sqrt(ab), math.sqrt(1 - ab)
    x_t = torch.linspace(-4, 4, 33, dtype=torch.float64)[None]
    y = x_t * (1 - sigma) / a if a > 0.5 else x_t * sigma / s
    flow = -m + (sigma - (1 - sigma) * q) / ((1 - sigma) ** 2 * q + sigma**2) * (y - (1 - sigma) * m)
    truth = -s * m + a * s * (1 - q) / (a * a * q + s * s) * (x_t - a * m)
    found = v_from_flow(flow, x_t, sigma)
    assert torch.isfinite(found).all()
    torch.testing.assert_close(found, truth, rtol=1e-6, atol=1e-6)


def test_latents_are_the_normalized_mean_of_diffusers_vae_and_remember_no_other_clip(prior, pipeline):
    clip = random_clip()
    latents = prior.encode(clip)
    assert latents.shape == (1, 3, 4, 4, 6) and latents.dtype == torch.float32
    prior.encode(random_clip(17, seed=1))
    prior.decode(latents)
    prior.encode(random_clip(5, 64, 32, seed=2).requires_grad_()).sum().backward()
    assert torch.equal(prior.encode(clip), latents)
    config = pipeline.vae.config
    mean, spread = (torch.tensor(config[key]).reshape(1, 4, 1, 1, 1) for key in ("latents_mean", "latents_std"))
    with torch.no_grad():
        posterior = pipeline.vae.encode((2 * clip - 1).permute(1, 0, 2, 3)[None]).latent_dist
    torch.testing.assert_close(latents, ((posterior.mean - mean) / spread).permute(0, 2, 1, 3, 4), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("checkpointing", [False, True])
def test_gradient_of_the_latents_is_the_central_difference(tiny, exact, checkpointing):
    """The differences are those of diffusers' VAE in float64, along a random direction."""
    prior = WanPrior.load(tiny, dtype=torch.float64, frames=9, checkpointing=checkpointing)
    clip, along, weights = random_clip().double(), random(9, 3, 32, 48, seed=4).double(), random(1, 3, 4, 4, 6, seed=5).double()
    (gradient,) = torch.autograd.grad(prior.encode(pixels := clip.clone().requires_grad_()), pixels, weights.float())
    spread = torch.tensor(exact.vae.config.latents_std, dtype=torch.float64).reshape(1, 4, 1, 1, 1)

    def weighted(frames):
        with torch.no_grad():
            mean = exact.vae.encode((2 * frames - 1).permute(1, 0, 2, 3)[None]).latent_dist.mean
        return float((weights.transpose(1, 2) * mean / spread).sum())

    truth = (weighted(clip + 1e-5 * along) - weighted(clip - 1e-5 * along)) / 2e-5
    assert float((gradient * along).sum()) == pytest.approx(truth, rel=1e-5)
    assert (gradient.flatten(1).norm(dim=1) > 0).all()


def test_checkpointing_changes_memory_not_gradients(tiny, prior):
    clip, thrifty = random_clip(), WanPrior.load(tiny, frames=9, checkpointing=True)
    gradients, kept = zip(*(there_and_back(which, clip) for which in (prior, thrifty)), strict=True)
    assert torch.equal(gradients[0], gradients[1])
    assert kept[1] < 0.5 * kept[0]


def test_a_decoded_clip_is_what_diffusers_pipeline_makes_of_the_latents(prior, pipeline, monkeypatch):
    clip, latents = random_clip(), prior.encode(random_clip())
    found = prior.decode(latents)
    assert found.shape == clip.shape and found.dtype == torch.float32 and found.min() >= 0 and found.max() <= 1
    monkeypatch.setattr(pipeline.scheduler, "step", lambda flow, t, latents, **_: (latents,))
    made = pipeline(PROMPT, None, 32, 48, 9, 1, guidance_scale=1.0, latents=latents.transpose(1, 2), output_type="pt").frames[0]
    torch.testing.assert_close(found, made, rtol=1e-4, atol=1e-5)


def test_embeddings_are_those_of_the_pipeline_and_the_text_encoder_is_not_loaded_again(tiny, pipeline, monkeypatch, tmp_path):
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path))
    texts = [PROMPT, NEGATIVE, "", "  snow   is\nfalling &amp;amp; in a garden "]
    found = WanPrior.load(tiny).encode_prompt(texts)
    truth, _ = pipeline.encode_prompt(texts, do_classifier_free_guidance=False, max_sequence_length=512)
    assert found.shape == (4, 512, 16) and (found[1, :3].abs().sum(dim=1) > 0).all() and not found[1, 3:].any()
    torch.testing.assert_close(found, truth, rtol=1e-5, atol=1e-6)
    monkeypatch.setattr("transformers.UMT5EncoderModel.from_pretrained", lambda *_, **__: pytest.fail("loaded again"))
    assert torch.equal(WanPrior.load(tiny).encode_prompt([NEGATIVE, f" {PROMPT}"]), found[[1, 0]])


@pytest.mark.parametrize(
    "text", [PROMPT, " rain,\t\n heavy  ", "a &quot;white&quot; garden &amp;lt;3", "Schnee fällt — überall, 35 °C", ""]
)
def test_texts_are_cleaned_as_diffusers_does(text):
    from diffusers.pipelines.wan.pipeline_wan import prompt_clean

    assert cleaned(text) == prompt_clean(text)


def test_ftfy_repairs_texts_where_it_is_installed(monkeypatch, tmp_path):
    (tmp_path / "ftfy.py").write_text("def fix_text(text):\n    return text.replace('Ã¼', 'ü')\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert cleaned("Ã¼ber  all") == "über all"


def test_one_text_alone_is_refused(prior):
    with pytest.raises(TypeError, match="list of texts"):
        prior.encode_prompt(PROMPT)


@pytest.mark.parametrize("checkpointing", [False, True])
def test_distillation_of_a_clip_gives_a_finite_gradient(tiny, checkpointing):
    prior, clip = WanPrior.load(tiny, frames=9, checkpointing=checkpointing), random_clip()
    text, negative = prior.encode_prompt([PROMPT, NEGATIVE]).split(1)
    for timestep in (20, 999):
        rng = torch.Generator().manual_seed(0)
        found = distill_clip(prior, clip, text, negative, timestep, config=DistillationConfig(), generator=rng)
        assert found.gradient.shape == clip.shape and torch.isfinite(found.gradient).all() and found.loss > 0
        assert (found.gradient.flatten(1).norm(dim=1) > 0).all()


def test_half_precision_keeps_what_diffusers_keeps_wide_and_the_vae_in_float32(tiny, prior):
    half = WanPrior.load(tiny, dtype=torch.bfloat16)
    assert half.dtype == torch.bfloat16 and {p.dtype for p in half.vae.parameters()} == {torch.float32}
    wide = {name for name, p in half.transformer.named_parameters() if p.dtype == torch.float32}
    assert wide == {
        name
        for name, _ in half.transformer.named_parameters()
        if any(kept in name for kept in ("scale_shift_table", "time_embedder", ".norm2."))
    }
    assert torch.equal(half.transformer.scale_shift_table, prior.transformer.scale_shift_table)
    noisy, text = random(1, 3, 4, 4, 6), prior.encode_prompt([PROMPT])
    found, truth = half.predict_v(noisy, 500, text), prior.predict_v(noisy, 500, text)
    assert found.dtype == torch.float32 and float((found - truth).norm() / truth.norm()) < 0.02
    assert half.encode_prompt([PROMPT]).dtype == torch.bfloat16 and half.encode(random_clip()).dtype == torch.float32


def test_no_weight_ever_gets_a_gradient(prior):
    assert not any(p.requires_grad for model in (prior.transformer, prior.vae) for p in model.parameters())
    assert not prior.predict_v(random(1, 3, 4, 4, 6).requires_grad_(), 10, prior.encode_prompt([PROMPT])).requires_grad


def test_clip_shape_is_the_published_one_or_as_many_frames_as_asked(tiny, prior):
    assert prior.clip_shape == (9, 480, 832) and WanPrior.load(tiny).clip_shape == (81, 480, 832)
    with pytest.raises(ValueError, match=r"4k \+ 1 frames, found 10; use 9 or 13"):
        WanPrior.load(tiny, frames=10)


@pytest.mark.mistyped
@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((8, 3, 32, 48), r"4k \+ 1 frames, found 8; use 5 or 9"),
        ((9, 3, 40, 48), "multiples of 16 .* found 40x48"),
        ((9, 3, 32, 56), "multiples of 16 .* found 32x56"),
        ((9, 4, 32, 48), r"\[frames, 3, height, width\], found \[9, 4, 32, 48\]"),
    ],
)
def test_a_clip_of_the_wrong_shape_is_refused(prior, shape, message):
    with pytest.raises(ValueError, match=message):
        prior.encode(torch.rand(*shape))


def test_the_tiny_encoder_of_cogvideox_is_refused(prior):
    with pytest.raises(PriorError, match=r"taecvx gives latents of CogVideoX, but .* is a Wan model; leave the tiny VAE out"):
        prior.through(TinyEncoder())


@pytest.mark.parametrize(
    ("file", "changes", "message"),
    [
        ("vae/config.json", {"_class_name": "AutoencoderKL"}, "must hold a AutoencoderKLWan, found AutoencoderKL; use a Wan"),
        (
            "transformer/config.json",
            {"in_channels": 36},
            "takes 36 channels where its VAE makes 4: an image-to-video model; use",
        ),
        (
            "scheduler/scheduler_config.json",
            {"prediction_type": "epsilon"},
            "the prediction_type flow_prediction, .* found epsilon",
        ),
    ],
)
def test_another_kind_of_model_is_refused(broken, file, changes, message):
    rewrite(broken / file, **changes)
    with pytest.raises(PriorError, match=message):
        WanPrior.load(broken)


def test_missing_parts_and_damaged_weights_are_named(broken):
    (broken / "transformer_2").mkdir()
    with pytest.raises(PriorError, match=r"between two transformers, as Wan 2\.2 does, where one is expected; use a Wan 2\.1"):
        WanPrior.load(broken)
    (broken / "transformer_2").rmdir()
    weights = broken / "transformer" / "diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(PriorError, match="could not be loaded"):
        WanPrior.load(broken)
    weights.unlink()
    with pytest.raises(PriorError, match=r"transformer holds no \*\.safetensors weights; download"):
        WanPrior.load(broken)
    shutil.rmtree(broken / "vae")
    with pytest.raises(PriorError, match="is not a diffusers Wan folder: it lacks vae; such a folder holds transformer, vae"):
        WanPrior.load(broken)
    with pytest.raises(PriorError, match="there is no local folder /no/such/prior"):
        WanPrior.load("/no/such/prior")


def test_weights_in_several_files_are_read_and_a_missing_one_is_told(pipeline, broken, prior):
    shutil.rmtree(broken / "transformer")
    pipeline.transformer.save_pretrained(broken / "transformer", max_shard_size="40KB")
    shards = sorted((broken / "transformer").glob("*.safetensors"))
    assert len(shards) > 1
    stored = WanPrior.load(broken).transformer.state_dict()
    assert all(torch.equal(stored[name], weight) for name, weight in prior.transformer.state_dict().items())
    shards[0].unlink()
    with pytest.raises(
        PriorError,
        match=r"must hold the \d+ weights of its configuration, found \d+ missing and 0 unknown, first \S+; download",
    ):
        WanPrior.load(broken)


def test_a_euler_scheduler_serves_as_well(broken):
    from diffusers import FlowMatchEulerDiscreteScheduler

    (broken / "scheduler" / "scheduler_config.json").unlink()
    FlowMatchEulerDiscreteScheduler(shift=3.0).save_pretrained(broken / "scheduler")
    assert WanPrior.load(broken).alphas_cumprod.shape == (1000,)


@pytest.mark.skipif(torch.cuda.is_available(), reason="only where there is no CUDA device")
def test_cuda_is_refused_where_there_is_none(tiny):
    with pytest.raises(PriorError, match="no CUDA device was found; use the device cpu"):
        WanPrior.load(tiny, "cuda")
