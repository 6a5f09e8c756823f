"""Thousands of damaged files of each kind: taken or refused in one sentence, in bounded time and memory.

Default runs take a hundred of each; `-m slow` takes 10,000 .ply and 3,000 of each other kind and prints what became of them.
"""

from __future__ import annotations

import gzip
import io
import json
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fuzzing import changed_bytes, changed_json, changed_text, survive
from hypothesis import strategies as st
from splat_files import DATA, a_cloud, write_gltf, write_splat

from pgsd_nerfstudio.effects.request import Request
from pgsd_nerfstudio.plugin.checkpoints import read_checkpoint
from pgsd_nerfstudio.plugin.environment import RunError
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.path_file import read_camera_path
from pgsd_nerfstudio.scene.path_times import path_times
from pgsd_nerfstudio.scene.run_config import read_run_config
from pgsd_nerfstudio.scene.splats.reading import read_splat
from pgsd_nerfstudio.storage import load_tensors, save_tensors

Case = tuple[st.SearchStrategy[Any], Callable[[Any], None], type[Exception]]

FEW = 100
MANY = {"ply": 10_000}
"""Mutations with -m slow; 3,000 where nothing is said."""

PACKED = ["packed.compressed.ply", "v4.spz", "v3.spz", "v2.sog", "plain.glb", "level0.ksplat", "level1.ksplat", "level2.ksplat"]

PLY_NAMES = [*"xyz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9)), "opacity"]
PLY_NAMES += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def a_ply(n: int = 12) -> bytes:
    rows = np.random.default_rng(0).normal(size=(n, len(PLY_NAMES))).astype("<f4")
    head = "".join(f"property float {name}\n" for name in PLY_NAMES)
    return f"ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{head}end_header\n".encode() + rows.tobytes()


def a_text_ply(n: int = 4) -> str:
    rows = np.random.default_rng(0).normal(size=(n, len(PLY_NAMES)))
    head = "".join(f"property float {name}\n" for name in PLY_NAMES)
    body = "\n".join(" ".join(f"{value:.6g}" for value in row) for row in rows)
    return f"ply\nformat ascii 1.0\nelement vertex {n}\n{head}end_header\n{body}\n"


def a_checkpoint(folder: Path, n: int = 6) -> bytes:
    draw = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (3, 3), "opacities": (1,)}
    state = {f"_model.gauss_params.{name}": torch.randn(n, *shape, generator=draw) for name, shape in shapes.items()}
    torch.save({"step": 10, "pipeline": state}, folder / "whole.ckpt")
    return (folder / "whole.ckpt").read_bytes()


