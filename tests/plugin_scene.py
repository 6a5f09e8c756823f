"""A table on a floor in 340 Gaussians with six views of 48x32, on disk as users have it; and a run on it in three steps."""

import json
import math
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement

VIEWS, WIDTH, HEIGHT = 6, 48, 32


def write_scene(folder: Path, table: float = 0.8) -> Path:
    """Write floor.ply with its transforms.json; returns the .ply. The table stands as high as asked for."""
    floor = [(x, y, 0.0, 0.5) for x in np.linspace(-6, 6, 18) for y in np.linspace(-6, 6, 18)]
    tiles = [(x, y, table, 0.25) for x in np.linspace(-0.6, 0.6, 4) for y in np.linspace(-0.6, 0.6, 4)]
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    rows = np.zeros(len(floor) + len(tiles), dtype=[(name, "f4") for name in names])
    for row, (x, y, z, size) in zip(rows, floor + tiles, strict=True):
        green = 0.5 + 0.3 * math.sin(3 * x + 2 * y)
        row["x"], row["y"], row["z"] = x, y, z
        row["f_dc_0"], row["f_dc_1"], row["f_dc_2"] = (-0.5, green - 0.5, -0.8)
        row["opacity"], row["rot_0"] = 5.0, 1.0
        row["scale_0"] = row["scale_1"] = math.log(size)
        row["scale_2"] = math.log(0.02)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(folder / "floor.ply"))
    frames = [{"file_path": f"{i}.png", "transform_matrix": _pose(i)} for i in range(VIEWS)]
    intrinsics = {"fl_x": 40.0, "fl_y": 40.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", **intrinsics, "frames": frames}))
    return folder / "floor.ply"


def _pose(index: int) -> list[list[float]]:
    angle = 2 * math.pi * index / VIEWS
    center = torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 1.5])
    back = torch.nn.functional.normalize(center - torch.tensor([0.0, 0.0, 0.4]), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back), dim=0)
    pose = torch.eye(4)
    pose[:3] = torch.stack([right, torch.linalg.cross(back, right), back, center], dim=1)
    return pose.tolist()


def tiny_config(scene: Path, prior: Path, outputs: Path, **flags):
    """What `ns-train pgsd-weather` would be configured with: one second of weather, 300 particles, clips of 5 frames."""
    from pgsd_nerfstudio.plugin.config import WeatherTrainerConfig
    from pgsd_nerfstudio.plugin.options import RunOptions

    small = {"seconds": 0.8, "max_particles": 300, "steps": 3, "clip_frames": 5, "refresh_every": 2, "intensity": 3.0}
    flags = {**small, "load_scene": scene, "data": scene.parent, "prior": str(prior), **flags}
    own = {f.name for f in fields(WeatherTrainerConfig) if f.name not in ("data", "prompt")}
    given = {name: flags.pop(name) for name in list(flags) if name in own}
    return WeatherTrainerConfig(run=grouped(RunOptions(), flags), **{"output_dir": outputs, "timestamp": "now", **given})


def grouped(options, flags: dict):
    """Options with the named ones in their groups, as the flags of a command have them."""
    changes = {f.name: flags[f.name] for f in fields(options) if f.name in flags and not is_dataclass(getattr(options, f.name))}
    known = set(changes)
    for group in (f.name for f in fields(options) if is_dataclass(getattr(options, f.name))):
        own = {f.name for f in fields(getattr(options, group))}
        known |= own
        changes[group] = replace(getattr(options, group), **{name: flags[name] for name in own & set(flags)})
    assert set(flags) <= known, f"no such options: {set(flags) - known}"
    return replace(options, **changes)


def train(config) -> Path:
    """As nerfstudio's train.main does; returns config.yml."""
    torch.manual_seed(config.machine.seed)
    config.set_timestamp()
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    return config.get_base_dir() / "config.yml"
