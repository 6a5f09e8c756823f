"""The kernel of view-dependent colours against scene.spherical_harmonics in float64."""

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.rendering.harmonics import color
from pgsd_nerfstudio.rendering.projection import BLUE, COLUMNS, LEFT, RED, RIGHT
from pgsd_nerfstudio.scene.spherical_harmonics import view_colors


def _case(coefficients: int, count: int = 400) -> tuple[torch.Tensor, torch.Tensor, np.ndarray, np.ndarray]:
    rng = torch.Generator().manual_seed(coefficients)
    colors = torch.randn(count, coefficients, 3, generator=rng)
    means = 4 * torch.randn(count, 3, generator=rng)
    turned, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turned, (0.3, -1.0, 2.0)
    splats = np.zeros((count, COLUMNS), np.float32)
    splats[:, RIGHT] = torch.arange(count) % 3  # every third touches no pixel
    return colors, means, viewmat, splats


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_colours_are_those_of_the_harmonics(degree: int) -> None:
    colors, means, viewmat, splats = _case((degree + 1) ** 2)
    color(colors.numpy(), means.numpy(), viewmat, splats)
    expected = view_colors(colors.double(), means.double(), torch.from_numpy(viewmat)).numpy()
    shown = splats[:, LEFT] < splats[:, RIGHT]
    assert 0 < shown.sum() < len(shown)
    assert np.abs(splats[shown, RED : BLUE + 1] - expected[shown]).max() < 2e-6
    assert not splats[~shown, RED : BLUE + 1].any()


def test_plain_colours_stay_as_they_are() -> None:
    _, means, viewmat, splats = _case(1)
    plain = torch.rand(len(means), 3)
    color(plain.numpy(), means.numpy(), viewmat, splats)
    assert (splats[:, RED : BLUE + 1] == plain.numpy()).all()


def test_other_numbers_of_coefficients_are_refused() -> None:
    colors, means, viewmat, splats = _case(5)
    with pytest.raises(ValueError, match="found 5"):
        color(colors.numpy(), means.numpy(), viewmat, splats)
