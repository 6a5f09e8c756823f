"""Pieces of a layer of snow or sand on the surface of a scene: where they lie, what falls on them and what light they get.

The surface is sampled evenly and finer around what the cameras look at. A fused surface has shreds in the air at the edges of
things (floaters), where the depths of two views disagreed; a piece stays only where opaque Gaussians of the scene lie.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from pgsd_nerfstudio.effects.effect import Effect
from pgsd_nerfstudio.response.exposure import OFF, RAYS, arrivals
from pgsd_nerfstudio.response.layer import RIM, Layer
from pgsd_nerfstudio.response.patchiness import ranks
from pgsd_nerfstudio.response.rays import blocked, open_sky
from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.frame import attention
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.scene import Scene
from pgsd_nerfstudio.surface.mesh import SurfaceMesh

FINE = 1 / 110  # distance between pieces near what the cameras look at, in radii: distances from the cameras to it
RINGS = ((0.0, 1.0), (1.25, 2.0), (2.5, 4.0))  # from so many radii on, the distance is so many times the finest
STEEPEST = 70.0  # degrees; on steeper faces there is no layer
SAMPLES = 5.0  # of the surface per piece, whose mean is the piece
NEIGHBOURS = 10  # pieces over which the exposure is averaged, which is noisy by the number of rays
GRAIN, UNEVEN = 0.035, 0.12  # standard deviations of the logarithms of tone and thickness from piece to piece
NEAREST = 8  # frozen Gaussians that are asked whether they carry a piece
CARRIES = 0.25  # sum of their opacities at a piece from which they do
UPRIGHT = (0.5, 0.7)  # how level what carries is, below which only caps lie on it, and above which any cover
CAP = 0.003  # m; thickness of a cap on stems and on leaves on edge, a leaf's width or so
ROUGH = 0.012  # m; how far a surface may be from the Gaussians that it was made from


class _Pieces(NamedTuple):
    points: Float[Tensor, "l 3"]
    normals: Float[Tensor, "l 3"]
    spacing: Float[Tensor, " l"]


def layer_of(scene: Scene, metric: Gaussians, surface: SurfaceMesh, effect: Effect, *, seed: int = 0) -> Layer | None:
    """The layer of an effect on a scene; None if nothing of the effect stays, or if there is no surface for it.

    Args:
        scene: gives the metric frame and what the cameras look at.
        metric: its frozen Gaussians in metres.
        surface: its mesh in metres.
        effect: its surface response tells whether particles stay; its emission, material and wind how they arrive.
        seed: of the samples, the rays and the patches.
    """
    if effect.surface.landing != "stays" or len(surface.triangles) == 0:
        return None
    generator = torch.Generator().manual_seed(seed)
    middle, radius = attention(scene.cameras, scene.gaussians)
    center, fine = scene.frame.to_metric(middle.float()), FINE * radius * scene.frame.metres_per_unit
    pieces = _sampled(surface, center, fine, generator)
    carriers = Carriers.of(pieces.points, metric)
    kept = carriers.share > CARRIES
    settled, host = carriers.settled(pieces.points, pieces.normals, metric)[kept], carriers.strongest[kept]
    pieces = _Pieces(*(t[kept] for t in pieces))
    if len(pieces.points) <= NEIGHBOURS:
        return None
    around = _neighbours(pieces.points)
    slope = torch.rad2deg(torch.arccos(pieces.normals[:, 2].clamp(-1, 1)))
    catches, sky = _exposed(pieces, surface, effect, generator)
    catches, sky = catches[around].mean(1), sky[around].mean(1)
    uneven = torch.exp(UNEVEN * torch.randn(len(slope), generator=generator) - 0.5 * UNEVEN**2)
    return Layer(
        points=settled,
        normals=_rounded(pieces, around),
        spacing=pieces.spacing,
        catches=catches * uneven,
        slope=slope,
        rank=ranks(pieces.points, seed),
        bears=borne(carriers.level(metric)[kept][around].mean(1)),
        sky=sky,
        tone=torch.exp(GRAIN * torch.randn(len(slope), generator=generator)),
        host=host,
        frame=scene.frame,
    )


class Carriers(NamedTuple):
    """The opaque frozen Gaussians about points."""

    near: Int[Tensor, "n k"]
    """Their indices."""
    there: Float[Tensor, "n k"]
    """Opacity of each at the point."""

    @staticmethod
    def of(points: Float[Tensor, "n 3"], metric: Gaussians) -> Carriers:
        """The Gaussians nearest to points in metres, from the frozen ones in metres."""
        _, near = KDTree(metric.means.numpy()).query(points.numpy(), min(NEAREST, len(metric)), workers=-1)
        near = torch.from_numpy(near).reshape(len(points), -1)
        along = torch.einsum("nki,nkij->nkj", points[:, None] - metric.means[near], _axes(metric.quats)[near])
        wide = (metric.scales[near].square() + ROUGH**2).sqrt()
        return Carriers(near, metric.opacities[near] * torch.exp(-0.5 * (along / wide).square().sum(2)))

    @property
    def share(self) -> Float[Tensor, " n"]:
        """Sum of the opacities at each point; near 0 where nothing carries it."""
        return self.there.sum(1)

    @property
    def strongest(self) -> Int[Tensor, " n"]:
        """Index of the Gaussian that is most opaque at each point."""
        return self.near.gather(1, self.there.argmax(1, keepdim=True))[:, 0]

    def level(self, metric: Gaussians) -> Float[Tensor, " n"]:
        """How level the Gaussians lie, 0..1: their area seen from above, relative to that of their broad side. A stone that
        lies flat has 1, as does a twig that lies; a stem and a leaf on edge have next to 0."""
        axes = _axes(metric.quats)
        cov = (axes * metric.scales[:, None].square()) @ axes.transpose(1, 2)
        above = (cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1].square()).clamp_min(0.0).sqrt()
        broad = metric.scales.sort(dim=1).values[:, 1:].prod(1)
        return (self.there * (above / broad.clamp_min(1e-12))[self.near]).sum(1) / self.share.clamp_min(1e-6)

    def settled(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], metric: Gaussians) -> Float[Tensor, "n 3"]:
        """Points moved along their normals onto the mean height of the Gaussians that carry them."""
        heights = ((metric.means[self.near] - points[:, None]) * normals[:, None]).sum(2)
        mean = (self.there * heights).sum(1) / self.share.clamp_min(1e-6)
        return points + mean[:, None] * normals


def borne(level: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """Greatest thickness in metres of a cover on Gaussians that lie so level; inf where they are ground, table or bench."""
    low, high = UPRIGHT
    return CAP / (1 - ((level - low) / (high - low)).clamp(0.0, 1.0))


def _axes(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    return rotations.unitquat_to_rotmat(rotations.quat_wxyz_to_xyzw(normalize(quats, dim=1)))


def _sampled(surface: SurfaceMesh, center: Float[Tensor, "3"], fine: float, generator: torch.Generator) -> _Pieces:
    """Pieces on the faces that look up, evenly spaced within each ring about the centre."""
    corners = surface.vertices[surface.triangles.long()]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = 0.5 * area.norm(dim=1)
    faces = (area[:, 2] > 2 * size * math.cos(math.radians(STEEPEST))) & (size > 0)
    corners, size, normals = corners[faces], size[faces], surface.vertex_normals[surface.triangles[faces].long()]
    apart = (corners.mean(1) - center).norm(dim=1) / (fine / FINE)
    found: list[_Pieces] = []
    for (start, factor), end in zip(RINGS, [*(ring[0] for ring in RINGS[1:]), math.inf], strict=True):
        inside = (apart >= start) & (apart < end)
        if not inside.any():
            continue
        spacing = factor * fine
        found.append(_in_ring(corners[inside], size[inside], normals[inside], spacing, generator))
    return _Pieces(*(torch.cat(parts) for parts in zip(*found, strict=True))) if found else _Pieces(*_nothing())


def _in_ring(
    corners: Float[Tensor, "f 3 3"],
    size: Float[Tensor, " f"],
    normals: Float[Tensor, "f 3 3"],
    spacing: float,
    generator: torch.Generator,
) -> _Pieces:
    """Means of random samples of some faces within cubes of an edge of `spacing`."""
    count = math.ceil(SAMPLES * float(size.sum()) / spacing**2)
    edges = torch.cumsum(size.double(), 0)
    at = torch.rand(count, generator=generator, dtype=torch.float64) * edges[-1]
    face = torch.searchsorted(edges, at).clamp_max(len(size) - 1)
    u, v = torch.rand(2, count, generator=generator)
    over = u + v > 1
    u, v = torch.where(over, 1 - u, u), torch.where(over, 1 - v, v)
    weights = torch.stack([1 - u - v, u, v], 1)[:, :, None]
    points, normal = (weights * corners[face]).sum(1), (weights * normals[face]).sum(1)
    cells, which = torch.unique((points / spacing).floor().long(), dim=0, return_inverse=True)
    number = torch.bincount(which, minlength=len(cells)).clamp_min(1)[:, None]
    mean, up = (torch.zeros(len(cells), 3).index_add_(0, which, values) for values in (points, normal))
    kept = number[:, 0] > 1  # a cube that a face only touches has its neighbours' pieces
    return _Pieces((mean / number)[kept], normalize(up, dim=1)[kept], torch.full((int(kept.sum()),), spacing))


def _nothing() -> tuple[Tensor, Tensor, Tensor]:
    return torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0)


def _neighbours(points: Float[Tensor, "l 3"]) -> Int[Tensor, "l k"]:
    _, near = KDTree(points.numpy()).query(points.numpy(), NEIGHBOURS, workers=-1)
    return torch.from_numpy(near)


def _rounded(pieces: _Pieces, around: Int[Tensor, "l k"]) -> Float[Tensor, "l 3"]:
    """Normals of the layer: those of the surface, averaged, and tilted outwards where the surface ends."""
    offset = pieces.points[around] - pieces.points[:, None]
    near = (offset.norm(dim=2) < 2.2 * pieces.spacing[:, None])[:, :, None]
    number = near.sum(1).clamp_min(1)
    normals = normalize((near * pieces.normals[around]).sum(1) / number, dim=1)
    inward = (near * offset).sum(1) / (number * pieces.spacing[:, None])
    inward = inward - (inward * normals).sum(1, keepdim=True) * normals
    # At a straight edge the mean of the neighbours lies about half a distance inwards; elsewhere chance moves it by a tenth.
    strength = ((inward.norm(dim=1, keepdim=True) - 0.2) / 0.3).clamp(0, 1)
    return normalize(normals - RIM * strength * normalize(inward, dim=1), dim=1)


def _exposed(
    pieces: _Pieces, surface: SurfaceMesh, effect: Effect, generator: torch.Generator
) -> tuple[Float[Tensor, " l"], Float[Tensor, " l"]]:
    """Mass that pieces catch relative to an open horizontal area, and the share of the sky that they see."""
    starts = pieces.points + OFF * pieces.normals
    catches = torch.zeros(len(starts))
    for way, flux in zip(*arrivals(effect, RAYS, generator), strict=True):
        facing = -(pieces.normals @ way).clamp_max(0.0)
        asked = (facing > 0).nonzero()[:, 0]
        facing[asked[blocked(surface, starts[asked], (-way / way.norm()).expand(len(asked), 3))]] = 0.0
        catches += flux * facing
    sky, _ = open_sky(starts, pieces.normals, surface, RAYS, generator)
    return catches, sky
