"""What was prepared for a camera, kept as long as there is room."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Sized(Protocol):
    """Something that knows the memory it holds."""

    @property
    def nbytes(self) -> int: ...


V = TypeVar("V", bound=Sized)


class ViewCache(Generic[V]):
    """Views by camera; the least recently used are forgotten beyond `cache_bytes`. May be asked from several threads."""

    def __init__(self, cache_bytes: int) -> None:
        self.cache_bytes = cache_bytes
        self.nbytes = 0
        """Memory held now."""
        self._views: OrderedDict[bytes, V] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._views)

    def __str__(self) -> str:
        return f"{len(self)} prepared views, {self.nbytes / 1e6:,.0f} of at most {self.cache_bytes / 1e6:,.0f} MB"

    def get(
        self,
        viewmat: Float[Tensor, "4 4"],
        K: Float[Tensor, "3 3"],
        width: int,
        height: int,
        make: Callable[[], V],
        moment: bytes = b"",
    ) -> V:
        """The view of a camera at a moment, made if it is not held."""
        numbers = torch.cat([viewmat.flatten(), K.flatten()]).detach().cpu().double().numpy()
        key = numbers.tobytes() + f"{width}x{height}".encode() + moment
        with self._lock:
            if key in self._views:
                self._views.move_to_end(key)
                return self._views[key]
            made = make()
            if made.nbytes <= self.cache_bytes:
                self._views[key] = made
                self.nbytes += made.nbytes
            while self.nbytes > self.cache_bytes:
                _, oldest = self._views.popitem(last=False)
                self.nbytes -= oldest.nbytes
            return made
