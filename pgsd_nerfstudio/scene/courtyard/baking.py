"""Late-afternoon light on the courtyard: sun with ray-cast soft shadows, sky light with ambient occlusion, one bounce.

Radiance is linear with an exposure of its own; `develop` turns it into the 0..1 colours that Gaussians carry. A ray that
reaches the sky brings the light of the sky; a ray that meets a part brings the mean colour of that part under the light BOUNCE.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pgsd_nerfstudio.scene.courtyard.surfels import Array, Part, Patch, join, samples
from pgsd_nerfstudio.scene.courtyard.texture import noise

if TYPE_CHECKING:
    import open3d as o3d

SUN = np.array([0.50, -0.70, 0.52]) / np.linalg.norm([0.50, -0.70, 0.52])  # towards the sun
SUN_LIGHT = np.array([2.75, 1.98, 1.22])
SUN_SPREAD = 0.045  # rad: half a degree in truth, wider here because thin cloud softens the shadows
BOUNCE = np.array([0.55, 0.5, 0.45])  # light on the surfaces that reflect onto others
SKY_RADIUS = 30.0


def sky_light(direction: Array) -> Array:
    """Linear radiance of the sky without clouds in unit directions [n, 3]: a vertical gradient and a glow about the sun."""
    up, toward = np.clip(direction[:, 2:], 0.0, 1.0), np.clip(direction @ SUN, 0.0, 1.0)[:, None]
    horizon, zenith = np.array([0.48, 0.42, 0.38]), np.array([0.19, 0.28, 0.43])
    return (
        zenith + (horizon - zenith) * np.exp(-up / 0.20) + (0.18 * toward**3 + 0.4 * toward**24) * np.array([1.0, 0.72, 0.42])
    )


def sky_radiance(direction: Array) -> Array:
    """Linear radiance of the sky with broken clouds in unit directions [n, 3]; the clouds are grey away from the sun."""
    up, toward = np.clip(direction[:, 2:], 0.0, 1.0), np.clip(direction @ SUN, 0.0, 1.0)[:, None]
    # The clouds lie on a plane overhead, so that near the horizon they look flatter and close up.
    deck = np.concatenate([0.9 * direction[:, :2] / (up + 0.14) * [1.0, 1.4], np.full_like(up, 0.5)], axis=1)
    thickness = noise(deck, 203, 4)[:, None]
    cover = np.clip(0.5 + 2.2 * thickness, 0, 1)
    lit = np.clip(1.15 - 1.3 * (thickness - 0.05), 0.72, 1.5)
    cloud = lit * (np.array([0.27, 0.285, 0.33]) + 0.34 * toward**3 * np.array([1.0, 0.68, 0.40]))
    return (1 - cover) * sky_light(direction) * 0.8 + cover * cloud * 0.88


def develop(radiance: Array) -> Array:
    """sRGB values 0..1 of linear radiance, by exposure, a soft shoulder and the curve of sRGB."""
    exposed = 1.25 * radiance
    film = exposed * (1 + exposed / 6.0) / (1 + exposed)
    film = np.clip(film, 0.0, 1.0)
    return np.where(film <= 0.0031308, 12.92 * film, 1.055 * film ** (1 / 2.4) - 0.055)


def bake(parts: Sequence[Part], rays: int = 40) -> Array:
    """Linear radiance [n, 3] of the samples of all parts, in their order.

    Args:
        parts: all parts, which cast shadows on each other.
        rays: number of rays for the sky light of each sample.
    """
    everything = join([p.patch for p in parts])
    albedo = np.concatenate([p.albedo for p in parts])
    leafy = np.concatenate([np.full(len(p.patch), p.leafy) for p in parts])
    scene = raycasting(everything.vertices, everything.triangles)
    owner = np.concatenate([np.full(len(p.patch.triangles), i) for i, p in enumerate(parts)] + [[len(parts)]])
    tints = np.stack([p.albedo.mean(0) if len(p.albedo) else np.full(3, 0.2) for p in parts] + [np.zeros(3)]) * BOUNCE
    normal = everything.normal / np.linalg.norm(everything.normal, axis=1, keepdims=True)
    # Leaves receive light from above on whichever side is up; half of it shines through.
    normal = np.where((leafy & (normal[:, 2] < 0))[:, None], -normal, normal)
    start = everything.position + 0.004 * normal + 0.012 * leafy[:, None] * normal

    gathered = np.zeros_like(start)
    tangent, across = _frames(normal)
    for local in _cosine_directions(rays):
        direction = local[0] * tangent + local[1] * across + local[2] * normal
        hit = scene.cast_rays(_rays(start, direction))
        met = hit["primitive_ids"].numpy().astype(np.int64)
        free = met == scene.INVALID_ID
        gathered += np.where(
            free[:, None], sky_light(direction) * (direction[:, 2:] > -0.02), tints[owner[np.where(free, -1, met)]]
        )
    gathered /= rays

    sun = np.zeros(len(start))
    side, other = (a[0] for a in _frames(SUN[None]))
    for offset in _disc(10):
        toward = SUN + SUN_SPREAD * (offset[0] * side + offset[1] * other)
        facing = normal @ toward
        facing = np.where(leafy, 0.35 + 0.5 * np.abs(facing), np.clip(facing, 0, None))
        sun += facing * ~scene.test_occlusions(_rays(start, np.broadcast_to(toward, start.shape))).numpy()
    return albedo * (gathered + (sun / 10)[:, None] * SUN_LIGHT)


def raycasting(vertices: NDArray, triangles: NDArray) -> o3d.t.geometry.RaycastingScene:
    """A mesh that rays can be cast on."""
    # Open3D is slow to import, and a demo scene from the cache does not need it.
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(as_tensor(vertices), o3d.core.Tensor.from_numpy(triangles.astype(np.uint32)))
    return scene


def as_tensor(array: NDArray) -> o3d.core.Tensor:
    """Open3D's float32 tensor of an array."""
    import open3d as o3d

    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array, np.float32))


