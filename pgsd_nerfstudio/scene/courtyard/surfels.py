"""Shapes of the built-in courtyard, each as triangles and as flat Gaussians (surfels) on the same surface.

A shape is cut into cells of nearly equal size, so that surfels leave no gaps and overlap evenly; every cell carries one surfel
whose standard deviations are a fixed part of the cell. Cells along an open edge are narrower, which keeps silhouettes sharp.
Lengths are in metres, z is up, arrays are float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.gaussians import Gaussians

Array = NDArray[np.float64]
Vector = Array | Sequence[float]

FILL = 0.63  # standard deviation / cell width; between neighbours at most 3 % of the background shows
THICKNESS = 0.12  # of the smaller standard deviation, across the surface
SH_CONSTANT = 0.28209479177387814  # the degree-0 spherical harmonic


@dataclass(frozen=True)
class Patch:
    """Triangles, and samples of the same surface."""

    vertices: Array  # [v, 3]
    triangles: NDArray[np.int64]  # [t, 3], counter-clockwise from outside
    position: Array  # [n, 3]
    normal: Array  # [n, 3] outwards
    tangent: Array  # [n, 3] direction of the first standard deviation
    size: Array  # [n, 2] standard deviations along the tangent and across it

    def __len__(self) -> int:
        return len(self.position)

    def moved(self, offset: Vector, turn: float = 0.0) -> Patch:
        """Turned about the z axis by `turn` radians, then shifted."""
        shift, c, s = np.asarray(offset, float), np.cos(turn), np.sin(turn)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Patch(
            self.vertices @ rotation.T + shift,
            self.triangles,
            self.position @ rotation.T + shift,
            self.normal @ rotation.T,
            self.tangent @ rotation.T,
            self.size,
        )

    def without_mesh(self) -> Patch:
        """Only the samples."""
        return replace(self, vertices=np.zeros((0, 3)), triangles=np.zeros((0, 3), np.int64))

    def without_samples(self) -> Patch:
        """Only the triangles: surfaces that no camera of the courtyard sees."""
        empty = np.zeros((0, 3))
        return replace(self, position=empty, normal=empty, tangent=empty, size=np.zeros((0, 2)))


@dataclass(frozen=True)
class Part:
    """A patch of one material with its colours."""

    name: str
    patch: Patch
    albedo: Array  # [n, 3] linear
    leafy: bool = False
    """Thin and translucent: lit from both sides, and unfit to measure depth."""
    opacity: float = 0.98


def join(patches: Sequence[Patch]) -> Patch:
    """Join several patches in their order."""
    starts = np.cumsum([0] + [len(p.vertices) for p in patches[:-1]])
    triangles = np.concatenate([p.triangles + start for p, start in zip(patches, starts, strict=True)])
    vertices, *samples = (
        np.concatenate([getattr(p, name) for p in patches]) for name in ("vertices", "position", "normal", "tangent", "size")
    )
    return Patch(vertices, triangles, *samples)


def samples(position: Array, normal: Vector, tangent: Vector, size: Vector) -> Patch:
    """Samples without triangles.

    Args:
        position: [n, 3] centres.
        normal: [n, 3], or one [3] for all.
        tangent: [n, 3] first axes, or one [3] for all.
        size: [n, 2] standard deviations along the tangent and across it, or one [2] for all.
    """
    n = len(position)
    wide = [np.broadcast_to(np.asarray(a, float), (n, k)).copy() for a, k in ((normal, 3), (tangent, 3), (size, 2))]
    return Patch(np.zeros((0, 3)), np.zeros((0, 3), np.int64), position, *wide)


def cells(length: float, spacing: float, edge: float | None = None) -> tuple[Array, Array]:
    """Centres and widths of cells that fill 0..length.

    Args:
        length: of the whole row.
        spacing: approximate width of a cell.
        edge: width of the first and the last cell; None: all cells have the same width.
    """
    if edge is None or length < 3 * edge:
        count = max(1, round(length / spacing))
        widths = np.full(count, length / count)
    else:
        count = max(1, round((length - 2 * edge) / spacing))
        widths = np.concatenate([[edge], np.full(count, (length - 2 * edge) / count), [edge]])
    return np.cumsum(widths) - widths / 2, widths


def rectangle(corner: Vector, u: Vector, v: Vector, spacing: tuple[float, float], edge: float | None = None) -> Patch:
    """A rectangle of two triangles.

    Args:
        corner: [3] point.
        u: [3] one side, from the corner.
        v: [3] the other side; u x v points outwards.
        spacing: approximate widths of the cells along u and along v.
        edge: as for `cells`.
    """
    corner, u, v = (np.asarray(a, float) for a in (corner, u, v))
    (along, width), (across, height) = (cells(float(np.linalg.norm(a)), h, edge) for a, h in zip((u, v), spacing, strict=True))
    unit_u, unit_v = u / np.linalg.norm(u), v / np.linalg.norm(v)
    a, b = (g.ravel() for g in np.meshgrid(along, across))
    size = FILL * np.stack([g.ravel() for g in np.meshgrid(width, height)], axis=1)
    flat = samples(corner + a[:, None] * unit_u + b[:, None] * unit_v, np.cross(unit_u, unit_v), unit_u, size)
    return replace(
        flat, vertices=np.stack([corner, corner + u, corner + u + v, corner + v]), triangles=np.array([[0, 1, 2], [0, 2, 3]])
    )


def box(lower: Vector, upper: Vector, spacing: tuple[float, float], edge: float | None = None, hidden: str = "") -> Patch:
    """An upright block.

    Args:
        lower: [3] least coordinates.
        upper: [3] greatest coordinates.
        spacing: approximate widths of the cells along the longest side and along the others.
        edge: as for `cells`.
        hidden: names of the faces ("x-", "z-", ...) that have triangles but no samples.
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    extent = high - low
    longest = int(np.argmax(extent))
    faces = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        steps = (spacing[i != longest], spacing[j != longest])
        side_u, side_v = np.eye(3)[i] * extent[i], np.eye(3)[j] * extent[j]
        top = low + np.eye(3)[axis] * extent[axis]
        for name, corner, u, v, h in (("-", low, side_v, side_u, (steps[1], steps[0])), ("+", top, side_u, side_v, steps)):
            face = rectangle(corner, u, v, h, edge)
            faces.append(face.without_samples() if "xyz"[axis] + name in hidden else face)
    return join(faces)


