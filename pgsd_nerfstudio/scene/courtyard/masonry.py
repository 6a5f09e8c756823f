"""Ground and walls of the courtyard: the round terrace, the brick walls with their coping, and the backs of the walls.

Lengths are in metres and z is up; the terrace is the plane z = 0 and the table stands in its middle. Colours are linear
albedos. Joints and mortar are painted on the surfaces of the mesh.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from pgsd_nerfstudio.scene.courtyard.surfels import FILL, Array, Part, Patch, box, cells, join, lathe, rectangle, samples
from pgsd_nerfstudio.scene.courtyard.texture import noise, vary

HALF = 5.6  # the courtyard reaches from -HALF to HALF in x and y
TERRACE = 3.3  # radius
LAWN_LEVEL = -0.04
WALL_HEIGHT = 1.75  # below the coping
WALL_THICKNESS = 0.24

STONE = np.array([0.235, 0.212, 0.188])
JOINT = np.array([0.05, 0.048, 0.036])
BRICK = np.array([0.215, 0.09, 0.06])
MORTAR = np.array([0.19, 0.17, 0.145])


def masonry(rng: np.random.Generator) -> list[Part]:
    """All parts of this module."""
    return [*_terrace(rng), *_walls(rng), *_backing()]


def _terrace(rng: np.random.Generator) -> list[Part]:
    """Rings of slabs about a round one; the outermost ring is of small dark setts."""
    rings = [0.0, 0.42, 0.80, 1.18, 1.58, 1.98, 2.38, 2.76, 3.12, TERRACE]
    joint = 0.009
    slabs, colors, gaps = [], [], []
    for k, (inner, outer) in enumerate(pairwise(rings)):
        sett = outer == TERRACE
        middle = 0.5 * (inner + outer)
        count = 1 if k == 0 else round(2 * np.pi * middle / (0.17 if sett else rng.uniform(0.5, 0.62)))
        spacing = 0.085 if sett else 0.05 if outer < 2.5 else 0.066
        start = rng.uniform(0, 2 * np.pi)
        for slab in range(count):
            arc = 2 * np.pi / count
            patch = _ring_sector(
                inner, outer, start + slab * arc, arc, joint if k else 0.0, spacing, 0.014 if k and not sett else None
            )
            tone, warmth = rng.normal(0, 0.16), rng.normal(0, 0.05)
            stain = noise(patch.position * 2.2, 11) + 0.8 * noise(patch.position * 9.0 + slab, 12)
            paint = vary(STONE * (0.45 if sett else 1.0), tone + 0.13 * stain + rng.normal(0, 0.035, len(patch)))
            slabs.append(patch)
            colors.append(paint * np.exp(warmth * np.array([1.0, 0.0, -1.0])))
            if k:
                gaps.append(_strip((middle, start + slab * arc), outer - inner, joint, radial=True))
        if k:
            steps = round(2 * np.pi * inner / 0.07)
            around = np.linspace(0, 2 * np.pi, steps, endpoint=False)
            gaps.extend(_strip((inner, a), 2 * np.pi * inner / steps, joint, radial=False) for a in around)
    turn = np.linspace(0, 2 * np.pi, 192, endpoint=False)
    rim = np.stack([TERRACE * np.cos(turn), TERRACE * np.sin(turn), np.zeros(192)], axis=1)
    i = np.arange(192)
    fan = np.stack([np.full(192, 192), i, (i + 1) % 192], axis=1)
    side = lathe([(TERRACE, LAWN_LEVEL), (TERRACE, 0.0)], 0.04, 192)
    top = replace(join(slabs), vertices=np.concatenate([rim, np.zeros((1, 3))]), triangles=fan)
    seams = join(gaps)
    moss = noise(seams.position * 1.5, 13) > 0.25
    seam_color = np.where(moss[:, None], [0.07, 0.09, 0.03], JOINT) * rng.uniform(0.8, 1.2, (len(seams), 1))
    spots = rng.uniform(-2.6, 2.6, (500, 2))
    tangent = np.stack([np.cos(spots[:, 0] * 99), np.sin(spots[:, 0] * 99), np.zeros(500)], axis=1)
    lichen = samples(
        np.concatenate([spots, np.full((500, 1), 0.002)], 1),
        np.array([0, 0, 1.0]),
        tangent,
        rng.uniform(0.007, 0.022, (500, 2)),
    )
    return [
        Part("paving", lichen, vary(STONE, rng.normal(-0.1, 0.5, 500)), opacity=0.5),
        Part("paving", top, np.concatenate(colors)),
        Part("paving", seams, seam_color, opacity=0.9),
        Part("paving", side, vary(0.4 * STONE, 0.2 * noise(side.position * 8.0, 14))),
    ]


def _ring_sector(
    inner: float, outer: float, start: float, arc: float, joint: float, spacing: float, edge: float | None
) -> Patch:
    """Samples of one slab between two radii, with cells of width `edge` along its four sides."""
    (r, dr), rows = cells(outer - inner - joint, spacing, edge), []
    for radius, depth in zip(r + inner + joint / 2, dr, strict=True):
        along, width = cells(arc * radius - joint, spacing, edge)
        angle = start + (along + joint / 2) / radius
        out = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        tangent = np.stack([-out[:, 1], out[:, 0], out[:, 2]], axis=1)
        rows.append(
            samples(radius * out, np.array([0.0, 0.0, 1.0]), tangent, FILL * np.stack([width, np.full_like(width, depth)], 1))
        )
    return join(rows)


def _strip(at: tuple[float, float], length: float, width: float, *, radial: bool) -> Patch:
    """A short piece of joint between slabs, as a row of long thin samples; `at` is (radius, angle)."""
    radius, angle = at
    out = np.array([[np.cos(angle), np.sin(angle), 0.0]])
    along = out if radial else np.array([[-out[0, 1], out[0, 0], 0.0]])
    offsets, lengths = cells(length, 0.07)
    position = radius * out + (offsets - length / 2)[:, None] * along
    size = np.stack([FILL * lengths, np.full_like(lengths, 0.55 * width)], axis=1)
    return samples(position, np.array([0.0, 0.0, 1.0]), along, size)


def _walls(rng: np.random.Generator) -> list[Part]:
    """Brick walls in the north (y = HALF) and in the west (x = -HALF) under flat coping stones."""
    parts = []
    length = 2 * HALF + WALL_THICKNESS
    for turn in (0.0, np.pi / 2):
        # Built along x with the face at y = HALF looking to -y; the quarter turn makes it the western wall.
        block = box((-HALF - WALL_THICKNESS, HALF, LAWN_LEVEL - 0.1), (HALF, HALF + WALL_THICKNESS, WALL_HEIGHT), (9.0, 9.0))
        bricks, colors = _brick_face(rng, length)
        beds, perpends = _mortar(length)
        face = replace(bricks, vertices=block.vertices, triangles=block.triangles)
        mortar = join([beds, perpends])
        moss = np.clip(1.0 - (mortar.position[:, 2] + 0.1) / 0.5, 0, 1) * (noise(mortar.position * 2.0, 21) > -0.3)
        stones, stone_colors = [], []
        for x in np.arange(-HALF - WALL_THICKNESS, HALF - 0.1, 0.62):
            upper = (min(x + 0.614, HALF), HALF + WALL_THICKNESS + 0.05, WALL_HEIGHT + 0.075)
            stone = box((x, HALF - 0.05, WALL_HEIGHT), upper, (0.16, 0.1), 0.024, hidden="x- x+ y+" if x > -HALF else "x+ y+")
            grain = 0.15 * noise(stone.position * 7.0, 22) + rng.normal(0, 0.10)
            stones.append(stone)
            stone_colors.append(vary(0.95 * STONE, grain))
        coping = join(stones)
        parts += [
            Part("wall", face.moved((0, 0, 0), turn), colors),
            Part(
                "wall",
                mortar.moved((0, 0, 0), turn),
                vary(MORTAR, 0.15 * noise(mortar.position * 3.0, 23) - moss),
                opacity=0.75,
            ),
            Part("coping", coping.moved((0, 0, 0), turn), np.concatenate(stone_colors)),
        ]
    return parts


def _brick_face(rng: np.random.Generator, length: float) -> tuple[Patch, Array]:
    """Stretcher bond: three samples for each brick of 21.5 x 6.5 cm."""
    course, pitch, pieces = 0.075, 0.225, 3
    rows = int(np.ceil((WALL_HEIGHT - LAWN_LEVEL) / course))
    row, col, piece = (
        g.ravel()
        for g in np.meshgrid(np.arange(rows), np.arange(-1, int(length / pitch) + 2), np.arange(pieces), indexing="ij")
    )
    left = (col + 0.5 * (row % 2)) * pitch
    x = -HALF - WALL_THICKNESS + left + 0.005 + 0.215 * (piece + 0.5) / pieces
    z = WALL_HEIGHT - (row + 0.5) * course
    position = np.stack([x, np.full_like(x, HALF), z], axis=1)
    bricks = samples(position, np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.046, 0.0285]))
    number = row * 1000 + col + 5
    tone, warmth = rng.normal(0, 0.26, number.max() + 1)[number], rng.normal(0, 0.10, number.max() + 1)[number]
    damp = -0.55 * np.clip(1.0 - (z - LAWN_LEVEL) / 0.45, 0, 1) * (0.7 + 0.6 * noise(position * 1.3, 24))
    stain = 0.14 * noise(position * 0.9, 25) - 0.25 * np.clip((z - WALL_HEIGHT + 0.25) / 0.25, 0, 1)
    paint = vary(BRICK, tone + damp + stain + rng.normal(0, 0.06, len(z))) * np.exp(
        warmth[:, None] * np.array([0.6, 0.0, -0.4])
    )
    inside = (x > -HALF - WALL_THICKNESS) & (x < HALF)
    return replace(bricks, **{k: getattr(bricks, k)[inside] for k in ("position", "normal", "tangent", "size")}), paint[inside]


def _mortar(length: float) -> tuple[Patch, Patch]:
    """The beds between the courses, and the perpends between the bricks of a course."""
    course, pitch = 0.075, 0.225
    rows = np.arange(1, int(np.ceil((WALL_HEIGHT - LAWN_LEVEL) / course)))
    along, width = cells(length, 0.17)
    x, z = (g.ravel() for g in np.meshgrid(along - HALF - WALL_THICKNESS, WALL_HEIGHT - rows * course))
    # Were the pieces of all beds in line, they would show as upright stripes on a wall seen from the side.
    x = np.clip(x + width[0] * (0.618 * np.repeat(rows, len(along)) % 1 - 0.5), -HALF - WALL_THICKNESS, HALF)
    position = np.stack([x, np.full_like(x, HALF), z], axis=1)
    facing, level = np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    beds = samples(position, facing, level, np.array([FILL * width[0], 0.0068]))
    row, col = (
        g.ravel() for g in np.meshgrid(np.append(rows - 1, rows[-1]), np.arange(int(length / pitch) + 1), indexing="ij")
    )
    x = -HALF - WALL_THICKNESS + (col + 0.5 * (row % 2)) * pitch
    position = np.stack([x, np.full_like(x, HALF), WALL_HEIGHT - (row + 0.5) * course], axis=1)
    return beds, samples(position[x < HALF], facing, level, np.array([0.0062, 0.026]))


def _backing() -> list[Part]:
    """Earth below the ground and cores in the walls: what little passes between the samples ends here, not in the sky."""
    size = HALF + 0.6
    ground = rectangle((-size, -size, -0.22), (2 * size, 0, 0), (0, 2 * size, 0), (0.36, 0.36))
    # Well inside the walls: these samples are wide.
    core = rectangle((-HALF, HALF + 0.14, -0.2), (2 * HALF - 0.35, 0, 0), (0, 0, WALL_HEIGHT - 0.05), (0.3, 0.3))
    cores = join([core, core.moved((0, 0, 0), np.pi / 2)])
    return [
        Part("backing", ground.without_mesh(), np.tile(JOINT, (len(ground), 1))),
        Part("backing", cores.without_mesh(), np.tile(0.8 * BRICK, (len(cores), 1))),
    ]
