"""Muon: momentum whose matrix updates are orthogonalised (Jordan et al. 2024), for the few thousand steps there is time for.

Scaled as in "Muon is scalable for LLM training" (Liu et al. 2025), so that matrices and all other parameters, which AdamW
moves, share one learning rate. Convolution kernels count as matrices [out, in * taps].
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn import Parameter


def orthogonalise(matrix: Tensor, steps: int = 5) -> Tensor:
    """Newton-Schulz iteration toward the nearest semi-orthogonal matrix; coefficients of Jordan et al."""
    x = matrix / (matrix.norm() + 1e-7)
    tall = x.shape[0] > x.shape[1]
    x = x.T if tall else x
    for _ in range(steps):
        gram = x @ x.T
        x = 3.4445 * x + (-4.7750 * gram + 2.0315 * gram @ gram) @ x
    return x.T if tall else x


class Muon(torch.optim.Optimizer):
    """Muon for matrices and kernels, AdamW for vectors, embeddings and whatever `adam` lists."""

    def __init__(self, params: Iterable[Parameter], adam: Iterable[Parameter] = (), lr: float = 1e-3, decay: float = 0.0):
        apart = {id(p) for p in adam}
        params = [p for p in params if p.requires_grad]
        is_matrix = [p.ndim >= 2 and id(p) not in apart and min(p.shape[0], p.numel() // p.shape[0]) >= 8 for p in params]
        groups = [
            {"params": [p for p, m in zip(params, is_matrix, strict=True) if m], "matrix": True},
            {"params": [p for p, m in zip(params, is_matrix, strict=True) if not m], "matrix": False},
        ]
        super().__init__([g for g in groups if g["params"]], {"lr": lr, "decay": decay})

    @torch.no_grad()
    def step(self, closure=None) -> None:
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if not state:
                    state["first"] = torch.zeros_like(p)
                    state["second"] = torch.zeros_like(p) if not group["matrix"] else torch.zeros(())
                    state["step"] = 0
                state["step"] += 1
                p.mul_(1 - group["lr"] * group["decay"])
                if group["matrix"]:
                    state["first"].lerp_(p.grad, 0.05)
                    ahead = torch.lerp(p.grad, state["first"], 0.95).reshape(p.shape[0], -1)
                    p.add_(orthogonalise(ahead).reshape(p.shape), alpha=-0.2 * max(ahead.shape) ** 0.5 * group["lr"])
                else:
                    state["first"].lerp_(p.grad, 0.1)
                    state["second"].lerp_(p.grad.square(), 0.02)
                    first = state["first"] / (1 - 0.9 ** state["step"])
                    second = state["second"] / (1 - 0.98 ** state["step"])
                    p.addcdiv_(first, second.sqrt() + 1e-8, value=-group["lr"])
