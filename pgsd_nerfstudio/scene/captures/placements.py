"""In which coordinates a splat may be, given its cameras: what trainers and converters do to the world between the two.

ns-process-data turns COLMAP's world so that z is up (`applied_transform`). nerfstudio's dataparsers then turn, centre and scale
the poses, and ns-export writes a splat in those coordinates. Inria's trainer and gsplat's examples change nothing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from pgsd_nerfstudio.scene.captures.capture import Placement, moved_poses
from pgsd_nerfstudio.scene.errors import SceneError

TURNS = {
    "as ns-process-data turns COLMAP's world": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "as ns-process-data turned COLMAP's world before nerfstudio 1.0": ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
}
"""What `applied_transform` holds, by version: colmap_to_json of nerfstudio/process_data/colmap_utils.py, and what nerfstudio's
dataparser takes for granted where a transforms.json that lies beside COLMAP's model holds none."""
DEFAULT = "oriented, centred and scaled as nerfstudio's dataparser does by default (where ns-export writes a splat)"


def colmap_placements(poses: Float64[Tensor, "t 4 4"]) -> tuple[Placement, ...]:
    """Where a splat may be whose cameras are in COLMAP's world."""
    turns = [Placement(f"turned {name}", _turn(rows)) for name, rows in TURNS.items()]
    oriented = [Placement(f"{turn.name}, then {DEFAULT}", _oriented(poses, turn.move)) for turn in turns]
    return (*turns, *oriented)


def saved_placements(
    poses: Float64[Tensor, "t 4 4"], applied: Float64[Tensor, "4 4"], applied_scale: float
) -> tuple[Placement, ...]:
    """Where a splat may be whose cameras are in a transforms.json.

    Args:
        poses: camera to world, as the file has them.
        applied: its applied_transform; the identity where it has none.
        applied_scale: its applied_scale.
    """
    found = [Placement(DEFAULT, _oriented(poses, torch.eye(4, dtype=torch.float64)))]
    whole = applied.clone()
    whole[:3] *= applied_scale
    if torch.equal(whole, torch.eye(4, dtype=torch.float64)):
        return (*found, *(Placement(f"turned back, {name}", torch.linalg.inv(_turn(rows))) for name, rows in TURNS.items()))
    if float(torch.linalg.det(whole)) < 0:  # cameras of a mirrored world see no other
        return tuple(found)
    back = Placement("turned back by applied_transform", torch.linalg.inv(whole))
    return (back, Placement("turned by applied_transform once more", whole), *found)


def applied_transform(meta: Mapping[str, Any], source: Path) -> tuple[Float64[Tensor, "4 4"], float]:
    """What a transforms.json says was done to the original world: rotation or reflection with a shift, and a scale.

    Args:
        meta: content of the file.
        source: the file.

    Raises:
        SceneError: applied_transform is no invertible 3x4 matrix, or applied_scale no positive number.
    """
    try:
        applied = affine(meta.get("applied_transform", torch.eye(4)[:3].tolist()))
        scale = float(meta.get("applied_scale", 1.0))
    except (TypeError, ValueError, OverflowError) as error:
        raise SceneError(f"{source}: applied_transform must be a 3x4 matrix and applied_scale a number ({error})") from error
    if not (_invertible(applied) and 1e-9 < scale < 1e9):
        raise SceneError(f"{source}: applied_transform must be invertible, applied_scale positive; take them out of the file")
    return applied, scale


def run_placement(dataparser_transforms: Path, applied: Float64[Tensor, "4 4"], applied_scale: float) -> Placement:
    """From the coordinates of a capture to those of a run: x_run = scale * (T @ inv(applied_transform)) x_saved.

    Args:
        dataparser_transforms: the run's dataparser_transforms.json, which holds T (3x4) and the scale.
        applied: what was done to the original world before the capture's poses.
        applied_scale: its scale.

    Raises:
        SceneError: dataparser_transforms.json, which the run writes, is missing or damaged.
    """
    original_to_run, scale = _dataparser(dataparser_transforms)
    move = original_to_run @ torch.linalg.inv(applied)
    move[:3] *= scale / applied_scale
    if not (_invertible(move) and float(torch.linalg.det(move)) > 0):
        raise SceneError(f"{dataparser_transforms} must hold a rotation with a positive scale; copy it from the run again")
    return Placement(f"moved as {dataparser_transforms} says", move)


