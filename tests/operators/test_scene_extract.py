"""Geometry, placement, cameras and files: what renders, where it stands, and what is refused."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from gi_volumes.bake.snapshot import SnapshotError

# Triangles with instances, instances, meshes, lamps: the scenes' own README.
SCENES = {
    "sponza": (262267, 1, 1, 0),
    "small_house": (145844, 85, 62, 8),
    "bookstore": (118169, 138, 26, 6),
    "truck_town": (36167, 40, 23, 11),
    "modern_hall": (31077, 32, 32, 0),
    "living_room": (5086, 2, 2, 3),
}
# Zero-area triangles that the README counts; the others have a few as well, of slivers below float precision.
FLAT = {"modern_hall": 2432, "living_room": 3536}


def world_corners(snapshot):
    """(t, 3, 3) corners of all instances relative to the origin, mirrored ones turned round."""
    geometry, found = snapshot.geometry, []
    for mesh, matrix in zip(geometry.instance_mesh, geometry.instance_transform, strict=True):
        first, last = geometry.mesh_first_triangle[mesh : mesh + 2]
        corners = geometry.positions[geometry.triangles[first:last]].astype(np.float64)
        placed = corners @ matrix[:, :3].T + (matrix[:, 3] - snapshot.origin)
        found.append(placed[:, ::-1] if np.linalg.det(matrix[:, :3]) < 0 else placed)
    return np.concatenate(found)


def signed_volume(corners):
    """Positive where faces look outwards."""
    return np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6


@pytest.mark.parametrize("name", SCENES)
def test_shared_scene_has_the_counts_of_its_readme(repository, name):
    pytest.importorskip("bpy")
    from gi_volumes.operators import extract

    path = repository.parent / "shared" / "scenes" / f"{name}.glb"
    if not path.exists():
        pytest.skip(f"SCENE NOT FOUND: {path.name} is not beside the repository")
    snapshot = extract.from_file(path)
    geometry = snapshot.geometry
    counts = np.diff(geometry.mesh_first_triangle)[geometry.instance_mesh]
    triangles, instances, meshes, lamps = SCENES[name]
    dropped = triangles - counts.sum()
    assert (len(geometry.instance_mesh), len(np.diff(geometry.mesh_first_triangle))) == (instances, meshes)
    assert len(snapshot.lights.names) == lamps
    assert FLAT.get(name, 0) <= dropped <= FLAT.get(name, 0) + 0.005 * triangles
    assert np.isfinite(geometry.positions).all()
    np.testing.assert_allclose(np.linalg.norm(geometry.corner_normals, axis=2), 1, atol=1e-5)
    assert geometry.materials.max() < len(snapshot.materials)


def test_modifiers_curves_text_and_metaballs_become_triangles(studio, extract):
    bpy = studio.bpy
    subdivided = studio.place(studio.cube(), "subdivided")
    modifier = subdivided.modifiers.new("s", "SUBSURF")
    modifier.levels, modifier.render_levels = 0, 2
    curve = bpy.data.curves.new("curve", "CURVE")
    curve.bevel_depth = 0.1
    curve.splines.new("POLY").points.add(2)
    for index, point in enumerate(curve.splines[0].points):
        point.co = (index, index, 0, 1)
    studio.place(curve, "tube")
    text = bpy.data.curves.new("text", "FONT")
    text.body = "GI"
    studio.place(text, "text")
    studio.place(bpy.data.metaballs.new("ball"), "ball").data.elements.new()
    snapshot = extract()
    counts = np.diff(snapshot.geometry.mesh_first_triangle)
    found = {
        name: counts[mesh]
        for name, mesh in zip(snapshot.geometry.instance_names, snapshot.geometry.instance_mesh, strict=True)
    }
    assert set(found) == {"subdivided", "tube", "text", "ball"}
    assert found["subdivided"] == 6 * 4**2 * 2, "the render level, not the viewport's"


def test_render_visibility_decides_and_viewport_visibility_does_not(studio, extract):
    studio.place(studio.cube(), "shown")
    studio.place(studio.cube(), "unseen in the viewport").hide_viewport = True
    studio.place(studio.cube(), "hidden in the view layer").hide_set(True)
    studio.place(studio.cube(), "not rendered").hide_render = True
    collection = studio.bpy.data.collections.new("not rendered")
    collection.hide_render = True
    studio.scene.collection.children.link(collection)
    collection.objects.link(studio.bpy.data.objects.new("in a collection", studio.cube()))
    names = extract().geometry.instance_names
    assert set(names) == {"shown", "unseen in the viewport", "hidden in the view layer"}


def test_linked_duplicates_and_collection_instances_share_one_mesh(studio, extract):
    mesh = studio.cube()
    collection = studio.bpy.data.collections.new("pair")
    collection.instance_offset = (0, 0, 1)
    member = studio.bpy.data.objects.new("member", mesh)
    member.location = (1, 0, 0)
    collection.objects.link(member)
    for x in (0, 10):
        placed = studio.place(None, f"pair {x}", (x, 0, 0), rotation=(0, 0, math.pi / 2))
        placed.instance_type, placed.instance_collection = "COLLECTION", collection
    studio.place(mesh, "alone", (0, 20, 0))
    geometry = extract().geometry
    assert len(geometry.positions) == 8
    where = sorted(geometry.instance_transform[:, :, 3].round(6).tolist())
    assert where == [[0, 1, -1], [0, 20, 0], [10, 1, -1]]


def test_object_linked_materials_make_a_mesh_of_their_own(studio, extract):
    mesh = studio.mesh()
    red, blue = studio.material("red"), studio.material("blue")
    mesh.materials.append(red)
    studio.place(mesh, "a")
    other = studio.place(mesh, "b")
    other.material_slots[0].link = "OBJECT"
    other.material_slots[0].material = blue
    snapshot = extract()
    worn = {
        name: snapshot.materials[snapshot.geometry.materials[snapshot.geometry.mesh_first_triangle[mesh]]].name
        for name, mesh in zip(snapshot.geometry.instance_names, snapshot.geometry.instance_mesh, strict=True)
    }
    assert worn == {"a": "red", "b": "blue"}


@pytest.mark.parametrize("scale", [(1, 1, 1), (-1, 1, 1), (2, -3, 0.5), (-1, -1, -1)])
def test_closed_cube_faces_outwards_however_it_is_mirrored(studio, extract, scale):
    studio.place(studio.cube(), "cube", (3, 4, 5), scale, (0.3, 0.2, 0.1))
    snapshot = extract()
    corners = world_corners(snapshot)
    corners -= corners.mean((0, 1))
    assert signed_volume(corners) == pytest.approx(8 * abs(np.prod(scale)), rel=1e-5)


def test_corner_normals_point_out_of_a_sphere(studio, extract):
    studio.bpy.ops.mesh.primitive_uv_sphere_add(radius=2)
    studio.bpy.ops.object.shade_smooth()
    geometry = extract().geometry
    outward = geometry.positions[geometry.triangles] / 2
    np.testing.assert_allclose(geometry.corner_normals, outward, atol=0.02)


def test_scene_500_km_away_keeps_the_detail_of_its_parts(studio, extract):
    """The group stands far away; its parts stand within it, finer than float32 can say from the world's origin."""
    near = studio.place(None, "near")
    for index in range(5):
        studio.place(studio.cube(), f"part {index}", (0.0012345 * index, 1.1 * index, 0), parent=near)
    before = extract()
    near.location = (500 * 1024.0, -500 * 1024.0, 0)
    after = extract()
    np.testing.assert_array_equal(before.origin, [0, 0, 0])
    np.testing.assert_array_equal(after.origin, [500 * 1024, -500 * 1024, 0])
    np.testing.assert_allclose(world_corners(after), world_corners(before), atol=1e-6)


