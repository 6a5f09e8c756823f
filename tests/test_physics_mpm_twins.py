"""Kernels of the dense regime against their plain form in double precision."""

# pyright: reportInvalidTypeForm=false

import numpy as np
import pytest
import torch
from scipy.integrate import trapezoid
from scipy.linalg import polar

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm import Elastic, Mpm, MpmConfig, Obstacle, Sand, Snow, Water
from pgsd_nerfstudio.physics.mpm.layout import ENERGY, TAU, J
from pgsd_nerfstudio.physics.mpm.materials import LAMBDA, MU

BOX = Domain((0, 0, 0), (1, 1, 1))
FLOOR = Obstacle.plane((0, 0, 0.1), (0, 0, 1))
MATTER = (Water(), Elastic(), Snow(), Sand())


def names(matter) -> str:
    return matter.name


def deformed(size: float, count: int = 60) -> np.ndarray:
    """Deformation gradients of about that strain, turned at random."""
    rng = np.random.default_rng(3)
    turn = np.stack([polar(m)[0] for m in rng.normal(size=(count, 3, 3))])
    turn *= np.sign(np.linalg.det(turn))[:, None, None]
    f = turn @ (np.eye(3) + size * rng.normal(size=(count, 3, 3)) / 3)
    return f[np.linalg.det(f) > 0.05]


def function_of(symmetric: np.ndarray, function) -> np.ndarray:
    values, axes = np.linalg.eigh(symmetric)
    return axes @ np.diag(function(values)) @ axes.T


def answer(matter, f: np.ndarray, ratio: float) -> tuple[np.ndarray, float, np.ndarray, float]:
    """Kirchhoff stress, energy density, F F^T and ratio after the return to what the matter bears, written out plainly."""
    _, _, mu, lam, *_ = matter.row()
    if isinstance(matter, Water):
        ratio = float(np.clip(ratio, *matter.volume_range))
        pressed = min(ratio, 1.0)
        grid = np.linspace(pressed, 1.0, 20001)
        energy = trapezoid(lam / 7 * (grid**-7 - 1), grid)
        return lam / 7 * (1 - pressed**-7) * pressed * np.eye(3), float(energy), f @ f.T, ratio
    if isinstance(matter, Sand):
        strain = function_of(f @ f.T, np.log) / 2 + ratio / 3 * np.eye(3)
        trace = np.trace(strain)
        if trace >= 0:
            return np.zeros((3, 3)), 0.0, np.eye(3), min(trace, matter.largest_gain)
        deviator = strain - trace / 3 * np.eye(3)
        size = np.linalg.norm(deviator)
        # On the cone |dev tau| = -tr tau * opening, with dev tau = 2 mu dev strain and tr tau = (3 lambda + 2 mu) tr strain.
        allowed = -(3 * lam + 2 * mu) * trace * matter.row()[9] / (2 * mu)
        strain = trace / 3 * np.eye(3) + deviator * min(1.0, allowed / size)
        energy = mu * (strain**2).sum() + lam / 2 * trace**2
        return 2 * mu * strain + lam * trace * np.eye(3), energy, function_of(2 * strain, np.exp), 0.0
    if isinstance(matter, Snow):
        u, values, vt = np.linalg.svd(f)
        kept = np.clip(values, 1 - matter.critical_compression, 1 + matter.critical_stretch)
        ratio = float(np.clip(ratio * values.prod() / kept.prod(), *matter.plastic_range))
        f = u @ np.diag(kept) @ vt
        mu, lam = (x * np.exp(matter.hardening * (1 - ratio)) for x in (mu, lam))
    volume, stretch = np.linalg.det(f), function_of(f @ f.T, np.sqrt)
    stress = 2 * mu * (f - polar(f)[0]) @ f.T + lam * (volume - 1) * volume * np.eye(3)
    return stress, mu * ((stretch - np.eye(3)) ** 2).sum() + lam / 2 * (volume - 1) ** 2, f @ f.T, ratio


