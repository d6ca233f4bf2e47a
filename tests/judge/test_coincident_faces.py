"""Faces in the same place: what Cycles does with them, and that they are found."""

from __future__ import annotations

import math

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="Cycles comes with the bpy wheel")

from gi_volumes.benchmarks import coincident_faces, surface_points  # noqa: E402
from gi_volumes.benchmarks.cycles_judge import Settings, irradiance  # noqa: E402

SUN, ALBEDO = 1.0, 0.75
SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
HALVES = [(0, 1, 2), (0, 2, 3)]
OTHER_HALVES = [(1, 2, 3), (1, 3, 0)]


@pytest.fixture(autouse=True)
def empty_scene():
    """An empty file for every test."""
    bpy.ops.wm.read_homefile(use_empty=True)


def add(corners, faces) -> bpy.types.Object:
    """Link a mesh."""
    mesh = bpy.data.meshes.new("matter")
    mesh.from_pydata([tuple(corner) for corner in corners], [], faces)
    item = bpy.data.objects.new("matter", mesh)
    bpy.context.scene.collection.objects.link(item)
    bpy.context.view_layer.update()
    return item


def add_plane(half: float, faces) -> bpy.types.Object:
    """Link a white diffuse square around the origin."""
    item = add((SQUARE - (0.5, 0.5, 0)) * 2 * half, faces)
    material = bpy.data.materials.get("white") or bpy.data.materials.new("white")
    if material.node_tree is None:
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    shader, output = nodes.new("ShaderNodeBsdfDiffuse"), nodes.new("ShaderNodeOutputMaterial")
    shader.inputs["Color"].default_value = (ALBEDO, ALBEDO, ALBEDO, 1)
    material.node_tree.links.new(shader.outputs[0], output.inputs["Surface"])
    item.data.materials.append(material)
    return item


def bounce() -> float:
    """Irradiance on points that look down at the origin's plane, lit by a sun that shines down."""
    light = bpy.data.lights.new("sun", "SUN")
    light.energy, light.angle = SUN, 0.0
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("sun", light))
    points = np.random.default_rng(0).uniform((-1, -1, 1.5), (1, 1, 3.5), (200, 3))
    normals = np.tile((0.0, 0.0, -1.0), (200, 1))
    return float(irradiance(points, normals, "sun", Settings(samples=32, bounces=1)).mean.mean())


def random_faces(count: int, seed: int) -> np.ndarray:
    """(count, 3, 3) triangles apart from each other, of all tilts."""
    generator = np.random.default_rng(seed)
    return generator.normal(size=(count, 3, 3)) + 10 * np.arange(count)[:, None, None]


def test_one_plane_reflects_in_cycles_what_its_albedo_says():
    add_plane(400.0, HALVES)
    assert bounce() == pytest.approx(ALBEDO * SUN, rel=2e-3)


def test_a_plane_twice_in_the_same_place_loses_light_in_cycles():
    """The reason to remove coincident faces: should Cycles ever handle them, this fails and the removal can go."""
    add_plane(400.0, HALVES)
    add_plane(400.0, HALVES)
    assert bounce() < 0.9 * ALBEDO * SUN


def test_a_plane_twice_reflects_in_cycles_what_one_does_once_coincident_faces_are_removed():
    add_plane(400.0, HALVES)
    add_plane(400.0, OTHER_HALVES)
    assert coincident_faces.remove_coincident() == (2, 0.0)
    assert bounce() == pytest.approx(ALBEDO * SUN, rel=2e-3)


def test_of_duplicates_in_any_winding_and_corner_order_one_stays():
    faces = random_faces(50, seed=1)
    copies = np.concatenate([faces, faces[:, [1, 2, 0]], faces[:, ::-1]])
    gone = coincident_faces.covered(copies, np.zeros(len(copies), bool))
    np.testing.assert_array_equal(gone.reshape(3, 50).sum(axis=0), 2)


def test_what_must_stay_stays_and_its_copies_go():
    faces = np.concatenate([random_faces(20, seed=2)] * 2)
    keep = np.arange(40) >= 20
    np.testing.assert_array_equal(coincident_faces.covered(faces, keep), ~keep)


def test_a_face_that_others_cover_together_goes_and_one_they_cover_in_part_stays():
    big = SQUARE[[HALVES[0], HALVES[1]]] * 4
    small = SQUARE[[HALVES[0]]] + (1.5, 1.5, 0)
    over_the_edge = SQUARE[[HALVES[0]]] + (3.5, 1, 0)
    faces = np.concatenate([big, small, over_the_edge])
    gone = coincident_faces.covered(faces, np.zeros(4, bool))
    np.testing.assert_array_equal(gone, [False, False, True, False])


@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.1])
def test_faces_farther_apart_than_the_reach_or_tilted_stay(tilt):
    turn = np.array([(1, 0, 0), (0, math.cos(tilt), math.sin(tilt)), (0, -math.sin(tilt), math.cos(tilt))])
    near, far, tilted = SQUARE[[HALVES[0]]] + (0, 0, 5e-5), SQUARE[[HALVES[0]]] + (0, 0, 3e-4), SQUARE[[HALVES[0]]]
    tilted = tilted + tilted[..., :1] * (0, 0, 0.01)
    base = SQUARE[[HALVES[0]]]
    for other, goes in ((near, True), (far, False), (tilted, False)):
        faces = np.concatenate([base, other]) @ turn
        assert coincident_faces.covered(faces, np.zeros(2, bool)).any() == goes


def test_faces_are_removed_from_meshes_and_the_others_stay_where_they_were():
    add(SQUARE, HALVES)
    moved = add(SQUARE - (5, 0, 0), [*HALVES, (0, 1, 3)])
    moved.location = (5, 0, 0)
    add(np.add(SQUARE, (0, 0, 2)), HALVES)
    bpy.context.view_layer.update()
    removed, left = coincident_faces.remove_coincident()
    assert (removed, left) == (3, 0.0)
    kept = surface_points.world_triangles()
    assert coincident_faces.covered(kept, np.zeros(len(kept), bool)).sum() == 0
    assert sorted(kept[..., 2].mean(axis=1)) == [0, 0, 2, 2]
    edges = kept[:, 1:] - kept[:, :1]
    assert np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1).sum() / 2 == pytest.approx(2.0)


def test_a_mesh_that_two_objects_share_loses_faces_only_where_they_are_covered():
    first = add(SQUARE, HALVES)
    second = bpy.data.objects.new("again", first.data)
    second.location = (0, 0, 1)
    bpy.context.scene.collection.objects.link(second)
    add(SQUARE * 3 - (1, 1, 0), HALVES)
    bpy.context.view_layer.update()
    assert coincident_faces.remove_coincident()[0] == 2
    assert len(first.data.polygons) == 0
    assert len(second.data.polygons) == 2
