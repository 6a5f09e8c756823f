"""The whole run: nothing is lost, water is kept, what was interrupted goes on to the same bits."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import SNOWFALL, Wind
from pgsd_nerfstudio.effects.appearance import layer_volume
from pgsd_nerfstudio.effects.snowfall import mass
from pgsd_nerfstudio.physics import Clock, Domain, ParticleHistory, motion_prior, simulate_metric, summary
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -0.2), (2.0, 2.0, 3.0))
CLOCK = Clock(fps=25.0, frames=90)
MOST = 600


def courtyard() -> SurfaceMesh:
    """A floor of 6 m and a table of 1 m at 0.7 m."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = torch.cat([3 * corners, 0.5 * corners + torch.tensor([0, 0, 0.7])])
    return SurfaceMesh(vertices, torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], dtype=torch.int32))


def run(**changes) -> ParticleHistory:
    settings = {"surface": courtyard(), "effect": SNOWFALL, "clock": CLOCK, "domain": DOMAIN, "max_particles": MOST} | changes
    return simulate_metric(
        settings.pop("surface"),
        settings.pop("effect"),
        settings.pop("clock"),
        settings.pop("domain"),
        progress=False,
        **settings,
    )


@pytest.fixture(scope="module")
def history() -> ParticleHistory:
    return run()


def same(first: ParticleHistory, second: ParticleHistory) -> bool:
    values = [(v, getattr(second, n)) for n, v in vars(first).items() if isinstance(v, torch.Tensor)]
    return all(torch.equal(a, b) for a, b in values)


def bare(history: ParticleHistory) -> torch.Tensor:
    """Where landed particles lie, without the cover beneath them."""
    rest = history.rest_positions[history.collided].clone()
    rest[:, 2] -= history.rest_covers[history.collided]
    return rest


def test_every_particle_is_accounted_for(history):
    about = history.about
    ends = about["landed"] + about["absorbed"] + about["left"] + about["unseen"] + about["in_air"]
    assert about["emitted"] == len(history) == ends
    assert about["landed"] == int(history.collided.sum()) > 200
    assert about["slid"] == 0
    assert about["in_air"] == int(((history.ends == CLOCK.frames) & ~history.collided).sum())
    assert torch.isfinite(history.positions).all()


def test_the_air_is_full_from_the_first_frame_to_the_last(history):
    active = [len(history.active(f)) for f in range(0, CLOCK.frames, 10)]
    assert min(active) > 0.85 * MOST
    assert max(active) < 1.05 * MOST


def test_snow_lies_on_the_table_and_the_ground_and_not_below_the_table(history):
    rest = bare(history)
    over_table = (rest[:, :2].abs() < 0.5).all(1)
    on_table, on_floor = (rest[:, 2] - 0.7).abs() < 0.02, rest[:, 2].abs() < 0.02
    assert (on_table | on_floor).all()
    assert int((on_table & over_table).sum()) > 15
    assert int((on_floor & over_table).sum()) < int((on_table & over_table).sum()) / 2  # wind carries a few under it


def test_it_rests_where_it_touched_on_what_lay_there_and_itself(history):
    ids = history.collided.nonzero()[:, 0]
    last, rest = history.positions[history.offsets[ids + 1] - 1], history.rest_positions[ids]
    assert (last - rest)[:, :2].abs().max() < 1e-3
    rise = (rest - last)[:, 2] - SNOWFALL.surface.settle
    assert rise.min() > -1e-3  # what touched the cover does not sink into it
    assert rise.quantile(0.9) < 0.02 and rise.max() < 0.06  # but its own snow, and what came in that frame, lies below it
    on_table = bare(history)[:, 2] > 0.35
    off = bare(history)[:, 2] - SNOWFALL.surface.settle - 0.7 * on_table
    assert off.abs().max() < 1e-4


