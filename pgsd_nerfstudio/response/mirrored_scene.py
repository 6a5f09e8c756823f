"""What a mirror in the scene shows: rays on the surface mesh in the colours of the frozen Gaussians, and what is far behind it.

A vertex of the mesh has the light of the opaque Gaussians next to it. Where a ray meets no mesh, it sees the picture that all
Gaussians make from a place in the open, or the sky (`sky`): Gaussians that are sky, and directions that none covers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree
from torch import Tensor

from pgsd_nerfstudio.effects.ambience import Ambience
from pgsd_nerfstudio.rendering.cpu import CpuRasterizer
from pgsd_nerfstudio.rendering.display import linear
from pgsd_nerfstudio.response.sky import overcast
from pgsd_nerfstudio.response.weather_light import in_weather
from pgsd_nerfstudio.scene.cameras import Cameras
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh, queries

SIDE = 96  # pixels of a face of the picture of what is far
WIDE, HIGH = 192, 48  # pixels of that picture, all around and from the horizon to the zenith
NEIGHBOURS = 6  # Gaussians that colour a vertex
NEAR = 0.03  # m, standard deviation of their weights
OPAQUE = 0.3  # opacity from which a Gaussian colours the mesh
UNDERSIDE = 0.35  # light of the underside of a surface relative to its upper side
LIFT = 0.04  # m; rays start this far above the water, since the mesh of a capture is rough
AGAIN = 0.25  # m behind a hit from where a ray goes on that has met the rough ground itself


@dataclass(frozen=True, eq=False)
class MirroredScene:
    """The surroundings of mirrors, as linear light without weather but for clouds that take the sun."""

    surface: SurfaceMesh
    """In metres."""
    light: Float[Tensor, "v 3"]
    """Of its vertices."""
    far: Float[Tensor, "h w 3"]
    """Of what is far: rows from the horizon up, columns counted from the x axis towards y."""
    open: Float[Tensor, "h w"]
    """Share of the sky in each of its pixels, 0..1."""

    @staticmethod
    def of(metric: Gaussians, surface: SurfaceMesh, middle: Float[Tensor, "3"], sky: Float[Tensor, " n"]) -> MirroredScene:
        """The surroundings that a scene's mirrors show.

        Args:
            metric: the frozen Gaussians in metres, with plain RGB, as clouds light them.
            surface: mesh of the scene, in metres.
            middle: place in the open from which what is far is seen, m.
            sky: share of each Gaussian that is sky, 0..1.
        """
        far, opened = _around(metric, middle, sky)
        return MirroredScene(surface, _vertex_light(metric, surface), far, opened)

    def seen(
        self, points: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], ambience: Ambience | None, share: float
    ) -> Float[Tensor, "n 3"]:
        """Linear light that arrives at points from directions, under a weather.

        Args:
            points: in metres.
            directions: metric unit vectors away from the points.
            ambience: light of the full weather; None: it stays as captured.
            share: share of the full weather, 0..1.
        """
        device = points.device
        points, directions = points.detach().float().cpu(), directions.detach().float().cpu()
        light, opened = self._behind(directions)
        if len(self.surface.triangles) and len(points):
            start = points + LIFT * torch.tensor([0.0, 0.0, 1.0])
            found = self.surface.raycasting.cast_rays(queries(start, directions))
            distance = torch.from_numpy(found["t_hit"].numpy())
            ground = (distance * directions[:, 2] < LIFT) & (distance < math.inf)
            # What is less than twice the lift above the water is its own ground.
            onward = start[ground] + (distance[ground] + AGAIN)[:, None] * directions[ground]
            again = self.surface.raycasting.cast_rays(queries(onward, directions[ground]))
            hits = {name: found[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs", "primitive_normals")}
            for name, values in hits.items():
                values[ground.numpy()] = again[name].numpy()
            met = np.isfinite(hits["t_hit"])
            which = torch.from_numpy(hits["primitive_ids"][met].astype(np.int64))
            u, v = torch.from_numpy(hits["primitive_uvs"][met]).unbind(1)
            corners = self.light[self.surface.triangles[which].long()]
            at = (torch.stack([1 - u - v, u, v], 1)[:, :, None] * corners).sum(1)
            normals = torch.from_numpy(hits["primitive_normals"][met])
            hit = torch.from_numpy(met)
            under = ((normals * directions[hit]).sum(1) > 0) & (normals[:, 2] > 0.3)
            light[hit] = torch.where(under[:, None], UNDERSIDE * at, at)
            opened[hit] = 0.0
        if ambience is not None:
            sky = overcast(directions[:, 2], ambience.sky)
            light = torch.lerp(in_weather(light, ambience, share, None), sky, share * opened[:, None])
        return light.to(device)

    def _behind(self, directions: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        """Light and share of the sky of what is far."""
        height, width = self.open.shape
        row = (torch.asin(directions[:, 2].clamp(0, 1)) / (math.pi / 2) * height).long().clamp(0, height - 1)
        column = (torch.atan2(directions[:, 1], directions[:, 0]) / (2 * math.pi) % 1.0 * width).long().clamp(0, width - 1)
        return self.far[row, column].clone(), self.open[row, column].clone()


def _vertex_light(metric: Gaussians, surface: SurfaceMesh) -> Float[Tensor, "v 3"]:
    opaque = (metric.opacities > OPAQUE).nonzero()[:, 0]
    if len(opaque) == 0 or len(surface.vertices) == 0:
        return torch.zeros(len(surface.vertices), 3)
    count = min(NEIGHBOURS, len(opaque))
    distance, nearest = KDTree(metric.means[opaque].numpy()).query(surface.vertices.numpy(), count)
    distance, nearest = torch.from_numpy(distance).reshape(-1, count), torch.from_numpy(nearest).reshape(-1, count)
    which = opaque[nearest]
    # Relative to the nearest one, so that a vertex far from all Gaussians still has a colour.
    away = distance.square() - distance[:, :1].square()
    weights = metric.opacities[which] * torch.exp(-away / (2 * NEAR**2)).float()
    light = linear(metric.colors)[which]
    return (weights[:, :, None] * light).sum(1) / weights.sum(1, keepdim=True)


def _around(
    metric: Gaussians, middle: Float[Tensor, "3"], sky: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]:
    """Linear light and share of the sky in all directions above the horizon."""
    elevation = (torch.arange(HIGH) + 0.5) / HIGH * (math.pi / 2)
    azimuth = (torch.arange(WIDE) + 0.5) / WIDE * (2 * math.pi)
    flat = elevation.cos()[:, None]
    up = elevation.sin()[:, None].expand(HIGH, WIDE)
    directions = torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), up], -1).reshape(-1, 3)
    # World to camera of the views along x, y, -x, -y and z.
    forward = torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1]])
    down = torch.tensor([[0.0, 0, -1]] * 4 + [[1.0, 0, 0]])
    turns = torch.stack([torch.linalg.cross(down, forward), down, forward], 1)
    viewmats = torch.eye(4).repeat(5, 1, 1)
    viewmats[:, :3, :3], viewmats[:, :3, 3] = turns, -(turns @ middle)
    K = torch.tensor([[SIDE / 2, 0, SIDE / 2], [0, SIDE / 2, SIDE / 2], [0, 0, 1.0]]).repeat(5, 1, 1)
    with torch.no_grad():
        cameras = Cameras(viewmats, K, SIDE, SIDE)
        seen = CpuRasterizer(metric).render(cameras)
        shares = replace(metric, colors=sky[:, None].expand(-1, 3).contiguous())
        clouds = CpuRasterizer(shares).render(cameras).rgb[..., 0]
    face = (directions @ forward.T).argmax(1)
    ahead = (turns[face] @ directions[:, :, None])[:, :, 0]
    x, y = ((ahead[:, :2] / ahead[:, 2:] + 1) * SIDE / 2).long().clamp(0, SIDE - 1).unbind(1)
    covered = seen.accumulation[face, y, x]
    light = linear(seen.rgb[face, y, x] / covered.clamp_min(1e-3)[:, None])
    opened = (1 - covered + clouds[face, y, x]).clamp(0, 1)
    return light.reshape(HIGH, WIDE, 3), opened.reshape(HIGH, WIDE)
