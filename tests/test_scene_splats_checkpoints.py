"""Checkpoints of splatfacto, of all its versions, hold the splat that splatfacto would show."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.splats.reading import read_splat

CONFIG = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
method_name: splatfacto
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig
    _target: !!python/name:nerfstudio.models.splatfacto.SplatfactoModel ''
    rasterize_mode: {mode}
    sh_degree: 3
"""


def parameters(n: int = 4, rest: int = 15) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (rest, 3), "opacities": (1,)}
    return {name: torch.randn(n, *shape, generator=generator) for name, shape in shapes.items()}


def write(path: Path, raw: dict, prefix: str = "_model.gauss_params.") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"step": 29999, "pipeline": {f"{prefix}{name}": value for name, value in raw.items()}}, path)
    return path


@pytest.mark.parametrize("prefix", ["_model.gauss_params.", "_model.", "module._model.", "_model.module.gauss_params."])
def test_checkpoints_of_older_and_parallel_runs(tmp_path, prefix):
    raw = parameters()
    read = read_splat(write(tmp_path / "a.ckpt", raw, prefix)).gaussians
    assert read.sh_degree == 3 and not read.antialiased
    assert torch.equal(read.means, raw["means"]) and torch.equal(read.colors[:, 1:], raw["features_rest"])
    assert torch.equal(read.scales, raw["scales"].exp()) and torch.equal(read.opacities, raw["opacities"][:, 0].sigmoid())
    del raw["quats"]
    with pytest.raises(SceneError, match=r"holds no Gaussians \(quats not found\)"):
        read_splat(write(tmp_path / "a.ckpt", raw, prefix))


def test_with_sh_degree_0_colours_are_logits(tmp_path):
    """nerfstudio 1.1.5, models/splatfacto.py, get_outputs: colors_crop = torch.sigmoid(colors_crop) where sh_degree is 0."""
    raw = parameters(rest=0)
    read = read_splat(write(tmp_path / "a.ckpt", raw)).gaussians
    assert read.sh_degree == 0
    torch.testing.assert_close(0.5 + 0.28209479177387814 * read.colors[:, 0], raw["features_dc"].sigmoid())


@pytest.mark.parametrize("rest", [0, 3, 15])
@pytest.mark.parametrize("how", ["colors_all", "colors"])
def test_names_of_colours_before_nerfstudio_1(tmp_path, how, rest):
    raw = parameters(rest=rest)
    expected = read_splat(write(tmp_path / "new.ckpt", raw)).gaussians
    constant, others = raw.pop("features_dc")[:, None], raw.pop("features_rest")
    if how == "colors_all":
        raw["colors_all"] = torch.cat([constant, others], dim=1)
    else:
        raw |= {"colors": constant, "shs_rest": others}
    read = read_splat(write(tmp_path / "old.ckpt", raw, "_model.")).gaussians
    assert torch.equal(read.colors, expected.colors)


def test_colours_that_are_not_known_are_named(tmp_path):
    raw = parameters()
    del raw["features_dc"]
    with pytest.raises(SceneError, match=r"its colours are features_rest; expected features_dc .*ns-export gaussian-splat"):
        read_splat(write(tmp_path / "a.ckpt", raw))
    raw |= {"features_dc": torch.zeros(4, 3, 15), "features_rest": torch.zeros(4, 15, 3)}
    with pytest.raises(SceneError, match=r"its colours are \[4, 3, 15\] and \[4, 15, 3\], expected \[4, 3\] and \[4, k, 3\]"):
        read_splat(write(tmp_path / "a.ckpt", raw))
    raw |= {"features_dc": torch.zeros(4, 3), "features_rest": torch.zeros(4, 7, 3)}
    with pytest.raises(SceneError, match="has 7 coefficients beyond the constant; degrees 1 to 4 have 3, 8, 15, 24"):
        read_splat(write(tmp_path / "a.ckpt", raw))


@pytest.mark.parametrize(("mode", "antialiased"), [("classic", False), ("antialiased", True)])
def test_a_run_says_how_it_was_rasterized(tmp_path, mode, antialiased):
    path = write(tmp_path / "run/nerfstudio_models/step-000029999.ckpt", parameters())
    (tmp_path / "run/config.yml").write_text(CONFIG.format(mode=mode))
    assert read_splat(path).gaussians.antialiased is antialiased


def test_a_config_that_cannot_be_read_is_not_passed_over(tmp_path):
    path = write(tmp_path / "run/nerfstudio_models/step-000029999.ckpt", parameters())
    (tmp_path / "run/config.yml").write_text("a: [")
    with pytest.raises(SceneError, match=r"config\.yml says how the splat of step-000029999\.ckpt was rasterized"):
        read_splat(path)


def test_nothing_that_a_config_names_is_run(tmp_path):
    path = write(tmp_path / "run/nerfstudio_models/step-000029999.ckpt", parameters())
    trap = f"!!python/object/apply:os.mkdir ['{tmp_path / 'sprung'}']"
    (tmp_path / "run/config.yml").write_text(CONFIG.format(mode="antialiased") + f"trap: {trap}\n")
    assert read_splat(path).gaussians.antialiased
    assert not (tmp_path / "sprung").exists()


def test_a_checkpoint_that_would_run_code_is_not_opened(tmp_path):
    class Trap:
        def __reduce__(self):
            return Path.touch, (tmp_path / "sprung",)

    torch.save({"pipeline": Trap()}, tmp_path / "trap.ckpt")
    (tmp_path / "pickle.ckpt").write_bytes(pickle.dumps(Trap()))
    (tmp_path / "text.ckpt").write_text("hello")
    for name in ("trap", "pickle", "text"):
        with pytest.raises(SceneError, match=f"{name}.ckpt"):
            read_splat(tmp_path / f"{name}.ckpt")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("means", torch.zeros(4, 2), r"its means are \[4, 2\], expected \[4, 3\]"),
        ("quats", torch.zeros(3, 4), r"its quats are \[3, 4\], expected \[4, 4\]"),
        ("opacities", torch.zeros(4, 2), r"its opacities are \[4, 2\], expected \[4, 1\]"),
        ("scales", "hello", "its scales are no tensor of fractions"),
        ("scales", torch.zeros(4, 3, dtype=torch.int32), "its scales are no tensor of fractions"),
        ("means", torch.tensor(1.0), "its means are no tensor of fractions"),
        ("quats", torch.zeros(4, 4), "4 values of its quaternions' lengths lie outside"),
        ("opacities", torch.full((4, 1), torch.nan), "4 values of its opacities are NaN"),
    ],
)
def test_parameters_of_other_shapes_are_refused(tmp_path, name, value, sentence):
    with pytest.raises(SceneError, match=sentence):
        read_splat(write(tmp_path / "a.ckpt", parameters() | {name: value}))


def test_other_methods_and_other_things(tmp_path):
    torch.save({"pipeline": {"_model.field.mlp": torch.zeros(3)}}, tmp_path / "nerf.ckpt")
    torch.save([1, 2, 3], tmp_path / "list.ckpt")
    torch.save({"pipeline": 3}, tmp_path / "three.ckpt")
    for name in ("nerf", "list", "three"):
        with pytest.raises(SceneError, match="holds no Gaussians"):
            read_splat(tmp_path / f"{name}.ckpt")
