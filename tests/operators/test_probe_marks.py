"""Objects that stand for reflection probes: what counts as pinned, moved and deleted, and what a new bake does."""

from __future__ import annotations

import time

import numpy as np
import pytest

PLACES = np.array([[0.0, 0, 2], [4, 0, 2], [0, 8, 2], [0, 0, 30]])
REACHES = [2.0, 2.0, 4.0, 14.0]


@pytest.fixture
def settings(studio):
    """Scenes and objects with their settings, and something to bake."""
    from gi_volumes.operators import properties

    for group in properties.CLASSES:
        studio.bpy.utils.register_class(group)
    properties.attach()
    studio.place(studio.cube(), "cube")
    yield studio.scene.gi_volumes
    properties.detach()
    for group in reversed(properties.CLASSES):
        studio.bpy.utils.unregister_class(group)


@pytest.fixture
def marks(settings):
    from gi_volumes.operators import probe_marks

    return probe_marks


@pytest.fixture
def show(studio, settings):
    """Show a bake's probes; returns their objects in the order of the bake."""
    from gi_volumes.operators import baked_probes, probe_marks, probe_objects

    def run(places=PLACES, pinned=(), made="one"):
        places = np.asarray(places, float).reshape(-1, 3)
        reach = baked_probes.reaches(places, 4.0)
        is_pinned = np.isin(np.arange(len(places)), pinned)
        probe_objects.show(studio.scene, baked_probes.Baked(places, reach, is_pinned, made, 1, 1))
        return probe_marks.probes_of(studio.scene)

    return run


def test_each_probe_is_a_sphere_in_a_collection_of_their_own(studio, show):
    found = show()
    assert [object.empty_display_type for object in found] == ["SPHERE"] * 4
    assert np.array([object.location for object in found]) == pytest.approx(PLACES)
    assert [object.empty_display_size for object in found] == pytest.approx(np.array(REACHES) / 4)
    assert {object.users_collection[0].name for object in found} == {"GI Probes"}
    assert [c.name for c in studio.scene.collection.children] == ["GI Probes"]


def test_probes_that_nobody_touched_say_nothing_and_are_no_geometry(show, extract):
    from gi_volumes.bake import snapshot_file

    without = extract()
    show()
    found = extract()
    assert (found.probes.pinned.shape, found.probes.deleted.shape) == ((0, 3), (0, 2, 3))
    assert snapshot_file.digest(found) == snapshot_file.digest(without)
    assert found.notes == without.notes


def test_a_mesh_that_stands_for_a_probe_is_not_baked(studio, show, extract):
    ball = studio.place(studio.mesh(), "ball", (1, 2, 3))
    triangles = len(extract().geometry.instance_mesh)
    ball.gi_volumes.role = "PROBE"
    found = extract()
    assert len(found.geometry.instance_mesh) == triangles - 1
    assert found.probes.pinned == pytest.approx(np.array([[1, 2, 3]]))


def test_moved_duplicated_and_pinned_probes_are_pinned_once(studio, show, extract):
    probes = show()
    probes[0].location.x += 1
    probes[1].gi_volumes.pinned = True
    for place in ((0, 5, 2), (0, 5, 2), probes[2].location):
        copy = probes[2].copy()
        copy.location = place
        studio.scene.collection.objects.link(copy)
    assert [object.gi_volumes.pinned for object in probes] == [True, True, False, False]
    found = extract().probes
    assert found.pinned == pytest.approx(np.array([[0, 5, 2], [1, 0, 2], [4, 0, 2]]))
    assert len(found.deleted) == 0


def test_a_deleted_probe_leaves_a_box_that_reaches_half_of_the_way_to_the_next(studio, show, extract):
    studio.bpy.data.objects.remove(show()[2])
    found = extract().probes
    assert found.deleted == pytest.approx(np.array([[[-4, 4, -2], [4, 12, 6]]]))
    assert len(found.pinned) == 0


@pytest.mark.parametrize("way", ["hide_viewport", "hide_render", "hide_set", "exclude"])
def test_a_hidden_probe_is_neither_moved_nor_deleted_also_in_a_file_that_was_just_opened(
    studio, show, extract, tmp_path, way
):
    bpy, probes = studio.bpy, show()
    probes[1].location.x += 1
    for object in probes[:2]:
        if way == "exclude":
            bpy.context.view_layer.layer_collection.children["GI Probes"].exclude = True
        elif way == "hide_set":
            object.hide_set(True)
        else:
            setattr(object, way, True)
    for _ in range(2):
        found = extract().probes
        assert found.pinned == pytest.approx(np.array([[5, 0, 2]]))
        assert len(found.deleted) == 0
        again = [object for object in studio.scene.objects if object.gi_volumes.role == "PROBE"]
        assert sorted(object.gi_volumes.pinned for object in again) == [False, False, False, True]
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))


