"""The haze of each weather has the measured extinction, drifts with the wind and follows the timeline."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.effects.effect import Effect, Wind, effect
from pgsd_nerfstudio.effects.haze import Haze
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.physics.air.arrival import Arrival
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.rendering.medium import Medium
from pgsd_nerfstudio.response.front import CUT, SOFT, Front, reach
from pgsd_nerfstudio.response.haze_field import HazeField, full_extinction
from pgsd_nerfstudio.response.patches import OCTAVES, PERIOD, Patches
from pgsd_nerfstudio.scene.frame import Frame

METRES = Frame(1.0, torch.eye(3), torch.zeros(3))
SCENE = Frame(2.5, torch.tensor([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]), torch.tensor([0.3, -0.2, -0.4]))
BOX = Domain((-8.0, -7.0, -0.3), (8.0, 9.0, 4.0))
VIEW = torch.tensor(  # from 1.5 m above the ground towards +y and a little up
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.28, -0.96, 1.44], [0.0, 0.96, 0.28, -0.42], [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64
)
LENS = torch.tensor([[430.0, 0, 256], [0, 430.0, 256], [0, 0, 1]], dtype=torch.float64), 512, 512

INTENSITY = {"fog": 60.0, "sandstorm": 60.0, "rainfall": 12.0, "snowfall": 1.5}


def weather(
    name: str, *, share: float | None = None, timeline: Timeline | None = None, wind: Wind | None = None, **haze
) -> Effect:
    plain = effect(name, intensity=INTENSITY[name])
    emission = plain.emission if share is None else replace(plain.emission, share=share)
    return replace(plain, haze=Haze(**haze), emission=emission, timeline=timeline or Timeline(), wind=wind or plain.wind)


def in_metres(medium: Medium | None) -> float:
    """Extinction of even air, per scene unit."""
    assert medium is not None and not callable(medium.extinction)
    return medium.extinction


def cube(count: int, side: float) -> torch.Tensor:
    return side * torch.rand(count, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


# What the air takes.


@pytest.mark.parametrize("name", ["fog", "sandstorm"])
@pytest.mark.parametrize(("visibility", "contrast"), [("optical-range", 0.05), ("koschmieder", 0.02)])
def test_the_contrast_that_is_left_at_the_visibility(name, visibility, contrast):
    """WMO No. 8: the meteorological optical range is where 5 % are left; Koschmieder (1924) has 2 %."""
    plain = weather(name)
    taken = full_extinction(replace(plain, emission=replace(plain.emission, visibility=visibility)))
    assert math.exp(-taken * INTENSITY[name]) == pytest.approx(contrast)
    assert visibility != "optical-range" or taken == full_extinction(plain)


@pytest.mark.parametrize("rate", [1.0, 5.0, 12.0, 25.0, 50.0])
def test_rain_takes_what_carbonneau_and_wisely_give(rate):
    rain = effect("rainfall", intensity=rate)
    decibels = 10 / math.log(10) * 1e3 * full_extinction(replace(rain, haze=Haze()))
    assert decibels == pytest.approx(1.076 * rate**0.67, rel=0.25)


@pytest.mark.parametrize(("rate", "miles"), [(1.0, 1 / 2), (2.5, 1 / 4)])
def test_snow_hides_what_weather_services_see_hidden(rate, miles):
    """Light snow, less than 1 mm/h of water, lets see half a mile; heavy, more than 2.5 mm/h, not a quarter (FMH-1). At equal
    rates storms differ by a factor of three and more (Rasmussen et al. 1999)."""
    snow = effect("snowfall", intensity=rate)
    visibility = math.log(20.0) / full_extinction(replace(snow, haze=Haze()))
    assert 1 / 2 < visibility / (1609.0 * miles) < 1.5


@pytest.mark.parametrize("name", ["rainfall", "snowfall"])
def test_what_is_simulated_does_not_decide_what_the_air_takes(name):
    """Fewer sizes are simulated than fall, so that each can be seen."""
    plain = weather(name)
    coarse = replace(plain, emission=replace(plain.emission, smallest=2e-3, largest=4e-3))
    assert full_extinction(coarse) == full_extinction(plain)


def test_the_amount_is_a_factor_on_what_is_taken():
    assert full_extinction(weather("snowfall", amount=0.25)) == pytest.approx(0.25 * full_extinction(weather("snowfall")))


def test_scene_units_change_nothing():
    fog = weather("sandstorm", patchiness=0.4, scale_height=8.0)
    points = torch.tensor([[1.0, 8.0, 3.0], [-2.0, 15.0, 1.0], [3.0, 30.0, 12.0]], dtype=torch.float64)
    depths = []
    for frame in (METRES, SCENE):
        medium = HazeField.of(fog, frame, BOX).at(2.0)
        assert medium is not None
        view = VIEW.clone()
        view[:3, :3] = VIEW[:3, :3] @ frame.rotation.double()
        view[:3, 3] = VIEW[:3, 3] / frame.metres_per_unit - view[:3, :3] @ frame.origin.double()
        depths.append(medium.optical_depth(frame.to_scene(points), view, *LENS))
    torch.testing.assert_close(depths[0], depths[1], rtol=1e-4, atol=1e-6)
    even = weather("sandstorm")
    assert in_metres(HazeField.of(even, SCENE, BOX).at(0.0)) == pytest.approx(2.5 * math.log(20) / 60)


def test_it_thins_to_a_third_over_the_scale_height_and_not_below_the_ground():
    found = HazeField.of(weather("sandstorm", scale_height=12.0), METRES, BOX).density(
        torch.tensor([[3.0, 1, -5], [0.0, 0, 0], [0.0, 9, 12], [-70.0, 0, 36]]), 0.0
    )
    assert found.tolist() == pytest.approx([1.0, 1.0, math.exp(-1), math.exp(-3)])


# Patches.


@pytest.mark.parametrize("deviation", [0.3, 0.6, 1.0])
def test_patches_move_density_about_and_add_none(deviation):
    patches = Patches.draw(deviation, 12.0, (0.0, 0.0, 0.0), turbulence=0.3)
    for seconds in (0.0, 7.0, 200.0):
        density = patches.density(cube(100_000, patches.period), seconds)
        assert density.mean().item() == pytest.approx(1.0, abs=0.01)
        assert density.log().std().item() == pytest.approx(deviation, rel=0.02)


def test_patches_have_the_spectrum_of_a_scalar_in_turbulence():
    """Energy in shells of wave number k falls as k^-5/3 between the largest and the smallest, and is 0 outside."""
    field = Patches.draw(0.5, 10.0, (0.0, 0.0, 0.0), turbulence=0.2, seed=4).field(3.0).double().numpy()
    power = np.abs(np.fft.fftn(field, norm="forward")) ** 2
    turns = np.fft.fftfreq(len(field), 1 / len(field))
    k = np.sqrt(turns[:, None, None] ** 2 + turns[:, None] ** 2 + turns**2)
    shells = np.arange(PERIOD + 1, PERIOD * 2**OCTAVES)
    # Shells of the lattice hold more or fewer waves than 4 pi k^2: their mean power counts, not their sum.
    energy = [4 * np.pi * r**2 * power[np.abs(k - r) <= 0.5].mean() for r in shells]
    slope = np.polyfit(np.log(shells), np.log(energy), 1)[0]
    assert slope == pytest.approx(-5 / 3, abs=0.05)
    assert power[(k < PERIOD) | (k > PERIOD * 2**OCTAVES)].max() < 1e-9 * power.max()


def test_at_its_nodes_density_is_the_exponential_of_the_field():
    patches = Patches.draw(0.6, 8.0, (0.0, 0.0, 0.0), turbulence=0.3)
    nodes = torch.tensor([[0, 0, 0], [3, 50, 17], [63, 1, 40], [20, 21, 22]])
    for seconds in (6.0, 40.0):
        field = patches.field(seconds)
        density = patches.density(nodes * (patches.period / len(field)), seconds)
        wanted = torch.exp(0.6 * field)
        torch.testing.assert_close(density, wanted[tuple(nodes.T)] / wanted.mean(), rtol=1e-4, atol=1e-5)


def test_patches_repeat_themselves_after_their_period():
    patches = Patches.draw(0.7, 5.0, (1.0, -2.0, 0.0), turbulence=0.4)
    points = cube(500, 20.0)
    for axis in range(3):
        shifted = points.clone()
        shifted[:, axis] += patches.period * (axis - 3)
        torch.testing.assert_close(patches.density(shifted, 4.0), patches.density(points, 4.0), rtol=1e-6, atol=1e-9)


def test_no_seam_shows_where_patches_repeat():
    patches = Patches.draw(0.7, 5.0, (0.0, 0.0, 0.0))
    side, step = 20.0 * torch.eye(3, dtype=torch.float64), 1e-6
    before, after = patches.density(side - step, 0.0), patches.density(side + step, 0.0)
    torch.testing.assert_close(before, after, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("later", [0.4, 3.0, 1000.0])
def test_without_turbulence_patches_only_drift_with_the_wind(later):
    wind = torch.tensor([3.0, -1.2, 0.0], dtype=torch.float64)
    patches = Patches.draw(0.7, 12.0, (3.0, -1.2, 0.0))
    points = cube(500, 40.0)
    torch.testing.assert_close(
        patches.density(points + later * wind, 2.0 + later), patches.density(points, 2.0), rtol=1e-5, atol=1e-8
    )


def test_turbulence_makes_other_patches_of_them_the_small_ones_first():
    patches = Patches.draw(0.7, 12.0, (0.0, 0.0, 0.0), turbulence=0.2)

    def likeness(seconds: float, low: float, high: float) -> float:
        one, other = (np.fft.fftn(patches.field(at).double().numpy()) for at in (5.0, 5.0 + seconds))
        turns = np.fft.fftfreq(len(one), 1 / len(one))
        k = np.sqrt(turns[:, None, None] ** 2 + turns[:, None] ** 2 + turns**2)
        band = (k >= low) & (k <= high)
        return float((one[band] * other[band].conj()).sum().real / (np.abs(one[band]) ** 2).sum())

    large, small = (PERIOD, PERIOD + 1), (3 * PERIOD, 4 * PERIOD)
    assert likeness(1.0, *large) > likeness(4.0, *large) > likeness(15.0, *large) > likeness(60.0, *large)
    assert likeness(10.0, *large) > likeness(10.0, *small) + 0.3
    # Frequencies are normal with the deviation pi turbulence / wavelength: so is the likeness, over time.
    assert likeness(10.0, PERIOD, PERIOD) == pytest.approx(math.exp(-0.5 * (math.pi * 0.2 / 12 * 10) ** 2), abs=0.1)


def test_the_same_seed_makes_the_same_patches_and_another_one_others():
    points = cube(50, 30.0)
    one, again, other = (Patches.draw(0.5, 9.0, (1.0, 0, 0), seed=seed).density(points, 1.0) for seed in (1, 1, 2))
    assert torch.equal(one, again)
    assert (one - other).abs().max() > 0.1


@pytest.mark.parametrize(
    ("name", "deviation", "size", "visibility"),
    [("fog", 0.5, 8.0, 60.0), ("fog", 1.0, 4.0, 25.0), ("sandstorm", 1.0, 5.0, 40.0), ("sandstorm", 0.5, 20.0, 300.0)],
)
def test_froxels_see_patches_as_a_fine_quadrature_does(name, deviation, size, visibility):
    plain = weather(name, share=0.35, patchiness=deviation, patch_size=size)
    dense = replace(plain, emission=replace(plain.emission, intensity=visibility, visibility="koschmieder"))
    medium = HazeField.of(dense, METRES, BOX).at(3.0)
    assert medium is not None and callable(medium.extinction)
    uniform = cube(300, 1.0)
    flat = (uniform[:, :2] * 512 - 256) / 430
    rays = torch.nn.functional.normalize(torch.cat([flat, torch.ones(300, 1)], 1), dim=1) @ VIEW[:3, :3]
    center = torch.linalg.inv(VIEW)[:3, 3]
    ways = 60.0 ** uniform[:, 2:] * rays
    steps = (torch.arange(600) + 0.5)[None, :, None] / 600
    along = medium.extinction((center + ways[:, None] * steps).view(-1, 3)).view(300, 600)
    expected = along.mean(1) * ways.norm(dim=1)
    found = medium.optical_depth(center + ways, VIEW, *LENS)
    counted = (expected > 0.05) & (expected < math.log(100.0))
    off = ((found - expected) / expected)[counted].abs()
    assert counted.sum() > 100
    # The samples are farther apart than the smallest patches, whose sums along a ray they only estimate.
    assert off.square().mean().sqrt() < 0.08 * deviation
    assert (torch.exp(-found) - torch.exp(-expected)).abs().max() < 0.08 * deviation


# Parcels of fog.


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("share", [0.35, 1.0])
def test_parcels_and_medium_together_are_all_of_the_fog(share, axis):
    """Along a line through the box: what parcels bring within plus what the medium has is what the visibility asks for."""
    at = torch.linspace(-20, 20, 40_001, dtype=torch.float64)
    line = torch.tensor([1.0, 1.0, 2.0], dtype=torch.float64).repeat(len(at), 1)
    line[:, axis] = at
    medium = HazeField.of(weather("fog", share=share), METRES, BOX).density(line, 0.0)
    parcels = share * ((at > BOX.lower[axis]) & (at < BOX.upper[axis]))
    assert float((medium + parcels).mean()) == pytest.approx(1.0, abs=1e-4)
    assert medium.min().item() == pytest.approx(1 - share, abs=1e-9)
    assert medium[[0, -1]].tolist() == [1.0, 1.0]


@pytest.mark.parametrize("name", ["sandstorm", "snowfall", "rainfall"])
def test_grains_flakes_and_drops_leave_the_haze_to_the_medium(name):
    assert (HazeField.of(weather(name), METRES, BOX).density(cube(50, 8.0), 0.0) == 1.0).all()


# When it comes.


@pytest.mark.parametrize("arrives", ["everywhere", "as a front"])
def test_the_first_second_of_a_clear_start_is_untouched(arrives):
    field = HazeField.of(weather("fog", timeline=Timeline(onset=6.0, arrives=arrives), patchiness=0.5), METRES, BOX)
    assert field.at(0.0) is None and field.key(0.0) == b""
    assert field.at(0.04) is not None


@pytest.mark.parametrize("clear", [weather("fog", amount=0.0), replace(effect("fog"), haze=None)])
def test_without_haze_the_air_stays_clear(clear):
    for timeline in (Timeline(), Timeline(onset=5.0, arrives="as a front")):
        field = HazeField.of(replace(clear, timeline=timeline), METRES, BOX)
        assert field.at(9.0) is None and field.key(9.0) == b""


def test_it_grows_with_the_share_that_has_come():
    field = HazeField.of(weather("rainfall", timeline=Timeline(onset=8.0)), METRES, BOX)
    full = full_extinction(weather("rainfall"))
    assert [in_metres(field.at(s)) / full for s in (2.0, 4.0, 8.0, 30.0)] == pytest.approx([0.25, 0.5, 1.0, 1.0])


STORM = Timeline(onset=8.0, arrives="as a front")


def front_of(degrees: float = 0.0, timeline: Timeline = STORM) -> Front:
    return Front.of(Arrival.of(timeline, BOX, Wind(direction_degrees=degrees)), BOX)


def wall(front: Front, ahead: torch.Tensor, sideways: torch.Tensor) -> torch.Tensor:
    """[n, 3] points so many metres ahead of the mean front at second 0 and to its left, at heights of 0-3 m."""
    along = torch.tensor([*front.along, 0.0])
    aside = torch.tensor([-front.along[1], front.along[0], 0.0])
    heights = torch.linspace(0, 3, len(ahead))[:, None] * torch.tensor([0.0, 0.0, 1.0])
    return (front.start + ahead)[:, None] * along + sideways[:, None] * aside + heights


@pytest.mark.parametrize("degrees", [0.0, 70.0, 200.0])
def test_a_front_crosses_the_domain_from_upwind_to_downwind_within_the_onset(degrees):
    storm = weather("sandstorm", timeline=STORM, wind=Wind(direction_degrees=degrees))
    field = HazeField.of(storm, METRES, BOX)
    assert field.front is not None and field.at(0.0) is None
    corners = torch.cartesian_prod(*(torch.tensor(ends) for ends in zip(BOX.lower, BOX.upper, strict=True)))
    along = corners[:, 0] * math.cos(math.radians(degrees)) + corners[:, 1] * math.sin(math.radians(degrees))
    widest = CUT * SOFT + float(reach(torch.tensor(0.0)))
    assert (field.density(corners[along > along.min() + widest], 0.0) == 0.0).all()
    assert (field.density(corners, 8.0 + widest / field.front.speed) == 1.0).all()
    for corner, second in ((corners[along.argmin()], 0.0), (corners[along.argmax()], 8.0)):
        late = 3.0 / field.front.speed
        assert (
            field.density(corner[None], second - late).item() < 0.2 and field.density(corner[None], second + late).item() > 0.8
        )
    reached = [field.density(corners, second) for second in np.linspace(0, 12, 49)]
    assert all((later >= earlier - 0.02).all() for earlier, later in pairwise(reached))


def test_a_front_rises_within_metres_and_lobes_lead_and_lag_by_about_one():
    """On average over its breadth it is half where the particles begin, and the wind blows to its thin side."""
    front = front_of(130.0)
    aside = torch.linspace(-4, 4, 401)
    ahead = torch.linspace(-9, 9, 181)
    share = torch.stack([front.passed(wall(front, a.expand(401), aside), 0.0) for a in ahead])
    mean = share.mean(1)
    assert mean[ahead.abs() < 0.05].item() == pytest.approx(0.5, abs=0.15)
    assert (mean.diff() <= 1e-3).all() and mean[0] > 0.99 and mean[-1] < 0.01
    rising = ahead[(mean > 0.1) & (mean < 0.9)]
    assert 2.0 < float(rising.max() - rising.min()) < 6.0
    # Where each place along the front has half of the weather: no plane, and no farther than a sliver of the way.
    half = ahead[(share - 0.5).abs().argmin(0)]
    assert 0.3 < float(half.std()) < 1.5 and float(half.abs().max()) < 4.0


def test_the_edge_of_a_storm_kilometres_deep_is_no_line():
    """Light that arrives from 3 km away, along rays that turn from into the storm to away from it at 0.3 per metre."""
    front = front_of()
    angles = torch.deg2rad(torch.linspace(-20, 60, 321))
    steps = torch.cat([torch.tensor([0.0]), torch.logspace(-0.5, 3.5, 400)])
    middle, deep = 0.5 * (steps[1:] + steps[:-1]), steps.diff()
    depth = torch.stack(
        [
            (0.3 * deep * front.passed(torch.stack([a.sin() * middle, a.cos() * middle, 0.1 * middle], 1), 0.8)).sum()
            for a in angles
        ]
    )
    light = torch.exp(-depth)
    between = angles[(light > 0.05) & (light < 0.95)]
    assert float(torch.rad2deg(between.max() - between.min())) > 4.0  # the plane wall had a tenth of a degree


def test_the_front_of_the_particles_is_that_of_the_haze():
    timeline, wind = STORM, Wind(direction_degrees=130.0)
    arrival = Arrival.of(timeline, BOX, wind)
    field = HazeField.of(weather("sandstorm", timeline=timeline, wind=wind), METRES, BOX)
    assert field.front is not None
    low, high = torch.tensor(BOX.lower), torch.tensor(BOX.upper)
    points = low + (high - low) * (cube(200, 0.5) + 0.5)
    seconds = torch.linspace(-4, 14, 121)
    share = torch.stack([field.density(points, float(second)) for second in seconds])
    half = seconds[(share - 0.5).abs().argmin(0)]
    late = (half - torch.from_numpy(arrival.times(points.numpy())).float()) * field.front.speed  # in metres
    assert float(late.mean().abs()) < 0.5 and float(late.std()) < 1.5
    with pytest.raises(ValueError, match="only what arrives as a front"):
        Front.of(Arrival.of(Timeline(onset=8.0), BOX, wind), BOX)


def test_a_front_fades_in_at_first_so_that_nothing_jumps():
    timeline = Timeline(onset=10.0, arrives="as a front")
    field = HazeField.of(weather("sandstorm", timeline=timeline), METRES, BOX)
    point = torch.tensor([[-200.0, -100.0, 1.0]])  # behind it from the start
    strengths = []
    for second in (0.02, 1.0, 2.0, 9.99, 10.01, 60.0):
        medium = field.at(second)
        assert medium is not None
        strengths.append(float(medium.extinction(point)) if callable(medium.extinction) else medium.extinction)
    full = full_extinction(weather("sandstorm"))
    assert [strength / full for strength in strengths] == pytest.approx([0.01, 0.5, 1.0, 1.0, 1.0, 1.0])


def test_air_is_even_again_when_the_front_is_out_of_sight():
    field = HazeField.of(weather("sandstorm", timeline=Timeline(onset=4.0, arrives="as a front")), METRES, BOX)
    assert callable(getattr(field.at(5.0), "extinction"))  # noqa: B009
    assert in_metres(field.at(100.0)) == pytest.approx(math.log(20) / 60)


# What caches know it by.


def test_keys_differ_where_the_air_does_and_only_there():
    still = HazeField.of(weather("rainfall", timeline=Timeline(onset=4.0)), METRES, BOX)
    assert still.key(5.0) == still.key(9.0) != b""
    assert len({still.key(second) for second in (0.0, 1.0, 2.0, 4.0)}) == 4
    drifting = HazeField.of(weather("rainfall", patchiness=0.4), METRES, BOX)
    assert drifting.key(5.0) != drifting.key(5.04)
    front = HazeField.of(weather("sandstorm", timeline=Timeline(onset=4.0, arrives="as a front")), METRES, BOX)
    assert front.key(2.0) != front.key(3.0)
    assert front.key(100.0) == front.key(101.0)
    fixed = HazeField.of(weather("fog", scale_height=20.0), METRES, BOX)
    assert fixed.key(1.0) == fixed.key(2.0)
    others = [HazeField.of(weather("fog", rgb=(0.5, 0.5, 0.5)), METRES, BOX), HazeField.of(weather("fog"), METRES, BOX, seed=1)]
    assert len({one.key(1.0) for one in (still, drifting, front, fixed, *others)}) == 6
