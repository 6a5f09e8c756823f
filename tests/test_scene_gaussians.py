"""Sets of Gaussians: displacements stay with their Gaussians in every operation on a set."""

from __future__ import annotations

import pytest
import torch

from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate


def some(n: int, *, moving: bool) -> Gaussians:
    generator = torch.Generator().manual_seed(n)
    shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,), "colors": (n, 3)}
    shapes |= {"displacements": (n, 3)} if moving else {}
    return Gaussians(**{name: torch.rand(*shape, generator=generator) for name, shape in shapes.items()})


def test_what_is_not_there_stays_away():
    still = some(4, moving=False)
    assert list(still.tensors) == ["means", "quats", "scales", "opacities", "colors"]
    for made in (still.to(torch.float64), still.detach(), still.select(torch.tensor([0, 2])), concatenate([still, still])):
        assert made.displacements is None


def test_chosen_and_converted_with_the_rest():
    moving = some(5, moving=True)
    picked = moving.select(torch.tensor([3, 1]))
    assert torch.equal(picked.displacements, moving.displacements[[3, 1]])
    assert moving.to(torch.float64).displacements.dtype == torch.float64
    leaf = Gaussians(**{**moving.tensors, "displacements": moving.displacements.clone().requires_grad_()})
    assert not leaf.detach().displacements.requires_grad


def test_beside_moving_ones_the_others_stand_still():
    still, moving = some(3, moving=False), some(2, moving=True)
    joined = concatenate([still, moving])
    assert torch.equal(joined.displacements, torch.cat([torch.zeros(3, 3), moving.displacements]))
    assert torch.equal(joined.means, torch.cat([still.means, moving.means]))


@pytest.mark.mistyped
def test_displacements_of_another_number_are_refused():
    with pytest.raises(ValueError, match=r"Gaussians.displacements must have shape \(3, 3\), found \(2, 3\)"):
        Gaussians(**{**some(3, moving=False).tensors, "displacements": torch.zeros(2, 3)})


def test_large_numbers_are_no_error_and_nan_is_named():
    huge = Gaussians(**{**some(3, moving=True).tensors, "means": torch.full((3, 3), 3e38)})
    huge.check_finite()  # their sum overflows, they do not
    broken = Gaussians(**{**some(3, moving=True).tensors, "displacements": torch.tensor([[0.0, float("nan"), 1.0]] * 3)})
    with pytest.raises(ValueError, match="3 values of the Gaussians' displacements are NaN or infinite"):
        broken.check_finite()
