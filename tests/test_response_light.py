"""Wet and tinted colours against Fresnel's equations, an inverse, and invariants."""

import math

import pytest
import torch

from pgsd_nerfstudio.rendering.display import encoded, linear
from pgsd_nerfstudio.response.light import (  # fmt: skip
    leafy,
    luminance,
    mirrored,
    saturated,
    similarity,
    thick_albedo,
    wetted,
)


def test_similarity_inverts_the_albedo_of_a_thick_medium():
    albedo = torch.linspace(0, 1, 101, dtype=torch.float64)
    assert torch.allclose(thick_albedo(similarity(albedo)), albedo, atol=1e-12)
    assert similarity(torch.tensor([1.0, 0.0], dtype=torch.float64)).tolist() == pytest.approx([0.0, 1.0], abs=1e-12)


def test_wet_is_darker_but_black_stays_black_and_white_white():
    grey = torch.linspace(0, 1, 21)[:, None].expand(-1, 3)
    wet = wetted(grey)
    assert (wet[1:-1] < grey[1:-1]).all() and wet[0].max() == 0 and wet[-1].min() == pytest.approx(1.0, abs=1e-5)
    # Sand and soils of albedo 0.3 fall to 0.11-0.18 (Twomey et al. 1986, figure 6: theory and measurements).
    assert 0.10 < float(wetted(torch.full((1, 3), 0.3)).mean()) < 0.18


def fresnel(degrees: float) -> float:
    """Unpolarised reflectance from air to water by the angles of incidence and refraction (Born & Wolf, eq. 1.5.21)."""
    if degrees == 0:
        return 0.0200577
    i = math.radians(degrees)
    t = math.asin(math.sin(i) / 1.33)
    return 0.5 * ((math.sin(i - t) / math.sin(i + t)) ** 2 + (math.tan(i - t) / math.tan(i + t)) ** 2)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0, 60.0, 75.0, 85.0])
def test_the_mirror_follows_fresnel(degrees: float):
    cosine = math.cos(math.radians(degrees))
    assert float(mirrored(torch.tensor([cosine]))) == pytest.approx(fresnel(degrees), rel=1e-3)
    assert float(mirrored(torch.tensor([-0.5]))) == pytest.approx(1.0)  # never more than all of it


def test_saturation_keeps_luminance():
    light = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(luminance(saturated(light, 0.4)), luminance(light), atol=1e-6)
    assert torch.equal(saturated(light, 1.0) > 0, light > 0)
    grey = saturated(light, 0.0)
    assert (grey.amax(1) - grey.amin(1)).max() < 1e-6


def test_encoding_inverts():
    rgb = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(encoded(linear(rgb)), rgb, atol=1e-5)
    assert torch.isfinite(encoded(linear(torch.tensor([[-0.2, 0.0, 1.7]])))).all()


def test_leaves_are_told_from_stone():
    assert leafy(linear(torch.tensor([[0.25, 0.45, 0.15], [0.5, 0.5, 0.48], [0.6, 0.4, 0.3], [0.2, 0.4, 0.7]]))).tolist() == [
        1.0,
        0.0,
        0.0,
        0.0,
    ]
