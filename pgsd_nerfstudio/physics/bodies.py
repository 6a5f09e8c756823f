"""Active particles, and everything that the next frame of a simulation depends on.

A particle is active while it moves: it flies, slides, or is part of dense matter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

GRAVITY = 9.81  # m/s^2, in all motion here; the fits in laws.fall_speeds were made with the standard 9.80665
LANDED, ABSORBED, LEFT, UNSEEN = 0, 1, 2, 3  # how a particle ended; a particle that has not ended is active
ENDS = {"landed": LANDED, "absorbed": ABSORBED, "left": LEFT, "unseen": UNSEEN}
ANY_DISTANCE = np.float32(1e9)  # m; the reach of a particle that is shown however far it is
NO_END = np.iinfo(np.int32).max  # frame
SPLASHED, SLID, DENSE, DRIPPED = 1, 2, 4, 8
"""Bits of `kinds`: the particle is a splash droplet, has slid, has been dense matter, has dripped from an edge or splashed from
what has."""


@dataclass(frozen=True)
class Bodies:
    """n active particles with all that their motion depends on."""

    ids: Int[ndarray, " n"]
    positions: Float[ndarray, "n 3"]
    """Metres."""
    velocities: Float[ndarray, "n 3"]
    """m/s."""
    diameters: Float[ndarray, " n"]
    """Metres."""
    speeds: Float[ndarray, " n"]
    """Terminal speeds, m/s."""
    sways: Float[ndarray, " n"]
    """Speed of the flutter, m/s."""
    hertz: Float[ndarray, " n"]
    """Rate of the flutter, Hz; its sign is the sense of rotation."""
    phases: Float[ndarray, " n"]
    """Phase of the flutter, turns."""
    holds: Float[ndarray, " n"]
    """Draws from 0..1 that decide whether a particle stays on a slope."""
    spins: Float[ndarray, " n"]
    """Turns about the surface normal after landing."""
    represents: Float[ndarray, " n"]
    """Real particles that each particle represents."""
    reaches: Float[ndarray, " n"]
    """Metres up to which each particle is told apart by a camera; it is simulated only where it may come so near to one."""
    since: Int[ndarray, " n"]
    """Frame in which each particle begins to matter, int32; until then it waits (`foresight`)."""
    until: Int[ndarray, " n"]
    """Last frame in which it matters while it flies, int32."""
    kinds: UInt8[ndarray, " n"]
    """Bits SPLASHED, SLID and DENSE."""

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, which: ndarray) -> Bodies:
        """The chosen particles.

        Args:
            which: mask or indices.
        """
        which = np.asarray(which)
        if which.dtype == np.bool_:
            which = which.nonzero()[0]  # found once for all arrays
        return Bodies(*[values.take(which, 0) for values in vars(self).values()])

    @staticmethod
    def join(parts: Sequence[Bodies]) -> Bodies:
        """All particles of the parts, in their order, as new arrays."""
        some = [vars(part) for part in parts if len(part)] or [vars(parts[0])]
        return Bodies(*[np.concatenate([part[name] for part in some]) for name in some[0]])

    def marked(self, kind: int) -> Bodies:
        """The same particles with a bit of their kinds set.

        Args:
            kind: SPLASHED, SLID or DENSE.
        """
        return replace(self, kinds=self.kinds | np.uint8(kind))

    @staticmethod
    @cache
    def none() -> Bodies:
        """No particles."""
        widths = {"positions": (0, 3), "velocities": (0, 3)}
        types = {"ids": np.int32, "since": np.int32, "until": np.int32, "kinds": np.uint8}
        return Bodies(*(np.zeros(widths.get(f.name, 0), types.get(f.name, np.float32)) for f in fields(Bodies)))


@dataclass(frozen=True)
class RunState:
    """Everything that the next frame depends on."""

    flying: Bodies
    sliding: Bodies
    dense: Bodies
    coming: Bodies
    """Particles that wait until they matter; they have no ids yet."""
    deposits: Mapping[str, ndarray]
    """State of cover, wetness and dense matter; see `deposits.Deposits`."""
    born: int
    """Number of particles so far, which is the next id."""

    @staticmethod
    def empty() -> RunState:
        """The state before the first frame."""
        return RunState(Bodies.none(), Bodies.none(), Bodies.none(), Bodies.none(), {}, 0)

    @property
    def moving(self) -> int:
        """Number of active particles."""
        return len(self.flying) + len(self.sliding) + len(self.dense)

    def arrays(self) -> dict[str, ndarray]:
        """All arrays by name; `of` reads them back."""
        groups = {group: getattr(self, group) for group in _GROUPS}
        named = {f"{group}.{f.name}": getattr(bodies, f.name) for group, bodies in groups.items() for f in fields(Bodies)}
        return named | with_prefix("deposits.", self.deposits)

    @staticmethod
    def of(arrays: Mapping[str, ndarray], born: int) -> RunState:
        """Rebuild a state.

        Args:
            arrays: what the method `arrays` returned.
            born: number of particles so far.
        """
        groups = {group: Bodies(*(arrays[f"{group}.{f.name}"] for f in fields(Bodies))) for group in _GROUPS}
        return RunState(**groups, deposits=without_prefix("deposits.", arrays), born=born)


_GROUPS = ("flying", "sliding", "dense", "coming")


T = TypeVar("T")


def with_prefix(prefix: str, arrays: Mapping[str, T]) -> dict[str, T]:
    """The same arrays with a prefix before each name."""
    return {f"{prefix}{name}": value for name, value in arrays.items()}


def without_prefix(prefix: str, arrays: Mapping[str, T]) -> dict[str, T]:
    """The arrays whose names have a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def random_orientations(key: Sequence[int], count: int) -> Float[ndarray, "n 4"]:
    """Random unit quaternions (wxyz), uniform over all orientations.

    Args:
        key: seed of the random numbers.
        count: number of quaternions.
    """
    quats = np.random.default_rng(key).normal(size=(count, 4))
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