def test_origin_is_the_nearest_multiple_of_1024_m(studio, extract):
    studio.place(studio.cube(), "cube", (1500, -600, 500))
    np.testing.assert_array_equal(extract().origin, [1024, -1024, 0])


def test_constraints_are_followed_though_parents_say_otherwise(studio, extract):
    target = studio.place(None, "target", (7, 8, 9))
    follower = studio.place(studio.cube(), "follower", (1, 1, 1), parent=studio.place(None, "parent"))
    follower.constraints.new("COPY_LOCATION").target = target
    np.testing.assert_allclose(extract().geometry.instance_transform[0, :, 3], [7, 8, 9], atol=1e-6)


def test_triangles_without_area_are_dropped_and_counted(studio, extract):
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (0.5, 0.5, 0)]
    studio.place(studio.mesh("m", corners, [(0, 1, 2), (0, 1, 3), (1, 2, 4)]), "thin")
    snapshot = extract()
    assert len(snapshot.geometry.triangles) == 1
    assert len(snapshot.geometry.positions) == 3
    assert [note.what for note in snapshot.notes if "without area" in note.what] == [
        "triangles without area (2 of the meshes' triangles)"
    ]


def test_vertices_that_are_not_numbers_are_refused_by_object_name(studio, extract):
    studio.place(studio.mesh("m", [(0, 0, 0), (1, 0, float("nan")), (0, 1, 0)]), "torn")
    with pytest.raises(SnapshotError, match="'torn' has 1 vertices that are not numbers: delete them") as caught:
        extract()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lamps", [0, 2])