@pytest.mark.parametrize("size", [0.0, 1e-4, 5e-3, 0.03, 0.1, 0.4], ids=lambda size: f"strain {size:g}")
@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_matter_answers_a_deformation_as_its_formulas_say(matter, size):
    """With and without principal axes: small strains take the series. Axes are found to seven digits in any case."""
    close = 1e-9 if size < 0.02 else 5e-7
    f = deformed(size)
    rng = np.random.default_rng(5)
    first = {Water: rng.uniform(0.7, 1.1, len(f)), Snow: rng.uniform(0.8, 1.2, len(f)), Sand: rng.uniform(0, 0.05, len(f))}
    ratio = first.get(type(matter), np.ones(len(f)))
    mpm = Mpm(MpmConfig(dx=0.05, precision="f64"), BOX)
    ids = mpm.emit(torch.full((len(f), 3), 0.5), torch.zeros(len(f), 3), matter, 1.0)
    rows = mpm._particles.state[: len(f)]
    rows[:, 15:24] = torch.from_numpy(f).reshape(-1, 9)
    rows[:, J] = torch.from_numpy(ratio)
    mpm._particles.respond(ids)
    now = mpm.deformations.numpy()
    stiff = matter.row()[MU] + matter.row()[LAMBDA]
    for k in range(len(f)):
        stress, energy, stretch, left = answer(matter, f[k], ratio[k])
        scale = stiff * (np.exp(10 * (1 - left)) if isinstance(matter, Snow) else 1)
        found = rows[k, TAU : TAU + 6].numpy()
        np.testing.assert_allclose(found, stress[np.triu_indices(3)], atol=close * scale)
        np.testing.assert_allclose(rows[k, ENERGY].item(), energy, atol=close * scale)
        np.testing.assert_allclose(now[k] @ now[k].T, stretch, atol=close)
        np.testing.assert_allclose(rows[k, J].item(), left, atol=close)


@pytest.mark.parametrize("matter", MATTER, ids=names)
def test_scattering_with_atomics_as_on_the_gpu_gives_the_same(matter):
    ends = []
    for atomic in (False, True):
        mpm = Mpm(MpmConfig(dx=0.05, precision="f64"), BOX, FLOOR)
        points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.2
        points += torch.tensor([0.4, 0.4, 0.12])
        mpm.emit(points, torch.tensor([0.0, 0.0, -2.0]).expand(500, 3), matter, 0.2**3 / 500)
        mpm._atomic = atomic
        mpm.step(0.02)
        ends.append(mpm.positions)
    torch.testing.assert_close(*ends, atol=1e-9, rtol=0)


def test_an_obstacle_on_a_grid_acts_like_the_analytic_one():
    axis = torch.linspace(0, 1, 41, dtype=torch.float64)
    z = torch.meshgrid(axis, axis, axis, indexing="ij")[2]
    normal = torch.zeros(*z.shape, 3, dtype=torch.float64)
    normal[..., 2] = 1
    sampled = Obstacle.from_grid(z - 0.1, normal, (0, 0, 0), 1 / 40)
    ends = []
    for obstacle in (FLOOR, sampled):
        mpm = Mpm(MpmConfig(dx=0.05, precision="f64"), BOX, obstacle)
        points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 0.2
        points += torch.tensor([0.4, 0.4, 0.12])
        mpm.emit(points, torch.tensor([0.0, 0.0, -1.0]).expand(500, 3), Snow(), 0.2**3 / 500)
        mpm.step(0.05)
        ends.append(mpm.positions)
    torch.testing.assert_close(*ends, atol=1e-6, rtol=0)


def test_singular_values_are_those_of_numpy():
    """Also of nearly the identity, whose products vanish in single precision, and of a mirrored matrix."""
    import taichi as ti

    from pgsd_nerfstudio.physics.mpm.constitutive import assembled, singular_values
    from pgsd_nerfstudio.physics.mpm.runtime import Precision, start

    @ti.kernel
    def decompose(f: ti.types.ndarray(ndim=3), out: ti.types.ndarray(ndim=2)):
        for n in range(f.shape[0]):
            m = ti.Matrix([[f[n, i, j] for j in ti.static(range(3))] for i in ti.static(range(3))])
            u, values, v = singular_values(m)
            again = assembled(u, values, v)
            for i in ti.static(range(3)):
                out[n, i] = values[i]
                for j in ti.static(range(3)):
                    out[n, 3 + 3 * i + j] = again[i, j]

    rng = np.random.default_rng(0)
    hard = np.eye(3) + np.array([[0, 1e-25, 1e-3], [0, 0, 0], [0, 0, 0]])
    flat = np.diag([1.0, 1.0, 1e-3])
    matrices = np.concatenate(
        [np.eye(3) + 0.4 * rng.normal(size=(200, 3, 3)), [np.eye(3), hard, flat, np.diag([1.0, 1.0, -0.5])]]
    )
    kinds: tuple[tuple[Precision, type, float], ...] = (("f64", np.float64, 1e-9), ("f32", np.float32, 2e-5))
    for precision, dtype, tolerance in kinds:
        start("cpu", precision)
        out = np.zeros((len(matrices), 12), dtype)
        decompose(matrices.astype(dtype), out)
        assert np.isfinite(out).all()
        values = np.sort(np.abs(out[:, :3]), 1)
        np.testing.assert_allclose(values, np.sort(np.linalg.svd(matrices)[1], 1), atol=tolerance)
        np.testing.assert_allclose(out[:, 3:].reshape(-1, 3, 3), matrices, atol=tolerance)
        assert (np.sign(out[:, :3].prod(1)) == np.sign(np.linalg.det(matrices))).all()
