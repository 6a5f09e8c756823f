"""Lists of Gaussians by tile and depth in gsplat's encoding, and the merge of two sorted lists without sorting again.

An id is tile << 32 | bits of the depth; the bits of positive floats order like the floats.
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
    """int32: the index of the Gaussian of each id (gsplat: flatten_ids)."""
    offsets: Int[Tensor, "1 tiles_down tiles_across"]
    """int32: the first id of each tile."""


def merge(first: Isects, second: Isects, first_gaussians: int) -> Isects:
    """The list that a stable sort of both together would give: for equal ids, those of `first` come first.

    Args:
        first: one list.
        second: another list, whose Gaussians are numbered after those of `first`.
        first_gaussians: number of Gaussians of `first`.
    """
    # The place of an id is its own index plus the number of ids of the other list that come before it.
    to_first = _count_up(first.ids) + torch.searchsorted(second.ids, first.ids)
    to_second = _count_up(second.ids) + torch.searchsorted(first.ids, second.ids, right=True)
    ids = first.ids.new_empty(len(first.ids) + len(second.ids))
    rows = first.rows.new_empty(len(ids))
    ids[to_first], ids[to_second] = first.ids, second.ids
    rows[to_first], rows[to_second] = first.rows, second.rows + first_gaussians
    return Isects(ids, rows, first.offsets + second.offsets)


def _count_up(ids: Int[Tensor, " e"]) -> Int[Tensor, " e"]:
    return torch.arange(len(ids), device=ids.device)
