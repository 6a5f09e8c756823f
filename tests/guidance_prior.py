"""The gradient on a clip and what it costs, and damaged configurations, for tests of both families of priors."""

import json
from pathlib import Path

import torch

from pgsd_nerfstudio.guidance import VideoPrior
from pgsd_nerfstudio.guidance.memory import MemoryMeter


def there_and_back(prior: VideoPrior, clip: torch.Tensor) -> tuple[torch.Tensor, int]:
    """The gradient on a clip through the prior's encoder, and the bytes that were kept for it."""
    pixels = clip.clone().requires_grad_()
    with MemoryMeter() as meter:
        latents = prior.encode(pixels)
    kept = meter.live
    return torch.autograd.grad(latents.square().sum(), pixels)[0], kept


def rewrite(path: Path, **changes) -> None:
    """Change some entries of a JSON file."""
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))
