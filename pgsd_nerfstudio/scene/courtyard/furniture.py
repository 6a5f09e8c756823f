"""Furniture of the courtyard: the table with its vase of twigs and flowers, the bench, and plants in pots.

Lengths are in metres, z is up, albedos are linear. Gaps between boards are painted. Petals, leaves and berries are rhombi of
the mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pgsd_nerfstudio.scene.courtyard.masonry import LAWN_LEVEL, TERRACE
from pgsd_nerfstudio.scene.courtyard.plants import BARK, directions, wander
from pgsd_nerfstudio.scene.courtyard.surfels import (
    FILL,
    Array,
    Part,
    Patch,
    box,
    cards,
    cells,
    join,
    lathe,
    samples,
    smooth,
    tube,
)
from pgsd_nerfstudio.scene.courtyard.texture import noise, vary

TABLE_HEIGHT = 0.75
TABLE_RADIUS = 0.64
WOOD = np.array([0.20, 0.115, 0.06])
IRON = np.array([0.035, 0.035, 0.04])
EARTH = np.array([0.06, 0.045, 0.03])

FOOT = [
    (0.30, 0.025),
    (0.30, 0.025),
    (0.24, 0.035),
    (0.11, 0.07),
    (0.05, 0.13),
    (0.038, 0.20),
    (0.038, 0.31),
    (0.06, 0.345),
    (0.06, 0.365),
    (0.038, 0.40),
    (0.034, 0.60),
    (0.07, 0.665),
    (0.13, 0.69),
    (0.13, 0.69),
]

VASE = [
    (0.055, 0.0),
    (0.075, 0.012),
    (0.105, 0.07),
    (0.122, 0.13),
    (0.118, 0.18),
    (0.092, 0.235),
    (0.058, 0.275),
    (0.047, 0.30),
    (0.053, 0.322),
    (0.066, 0.338),
    (0.066, 0.338),
    (0.058, 0.338),
    (0.058, 0.338),
    (0.040, 0.30),
    (0.040, 0.285),
    (0.040, 0.285),
    (0.001, 0.285),
    (0.001, 0.285),
]

BENCH_AT = (1.95, 3.38)
BENCH_TURN = float(np.arctan2(BENCH_AT[1], BENCH_AT[0]) - np.pi / 2)  # its front looks at the table
POTS = [(-2.75, 0.55, 1.0), (-2.62, 1.12, 0.72), (2.55, -1.35, 1.0)]  # x, y, size


def furniture(rng: np.random.Generator) -> list[Part]:
    """All parts of this module."""
    return [*_table(rng), *_vase(), *_bouquet(rng), *_bench(rng), *_pots(), *_potted(rng)]


def _table(rng: np.random.Generator) -> list[Part]:
    """A round top of boards on a turned iron foot."""
    thickness, boards = 0.042, 12
    tones = rng.normal(0, 0.17, boards)

    def grain(position: Array) -> Array:
        board = (position[:, 1] + TABLE_RADIUS) * boards / (2 * TABLE_RADIUS)
        gap = np.abs(board - np.round(board)) < 0.05
        k = np.clip(board, 0, boards - 1).astype(int)
        fibre = noise(position * [2.5, 55.0, 1.0] + 7.0 * k[:, None], 31)
        return vary(WOOD, tones[k] + 0.30 * fibre - 0.9 * gap + rng.normal(0, 0.03, len(position)))

    # Rows along the boards up to a circle, then three rings of narrow samples to the rim.
    up, rows, inner = np.array([0.0, 0.0, 1.0]), [], TABLE_RADIUS - 0.028
    for k in range(boards):
        across, height = cells(2 * TABLE_RADIUS / boards, 0.018, 0.0065)
        for y, h in zip(k * 2 * TABLE_RADIUS / boards - TABLE_RADIUS + across, height, strict=True):
            if abs(y) < inner - 0.005:
                reach = np.sqrt(inner**2 - y**2)
                along, width = cells(2 * reach, 0.04, 0.02)
                position = np.stack([along - reach, np.full_like(along, y), np.full_like(along, TABLE_HEIGHT)], axis=1)
                rows.append(
                    samples(position, up, np.array([1.0, 0.0, 0.0]), FILL * np.stack([width, np.full_like(width, h)], 1))
                )
    low, steps = TABLE_HEIGHT - thickness, 230
    turn = 2 * np.pi * np.arange(steps) / steps
    circle = np.stack([np.cos(turn), np.sin(turn), np.zeros(steps)], axis=1)
    tangent = np.stack([-circle[:, 1], circle[:, 0], circle[:, 2]], axis=1)
    arc = FILL * 2 * np.pi * TABLE_RADIUS / steps
    for radius, half in ((0.026, 0.008), (0.014, 0.006), (0.005, 0.004)):
        rows.append(samples((TABLE_RADIUS - radius) * circle + [0, 0, TABLE_HEIGHT], up, tangent, np.array([arc, half])))
    top = join(rows)
    solid = lathe([(0.001, low), (TABLE_RADIUS, low), (TABLE_RADIUS, TABLE_HEIGHT), (0.001, TABLE_HEIGHT)], 9.0, 192)
    edge = join(
        [
            samples(TABLE_RADIUS * circle + [0, 0, low + z], circle, tangent, np.array([arc, FILL * h]))
            for z, h in zip(*cells(thickness, 0.016, 0.007), strict=True)
        ]
    )
    under = lathe([(0.06, low), (TABLE_RADIUS - 0.005, low)], 0.05)
    foot = lathe([(0.30, 0.0), *smooth(FOOT), (0.13, low)], 0.021, 64, 0.008)
    return [
        Part("table", replace(top, vertices=solid.vertices, triangles=solid.triangles), grain(top.position)),
        Part("table", edge, vary(WOOD, -0.1 + 0.3 * noise(edge.position * [4, 4, 90.0], 32))),
        Part("table", under.without_mesh(), np.tile(0.6 * WOOD, (len(under), 1))),
        Part("table", foot, vary(IRON, 0.3 * noise(foot.position * 12.0, 33))),
    ]


def _vase() -> list[Part]:
    """Ceramic: a blue glaze that has run down over bare stoneware, dark within."""
    vase = lathe(smooth(VASE), 0.009, 72)
    x, y, z = vase.position.T
    angle = np.arctan2(y, x)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    run = 0.085 + 0.035 * noise(2.5 * circle, 41, 2)
    glazed = (1 / (1 + np.exp(-(z - run) / 0.005)))[:, None]
    glaze = vary(
        np.array([0.035, 0.12, 0.19]), 0.25 * noise(vase.position * [18, 18, 9.0], 42) + 0.6 * np.clip((z - 0.30) / 0.03, 0, 1)
    )
    ware = vary(np.array([0.30, 0.20, 0.12]), 0.22 * noise(vase.position * 60.0, 43, 2))
    inner = (z > 0.28) & (np.hypot(x, y) < 0.0415)
    paint = np.where(inner[:, None], [0.012, 0.014, 0.016], glazed * glaze + (1 - glazed) * ware)
    return [Part("vase", vase.moved((0.0, 0.0, TABLE_HEIGHT)), paint)]


def _bouquet(rng: np.random.Generator) -> list[Part]:
    """Twigs with red berries, some flowers and leaves in the vase."""
    mouth = np.array([0.0, 0.0, TABLE_HEIGHT + 0.29])
    stems, berries, petals = [], [], []
    petal_color, leaf_color, leaves = [], [], []
    for k in range(13):
        angle = 2.4 * k + rng.uniform(-0.3, 0.3)
        spread = 0.18 + 0.42 * ((k * 5) % 13) / 13
        out = np.array([np.cos(angle) * spread, np.sin(angle) * spread, 1.0])
        flower = k % 2 == 0
        path = wander(
            rng,
            mouth + 0.025 * out * [1, 1, 0],
            out,
            rng.uniform(0.20, 0.30) if flower else rng.uniform(0.34, 0.46),
            6,
            0.10,
            -0.015,
        )
        stems.append(tube(path, np.linspace(0.0032, 0.002, len(path)), 0.02, 5))
        if flower:
            heading = path[-1] - path[-2]
            heading /= np.linalg.norm(heading)
            side = np.cross(heading, [0.3, 0.5, 0.8])
            side /= np.linalg.norm(side)
            for layer, (count, reach, tilt) in enumerate(((11, 0.034, 0.25), (9, 0.024, 0.6))):
                turn = 2 * np.pi * (np.arange(count) + 0.5 * layer) / count
                radial = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(heading, side)
                direction = radial + tilt * heading
                petals.append(
                    cards(
                        path[-1] + 0.62 * reach * direction,
                        direction,
                        heading - tilt * radial,
                        np.full(count, 1.3 * reach),
                        np.full(count, 0.021),
                    )
                )
                tone = np.array([[0.62, 0.20, 0.02], [0.55, 0.10, 0.05], [0.60, 0.33, 0.03]])[(k // 2) % 3]
                petal_color.append(vary(tone, 0.25 * layer + rng.normal(0, 0.12, count)))
            petals.append(cards(path[-1:] + 0.006 * heading, side[None], heading[None], np.array([0.03]), np.array([0.03])))
            petal_color.append(np.array([[0.16, 0.07, 0.015]]))
        else:
            berries.append(np.repeat(path[2:], 5, axis=0) + rng.normal(0, 0.011, (5 * len(path[2:]), 3)))
        n = 7
        at = path[rng.integers(1, 5, n)]
        direction = directions(rng, n) + 0.4 * out
        leaves.append(
            cards(
                at + 0.028 * direction,
                direction,
                np.array([0, 0, 1.0]) + 0.5 * directions(rng, n),
                rng.uniform(0.05, 0.075, n),
                rng.uniform(0.02, 0.028, n),
            )
        )
        leaf_color.append(vary(np.array([0.07, 0.11, 0.035]), rng.normal(0, 0.3, n)))
    beads = np.concatenate(berries)
    # A berry is one nearly round Gaussian; its triangles are a small rhombus that lies level.
    berry = cards(
        beads,
        np.tile([1.0, 0, 0], (len(beads), 1)),
        np.tile([0, 0, 1.0], (len(beads), 1)),
        np.full(len(beads), 0.014),
        np.full(len(beads), 0.014),
    )
    berry = replace(berry, normal=np.tile([0.0, 0.0, 1.0], (len(beads), 1)))
    stem = join(stems)
    return [
        Part("bouquet", stem, np.tile(BARK, (len(stem), 1)), leafy=True),
        Part("bouquet", berry, vary(np.array([0.42, 0.02, 0.015]), rng.normal(0, 0.2, len(berry))), leafy=True, opacity=0.85),
        Part("bouquet", join(petals), np.concatenate(petal_color), leafy=True, opacity=0.96),
        Part("bouquet", join(leaves), np.concatenate(leaf_color), leafy=True, opacity=0.96),
    ]


def _bench(rng: np.random.Generator) -> list[Part]:
    """Slats on two frames; built with its front towards -y."""
    boards: list[Patch] = []
    ground = LAWN_LEVEL if float(np.hypot(*BENCH_AT)) > TERRACE else 0.0
    for y in (-0.24, -0.145, -0.05, 0.045, 0.14):
        boards.append(box((-0.78, y, 0.435), (0.78, y + 0.085, 0.462), (0.09, 0.026), 0.009))
    for z in (0.54, 0.65, 0.76):
        boards.append(box((-0.78, 0.235, z), (0.78, 0.257, z + 0.09), (0.09, 0.028), 0.009))
    for x in (-0.70, 0.64):
        boards += [
            box((x, -0.22, ground), (x + 0.06, -0.16, 0.64), (0.05, 0.03), 0.012),
            box((x, 0.20, ground), (x + 0.06, 0.235, 0.86), (0.05, 0.03), 0.012),
            box((x, -0.16, 0.375), (x + 0.06, 0.20, 0.435), (0.05, 0.03), 0.012),
            box((x - 0.005, -0.25, 0.64), (x + 0.065, 0.20, 0.668), (0.05, 0.03), 0.012),
        ]
    colors = [
        vary(
            1.15 * WOOD,
            rng.normal(0, 0.14) + 0.28 * noise(b.position * [3, 40.0, 40.0] + 5.0 * i, 51) + rng.normal(0, 0.03, len(b)),
        )
        for i, b in enumerate(boards)
    ]
    return [Part("bench", join(boards).moved((*BENCH_AT, 0.0), BENCH_TURN), np.concatenate(colors))]


def _pots() -> list[Part]:
    """Terracotta pots filled with earth."""
    profile = np.array([(0.13, 0.0), (0.19, 0.30), (0.215, 0.30), (0.215, 0.36), (0.185, 0.36), (0.18, 0.33), (0.001, 0.33)])
    parts = []
    for x, y, size in POTS:
        pot = lathe([tuple(p) for p in size * profile], 0.036, 48, 0.012)
        earth = (pot.normal[:, 2] > 0.9) & (pot.position[:, 2] < 0.345 * size)
        paint = vary(np.array([0.33, 0.13, 0.07]), 0.15 * noise(pot.position * 9.0 + x, 61))
        parts.append(Part("pot", pot.moved((x, y, 0.0)), np.where(earth[:, None], EARTH, paint)))
    return parts


def _potted(rng: np.random.Generator) -> list[Part]:
    """A clipped ball of leaves on every pot."""
    parts = []
    for k, (x, y, size) in enumerate(POTS):
        n = round(900 * size**2)
        out = directions(rng, n)
        radius = 0.30 * size * (1 + 0.08 * noise(4.0 * out + k, 111, 2)) * rng.uniform(0.86, 1.0, n)
        position = np.array([x, y, 0.36 * size + 0.25 * size]) + out * radius[:, None]
        normal = out + 0.7 * directions(rng, n)
        leaf = cards(
            position, np.cross(normal, directions(rng, n)), normal, rng.uniform(0.06, 0.085, n), rng.uniform(0.04, 0.055, n)
        )
        green = vary(np.array([0.05, 0.085, 0.03]) if k != 1 else np.array([0.11, 0.10, 0.07]), rng.normal(0, 0.28, n))
        parts.append(Part("shrub", leaf, green, leafy=True))
    return parts
