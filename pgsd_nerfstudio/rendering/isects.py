"""Gaussians by tile and depth in gsplat's encoding, and two sorted lists of them merged without sorting again.

An id is tile << 32 | bits of the depth: the bits of positive floats are ordered like the floats.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor


class Isects(NamedTuple):
    """Which Gaussians enter which tiles of one camera, tile by tile and nearest first."""

    ids: Int[Tensor, " e"]
    """int64, ascending."""
    rows: Int[Tensor, " e"]
    """int32: the Gaussian of each (gsplat: flatten_ids)."""
    offsets: Int[Tensor, "1 tiles_down tiles_across"]
    """int32: where each tile begins."""


def merge(first: Isects, second: Isects, first_gaussians: int) -> Isects:
    """What sorting both together would give, the Gaussians of `second` numbered after the `first_gaussians` of `first`.

    As in a stable sort, `first` comes first where ids are equal.
    """
    # The place of each is its own index and the number of the other list's that come before it.
    to_first = _count_up(first.ids) + torch.searchsorted(second.ids, first.ids)
    to_second = _count_up(second.ids) + torch.searchsorted(first.ids, second.ids, right=True)
    ids = first.ids.new_empty(len(first.ids) + len(second.ids))
    rows = first.rows.new_empty(len(ids))
    ids[to_first], ids[to_second] = first.ids, second.ids
    rows[to_first], rows[to_second] = first.rows, second.rows + first_gaussians
    return Isects(ids, rows, first.offsets + second.offsets)


def _count_up(ids: Int[Tensor, " e"]) -> Int[Tensor, " e"]:
    return torch.arange(len(ids), device=ids.device)
