"""Clips without a 3D scene: collages of random shapes, panned and zoomed, with flakes that fall or lie in front of them.

"Dead leaves" images (Lee, Mumford & Huang 2001) share their edge statistics with photographs, so they teach the
autoencoder and the denoiser that a background can be anything; the demo scene alone would teach them one courtyard.
"""

from __future__ import annotations

import math
import random

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFilter
from torch import Tensor

from bundled_prior.looks import Look

FLAKE_PIXELS = 0.9
"""Standard deviation in pixels of a curated flake at unit distance."""


def background(rng: random.Random, width: int, height: int) -> Float[Tensor, "3 h w"]:
    """A collage of ellipses, polygons and stripes of power-law sizes, with grain and a gradient of light."""
    image = Image.new("RGB", (width, height), _color(rng))
    draw = ImageDraw.Draw(image)
    palette = [_color(rng) for _ in range(rng.randint(4, 10))]
    for _ in range(rng.randint(60, 500)):
        radius = min(0.35, 0.02 / rng.random() ** 0.6) * height
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        fill = tuple(int(min(255, max(0, c + rng.gauss(0, 14)))) for c in rng.choice(palette))
        kind = rng.random()
        if kind < 0.4:
            stretch = 2 ** rng.uniform(-1, 1)
            draw.ellipse((x - radius * stretch, y - radius / stretch, x + radius * stretch, y + radius / stretch), fill=fill)
        elif kind < 0.8:
            corners = sorted(rng.uniform(0, math.tau) for _ in range(rng.randint(3, 6)))
            draw.polygon([(x + radius * math.cos(a), y + radius * math.sin(a)) for a in corners], fill=fill)
        else:
            angle, reach = rng.uniform(0, math.tau), radius * rng.uniform(1, 4)
            ends = (x, y, x + reach * math.cos(angle), y + reach * math.sin(angle))
            draw.line(ends, fill=fill, width=max(1, int(radius / 5)))
    if rng.random() < 0.5:
        image = image.filter(ImageFilter.GaussianBlur(rng.uniform(0.3, 1.5)))
    pixels = torch.from_numpy(np.asarray(image).copy()).permute(2, 0, 1) / 255.0
    generator = torch.Generator().manual_seed(rng.getrandbits(40))
    grain = torch.randn(1, height, width, generator=generator) * rng.uniform(0, 0.05)
    light = torch.linspace(-1, 1, height)[None, :, None] * rng.uniform(-0.25, 0.25) + rng.uniform(-0.1, 0.1)
    return (pixels + grain + light).clamp(0, 1)


def _color(rng: random.Random) -> tuple[int, int, int]:
    value, spread = rng.uniform(25, 215), 70 * rng.random() ** 2
    return tuple(int(min(255, max(0, value + rng.uniform(-spread, spread)))) for _ in range(3))