def test_the_cover_holds_the_snow_that_landed_and_raises_what_lands_later(history):
    ids = history.collided.nonzero()[:, 0]
    volume = layer_volume(SNOWFALL, history.diameters[ids].double(), history.represents[ids].double()).sum()
    about = history.about
    assert about["cover_m3"] + about["cover_lost_m3"] + about["cover_missed_m3"] == pytest.approx(float(volume), rel=1e-6)
    assert about["cover_missed_m3"] + about["cover_lost_m3"] < 0.01 * float(volume)
    covers, late = history.rest_covers[ids], history.ends[ids] > 80
    assert covers[late].mean() > 1.5 * covers[history.ends[ids] < 10].mean()
    flat = run(effect=replace(SNOWFALL, surface=replace(SNOWFALL.surface, accumulates=False)))
    assert (flat.rest_covers == 0).all()


def test_flakes_on_a_growing_cover_lie_above_what_is_thin():
    """A board of 2 cm that looks up and down: what falls on its snow must not be taken for lying on its underside."""
    top = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    board = torch.cat([top, top - torch.tensor([0.0, 0.0, 0.02])])
    surface = SurfaceMesh(board, torch.tensor([[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]], dtype=torch.int32))
    snow = replace(SNOWFALL, emission=replace(SNOWFALL.emission, intensity=20.0), dense=None)
    found = simulate_metric(
        surface, snow, Clock(frames=100), Domain((-1.0, -1, 0), (1.0, 1, 3)), max_particles=2000, progress=False
    )
    inside = found.rest_positions[found.collided & (found.rest_positions[:, :2].abs().amax(1) < 0.8)]
    covers = found.rest_covers[found.collided & (found.rest_positions[:, :2].abs().amax(1) < 0.8)]
    assert len(inside) > 100 and covers.max() > 0.03
    assert inside[:, 2].min() > 1.0
    assert (inside[:, 2] - covers - 1.0).abs().max() < 0.02


def test_paths_do_not_jump(history):
    window = history.window(0, CLOCK.frames)
    step = (window.positions[:, 1:] - window.positions[:, :-1]).norm(dim=2)[window.active[:, 1:] & window.active[:, :-1]]
    assert step.max() < 2.5 / CLOCK.fps


def test_without_a_surface_nothing_lands():
    history = run(surface=SurfaceMesh.empty(), clock=Clock(frames=40))
    assert not history.collided.any()
    assert history.about["left"] > 0


def test_without_wind_nothing_lies_in_the_shadow_of_a_roof():
    still = replace(SNOWFALL, wind=Wind(speed=0.0, turbulence=0.0, flutter=0.0))
    history = run(effect=still)
    rest = history.rest_positions[history.collided]
    assert not ((rest[:, :2].abs() < 0.499).all(1) & (rest[:, 2] < 0.5)).any()
    active = history.positions_at(0, history.active(0))
    assert not ((active[:, :2].abs() < 0.499).all(1) & (active[:, 2] < 0.7)).any()
    assert (active[:, 2] > 0).all()


def test_water_through_a_plane_is_what_was_asked_for():
    clock = Clock(frames=125)
    history = run(surface=SurfaceMesh.empty(), clock=clock, max_particles=3000)
    window = history.window(0, clock.frames)
    above = window.positions[:, :, 2] > 1.2
    both = window.active[:, 1:] & window.active[:, :-1]
    crossings = ((above[:, :-1] & ~above[:, 1:]).float() - (~above[:, :-1] & above[:, 1:]).float()) * both
    kilograms = torch.from_numpy(mass(history.diameters[window.ids].double().numpy())) * history.represents[window.ids]
    water = float((crossings.sum(1) * kilograms).sum()) / DOMAIN.area / ((clock.frames - 1) / clock.fps)
    assert water * 3600 == pytest.approx(SNOWFALL.emission.intensity, rel=0.03)


def test_the_same_seed_gives_the_same_bits(history):
    assert same(history, run())
    assert not same(history, run(seed=1))


