"""The wrapper around Embree: brute force, opaque and transparent triangles, offsets at every scale."""

from __future__ import annotations

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake import warp
from gi_volumes.bake.rays import MISS, SKIP, Tracer
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.snapshot import Material

FAR = np.float32(1e30)
EDGE = 1e-4
"""Barycentric distance from an edge within which float32 may decide either way."""


def rays(seed: int, count: int, reach: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-reach, reach, (3, count)).astype(np.float32)
    return origin, warp.sphere(*rng.random((2, count), np.float32))


def triangles(seed: int, count: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.uniform(-1, 1, (count, 1, 3)) + rng.normal(0, 0.3, (count, 3, 3))).astype(np.float32)


def moller_trumbore(corners, origin, direction):
    """(rays, triangles) distances, inf for none, and barycentrics u, v, in double precision."""
    corners, origin, direction = (np.asarray(a, np.float64) for a in (corners, origin.T, direction.T))
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction[:, None], edge2[None])
    determinant = np.einsum("rtk,tk->rt", p, edge1)
    start = origin[:, None] - corners[None, :, 0]
    u = np.einsum("rtk,rtk->rt", start, p) / determinant
    q = np.cross(start, edge1[None])
    v = np.einsum("rk,rtk->rt", direction, q) / determinant
    t = np.einsum("tk,rtk->rt", edge2, q) / determinant
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(hit, t, np.inf), u, v


def clear_cases(u, v, t):
    """(rays,) whether no triangle is met so close to an edge, or to the origin, that rounding decides."""
    margin = np.minimum(np.minimum(u, v), 1 - u - v)
    return ~((np.abs(margin) < EDGE) | ((margin > -EDGE) & (np.abs(t) < EDGE))).any(axis=1)


def first_of(distance):
    """(ray, nearest triangle or MISS)."""
    return np.where(np.isfinite(distance.min(axis=1)), distance.argmin(axis=1), MISS)


