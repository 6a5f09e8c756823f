"""Edits: a change of the frozen Gaussians that is stored apart from them, so that any share of it can be shown."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.spherical_harmonics import SH_C0
from pgsd_nerfstudio.storage import load_tensors, save_tensors


@dataclass(frozen=True)
class Edits:
    """A change of n Gaussians; zero changes nothing."""

    rgb: Float[Tensor, "n 3"]
    """Summand of the colour in plain RGB."""
    logit: Float[Tensor, " n"]
    """Summand of the logit of the opacity."""
    log_scale: Float[Tensor, "n 3"]
    """Summand of the logarithms of the scales."""

    def __post_init__(self) -> None:
        n = self.rgb.shape[0]
        for name, shape in {"rgb": (n, 3), "logit": (n,), "log_scale": (n, 3)}.items():
            if (found := tuple(getattr(self, name).shape)) != shape:
                raise ValueError(f"Edits.{name} must have shape {shape}, found {found}")

    def __len__(self) -> int:
        return self.rgb.shape[0]

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All tensors by field name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def to(self, device: torch.device | str) -> Edits:
        return Edits(**{name: tensor.to(device) for name, tensor in self.tensors.items()})

    def select(self, which: Tensor) -> Edits:
        """The edits of the chosen Gaussians, by mask or by index."""
        return Edits(**{name: tensor[which] for name, tensor in self.tensors.items()})

    def applied(self, gaussians: Gaussians, share: Float[Tensor, " n"] | float) -> Gaussians:
        """The Gaussians with a share of the edits; differentiable.

        Share 0 returns the same values bit for bit, share 1 the look that was fitted. Opacities change by their logits and
        scales by their logarithms, so that both stay in their range at any share.

        Args:
            gaussians: as many as the edits have.
            share: one for all, or one for each Gaussian.

        Raises:
            ValueError: the number of Gaussians or of shares is not that of the edits.
        """
        if len(gaussians) != len(self):
            raise ValueError(f"these edits are for {len(self):,} Gaussians, found {len(gaussians):,}")
        if not isinstance(share, Tensor):
            return gaussians if share == 0 else self._added(gaussians, share)
        if tuple(share.shape) != (len(self),):
            raise ValueError(f"expected one share for each of the {len(self):,} Gaussians, found shape {tuple(share.shape)}")
        share = share.to(gaussians.means)
        edited, still = self._added(gaussians, share), share == 0
        kept = {
            name: torch.where(still.view(-1, *[1] * (tensor.ndim - 1)), tensor, getattr(edited, name))
            for name, tensor in gaussians.tensors.items()
            if name in ("colors", "opacities", "scales")
        }
        return replace(gaussians, **kept)

    def _added(self, gaussians: Gaussians, share: Tensor | float) -> Gaussians:
        rows = share[:, None] if isinstance(share, Tensor) else share
        rgb, logit, log_scale = (tensor.to(gaussians.means) for tensor in self.tensors.values())
        if gaussians.sh_degree is None:
            colors = gaussians.colors + rgb * rows
        else:
            constant = gaussians.colors[:, :1] + (rgb * rows / SH_C0)[:, None]
            colors = torch.cat([constant, gaussians.colors[:, 1:]], dim=1)
        # This is sigmoid(logit(o) + x) without logarithms: exact if x is 0 and if o is 0 or 1. The bound 80 keeps odds finite.
        odds = (logit * share).clamp(-80, 80).exp()
        opacities = gaussians.opacities * odds / (1 + gaussians.opacities * (odds - 1))
        return replace(gaussians, colors=colors, opacities=opacities, scales=gaussians.scales * (log_scale * rows).exp())

    def save(self, path: Path, key: str) -> None:
        """Write one safetensors file, atomically.

        Args:
            path: the final name.
            key: the `edits_key` of the fit, stored in the file.

        Raises:
            OSError: the file could not be written.
        """
        save_tensors(path, self.tensors, {"key": key})

    @staticmethod
    def load(path: Path, key: str) -> Edits | None:
        """Read stored edits; arguments as for `save`. None if the file is missing or damaged, or has another key."""
        stored = load_tensors(path)
        if stored is None or stored[1].get("key") != key or set(stored[0]) != {f.name for f in fields(Edits)}:
            return None
        return Edits(**stored[0])