def backdrop(rng: np.random.Generator) -> tuple[Patch, Array]:
    """Samples and linear radiance of the background: a dome of large Gaussians that shows the sky, and wooded hills below."""
    patches, colors = [], []
    # The dome is finest near the horizon, where the cameras of the courtyard look.
    for lowest, highest, spacing in ((-0.45, -0.1, 0.09), (-0.06, 0.5, 0.042), (0.52, np.pi / 2, 0.085)):
        for elevation in np.arange(lowest, highest, spacing):
            count = max(5, round(2 * np.pi * np.cos(elevation) / spacing))
            direction = _direction(2 * np.pi * (np.arange(count) + rng.uniform()) / count, np.full(count, elevation))
            patches.append(_on_dome(direction, SKY_RADIUS, np.full((count, 2), 0.8 * spacing)))
            colors.append(np.where(direction[:, 2:] < -0.08, np.array([0.05, 0.06, 0.035]), sky_radiance(direction)))
    # Two wooded ridges, the further one paler. Each is a closed band with a fringe of tree crowns above it.
    for radius, height, color, columns in (
        (28.5, 0.10, np.array([0.13, 0.145, 0.175]), 210),
        (26.0, 0.075, np.array([0.055, 0.06, 0.055]), 240),
    ):
        step = 2 * np.pi / columns
        azimuth = step * (np.arange(columns) + rng.uniform(-0.3, 0.3, columns))
        ridge = height * (
            0.75 + 0.6 * noise(np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1) * 2.0 + radius, 211, 5)
        )
        rows = [(azimuth, ridge - (k + 0.75) * 1.1 * step, np.full(columns, 0.7 * step)) for k in range(3)]
        for _ in range(4):
            aside, above = rng.uniform(-0.5, 0.5, columns) * step, rng.normal(0.0, 0.007, columns)
            rows.append((azimuth + aside, ridge + above, rng.uniform(0.12, 0.26, columns) * step))
        azimuth, elevation, size = (np.concatenate(c) for c in zip(*rows, strict=True))
        direction, n = _direction(azimuth, elevation), len(azimuth)
        patches.append(_on_dome(direction, radius + rng.uniform(-0.3, 0.3, (n, 1)), np.stack([size, size], axis=1)))
        haze = 1 + 0.6 * np.clip(direction @ SUN, 0, 1)[:, None] * np.array([1.0, 0.8, 0.6])
        colors.append(color * haze * rng.uniform(0.85, 1.15, (n, 1)))
    return join(patches), np.concatenate(colors)


def _direction(azimuth: Array, elevation: Array) -> Array:
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1, dtype=np.float64)


def _on_dome(direction: Array, radius: float | Array, angular: Array) -> Patch:
    tangent = np.cross([1e-6, 0.0, 1.0], direction)
    return samples(radius * direction, -direction, tangent, radius * angular)


def _rays(start: Array, direction: Array) -> o3d.core.Tensor:
    return as_tensor(np.concatenate([start, direction], axis=1))


def _frames(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors across each normal."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    tangent = np.cross(helper, normal)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return tangent, np.cross(normal, tangent)


def _disc(count: int) -> Array:
    """Evenly spread points of the unit disc (Vogel's spiral)."""
    k = np.arange(count) + 0.5
    return np.sqrt(k / count)[:, None] * np.stack([np.cos(2.399963 * k), np.sin(2.399963 * k)], axis=1, dtype=np.float64)


def _cosine_directions(count: int) -> Array:
    """Directions about +z whose density is proportional to the cosine."""
    disc = _disc(count)
    return np.concatenate([disc, np.sqrt(1 - (disc**2).sum(1, keepdims=True))], axis=1)
