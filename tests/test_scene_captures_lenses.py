"""Lenses draw where COLMAP and OpenCV say, and photographs become those of a pinhole."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.lenses import MODELS, READ, Lens, lens_of
from pgsd_nerfstudio.scene.captures.photographs import Photograph, read_photograph
from pgsd_nerfstudio.scene.errors import SceneError

TRUTH = json.loads((Path(__file__).parent / "colmap" / "truth.json").read_text())  # of COLMAP 4.2.1, see colmap_truth.py


def lens(model: str) -> Lens:
    names = MODELS[model][1].split()
    return lens_of(model, 620, 500, dict(zip(names, TRUTH["lenses"][model]["parameters"], strict=True)), "a photograph")


def pinhole(K: np.ndarray, width: int, height: int) -> Cameras:
    return Cameras(torch.eye(4)[None], torch.from_numpy(K).float()[None], width, height)


def smooth(width: int, height: int) -> np.ndarray:
    """A picture without edges, so that the way of interpolation does not matter."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    waves = [0.5 + 0.4 * np.sin(2 * np.pi * (a * x + b * y)) for a, b in ((1, 0.5), (0.5, 2), (2, 1))]
    return np.round(255 * np.stack(waves, axis=2)).astype(np.uint8)


@pytest.mark.parametrize("model", READ)
def test_lenses_draw_where_colmap_says(model):
    points, pixels = torch.tensor(TRUTH["points"], dtype=torch.float64), torch.tensor(TRUTH["lenses"][model]["pixels"])
    found, drawn = lens(model).pixels(points)
    assert drawn.all()
    assert (found - pixels).abs().max() < 1e-4


def test_models_that_no_pinhole_stands_for_are_refused_by_name():
    for model in ("EQUIRECTANGULAR", "RAD_TAN_THIN_PRISM_FISHEYE", "FISHEYE624", "VR180_L"):
        with pytest.raises(SceneError, match=rf"the lens of a\.jpg was taken with a {model} camera.*cut panoramas"):
            lens_of(model, 64, 48, {}, "the lens of a.jpg")


def test_beyond_its_fold_a_lens_draws_nothing():
    """r (1 - r^2 / 3) rises up to r = 1 and falls beyond."""
    bent = lens_of("SIMPLE_RADIAL", 640, 480, {"f": 100.0, "cx": 320.0, "cy": 240.0, "k1": -1 / 3}, "a photograph")
    _, drawn = bent.pixels(torch.tensor([[0.0, 0.99], [-0.7, 0.7], [1.01, 0.0], [0.0, 2.0]], dtype=torch.float64))
    assert drawn.tolist() == [True, True, False, False]
    _, drawn = lens("SIMPLE_DIVISION").pixels(torch.tensor([[5.0, 0.0]], dtype=torch.float64))
    assert drawn.all()


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_photographs_are_undistorted_as_opencv_does(model, tmp_path):
    """OpenCV counts pixel centres as whole numbers, COLMAP and nerfstudio as halves."""
    bent, picture = lens(model), smooth(620, 500)
    Image.fromarray(picture).save(tmp_path / "a.png")
    seen = read_photograph(Photograph(tmp_path / "a.png", bent), pinhole(bent.K.numpy(), 620, 500))
    K = bent.K.numpy() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    p = TRUTH["lenses"][model]["parameters"][4:]
    if model == "OPENCV_FISHEYE":
        maps = cv2.fisheye.initUndistortRectifyMap(K, np.array(p), np.eye(3), K, (620, 500), cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(K, np.array(p), None, K, (620, 500), cv2.CV_32FC1)
    expected = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    known = seen.known.numpy()
    assert known.mean() > 0.9 and known.all() == (model == "OPENCV_FISHEYE")
    assert np.abs(255 * seen.rgb.numpy() - expected)[known].max() < 1.01
    inside = (maps[0] > -0.5) & (maps[0] < 619.5) & (maps[1] > -0.5) & (maps[1] < 499.5)
    assert (known == inside).mean() > 0.999


def test_a_straight_photograph_in_the_camera_s_size_keeps_its_pixels(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    straight = lens_of("PINHOLE", 64, 48, {"fx": 70.0, "fy": 71.0, "cx": 31.0, "cy": 25.0}, "a photograph")
    seen = read_photograph(Photograph(tmp_path / "a.png", straight), pinhole(straight.K.numpy(), 64, 48))
    assert seen.known.all()
    assert (255 * seen.rgb - torch.from_numpy(pixels)).abs().max() < 0.01


SIZES = [((1240, 1000), "png"), ((2483, 2001), "jpg"), ((310, 250), "png"), ((155, 125), "png")]


@pytest.mark.parametrize(("stored", "suffix"), SIZES)
def test_photographs_of_any_size_show_the_same(stored, suffix, tmp_path):
    """Shrunk and enlarged copies (images_2) give the picture of the camera to two levels of 255, without a shift."""
    straight = lens("PINHOLE")
    Image.fromarray(smooth(*stored)).save(tmp_path / f"a.{suffix}", quality=98)
    K = straight.K.numpy() * np.array([[0.25], [0.25], [1]])
    seen = read_photograph(Photograph(tmp_path / f"a.{suffix}", straight), pinhole(K, 155, 125))
    exact = smooth(620, 500).reshape(125, 4, 155, 4, 3).mean((1, 3))
    assert np.abs(255 * seen.rgb.numpy() - exact).max() < 3.0
    assert np.abs((255 * seen.rgb.numpy() - exact).mean()) < 0.3


def test_another_aspect_is_the_middle_of_the_view_and_is_not_stretched(tmp_path):
    picture = smooth(512, 512)
    Image.fromarray(picture[64:448]).save(tmp_path / "rows.png")
    Image.fromarray(picture[:, 100:412]).save(tmp_path / "columns.png")
    square = lens_of("PINHOLE", 512, 512, {"fx": 500.0, "fy": 500.0, "cx": 256.0, "cy": 250.0}, "a photograph")
    camera = pinhole(square.K.numpy(), 512, 512)
    for name, shown in (("rows", np.s_[64:448, :]), ("columns", np.s_[:, 100:412])):
        seen = read_photograph(Photograph(tmp_path / f"{name}.png", square), camera)
        expected = np.zeros((512, 512), dtype=bool)
        expected[shown] = True
        assert (seen.known.numpy() == expected).all()
        assert np.abs(255 * seen.rgb.numpy() - picture)[expected].max() < 0.01


def test_what_is_masked_out_is_not_known(tmp_path):
    Image.fromarray(smooth(64, 48)).save(tmp_path / "a.png")
    mask = np.zeros((48, 64), dtype=np.uint8)
    mask[:, 20:] = 1  # nerfstudio takes all but black for trained on
    Image.fromarray(mask).save(tmp_path / "mask.png")
    straight = lens_of("PINHOLE", 64, 48, {"fx": 70.0, "fy": 70.0, "cx": 32.0, "cy": 24.0}, "a photograph")
    seen = read_photograph(Photograph(tmp_path / "a.png", straight, tmp_path / "mask.png"), pinhole(straight.K.numpy(), 64, 48))
    assert (seen.known.numpy() == (mask > 0)).all()
