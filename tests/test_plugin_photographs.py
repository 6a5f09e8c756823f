"""Views are compared with their photographs where these are there, and with nothing else."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from plugin_scene import HEIGHT, VIEWS, WIDTH, grouped, write_scene
from test_scene_captures_photographs import png16

from pgsd_nerfstudio.plugin import opening
from pgsd_nerfstudio.plugin.datamanager import TrajectoryDataManager, TrajectoryDataManagerConfig
from pgsd_nerfstudio.plugin.fidelity import fidelity
from pgsd_nerfstudio.plugin.options import RunOptions
from pgsd_nerfstudio.plugin.pipeline import WeatherPipeline
from pgsd_nerfstudio.plugin.run_cameras import from_nerfstudio
from pgsd_nerfstudio.plugin.views import BACKGROUND
from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.loading import read_scene
from pgsd_nerfstudio.scene.scene import SceneError
from pgsd_nerfstudio.storage import cache_dir

CLIP = {"clip_frames": 5, "clip_height": HEIGHT, "clip_width": WIDTH}
FLATTER = 0.05  # by so much photographs are less black and less white than renders


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene whose photographs are its renders with less contrast."""
    ply = write_scene(tmp_path)
    read = read_scene(ply, tmp_path)
    rasterizer = choose_rasterizer(read.gaussians, "cpu")
    for index in range(VIEWS):
        rgb = rasterizer.render(read.cameras[index], None, torch.tensor(BACKGROUND)).rgb[0].clamp(0, 1)
        Image.fromarray((255 * (rgb * (1 - 2 * FLATTER) + FLATTER) + 0.5).byte().numpy()).save(tmp_path / f"{index}.png")
    return ply


def manager_of(ply: Path) -> TrajectoryDataManager:
    opening._opened.cache_clear()  # photographs are found when a scene is opened
    options = grouped(RunOptions(), {"load_scene": ply, "data": ply.parent, "seconds": 0.8, "trust_cameras": True, **CLIP})
    return TrajectoryDataManagerConfig(options=options).setup()


