"""Edits of the frozen scene fitted to edited pictures: a known edit is found, and what no picture shows is not changed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pgsd_nerfstudio.rendering import choose_rasterizer
from pgsd_nerfstudio.response import edited
from pgsd_nerfstudio.response.edited import difference, edits_key, fit_edits
from pgsd_nerfstudio.response.edited_pictures import read_edited
from pgsd_nerfstudio.response.edits import Edits
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.lenses import pinhole
from pgsd_nerfstudio.scene.captures.photographs import Photograph
from pgsd_nerfstudio.scene.frame import Frame
from pgsd_nerfstudio.scene.gaussians import Gaussians, concatenate
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0, view_colors
from pgsd_nerfstudio.storage import content_key

SIDE = 12  # Gaussians along an edge of the slab
TOP = slice(0, SIDE * SIDE)
UNDERSIDE = slice(SIDE * SIDE, None)
WHITE = 0.9


def layer(z: float, half: float, seed: int) -> Gaussians:
    """A sheet of flat, nearly opaque Gaussians of dark colours."""
    x, y = torch.meshgrid(*2 * [torch.linspace(-half, half, SIDE)], indexing="ij")
    n, spacing = SIDE * SIDE, 2 * half / (SIDE - 1)
    colors = 0.05 + 0.3 * torch.rand(n, 3, generator=torch.Generator().manual_seed(seed))
    harmonics = torch.zeros(n, 4, 3)
    harmonics[:, 0] = (colors - 0.5) / SH_C0
    flat = torch.tensor([0.8 * spacing, 0.8 * spacing, 0.01])
    means = torch.stack([x.flatten(), y.flatten(), torch.full((n,), z)], dim=1)
    return Gaussians(means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), flat.repeat(n, 1), torch.full((n,), 0.98), harmonics)


def from_above(count: int, width: int, height: int) -> Cameras:
    poses = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        eye = torch.tensor([1.2 * math.cos(angle), 1.2 * math.sin(angle), 2.6])
        back = eye / eye.norm()
        right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([-math.sin(angle), 0.3, 1.0]), back), dim=0)
        poses.append(torch.stack([right, torch.linalg.cross(back, right), back, eye], dim=1))
    K = torch.tensor([[0.9 * width, 0.0, width / 2], [0.0, 0.9 * width, height / 2], [0.0, 0.0, 1.0]])
    return Cameras.from_opengl(torch.stack(poses), K.repeat(count, 1, 1), width, height)


def slab(views: int = 7, width: int = 48, height: int = 32, images: tuple[Path, ...] = ()) -> Scene:
    """A slab seen from above: its underside, a smaller sheet, is hidden by its top."""
    frame = Frame(1.0, torch.eye(3), torch.zeros(3))
    cameras = from_above(views, width, height)
    photographs = tuple(Photograph(path, pinhole(cameras[index])) for index, path in enumerate(images))
    return Scene("slab", concatenate([layer(0.0, 1.0, 1), layer(-0.3, 0.4, 2)]), cameras, frame, photographs)


def whitened(gaussians: Gaussians) -> Gaussians:
    """Snow on the half of the top where x > 0."""
    colors = gaussians.colors.clone()
    snowed = torch.arange(len(gaussians)) < TOP.stop
    snowed &= gaussians.means[:, 0] > 0
    colors[snowed, 0] = (WHITE - 0.5) / SH_C0
    return replace(gaussians, colors=colors)


def picture(gaussians: Gaussians, cameras: Cameras, view: int) -> torch.Tensor:
    return (choose_rasterizer(gaussians, "cpu").render(cameras[view]).rgb[0].clamp(0, 1) * 255 + 0.5).byte()


def psnr(found: torch.Tensor, expected: torch.Tensor) -> float:
    return -10 * math.log10(((found.float() - expected.float()) / 255).square().mean().clamp_min(1e-12).item())


def bits(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.contiguous().view(torch.int32)


def same_bits(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(bits(one[name]), bits(other[name])) for name in one)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return slab()


@pytest.fixture(scope="module")
def pictures(scene: Scene) -> list:
    """All views but the last, under snow."""
    snowed = whitened(scene.gaussians)
    return [(view, picture(snowed, scene.cameras, view)) for view in range(len(scene.cameras) - 1)]


@pytest.fixture(scope="module")
def fitted(scene: Scene, pictures: list) -> Edits:
    before = content_key(scene.gaussians, scene.cameras, [image for _, image in pictures])
    edits = fit_edits(scene, pictures, steps=200, progress=False)
    assert content_key(scene.gaussians, scene.cameras, [image for _, image in pictures]) == before
    return edits


def test_a_known_edit_is_recovered_in_a_view_that_was_held_out(scene, fitted):
    view = len(scene.cameras) - 1
    expected = picture(whitened(scene.gaussians), scene.cameras, view)
    without = psnr(picture(scene.gaussians, scene.cameras, view), expected)
    with_edits = psnr(picture(fitted.applied(scene.gaussians, 1.0), scene.cameras, view), expected)
    assert with_edits > without + 12 and with_edits > 25


def test_the_change_is_where_the_editor_changed_something(scene, fitted):
    x, brightening = scene.gaussians.means[TOP, 0], fitted.rgb[TOP].mean(1)
    assert brightening[x > 0.2].median() > 0.5
    assert brightening[x < -0.2].abs().median() < 0.03


def test_what_no_edited_view_shows_stays_exactly_as_it_is(scene, fitted):
    for name, tensor in fitted.tensors.items():
        assert torch.count_nonzero(tensor[UNDERSIDE]) == 0, name
    shown = fitted.applied(scene.gaussians, 1.0)
    assert same_bits(scene.gaussians.select(torch.arange(144, 288)).tensors, shown.select(torch.arange(144, 288)).tensors)


def test_colour_is_preferred_to_opacity_and_size(fitted):
    assert fitted.rgb[TOP].abs().mean() > 3 * max(fitted.logit[TOP].abs().mean(), fitted.log_scale[TOP].abs().mean())


def test_what_is_darker_than_black_can_whiten_too():
    """Colours are cut off at 0, and harmonics of captures reach below it: without care, nothing would draw them up again."""
    scene = slab()
    scene.gaussians.colors[:, 0] = (-0.3 - 0.5) / SH_C0
    cameras = scene.cameras
    pictures = [(view, picture(whitened(scene.gaussians), cameras, view)) for view in range(len(cameras))]
    edits = fit_edits(scene, pictures, steps=120, progress=False)
    shown, black = (picture(g, cameras, 0) for g in (edits.applied(scene.gaussians, 1.0), scene.gaussians))
    assert psnr(shown, pictures[0][1]) > psnr(black, pictures[0][1]) + 6


def test_the_same_seed_gives_the_same_bits_and_another_does_not(scene, pictures):
    one, same, other = (fit_edits(scene, pictures, steps=12, seed=seed, progress=False) for seed in (3, 3, 4))
    assert same_bits(one.tensors, same.tensors)
    assert not same_bits(one.tensors, other.tensors)


def test_smaller_pictures_at_work_are_not_taken_for_an_edit():
    """Gaussians look wider where pixels are larger; an editor that changed nothing must not be answered to that."""
    scene = slab(views=4, width=96, height=64)
    pictures = [(view, picture(scene.gaussians, scene.cameras, view)) for view in range(4)]
    edits = fit_edits(scene, pictures, steps=40, side=32, progress=False)
    shown = picture(edits.applied(scene.gaussians, 1.0), scene.cameras, 1)
    assert psnr(shown, pictures[1][1]) > 38


def test_loss_of_even_pictures_is_what_its_formula_says():
    """3DGS, eq. 7, where the variances vanish: SSIM = (2ab + C1) / (a^2 + b^2 + C1)."""
    a, b, c1 = 0.3, 0.7, 0.01**2
    found = difference(*(torch.full((20, 24, 3), value, dtype=torch.float64) for value in (a, b)))
    assert found.item() == pytest.approx(0.8 * (b - a) + 0.2 * (1 - (2 * a * b + c1) / (a * a + b * b + c1)), rel=1e-6)


# --- a change and its shares


def some_edits(n: int, seed: int = 0) -> Edits:
    generator = torch.Generator().manual_seed(seed)
    rgb, logit, log_scale = (torch.randn(*shape, generator=generator) for shape in ((n, 3), (n,), (n, 3)))
    return Edits(0.3 * rgb, 2 * logit, 0.5 * log_scale)


@pytest.mark.parametrize("harmonics", [True, False])
def test_share_0_is_the_scene_to_the_bit(scene, harmonics):
    gaussians = scene.gaussians if harmonics else replace(scene.gaussians, colors=torch.rand(288, 3))
    gaussians.colors.view(-1)[:6] = -0.0  # its bits would not survive adding zero
    gaussians.opacities[0], gaussians.opacities[1] = 0.0, 1.0
    edits = some_edits(288)
    assert same_bits(gaussians.tensors, edits.applied(gaussians, 0.0).tensors)
    share = torch.zeros(288)
    share[200:] = 0.5
    mixed = edits.applied(gaussians, share)
    assert same_bits(gaussians.select(torch.arange(200)).tensors, mixed.select(torch.arange(200)).tensors)
    half = edits.applied(gaussians, 0.5)
    assert same_bits(half.select(torch.arange(200, 288)).tensors, mixed.select(torch.arange(200, 288)).tensors)


@pytest.mark.parametrize("share", [0.35, 1.0])
def test_a_share_moves_colour_logit_and_log_scale_in_proportion(share):
    gaussians, edits = layer(0.0, 1.0, 5), some_edits(144, 5)
    found = edits.applied(gaussians, share)
    logit = torch.logit(gaussians.opacities.double()) + share * edits.logit.double()
    assert torch.allclose(found.opacities.double(), logit.sigmoid(), rtol=1e-5)
    assert torch.allclose(found.scales.double().log(), gaussians.scales.double().log() + share * edits.log_scale, atol=1e-5)
    assert torch.equal(found.means, gaussians.means) and torch.equal(found.quats, gaussians.quats)
    assert torch.equal(found.colors[:, 1:], gaussians.colors[:, 1:])
    bright = gaussians.colors.clone()
    bright[:, 0] += 20.0  # far from where colours are cut off
    wide = replace(gaussians, colors=bright)
    before, after = (view_colors(g.colors, g.means, torch.eye(4)) for g in (wide, edits.applied(wide, share)))
    assert torch.allclose(after - before, share * edits.rgb, atol=1e-5)


def test_opacities_stay_within_their_range_at_any_change():
    gaussians = replace(layer(0.0, 1.0, 6), opacities=torch.linspace(0, 1, 144))
    edits = replace(some_edits(144), logit=torch.linspace(-300, 300, 144))
    opacities = edits.applied(gaussians, 1.0).opacities
    assert torch.isfinite(opacities).all() and opacities.min() >= 0 and opacities.max() <= 1


def test_no_change_can_still_learn():
    """At zero the gradients are those of sigmoid, exp and the constant harmonic: o (1 - o), s, 1 / C0."""
    gaussians = layer(0.0, 1.0, 7)
    edits = Edits(*(torch.zeros(144, *shape, requires_grad=True) for shape in ((3,), (), (3,))))
    found = edits.applied(gaussians, 1.0)
    (found.colors.sum() + found.opacities.sum() + found.scales.sum()).backward()
    assert edits.rgb.grad is not None and edits.logit.grad is not None and edits.log_scale.grad is not None
    assert torch.allclose(edits.rgb.grad, torch.full((144, 3), 1 / SH_C0))
    assert torch.allclose(edits.logit.grad, gaussians.opacities * (1 - gaussians.opacities), rtol=1e-4)
    assert torch.allclose(edits.log_scale.grad, gaussians.scales)


@pytest.mark.mistyped
def test_a_change_of_other_gaussians_is_refused(scene):
    with pytest.raises(ValueError, match="for 5 Gaussians, found 288"):
        some_edits(5).applied(scene.gaussians, 1.0)
    with pytest.raises(ValueError, match=r"one share for each of the 288 Gaussians, found shape \(5,\)"):
        some_edits(288).applied(scene.gaussians, torch.ones(5))
    with pytest.raises(ValueError, match=r"Edits.logit must have shape \(4,\), found \(3,\)"):
        Edits(torch.zeros(4, 3), torch.zeros(3), torch.zeros(4, 3))


def test_a_stored_change_is_read_only_for_what_it_was_made_from(tmp_path):
    edits, path = some_edits(9), tmp_path / "made" / "edits.safetensors"
    edits.save(path, "abc")
    found = Edits.load(path, "abc")
    assert found is not None and same_bits(edits.tensors, found.tensors)
    assert Edits.load(path, "abd") is None and Edits.load(tmp_path / "none", "abc") is None
    path.write_bytes(path.read_bytes()[:40])
    assert Edits.load(path, "abc") is None


def test_the_key_knows_pictures_and_numbers(scene, pictures):
    changed = [(view, image.clone()) for view, image in pictures]
    changed[2][1][5, 5, 0] += 1
    keys = {
        edits_key(scene, pictures),
        edits_key(scene, changed),
        edits_key(scene, pictures[:3]),
        edits_key(scene, pictures, steps=7),
        edits_key(scene, pictures, seed=1),
        edits_key(scene, pictures, side=32),
        edits_key(scene, pictures, device="cuda"),  # where the pictures are worked on in their full size
        edits_key(replace(scene, gaussians=whitened(scene.gaussians)), pictures),
    }
    assert len(keys) == 8 and edits_key(scene, list(pictures)) in keys


# --- long work


class Interrupting:
    """`difference`, that breaks off or fails in some of its calls."""

    def __init__(self, *, stop: int | None = None, failing: range = range(0)) -> None:
        self.calls, self.stop, self.failing = 0, stop, failing

    def __call__(self, shown: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        if self.calls == self.stop:
            raise KeyboardInterrupt
        return difference(shown, target) * (math.nan if self.calls in self.failing else 1.0)


def test_a_fit_that_was_broken_off_ends_with_the_same_bits(scene, pictures, tmp_path, monkeypatch):
    whole = fit_edits(scene, pictures, steps=75, progress=False)
    state = tmp_path / "fit.safetensors"
    monkeypatch.setattr(edited, "difference", Interrupting(stop=65))
    with pytest.raises(KeyboardInterrupt):
        fit_edits(scene, pictures, steps=75, progress=False, resume=state)
    assert [path.name for path in tmp_path.iterdir()] == ["fit.safetensors"]
    monkeypatch.setattr(edited, "difference", rest := Interrupting())
    resumed = fit_edits(scene, pictures, steps=75, progress=False, resume=state)
    assert rest.calls == 25
    assert same_bits(whole.tensors, resumed.tensors)
    assert not state.exists()


def test_where_another_fit_stands_is_not_gone_on_from(scene, pictures, tmp_path, monkeypatch):
    state = tmp_path / "fit.safetensors"
    monkeypatch.setattr(edited, "difference", Interrupting(stop=55))
    with pytest.raises(KeyboardInterrupt):
        fit_edits(scene, pictures, steps=60, seed=1, progress=False, resume=state)
    monkeypatch.setattr(edited, "difference", fresh := Interrupting())
    fit_edits(scene, pictures, steps=10, progress=False, resume=state)
    assert fresh.calls == 10


def test_a_disk_that_takes_nothing_does_not_end_the_fit(scene, pictures, tmp_path, capsys):
    blocked = tmp_path / "file"
    blocked.write_text("in the way of a folder")
    fit_edits(scene, pictures, steps=51, progress=False, resume=blocked / "fit.safetensors")
    assert "could not store step 50" in capsys.readouterr().err


def test_steps_without_a_finite_gradient_change_nothing_and_are_counted(scene, pictures, monkeypatch, capsys):
    monkeypatch.setattr(edited, "difference", Interrupting(failing=range(1, 5)))
    edits = fit_edits(scene, pictures, steps=4, progress=False)
    assert all(torch.count_nonzero(tensor) == 0 for tensor in edits.tensors.values())
    assert "4 of 4 steps had no finite gradient" in capsys.readouterr().err


def test_five_of_them_in_a_row_end_the_fit(scene, pictures, monkeypatch):
    monkeypatch.setattr(edited, "difference", Interrupting(failing=range(3, 20)))
    with pytest.raises(FloatingPointError, match="NaN or infinite in 5 steps in a row, up to step 7"):
        fit_edits(scene, pictures, steps=20, progress=False)


# --- bad input


@pytest.mark.mistyped
def test_what_cannot_be_fitted_is_refused(scene, pictures):
    with pytest.raises(ValueError, match="at least one edited picture, found none"):
        fit_edits(scene, [], progress=False)
    with pytest.raises(ValueError, match="views 0 to 6, found a picture of view 7"):
        fit_edits(scene, [(7, pictures[0][1])], progress=False)
    with pytest.raises(ValueError, match=r"must be uint8 \[32, 48, 3\], found torch.float32 \[32, 48, 3\]"):
        fit_edits(scene, [(0, pictures[0][1] / 255)], progress=False)
    with pytest.raises(ValueError, match="found steps=0, side=None"):
        fit_edits(scene, pictures, steps=0, progress=False)
    behind = replace(scene, gaussians=replace(scene.gaussians, means=scene.gaussians.means + torch.tensor([0.0, 0.0, 50.0])))
    with pytest.raises(ValueError, match="none of the 288 Gaussians is seen in the 6 edited views"):
        fit_edits(behind, pictures, progress=False)


@pytest.fixture
def captured() -> Scene:
    """With photographs, in an order that is not that of their numbers."""
    return slab(views=3, images=tuple(Path(f"images/frame_{number:05d}.jpg") for number in (12, 3, 40)))


def write(path: Path, value: int, size: tuple[int, int] = (48, 32)) -> None:
    Image.new("RGB", size, (value, value, value)).save(path)


def test_pictures_are_found_by_the_names_of_the_photographs(captured, tmp_path, capsys):
    write(tmp_path / "frame_00003.png", 30)
    write(tmp_path / "frame_00012.webp", 120, (480, 320))
    write(tmp_path / "frame_00099.jpg", 0)
    Image.new("RGBA", (48, 32), (40, 40, 40, 255)).save(tmp_path / "frame_00040.tif")
    (tmp_path / "frame_00003.txt").write_text("the prompt")
    write(tmp_path / "._frame_00003.png", 0)
    found = read_edited(tmp_path, captured)
    assert [index for index, _ in found] == [0, 1, 2]
    for (_, image), value in zip(found, (120, 30, 40), strict=True):
        assert image.shape == (32, 48, 3) and image.dtype == torch.uint8
        assert (image.float() - value).abs().max() <= 2  # .webp loses a little
    assert "1 of the 4 pictures" in (note := capsys.readouterr().err) and "frame_00099.jpg" in note


def test_pictures_of_another_aspect_are_not_stretched_and_change_nothing_beyond_their_edges(captured, tmp_path):
    """An editor's square of a 48x32 view shows its middle 32 columns; the rest is the scene as it is."""
    write(tmp_path / "frame_00003.png", 200, (512, 512))
    ((_, image),) = read_edited(tmp_path, captured)
    assert (image[:, 8:40] == 200).all()
    scene = picture(captured.gaussians, captured.cameras, 1)
    assert torch.equal(image[:, :8], scene[:, :8]) and torch.equal(image[:, 40:], scene[:, 40:])


