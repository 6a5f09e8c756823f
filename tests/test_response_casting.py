"""Which part of a mesh casts shadows: a floor of Gaussians, and a wall in the mesh where none is."""

import torch

from pgsd_nerfstudio.response.casting import AWAY, casting
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.surface.mesh import SurfaceMesh


def floor_and_wall() -> SurfaceMesh:
    """A floor of 2 m in 20 x 20 squares, and a wall of two triangles above its middle."""
    x, y = torch.meshgrid(*[torch.linspace(-1, 1, 21)] * 2, indexing="ij")
    floor = torch.stack([x.flatten(), y.flatten(), torch.zeros(441)], dim=1)
    corner = (torch.arange(20)[:, None] * 21 + torch.arange(20)).flatten()
    squares = torch.cat([torch.stack([corner, corner + 21, corner + 22], 1), torch.stack([corner, corner + 22, corner + 1], 1)])
    wall = torch.tensor([[-1.0, 0, 0.5], [1, 0, 0.5], [1, 0, 1.5], [-1, 0, 1.5]])
    return SurfaceMesh(torch.cat([floor, wall]), torch.cat([squares, 441 + torch.tensor([[0, 1, 2], [0, 2, 3]])]).int())


def flat(means: torch.Tensor, opacity: float = 0.9, size: float = 0.03) -> Gaussians:
    n = len(means)
    scales = torch.tensor([size, size, 0.002]).repeat(n, 1)
    return Gaussians(means, torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), scales, torch.full((n,), opacity), torch.zeros(n, 3))


def test_what_has_no_gaussians_casts_no_shadow():
    mesh = floor_and_wall()
    kept = casting(mesh, flat(mesh.vertices[:441]))
    assert len(kept.triangles) == 800 and (kept.triangles < 441).all()
    up = torch.tensor([[0.0, 1.0, 0.2]])
    before, after = (m.cast(torch.tensor([[0.0, -0.5, 0.9]]), up).distance for m in (mesh, kept))
    assert torch.isfinite(before).all() and torch.isinf(after).all()


def test_a_surface_of_few_large_gaussians_casts_its_shadow():
    mesh = floor_and_wall()
    few = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0], [-0.5, 0.5, 0], [0.5, 0.5, 0], [-0.5, 0, 1], [0.5, 0, 1]])
    assert len(casting(mesh, flat(few, size=0.5)).triangles) == 802


def test_what_lies_beside_its_gaussians_by_less_than_a_meshs_roughness_stays():
    mesh = floor_and_wall()
    lower = mesh.vertices - torch.tensor([0, 0, 0.9 * AWAY])
    assert len(casting(mesh, flat(lower)).triangles) == 802


def test_faint_gaussians_are_no_surface_and_nothing_at_all_changes_nothing():
    mesh = floor_and_wall()
    faint = flat(mesh.vertices, opacity=0.1)
    assert casting(mesh, faint) is mesh
    both = Gaussians(
        *(torch.cat([a, b]) for a, b in zip(flat(mesh.vertices[:441]).tensors.values(), faint.tensors.values(), strict=True))
    )
    assert len(casting(mesh, both).triangles) == 800