def evaluated(ply: Path) -> dict[str, float]:
    """What ns-eval writes of a scene in which no weather is."""
    manager = manager_of(ply)
    background = torch.tensor(BACKGROUND)

    def render(cameras, weather):
        return manager.prepared.rasterizer.render(cameras, None, background)

    model = SimpleNamespace(
        get_outputs_for_camera=lambda camera: {"rgb": render(from_nerfstudio(camera), None).rgb[0].clamp(0, 1)},
        render=render,
        device=torch.device("cpu"),
        background_color=background,
        rollout=SimpleNamespace(frames=lambda: []),
    )
    pipeline = SimpleNamespace(model=model, datamanager=manager, eval=lambda: None, train=lambda: None)
    return WeatherPipeline.get_average_eval_image_metrics(pipeline)  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def _no_drift(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("pgsd_nerfstudio.plugin.pipeline.drift", lambda frames: 0.0)


@pytest.mark.mistyped
def test_a_missing_photograph_is_not_compared_with_the_scene_itself(scene: Path, capsys: pytest.CaptureFixture[str]):
    whole = evaluated(scene)
    assert whole["photographs"] == VIEWS and 25 < whole["frozen_psnr"] < 45
    for index in (1, 4):
        (scene.parent / f"{index}.png").unlink()
    rest = evaluated(scene)
    assert rest["photographs"] == VIEWS - 2
    assert rest["frozen_psnr"] == pytest.approx(whole["frozen_psnr"], abs=1.0)
    assert rest["frozen_ssim"] == pytest.approx(whole["frozen_ssim"], abs=0.02)
    assert f"2 of {VIEWS} photographs are missing" in capsys.readouterr().err
    for index in range(VIEWS):
        (scene.parent / f"{index}.png").unlink(missing_ok=True)
    none = evaluated(scene)
    assert none["photographs"] == 0 and not any(name.startswith("frozen") for name in none)


@pytest.mark.mistyped
def test_photographs_in_other_ways_are_compared_as_they_are(scene: Path):
    """Sixteen bits, another suffix, a crop, an opaque alpha: the same fidelity as the plain ones."""
    plain = evaluated(scene)["frozen_psnr"]
    folder = scene.parent
    pictures = [np.asarray(Image.open(folder / f"{i}.png")) for i in range(VIEWS)]
    Image.fromarray(np.dstack([pictures[0], np.full((HEIGHT, WIDTH), 255, np.uint8)])).save(folder / "0.png")
    png16(folder / "1.png", pictures[1].astype(np.uint16) * 257)
    Image.fromarray(pictures[2]).save(folder / "2.tif")
    (folder / "2.png").unlink()
    Image.fromarray(pictures[3][4:-4]).save(folder / "3.png")  # rows are cut off
    results = evaluated(scene)
    assert results["photographs"] == VIEWS
    assert results["frozen_psnr"] == pytest.approx(plain, abs=0.3)


@pytest.mark.mistyped
def test_what_is_transparent_is_compared_with_the_scene_over_the_same_background(scene: Path):
    """An opaque half, and a half cut out whose colour, black, must not count."""
    before = evaluated(scene)["frozen_psnr"]
    ply = read_scene(scene, scene.parent)
    rasterizer = choose_rasterizer(ply.gaussians, "cpu")
    for index in range(VIEWS):
        rendering = rasterizer.render(ply.cameras[index])
        cover = rendering.accumulation[0, ..., None].clamp(1e-3, 1)
        rgba = torch.cat([(rendering.rgb[0] / cover).clamp(0, 1), cover], dim=-1)
        Image.fromarray((255 * rgba + 0.5).byte().numpy(), "RGBA").save(scene.parent / f"{index}.png")
    assert evaluated(scene)["frozen_psnr"] > max(40.0, before)


def test_a_photograph_that_cannot_be_read_is_named(scene: Path):
    whole = (scene.parent / "3.png").read_bytes()
    (scene.parent / "3.png").write_bytes(whole[: len(whole) // 2])
    manager = manager_of(scene)
    manager.train_dataset.get_numpy_image(2)
    for ask in (manager.train_dataset.get_numpy_image, lambda i: manager.train_dataset.photograph(i, torch.tensor(BACKGROUND))):
        with pytest.raises(SceneError, match=r"the picture .*3\.png cannot be read"):
            ask(3)


def test_only_missing_photographs_are_rendered(scene: Path):
    (scene.parent / "2.png").unlink()
    dataset = manager_of(scene).train_dataset
    assert [path.is_relative_to(cache_dir()) for path in dataset.image_filenames] == [i == 2 for i in range(VIEWS)]
    rendered = dataset.prepared.rasterizer.render(dataset.prepared.scene.cameras[2]).rgb[0].clamp(0, 1)
    assert float((dataset[2]["image"] - rendered).abs().max()) < 1 / 255
    stored = torch.from_numpy(np.asarray(Image.open(scene.parent / "1.png"))) / 255
    assert float((dataset[1]["image"] - stored).abs().max()) < 1 / 255


def test_distorted_photographs_are_served_undistorted(scene: Path):
    """The picture of a lens that draws everything twice as large: its middle half fills the pinhole's view."""
    manager = manager_of(scene)
    views = manager.train_dataset
    prepared = views.prepared
    lens = replace(prepared.scene.photographs[0].lens, fx=80.0, fy=80.0)
    photographs = tuple(replace(photograph, lens=lens) for photograph in prepared.scene.photographs)
    views.prepared = replace(prepared, scene=replace(prepared.scene, photographs=photographs))
    served = views.get_numpy_image(1)
    assert (served[0, 0] == np.round(255 * np.array(BACKGROUND))).all(), "beyond the photograph's edge"
    stored = np.asarray(Image.open(scene.parent / "1.png"))
    small = stored.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    found = served[HEIGHT // 4 : -HEIGHT // 4, WIDTH // 4 : -WIDTH // 4]
    assert np.abs(found[1:-1, 1:-1] - small[1:-1, 1:-1]).mean() < 3


def test_fidelity_of_whole_pictures_is_that_of_torchmetrics_and_unknown_pixels_do_not_count():
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    draw = torch.Generator().manual_seed(0)
    truth = torch.rand(40, 60, 3, generator=draw)
    ours = (truth + 0.1 * torch.randn(40, 60, 3, generator=draw)).clamp(0, 1)
    known = torch.ones(40, 60, dtype=torch.bool)
    planes = [picture.permute(2, 0, 1)[None] for picture in (ours, truth)]
    found = fidelity(ours, truth, known)
    assert found["psnr"] == pytest.approx(float(peak_signal_noise_ratio(*planes, data_range=1.0)), abs=1e-4)
    assert found["ssim"] == pytest.approx(float(structural_similarity_index_measure(*planes, data_range=1.0)), abs=1e-5)
    known[:, :25] = False
    crop = fidelity(ours[:, 25:], truth[:, 25:], known[:, 25:])
    spoilt = truth.clone()
    spoilt[:, :25] = float("nan")
    assert fidelity(ours, spoilt, known) == pytest.approx(crop, abs=1e-5)
    assert math.isnan(fidelity(ours, truth, torch.arange(2400).reshape(40, 60) == 7)["ssim"])
