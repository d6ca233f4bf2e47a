"""Instances as one list of triangles: faces keep their front, corners their attributes, far scenes their detail."""

from __future__ import annotations

import dataclasses

import build_scenes
import numpy as np
import pytest
from gi_volumes.bake.scene import Model, prepare
from gi_volumes.bake.snapshot import Channel, Geometry, Material, Snapshot, SnapshotError
from gi_volumes.bake.soup import flatten

BOX = build_scenes.box((-1, -2, -3), (2, 1, 0.5))
BOX_VOLUME = 3 * 3 * 3.5


def signed_volume(corners: np.ndarray) -> float:
    """Of a closed surface: positive when its faces point outward."""
    a, b, c = corners.astype(np.float64).transpose(1, 0, 2)
    return float(np.einsum("nk,nk->n", a, np.cross(b, c)).sum() / 6)


def transform(linear, offset=(0, 0, 0)) -> np.ndarray:
    """(3, 4) world_from_mesh."""
    return np.concatenate([np.asarray(linear, float), np.asarray(offset, float)[:, None]], axis=1)


def placed(transforms, meshes=(BOX,), which=None, origin=(0, 0, 0), **attributes) -> Snapshot:
    """Instances of meshes."""
    base = build_scenes.snapshot([(mesh, Material("m")) for mesh in meshes], origin=origin)
    count = len(transforms)
    first = np.concatenate([[0], np.cumsum([len(mesh) for mesh in meshes])])
    geometry = dataclasses.replace(
        base.geometry,
        mesh_first_triangle=first.astype(np.int64),
        instance_mesh=np.zeros(count, np.int32) if which is None else np.asarray(which, np.int32),
        instance_transform=np.asarray(transforms, np.float64).reshape(count, 3, 4),
        instance_names=tuple(f"thing {i}" for i in range(count)),
        **attributes,
    )
    return dataclasses.replace(base, geometry=geometry)


MIRRORS = {
    "one axis": np.diag([-1.0, 1, 1]),
    "two axes": np.diag([-1.0, -1, 1]),
    "three axes": np.diag([-1.0, -1, -1]),
    "uneven": np.diag([2.0, 0.1, -7]),
    "sheared": np.array([[1, 0.7, 0], [0, -1, 0.3], [0.2, 0, 1.5]]),
    "turned": np.array([[0, 1, 0], [1, 0, 0], [0, 0, 1.0]]),
}


@pytest.mark.parametrize("name", MIRRORS)
def test_faces_of_mirrored_and_uneven_instances_stay_outward_and_their_volume_is_the_determinant(name):
    linear = MIRRORS[name]
    soup = flatten(placed([transform(linear, (0.5, -0.25, 4))]))
    assert signed_volume(soup.corners) == pytest.approx(abs(np.linalg.det(linear)) * BOX_VOLUME, rel=1e-4)
    in_source_order = np.take_along_axis(soup.corners, soup.corner_order[:, :, None].astype(int), axis=1)
    assert np.sign(signed_volume(in_source_order)) == np.sign(np.linalg.det(linear))


def test_corners_are_the_source_s_corners_in_the_order_that_the_soup_names():
    transforms = [transform(linear, (k, 2 * k, -k)) for k, linear in enumerate(MIRRORS.values())]
    snapshot = placed(transforms)
    soup, geometry = flatten(snapshot), snapshot.geometry
    source = geometry.positions[geometry.triangles[soup.source]].astype(np.float64)
    source = np.take_along_axis(source, soup.corner_order[:, :, None].astype(int), axis=1)
    linear = geometry.instance_transform[soup.instance]
    truth = np.einsum("nij,ncj->nci", linear[:, :, :3], source) + linear[:, None, :, 3]
    assert np.allclose(soup.corners, truth, rtol=1e-6, atol=1e-6)
    assert set(np.unique(soup.corner_order.sum(axis=1))) == {3}


