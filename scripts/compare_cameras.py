"""Compares cameras as they are read here with those of nerfstudio's dataparsers and of COLMAP, and renders with photographs.

python scripts/compare_cameras.py --load-scene garden.ply --data data/garden --colmap tests/colmap

Prints the two tables of docs/cameras.md. The capture is written in each form that people have it in, and read again.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import roma
import torch
import tyro
from torch import Tensor

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.scene.captures.capture import Capture, moved_poses
from pgsd_nerfstudio.scene.captures.placements import TURNS
from pgsd_nerfstudio.scene.captures.reading import read_capture
from pgsd_nerfstudio.scene.loading import read_scene
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.weather.agreement import likeness_of

STILL = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}


@dataclass(frozen=True)
class Compare:
    """How far cameras lie from those of other readers, and how well renders tell right cameras from wrong ones."""

    load_scene: Path
    """A splat."""
    data: Path
    """Folder of a transforms.json on which it was trained, with its photographs."""
    colmap: Path = Path("tests/colmap")
    """Folder of a reconstruction that COLMAP wrote, with its own numbers in truth.json."""

    def run(self) -> None:
        print("| cameras in | judged by | views | centres, of the ring | turned | pixels |")
        print("|---|---|---|---|---|---|")
        with tempfile.TemporaryDirectory() as folder:
            for name, judge, ours, theirs in (*self._forms(Path(folder)), *self._reconstructions(Path(folder))):
                print(f"| {name} | {judge} | {len(ours)} | {_apart(ours, *theirs)} |", flush=True)
        print()
        print("| cameras | correlation | PSNR, dB |")
        print("|---|---|---|")
        scene = read_scene(self.load_scene, self.data)
        device = torch.device("cpu")
        rasterizer = choose_rasterizer(scene.gaussians, device)
        for name, wrong in _wrong(scene):
            found = likeness_of(wrong, rasterizer, device)
            if found is not None:
                print(f"| {name} | {found.correlation:.2f} | {found.psnr:.1f} |", flush=True)

    def _forms(self, folder: Path) -> Iterator[tuple[str, str, Capture, tuple[Tensor, Tensor]]]:
        """The capture in the forms of nerfstudio, instant-ngp, Blender and Inria's trainer."""
        from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
        from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
        from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

        original = json.loads((self.data / "transforms.json").read_text("utf-8"))
        by_nerfstudio = _dataparser(NerfstudioDataParserConfig(data=self.data, eval_mode="all", **STILL))
        yield "transforms.json", "nerfstudio", read_capture(self.data), by_nerfstudio
        frames = [{**frame, "file_path": str((self.data / frame["file_path"]).resolve())} for frame in original["frames"]]
        written = [[[f"{value}" for value in row] for row in frame["transform_matrix"][:3]] for frame in frames]
        _write(folder / "strings" / "transforms.json", original, _with(frames, written))
        yield "the same, 3x4 matrices of strings", "nerfstudio", read_capture(folder / "strings"), by_nerfstudio
        angle = {"camera_angle_x": 2 * math.atan(original["w"] / 2 / original["fl_x"])}
        _write(folder / "ngp" / "transforms.json", angle, frames)
        ngp = _dataparser(InstantNGPDataParserConfig(data=folder / "ngp", scene_scale=1.0, eval_mode="all"))
        yield "camera_angle_x alone (instant-ngp)", "nerfstudio", *_sorted(read_capture(folder / "ngp"), ngp, frames)
        bare = [{**frame, "file_path": str(Path(frame["file_path"]).with_suffix(""))} for frame in frames]
        suffix = Path(frames[0]["file_path"]).suffix
        for frame in bare:  # Blender's dataparser adds .png
            link = folder / "blender" / f"{Path(frame['file_path']).name}.png"
            link.parent.mkdir(exist_ok=True)
            link.symlink_to(f"{frame['file_path']}{suffix}")
            frame["file_path"] = f"./{link.stem}"
        _write(folder / "blender" / "transforms_train.json", angle, bare)
        blender = _dataparser(BlenderDataParserConfig(data=folder / "blender"))
        yield "transforms_train.json (Blender)", "nerfstudio", *_sorted(read_capture(folder / "blender"), blender, bare)
        far = torch.tensor([500_123.25, 5_400_678.5, 312.25], dtype=torch.float64)
        shifted = [(torch.tensor(frame["transform_matrix"], dtype=torch.float64)).clone() for frame in frames]
        for matrix in shifted:
            matrix[:3, 3] += far
        _write(folder / "far" / "transforms.json", original, _with(frames, [matrix.tolist() for matrix in shifted]))
        back = torch.eye(4, dtype=torch.float64)
        back[:3, 3] = -far
        yield "the same at UTM coordinates, moved back", "nerfstudio", read_capture(folder / "far").moved(back), by_nerfstudio

    def _reconstructions(self, folder: Path) -> Iterator[tuple[str, str, Capture, tuple[Tensor, Tensor]]]:
        truth = json.loads((self.colmap / "truth.json").read_text("utf-8"))
        names = sorted(truth["images"])
        viewmats = torch.tensor([truth["images"][name]["world_to_camera"] for name in names], dtype=torch.float64)
        lenses = {1: "OPENCV", 2: "OPENCV_FISHEYE"}
        Ks = torch.eye(3, dtype=torch.float64).repeat(len(names), 1, 1)
        for K, name in zip(Ks, names, strict=True):
            fx, fy, cx, cy, *_ = truth["lenses"][lenses[truth["images"][name]["camera"]]]["parameters"]
            K[0, 0], K[1, 1], K[0, 2], K[1, 2] = fx, fy, cx, cy
        for kind, suffix in (("binary", ".bin"), ("text", ".txt")):
            capture = read_capture(self.colmap / kind)
            yield f"COLMAP's {suffix} with rigs and frames", f"COLMAP {truth['pycolmap']}", capture, (viewmats, Ks)


