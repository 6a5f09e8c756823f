"""Score distillation against the textbook expression, against autograd, and against a prior whose score is known exactly."""

import math
from typing import Any

import pytest
import torch

from pgsd_nerfstudio.guidance import DistillationConfig, TimestepSchedule, distill, distill_clip, load_prior
from pgsd_nerfstudio.laboratory.tiny_cogvideox import scheduler_2b, write_tiny

SHAPE = (1, 3, 4, 5, 6)
TEXT, NEGATIVE = torch.ones(1, 2, 2), torch.zeros(1, 2, 2)


class Prior:
    """The exact denoiser of Gaussian data: deviation `sigma`, mean `mean` times the text (nothing for the negative one)."""

    def __init__(self, mean: float = 0.0, sigma: float = 1.0):
        self.alphas_cumprod, self.mean, self.sigma = scheduler_2b().alphas_cumprod, mean, sigma

    def predict_v(self, noisy, timestep, text_embeddings):
        ab = self.alphas_cumprod[timestep]
        a, s = ab.sqrt(), (1 - ab).sqrt()
        mean = self.mean * text_embeddings.mean(dim=(1, 2)).reshape(-1, 1, 1, 1, 1)
        x0 = mean + a * self.sigma**2 / (ab * self.sigma**2 + 1 - ab) * (noisy.double() - a * mean)
        eps = (noisy.double() - a * x0) / s
        return (a * eps - s * x0).float()


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def explicit(prior, latents, timestep, scale, seed):
    """eps, eps_hat, x0, x0_hat with divisions and all, in float64."""
    ab = prior.alphas_cumprod[timestep]
    a, s = ab.sqrt(), (1 - ab).sqrt()
    eps, x0 = torch.randn(latents.shape, generator=seeded(seed)).double(), latents.double()
    x_t = a * x0 + s * eps
    v_negative, v_text = prior.predict_v(x_t.expand(2, *SHAPE[1:]), timestep, torch.cat([NEGATIVE, TEXT])).double().split(1)
    v_hat = v_negative + scale * (v_text - v_negative)
    x0_hat = a * x_t - s * v_hat
    return eps, (x_t - a * x0_hat) / s, x0, x0_hat, 1 - ab


@pytest.mark.parametrize("timestep", [20, 300, 740, 980])
@pytest.mark.parametrize("omega", ["sds", "paper_code"])
def test_v_form_is_the_textbook_gradient(timestep, omega):
    prior, latents = Prior(mean=0.4), torch.randn(SHAPE, generator=seeded(5))
    eps, eps_hat, x0, x0_hat, weight = explicit(prior, latents, timestep, 7.0, seed=3)
    truth = weight * (eps_hat - eps if omega == "sds" else x0 - x0_hat)
    config = DistillationConfig(guidance_scale=7.0, omega=omega, max_rms=math.inf)
    found = distill(prior, latents, TEXT, NEGATIVE, timestep, config=config, generator=seeded(3))
    torch.testing.assert_close(found.gradient.double(), truth, rtol=1e-3, atol=1e-5 * float(truth.abs().max()))
    assert found.timestep == timestep


@pytest.mark.parametrize(("timestep", "ratio"), [(20, 0.24), (740, 9.0), (980, 202.0)])
def test_the_two_omegas_differ_by_the_known_ratio(timestep, ratio):
    prior, latents = Prior(mean=0.4), torch.randn(SHAPE)
    sizes = {}
    for omega in ("sds", "paper_code"):
        config = DistillationConfig(guidance_scale=1.0, omega=omega, max_rms=math.inf)
        sizes[omega] = distill(prior, latents, TEXT, NEGATIVE, timestep, config=config, generator=seeded()).gradient.norm()
    assert float(sizes["paper_code"] / sizes["sds"]) == pytest.approx(ratio, rel=0.03)


def test_last_timestep_is_pure_noise_and_finite():
    for omega, empty in (("sds", True), ("paper_code", False)):
        config = DistillationConfig(omega=omega)  # type: ignore[arg-type]
        found = distill(Prior(mean=0.4), torch.randn(SHAPE), TEXT, NEGATIVE, 999, config=config, generator=seeded())
        assert torch.isfinite(found.gradient).all() and (found.loss == 0.0) == empty


