"""Effects as wholes: what slides, moves as a mass, splashes, wets and glides; and that nothing of it is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects import FOG, RAINFALL, SANDSTORM, SNOWFALL, Effect, Splash, Wind
from pgsd_nerfstudio.physics import Clock, Domain, ParticleHistory, simulate_metric
from pgsd_nerfstudio.physics.air.air import Air
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.air.emitters import Newcomers, Sizes
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.splash import splashed
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.bodies import DENSE, SLID, SPLASHED
from pgsd_nerfstudio.physics.ground.landing import Ground
from pgsd_nerfstudio.physics.record.report import report
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

DOMAIN = Domain((-2.0, -2.0, -0.2), (2.0, 2.0, 4.0))
STILL = Wind(speed=0.0, turbulence=0.0, flutter=0.0)
SQUARE = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)


def roof() -> SurfaceMesh:
    """A floor, and a roof of 58 degrees over its left half."""
    slope = torch.tensor([[-1.5, -2, 3.2], [0, -2, 0.8], [0, 2, 0.8], [-1.5, 2, 3.2]])
    return SurfaceMesh(torch.cat([3 * SQUARE, slope]), torch.cat([FACES, FACES + 4]))


def floor() -> SurfaceMesh:
    return SurfaceMesh(3 * SQUARE, FACES)


def run(effect: Effect, surface: SurfaceMesh, frames: int = 75, **settings) -> ParticleHistory:
    settings = {"max_particles": 1500, "progress": False} | settings
    return simulate_metric(surface, effect, Clock(frames=frames), DOMAIN, **settings)


def slippery(speedup: float = 800.0) -> Effect:
    surface = replace(SNOWFALL.surface, holds_degrees=40.0, slips_degrees=50.0, accumulation_speedup=speedup)
    return replace(SNOWFALL, wind=STILL, surface=surface)


def test_thin_snow_slides_off_a_steep_roof_one_by_one_and_lands_below_it():
    history = run(slippery(200.0), roof(), 100)
    slid = (history.kinds & SLID) > 0
    assert int(slid.sum()) == history.about["slid"] > 100 and history.about["dense"] == 0
    landed = history.rest_positions[slid & history.collided]
    assert len(landed) > 20 and (landed[:, 2] < 0.15).all()
    assert (landed[:, 0] > -0.3).all()  # beyond the eaves at x = 0
    on_roof = history.rest_positions[history.collided & ~slid]
    assert not ((on_roof[:, 0] < -0.05) & (on_roof[:, 2] > 0.9)).any()


@pytest.fixture(scope="module")
def avalanche() -> ParticleHistory:
    return run(slippery(6000.0), roof(), 60)


def test_thick_snow_is_handed_to_the_dense_regime_and_back(avalanche):
    dense = (avalanche.kinds & DENSE) > 0
    assert int(dense.sum()) == avalanche.about["dense"] > 50
    assert ((avalanche.kinds[dense] & SLID) > 0).all()  # nothing becomes dense out of the air
    back = dense & avalanche.collided
    assert int(back.sum()) > 5
    about = avalanche.about
    assert about["emitted"] == sum(about[end] for end in ("landed", "absorbed", "left", "unseen", "in_air"))
    assert torch.isfinite(avalanche.positions).all()
    window = avalanche.window(0, 60)
    step = (window.positions[:, 1:] - window.positions[:, :-1]).norm(dim=2)[window.active[:, 1:] & window.active[:, :-1]]
    assert step.max() * 25 < math.sqrt(2 * 9.81 * 3.4) + 1  # no faster than free fall from the ridge
    assert abs(report(avalanche, SNOWFALL.material)["mass_lost"]) < 1e-9


def test_an_avalanche_goes_on_from_the_disk_to_the_same_bits(avalanche, tmp_path):
    run(slippery(6000.0), roof(), 60, resume=tmp_path)
    (tmp_path / "chunk-0002.safetensors").unlink()
    again = run(slippery(6000.0), roof(), 60, resume=tmp_path)
    for name, value in vars(avalanche).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, getattr(again, name)), name


def test_rain_leaves_all_its_water_on_the_ground():
    history = run(replace(RAINFALL, wind=STILL), floor(), max_particles=800)
    about = history.about
    assert about["landed"] == 0 and not history.collided.any() and about["absorbed"] > 500
    masses = RAINFALL.material.mass(history.diameters.double()) * history.represents.double()
    down = history.positions[history.offsets[1:] - 1][:, 2] < 1e-3
    drops = (history.kinds & SPLASHED) == 0
    splashed_mass = masses[~drops].sum()
    back = masses[down & ~drops].sum()
    expected = masses[down & drops].sum() - splashed_mass + back
    assert about["water_deposited_kg"] + about["water_missed_kg"] == pytest.approx(float(expected), rel=1e-3)
    assert about["water_kg"] + about["water_evaporated_kg"] == pytest.approx(about["water_deposited_kg"], rel=1e-9)
    assert abs(report(history, RAINFALL.material)["mass_lost"]) < 1e-9


def test_what_vanishes_leaves_nothing():
    history = run(replace(SNOWFALL, surface=replace(SNOWFALL.surface, landing="vanishes")), floor())
    assert history.about["absorbed"] > 200 and not history.collided.any()
    assert not any(name.startswith(("water", "cover")) for name in history.about)


def air_of(effect: Effect) -> Air:
    sizes = Sizes.of(effect, DOMAIN, 100, Sight.everything())
    ground = Ground.of(floor(), effect.surface, DOMAIN)
    wind, arrival = WindField.draw(effect.wind, 0), Arrival.of(effect.timeline, DOMAIN, effect.wind)
    return Air(DOMAIN, sizes, wind, arrival, effect, ground, Sight.everything(), 0.04, 0)


def test_splashes_grow_with_the_energy_and_carry_a_share_of_it():
    splash, air = Splash(), air_of(RAINFALL)
    diameters = np.array([0.0006, 0.001, 0.002, 0.003, 0.005])
    drops = air.newborn(Newcomers(np.zeros((5, 3)), diameters, np.full(5, 1e9)), np.zeros((5, 3)), np.random.default_rng(0))
    drops.velocities[:] = np.column_stack([0 * diameters, 0 * diameters, -drops.speeds])
    up = np.tile([0.0, 0.0, 1.0], (5, 1))
    droplets, share = splashed(air, splash, drops, up, np.random.default_rng(0))
    counts = np.rint(share / splash.diameter**3).astype(int)
    energy = 0.5 * RAINFALL.material.mass(diameters) * drops.speeds**2
    np.testing.assert_array_equal(counts, np.minimum(energy / splash.joule_per_droplet, splash.most).astype(int))
    assert counts[0] == 0 and counts[-1] == splash.most and len(droplets) == counts.sum()
    ends = np.cumsum(counts)
    for i in np.nonzero(counts)[0]:
        own = droplets.select(np.arange(ends[i] - counts[i], ends[i]))
        carried = 0.5 * (RAINFALL.material.mass(own.diameters.astype(float)) * (own.velocities**2).sum(1)).sum()
        assert 0 < carried <= splash.energy * energy[i] * (1 + 1e-5)
        assert (own.velocities[:, 2] > 0).all()
    assert (droplets.kinds == SPLASHED).all()
    weak = replace(splash, energy=0.01)  # where none is as fast as the impact
    many = drops.select(np.full(300, 4))
    thrown, _ = splashed(air, weak, many, np.tile(up[:1], (300, 1)), np.random.default_rng(0))
    carried = (
        0.5 * (RAINFALL.material.mass(thrown.diameters.astype(float)) * (thrown.velocities.astype(float) ** 2).sum(1)).sum()
    )
    # Speeds are uniform in 0.6-1 of the fastest: on average (1 - 0.6^3) / (3 (1 - 0.6)) of its energy.
    assert carried == pytest.approx(0.784 / 1.2 * weak.energy * 300 * energy[4], rel=0.03)
    again, nothing = splashed(air, splash, droplets, np.tile([0.0, 0.0, 1.0], (len(droplets), 1)), np.random.default_rng(0))
    assert len(again) == 0 and nothing.sum() == 0  # droplets do not splash


def test_fog_flows_around_a_wall_instead_of_ending_at_it():
    wall = SurfaceMesh(
        torch.tensor([[0.0, -1, 0], [0, 1, 0], [0, 1, 2], [0, -1, 2]]), torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    )
    history = run(replace(FOG, wind=replace(FOG.wind, speed=1.0, direction_degrees=0.0)), wall, max_particles=600)
    assert history.about["landed"] == 0 == history.about["absorbed"]
    window = history.window(0, history.frames)
    x, y, z = window.positions.unbind(2)
    # From one side to the other within two frames; the one between may be the contact itself.
    crossed = (x[:, :-2] < -1e-3) & (x[:, 2:] > 1e-3) & window.active[:, 2:] & window.active[:, :-2]
    share = x[:, :-2] / (x[:, :-2] - x[:, 2:])
    at_y, at_z = (c[:, :-2] + share * (c[:, 2:] - c[:, :-2]) for c in (y, z))
    through = crossed & (at_y.abs() < 0.95) & (at_z < 1.95) & (at_z > 0.05)
    assert int(crossed.sum()) > 30 and int(through.sum()) == 0


def test_a_cloud_of_fog_diffuses_as_its_eddy_diffusivity_says():
    effect = replace(FOG, wind=replace(STILL, diffusivity=0.02), emission=replace(FOG.emission, most=None))
    history = run(effect, SurfaceMesh.empty(), 40, max_particles=8000)
    ids = ((history.births == 0) & (history.ends == 40)).nonzero()[:, 0]
    moved = (history.positions_at(39, ids) - history.positions_at(0, ids)).double()
    inner = (history.positions_at(0, ids)[:, :2].abs() < 1.2).all(1) & ((history.positions_at(0, ids)[:, 2] - 2).abs() < 1)
    expected = 2 * 0.02 * 39 / 25
    assert moved[inner].var(0).numpy() == pytest.approx(np.full(3, expected), rel=0.15)


def test_sand_lands_where_the_wind_comes_from():
    block = torch.tensor([[x, y, z] for x in (-0.4, 0.4) for y in (-0.8, 0.8) for z in (0.0, 1.2)])
    faces = torch.tensor(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [1, 5, 7], [1, 7, 3]],
        dtype=torch.int32,
    )
    mesh = SurfaceMesh(torch.cat([3 * SQUARE, block]), torch.cat([FACES, faces + 4]))
    wind = replace(SANDSTORM.wind, direction_degrees=0.0)
    sticky = replace(SANDSTORM.surface, holds_degrees=120.0, slips_degrees=130.0, accumulates=False)
    history = run(replace(SANDSTORM, wind=wind, surface=sticky), mesh, max_particles=4000)
    rest = history.rest_positions[history.collided]
    side = (rest[:, 1].abs() < 0.7) & (rest[:, 2] > 0.1) & (rest[:, 2] < 1.1)
    windward, leeward = side & ((rest[:, 0] + 0.4).abs() < 0.02), side & ((rest[:, 0] - 0.4).abs() < 0.02)
    assert int(windward.sum()) > 10 * max(int(leeward.sum()), 1)


def test_what_no_camera_sees_is_left_out_and_what_it_sees_is_not():
    from pgsd_nerfstudio.laboratory.yard import view_into_yard

    camera = view_into_yard(16, 16)
    camera = replace(camera, Ks=camera.Ks * torch.tensor([[8.0, 1, 1], [1, 8, 1], [1, 1, 1]]))  # a narrow view
    seen = run(SNOWFALL, floor(), cameras=camera)
    assert seen.about["air_simulated"] < 1.0 and seen.about["unseen"] > 0


@pytest.mark.parametrize("effect", [SNOWFALL, RAINFALL, FOG, SANDSTORM], ids=lambda e: e.name)
@pytest.mark.parametrize("size", [1e-3, 1.0, 500.0])
def test_scenes_of_any_size_run(effect, size):
    small = SurfaceMesh(3 * size * SQUARE, FACES)
    lower, upper = np.array([-2.0, -2.0, -0.2]) * size, np.array([2.0, 2.0, 4.0]) * size
    history = simulate_metric(
        small, effect, Clock(frames=8), Domain(tuple(lower), tuple(upper)), max_particles=100, progress=False
    )
    history.check_finite()


@pytest.mark.parametrize("effect", [SNOWFALL, RAINFALL, FOG, SANDSTORM], ids=lambda e: e.name)
def test_a_storm_of_60_metres_a_second_and_no_gravity_of_fall_stay_finite(effect):
    storm = replace(effect, wind=replace(effect.wind, speed=60.0, turbulence=8.0))
    run(storm, roof(), 10, max_particles=300).check_finite()
    afloat = replace(effect, material=replace(effect.material, speed_factor=1e-12))
    run(afloat, roof(), 10, max_particles=300).check_finite()


def test_holes_and_flipped_triangles_lose_nothing():
    mesh = roof()
    broken = SurfaceMesh(mesh.vertices, torch.cat([mesh.triangles[:1].flip(1), mesh.triangles[2:]]))
    history = run(slippery(), broken, 50)
    about = history.about
    assert about["emitted"] == sum(about[end] for end in ("landed", "absorbed", "left", "unseen", "in_air"))
    assert about["landed"] > 50