def a_capture() -> dict[str, Any]:
    frames = []
    for i in range(3):
        pose = np.eye(4)
        pose[:3, 3] = i, 2.0, 1.0
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose.tolist()})
    lens = {"camera_model": "OPENCV", "fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "k1": 0.01}
    return {**lens, "applied_transform": np.eye(4)[:3].tolist(), "frames": frames}


def a_camera_list() -> list[dict[str, Any]]:
    return [
        {
            "id": i,
            "img_name": f"{i}",
            "width": 64,
            "height": 48,
            "position": [float(i), 0.0, 0.0],
            "rotation": np.eye(3).tolist(),
            "fy": 50.0,
            "fx": 50.0,
        }
        for i in range(3)
    ]


A_CONFIG = """!!python/object:nerfstudio.engine.trainer.TrainerConfig
data: !!python/object/apply:pathlib.PosixPath
- /
- data
experiment_name: garden
max_num_iterations: 30000
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig
    rasterize_mode: antialiased
    sh_degree: 3
    background: !!python/tuple
    - 0.1
    - 0.2
machine:
  seed: 42
"""


def a_camera_path() -> dict[str, Any]:
    frames = [
        {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50.0, "aspect": 1.5, "render_time": i / 2} for i in range(3)
    ]
    keyframes = [{"matrix": np.eye(4).ravel().tolist(), "fov": 50.0, "aspect": 1.5, "render_time": float(i)} for i in range(2)]
    whole = {"render_width": 48, "render_height": 32, "seconds": 1.0, "fps": 3.0, "camera_type": "perspective"}
    return {**whole, "is_cycle": False, "default_transition_sec": 1.0, "keyframes": keyframes, "camera_path": frames}


def written(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    return path


def splat_at(path: Path, content: bytes | str) -> None:
    splat = read_splat(written(path, content))
    splat.gaussians.check_finite()
    assert len(splat.gaussians) > 0 and torch.isfinite(splat.offset).all()
    assert ((splat.gaussians.opacities >= 0) & (splat.gaussians.opacities <= 1)).all()
    assert (splat.gaussians.scales >= 0).all()


def capture_at(path: Path, content: str) -> None:
    cameras = read_capture(written(path, content)).cameras()
    assert len(cameras) > 0 and cameras.width >= 1 and cameras.height >= 1
    assert torch.isfinite(cameras.viewmats).all() and torch.isfinite(cameras.Ks).all()


def config_at(path: Path, content: bytes | str) -> None:
    assert read_run_config(written(path, content))


def tensors_at(path: Path, whole: Any, content: bytes) -> None:
    found = load_tensors(written(path, content))
    if found is None:
        raise SceneError("damaged")
    assert found[1] == whole[1] and all(torch.equal(found[0][name], tensor) for name, tensor in whole[0].items())


def path_at(path: Path, content: str) -> None:
    found = read_camera_path(written(path, content))
    assert torch.isfinite(found.cameras.viewmats).all() and torch.isfinite(found.cameras.Ks).all()
    moments = path_times(found.times, seconds=10.0, frames=250).times
    assert len(moments) == len(found.cameras) and all(0 <= moment <= 1 for moment in moments)


def training_checkpoint_at(path: Path, whole: dict[str, Any], content: bytes) -> None:
    """What is read is what was stored: nothing that has changed is taken."""
    found = read_checkpoint(written(path, content))
    assert found["step"] == whole["step"]
    assert torch.equal(found["pipeline"]["_model.look.active"], whole["pipeline"]["_model.look.active"])


def cases(folder: Path) -> dict[str, Callable[[], Case]]:
    """What is mutated, how it is used, and what a refusal is; made when asked for."""

    def splat(name: str, whole: bytes) -> Case:
        return changed_bytes(whole), partial(splat_at, folder / name), SceneError

    def stored() -> Case:
        whole = {"a": torch.randn(20, 3), "b": torch.arange(7)}, {"fps": 25.0, "name": "snow"}
        save_tensors(folder / "whole.safetensors", *whole)
        content = (folder / "whole.safetensors").read_bytes()
        return changed_bytes(content), partial(tensors_at, folder / "stored.safetensors", whole), SceneError

    def training_checkpoint() -> Case:
        whole = {"step": 7, "pipeline": {"_model.look.active": torch.randn(300)}, "optimizers": {"look": {"lr": 0.1}}}
        torch.save(whole, folder / "step.ckpt")
        content = (folder / "step.ckpt").read_bytes()
        return changed_bytes(content), partial(training_checkpoint_at, folder / "step.ckpt", whole), RunError

    def ply() -> Case:
        binary, text = a_ply(), a_text_ply()
        head, body = binary.split(b"end_header\n", 1)
        heads = changed_text(head.decode()).map(lambda changed: changed.encode() + b"end_header\n" + body)
        return st.one_of(changed_bytes(binary), heads, changed_text(text)), partial(splat_at, folder / "a.ply"), SceneError

    def unpacked_spz() -> Case:
        """Changed within, and packed again so that its checksum is right."""
        inside = gzip.decompress((DATA / "v3.spz").read_bytes())
        return changed_bytes(inside).map(gzip.compress), partial(splat_at, folder / "a.spz"), SceneError

    def sog_description() -> Case:
        with zipfile.ZipFile(DATA / "v2.sog") as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        meta = next(name for name in members if name.endswith("meta.json"))

        def packed(description: str) -> bytes:
            content = io.BytesIO()
            with zipfile.ZipFile(content, "w") as archive:
                for name, member in {**members, meta: description.encode()}.items():
                    archive.writestr(name, member)
            return content.getvalue()

        return changed_json(json.loads(members[meta])).map(packed), partial(splat_at, folder / "a.sog"), SceneError

    def dot_splat() -> Case:
        whole = write_splat(folder / "whole.splat", a_cloud(degree=0)).read_bytes()
        return changed_bytes(whole), partial(splat_at, folder / "a.splat"), SceneError

    def gltf() -> Case:
        path = write_gltf(folder / "a.gltf", a_cloud(degree=1))
        return changed_json(json.loads(path.read_text("utf-8"))), partial(splat_at, path), SceneError

    return {
        "ply": ply,
        **{name: partial(splat, name, (DATA / name).read_bytes()) for name in PACKED},
        "spz, unpacked": unpacked_spz,
        "sog, meta.json": sog_description,
        "splat": dot_splat,
        "gltf": gltf,
        "checkpoint": lambda: splat("a.ckpt", a_checkpoint(folder)),
        "transforms.json": lambda: (changed_json(a_capture()), partial(capture_at, folder / "transforms.json"), SceneError),
        "cameras.json": lambda: (changed_json(a_camera_list()), partial(capture_at, folder / "cameras.json"), SceneError),
        "config.yml": lambda: (
            st.one_of(changed_text(A_CONFIG), changed_bytes(A_CONFIG.encode())),
            partial(config_at, folder / "config.yml"),
            SceneError,
        ),
        "camera path": lambda: (changed_json(a_camera_path()), partial(path_at, folder / "path.json"), SceneError),
        "training checkpoint": training_checkpoint,
        "stored tensors": stored,
        "answer of a language model": lambda: (
            changed_json(json.loads(Request(base="snowfall", rgb=(0.5, 0.0, 0.5), prompt="Purple snow in {scene}").to_json())),
            lambda text: Request.from_json(text) and None,
            ValueError,
        ),
    }


KINDS = list(cases(Path()))


# What is packed is damaged in test_scene_splats_damage.py too.
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in PACKED])
def test_a_damaged_file_is_taken_or_refused_in_a_sentence(kind, tmp_path):
    tally = survive(*cases(tmp_path)[kind](), examples=FEW)
    assert tally.refused > 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", KINDS)
def test_thousands_of_damaged_files(kind, tmp_path, capsys):
    tally = survive(*cases(tmp_path)[kind](), examples=MANY.get(kind, 3000))
    with capsys.disabled():
        print(f"\n{kind}: {tally}")
