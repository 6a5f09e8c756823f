"""A request changes the numbers that it names by its factors, and every request gives an effect that can be simulated.

References: physics.laws.populations for counts, water and fall speeds (Gunn & Marshall, Locatelli & Hobbs, Koschmieder),
`initial_look` for the look of particles, and the errors of Emission for the intensities that it allows.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.cli.preview import Preview
from pgsd_nerfstudio.effects import EFFECTS, FOG, RAINFALL, SANDSTORM, SNOWFALL, Effect, InitialLook, initial_look
from pgsd_nerfstudio.effects.application import applied, remarks
from pgsd_nerfstudio.effects.matter import INTENSITIES
from pgsd_nerfstudio.effects.options import EffectOptions
from pgsd_nerfstudio.effects.reader import read
from pgsd_nerfstudio.effects.request import BASES, LIMITS, Request
from pgsd_nerfstudio.effects.timeline import Timeline
from pgsd_nerfstudio.effects.tint import in_matter, mixed_evenly
from pgsd_nerfstudio.effects.vocabulary import KINDS
from pgsd_nerfstudio.physics import Clock, Domain, simulate_metric
from pgsd_nerfstudio.physics.air.emitters import Sizes
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.air.wind import WindField
from pgsd_nerfstudio.physics.laws import fall_speeds
from pgsd_nerfstudio.physics.laws.populations import extinction, fall_speed, integral, number_density
from pgsd_nerfstudio.refusal import Refusal
from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.weather.options import SceneOptions

PROMPT = "Purple things are falling in {scene}"
BOX = Domain((-10.0, -10.0, 0.0), (10.0, 10.0, 7.5))
PURPLE = (0.5, 0.0, 0.5)


@dataclass
class Fallen:
    """1500 particles that span the sizes of an effect, all landed."""

    diameters: torch.Tensor
    ends = torch.full((1500,), 10, dtype=torch.int32)
    represents = torch.linspace(40.0, 5.0, 1500)
    rest_extents = torch.full((1500,), 10.0)
    fps = 25.0

    @staticmethod
    def of(effect: Effect) -> Fallen:
        return Fallen(torch.linspace(effect.emission.smallest, effect.emission.largest, 1500))

    def __len__(self) -> int:
        return 1500


def request(base: Any = "snowfall", **said: Any) -> Request:
    return Request(base=base, prompt=said.pop("prompt", PROMPT), **said)


def look(effect: Effect) -> InitialLook:
    return initial_look(effect, Fallen.of(effect))


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {name: value}
    return {key: leaf for part in value for key, leaf in leaves(value[part], f"{name}.{part}".lstrip(".")).items()}


def changes(effect: Effect, base: Effect) -> dict[str, Any]:
    """What differs, as new value over old for numbers, else as the new value; the prompt aside."""
    new, old = (leaves(asdict(replace(each, prompt=""))) for each in (effect, base))
    # A part that was taken out (a splash) has no leaves any more.
    return {name: _ratio(new.get(name), old.get(name)) for name in new | old if new.get(name) != old.get(name)}


def _ratio(new: Any, old: Any) -> Any:
    if isinstance(new, tuple) and new != PURPLE:
        return tuple(round(a / b, 9) for a, b in zip(new, old, strict=True))
    return round(new / old, 9) if isinstance(new, int | float) and old and not isinstance(new, bool) else new


def purple(base: Effect) -> dict[str, Any]:
    """What purple dye changes: air and sky go 60 % of the way where they are matter, and stay plain where things fall."""
    share = 0.0 if base.emission.precipitates else 0.6
    owns = {"haze.rgb": base.haze.rgb, "ambience.sky": base.ambience.sky} if base.haze and base.ambience else {}
    air = {
        name: tuple(round(new / old, 9) for old, new in zip(own, mixed_evenly(own, PURPLE, share), strict=True))
        for name, own in owns.items()
        if share
    }
    return {"appearance.active.rgb": PURPLE, "appearance.collided.rgb": PURPLE, **air}


TURNED: list[tuple[Effect, dict[str, Any], dict[str, Any]]] = [
    *((base, {}, {}) for base in EFFECTS.values()),
    *((base, {"rgb": PURPLE, "dyed": True}, purple(base)) for base in EFFECTS.values()),
    *((base, {"landed_rgb": PURPLE, "dyed": True}, {"appearance.collided.rgb": PURPLE}) for base in EFFECTS.values()),
    (
        SNOWFALL,
        {"size": 2.0},
        {
            "emission.smallest": 2.0,
            "emission.largest": 2.0,
            "material.mass_milligram": round(2**-1.4, 9),
            "material.speed_at_1mm": round(2**-0.16, 9),
        },
    ),
    (RAINFALL, {"size": 3.0}, {"appearance.active.scale_per_diameter": (3.0, 3.0, 3.0)}),
    (SANDSTORM, {"size": 0.5}, {"appearance.active.scale_per_diameter": (0.5, 0.5, 0.5)}),
    (FOG, {"size": 2.0}, {"appearance.active.scale_m": (2.0, 2.0, 2.0)}),
    (FOG, {"size": 0.5}, {"appearance.active.scale_m": (0.5, 0.5, 0.5), "emission.most": 4.0}),
    (SNOWFALL, {"amount": 3.0}, {"emission.intensity": 3.0}),
    (RAINFALL, {"amount": 0.5}, {"emission.intensity": 0.5}),
    # Where the visibility follows the scene, its multiple follows the amount.
    (SANDSTORM, {"amount": 2.0}, {"emission.intensity": 0.5, "adaptation.visibility": 0.5}),
    (FOG, {"amount": 0.5}, {"emission.intensity": 2.0, "adaptation.visibility": 2.0}),
    (FOG, {"amount": 2.0}, {"emission.intensity": 0.5, "emission.most": 2.0, "adaptation.visibility": 0.5}),
    (SNOWFALL, {"opacity": 0.5}, {"appearance.active.opacity": 0.5, "appearance.collided.opacity": 0.5}),
    (FOG, {"opacity": 0.5}, {"appearance.collided.opacity": 0.5}),
    *((base, {"fall_speed": 0.4}, {"material.speed_factor": 0.4}) for base in EFFECTS.values()),
    (SNOWFALL, {"wind": 2.0}, {"wind.speed": 2.0, "wind.turbulence": 2.0}),
    (FOG, {"wind": 2.0}, {"wind.speed": 2.0, "wind.turbulence": 2.0, "wind.diffusivity": 2.0}),
    (SNOWFALL, {"tumbling": 3.0}, {"wind.flutter": 3.0}),
    (RAINFALL, {"tumbling": 3.0}, {}),
    (SNOWFALL, {"accumulates": True}, {}),
    (RAINFALL, {"accumulates": True}, {}),
    (RAINFALL, {"accumulates": False}, {}),
    (FOG, {"accumulates": False}, {}),
    *(
        (
            base,
            {"accumulates": False},
            {"surface.landing": "vanishes", "surface.accumulates": False, "appearance.collided.opacity": 0.0},
        )
        for base in (SNOWFALL, SANDSTORM)
    ),
]


@pytest.mark.parametrize(("base", "said", "expected"), TURNED)
def test_each_field_of_a_request_changes_its_own_numbers_and_no_others(base, said, expected):
    effect = applied(request(base.name, **said))
    assert changes(effect, base) == expected
    assert (effect.name, effect.prompt) == (base.name, PROMPT)
    assert EFFECTS[base.name] is base


def test_a_request_without_a_base_is_for_snow_and_a_given_base_comes_first():
    assert applied(request(None)).emission == SNOWFALL.emission
    heavier = replace(RAINFALL, emission=replace(RAINFALL.emission, intensity=20.0))
    assert applied(request("fog", amount=2.0), base=heavier).emission.intensity == 40.0
    assert applied(request(None), base=heavier) == replace(heavier, prompt=PROMPT)


@pytest.mark.parametrize(("base", "size"), [*product(EFFECTS.values(), [0.2, 0.7, 5.0])])
def test_particles_look_wider_by_the_factor(base, size):
    found, before = look(applied(request(base.name, size=size))), look(base)
    torch.testing.assert_close(found.active.scales, before.active.scales * size, rtol=1e-5, atol=0)


@pytest.mark.parametrize(("base", "size"), [*product(EFFECTS.values(), [0.2, 0.7, 5.0])])
def test_wider_particles_are_as_many_fall_as_fast_and_bring_as_much(base, size):
    def air(effect: Effect) -> tuple[Any, ...]:
        emission = effect.emission
        diameter = np.geomspace(emission.smallest, emission.largest, 4096)
        density, speed = number_density(diameter, emission, effect.material), fall_speed(diameter, effect.material)
        water = density * speed * effect.material.mass(diameter)
        return integral(density, diameter), integral(water, diameter), speed, effect.material.mass(diameter)

    for found, expected in zip(air(applied(request(base.name, size=size))), air(base), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("base", EFFECTS.values())
def test_twice_the_amount_is_twice_the_water_or_the_extinction(base):
    effect = applied(request(base.name, amount=2.0))
    if base.emission.precipitates:
        diameter = np.geomspace(base.emission.smallest, base.emission.largest, 4096)
        flux = number_density(diameter, effect.emission, effect.material) * fall_speed(diameter, effect.material)
        rate = 3600 * integral(flux * effect.material.mass(diameter), diameter)  # kg/(m^2 h), which is mm/h
        assert rate == pytest.approx(2 * base.emission.intensity, rel=1e-6)
    else:
        assert extinction(effect.emission) == pytest.approx(2 * extinction(base.emission))


@pytest.mark.parametrize("base", EFFECTS.values())
def test_amounts_stop_where_an_emission_refuses_and_say_so(base):
    low, high = INTENSITIES[base.emission.kind]
    for end, beyond in ((low, low * 0.999), (high, high * 1.001)):
        with pytest.raises(ValueError, match="intensity must lie in"):
            replace(base.emission, intensity=beyond)
        near = replace(base, emission=replace(base.emission, intensity=max(end, 0.01)))
        less = request(base.name, amount=5.0 if (end == high) == base.emission.precipitates else 0.1)
        if end > 0:
            assert applied(less, base=near).emission.intensity == end
            assert [said.endswith(f": {end:g} is used") for said in remarks(less, base=near)] == [True]


def test_no_parcel_of_fog_has_to_be_darker_than_opaque():
    for amount, size in product((0.1, 1.0, 5.0), (0.2, 1.0, 5.0)):
        effect = applied(request("fog", amount=amount, size=size))
        sizes = Sizes.of(effect, BOX, effect.emission.most or 0, Sight.everything())
        count = sizes.in_air()[-1] * BOX.volume
        assert count == pytest.approx(effect.emission.most, rel=0.01)
        # Optical depth in the middle of a parcel, by its part of the extinction that parcels cause and the area it covers.
        a, b, c = effect.appearance.active.scale_m or (0, 0, 0)
        depth = effect.emission.share * extinction(effect.emission) * BOX.volume / count / (2 * np.pi * (a * b * c) ** (2 / 3))
        assert depth < 0.6


@pytest.mark.parametrize("base", [SNOWFALL, RAINFALL, SANDSTORM])
def test_lights_are_those_of_the_active_particles_and_none_gets_weaker(base):
    """Particles differ by what they mirror at a moment (dynamics.sparkle), no longer by brightness and opacity for good."""
    effect = applied(request(base.name, glitter=0.7, glow=0.4, twinkle=2.0))
    assert changes(effect, base) == {
        "appearance.active.glitter": 0.7,
        "appearance.active.glow": 0.4,
        "appearance.active.twinkle_hertz": 2.0,
    }
    assert applied(request(base.name, glitter=0.1), base=effect).appearance == effect.appearance


def test_fog_has_no_facets():
    asked = request("fog", glitter=0.5)
    assert applied(asked).appearance == FOG.appearance
    assert remarks(asked) == ("glitter 0.5 changes nothing: droplets of fog have no facets",)


@pytest.mark.parametrize("base", EFFECTS.values())
def test_no_wind_is_still_air(base):
    field = WindField.draw(applied(request(base.name, wind=0.0)).wind, seed=0)
    points = np.random.default_rng(0).uniform(0, 10, (50, 3))
    assert abs(field.velocity(points, 3.0)).max() == 0
    assert applied(request(base.name, wind=0.0)).wind.diffusivity == 0


def test_gusts_grow_as_the_mean_wind_does():
    plain, strong = (WindField.draw(applied(request(wind=factor)).wind, seed=0) for factor in (1.0, 3.0))
    gusts = [np.array([field.at_reference(time) - field.mean for time in range(20)]) for field in (plain, strong)]
    np.testing.assert_allclose(gusts[1], 3 * gusts[0], rtol=1e-9)


def test_a_part_that_cannot_be_applied_is_remarked():
    assert remarks(request(size=2.0, amount=3.0, opacity=0.3, tumbling=3.0, accumulates=True)) == ()
    assert remarks(request("rainfall", accumulates=False)) == ()
    found = remarks(request("fog", opacity=0.5, tumbling=2.0, accumulates=True))
    assert [said.partition(":")[0] for said in found] == [
        "opacity 0.5 changes nothing",
        "tumbling 2 changes nothing",
        "nothing will accumulate",
    ]
    assert remarks(request("rainfall", accumulates=True)) == ("nothing will accumulate: rainfall wets surfaces",)


ENDS = [
    {name: limits[end] for (name, limits), end in zip(LIMITS.items(), ends, strict=True)}
    for ends in product((0, 1), repeat=len(LIMITS))
]


@pytest.mark.parametrize("base", BASES)
def test_the_ends_of_all_ranges_together_give_effects_with_lawful_numbers(base):
    assert len(ENDS) == 2 ** len(LIMITS) >= 128
    for said, accumulates in product(ENDS, (None, True, False)):
        effect = applied(request(base, rgb=(0.0, 0.0, 0.0), landed_rgb=(1.0, 1.0, 1.0), accumulates=accumulates, **said))
        remarks(request(base, accumulates=accumulates, **said))
        emission, law = effect.emission, effect.material
        ends = np.array([emission.smallest, emission.largest])
        if law.speed_law == "power":  # at the fit's own diameter, where 0.8 D^0.16 was measured: 1-12 mm
            lawful = fall_speeds.snow_fall_speed(ends / said["size"])
            np.testing.assert_allclose(fall_speed(ends, law), said["fall_speed"] * lawful, rtol=1e-9)
        else:
            assert (fall_speed(ends, law) > 0).all()  # refuses what its law was not made for
        for state in (effect.appearance.active, effect.appearance.collided):
            assert state.opacity is None or 0 <= state.opacity <= 1


@pytest.mark.parametrize("base", BASES)
def test_the_ends_of_each_range_give_looks_that_can_be_drawn(base):
    everything = [{name: limits[end] for name, limits in LIMITS.items()} for end in (0, 1)]
    for said in [*everything, *({name: value} for name, limits in LIMITS.items() for value in limits)]:
        effect = applied(request(base, rgb=PURPLE, landed_rgb=(0.0, 1.0, 0.0), dyed=True, accumulates=False, **said))
        found = look(effect)
        for state in (found.active, found.collided):
            assert 0 < state.opacity.min() <= state.opacity.max() < 1
            assert 0 <= state.rgb.min() <= state.rgb.max() <= 1
            assert 0 < state.scales.min() <= state.scales.max() < 15
        assert found.active.rgb[:, 1].max() == 0  # no green in purple
        sizes = Sizes.of(effect, BOX, 20_000, Sight.everything())
        assert np.isfinite(sizes.in_air()).all() and sizes.in_air()[-1] > 0


def test_every_kind_that_the_reader_knows_can_be_applied():
    for name in KINDS:
        asked = read(f"heavy glittering {name}").request
        assert applied(asked).name == asked.base


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--weather", "the meaning of life"], "names nothing that could be in the air"),
        (["--weather", " "], "a text for the weather must have 1-400 characters, found 0"),
        (
            ["--weather", "purple snow", "--effect", "fog"],
            "--weather stands in place of --effect, got both 'purple snow' and fog",
        ),
        (["--weather", "purple snow", "--intensity", "-2"], "intensity must lie in 0.01-100 mm/h of water, got -2"),
        (["--weather", "thin fog", "--exposure", "3"], "exposure must lie in 0-1 s, got 3"),
    ],
)
def test_words_that_are_no_weather_get_one_sentence_and_exit_code_1(tmp_path, capsys, monkeypatch, flags, sentence):
    monkeypatch.chdir(tmp_path)
    assert run(["preview", "--load-scene", "demo", *flags]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and said[0].startswith("pgsd: ") and sentence in said[0]
    assert list(tmp_path.iterdir()) == []


def test_a_preview_in_words_says_what_it_understood_and_shows_that(yard, tmp_path, capsys, monkeypatch):
    made: list[Effect] = []

    def stop(prepared: Any, effect: Effect, *others: Any, **named: Any) -> None:
        made.append(effect)
        raise ValueError("seen enough")

    monkeypatch.setattr("pgsd_nerfstudio.weather.making.make_weather", stop)
    scene = SceneOptions(load_scene=yard[0], data=yard[1])
    heavy = EffectOptions(weather="heavy purple blorp rain that accumulates")
    for options in (heavy, EffectOptions(weather="purple snow", intensity=0.7, exposure=0.01)):
        with pytest.raises(Refusal, match="seen enough"):
            Preview(scene=scene, weather=options, output=tmp_path / "v.mp4").run()
    said = " ".join(capsys.readouterr().err.split())
    rain, snow = made
    assert rain == applied(read("heavy purple blorp rain that accumulates").request)
    for effect, own in ((rain, RAINFALL), (snow, SNOWFALL)):  # matter in that colour, not the colour of a display
        tinted = in_matter(own.appearance.active.rgb, (128 / 255, 0, 128 / 255), own.emission.kind)
        assert effect.appearance.active.rgb == pytest.approx(tinted, abs=1e-6)
    assert "understood rain = rainfall; heavy = amount 2; purple = colour (0.50, 0.00, 0.50)" in said
    assert "Ignored: blorp" in said
    assert "nothing will accumulate: rainfall wets surfaces" in said
    assert (snow.emission.intensity, snow.appearance.exposure) == (0.7, 0.01)


def test_particles_that_shall_not_accumulate_vanish_where_they_land():
    corners = torch.tensor([[-3.0, -3, 0], [3, -3, 0], [3, 3, 0], [-3, 3, 0]])
    floor = SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))
    domain, clock = Domain((-2.0, -2.0, -0.2), (2.0, 2.0, 2.0)), Clock(fps=25.0, frames=40)
    for base, accumulates in product((SNOWFALL, SANDSTORM), (None, False)):
        effect = replace(applied(request(base.name, accumulates=accumulates)), timeline=Timeline())  # all at once
        about = (history := simulate_metric(floor, effect, clock, domain, max_particles=400, progress=False)).about
        landed, vanished = ("absorbed", "landed") if accumulates is False else ("landed", "absorbed")
        assert about[landed] > 50 and about[vanished] == 0
        assert int(history.collided.sum()) == about["landed"]