def test_guidance_of_the_papers_code_is_one_scale_further():
    """v_text + s (v_text - v_neg) = v_neg + (s + 1)(v_text - v_neg)."""
    prior, latents = Prior(mean=0.4), torch.randn(SHAPE)
    noisy = latents.expand(2, *SHAPE[1:])
    v_negative, v_text = prior.predict_v(noisy, 400, torch.cat([NEGATIVE, TEXT])).split(1)
    torch.testing.assert_close(
        v_text + 100 * (v_text - v_negative), v_negative + 101 * (v_text - v_negative), rtol=1e-3, atol=1e-3
    )


def test_gradient_is_that_of_the_loss_for_a_target_held_fixed():
    """The paper's code: 1/2 |z - stop_gradient(z - g)|^2 / frames, g = omega (eps_hat - eps)."""
    latents = torch.randn(SHAPE, requires_grad=True)
    whole, found = (
        distill(Prior(0.4), latents, TEXT, NEGATIVE, 300, config=DistillationConfig(), generator=seeded(), frames=frames)
        for frames in (1, 9)
    )
    loss = 0.5 * (latents - (latents - whole.gradient).detach()).square().sum() / 9
    (gradient,) = torch.autograd.grad(loss, latents)
    torch.testing.assert_close(found.gradient, gradient, rtol=1e-5, atol=1e-5)
    assert found.loss == pytest.approx(float(loss.detach()), rel=1e-5) and found.loss > 0


def test_gradient_is_bounded_and_keeps_its_direction():
    free, bound = (
        distill(
            Prior(5.0), torch.randn(SHAPE, generator=seeded(1)), TEXT, NEGATIVE, 300,
            config=DistillationConfig(max_rms=rms), generator=seeded(),
        ).gradient
        for rms in (math.inf, 2.0)
    )  # fmt: skip
    assert free.square().mean().sqrt() > 10
    assert float(bound.square().mean().sqrt()) == pytest.approx(2.0, rel=1e-4)
    torch.testing.assert_close(bound / bound.norm(), free / free.norm())


def test_nan_names_the_timestep():
    with pytest.raises(FloatingPointError, match="at timestep 321 has 360 NaN or infinite values"):
        distill(Prior(mean=math.nan), torch.randn(SHAPE), TEXT, NEGATIVE, 321, config=DistillationConfig(), generator=seeded())


class HalfPrior:
    """Predictions as a model in half precision gives them, up to 1000 in size and opposite for the two texts."""

    def __init__(self, worst: float = 1e3):
        self.alphas_cumprod, self.worst = scheduler_2b().alphas_cumprod, worst

    def predict_v(self, noisy, timestep, text_embeddings):
        v = torch.linspace(-1e3, 1e3, noisy[:1].numel()).reshape(SHAPE)
        v[..., 0] = self.worst
        return torch.cat([-v, v]).half()


@pytest.mark.parametrize("omega", ["sds", "paper_code"])
def test_a_guidance_scale_of_100_does_not_overflow_half_precision(omega):
    """100 * 2000 lies beyond 65504, the largest number of float16."""
    prior, latents, timestep = HalfPrior(), torch.randn(SHAPE, generator=seeded(1)), 300
    config = DistillationConfig(omega=omega, max_rms=math.inf)
    found = distill(prior, latents, TEXT, NEGATIVE, timestep, config=config, generator=seeded())
    eps, eps_hat, x0, x0_hat, weight = explicit(prior, latents, timestep, 100.0, seed=0)
    truth = weight * (eps_hat - eps if omega == "sds" else x0 - x0_hat)
    assert found.gradient.dtype == torch.float32
    assert float((found.gradient - truth).norm() / truth.norm()) < 1e-5


@pytest.mark.parametrize("worst", [math.inf, math.nan])
def test_an_overflow_within_the_prior_is_no_gradient(worst):
    with pytest.raises(FloatingPointError, match="at timestep 300 has 60 NaN or infinite values"):
        distill(HalfPrior(worst), torch.randn(SHAPE), TEXT, NEGATIVE, 300, config=DistillationConfig(), generator=seeded())


def test_infinity_is_found_even_where_its_weight_is_zero():
    """At t = 999 the weight of sds is 0."""
    with pytest.raises(FloatingPointError, match="at timestep 999"):
        distill(HalfPrior(math.inf), torch.randn(SHAPE), TEXT, NEGATIVE, 999, config=DistillationConfig(), generator=seeded())


def test_two_embeddings_are_a_mapping_of_two_roles():
    latents, config = torch.randn(SHAPE), DistillationConfig()
    two = distill(Prior(0.4), latents, TEXT, NEGATIVE, 300, config=config, generator=seeded())
    by_role: Any = {"negative": NEGATIVE, "text": TEXT}
    one = distill(Prior(0.4), latents, by_role, None, 300, config=config, generator=seeded())
    assert torch.equal(two.gradient, one.gradient) and two.loss == one.loss