def test_a_probe_that_gets_a_parent_stays_and_moves_with_it(studio, show, extract):
    probe = show()[0]
    parent = studio.place(None, "parent", (1234.5, 3, 3), rotation=(0.3, 0.2, 0.1))
    studio.bpy.context.view_layer.update()
    probe.parent, probe.matrix_parent_inverse = parent, parent.matrix_world.inverted()
    assert len(extract().probes.pinned) == 0
    assert not probe.gi_volumes.pinned
    parent.location.z += 1
    studio.bpy.context.view_layer.update()
    assert extract().probes.pinned == pytest.approx(PLACES[:1] + np.array([0, 0, 1]), abs=1e-3)


def test_an_animated_probe_counts_where_it_is_now(studio, show, extract):
    probe = show()[0]
    for frame, height in ((1, 2.0), (11, 12.0)):
        probe.location.z = height
        probe.keyframe_insert("location", frame=frame)
    studio.scene.frame_set(11)
    assert extract().probes.pinned == pytest.approx(np.array([[0, 0, 12]]))
    studio.scene.frame_set(1)
    assert len(extract().probes.pinned) == 0


def test_a_probe_with_a_constraint_counts_where_that_puts_it(studio, show, extract):
    probe = show()[0]
    constraint = probe.constraints.new("COPY_LOCATION")
    constraint.target = studio.place(None, "target", (7, 7, 7))
    studio.bpy.context.view_layer.update()
    assert probe.gi_volumes.pinned
    assert extract().probes.pinned == pytest.approx(np.array([[7, 7, 7]]))


@pytest.mark.parametrize("way", ["hide_viewport", "hide_render", "hide_set", "exclude"])
def test_a_hidden_probe_with_a_constraint_counts_where_the_panel_says(studio, show, marks, extract, way):
    probe, layer = show()[0], studio.bpy.context.view_layer
    probe.constraints.new("COPY_LOCATION").target = studio.place(None, "target", (7, 7, 7))
    layer.update()
    if way == "exclude":
        layer.layer_collection.children["GI Probes"].exclude = True
    elif way == "hide_set":
        probe.hide_set(True)
    else:
        setattr(probe, way, True)
    assert probe.gi_volumes.pinned
    assert marks.place_of(probe) == pytest.approx(np.array([7, 7, 7]))
    assert extract().probes.pinned == pytest.approx(np.array([[7, 7, 7]]))


def test_a_constraint_that_blender_never_evaluates_pins_a_probe_by_its_own_location(studio, show, extract, tmp_path):
    bpy, probe = studio.bpy, show()[0]
    probe.constraints.new("COPY_LOCATION").target = studio.place(None, "target", (7, 7, 7))
    bpy.context.view_layer.layer_collection.children["GI Probes"].exclude = True
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert bpy.data.objects["GI Probe"].gi_volumes.pinned
    assert extract().probes.pinned == pytest.approx(PLACES[:1])


@pytest.mark.parametrize("place", [(0, 0, 0), (9, 9, 9)])
def test_an_object_that_a_script_makes_a_probe_is_the_artists_wherever_it_is(studio, show, extract, place):
    show()
    own = studio.place(None, "own", place)
    own.gi_volumes.role = "PROBE"
    for made in (None, "one", "two"):
        if made:
            show(made=made)
        assert own.gi_volumes.pinned
        assert extract().probes.pinned == pytest.approx(np.array([place]))
        assert len(extract().probes.deleted) == 0
    studio.bpy.data.objects.remove(own)
    assert extract().probes.deleted.mean(axis=1) == pytest.approx(np.array([place]))


def test_an_object_that_a_script_made_a_probe_is_released_where_it_is(studio, show, extract):
    show()
    own = studio.place(None, "own", (9, 9, 9))
    own.gi_volumes.role = "PROBE"
    own.gi_volumes.pinned = False
    assert tuple(own.location) == (9, 9, 9)
    assert not own.gi_volumes.pinned
    assert len(show()) == len(PLACES)
    assert len(extract().probes.deleted) == 0


def test_a_probe_that_the_bake_put_at_the_origin_is_the_bakes_in_a_file_too(studio, show, extract, tmp_path):
    bpy = studio.bpy
    show([[0, 0, 0], [2, 0, 0]])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert len(extract().probes.pinned) == 0


def test_instances_of_a_collection_pin_a_probe_each(studio, show, extract):
    bpy = studio.bpy
    show()
    room = bpy.data.collections.new("room")
    probe = bpy.data.objects.new("in the room", None)
    probe.location, probe.gi_volumes.role, probe.gi_volumes.kept = (1, 0, 1), "PROBE", True
    room.objects.link(probe)
    for x in (10, 20):
        instance = studio.place(None, "instance", (x, 0, 0))
        instance.instance_type, instance.instance_collection = "COLLECTION", room
    assert extract().probes.pinned == pytest.approx(np.array([[11, 0, 1], [21, 0, 1]]))