class Collage:
    """One background with one camera motion and one set of flake tracks; `clip` shows it with any look."""

    def __init__(self, rng: random.Random, frames: int, width: int, height: int, amount: str):
        self.frames, self.width, self.height = frames, width, height
        picture = background(rng, 2 * width, 2 * height)
        zoom = torch.linspace(1.0, rng.uniform(0.93, 1.07), frames) * rng.uniform(0.5, 0.9)
        start = torch.tensor([rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1)])
        pan = torch.tensor([rng.gauss(0, 0.05), rng.gauss(0, 0.02)])
        self.shift = start + torch.linspace(0, 1, frames)[:, None] * pan  # of the view, in half widths of the picture
        self.zoom = zoom
        theta = torch.zeros(frames, 2, 3)
        theta[:, 0, 0] = theta[:, 1, 1] = zoom
        theta[:, :, 2] = self.shift
        grid = torch.nn.functional.affine_grid(theta, [frames, 3, height, width], align_corners=False)
        bigger = picture[None].expand(frames, -1, -1, -1)
        self.still = torch.nn.functional.grid_sample(
            bigger, grid, mode="bilinear", padding_mode="reflection", align_corners=False
        )

        generator = torch.Generator().manual_seed(rng.getrandbits(40))
        density = {"light": rng.uniform(0.15, 0.4), "moderate": rng.uniform(0.4, 0.8), "heavy": rng.uniform(0.8, 1.6)}[amount]
        falling, lying = int(600 * density), int(rng.uniform(0, 1500) * density)
        self.falling, self.lying = falling, lying
        u = torch.rand(falling + lying, 4, generator=generator)
        depth = 0.6 + 4.0 * u[:, 0].sqrt()  # more of them far away
        fall = torch.tensor([rng.gauss(0, 1.2), rng.uniform(1.5, 4.0)])  # pixels per frame at unit distance
        jitter = 1 + 0.3 * torch.randn(falling, 1, 1, generator=generator)
        position = torch.stack([u[:, 1] * width * 1.4 - 0.2 * width, u[:, 2] * height * 1.4 - 0.2 * height], dim=1)
        tracks = position[None].expand(frames, -1, -1).clone()
        tracks[:, :falling] += torch.arange(frames)[:, None, None] * (fall / depth[:falling, None] * jitter[:, 0])[None]
        # Lying flakes stick to the picture: two bands of it are covered.
        band = height * torch.tensor([rng.uniform(0.3, 0.6), rng.uniform(0.6, 1.0)])
        tracks[:, falling:, 1] = band[(u[falling:, 3] > 0.5).long()] + (u[falling:, 2] - 0.5) * height * rng.uniform(0.05, 0.4)
        centre = torch.tensor([width / 2, height / 2])
        moving = (tracks[:, falling:] - centre) * (zoom[0] / zoom)[:, None, None] + centre
        tracks[:, falling:] = moving - ((self.shift - start) / zoom[:, None] * centre)[:, None]
        self.tracks, self.depth, self.brightness = tracks, depth, 1 - 0.12 * u[:, 3:4]

    def clip(self, look: Look | None) -> Float[Tensor, "t 3 h w"]:
        """The clip with flakes of this look, or without weather."""
        if look is None:
            return self.still
        sigma = (FLAKE_PIXELS * look.size / self.depth).clamp_min(0.2)
        sigma = torch.sqrt(sigma**2 + 0.3)  # the rasterizer's low-pass filter
        strength = 0.95 * look.opacity * torch.where(torch.arange(len(sigma)) < self.falling, 0.85, 1.0)
        color = torch.tensor(look.tint)[None] * self.brightness
        reach = int(min(6, math.ceil(2.5 * float(sigma.max()))))
        offsets = torch.arange(-reach, reach + 1)
        dy, dx = (o.reshape(-1) for o in torch.meshgrid(offsets, offsets, indexing="ij"))
        out = torch.empty_like(self.still)
        for t in range(self.frames):
            x, y = self.tracks[t].unbind(1)
            px, py = x.floor().long()[:, None] + dx, y.floor().long()[:, None] + dy
            square = (px + 0.5 - x[:, None]) ** 2 + (py + 0.5 - y[:, None]) ** 2
            alpha = (strength[:, None] * torch.exp(-0.5 * square / sigma[:, None] ** 2)).clamp(0, 0.99)
            inside = (px >= 0) & (px < self.width) & (py >= 0) & (py < self.height) & (alpha > 1 / 255)
            index, flake = (py * self.width + px)[inside], torch.nonzero(inside)[:, 0]
            a = alpha[inside]
            covered = torch.zeros(self.height * self.width).index_add_(0, index, torch.log1p(-a))
            weight = torch.zeros(self.height * self.width).index_add_(0, index, a)
            paint = torch.zeros(self.height * self.width, 3).index_add_(0, index, a[:, None] * color[flake])
            opaque = 1 - torch.exp(covered)
            mixed = (paint / weight.clamp_min(1e-6)[:, None]).T.reshape(3, self.height, self.width)
            cover = opaque.reshape(1, self.height, self.width)
            out[t] = self.still[t] * (1 - cover) + mixed * cover
        return out.clamp(0, 1)
