"""The paper's solver against a plain twin of one substep, exact ballistic flight and the published numbers and artefacts."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.mpm.layout import C, F, V, X
from pgsd_nerfstudio.physics.paper import PAPER_EFFECTS, Box, PaperConfig, PaperSolver, paper_config, simulate_paper
from pgsd_nerfstudio.physics.paper.kernels import J
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-1.5, -1.5, 0.0), (1.5, 1.5, 3.0))
BOX = Box.of(DOMAIN)
NONE = np.zeros((0, 3))
FALLS = ("snowfall", "rainfall", "sandstorm")  # one per material


def small(effect: str, **changes) -> PaperConfig:
    """An effect in double precision on 32^3 cells, with as many particles per cell as the paper emits on 64^3."""
    config = paper_config(effect)
    fixed = {"cells": 32, "emit": config.emit // 8, "precision": "f64", "threads": 1}
    return replace(config, **{**fixed, **changes})


def floor(height: float) -> SurfaceMesh:
    corners = torch.tensor([[-2.0, -2, height], [2, -2, height], [2, 2, height], [-2, 2, height]])
    return SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))


def simulate(config: PaperConfig, *, surface: SurfaceMesh | None = None, static=NONE, frames: int = 12):
    return simulate_paper(surface or SurfaceMesh.empty(), static, config, DOMAIN, frames=frames, progress=False)


def first_emission(history):
    """Boxes [n, frames, 3] of the particles of frame 0 that are in the air all the time."""
    window = history.window(0, history.frames)
    whole = window.active.all(1)
    assert whole.sum() > 50
    return window.positions[whole].double().numpy() / history.about["metres_per_box"]


def fallen(history) -> tuple[float, float]:
    """How far the first emission fell on average, and how far it would have fallen freely; boxes."""
    paths = first_emission(history)
    seconds = 4e-3 * (history.frames - 1)
    return float((paths[:, -1] - paths[:, 0])[:, 2].mean()), -0.5 * seconds - 0.5 * 9.8 * seconds**2


# A plain twin


def deformed_cloud(config: PaperConfig, count: int = 12) -> tuple[PaperSolver, np.ndarray]:
    """Moving particles within a few cells of each other, strained and turning, among a handful of stationary ones (boxes)."""
    rng = np.random.default_rng(3)
    static = rng.uniform(0.44, 0.56, (5, 3))
    solver = PaperSolver(config, BOX, static)
    solver.emit(rng.uniform(0.46, 0.54, (count, 3)), rng.normal(size=(count, 3)))
    rows = solver.state
    rows[:, C : C + 9] = torch.from_numpy(20 * rng.normal(size=(count, 9)))
    rows[:, F : F + 9] += torch.from_numpy(0.02 * rng.normal(size=(count, 9)))
    rows[:, J] += torch.from_numpy(0.02 * rng.normal(size=count))
    if config.material == "water":  # keeps its volume, and nothing else
        rows[:, F : F + 9] = torch.eye(3, dtype=torch.float64).reshape(9)
        rows[:, F] = rows[:, J]
    return solver, static


def answer(config: PaperConfig, f: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray, float]:
    """New deformation, Kirchhoff stress in Pa and ratio of one particle, straight from the published formulas."""
    young, nu = 1e6 * config.young, config.poisson
    mu, lam = young / (2 * (1 + nu)), young * nu / ((1 + nu) * (1 - 2 * nu))
    if config.material == "water":
        j = np.linalg.det(f)
        return np.diag([j, 1.0, 1.0]), lam * (j - 1) * j * np.eye(3), j
    u, s, vt = np.linalg.svd(f)
    if config.material == "snow":
        e = math.exp(10 * (1 - ratio))
        elastic = np.clip(s, 1 - 0.025, 1 + 0.0045)
        new, rotation = u @ np.diag(elastic) @ vt, u @ vt
        j = elastic.prod()
        tau = 2 * mu * e * (new - rotation) @ new.T + lam * e * (j - 1) * j * np.eye(3)
        return new, tau, ratio * s.prod() / j
    log = np.log(s)
    trace = log.sum() + ratio
    if trace >= 0:
        return u @ vt, np.zeros((3, 3)), trace
    deviator = log - trace / 3
    sine = math.sin(math.radians(45))
    alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
    excess = np.linalg.norm(deviator) + (3 * lam + 2 * mu) / (2 * mu) * trace * alpha
    if excess > 0:
        log = log - excess * deviator / np.linalg.norm(deviator)
    tau = u @ np.diag(2 * mu * log + lam * log.sum()) @ u.T
    return u @ np.diag(np.exp(log)) @ vt, tau, 0.0


def stencil(x: np.ndarray, n: int):
    """Nodes, weights and arms (boxes) of the quadratic B-spline around a position; weights from their definition."""
    for node in np.ndindex(3, 3, 3):
        at = np.floor(x * n - 0.5).astype(int) + node
        r = np.abs(x * n - at)
        w = np.where(r < 0.5, 0.75 - r**2, 0.5 * np.maximum(1.5 - r, 0) ** 2)
        yield tuple(at), w.prod(), at / n - x


def twin(config: PaperConfig, rows: np.ndarray, static: np.ndarray, dt: float) -> np.ndarray:
    """One substep, particle by particle and node by node."""
    n, volume = config.cells, config.cells**-3.0
    mass, momentum = np.zeros((n, n, n)), np.zeros((n, n, n, 3))
    rows = rows.copy()
    for x in static:
        for node, w, _ in stencil(x, n):
            mass[node] += w * 1000 * volume
    for row in rows:
        gradient = row[C : C + 9].reshape(3, 3)
        new, tau, row[J] = answer(config, (np.eye(3) + dt * gradient) @ row[F : F + 9].reshape(3, 3), row[J])
        row[F : F + 9] = new.ravel()
        for node, w, arm in stencil(row[X : X + 3], n):
            mass[node] += w * 1000 * volume
            momentum[node] += w * (1000 * volume * (row[V : V + 3] + gradient @ arm) - dt * volume * 4 * n**2 * tau @ arm)
    for row in rows:
        velocity, moment = np.zeros(3), np.zeros((3, 3))
        for node, w, arm in stencil(row[X : X + 3], n):
            v = momentum[node] / mass[node] + dt * np.array(config.gravity)
            velocity += w * v
            moment += w * np.outer(v, arm)
        row[V : V + 3], row[C : C + 9] = velocity, (4 * n**2 * moment).ravel()
        row[X : X + 3] += dt * velocity
    return rows


@pytest.mark.parametrize("effect", FALLS)
def test_one_substep_equals_its_plain_twin(effect):
    config = small(effect)
    solver, static = deformed_cloud(config)
    expected = twin(config, solver.state.numpy(), static, 3e-4)
    solver.substep(3e-4)
    found = solver.state.numpy()
    for name, columns in {
        "x": slice(X, X + 3),
        "v": slice(V, V + 3),
        "C": slice(C, C + 9),
        "F": slice(F, F + 9),
        "J": J,
    }.items():
        scale = np.abs(expected[:, columns]).max() + 1e-12
        np.testing.assert_allclose(found[:, columns] / scale, expected[:, columns] / scale, atol=1e-11, err_msg=name)


def test_the_twin_saw_every_branch_of_sand():
    config = small("sandstorm")
    solver, _ = deformed_cloud(config)
    ratios = [answer(config, row[F : F + 9].reshape(3, 3), row[J])[2] for row in solver.state.numpy()]
    assert 0 < sum(ratio > 0 for ratio in ratios) < len(ratios)


@pytest.mark.parametrize("effect", FALLS)
def test_a_substep_without_forces_from_outside_keeps_mass_and_momentum(effect):
    config = small(effect, gravity=(0.0, 0.0, 0.0))
    solver, _ = deformed_cloud(config)
    solver.stationary = solver.stationary[:0]
    before = solver.velocities.mean(0)
    solver.substep(3e-4)
    mass, momentum = solver.grid[:, 0], solver.grid[:, :1] * solver.grid[:, 1:]
    assert float(mass.sum()) == pytest.approx(12 * 1000 / 32**3, rel=1e-13)
    np.testing.assert_allclose(momentum.sum(0) / mass.sum(), before, atol=1e-13)
    np.testing.assert_allclose(solver.velocities.mean(0), before, atol=1e-13)


def test_stationary_particles_add_mass_and_nothing_else():
    """As mass alone or, as the original has them, as whole particles: the same motion."""
    ends = []
    for stationary in ("mass", "particles"):
        solver, _ = deformed_cloud(small("snowfall", stationary=stationary))
        solver.step()
        ends.append(solver.state.numpy())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-10)


# The published numbers


def test_numbers_are_those_of_the_supplement():
    found = {
        name: (c.young, c.poisson, c.emit, c.emit_every, c.gravity, c.velocity[2], c.threshold, c.cells)
        for name, c in PAPER_EFFECTS.items()
    }
    down, sink = (0.0, 0.0, -9.8), (0.5, 0.0, -0.1)
    assert found == {
        "snowfall": (0.14, 0.2, 1000, 2, down, (-0.5, -0.5), 0.001, 64),
        "rainfall": (0.08, 0.45, 1000, 2, down, (-0.5, -0.5), 0.001, 64),
        "sandstorm": (0.08, 0.3, 1000, 2, down, (-0.2, 0.2), 0.001, 64),
        "fog": (0.08, 0.3, 5000, 0, sink, (-0.1, 0.1), 0.001, 64),
    }
    assert paper_config("sandstorm").velocity[0] == (0.8, 1.2)


def test_a_frame_takes_thirteen_substeps():
    solver = PaperSolver(small("snowfall", cells=64), BOX, NONE)
    solver.emit(np.full((1, 3), 0.5), np.zeros((1, 3)))
    assert solver.step() == 13


def test_two_simulated_seconds_are_shown_for_twenty():
    config = paper_config("snowfall")
    assert 500 * config.frame_seconds == pytest.approx(2.0)
    history = simulate(small("snowfall", emit=1), frames=3)
    assert history.frames / history.fps == pytest.approx(3 / 25)
    assert history.about["simulated_seconds"] == pytest.approx(2 * 4e-3)


def test_an_unknown_effect_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="fog, rainfall, sandstorm, snowfall, not 'hail'"):
        paper_config("hail")


def test_the_box_stands_on_the_ground_and_keeps_shapes():
    box = Box.of(Domain((0, 0, -1), (10, 5, 3)))
    points = np.array([[0, 0, -1], [10, 5, 3], [5, 2.5, -1]], float)
    np.testing.assert_allclose(box.to_box(points), [[0.05, 0.275, 0.05], [0.95, 0.725, 0.41], [0.5, 0.5, 0.05]])
    np.testing.assert_allclose(box.to_metres(box.to_box(points)), points)
    np.testing.assert_allclose(box.bounds, box.to_box(points[:2]))


# Laws and artefacts


def test_a_lone_particle_falls_freely_but_for_the_first_order_of_the_step():
    solver = PaperSolver(small("snowfall"), BOX, NONE)
    solver.emit(np.array([[0.5, 0.5, 0.9]]), np.array([[0.1, 0.0, -0.5]]))
    for _ in range(10):
        solver.step()
    t, dt = 0.04, 0.04 / solver.substeps
    np.testing.assert_allclose(
        solver.positions[0], [0.5 + 0.1 * t, 0.5, 0.9 - 0.5 * t - 0.5 * 9.8 * t * (t + dt)], atol=1e-12, rtol=0
    )


def test_a_single_emission_falls_freely_as_a_whole_yet_loses_its_sideways_spread():
    history = simulate(small("snowfall", emit_every=0, emit=1000))
    paths = first_emission(history)
    found, free = fallen(history)
    assert found == pytest.approx(free, rel=0.02)
    spread = np.diff(paths, axis=1)[:, :, 0].std(0) / 4e-3
    drawn = 0.2 / math.sqrt(12)
    assert spread[-1] < 0.35 * drawn


def test_steady_snow_falls_slower_than_freely_since_newcomers_share_its_cells():
    """Reported of the original: 0.70-0.83 of the ballistic speed, without drag and without anything in the way."""
    history = simulate(small("snowfall"), frames=30)
    paths = first_emission(history)
    speed = -np.diff(paths[:, -2:, 2], axis=1).mean() / 4e-3
    assert 0.65 < speed / (0.5 + 9.8 * 28.5 * 4e-3) < 0.85


def test_floating_stationary_mass_holds_back_what_falls_through_its_cells():
    static = BOX.to_metres(np.random.default_rng(0).uniform(0.05, 0.95, (500, 3)))
    found, free = fallen(simulate(small("snowfall", emit_every=0, emit=1000), static=static))
    assert 0.3 < found / free < 0.9


def test_what_moves_slower_than_the_threshold_comes_to_rest_in_mid_air():
    slow, sway = (-0.2, -0.2), (-0.1, 0.1)
    config = small("fog", emit=20, gravity=(0.0, 0.0, 0.0), velocity=(sway, sway, slow), region="above")
    history = simulate(config, surface=floor(0.5), frames=3)
    assert history.about["hanging"] > 10
    assert history.about["hanging"] == history.about["landed"] == int(history.collided.sum())
    hung = int(history.collided.nonzero()[0, 0])
    last = history.positions[history.offsets[hung + 1] - 1]
    torch.testing.assert_close(history.rest_positions[hung], last, rtol=0, atol=5e-5)
    assert last[2] > 2.0


def test_half_the_threshold_keeps_it_moving():
    slow, none = (-0.2, -0.2), (0.0, 0.0)
    config = small("fog", emit=20, gravity=(0.0, 0.0, 0.0), velocity=(none, none, slow), region="above")
    assert simulate(config, frames=3).about["landed"] == 20
    assert simulate(config.perturbed(threshold=0.5), frames=3).about["landed"] == 0


def test_what_meets_the_mesh_stops_there_and_is_laid_onto_it():
    history = simulate(small("snowfall", emit=30, emit_every=0), surface=floor(2.4), frames=40)
    about = history.about
    assert about["landed"] > 20 and about["hanging"] == 0
    assert about["emitted"] == 30 == about["landed"] + about["left"] + about["in_air"]
    landed = history.collided.nonzero()[:, 0]
    torch.testing.assert_close(
        history.positions[history.offsets[landed + 1] - 1][:, 2], torch.full((len(landed),), 2.4), rtol=0, atol=5e-5
    )
    settle = paper_config("snowfall").surface.settle
    torch.testing.assert_close(
        history.rest_positions[landed][:, 2], torch.full((len(landed),), 2.4 + settle), rtol=0, atol=1e-5
    )


def test_stationary_gaussians_stop_snow_above_the_mesh_and_it_is_laid_onto_it():
    """They share nodes up to three cells away; the original is reported to stop 1.5 cells above."""
    rng = np.random.default_rng(0)
    static = np.column_stack([rng.uniform(-1.5, 1.5, (5000, 2)), np.full(5000, 2.4)])
    config = small("snowfall", emit=50, emit_every=0)
    history = simulate(config, surface=floor(2.4), static=static, frames=45)
    landed = history.collided.nonzero()[:, 0]
    assert len(landed) > 30 and history.about["hanging"] == 0
    stopped = history.positions[history.offsets[landed + 1] - 1][:, 2] - 2.4
    cells = stopped.median() / (config.dx * BOX.metres)
    assert 1.2 < cells < 3.0
    settle = paper_config("snowfall").surface.settle
    torch.testing.assert_close(
        history.rest_positions[landed][:, 2], torch.full((len(landed),), 2.4 + settle), rtol=0, atol=1e-5
    )


def test_what_leaves_the_domain_ends_without_a_rest():
    fast, none = (5.0, 6.0), (0.0, 0.0)
    history = simulate(small("snowfall", emit=20, emit_every=0, velocity=(fast, none, none)), frames=50)
    assert history.about["left"] == 20 and not history.collided.any()
    assert (history.ends < 50).all()
    assert (history.positions[:, 0] <= 1.5 + 1e-5).all()


def test_a_single_thread_gives_the_same_bits_for_the_same_seed():
    one, two = (simulate(small("rainfall", emit=50), frames=6) for _ in range(2))
    assert torch.equal(one.positions, two.positions)


# Robustness


@pytest.mark.parametrize("effect", FALLS)
@pytest.mark.parametrize("factor", [0.5, 1.5])
@pytest.mark.parametrize("name", ["emission", "velocity", "stiffness", "threshold"])
def test_half_and_one_and_a_half_of_each_parameter_run(effect, factor, name):
    config = small(effect, emit=40)
    changed = config.perturbed(**{name: factor})
    history = simulate(changed, frames=3)
    history.check_finite()
    assert history.about["emitted"] == 2 * (round(40 * factor) if name == "emission" else 40)
    assert (changed.young / config.young, changed.threshold / config.threshold) == pytest.approx(
        (factor if name == "stiffness" else 1, factor if name == "threshold" else 1)
    )
    low, high = changed.velocity[0]
    assert low <= high and changed.velocity[2][0] == pytest.approx(
        config.velocity[2][0] * (factor if name == "velocity" else 1)
    )


@pytest.mark.parametrize("effect", FALLS)
@pytest.mark.parametrize("factor", [0.01, 10.0, 1000.0])
def test_any_stiffness_runs_in_as_many_substeps_as_it_needs(effect, factor):
    config = small(effect, emit=20).perturbed(stiffness=factor)
    history = simulate(config, frames=2)
    assert history.about["most_substeps"] >= max(7, 0.99 * config.sound_speed * 4e-3 / (config.courant * config.dx))


def test_a_hundredfold_step_is_shortened():
    config = small("snowfall", emit=20, step=2.0)
    assert simulate(config, frames=3).about["most_substeps"] >= config.sound_speed * 4e-3 / (0.5 * config.dx) - 1


def test_what_would_take_too_many_substeps_is_refused_with_its_cause():
    with pytest.raises(ValueError, match=r"frame 1 .* sound travels at .* boxes/s in snow .* lower young") as caught:
        simulate(small("snowfall", emit=20, young=1.4e8), frames=3)
    assert str(caught.value).count(". ") == 0
    with pytest.raises(ValueError, match=r"a particle moves at .* boxes/s"):
        simulate(small("snowfall", emit=20, velocity=((1e4, 1e4),) * 3), frames=3)
    with pytest.raises(ValueError, match=r"the longest step is .* raise step"):
        simulate(small("snowfall", emit=20, step=1e-4), frames=3)


def test_hardened_snow_takes_shorter_substeps():
    solver = PaperSolver(small("snowfall"), BOX, NONE)
    solver.emit(np.array([[0.5, 0.5, 0.5]]), np.zeros((1, 3)))
    calm = solver.step()
    solver.state[0, J] = 0.5
    solver.step()
    assert solver.step() > 5 * calm


def test_a_number_that_is_none_is_named_with_its_frame():
    solver, _ = deformed_cloud(small("snowfall"))
    solver.step()
    solver.state[4, V] = math.nan
    with pytest.raises(ValueError, match=r"the \w+ of \d+ particles \(first: \d+\) is not finite in frame 2"):
        solver.step()
    with pytest.raises(ValueError, match="1 of 2 are not"):
        PaperSolver(small("snowfall"), BOX, np.array([[0.5, 0.5, 0.5], [math.nan, 0, 0]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"young": 0.0}, "youngs modulus must be positive"),
        ({"poisson": 0.5}, "must lie in 0-0.49"),
        ({"threshold": -1.0}, "threshold must be positive"),
        ({"emit": 0}, "at least one particle"),
        ({"cells": 16}, "at least 32 cells"),
        ({"courant": 2.0}, "Courant number"),
        ({"velocity": ((1.0, 0.0), (0.0, 0.0), (0.0, 0.0))}, "must be finite and ascend"),
    ],
)
def test_numbers_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(paper_config("snowfall"), **change)
