"""The costly parts of an answer are computed once, and a stored answer equals the computed one."""

from dataclasses import fields, replace

import pytest
import torch
from PIL import Image
from plugin_scene import write_scene

from pgsd_nerfstudio.effects import effect
from pgsd_nerfstudio.response import prepare
from pgsd_nerfstudio.response.answer import Answer
from pgsd_nerfstudio.response.edits import Edits
from pgsd_nerfstudio.response.exposure import Exposure
from pgsd_nerfstudio.response.prepare import answer_of, edits_of, save_answer, softening_of, stored_answer, to_metric
from pgsd_nerfstudio.response.sunlight import Sunlight
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh
from pgsd_nerfstudio.weather.loading import load_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    ply = write_scene(tmp_path_factory.mktemp("scene"))
    return load_scene(str(ply), ply.parent)


@pytest.fixture(scope="module")
def floor() -> SurfaceMesh:
    corners = torch.tensor([[-8.0, -8, 0], [8, -8, 0], [8, 8, 0], [-8, 8, 0]])
    return SurfaceMesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))


def same(one: Answer, other: Answer) -> bool:
    pairs = [(getattr(one.exposure, f.name), getattr(other.exposure, f.name)) for f in fields(Exposure)]
    pairs += [(one.coating.thickness_rate, other.coating.thickness_rate)]
    return all(torch.equal(a, b) for a, b in pairs)


def test_an_answer_is_computed_once(scene, floor, monkeypatch):
    first = answer_of(scene, floor, effect("snowfall"), seconds=5.0)
    monkeypatch.setattr(prepare.Exposure, "of", None)  # would be called
    again = answer_of(scene, floor, effect("snowfall"), seconds=5.0)
    assert same(first, again) and again.seconds == 5.0
    with pytest.raises(TypeError):
        answer_of(scene, floor, effect("snowfall"), seconds=5.0, seed=1)


def test_what_rays_know_nothing_of_needs_no_new_rays(scene, floor, monkeypatch):
    answer_of(scene, floor, effect("snowfall"), seconds=5.0)
    monkeypatch.setattr(prepare.Exposure, "of", None)
    snow = effect("snowfall")
    whiter = replace(snow, surface=replace(snow.surface, hides=0.1))
    assert answer_of(scene, floor, whiter, seconds=5.0).effect == whiter


def test_a_stored_answer_is_the_same_with_its_edits_and_softening(scene, floor, tmp_path):
    n = len(scene.gaussians)
    edits = Edits(torch.rand(n, 3), torch.rand(n), torch.rand(n, 3))
    made = replace(answer_of(scene, floor, effect("rainfall"), seconds=5.0, edits=edits), softening=torch.rand(n, 3))
    save_answer(tmp_path / "a.safetensors", made)
    found = stored_answer(tmp_path / "a.safetensors", scene, effect("rainfall"), seconds=5.0)
    assert found is not None and same(found, made)
    assert torch.equal(found.softening, made.softening)
    assert found.edits is not None and all(torch.equal(found.edits.tensors[k], v) for k, v in edits.tensors.items())


def test_a_damaged_file_or_one_of_another_scene_is_no_answer(scene, floor, tmp_path):
    path = tmp_path / "a.safetensors"
    assert stored_answer(path, scene, effect("fog"), seconds=5.0) is None
    save_answer(path, answer_of(scene, floor, effect("fog"), seconds=5.0))
    smaller = replace(scene, gaussians=scene.gaussians.select(torch.arange(10)))
    assert stored_answer(path, smaller, effect("fog"), seconds=5.0) is None
    path.write_bytes(path.read_bytes()[:200])
    assert stored_answer(path, scene, effect("fog"), seconds=5.0) is None


def test_without_clouds_or_sun_nothing_softens(scene, floor, monkeypatch):
    metric = to_metric(scene)
    snow = effect("snowfall")
    exposure = Exposure.of(metric, floor, snow)
    none_is_sky = torch.zeros(len(metric))
    monkeypatch.setattr(prepare, "find_sunlight", lambda *_: None)
    assert softening_of(metric, exposure, floor, snow, none_is_sky) is None
    monkeypatch.setattr(prepare, "find_sunlight", lambda *_: Sunlight((0.0, 0.6, 0.8), 4.0, 0.2, 0.1, 9.0))
    assert softening_of(metric, exposure, floor, replace(snow, ambience=None), none_is_sky) is None
    softened = softening_of(metric, exposure, floor, snow, none_is_sky)
    assert softened is not None and (softened > 0).all()
    # The open floor keeps its light; what the table shades there gains, since clouds shine from all sides.
    open_floor = (exposure.normals[:, 2] > 0.9) & (exposure.sky > 0.99) & ~exposure.loose
    assert softened[open_floor].median() == pytest.approx(1.0, abs=0.1)


def test_mirrors_show_the_scene_without_the_shadows_that_clouds_take(scene, floor, monkeypatch):
    monkeypatch.setattr(prepare, "find_sunlight", lambda *_: Sunlight((0.0, 0.6, 0.8), 4.0, 0.2, 0.1, 9.0))
    darker = torch.tensor([0.25, 0.5, 1.0])
    monkeypatch.setattr(prepare, "softening_of", lambda metric, *_, **__: darker.expand(len(metric), 3))
    taken = answer_of(scene, floor, effect("rainfall"), seconds=5.0, seed=7).puddles
    monkeypatch.setattr(prepare, "softening_of", lambda *_, **__: None)
    left = answer_of(scene, floor, effect("rainfall"), seconds=5.0, seed=8).puddles
    assert taken is not None and left is not None
    assert torch.allclose(taken.scene.light, darker * left.scene.light, atol=1e-5)


def test_edited_pictures_are_fitted_once(scene, tmp_path, monkeypatch):
    for index in range(2):
        Image.new("RGB", (48, 32), (250, 250, 250)).save(tmp_path / f"{index}.png")
    fit = prepare.fit_edits
    monkeypatch.setattr(prepare, "fit_edits", lambda *args, **kwargs: fit(*args, steps=3, progress=False, **kwargs))
    first = edits_of(scene, tmp_path, "cpu")
    monkeypatch.setattr(prepare, "fit_edits", None)
    again = edits_of(scene, tmp_path, "cpu")
    assert all(torch.equal(first.tensors[k], v) for k, v in again.tensors.items()) and first.rgb.abs().max() > 0
