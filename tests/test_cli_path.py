"""Laws of `pgsd path`: nerfstudio reads what it writes, the whole weather passes along it, bad input gets one sentence."""

import json

import pytest
import torch

from pgsd_nerfstudio.cli.main import run


def written(yard, output, kind: str, *flags: object) -> dict:
    ply, data = yard
    words = ["path", kind, "--load-scene", ply, "--data", data, "--output", output, "--trust-cameras", "True", *flags]
    assert run([str(word) for word in words]) == 0
    return json.loads(output.read_text())


@pytest.mark.parametrize("kind", ["orbit", "interpolate", "dolly", "still"])
def test_a_path_of_each_kind_is_one_along_which_the_whole_weather_passes(yard, tmp_path, capsys, kind):
    from nerfstudio.cameras.camera_paths import get_path_from_json

    path = written(yard, tmp_path / "path.json", kind, "--seconds", 0.4)
    assert capsys.readouterr().out == f"{tmp_path / 'path.json'}\n"
    cameras = get_path_from_json(path)
    assert cameras.times is not None and path["seconds"] == 0.4
    torch.testing.assert_close(cameras.times[:, 0], torch.linspace(0, 1, 10))
    assert (path["render_width"], path["render_height"]) == (96, 64), "the shape of the training views"
    moved = (cameras.camera_to_worlds[0] - cameras.camera_to_worlds[-1]).abs().max() > 1e-3
    assert bool(moved) == (kind != "still")


@pytest.mark.parametrize(
    ("flags", "size"),
    [(["--width", 49, "--height", 33], (48, 32)), (["--width", 48], (48, 32)), (["--height", 33], (50, 32))],
)
def test_pictures_have_even_sides(yard, tmp_path, flags, size):
    path = written(yard, tmp_path / "path.json", "still", "--seconds", 0.1, *flags)
    assert (path["render_width"], path["render_height"]) == size


@pytest.mark.parametrize(
    ("kind", "flags", "sentence"),
    [
        ("orbit", {"load-scene": "nowhere"}, "no scene at nowhere"),
        ("orbit", {"seconds": 0}, "--seconds must be positive, got 0"),
        ("orbit", {"seconds": "inf"}, "--seconds must be positive, got inf"),
        ("orbit", {"seconds": "1e9"}, "are more than 200,000 frames"),
        ("orbit", {"fps": -1}, "--fps must be positive, got -1"),
        ("orbit", {"width": 8}, "--width must lie in 16-8192, got 8"),
        ("orbit", {"degrees": "nan"}, "finite number of degrees"),
        ("dolly", {"forward": 2}, "less than the whole way"),
        ("still", {"view": 8}, "must lie in 0-7"),
        ("interpolate", {"views": (0, 8)}, "views must lie in 0-7"),
        ("still", {"output": "/proc/none/path.json"}, "No such file or directory"),
    ],
)
def test_bad_input_gets_one_sentence_and_exit_code_1(yard, tmp_path, capsys, monkeypatch, kind, flags, sentence):
    monkeypatch.chdir(tmp_path)
    ply, data = yard
    words = {"load-scene": ply, "data": data, "output": tmp_path / "path.json", "trust-cameras": True} | flags
    pairs = [(name, value if isinstance(value, tuple) else (value,)) for name, value in words.items()]
    assert run(["path", kind, *(str(word) for name, values in pairs for word in (f"--{name}", *values))]) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pgsd: ")]
    assert len(said) == 1 and sentence in said[0]
    assert list(tmp_path.iterdir()) == []
