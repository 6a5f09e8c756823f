"""A column of water let go at once, without friction: potential flow, which judges the water made of particles.

Mixed Euler-Lagrange method (Longuet-Higgins & Cokelet 1976): nodes of the free surface move with the water, their potential
obeys Bernoulli, and the normal velocity follows from Green's third identity. Floor and back wall are mirrors, so only the free
surface is divided: straight elements with linear values, integrated exactly. Lengths are in widths a of the column, times in
sqrt(a / g).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import CubicSpline

Surface = Float[ndarray, "n 2"]
"""Points from the top of the water at the back wall to its front on the floor."""
MIRRORS = ((1, 1), (-1, -1), (-1, 1), (1, -1))


def collapse(times: Sequence[float], height: float, spacing: float = 0.02) -> list[Surface]:
    """The free surface at ascending times.

    Args:
        times: in sqrt(a / g).
        height: of the column at first, in a.
        spacing: of the nodes at the tip, in a; half of it moves the tip by 0.5 %.

    Raises:
        FloatingPointError: the surface became so uneven that time no longer advances.
    """
    surface = _column(height, spacing)
    potential = np.zeros(len(surface))
    surfaces, now, steps = [], 0.0, 0
    for late in times:
        while now < late - 1e-12:
            velocity, rise = rates(surface, potential)
            shortest = np.hypot(*np.diff(surface, axis=0).T).min()
            longest = min(0.6 * shortest / max(np.hypot(*velocity.T).max(), 0.1), 0.25 * math.sqrt(shortest))
            if not longest > 1e-6:
                raise FloatingPointError(f"the free surface is torn at {now:.4g} sqrt(a / g): nodes {shortest:.1e} a apart")
            dt = min(longest, late - now)
            surface, potential = _advanced(surface, potential, velocity, rise, dt)
            now, steps = now + dt, steps + 1
            surface, potential = _respaced(surface, potential, spacing)
            if steps % 3 == 0:
                surface, potential = _smoothed(surface, potential)
        surfaces.append(surface)
    return surfaces


def front(surface: Surface, left_out: float) -> float:
    """Farthest point of the water, but for a share of it; 0: the very tip."""
    x, y = surface[::-1].T
    beyond = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * (x[:-1] - x[1:]))])
    last = int(np.argmax(beyond >= left_out * beyond[-1])) + 1  # the sum may fall again farther back
    return float(np.interp(left_out * beyond[-1], beyond[:last], x[:last]))


def rates(surface: Surface, potential: Float[ndarray, " n"]) -> tuple[Surface, Float[ndarray, " n"]]:
    """Velocity of the nodes, and how fast their potential grows (Bernoulli)."""
    along, turning = _influence(surface)
    normal = np.linalg.solve(along, turning @ potential - turning.sum(1) * potential)
    x, y, value, at = _curves(surface, potential)
    tangent = np.stack([x(at, 1), y(at, 1)], 1)
    length = np.hypot(*tangent.T)
    tangent /= length[:, None]
    outward = np.stack([-tangent[:, 1], tangent[:, 0]], 1)
    velocity = (value(at, 1) / length)[:, None] * tangent + normal[:, None] * outward
    velocity[0, 0] = velocity[-1, 1] = 0.0
    return velocity, 0.5 * (velocity**2).sum(1) - surface[:, 1]


def _influence(surface: Surface) -> tuple[Float[ndarray, "n n"], Float[ndarray, "n n"]]:
    """What a normal velocity and a potential at each node mean at each other: integrals of log r and of its slope."""
    n = len(surface)
    along, turning = np.zeros((n, n)), np.zeros((n, n))
    for mirror in MIRRORS:
        image = surface * np.array(mirror)
        turned = mirror[0] * mirror[1] < 0  # the water stays on the right hand
        first, second = (image[1:], image[:-1]) if turned else (image[:-1], image[1:])
        parts = _elements(surface, first, second)
        if turned:
            parts = [parts[1], parts[0], parts[3], parts[2]]
        along[:, :-1] += parts[0]
        along[:, 1:] += parts[1]
        turning[:, :-1] += parts[2]
        turning[:, 1:] += parts[3]
    return along, turning


def _elements(points: Surface, first: Float[ndarray, "m 2"], second: Float[ndarray, "m 2"]) -> list[Float[ndarray, "n m"]]:
    """Integrals over straight elements, as seen from points, weighted to either end: of log r, and of its outward slope."""
    edge = second - first
    length = np.hypot(*edge.T)
    tangent = edge / length[:, None]
    offset = points[:, None] - first
    u = (offset * tangent).sum(-1)
    w = offset[..., 0] * tangent[:, 1] - offset[..., 1] * tangent[:, 0]  # depth below the element
    near, far = u**2 + w**2, (length - u) ** 2 + w**2
    log_near, log_far = (0.5 * np.log(np.maximum(r, 1e-300)) for r in (near, far))
    angle = np.arctan2(length - u, np.abs(w)) + np.arctan2(u, np.abs(w))
    angle[np.abs(w) < 1e-13] = 0.0
    flat = (length - u) * log_far + u * log_near - length + np.abs(w) * angle
    tilted = 0.5 * (far * log_far - near * log_near) - 0.25 * (far - near)
    slope, slope_tilted = np.sign(w) * angle, w * (log_far - log_near)
    flat_2, slope_2 = (tilted + u * flat) / length, (slope_tilted + u * slope) / length
    return [flat - flat_2, flat_2, slope - slope_2, slope_2]


def _curves(surface: Surface, potential: Float[ndarray, " n"]) -> tuple[CubicSpline, CubicSpline, CubicSpline, ndarray]:
    """Splines of x, y and potential over the length of the surface, mirrored at both ends; and that length at the nodes."""
    k = min(12, len(surface) - 1)
    x, y, value = (_mirrored(v, *s, k) for v, s in ((surface[:, 0], (-1, 1)), (surface[:, 1], (1, -1)), (potential, (1, 1))))
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    length -= length[k]
    return CubicSpline(length, x), CubicSpline(length, y), CubicSpline(length, value), length[k:-k]


def _mirrored(values: Float[ndarray, " n"], start: int, end: int, count: int) -> ndarray:
    """Values with `count` more at either end, even (1) or odd (-1)."""
    return np.concatenate([start * values[count:0:-1], values, end * values[-2 : -count - 2 : -1]])


def _column(height: float, spacing: float) -> Surface:
    """The surface at first; its upper edge is a little round, where a spline would ring."""
    r, turn = 0.05, np.linspace(math.pi / 2, 0, 12)
    top = np.stack([np.linspace(0, 1 - r, 30)[:-1], np.full(29, height)], 1)
    arc = np.stack([1 - r + r * np.cos(turn), height - r + r * np.sin(turn)], 1)
    side = np.stack([np.ones(80), np.linspace(height - r, 0, 81)[1:]], 1)
    surface = np.concatenate([top, arc, side])
    return _respaced(surface, np.zeros(len(surface)), spacing)[0]


def _advanced(surface: Surface, potential: ndarray, velocity: Surface, rise: ndarray, dt: float) -> tuple[Surface, ndarray]:
    """One step of Runge and Kutta's fourth order, whose first slope is known."""
    slopes = [(velocity, rise)]
    for share in (0.5, 0.5, 1.0):
        v, f = slopes[-1]
        slopes.append(rates(surface + share * dt * v, potential + share * dt * f))
    for weight, (v, f) in zip((1, 2, 2, 1), slopes, strict=True):
        surface, potential = surface + weight / 6 * dt * v, potential + weight / 6 * dt * f
    return surface, potential