def lathe(profile: Sequence[tuple[float, float]], spacing: float, segments: int = 64, edge: float | None = None) -> Patch:
    """A solid of revolution about the z axis.

    Args:
        profile: (radius, z) points; the outside is to the right of the way along them.
        spacing: approximate width of a cell.
        segments: number of triangles around the axis.
        edge: as for `cells`.
    """
    points = np.asarray(profile, float)
    angles = np.linspace(0.0, 2 * np.pi, segments, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    vertices = np.concatenate([np.concatenate([r * ring, np.full((segments, 1), z)], axis=1) for r, z in points])
    k, s = (g.ravel() for g in np.meshgrid(np.arange(len(points) - 1), np.arange(segments), indexing="ij"))
    a, b = k * segments + s, k * segments + (s + 1) % segments
    triangles = np.concatenate([np.stack([a, b, b + segments], 1), np.stack([a, b + segments, a + segments], 1)])

    patches = []
    for stroke in _strokes(points):
        slopes = np.diff(stroke, axis=0)
        lengths = np.linalg.norm(slopes, axis=1)
        slopes /= lengths[:, None]
        way = np.concatenate([[0.0], np.cumsum(lengths)])
        for row, (at, height) in enumerate(zip(*cells(way[-1], spacing, edge), strict=True)):
            radius, z = (float(np.interp(at, way, c)) for c in stroke.T)
            # Smooth shading: the slope is blended between the middles of the segments.
            slope = np.array([np.interp(at, way[:-1] + lengths / 2, c) for c in slopes.T])
            count = max(3, round(2 * np.pi * radius / spacing))
            turn = 2 * np.pi * (np.arange(count) + 0.5 * (row % 2)) / count
            out = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
            tangent = np.stack([-np.sin(turn), np.cos(turn), np.zeros(count)], axis=1)
            normal = slope[1] * out - slope[0] * np.array([0.0, 0.0, 1.0])
            size = FILL * np.array([2 * np.pi * radius / count, height])
            patches.append(samples(radius * out + [0.0, 0.0, z], normal, tangent, size))
    return replace(join(patches), vertices=vertices, triangles=triangles)


def _strokes(points: Array) -> list[Array]:
    """A profile cut where it turns by more than 50 degrees, so that no sample lies across a corner."""
    steps = np.diff(points, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    turns = np.abs((np.diff(headings) + np.pi) % (2 * np.pi) - np.pi)
    corners = np.flatnonzero(turns > np.radians(50)) + 1
    return [points[a : b + 1] for a, b in zip([0, *corners], [*corners, len(points) - 1], strict=True)]


def smooth(profile: Sequence[tuple[float, float]], pieces: int = 4) -> list[tuple[float, float]]:
    """A finer profile through the same points (Catmull-Rom).

    Args:
        profile: (radius, z) points; a point that is listed twice stays a corner.
        pieces: number of points for each piece of the profile.
    """
    points = np.asarray(profile, float)
    around = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    t = np.linspace(0.0, 1.0, pieces, endpoint=False)[:, None]
    fine = []
    for a, b, c, d in zip(around[:-3], around[1:-2], around[2:-1], around[3:], strict=True):
        if not np.allclose(b, c):
            fine.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - 3 * c + d - a) * t**3))
    return [(float(r), float(z)) for r, z in np.concatenate([*fine, points[-1:]])]