def plain_t(corners, origin, direction):
    """Distances to the triangles' planes."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).astype(np.float64)
    height = np.einsum("tk,rtk->rt", normal, corners[None, :, 0] - origin.T[:, None].astype(np.float64))
    return height / (direction.T @ normal.T)


def test_first_hits_are_those_of_brute_force_with_their_distance_barycentrics_and_normal():
    corners = triangles(1, 150)
    origin, direction = rays(2, 2000, 2.0)
    distance, u, v = moller_trumbore(corners, origin, direction)
    clear = clear_cases(u, v, plain_t(corners, origin, direction))
    assert clear.mean() > 0.8
    hits = Tracer(corners, np.zeros(150, bool)).intersect(origin, direction)
    first = first_of(distance)
    assert np.array_equal(hits.triangle[clear], first[clear])
    rows = np.flatnonzero(clear & (first != MISS))
    assert len(rows) > 300
    at = (rows, first[rows])
    assert np.allclose(hits.distance[rows], distance[at], rtol=1e-4, atol=1e-5)
    assert np.allclose(hits.u[rows], u[at], atol=2e-3)
    assert np.allclose(hits.v[rows], v[at], atol=2e-3)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.allclose(hits.normal[:, rows].T, normal[first[rows]], rtol=1e-4, atol=1e-5)


def test_segments_are_blocked_where_brute_force_finds_an_opaque_triangle_before_their_end():
    corners = triangles(3, 60)
    transparent = np.arange(60) % 3 == 0
    origin, direction = rays(4, 2000, 2.0)
    direction = direction * np.float32(2.5)
    far = np.random.default_rng(5).uniform(0.05, 1.5, 2000).astype(np.float32)
    distance, u, v = moller_trumbore(corners, origin, direction)
    clear = clear_cases(u, v, plain_t(corners, origin, direction))
    clear &= (np.abs(distance - far[:, None]) > EDGE).all(axis=1)
    tracer = Tracer(corners, transparent)
    before = far.copy()
    found = tracer.blocked(origin, direction, far)
    truth = (distance[:, ~transparent] < far[:, None]).any(axis=1)
    assert np.array_equal(found[clear], truth[clear])
    assert 0.02 < truth.mean() < 0.98
    with_all = (distance < far[:, None]).any(axis=1)
    assert not np.array_equal(found[clear], with_all[clear])
    assert np.array_equal(far, before)


def test_transparent_hits_are_the_first_transparent_triangle_before_the_end_numbered_among_all():
    corners = triangles(6, 60)
    transparent = np.arange(60) % 4 == 1
    origin, direction = rays(7, 2000, 2.0)
    far = np.full(2000, 1.2, np.float32)
    distance, u, v = moller_trumbore(corners, origin, direction)
    clear = clear_cases(u, v, plain_t(corners, origin, direction)) & (np.abs(distance - 1.2) > EDGE).all(axis=1)
    distance[:, ~transparent] = np.inf
    distance[distance > 1.2] = np.inf
    tracer = Tracer(corners, transparent)
    assert tracer.has_transparent
    hits = tracer.intersect_transparent(origin, direction, far)
    first = first_of(distance)
    assert np.array_equal(hits.triangle[clear], first[clear])
    rows = np.flatnonzero(clear & (first != MISS))
    assert len(rows) > 30
    assert np.allclose(hits.distance[rows], distance[rows, first[rows]], rtol=1e-4, atol=1e-5)
    assert np.all(far == np.float32(1.2))


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_scene_of_only_opaque_or_only_transparent_triangles_answers_every_query(share):
    corners = build_scenes.plane(10.0).astype(np.float32)
    tracer = Tracer(corners, np.full(2, bool(share)))
    origin, direction = np.array([[0.3], [0.2], [1.0]], np.float32), np.array([[0], [0], [-1]], np.float32)
    assert tracer.intersect(origin, direction).triangle[0] != MISS
    assert tracer.blocked(origin, direction, np.array([FAR]))[0] == (share == 0)
    assert tracer.has_transparent == (share == 1)
    if share:
        assert tracer.intersect_transparent(origin, direction, np.array([FAR])).triangle[0] != MISS


def test_a_skipped_ray_is_free_whatever_is_in_front_of_it_and_its_neighbours_are_not():
    tracer = Tracer(build_scenes.plane(10.0).astype(np.float32), np.zeros(2, bool))
    count = 1000
    origin = np.tile(np.array([[0.3], [0.2], [1.0]], np.float32), (1, count))
    direction = np.tile(np.array([[0], [0], [-1]], np.float32), (1, count))
    skipped = np.random.default_rng(8).random(count) < 0.4
    assert np.array_equal(tracer.blocked(origin, direction, np.where(skipped, SKIP, FAR)), ~skipped)
    assert not tracer.blocked(origin, direction, np.full(count, SKIP)).any()


def test_a_ray_that_ends_before_a_surface_is_free_and_one_that_ends_behind_it_is_not():
    tracer = Tracer(build_scenes.plane(10.0).astype(np.float32), np.zeros(2, bool))
    origin = np.tile(np.array([[0.3], [0.2], [1.0]], np.float32), (1, 2))
    direction = np.tile(np.array([[0], [0], [-2]], np.float32), (1, 2))
    found = tracer.blocked(origin, direction, np.array([0.4999, 0.5001], np.float32))
    assert found.tolist() == [False, True]


def test_no_rays_give_no_hits():
    tracer = Tracer(build_scenes.plane(1.0).astype(np.float32), np.array([True, False]))
    nothing = np.zeros((3, 0), np.float32)
    assert len(tracer.intersect(nothing, nothing).triangle) == 0
    assert len(tracer.blocked(nothing, nothing, np.zeros(0, np.float32))) == 0
    assert len(tracer.intersect_transparent(nothing, nothing, np.zeros(0, np.float32)).triangle) == 0


@pytest.mark.parametrize(
    ("origin", "direction", "far"),
    [
        (np.zeros((3, 4), np.float32), np.ones((3, 5), np.float32), np.ones(4, np.float32)),
        (np.zeros((3, 4)), np.ones((3, 4), np.float32), np.ones(4, np.float32)),
        (np.zeros((3, 4), np.float32), np.ones((3, 4)), np.ones(4, np.float32)),
        (np.zeros((4, 3), np.float32), np.ones((4, 3), np.float32), np.ones(4, np.float32)),
        (np.zeros(3, np.float32), np.ones(3, np.float32), np.ones(1, np.float32)),
        (np.zeros((3, 4), np.float32), np.ones((3, 4), np.float32), np.ones(3, np.float32)),
        (np.zeros((3, 4), np.float32), np.ones((3, 4), np.float32), np.ones((4, 1), np.float32)),
    ],
)
def test_rays_of_unequal_or_unexpected_shape_are_refused_before_embree_sees_them(origin, direction, far):
    tracer = Tracer(build_scenes.plane(1.0).astype(np.float32), np.array([True, False]))
    with pytest.raises(ValueError, match="want"):
        tracer.blocked(origin, direction, far)
    with pytest.raises(ValueError, match="want"):
        tracer.intersect_transparent(origin, direction, far)


def sphere(radius: float, rings: int = 60, inward: bool = True) -> np.ndarray:
    """(n, 3, 3) closed ball of quads cut in two, without the degenerate ones at its poles."""
    theta = np.linspace(0, np.pi, rings + 1)
    phi = np.linspace(0, 2 * np.pi, 2 * rings + 1)
    grid = np.stack(np.broadcast_arrays(np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi)), -1)
    grid = radius * np.concatenate([grid, np.broadcast_to(np.cos(theta)[:, None, None], (*grid.shape[:2], 1))], -1)
    grid[:, -1] = grid[:, 0]
    grid[[0, -1]] = [[[0, 0, radius]], [[0, 0, -radius]]]
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -2)[1:].reshape(-1, 3, 3), np.stack([a, c, d], -2)[:].reshape(-1, 3, 3)]
    )
    faces = faces[np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1) > 0]
    faces = np.concatenate([faces, np.stack([a, b, c], -2)[:1].reshape(-1, 3, 3)])
    return faces[:, ::-1] if inward else faces


def hit_again(tracer: Tracer, radius: float, start: np.ndarray, scale: float) -> tuple[float, int]:
    """(share of scattered rays that meet the surface they start on, rays that leave a closed ball)."""
    count = 20000
    rng = np.random.default_rng(9)
    direction = warp.sphere(*rng.random((2, count), np.float32))
    origin = np.repeat(start[:, None], count, axis=1).astype(np.float32)
    hits = tracer.intersect(origin, direction)
    rows = np.flatnonzero(hits.triangle != MISS)
    assert len(rows) > 0.999 * count
    hits_normal = hits.normal[:, rows] / np.sqrt(warp.dot(hits.normal[:, rows], hits.normal[:, rows]))
    facing = hits_normal * -np.copysign(np.float32(1), warp.dot(hits_normal, direction[:, rows]))
    position = origin[:, rows] + direction[:, rows] * hits.distance[rows]
    position = position + facing * (np.float32(scale) * tracer.offset(position, hits.distance[rows]))
    onward = warp.cosine(*rng.random((2, len(rows)), np.float32), facing)
    again = tracer.intersect(position, onward)
    return float((again.triangle == hits.triangle[rows]).mean()), int((again.triangle == MISS).sum())


@pytest.mark.parametrize("radius", [5e-4, 1.0, 50.0, 5e4])
def test_rays_from_offset_points_never_meet_their_own_triangle_from_a_millimetre_to_100_km(radius):
    corners = sphere(radius).astype(np.float32)
    tracer = Tracer(corners, np.zeros(len(corners), bool))
    start = np.array([0.1, -0.2, 0.15]) * radius
    selfish, lost = hit_again(tracer, radius, start, 1.0)
    assert selfish == 0
    assert lost == 0
    assert hit_again(tracer, radius, start, 0.0)[0] > 0.01


@pytest.mark.parametrize("radius", [1.0, 20.0])
def test_a_scene_500_km_away_hits_itself_no_more_than_one_at_the_origin(radius):
    origin = np.array([1024.0 * 488, -1024.0 * 488, 0.0])
    snapshot = build_scenes.snapshot([(sphere(radius), Material("wall"))], origin=origin)
    scene = prepare(snapshot, Model())
    assert np.abs(scene.soup.bounds).max() == pytest.approx(radius, rel=1e-6)
    selfish, lost = hit_again(scene.tracer, radius, np.array([0.1, -0.2, 0.15]) * radius, 1.0)
    assert (selfish, lost) == (0.0, 0)


def test_a_scene_a_kilometre_from_its_origin_does_not_hit_itself_either():
    center = np.array([900.0, -700.0, 400.0])
    corners = (sphere(3.0) + center).astype(np.float32)
    tracer = Tracer(corners, np.zeros(len(corners), bool))
    selfish, _ = hit_again(tracer, 3.0, center, 1.0)
    assert selfish == 0


def test_every_traced_ray_is_counted():
    tracer = Tracer(build_scenes.plane(1.0).astype(np.float32), np.zeros(2, bool))
    origin, direction = rays(10, 123)
    tracer.intersect(origin, direction)
    tracer.blocked(origin, direction, np.full(123, FAR))
    assert tracer.rays == 246
