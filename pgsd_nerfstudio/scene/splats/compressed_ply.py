"""Read the .compressed.ply of PlayCanvas and SuperSplat: chunks of 256 Gaussians, packed into 16 bytes each.

A chunk holds the bounds of its centres, log scales and colours; in them a Gaussian has 11, 10 and 11 bits for its centre and
as many for its scales, 8 for each colour and its opacity, and 10 for each of the three smaller parts of its quaternion.
Harmonics, if any, are bytes over -4..4. Format: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/ply/
"""

from __future__ import annotations

import numpy as np
import torch

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.activation import harmonics
from pgsd_nerfstudio.scene.splats.ply import antialiased, rest_names, side_by_side
from pgsd_nerfstudio.scene.splats.ply_file import PlyFile, unreadable
from pgsd_nerfstudio.scene.splats.quaternions import with_largest

CHUNK = 256  # Gaussians
HARMONICS = 4.0  # largest coefficient
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
CENTRES = ("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")
SCALES = ("min_scale_x", "min_scale_y", "min_scale_z"), ("max_scale_x", "max_scale_y", "max_scale_z")
COLOURS = ("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b")


def decompressed(ply: PlyFile) -> Gaussians:
    """Gaussians of an opened .compressed.ply, whose vertices are packed; not yet checked.

    Raises:
        SceneError: a table or column is missing, or their lengths do not agree.
    """
    vertex, chunk = ply.element("vertex"), ply.element("chunk")
    if vertex is None or chunk is None:
        raise unreadable(ply.path, "its packed vertices have no chunks")
    # The first files had no bounds of colours.
    colored = any(name in chunk.columns for side in COLOURS for name in side)
    bounding = [name for names in (CENTRES, SCALES, *([COLOURS] if colored else [])) for side in names for name in side]
    missing = [name for name in PACKED if vertex.columns.get(name) != "u4"]
    missing += [name for name in bounding if name not in chunk.columns]
    if missing:
        raise unreadable(ply.path, f"of a compressed .ply it lacks {', '.join(missing)}")
    if chunk.count != -(-vertex.count // CHUNK):
        raise unreadable(
            ply.path, f"{vertex.count:,} packed vertices need {-(-vertex.count // CHUNK):,} chunks, not {chunk.count:,}"
        )
    packed, bounds = ply.table("vertex"), ply.table("chunk")
    of = np.arange(vertex.count) // CHUNK

    def within(names: tuple[tuple[str, ...], tuple[str, ...]], part: np.ndarray) -> np.ndarray:
        low, high = (np.stack([bounds[name] for name in side], axis=1).astype(np.float32)[of] for side in names)
        return low * (1 - part) + high * part

    color = np.stack([_part(packed["packed_color"], shift, 8) for shift in (24, 16, 8, 0)], axis=1)
    rgb = within(COLOURS, color[:, :3]) if colored else color[:, :3]
    return Gaussians(
        torch.from_numpy(within(CENTRES, _three(packed["packed_position"]))),
        torch.from_numpy(_rotations(packed["packed_rotation"])),
        torch.from_numpy(within(SCALES, _three(packed["packed_scale"]))).exp(),
        torch.from_numpy(color[:, 3].copy()),
        torch.cat([harmonics(torch.from_numpy(rgb)), _rest(ply, vertex.count)], dim=1),
        antialiased=antialiased(ply.comments),
    )


def _part(words: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """Some bits of each word, as parts of the largest number that they can hold."""
    most = (1 << bits) - 1
    return ((words >> shift) & most).astype(np.float32) / np.float32(most)


def _three(words: np.ndarray) -> np.ndarray:
    return np.stack([_part(words, 21, 11), _part(words, 11, 10), _part(words, 0, 11)], axis=1)


def _rotations(words: np.ndarray) -> np.ndarray:
    """[n, 4] wxyz: the two highest bits say which part is the largest; the others are within sqrt(1/2)."""
    small = (np.stack([_part(words, shift, 10) for shift in (20, 10, 0)], axis=1) - 0.5) * np.float32(2**0.5)
    return with_largest(small, words >> 30)


def _rest(ply: PlyFile, count: int) -> torch.Tensor:
    """[n, k, 3] coefficients beyond the constant."""
    sh = ply.element("sh")
    if sh is None:
        return torch.zeros(count, 0, 3)
    if sh.count != count or set(sh.columns.values()) != {"u1"}:
        raise unreadable(ply.path, f"its harmonics are not bytes of its {count:,} vertices")
    # The first and last byte are the ends of the range, the others the middles of 256 equal steps.
    value = (np.arange(256, dtype=np.float32) + 0.5) / 256
    value[[0, 255]] = 0.0, 1.0
    value = torch.from_numpy((value - 0.5) * np.float32(2 * HARMONICS))
    stored = side_by_side(ply.table("sh"), rest_names(ply.path, sh.columns))
    return value[torch.from_numpy(stored).int()].reshape(count, -1, 3)
