"""Views that were prepared for cameras, kept as long as there is room."""

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
    """An object that knows how many bytes it holds."""

    @property
    def nbytes(self) -> int: ...


V = TypeVar("V", bound=Sized)


class ViewCache(Generic[V]):
    """Prepared views by camera; the least recently used are dropped beyond `cache_bytes`. Several threads may use a cache."""

    def __init__(self, cache_bytes: int) -> None:
        """Start without views.

        Args:
            cache_bytes: memory for all views.
        """
        self.cache_bytes = cache_bytes
        self.nbytes = 0
        """Bytes that the views hold now."""
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
        again: Callable[[V], V] | None = None,
    ) -> V:
        """The view of a camera at a moment, made if it is not kept.

        Args:
            viewmat: world to camera.
            K: intrinsics in pixels.
            width: of the image in pixels.
            height: of the image in pixels.
            make: makes the view.
            moment: key of the moment.
            again: what becomes of a kept view when it is asked for again; None: it stays.
        """
        numbers = torch.cat([viewmat.flatten(), K.flatten()]).detach().cpu().double().numpy()
        key = numbers.tobytes() + f"{width}x{height}".encode() + moment
        with self._lock:
            kept = self._views.get(key)
            if kept is not None:
                self._views.move_to_end(key)
                made = kept if again is None else again(kept)
                if made is kept:
                    return kept
                del self._views[key]
                self.nbytes -= kept.nbytes
            else:
                made = make()
            if made.nbytes <= self.cache_bytes:
                self._views[key] = made
                self.nbytes += made.nbytes
            while self.nbytes > self.cache_bytes:
                _, oldest = self._views.popitem(last=False)
                self.nbytes -= oldest.nbytes
            return made