def test_scene_without_surfaces_is_refused_with_a_remedy(studio, extract, lamps):
    for index in range(lamps):
        studio.lamp("POINT", f"lamp {index}")
    studio.place(studio.mesh("edges", [(0, 0, 0), (1, 0, 0)], []), "edges")
    with pytest.raises(
        SnapshotError, match=f"has {f'{lamps} lamps but ' if lamps else ''}no mesh that renders: add one"
    ):
        extract()


def test_reading_changes_nothing(studio, extract):
    bpy = studio.bpy
    studio.place(studio.cube(), "other")
    studio.lamp("POINT")
    cube = studio.place(studio.cube(), "cube")
    cube.modifiers.new("s", "SUBSURF")
    bpy.context.view_layer.objects.active = cube
    cube.select_set(True)
    bpy.ops.object.mode_set(mode="EDIT")
    studio.scene.frame_set(7)

    def state():
        scene = bpy.context.scene
        selected = sorted(o.name for o in scene.objects if o.select_get())
        settings = (scene.render.engine, scene.frame_current, scene.render.filepath, scene.camera)
        return studio.counts(), selected, bpy.context.mode, scene.name, bpy.context.view_layer.name, settings

    before = state()
    extract()
    assert state() == before
    bpy.ops.object.mode_set(mode="OBJECT")


def test_reading_that_fails_changes_nothing_either(studio, extract):
    studio.place(studio.mesh("m", [(0, 0, 0), (1, 0, float("inf")), (0, 1, 0)]), "torn")
    before = studio.counts()
    with pytest.raises(SnapshotError):
        extract()
    assert studio.counts() == before
    assert not [name for name in dir(studio.bpy.types) if "reader" in name.lower() and "volumes" in name.lower()]


def test_edits_in_progress_are_read(studio, extract):
    """Edit mode keeps its mesh apart from the object's until it is left."""
    import bmesh

    cube = studio.place(studio.cube(), "cube")
    studio.bpy.context.view_layer.objects.active = cube
    studio.bpy.ops.object.mode_set(mode="EDIT")
    edited = bmesh.from_edit_mesh(cube.data)
    for vertex in edited.verts:
        vertex.co.z += 100
    bmesh.update_edit_mesh(cube.data)
    assert extract().geometry.positions[:, 2].min() == pytest.approx(99)
    studio.bpy.ops.object.mode_set(mode="OBJECT")