def test_edits_of_a_distorted_photograph_are_undistorted_as_it_is(captured, tmp_path):
    """A pincushion lens draws what lies 0.25 focal lengths to the right of the middle 0.28 focal lengths to the right."""
    bent = replace(captured.photographs[1].lens, radial=(2.0,))
    scene = replace(captured, photographs=tuple(replace(photograph, lens=bent) for photograph in captured.photographs))
    stripe = np.zeros((32, 48, 3), np.uint8)
    stripe[:, int(bent.cx + bent.fx * 0.25 * (1 + 2 * 0.25**2))] = 255  # column 36; a pinhole's is 34
    Image.fromarray(stripe).save(tmp_path / "frame_00003.png")
    ((_, image),) = read_edited(tmp_path, scene)
    assert int(image[16, :, 0].argmax()) in (34, 35)


def test_sixteen_bits_of_an_edited_picture_are_scaled(captured, tmp_path):
    Image.fromarray(np.full((32, 48), 51 * 257, np.uint16)).save(tmp_path / "frame_00003.png")
    ((_, image),) = read_edited(tmp_path, captured)
    assert (image == 51).all()


def test_without_photographs_the_number_in_the_name_is_the_view(tmp_path):
    write(tmp_path / "view_0002.png", 20)
    write(tmp_path / "snow 0.png", 0)
    write(tmp_path / "take2_view1.png", 1)  # which of the two?
    write(tmp_path / "view_0007.png", 70)
    assert [(index, int(image[0, 0, 0])) for index, image in read_edited(tmp_path, slab(views=3))] == [(0, 0), (2, 20)]


