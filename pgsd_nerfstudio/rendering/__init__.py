"""Rendering: clips of frozen and dynamic Gaussians as cameras see them, differentiable in the dynamic ones.

>>> import torch
>>> from pgsd_nerfstudio.rendering import choose_rasterizer
>>> from pgsd_nerfstudio.scene.cameras import Cameras
>>> from pgsd_nerfstudio.scene.gaussians import Gaussians
>>> middle, upright = torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
>>> one = Gaussians(middle, upright, torch.full((1, 3), 0.1), torch.ones(1), torch.ones(1, 3))
>>> K = torch.tensor([[[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]])
>>> clip = choose_rasterizer(one, "cpu").render(Cameras(torch.eye(4)[None], K, 32, 32))
>>> clip.rgb.shape, round(clip.depth[0, 16, 16].item(), 3)
(torch.Size([1, 32, 32, 3]), 2.0)
"""

from pgsd_nerfstudio.rendering.choice import choose_rasterizer
from pgsd_nerfstudio.rendering.rasterizer import RasterConfig, Rasterizer, Rendering

__all__ = ["RasterConfig", "Rasterizer", "Rendering", "choose_rasterizer"]
