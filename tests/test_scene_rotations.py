"""Rotations against RoMa, and where it is delicate."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
import roma
import torch

from pgsd_nerfstudio.scene import rotations


def turns(n: int = 500) -> torch.Tensor:
    """Rotation vectors from tiny ones to half turns, and quarter turns about the axes."""
    generator = torch.Generator().manual_seed(0)
    axes = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1)
    angles = torch.cat([torch.logspace(-9, 0, n // 2), torch.linspace(0.0, math.pi - 1e-6, n - n // 2)]).double()
    return torch.cat([axes * angles[:, None], 0.5 * math.pi * torch.eye(3), -0.999 * math.pi * torch.eye(3)]).double()


@pytest.mark.parametrize(
    "name", ["rotvec_to_unitquat", "rotvec_to_rotmat", "rotmat_to_unitquat", "unitquat_to_rotvec", "unitquat_to_rotmat"]
)
def test_each_form_is_made_of_each_other_as_by_roma(name):
    vectors, source = turns(), name.split("_to_")[0]
    given = {"rotvec": vectors, "unitquat": roma.rotvec_to_unitquat(vectors), "rotmat": roma.rotvec_to_rotmat(vectors)}[source]
    found, expected = getattr(rotations, name)(given), getattr(roma, name)(given)
    # Roma takes small angles to first order in rotvec_to_rotmat.
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-9)


def test_products_inverses_and_orders_are_those_of_roma():
    p, q = roma.rotvec_to_unitquat(turns()), roma.rotvec_to_unitquat(turns().flip(0))
    torch.testing.assert_close(rotations.quat_product(p, q), roma.quat_product(p, q))
    torch.testing.assert_close(rotations.quat_product(p[:1], q), roma.quat_product(p[:1].expand_as(q), q))
    torch.testing.assert_close(rotations.quat_conjugation(p), roma.quat_conjugation(p))
    torch.testing.assert_close(rotations.quat_normalize(3 * p), p)
    assert torch.equal(rotations.quat_wxyz_to_xyzw(p), roma.quat_wxyz_to_xyzw(p))
    assert torch.equal(rotations.quat_xyzw_to_wxyz(p), roma.quat_xyzw_to_wxyz(p))
    matrices = roma.unitquat_to_rotmat(p), roma.unitquat_to_rotmat(q)
    torch.testing.assert_close(
        rotations.rotmat_geodesic_distance(*matrices), roma.rotmat_geodesic_distance(*matrices), atol=1e-7, rtol=0
    )


@pytest.mark.parametrize("second", [0, 7, 251, 400, 501])
def test_arcs_are_those_of_roma(second):
    quats, steps = roma.rotvec_to_unitquat(turns()), torch.linspace(0, 1, 7, dtype=torch.float64)
    for first, other in ((quats[100], quats[second]), (quats[100], -quats[second])):
        expected = roma.unitquat_slerp(first, other, steps, shortest_arc=True)
        torch.testing.assert_close(rotations.unitquat_slerp(first, other, steps), expected, atol=1e-9, rtol=0)


def test_no_turn_changes_no_bit_and_has_finite_gradients():
    q = roma.rotvec_to_unitquat(turns()).float()
    still = torch.zeros(len(q), 3, requires_grad=True)
    turned = rotations.quat_product(q, rotations.rotvec_to_unitquat(still))
    assert torch.equal(turned, q)
    (gradient,) = torch.autograd.grad(turned.sum(), still)
    assert torch.isfinite(gradient).all() and gradient.any()
    back = rotations.unitquat_to_rotvec(rotations.rotvec_to_unitquat(still))
    (gradient,) = torch.autograd.grad(back.sum(), still)
    torch.testing.assert_close(gradient, torch.ones_like(gradient))


def test_a_command_starts_without_torchs_compiler():
    """It would take seconds of every command; torch._dynamo comes with RoMa."""
    code = "import sys, pgsd_nerfstudio.weather.making, pgsd_nerfstudio.cli.preview; print('torch._dynamo' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"