def test_a_probe_without_a_place_is_named(studio, show, extract):
    from gi_volumes.bake.snapshot import SnapshotError

    show()[1].location.x = float("nan")
    with pytest.raises(SnapshotError, match=r"reflection probe 'GI Probe.001' has an invalid transform"):
        extract()


def test_putting_all_probes_away_deletes_none(studio, show, extract):
    studio.bpy.data.batch_remove(show())
    assert len(extract().probes.deleted) == 0
    assert len(show()) == 4


def test_a_new_bake_moves_what_is_its_own_and_leaves_the_artists_probes(studio, show, extract):
    probes = show()
    probes[0].location.x += 1
    probes[0].name = "mine"
    studio.bpy.data.objects.remove(probes[2])
    fresh = [[1, 0, 2], [4, 0, 2], [7, 0, 9]]
    found = show(fresh, pinned=[0], made="two")
    assert [tuple(object.location) for object in found] == [(1, 0, 2), (4, 0, 2), (7, 0, 9)]
    assert (found[0].name, found[1]) == ("mine", probes[1])
    said = extract().probes
    assert said.pinned == pytest.approx(np.array([[1, 0, 2]]))
    assert len(said.deleted) == 1
    assert np.array([object.location for object in show([*fresh, PLACES[0]], [0], "three")])[-1].tolist() == [0, 0, 2]


def test_showing_the_same_bake_again_changes_nothing(studio, show, extract):
    probes = show()
    probes[0].location.x += 1
    studio.bpy.data.objects.remove(probes[2])
    before, said = [(o.name, tuple(o.location)) for o in studio.scene.objects], extract().probes
    for _ in range(2):
        show()
        again = extract().probes
        assert [(o.name, tuple(o.location)) for o in studio.scene.objects] == before
        assert (again.pinned.tolist(), again.deleted.tolist()) == (said.pinned.tolist(), said.deleted.tolist())


def test_a_pinned_probe_that_is_deleted_keeps_others_away_once_it_was_shown(studio, show, extract):
    from gi_volumes.operators import probe_objects

    added = [probe_objects.add(studio.scene, place, 1.0) for place in ((9, 9, 9), (7, 7, 7))]
    for object in added:
        object.gi_volumes.kept = True
    studio.bpy.data.objects.remove(added[1])
    assert len(extract().probes.deleted) == 0
    show()
    studio.bpy.data.objects.remove(added[0])
    assert extract().probes.deleted == pytest.approx(np.array([[[8, 8, 8], [10, 10, 10]]]))
    assert len(extract().probes.pinned) == 0


def test_pinned_probes_of_a_bake_are_shown_in_a_file_that_has_none(show, extract):
    assert [object.gi_volumes.pinned for object in show(pinned=[3])] == [False, False, False, True]
    assert extract().probes.pinned == pytest.approx(PLACES[3:])


def test_deleted_places_can_be_allowed_again(studio, marks, show, extract):
    from gi_volumes.operators import probe_objects

    probes = show()
    studio.bpy.data.objects.remove(probes[2])
    show()
    studio.bpy.data.objects.remove(probes[3])
    assert len(extract().probes.deleted) == len(marks.deleted(studio.scene, probes[:2])) == 2
    assert probe_objects.forget_deleted(studio.scene) == 2
    assert len(extract().probes.deleted) == 0
    assert len(show()) == 4


def test_a_released_probe_goes_back_to_where_the_bake_had_put_it(show, extract):
    probe = show()[1]
    probe.location.x += 1
    probe.gi_volumes.pinned = False
    assert probe.location.x == 4
    assert len(extract().probes.pinned) == 0


def test_rounding_far_from_the_origin_moves_nothing(show, extract):
    probes = show(PLACES + np.array([123456.789, -98765.4321, 0.1]))
    found = extract().probes
    assert (len(probes), len(found.pinned), len(found.deleted)) == (4, 0, 0)


def test_a_thousand_probes_are_shown_within_two_seconds(show):
    places = np.random.default_rng(1).uniform(-50, 50, (1000, 3))
    start = time.perf_counter()
    assert len(show(places)) == 1000
    assert len(show(places[:500], made="two")) == 500
    assert time.perf_counter() - start < 2


def test_coincident_probes_do_not_count_for_each_others_reach():
    from gi_volumes.operators.baked_probes import reaches

    assert reaches(np.zeros((0, 3)), 4.0).shape == (0,)
    assert reaches(np.zeros((2, 3)), 4.0).tolist() == [4, 4]
    rng = np.random.default_rng(2)
    places = rng.normal(size=(1500, 3))
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(1500, np.inf))
    assert reaches(places, 4.0) == pytest.approx(apart.min(axis=1) / 2)