def tube(path: Array, radii: Array, spacing: float, sides: int = 8) -> Patch:
    """A round branch; a thin one has a single row of samples along its middle.

    Args:
        path: [k, 3] points of its middle.
        radii: [k] radii at these points.
        spacing: approximate width of a cell.
        sides: number of triangles around the branch.
    """
    forward = np.gradient(path, axis=0)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    helper = np.array([0.0, 0.0, 1.0]) if abs(forward[:, 2]).mean() < 0.8 else np.array([1.0, 0.0, 0.0])
    side = np.cross(forward, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, forward)
    turn = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    spokes = np.cos(turn)[None, :, None] * side[:, None] + np.sin(turn)[None, :, None] * up[:, None]
    vertices = (path[:, None] + radii[:, None, None] * spokes).reshape(-1, 3)
    k, s = (g.ravel() for g in np.meshgrid(np.arange(len(path) - 1), np.arange(sides), indexing="ij"))
    a, b = k * sides + s, k * sides + (s + 1) % sides
    triangles = np.concatenate([np.stack([a, b + sides, b], 1), np.stack([a, a + sides, b + sides], 1)])

    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    thin = 2 * np.pi * radii.mean() < 4 * spacing
    at, lengths = cells(way[-1], 2 * spacing if thin else spacing)
    middle, direction, left, top = (np.stack([np.interp(at, way, c) for c in v.T], axis=1) for v in (path, forward, side, up))
    radius = np.interp(at, way, radii)
    if thin:
        size = np.stack([FILL * lengths, 0.6 * radius], axis=1)
        return replace(samples(middle, top, direction, size), vertices=vertices, triangles=triangles)
    rows = []
    for row in range(len(at)):
        count = max(5, round(2 * np.pi * radius[row] / spacing))
        turn = 2 * np.pi * (np.arange(count) + 0.5 * (row % 2)) / count
        normal = np.cos(turn)[:, None] * left[row] + np.sin(turn)[:, None] * top[row]
        size = FILL * np.array([lengths[row] * 1.2, 2 * np.pi * radius[row] / count])
        rows.append(samples(middle[row] + radius[row] * normal, normal, direction[row], size))
    return replace(join(rows), vertices=vertices, triangles=triangles)


def cards(position: Array, direction: Array, normal: Array, length: Array, width: Array) -> Patch:
    """Leaves and petals, each of one surfel and of two triangles that form a rhombus.

    Args:
        position: [n, 3] centres.
        direction: [n, 3] long axes, of any length.
        normal: [n, 3] approximate normals, of any length.
        length: [n] along the long axis.
        width: [n] across it.
    """
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    normal = normal - (normal * direction).sum(1, keepdims=True) * direction
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = np.cross(normal, direction)
    half_length, half_width = 0.5 * length[:, None] * direction, 0.5 * width[:, None] * across
    corners = np.stack([position - half_length, position + half_width, position + half_length, position - half_width], axis=1)
    first = 4 * np.arange(len(position))[:, None]
    triangles = np.concatenate([first + np.array(k) for k in ((0, 2, 1), (0, 3, 2))])
    flat = samples(position, normal, direction, 0.3 * np.stack([length, width], axis=1))
    return replace(flat, vertices=corners.reshape(-1, 3), triangles=triangles)


def gaussians_of(patch: Patch, rgb: Array, opacity: Array) -> Gaussians:
    """The samples as flat Gaussians in metres, with spherical harmonics of degree 0.

    Args:
        patch: its samples.
        rgb: [n, 3] sRGB colours in 0..1.
        opacity: [n] peak opacities in 0..1.
    """
    tangent = patch.tangent / np.linalg.norm(patch.tangent, axis=1, keepdims=True)
    normal = patch.normal / np.linalg.norm(patch.normal, axis=1, keepdims=True)
    across = np.cross(normal, tangent)
    rotation = torch.from_numpy(np.stack([tangent, across, np.cross(tangent, across)], axis=2))
    thin = THICKNESS * patch.size.min(axis=1, keepdims=True)
    return Gaussians(
        means=torch.from_numpy(patch.position).float(),
        quats=rotations.quat_xyzw_to_wxyz(rotations.rotmat_to_unitquat(rotation)).float(),
        scales=torch.from_numpy(np.concatenate([patch.size, thin], axis=1)).float(),
        opacities=torch.from_numpy(opacity).float(),
        colors=torch.from_numpy((rgb[:, None, :] - 0.5) / SH_CONSTANT).float(),
    )