def test_an_interrupted_run_goes_on_to_the_same_bits(history, tmp_path, monkeypatch):
    meet, calls = Ground.meet, []

    def interrupted(self, *arguments):
        calls.append(0)
        if len(calls) == 60:
            raise KeyboardInterrupt
        return meet(self, *arguments)

    monkeypatch.setattr(Ground, "meet", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(resume=tmp_path)
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == ["chunk-0000.safetensors", "chunk-0001.safetensors"]
    assert same(history, run(resume=tmp_path))
    assert len(calls) == 60 + 40  # frames 50 to 89


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_a_damaged_chunk_is_made_again(history, tmp_path, damage):
    run(resume=tmp_path)
    path = tmp_path / "chunk-0001.safetensors"
    content = bytearray(path.read_bytes())
    if damage == "cut":
        del content[len(content) // 2 :]
    else:
        for at in range(len(content) // 2, len(content), 997):
            content[at] ^= 0xFF
    path.write_bytes(content)
    assert same(history, run(resume=tmp_path))


def test_a_full_disk_does_not_stop_the_run(history, tmp_path, monkeypatch, capsys):
    def full(*args, **kwargs):
        raise OSError("No space left on device")

    monkeypatch.setattr("pgsd_nerfstudio.physics.record.chunks.save_tensors", full)
    assert same(history, run(resume=tmp_path))
    assert "could not store frames 0-24" in capsys.readouterr().err


def test_a_number_that_blows_up_is_named_with_its_frame():
    broken = replace(SNOWFALL, wind=replace(SNOWFALL.wind, speed=float("nan")))
    with pytest.raises(ValueError, match=r"positions|velocities.*frame"):
        run(effect=broken, surface=SurfaceMesh.empty(), clock=Clock(frames=3))


def test_wind_leaves_no_corner_empty():
    windy = replace(SNOWFALL, wind=replace(SNOWFALL.wind, speed=3.0))
    history = run(effect=windy, surface=SurfaceMesh.empty(), max_particles=4000)
    at = history.positions_at(80, history.active(80)).numpy()
    counts = np.histogramdd(at, bins=2, range=list(zip(DOMAIN.lower, DOMAIN.upper, strict=True)))[0]
    assert counts.min() > 0.8 * counts.mean()


def test_one_frame_is_enough():
    history = run(clock=Clock(frames=1))
    assert len(history.active(0)) == len(history) > 400


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Clock(frames=0), "at least one frame"),
        (lambda: Domain((0, 0, 0), (1, 0, 1)), "lower < upper"),
        (lambda: run(max_particles=0), "max_particles must be at least 1"),
    ],
)
def test_bad_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_motion_prior_is_made_once(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path))
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, :3, 3] = torch.tensor([[0.0, -2, 1.5], [0.5, -2, 1.5]])
    poses[:, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # looking along +y
    cameras = Cameras.from_opengl(poses, torch.tensor([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]).repeat(2, 1, 1), 64, 64)
    scene = Scene("test", Gaussians.empty(), cameras, Frame(1.0, torch.eye(3), torch.zeros(3), ""), (), "a yard", None)

    def prior(**changes) -> ParticleHistory:
        settings = {"effect": SNOWFALL, "seed": 0, "max_particles": 300} | changes
        return motion_prior(
            scene,
            courtyard(),
            settings.pop("effect"),
            Clock(frames=30),
            **settings,
        )

    first = prior()
    said = capsys.readouterr().err
    assert "particles over 30 frames" in said
    assert "real ones" in said
    assert [path.suffix for path in (tmp_path / "motion").iterdir()] == [".safetensors"]  # chunks are gone
    module = importlib.import_module("pgsd_nerfstudio.physics.motion_prior")
    monkeypatch.setattr(module, "simulate_metric", lambda *a, **k: pytest.fail("simulated again"))
    assert same(first, prior())
    other_look = replace(SNOWFALL, prompt="snow", appearance=replace(SNOWFALL.appearance, exposure=0.5))
    assert same(first, prior(effect=other_look))  # looks do not move anything
    with pytest.raises(pytest.fail.Exception):
        prior(seed=1)
    stored = next((tmp_path / "motion").iterdir())
    stored.write_bytes(stored.read_bytes()[:1000])
    with pytest.raises(pytest.fail.Exception):
        prior()
    low, high = first.positions.min(0).values, first.positions.max(0).values
    assert high[1] > 1.0 > low[1] > -3.5  # ahead of the cameras and a little around them
    assert high[2] <= 3.5


def test_the_summary_says_what_happened(history):
    line = summary(history)
    assert line.startswith(f"snowfall: {len(history):,} particles over 90 frames")
    assert f"{int(history.collided.sum()):,} landed" in line