def test_same_seed_same_gradient():
    latents = torch.randn(SHAPE)
    a, b, c = (
        distill(Prior(0.4), latents, TEXT, NEGATIVE, 300, config=DistillationConfig(), generator=seeded(s)).gradient
        for s in (0, 0, 1)
    )
    assert torch.equal(a, b) and not torch.equal(a, c)


def test_descent_finds_the_mode_of_a_gaussian_prior():
    """SDS is mode seeking: latents drawn anywhere go to the mean of the data, under the annealed timesteps of the paper."""
    prior, schedule, rng = Prior(mean=0.7, sigma=0.3), TimestepSchedule(), seeded(2)
    latents = torch.randn(SHAPE, generator=rng) * 2 - 3
    config = DistillationConfig(guidance_scale=1.0)
    total = torch.zeros(SHAPE)
    for step in range(1500):
        timestep = schedule.sample(step, 1500, rng)
        latents = latents - 0.03 * distill(prior, latents, TEXT, NEGATIVE, timestep, config=config, generator=rng).gradient
        total += latents * (step >= 1000)
    assert float((total / 500 - 0.7).abs().max()) < 0.1


def test_guidance_leads_away_from_the_negative_prompt():
    """Where text and negative prompt want 0.7 and 0, a guidance scale of 3 leads beyond 0.7."""
    prior, rng = Prior(mean=0.7), seeded(2)
    latents = torch.zeros(SHAPE)
    for _ in range(600):
        config = DistillationConfig(guidance_scale=3.0)
        latents = latents - 0.03 * distill(prior, latents, TEXT, NEGATIVE, 300, config=config, generator=rng).gradient
    assert float(latents.mean()) == pytest.approx(3 * 0.7, rel=0.1)


def test_gradient_on_the_clip_is_autograd_of_the_explicit_expression(tmp_path):
    """d/d clip of sum(stop_gradient(g) * latents(clip)), and of 1/2 |z - stop_gradient(z - g)|^2, g the gradient per frame."""
    prior = load_prior(write_tiny(tmp_path / "prior"))
    text, negative = prior.encode_prompt(["snow is falling", "no snow"]).split(1)
    config, clip = DistillationConfig(), torch.rand(9, 3, 32, 48, generator=seeded(4))
    found = distill_clip(prior, clip, text, negative, 400, config=config, generator=seeded(6))
    pixels = clip.clone().requires_grad_()
    latents = prior.encode(pixels)
    on_latents = distill(prior, latents, text, negative, 400, config=config, generator=seeded(6), frames=9)
    assert found.loss == pytest.approx(on_latents.loss) and found.loss > 0
    (linear,) = torch.autograd.grad((on_latents.gradient * latents).sum(), pixels, retain_graph=True)
    rest = latents - (latents - on_latents.gradient).detach()
    (quadratic,) = torch.autograd.grad(0.5 * rest.square().sum(), pixels, retain_graph=True)
    explicit_loss = (_noise_difference(prior, latents, text, negative, 400, seed=6).detach() * latents).sum() / 9
    (textbook,) = torch.autograd.grad(explicit_loss, pixels, retain_graph=True)
    free = distill_clip(prior, clip, text, negative, 400, config=DistillationConfig(max_rms=math.inf), generator=seeded(6))
    assert float((free.gradient - textbook).norm() / textbook.norm()) < 1e-4
    for truth in (linear, quadratic):
        assert float((found.gradient - truth).norm() / truth.norm()) < 1e-4
    assert clip.grad is None and found.gradient.shape == clip.shape


def _noise_difference(prior, latents, text, negative, timestep, seed):
    """w(t) (eps_hat - eps) in float64, with the noise from v by way of x0_hat and a division."""
    ab, x0 = prior.alphas_cumprod[timestep], latents.detach().double()
    a, s = ab.sqrt(), (1 - ab).sqrt()
    eps = torch.randn(x0.shape, generator=seeded(seed)).double()
    x_t = a * x0 + s * eps
    v = prior.predict_v(x_t.float(), timestep, torch.cat([negative, text])).double()
    e_negative, e_text = ((x_t - a * (a * x_t - s * v)) / s).split(1)
    return (1 - ab) * (e_negative + 100.0 * (e_text - e_negative) - eps)


def test_a_bound_that_is_none_is_refused():
    with pytest.raises(ValueError, match="max_rms must be positive, got 0"):
        DistillationConfig(max_rms=0.0)