def test_a_folder_without_fitting_pictures_is_refused_with_two_names_that_would_fit(captured, tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path / 'none'} does not exist"):
        read_edited(tmp_path / "none", captured)
    (tmp_path / "a.txt").write_text("no picture")
    with pytest.raises(ValueError, match=r"a\.txt is a file"):
        read_edited(tmp_path / "a.txt", captured)
    with pytest.raises(
        ValueError, match=r"one of the 3 views: expected names such as frame_00012\.png and frame_00003\.png, found no"
    ):
        read_edited(tmp_path, captured)
    write(tmp_path / "IMG_1.png", 0)
    with pytest.raises(ValueError, match=r"found 1 pictures, such as IMG_1\.png"):
        read_edited(tmp_path, captured)
    (tmp_path / "IMG_1.png").rename(tmp_path / "x.png")
    with pytest.raises(ValueError, match=r"expected names such as view_0000\.png and view_0001\.png"):
        read_edited(tmp_path, slab(views=3))


def test_pictures_that_cannot_be_read_or_tell_two_stories_are_refused_by_name(captured, tmp_path):
    write(tmp_path / "frame_00003.png", 30)
    whole = (tmp_path / "frame_00003.png").read_bytes()
    (tmp_path / "frame_00003.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"frame_00003\.png cannot be read"):
        read_edited(tmp_path, captured)
    (tmp_path / "frame_00003.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"frame_00003\.png cannot be read"):
        read_edited(tmp_path, captured)
    write(tmp_path / "frame_00003.jpg", 30)
    with pytest.raises(ValueError, match=r"frame_00003\.jpg and frame_00003\.png in .* both show view 1"):
        read_edited(tmp_path, captured)
