"""Names of surfels, and how paths end on them."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake.paths import Radiance, Vertex, Wave
from gi_volumes.bake.rays import Tracer
from gi_volumes.bake.surfels import NONE, Known, Lattice, Surfels, Table, are_crowded

SIZE = 0.25
LATTICE = Lattice(np.zeros(3, np.float32), np.full(3, 8, np.float32), SIZE)
AXES = [sign * np.eye(3, dtype=np.float32)[axis] for axis in range(3) for sign in (1, -1)]


def columns(*rows) -> np.ndarray:
    """(3, n) float32."""
    return np.ascontiguousarray(np.array(rows, np.float32).T)


def key(place, normal) -> int:
    """Key of one hit."""
    return int(LATTICE.keys(columns(place), columns(normal))[0][0])


@pytest.mark.parametrize("count", [0, 1, 30, 20000])
def test_a_table_numbers_its_keys_and_no_others(count):
    rng = np.random.default_rng(count)
    near = np.unique(rng.integers(0, 3 * count + 1, count))
    keys = rng.permutation(np.unique(np.concatenate([near, near + (1 << 40), rng.integers(0, 1 << 60, count)])))
    table = Table(keys)
    assert (table.find(keys) == np.arange(len(keys))).all()
    others = np.setdiff1d(np.concatenate([rng.integers(0, 1 << 60, 5000), np.arange(4 * count + 50)]), keys)
    assert (table.find(others) == NONE).all()
    assert table.find(np.array([NONE])) == NONE


@pytest.mark.parametrize("normal", AXES)
def test_a_wall_on_the_lattice_is_one_surfel_wherever_rounding_puts_it(normal):
    across = np.flatnonzero(normal)[0]
    place = np.full(3, 1.1)
    place[across] = 2.0
    assert len({key(place + step * normal, normal) for step in (-3e-6, 0, 3e-6)}) == 1


@pytest.mark.parametrize("normal", AXES)
def test_sides_shelves_and_neighbours_are_surfels_of_their_own(normal):
    place = np.array([1.1, 1.15, 1.2])
    shelf = place + normal * SIZE / 2
    beside = place + np.roll(np.abs(normal), 1) * SIZE
    assert len({key(place, normal), key(place, -normal), key(shelf, normal), key(beside, normal)}) == 4


def test_slopes_that_differ_by_half_a_right_angle_are_surfels_of_their_own():
    slopes = [(np.sin(angle), 0, np.cos(angle)) for angle in np.arange(8) * np.pi / 4]
    assert len({key((1.1, 1.1, 1.1), slope) for slope in slopes}) == 8


def test_cubes_grow_with_the_distance_to_the_cell():
    far = np.array([0.0, 3.9, 4.1, 15.9, 16.1, 1000.0])
    place = columns(*[(8 + distance, 4, 4) for distance in far])
    found, size = LATTICE.keys(place, np.tile(columns((0, 0, 1)), len(far)))
    assert size.tolist() == [SIZE, SIZE, 2 * SIZE, 4 * SIZE, 8 * SIZE, 256 * SIZE]
    assert len(np.unique(found)) == len(far)
    assert (size[1:] <= np.maximum(2 * far[1:] / 16, SIZE)).all()


def test_hits_farther_than_a_key_can_say_have_none():
    small = Lattice(np.zeros(3, np.float32), np.full(3, 4000, np.float32), SIZE)
    found = small.keys(columns((2000, 2000, 2000), (3999, 1, 1)), columns((0, 0, 1), (0, 0, 1)))[0]
    assert found[0] >= 0
    assert found[1] == NONE


def test_paths_end_by_how_far_they_came_and_go_on_where_nothing_is_known():
    known, unknown = (1.1, 1.1, 1.0), (5.1, 1.1, 1.0)
    position, normal = columns(known, known, known, unknown), np.tile(columns((0, 0, 1)), 4)
    table = Table(LATTICE.keys(position[:, :1], normal[:, :1])[0])
    light = np.arange(1, 13, dtype=np.float32).reshape(1, 4, 3)
    floor = Tracer(build_scenes.plane(9.0).astype(np.float32), np.zeros(2, bool))
    none = np.zeros(1, bool)
    known = Known(LATTICE, table, position[:, :1] + 0.1, none, none, floor)
    cache = Surfels(known, light, light / 2)
    beta, reflectance = np.full((3, 4), 0.5, np.float32), np.tile(columns((0.25, 0.5, 0.75)), 4)
    lane = np.array([3, 0, 2, 1])
    wave = Wave(lane, position, normal, beta, np.ones(4, np.float32))
    found = Radiance(*(np.zeros(shape, np.float32) for shape in ((3, 4), (1, 3, 4), (2, 3, 4))))
    travelled = SIZE * np.array([2, 0.5, 0.1, 2], np.float32)
    left, on = cache.finish(wave, Vertex(np.zeros(4, np.int32), position, normal, reflectance), travelled, found)
    assert left.tolist() == [1, 2, 3]
    assert left[on].tolist() == [2, 3]
    whole = light[0] * [0.125, 0.25, 0.375] / np.pi
    assert pytest.approx(np.array([whole[0], whole[0] / 2, 0 * whole[0], 0 * whole[0]])) == found.local[:, lane].T
    assert found.sun[0][:, 3] == pytest.approx(whole[1])
    assert found.sky[:, :, 3] == pytest.approx(whole[2:])
    assert found.sky[:, :, 0] == pytest.approx(whole[2:] / 2)


def test_hits_that_do_not_see_the_middle_of_a_crowded_cube_are_not_of_its_surfel():
    here, there = (1.1, 1.15, 1.0), (1.2, 1.15, 1.0)
    position, normal = columns(here, there), np.tile(columns((0, 0, 1)), 2)
    wall = build_scenes.quad((1.15, 0, 0), (1.15, 3, 0), (1.15, 3, 3), (1.15, 0, 3)).astype(np.float32)
    table = Table(LATTICE.keys(position[:, :1], normal[:, :1])[0])
    for crowded, expected in ((True, [0, NONE]), (False, [0, 0])):
        flags, tracer = (np.array([crowded]), np.zeros(1, bool)), Tracer(wall, np.zeros(2, bool))
        known = Known(LATTICE, table, columns((1.1, 1.15, 1.06)), *flags, tracer)
        assert known.which(position, normal, np.full(2, 5, np.float32))[0].tolist() == expected


def test_cubes_are_crowded_where_surfaces_meet():
    places = [((1.1, 1.1, 1.0), (0, 0, 1)), ((1.1, 1.1, 1.1), (1, 0, 0)), ((3.1, 1.1, 1.0), (0, 0, 1))]
    keys = np.array([key(*place) for place in places])
    order = np.argsort(keys)
    assert are_crowded(keys[order])[np.argsort(order)].tolist() == [True, True, False]


def test_direct_light_is_looked_for_on_uneven_surfels_from_any_distance():
    position, normal = columns((1.1, 1.15, 1.0)), columns((0, 0, 1))
    table, nothing = (
        Table(LATTICE.keys(position, normal)[0]),
        Tracer(np.zeros((0, 3, 3), np.float32), np.zeros(0, bool)),
    )
    for uneven in (False, True):
        known = Known(LATTICE, table, position, np.zeros(1, bool), np.array([uneven]), nothing)
        number, near = known.which(position, normal, np.full(1, 50, np.float32))
        assert (number.tolist(), near.tolist()) == ([0], [uneven])