def test_graph_of_the_viewport_stands_for_its_scene(studio, extract):
    from gi_volumes.operators import extract as module

    studio.place(studio.cube(), "cube").hide_viewport = True
    snapshot = module.extract(studio.bpy.context.evaluated_depsgraph_get())
    assert snapshot.geometry.instance_names == ("cube",)


def camera_ray(camera, x, y):
    """Direction in camera space of a point of the picture, 0..1 from its lower left, by the record's definition."""
    width, height = camera.resolution
    half = camera.half_width
    shift_x, shift_y = (2 * half * shift for shift in camera.shift)
    return np.array([(2 * x - 1) * half + shift_x, (2 * y - 1) * half * height / width + shift_y, -1.0])


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(320, 180), (180, 320)])
@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_camera_frames_what_blender_frames(studio, extract, fit, size, kind):
    data = studio.bpy.data.cameras.new("camera")
    data.type, data.sensor_fit, data.lens, data.shift_x, data.shift_y = kind, fit, 35.0, 0.1, -0.2
    data.sensor_height, data.ortho_scale = 30.0, 3.0
    studio.scene.camera = studio.place(data, "camera", (1, 2, 3), rotation=(0.5, 0, 0.3))
    studio.scene.render.resolution_x, studio.scene.render.resolution_y = size
    studio.scene.render.resolution_percentage = 100
    studio.wear()
    camera = extract().cameras[0]
    assert camera.orthographic == (kind == "ORTHO")
    assert camera.resolution == size
    corners = [tuple(corner) for corner in data.view_frame(scene=studio.scene)]
    for (x, y), corner in zip([(1, 1), (1, 0), (0, 0), (0, 1)], corners, strict=True):
        expected = np.array(corner)[:2] / (1 if kind == "ORTHO" else -corner[2])
        np.testing.assert_allclose(camera_ray(camera, x, y)[:2], expected, rtol=1e-4, atol=1e-5)
    matrix = np.array(camera.world_from_camera).reshape(3, 4)
    np.testing.assert_allclose(matrix, np.array(studio.scene.camera.matrix_world)[:3], atol=1e-6)


def test_active_camera_comes_first(studio, extract):
    for name in ("b", "a", "c"):
        studio.place(studio.bpy.data.cameras.new(name), name)
    studio.scene.camera = studio.bpy.data.objects["b"]
    studio.wear()
    assert [camera.name for camera in extract().cameras] == ["b", "a", "c"]


PROGRAM = """
import sys
from gi_volumes.operators import extract
from gi_volumes.bake.snapshot import SnapshotError
try:
    print(len(extract.from_file(sys.argv[1]).geometry.triangles))
except SnapshotError as error:
    print(f"refused: {error}")
"""


def run(path):
    """What reading a file prints on standard output."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(path)], capture_output=True, text=True, check=True)
    return done.stdout


def test_blend_and_glb_files_give_the_same_triangles_and_print_nothing_else(studio, tmp_path):
    studio.place(studio.cube(), "cube")
    studio.bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    studio.bpy.ops.export_scene.gltf(filepath=str(tmp_path / "a.glb"))
    assert run(tmp_path / "a.blend") == "12\n"
    assert run(tmp_path / "a.glb") == "12\n"


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("missing.glb", None, "no such file"),
        ("text.blend", b"not a blend file", "cannot read it"),
        ("text.glb", b"not a glb file", "cannot read it"),
        ("text.gltf", b"{", "cannot read it"),
        ("text.obj", b"", "not a scene"),
    ],
)
def test_file_that_cannot_be_read_is_refused_in_one_line(tmp_path, name, content, reason):
    pytest.importorskip("bpy")
    if content is not None:
        (tmp_path / name).write_bytes(content)
    printed = run(tmp_path / name)
    assert printed.startswith("refused: ")
    assert reason in printed
    assert name in printed
    assert printed.count("\n") == 1
