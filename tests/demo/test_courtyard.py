"""The demo scene holds what it promises."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="the demo is built in Blender")

from gi_volumes.demo import courtyard, shapes  # noqa: E402

MOST_TRIANGLES = 60_000
SIZE = (34.0, 30.0, 8.5)


@pytest.fixture(scope="module")
def scene():
    """The built scene."""
    courtyard.build()
    return bpy.context.scene


def evaluated_meshes(instances: bool = True) -> list[tuple[str, np.ndarray, bool]]:
    """Name, world-space triangles (t, 3, 3), and whether the transform mirrors, of every mesh that renders."""
    found = []
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        if instance.object.type != "MESH" or (instance.is_instance and not instances):
            continue
        mesh = instance.object.data
        mesh.calc_loop_triangles()
        corners = np.empty((len(mesh.loop_triangles), 3), np.int32)
        mesh.loop_triangles.foreach_get("vertices", corners.ravel())
        vertices = np.empty((len(mesh.vertices), 3), np.float32)
        mesh.vertices.foreach_get("co", vertices.ravel())
        matrix = np.array(instance.matrix_world)
        world = vertices.astype(float) @ matrix[:3, :3].T + matrix[:3, 3]
        found.append((instance.object.name, world[corners], np.linalg.det(matrix[:3, :3]) < 0))
    return found


def open_edges(triangles: np.ndarray) -> int:
    """Directed edges without their opposite, after joining equal corners."""
    rows = np.unique(triangles.reshape(-1, 3).round(5), axis=0, return_inverse=True)[1].reshape(-1, 3)
    edges = Counter(map(tuple, np.concatenate([rows[:, [0, 1]], rows[:, [1, 2]], rows[:, [2, 0]]]).tolist()))
    return sum(count != edges[end, start] for (start, end), count in edges.items())


def test_every_solid_is_closed_and_faces_outwards(scene):
    solids = [(name, triangles, mirrored) for name, triangles, mirrored in evaluated_meshes() if "crown" not in name]
    assert len(solids) > 60
    for name, triangles, mirrored in solids:
        assert open_edges(triangles) == 0, name
        assert shapes.signed_volume(triangles) * (-1 if mirrored else 1) > 0, name


def test_a_solid_turned_inside_out_or_left_open_is_noticed():
    solid = shapes.slab((0, 0, 0), (1, 1, 1))
    triangles = np.array([solid.vertices[face[list(turn)]] for face in solid.faces for turn in ((0, 1, 2), (0, 2, 3))])
    assert (open_edges(triangles), shapes.signed_volume(triangles)) == (0, pytest.approx(1.0))
    assert shapes.signed_volume(triangles[:, ::-1]) < 0
    assert open_edges(triangles[1:]) == 3


def test_walls_with_openings_and_arches_have_the_volume_that_is_left():
    solids = {
        6.5 * 0.2: shapes.wall(3.0, 3.0, 0.2, [(1.0, 2.0, 0.0, 2.0), (2.2, 2.7, 1.0, 2.0)]),
        20 * 0.5: shapes.slab((-3, -2, 0), (3, 2, 0.5), [(-1, 1, -1, 1)]),
        (12 - 1.5 * np.pi * 0.8**2) * 0.4: shapes.arcade(6.0, 3, 0.8, 2.0, 0.4, segments=256),
        2 * np.pi: shapes.turned([(1, 0), (1, 2)], 1024),
    }
    for volume, solid in solids.items():
        fans = [(face[0], face[k], face[k + 1]) for face in solid.faces for k in range(1, len(face) - 1)]
        assert shapes.signed_volume(solid.vertices[np.array(fans)]) == pytest.approx(volume, rel=1e-4)


def test_the_scene_is_as_large_as_promised_and_no_larger(scene):
    triangles = np.concatenate([triangles for _, triangles, _ in evaluated_meshes()])
    assert 5_000 < len(triangles) < MOST_TRIANGLES
    size = np.ptp(triangles.reshape(-1, 3), axis=0)
    assert (size <= SIZE).all()
    assert (size > (24, 20, 7)).all()


def test_it_has_every_kind_of_light(scene):
    assert Counter(light.type for light in bpy.data.lights) == {"SUN": 1, "POINT": 1, "SPOT": 1}
    assert 3.0 <= next(light.energy for light in bpy.data.lights if light.type == "SUN") <= 5.0
    panel = bpy.data.objects["light panel"].data.materials[0]
    shader = next(node for node in panel.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    assert shader.inputs["Emission Strength"].default_value > 0
    assert any(node.type == "VALTORGB" for node in scene.world.node_tree.nodes)


def test_it_has_instances_a_mirror_image_and_modifiers(scene):
    empties = [thing for thing in scene.objects if thing.instance_type == "COLLECTION"]
    assert len([thing for thing in empties if thing.instance_collection.name == "column"]) == 14
    assert sum(thing.matrix_world.determinant() < 0 for thing in empties) == 1
    kinds = {modifier.type for thing in bpy.data.objects for modifier in thing.modifiers}
    assert kinds == {"ARRAY", "BEVEL"}
    windows = [thing for thing in scene.objects if thing.name.startswith("window")]
    assert len({thing.data for thing in windows}) == 1 < len(windows)


def test_its_images_are_packed_and_the_leaves_are_cut_out(scene):
    assert {image.name for image in bpy.data.images if image.packed_file} == {"tiles", "sprig"}
    pixels = np.array(bpy.data.images["sprig"].pixels).reshape(-1, 4)
    assert set(np.unique(pixels[:, 3])) == {0.0, 1.0}
    shader = next(n for n in bpy.data.materials["leaves"].node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    assert shader.inputs["Alpha"].is_linked


def test_the_active_camera_looks_through_the_arcade(scene):
    assert scene.camera.name == "courtyard"
    assert len([thing for thing in scene.objects if thing.type == "CAMERA"]) >= 3
    eye = scene.camera.location
    forward = -scene.camera.matrix_world.col[2].to_3d()
    hit, where, *_ = scene.ray_cast(bpy.context.evaluated_depsgraph_get(), eye, forward)
    assert hit
    assert (where - eye).length > 8.0


def test_two_builds_are_the_same(scene):
    first = np.concatenate([triangles for _, triangles, _ in evaluated_meshes()])
    courtyard.build()
    second = np.concatenate([triangles for _, triangles, _ in evaluated_meshes()])
    np.testing.assert_array_equal(first, second)