def undone_placements(dataparser_transforms: Path) -> tuple[Placement, ...]:
    """Where a splat may be whose cameras are those of a run: in the original world.

    Args:
        dataparser_transforms: the run's dataparser_transforms.json; nothing is known where there is none.

    Raises:
        SceneError: the file is damaged.
    """
    if not dataparser_transforms.is_file():
        return ()
    move, scale = _dataparser(dataparser_transforms)
    move[:3] *= scale
    if not (_invertible(move) and float(torch.linalg.det(move)) > 0):
        return ()
    return (Placement(f"moved back from where {dataparser_transforms} put them", torch.linalg.inv(move)),)


def _dataparser(file: Path) -> tuple[Float64[Tensor, "4 4"], float]:
    try:
        stored = json.loads(file.read_text("utf-8"))
        return affine(stored["transform"]), float(stored["scale"])
    except FileNotFoundError as error:
        raise SceneError(f"{file} is missing, without which data= does not fit the run") from error
    except (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
        raise SceneError(f"{file} must hold a 3x4 transform and a scale, found {error!r}") from error


def _invertible(matrix: Float64[Tensor, "4 4"]) -> bool:
    return bool(torch.isfinite(matrix).all()) and 1e-27 < abs(float(torch.linalg.det(matrix[:3, :3]))) < 1e27


def affine(rows: Any) -> Float64[Tensor, "4 4"]:
    """A matrix of three or four rows, or its numbers in one list, as four rows; numbers may be strings.

    Raises:
        TypeError, ValueError: these are not the numbers of such a matrix.
    """
    flat = [float(value) for row in rows for value in (row if isinstance(row, list | tuple) else [row])]
    if len(flat) not in (12, 16):
        raise ValueError(f"expected 3x4 or 4x4 numbers, found {len(flat)}")
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3] = torch.tensor(flat, dtype=torch.float64)[:12].reshape(3, 4)
    return matrix


def _turn(rows: tuple[tuple[int, int, int], ...]) -> Float64[Tensor, "4 4"]:
    move = torch.eye(4, dtype=torch.float64)
    move[:3, :3] = torch.tensor(rows, dtype=torch.float64)
    return move


def _oriented(poses: Float64[Tensor, "t 4 4"], turn: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
    """A turn, then what nerfstudio's dataparsers do by default: the cameras' mean up becomes z, the mean of their centres the
    origin, and the largest coordinate of a centre 1 (auto_orient_and_center_poses with "up" and "poses", auto_scale_poses)."""
    turned = moved_poses(poses, turn)
    move = torch.eye(4, dtype=torch.float64)
    move[:3, :3] = _onto_z(torch.nn.functional.normalize(turned[:, :3, 1].mean(0), dim=0))
    move[:3, 3] = -move[:3, :3] @ turned[:, :3, 3].mean(0)
    reach = float(moved_poses(turned, move)[:, :3, 3].abs().max())
    move[:3] /= reach if reach > 0 else 1.0
    return move @ turn


def _onto_z(up: Float64[Tensor, "3"]) -> Float64[Tensor, "3 3"]:
    """The rotation that takes `up` to z as nerfstudio's rotation_matrix_between does: where z is opposite, about y."""
    axis = torch.linalg.cross(up, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    if float(axis.abs().sum()) < 1e-6:
        return torch.diag(torch.tensor([-1.0, 1.0, -1.0] if up[2] < 0 else [1.0, 1.0, 1.0], dtype=torch.float64))
    sine, cosine = axis.norm(), up[2]
    x, y, z = (axis / sine).tolist()
    skew = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + sine * skew + (1 - cosine) * skew @ skew
