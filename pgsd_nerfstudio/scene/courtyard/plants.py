"""Plants of the courtyard: lawn, hedges, tree, ivy and fallen leaves.

Lengths are in metres, z is up, albedos are linear. The triangle mesh holds the soil of the lawn, the body of the hedges, trunk,
branches and twigs, and every leaf of the tree as a rhombus. It does not hold blades of grass, leaves of the hedges, ivy and
fallen leaves, which lie within some centimetres of a surface of the mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pgsd_nerfstudio.scene.courtyard.masonry import HALF, LAWN_LEVEL, TERRACE, WALL_HEIGHT
from pgsd_nerfstudio.scene.courtyard.surfels import Array, Part, Patch, box, cards, join, rectangle, samples, tube
from pgsd_nerfstudio.scene.courtyard.texture import noise, vary

GRASS = np.array([0.075, 0.115, 0.028])
HEDGE = np.array([0.06, 0.098, 0.036])
BARK = np.array([0.085, 0.065, 0.048])
AUTUMN = np.array([[0.42, 0.17, 0.025], [0.50, 0.27, 0.035], [0.33, 0.09, 0.022], [0.25, 0.22, 0.035]])
HEDGE_HEIGHT = 1.45
HEDGE_DEPTH = 0.7
TREE_AT = (-4.15, 4.2)


def plants(rng: np.random.Generator) -> list[Part]:
    """All parts of this module."""
    return [*_lawn(rng), *_hedges(rng), *_tree(rng), *_ivy(rng), *_fallen(rng)]


def directions(rng: np.random.Generator, n: int) -> Array:
    """`n` unit vectors, uniform on the sphere."""
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def wander(
    rng: np.random.Generator, start: Array, direction: Array, length: float, steps: int, bend: float, lift: float
) -> Array:
    """The [steps + 1, 3] points of a path with random bends that turns upwards on its way.

    Args:
        rng: source of the bends.
        start: first point in metres.
        direction: direction of the first step.
        length: of the whole path in metres.
        steps: number of straight pieces.
        bend: standard deviation of the change of the unit direction in each step.
        lift: upward change of the unit direction in each step.
    """
    points, heading = [start], direction / np.linalg.norm(direction)
    for _ in range(steps):
        heading = heading + bend * rng.normal(size=3) + [0, 0, lift]
        heading /= np.linalg.norm(heading)
        points.append(points[-1] + heading * length / steps)
    return np.stack(points)


def _lawn(rng: np.random.Generator) -> list[Part]:
    step = 0.142
    soil = rectangle((-HALF, -HALF, LAWN_LEVEL), (2 * HALF, 0, 0), (0, 2 * HALF, 0), (step, step))
    outside = np.hypot(*soil.position[:, :2].T) > TERRACE - 0.03
    position = soil.position[outside] + rng.uniform(-0.03, 0.03, (outside.sum(), 3)) * [1, 1, 0]
    turn = rng.uniform(0, np.pi, len(position))
    tangent = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    ground = replace(
        samples(position, np.array([0, 0, 1.0]), tangent, np.array([0.108, 0.082])),
        vertices=soil.vertices,
        triangles=soil.triangles,
    )
    patchy = 0.4 * noise(position * 0.8, 71)
    base = vary(0.62 * GRASS, patchy + rng.normal(0, 0.12, len(position)))

    # Blades: stratified over the same square, thinned away from the terrace, in tufts.
    step = 0.096
    x, y = (g.ravel() + rng.uniform(-0.5, 0.5, g.size) * step for g in np.meshgrid(*2 * [np.arange(-HALF, HALF, step)]))
    radius = np.hypot(x, y)
    keep = (radius > TERRACE + 0.01) & (rng.uniform(size=len(x)) < np.clip(1.25 - 0.2 * (radius - TERRACE), 0.4, 1))
    x, y, radius = x[keep], y[keep], radius[keep]
    n = len(x)
    tall = (0.045 + 0.03 * rng.uniform(size=n)) * (1 + 0.35 * noise(np.stack([x, y, 0 * x], 1) * 1.7, 72))
    lean = rng.normal(0, 0.45, (n, 2))
    direction = np.stack([lean[:, 0], lean[:, 1], np.ones(n)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = np.stack([x, y, np.full(n, LAWN_LEVEL)], axis=1) + 0.5 * tall[:, None] * direction
    face = np.cross(direction, directions(rng, n))
    blades = samples(middle, face, direction, np.stack([0.38 * tall, np.full(n, 0.005) + 0.001 * (radius - TERRACE)], axis=1))
    hue = rng.uniform(size=(n, 1))
    paint = vary(GRASS, 0.25 + 0.45 * noise(middle * 0.8, 71) + rng.normal(0, 0.22, n)) * (
        1 + hue * np.array([0.55, 0.12, 0.0])
    )
    return [Part("lawn", ground, base), Part("grass", blades, paint, leafy=True, opacity=0.92)]


def _hedges(rng: np.random.Generator) -> list[Part]:
    """Clipped hedges in the south (y = -HALF) and in the east (x = HALF)."""
    parts = []
    for turn in (0.0, np.pi / 2):
        body = box((-HALF, -HALF - HEDGE_DEPTH, LAWN_LEVEL - 0.1), (HALF + HEDGE_DEPTH, -HALF, HEDGE_HEIGHT), (9.0, 9.0))
        front = rectangle((-HALF, -HALF, LAWN_LEVEL), (0, 0, HEDGE_HEIGHT - LAWN_LEVEL), (2 * HALF, 0, 0), (0.12, 0.12))
        top = rectangle(
            (-HALF, -HALF - HEDGE_DEPTH, HEDGE_HEIGHT), (2 * HALF + HEDGE_DEPTH, 0, 0), (0, HEDGE_DEPTH, 0), (0.13, 0.13)
        )
        core = rectangle((-HALF, -HALF - 0.22, LAWN_LEVEL), (0, 0, HEDGE_HEIGHT - 0.06), (2 * HALF, 0, 0), (0.3, 0.3))
        skin = join([front, top])
        n = len(skin)
        bump = noise(skin.position * 3.0, 81)
        position = skin.position + rng.uniform(-0.045, 0.045, (n, 3)) + skin.normal * (0.03 * bump[:, None] - 0.01)
        normal = skin.normal + 0.55 * directions(rng, n)
        leaves = samples(
            position, normal, np.cross(normal, directions(rng, n)), rng.uniform([0.068, 0.052], [0.092, 0.072], (n, 2))
        )
        paint = vary(HEDGE, 0.5 * bump + rng.normal(0, 0.25, n)) * (1 + rng.uniform(size=(n, 1)) * np.array([0.5, 0.15, 0.0]))
        parts += [
            Part(
                "hedge",
                replace(leaves, vertices=body.vertices, triangles=body.triangles).moved((0, 0, 0), turn),
                paint,
                leafy=True,
            ),
            Part("backing", core.without_mesh().moved((0, 0, 0), turn), np.tile(0.3 * HEDGE, (len(core), 1))),
        ]
        count = 2000
        which = rng.integers(0, n, count)
        tips = (
            skin.position[which]
            + skin.normal[which] * rng.uniform(0.0, 0.04, (count, 1))
            + rng.uniform(-0.05, 0.05, (count, 3))
        )
        normal = skin.normal[which] + 0.9 * directions(rng, count)
        small = samples(
            tips, normal, np.cross(normal, directions(rng, count)), rng.uniform([0.025, 0.017], [0.045, 0.03], (count, 2))
        )
        light = vary(HEDGE, 0.2 + rng.normal(0, 0.45, count)) * (1 + rng.uniform(size=(count, 1)) * np.array([0.7, 0.3, 0.0]))
        parts.append(Part("hedge leaves", small.moved((0, 0, 0), turn), light, leafy=True, opacity=0.9))
    return parts


def _tree(rng: np.random.Generator) -> list[Part]:
    """Trunk, boughs, branches and twigs, each growing from the one before, with leaves about the ends."""
    root = np.array([*TREE_AT, LAWN_LEVEL - 0.05])
    trunk = wander(rng, root, np.array([0.10, -0.08, 1.0]), 3.6, 14, 0.075, 0.06)
    radii = np.linspace(0.135, 0.035, len(trunk))
    radii[:2] *= [1.45, 1.12]
    wood: list[Patch] = [tube(trunk, radii, 0.042, 12)]
    ends: list[Array] = []
    for k in range(11):
        at = 7 + (k * 7) // 11
        angle = 2.4 * k + rng.uniform(-0.3, 0.3)
        rise = 0.28 + 0.16 * (at - 7)
        bough = wander(
            rng,
            trunk[at],
            np.array([np.cos(angle), np.sin(angle), rise]),
            rng.uniform(1.55, 1.95) - 0.1 * (at - 7),
            8,
            0.10,
            0.03,
        )
        wood.append(tube(bough, np.linspace(0.040, 0.012, len(bough)), 0.045, 7))
        for node in range(3, 9):
            heading = bough[node] - bough[node - 1]
            heading = heading / np.linalg.norm(heading) + 0.75 * rng.normal(size=3) * [1, 1, 0.6]
            branch = wander(rng, bough[node], heading, rng.uniform(0.4, 0.7), 5, 0.15, 0.06)
            if branch[:, 2].min() < 2.15:
                continue
            wood.append(tube(branch, np.linspace(0.011, 0.004, len(branch)), 0.05, 5))
            ends += [branch[1:], branch[3:]]
    tips = np.concatenate(ends)
    count = 7400
    which = rng.integers(0, len(tips), count)
    position = tips[which] + rng.normal(0, 0.12, (count, 3)) - [0, 0, 0.04]
    position = position[position[:, 2] > 2.2]
    n = len(position)
    direction = directions(rng, n) * [1, 1, 0.6] - [0, 0, 0.35]
    normal = np.array([0, 0, 1.0]) + 0.9 * directions(rng, n)
    leaves = cards(position, direction, normal, rng.uniform(0.075, 0.115, n), rng.uniform(0.05, 0.075, n))
    mix = np.clip(1.4 + 1.3 * noise(position * 1.6, 91) + rng.normal(0, 0.8, n), 0, 2.999).astype(int)
    mix[rng.uniform(size=n) < 0.16] = 3
    stem = join(wood)
    bark = vary(BARK, 0.45 * noise(stem.position * [22.0, 22.0, 5.0], 92) + 0.3 * noise(stem.position * 3.0, 93))
    return [
        Part("tree", stem, bark),
        Part("leaves", leaves, vary(np.eye(4)[mix] @ AUTUMN, rng.normal(0, 0.18, n)), leafy=True, opacity=0.94),
    ]


def _ivy(rng: np.random.Generator) -> list[Part]:
    """Ivy on a part of each wall."""
    parts = []
    for turn, centre, reach, count in ((np.pi / 2, 0.9, 1.3, 1500), (0.0, 4.7, 0.85, 800)):
        tries = 8 * count
        level = np.stack(
            [centre + rng.uniform(-reach, reach, tries), np.zeros(tries), rng.uniform(LAWN_LEVEL, WALL_HEIGHT, tries)], axis=1
        )
        aside = np.abs(level[:, 0] - centre) / reach
        top = WALL_HEIGHT * (1.0 - 0.55 * aside**1.5) + 0.5 * noise(level * [2.2, 1.0, 0.0] + turn, 101)
        grows = (level[:, 2] < top) & (noise(level * 3.5, 102) > -0.45 + 0.5 * aside) & (level[:, 0] < HALF - 0.05)
        position = (level + np.array([0, HALF, 0]))[grows][:count]
        n = len(position)
        lift = rng.uniform(0.005, 0.07, n)
        position[:, 1] -= lift
        normal = np.array([0, -1.0, 0.5]) + 0.6 * directions(rng, n)
        leaf = samples(
            position, normal, np.cross(normal, directions(rng, n)), rng.uniform([0.026, 0.02], [0.038, 0.03], (n, 2))
        )
        # Leaves that lie deeper are darker; some have turned red.
        green = vary(np.array([0.032, 0.058, 0.024]), 14.0 * (lift - 0.045) + rng.normal(0, 0.3, n))
        green *= 1 + (rng.uniform(size=(n, 1)) < 0.15) * np.array([2.8, 0.2, 0.0])
        parts.append(Part("ivy", leaf.moved((0, 0, 0), turn), green, leafy=True, opacity=0.95))
    return parts


def _fallen(rng: np.random.Generator) -> list[Part]:
    """Autumn leaves on the ground, most of them near the tree."""
    near = np.array(TREE_AT) + rng.normal(0, 1.5, (700, 2))
    anywhere = rng.uniform(-HALF, HALF, (230, 2))
    place = np.concatenate([near, anywhere])
    place = place[(np.abs(place) < HALF - 0.05).all(1) & (np.hypot(*(place - TREE_AT).T) > 0.2)]
    place = place[np.hypot(*place.T) > 0.5]
    n = len(place)
    level = np.where(np.hypot(*place.T) < TERRACE, 0.006, LAWN_LEVEL + 0.035)
    position = np.concatenate([place, level[:, None]], axis=1)
    normal = np.array([0, 0, 1.0]) + 0.22 * directions(rng, n)
    leaf = samples(position, normal, np.cross(normal, directions(rng, n)), rng.uniform([0.022, 0.014], [0.032, 0.022], (n, 2)))
    paint = vary(AUTUMN[rng.integers(0, 4, n)] * 0.8, rng.normal(0, 0.25, n))
    return [Part("fallen leaves", leaf, paint, leafy=True)]