def _respaced(
    surface: Surface, potential: Float[ndarray, " n"], spacing: float
) -> tuple[Float[ndarray, "m 2"], Float[ndarray, " m"]]:
    """Nodes moved along the surface: closer where the water is thin, and towards the tip."""
    x, y, value, at = _curves(surface, potential)
    along = np.linspace(0, at[-1], 1000)
    wanted = np.minimum(np.clip(0.06 * y(along) + spacing, None, 0.05), 0.15 * (at[-1] - along) + spacing)
    count = np.concatenate([[0.0], np.cumsum(0.5 * (1 / wanted[1:] + 1 / wanted[:-1]) * np.diff(along))])
    new = np.interp(np.linspace(0, count[-1], math.ceil(count[-1]) + 1), count, along)
    return _on_walls(np.stack([x(new), y(new)], 1)), value(new)


def _smoothed(surface: Surface, potential: ndarray) -> tuple[Surface, ndarray]:
    """Without the zigzag from node to node that such methods grow (Longuet-Higgins & Cokelet 1976, five points)."""

    def smooth(values: ndarray, start: int, end: int) -> ndarray:
        v = _mirrored(values, start, end, 2)
        return (-v[:-4] + 4 * v[1:-3] + 10 * v[2:-2] + 4 * v[3:-1] - v[4:]) / 16

    return _on_walls(np.stack([smooth(surface[:, 0], -1, 1), smooth(surface[:, 1], 1, -1)], 1)), smooth(potential, 1, 1)


def _on_walls(surface: Surface) -> Surface:
    surface[0, 0] = surface[-1, 1] = 0.0
    return surface