def test_vertex_colours_stay_on_their_corners_when_an_instance_is_mirrored():
    colors = np.random.default_rng(1).uniform(0, 1, (12, 3, 4)).astype(np.float32)
    painted = Material("m", base_color=Channel((1.0,) * 3, vertex_color=True), specular_level=0.0)
    triangle, half = np.arange(12), np.zeros(12, np.float32)
    found = []
    for linear in (np.eye(3), np.diag([-1.0, 1, 1])):
        snapshot = dataclasses.replace(placed([transform(linear)], corner_colors=colors), materials=(painted,))
        scene = prepare(snapshot, Model())
        corners = scene.soup.corners * np.diag(linear)
        found.append((corners, [scene.surfaces.reflectance(triangle, half + u, half + v) for u, v in ((0, 0), (1, 0))]))
    plain, mirrored = found
    for k in (0, 1):
        rows = (mirrored[0][:, k, None] == plain[0]).all(axis=2).argmax(axis=1)
        truth = colors[np.arange(12), rows, :3]
        assert np.allclose(mirrored[1][k].T, truth, atol=1e-6)


def test_a_scene_500_km_away_keeps_half_a_float32_step_of_its_size_and_single_precision_would_not():
    place = np.array([512_000.0 + 13.37, -499_712.0 - 7.1, 2048.0 + 1.23])
    origin = np.array([512_000.0, -499_712.0, 2048.0])
    assert np.all(origin % 1024 == 0)
    detail = build_scenes.box((0, 0, 0), (1e-3, 2e-3, 3e-3))
    snapshot = placed([transform(np.eye(3), place)], (detail,), origin=origin)
    soup = flatten(snapshot)
    positions = snapshot.geometry.positions.reshape(-1, 3, 3).astype(np.float64)
    truth = positions + (place - origin)
    step = np.spacing(np.abs(truth).astype(np.float32)).astype(np.float64)
    assert (np.abs(soup.corners - truth) <= 0.5 * step).all()
    single = positions.astype(np.float32) + place.astype(np.float32) - origin.astype(np.float32)
    assert np.abs(single - truth).max() > 100 * step.max()


def test_many_instances_of_several_meshes_come_in_order_each_with_all_its_triangles():
    rng = np.random.default_rng(2)
    meshes = (BOX, build_scenes.plane(1.0), build_scenes.box((0, 0, 0), (1, 1, 1))[:5])
    count = 3000
    which = rng.integers(0, 3, count)
    transforms = np.concatenate([rng.normal(size=(count, 3, 3)), rng.uniform(-50, 50, (count, 3, 1))], axis=2)
    soup = flatten(placed(transforms, meshes, which))
    sizes = np.array([len(mesh) for mesh in meshes])
    assert np.array_equal(np.bincount(soup.instance, minlength=count), sizes[which])
    assert (np.diff(soup.instance) >= 0).all()
    first = np.concatenate([[0], np.cumsum(sizes)])[which]
    within = np.arange(len(soup.source)) - np.repeat(np.cumsum(sizes[which]) - sizes[which], sizes[which])
    assert np.array_equal(soup.source, first[soup.instance] + within)
    boxes = np.flatnonzero(which == 0)[:20]
    for row in boxes:
        linear = transforms[row, :, :3]
        assert signed_volume(soup.corners[soup.instance == row] - transforms[row, :, 3]) == pytest.approx(
            abs(np.linalg.det(linear)) * BOX_VOLUME, rel=1e-3, abs=1e-3
        )


def test_instances_of_a_mesh_without_triangles_add_nothing():
    base = placed([transform(np.eye(3)), transform(np.eye(3), (5, 0, 0)), transform(np.eye(3), (9, 0, 0))])
    geometry: Geometry = dataclasses.replace(
        base.geometry,
        mesh_first_triangle=np.array([0, 0, 12], np.int64),
        instance_mesh=np.array([0, 1, 0], np.int32),
    )
    soup = flatten(dataclasses.replace(base, geometry=geometry))
    assert len(soup.source) == 12
    assert np.all(soup.instance == 1)


def test_flattening_twice_gives_the_same_triangles_and_bounds_hold_them():
    snapshot = placed([transform(linear, (1, 2, 3)) for linear in MIRRORS.values()])
    one, two = flatten(snapshot), flatten(snapshot)
    assert np.array_equal(one.corners, two.corners)
    assert np.array_equal(one.bounds, [one.corners.min(axis=(0, 1)), one.corners.max(axis=(0, 1))])


def test_a_scene_without_triangles_is_refused_with_a_remedy():
    with pytest.raises(SnapshotError, match=r"no triangles.*add a mesh"):
        prepare(build_scenes.snapshot([]), Model())