def _write(path: Path, meta: dict[str, Any], frames: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**meta, "frames": frames}))


def _with(frames: list[dict[str, Any]], matrices: list[Any]) -> list[dict[str, Any]]:
    return [{**frame, "transform_matrix": matrix} for frame, matrix in zip(frames, matrices, strict=True)]


def _dataparser(config: Any) -> tuple[Tensor, Tensor]:
    """World-to-camera matrices with OpenCV's axes and intrinsics, as a dataparser of nerfstudio has them."""
    cameras = config.setup().get_dataparser_outputs("train").cameras
    c2w = torch.eye(4, dtype=torch.float64).repeat(len(cameras.camera_to_worlds), 1, 1)
    c2w[:, :3] = cameras.camera_to_worlds.double()
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    return torch.linalg.inv(c2w @ turn), cameras.get_intrinsics_matrices().double()


def _sorted(
    capture: Capture, theirs: tuple[Tensor, Tensor], frames: list[dict[str, Any]]
) -> tuple[Capture, tuple[Tensor, Tensor]]:
    """A dataparser that keeps the order of the file, in the order of the names."""
    order = sorted(range(len(frames)), key=lambda index: Path(frames[index]["file_path"]))
    return capture, (theirs[0][order], theirs[1][order])


def _apart(ours: Capture, viewmats: Tensor, Ks: Tensor) -> str:
    """Largest distance of centres in parts of the ring's radius, largest angle, and largest distance of pixels of a point."""
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    own = torch.linalg.inv(ours.poses @ turn)
    centers, others = ours.poses[:, :3, 3], torch.linalg.inv(viewmats)[:, :3, 3]
    radius = (others - others.mean(0)).norm(dim=1).median()
    between = own[:, :3, :3] @ viewmats[:, :3, :3].transpose(1, 2)
    angle = torch.linalg.vector_norm(roma.rotmat_to_rotvec(between), dim=1).max()
    point = torch.tensor([0.1, -0.2, 1.0], dtype=torch.float64)
    pixels = torch.stack([photograph.lens.K for photograph in ours.photographs]) @ point - Ks @ point
    return f"{(centers - others).norm(dim=1).max() / radius:.1e} | {math.degrees(angle):.1e}° | {pixels.abs().max():.1e}"


def _wrong(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """The scene with its own cameras, and with others."""
    yield "as they are in the file", scene
    middle = scene.cameras.centers.double().mean(0)
    reach = float((scene.cameras.centers.double() - middle).norm(dim=1).median())

    def move(rotation: Tensor | None = None, shift: float = 0.0, scale: float = 1.0) -> Tensor:
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = scale * (torch.eye(3, dtype=torch.float64) if rotation is None else rotation)
        matrix[:3, 3] = middle - matrix[:3, :3] @ middle
        matrix[0, 3] += shift * reach
        return matrix

    for degrees in (1, 2, 5, 10, 30, 180):
        turn = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, math.radians(degrees)], dtype=torch.float64))
        yield f"turned by {degrees}° about z", _moved(scene, move(turn))
    for share in (0.03, 0.1, 0.3, 1.0):
        yield f"shifted by {share:g} of their distance", _moved(scene, move(shift=share))
    for factor in (1.1, 1.3, 2.0, 0.5):
        yield f"{factor:g} times as far from their middle", _moved(scene, move(scale=factor))
    for name, rows in TURNS.items():
        yield f"turned {name}", _moved(scene, move(torch.tensor(rows, dtype=torch.float64)))
    for placement in scene.placements:
        yield placement.name, _moved(scene, placement.move)
    rolled = replace(scene.cameras, viewmats=scene.cameras.viewmats.roll(len(scene.cameras) // 3, 0))
    yield "mixed up", replace(scene, cameras=rolled)


def _moved(scene: Scene, move: Tensor) -> Scene:
    poses = moved_poses(scene.cameras.opengl(), move).float()
    cameras = scene.cameras.from_opengl(poses, scene.cameras.Ks, scene.cameras.width, scene.cameras.height)
    return replace(scene, cameras=cameras)


if __name__ == "__main__":
    tyro.cli(Compare).run()
