"""Photographs are found under every name that files of cameras give them, and read in every kind that people have."""

from __future__ import annotations

import random
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.captures.lenses import lens_of
from pgsd_nerfstudio.scene.captures.photographs import Photograph, find_photographs, read_photograph
from pgsd_nerfstudio.scene.errors import SceneError

WIDTH, HEIGHT = 32, 24
LENS = lens_of("PINHOLE", WIDTH, HEIGHT, {"fx": 30.0, "fy": 30.0, "cx": 16.0, "cy": 12.0}, "a photograph")
CAMERA = Cameras(torch.eye(4)[None], LENS.K.float()[None], WIDTH, HEIGHT)


def pixels(channels: int = 3) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8)


def shown(path: Path, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    return 255 * read_photograph(Photograph(path, LENS), CAMERA, background).rgb.numpy()


def png16(path: Path, values: np.ndarray) -> Path:
    """A PNG of 16 bits, grey [h, w] or colour [h, w, 3], which PIL cannot write."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    kind = 2 if values.ndim == 3 else 0
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], 16, kind, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))
    return path


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("images/a.jpg", "images/a.jpg"),
        ("images\\a.jpg", "images/a.jpg"),
        (".\\images\\a.jpg", "images/a.jpg"),
        ("./images/a", "images/a.png"),  # Blender, instant-ngp
        ("images/a", "images/a.JPG"),
        ("images/a.png", "images/a.jpg"),
        ("images/frame.0001", "images/frame.0001.png"),
        ("images/a.jpg", "images_4/a.jpg"),
        ("a.jpg", "images/a.jpg"),
        ("images/left/a.jpg", "images_2/a.jpg"),  # where nerfstudio's dataparser looks
        ("images/left/a.jpg", "images/left_2/a.jpg"),
        ("/somewhere/else/images/a.jpg", "images/a.jpg"),
        ("C:\\data\\garden\\images\\a.jpg", "images/a.jpg"),
        ("../beside/a.jpg", "../beside/a.jpg"),
    ],
)
def test_photographs_are_found_as_they_are_named(name, place, tmp_path):
    folder = tmp_path / "data"
    path = folder / place
    folder.mkdir()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    (found,) = find_photographs([name], [folder, folder / "images"])
    assert found.resolve() == path.resolve()


def test_photographs_that_are_not_there_keep_their_names(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.txt").touch()
    names = ["images/a.jpg", "images/" + 3000 * "a", "images", "/gone/b.jpg", "a\udcff.jpg"]
    found = find_photographs(names, [tmp_path])
    assert not any(path.is_file() for path in found if len(path.name) < 100)
    assert found[0] == tmp_path / "images" / "a.jpg"


def test_sixteen_bits_are_scaled_and_not_cut_off(tmp_path):
    grey = np.random.default_rng(2).integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
    found = shown(png16(tmp_path / "grey.png", grey))
    assert np.abs(found - grey[..., None] / 257).max() < 0.01
    colour = np.random.default_rng(2).integers(0, 65536, (HEIGHT, WIDTH, 3)).astype(np.uint16)
    assert np.abs(shown(png16(tmp_path / "colour.png", colour)) - colour / 257).max() < 1.0
    Image.fromarray(grey).save(tmp_path / "grey.tif")
    assert np.abs(shown(tmp_path / "grey.tif") - grey[..., None] / 257).max() < 0.01


def test_what_is_transparent_shows_the_background(tmp_path):
    """splatfacto composites photographs in training: alpha * rgb + (1 - alpha) * background."""
    rgba = pixels(4)
    Image.fromarray(rgba, "RGBA").save(tmp_path / "a.png")
    Image.fromarray(rgba[..., [0, 3]], "LA").save(tmp_path / "grey.png")
    background = np.array([0.2, 0.4, 0.6])
    alpha = rgba[..., 3:] / 255
    assert (
        np.abs(shown(tmp_path / "a.png", (0.2, 0.4, 0.6)) - (alpha * rgba[..., :3] + (1 - alpha) * 255 * background)).max()
        < 0.01
    )
    grey = alpha * rgba[..., :1] + (1 - alpha) * 255 * background
    assert np.abs(shown(tmp_path / "grey.png", (0.2, 0.4, 0.6)) - grey).max() < 0.01
    palette = Image.fromarray(pixels()).quantize(16)
    palette.save(tmp_path / "palette.png", transparency=3)
    clear = np.asarray(palette) == 3
    assert np.abs(shown(tmp_path / "palette.png", (0.2, 0.4, 0.6))[clear] - 255 * background).max() < 0.01


def test_a_damaged_photograph_is_named(tmp_path):
    Image.fromarray(pixels()).save(tmp_path / "whole.jpg")
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "whole.jpg").read_bytes()[:700])
    (tmp_path / "text.png").write_text("hello")
    for name in ("cut.jpg", "text.png", "none.png"):
        with pytest.raises(SceneError, match=rf"the picture .*{name} cannot be read \(.*copy it again") as refusal:
            shown(tmp_path / name)
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "webp", "bmp"])
def test_mutated_photographs_are_read_or_refused(suffix, tmp_path):
    draw = random.Random(3)
    Image.fromarray(pixels(4 if suffix == "png" else 3)).save(tmp_path / f"a.{suffix}")
    whole = (tmp_path / f"a.{suffix}").read_bytes()
    for number in range(60):
        damaged = bytearray(whole)
        for _ in range(draw.choice((1, 4))):
            damaged[draw.randrange(min(len(whole), 200))] = draw.randrange(256)
        path = tmp_path / f"{number}.{suffix}"
        path.write_bytes(damaged)
        try:
            read_photograph(Photograph(path, LENS), CAMERA)
        except SceneError as refusal:
            assert path.name in str(refusal) and "\n" not in str(refusal)
