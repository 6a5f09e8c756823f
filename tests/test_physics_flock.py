"""Particles in place: what stays, what leaves and why, their order along a curve; against plain forms."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from pgsd_nerfstudio.physics.air.leaving import Leaving
from pgsd_nerfstudio.physics.air.sight import Sight
from pgsd_nerfstudio.physics.bodies import Bodies
from pgsd_nerfstudio.physics.clock import Domain
from pgsd_nerfstudio.physics.curve import along_curve
from pgsd_nerfstudio.physics.flock import Flock

DOMAIN = Domain((-2.0, -1.0, 0.0), (2.0, 3.0, 4.0))


def bodies(count: int, seed: int = 0) -> Bodies:
    rng, none = np.random.default_rng(seed), Bodies.none()
    shapes = {f.name: (count, *getattr(none, f.name).shape[1:]) for f in fields(Bodies)}
    made = {name: (100 * rng.uniform(size=shape)).astype(getattr(none, name).dtype) for name, shape in shapes.items()}
    lower, size = np.array(DOMAIN.lower) - 0.5, np.array(DOMAIN.size) + 1.0
    made["positions"] = (lower + size * rng.uniform(size=(count, 3))).astype(np.float32)
    return Bodies(**made)


def same(first: Bodies, second: Bodies) -> bool:
    return all(np.array_equal(getattr(first, f.name), getattr(second, f.name)) for f in fields(Bodies))


def test_what_stays_and_what_comes_is_what_selecting_and_joining_would_give():
    expected, rng = bodies(50), np.random.default_rng(1)
    flock = Flock(expected)
    for seed in range(12):
        stays = (rng.uniform(size=len(expected)) < 0.8).nonzero()[0]
        new = bodies(seed * 7, seed)
        flock.keep(stays.astype(np.uint32))
        flock.add(new)
        expected = Bodies.join([expected.select(stays), new])
        assert len(flock) == len(expected) and same(flock.bodies, expected)


def test_particles_that_move_in_place_do_not_change_those_that_were_given():
    given = bodies(5)
    before = given.positions.copy()
    flock = Flock(given)
    flock.bodies.positions[:] += 1
    np.testing.assert_array_equal(given.positions, before)
    np.testing.assert_array_equal(flock.bodies.positions, before + 1)


@pytest.mark.parametrize("with_front", [False, True])
@pytest.mark.parametrize("with_sight", [False, True])
def test_who_leaves_is_whom_the_plain_rules_name(with_front, with_sight):
    flying, rng = bodies(4000, 3), np.random.default_rng(4)
    at = flying.positions
    contacts = np.sort(rng.choice(4000, 300, replace=False))
    distances = np.where(rng.uniform(size=(5, 4, 3)) < 0.3, np.inf, 100 * rng.uniform(size=(5, 4, 3))).astype(np.float32)
    lower, cell = np.array(DOMAIN.lower), np.array(DOMAIN.size) / [5, 4, 3]
    sight = Sight(lower, cell, distances, distances) if with_sight else Sight.everything()
    passed = rng.uniform(size=4000) < 0.9 if with_front else None
    over = rng.uniform(size=4000) < 0.1
    found = Leaving.of(flying, contacts, DOMAIN, sight, passed, over)
    contact = np.isin(np.arange(4000), contacts)
    outside = ((at < np.float32(DOMAIN.lower)) | (at > np.float32(DOMAIN.upper))).any(1) & ~contact
    ahead = ~contact & ~outside & (~passed if passed is not None else False)
    unseen = ~(contact | outside | ahead) & (over | ~sight.needed(at, flying.reaches))
    for which, expected in ((found.out, outside), (found.ahead, ahead), (found.unseen, unseen)):
        np.testing.assert_array_equal(which, expected.nonzero()[0])
    np.testing.assert_array_equal(found.stays, (~(contact | outside | ahead | unseen)).nonzero()[0])
    assert found.broken == 0 and len(found.unseen) > 0


def test_broken_particles_are_counted():
    flying = bodies(6)
    flying.positions[1, 2], flying.velocities[4, 0] = np.nan, np.inf
    assert Leaving.of(flying, np.zeros(0, np.int64), DOMAIN, Sight.everything(), None).broken == 2


def test_neighbours_on_the_curve_are_neighbours_in_space():
    points = np.random.default_rng(0).uniform(DOMAIN.lower, DOMAIN.upper, (5000, 3)).astype(np.float32)
    order = along_curve(points, np.array(DOMAIN.lower), np.array(DOMAIN.upper))
    assert sorted(order) == list(range(5000))
    apart = [np.linalg.norm(np.diff(points[which], axis=0), axis=1).mean() for which in (order, np.arange(5000))]
    assert apart[0] < 0.25 * apart[1]
    assert len(along_curve(points[:0], np.zeros(3), np.ones(3))) == 0
