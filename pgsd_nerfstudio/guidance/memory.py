"""How many bytes a computation holds at once, counted tensor by tensor: no GPU, and with fake tensors no memory either.

Every tensor that an operator makes has a storage; its bytes count from the operator's return until the storage is freed, which
the interpreter reports through a weak reference. Tensors that autograd saves for the backward pass are kept alive by the graph
and so are counted like any other. The count leaves out what a kernel needs inside itself (workspace of cuDNN) and what an
allocator keeps beside (fragments, the CUDA context).
"""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class MemoryMeter(TorchDispatchMode):
    """Bytes of the storages that operators make while the meter is entered. Example:

    >>> with MemoryMeter() as meter:
    ...     y = torch.ones(1000) + 1  # two tensors of 4 kB at once
    >>> meter.peak, meter.live
    (8000, 4000)
    """

    def __init__(self) -> None:
        super().__init__()
        self.live = 0
        """Bytes held now."""
        self.peak = 0
        """Most bytes held at once so far."""
        self.phases: dict[str, int] = {}
        """Most bytes held at once in each phase, in the order in which the phases first began."""
        self._held: dict[int, weakref.finalize] = {}
        self._running: list[str] = []

    def hold(self, tensors: Iterable[Tensor]) -> int:
        """Count tensors that were made before, such as a model's weights; returns the bytes this adds."""
        before = self.live
        for tensor in tensors:
            self._count(tensor)
        return self.live - before

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Keep the peak of what happens within under a name too; phases may be nested, and entered again."""
        self.phases[name] = max(self.phases.get(name, 0), self.live)
        self._running.append(name)
        try:
            yield
        finally:
            self._running.pop()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        given = {id(leaf.untyped_storage()) for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)}
        for leaf in tree_leaves(made):
            # A view of something made before, such as a weight, or the same thing written to: nothing new is held.
            if isinstance(leaf, Tensor) and id(leaf.untyped_storage()) not in given:
                self._count(leaf)
        return made

    def _count(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        if id(storage) in self._held:
            return
        size = storage.nbytes()
        self._held[id(storage)] = weakref.finalize(storage, self._free, id(storage), size)
        self._held[id(storage)].atexit = False
        self.live += size
        self.peak = max(self.peak, self.live)
        for name in self._running:
            self.phases[name] = max(self.phases[name], self.live)

    def _free(self, identity: int, size: int) -> None:
        self._held.pop(identity, None)
        self.live -= size


def weights(*modules: torch.nn.Module) -> Iterator[Tensor]:
    """Parameters and buffers of modules, for `MemoryMeter.hold`."""
    for module in modules:
        yield from module.parameters()
        yield from module.buffers()
