# SPDX-License-Identifier: GPL-3.0-or-later
"""What the viewport's drawing is given: splats as arrays, their order, their places, and carriers without a preview."""

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

from objectgs.backend.recolour import Recolour  # noqa: E402
from objectgs.objectgs_addon import scene, splat_arrays  # noqa: E402
from objectgs.objectgs_addon.drawing import gather  # noqa: E402
from objectgs.objectgs_addon.drawing.order import back_to_front  # noqa: E402
from objectgs.objectgs_addon.scene import carrier  # noqa: E402
from objectgs.objectgs_addon.scene.drawn import show_preview  # noqa: E402

from .building import HUGE, write_folder  # noqa: E402


@pytest.fixture
def root(tmp_path, fresh):
    """Three objects and what belongs to none, in Blender."""
    folder = write_folder(tmp_path / "folder")
    root = scene.show_capture(bpy.context.scene, folder)
    scene.show_result(root, folder, bpy.context.scene)
    bpy.context.view_layer.update()
    splat_arrays.register()
    yield root
    splat_arrays.unregister()


def part(root, object_id: int):
    return next(thing for thing in scene.object_collections(root)[object_id].objects
                if scene.kind_of(thing) == "splats")


def evaluated_size(thing) -> int:
    """How many vertices or points a viewport gets of an object."""
    shape = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if hasattr(shape, "evaluated_geometry"):  # Not in 4.2, whose scripts see no point clouds.
        geometry = shape.evaluated_geometry()
        return sum(0 if block is None else len(block.attributes["position"].data) if "position" in block.attributes
                   else 0 for block in (geometry.mesh, geometry.pointcloud))
    return len(shape.data.vertices)


def test_arrays_are_those_of_the_file_and_are_read_again_when_the_mesh_changes(root):
    thing = part(root, 2)
    arrays = splat_arrays.arrays_of(thing.data)
    assert arrays.means.shape == (10, 3) and arrays.harmonics.shape == (10, 4, 3) and arrays.opacities.shape == (10,)
    assert np.array_equal(arrays.harmonics[:, 2], carrier.read(thing.data, "radiance:sh_2"))
    assert arrays.cloud.count > 0 and splat_arrays.arrays_of(thing.data) is arrays
    thing.data.attributes["radiance:base"].data[3].color = (0.0, 0.0, 0.0, 0.5)
    thing.data.update()
    bpy.context.view_layer.update()
    assert splat_arrays.arrays_of(thing.data).opacities[3] == 0.5
    thing.data.attributes.remove(thing.data.attributes["scale"])
    bpy.context.view_layer.update()
    assert splat_arrays.arrays_of(thing.data) is None


def test_what_is_hidden_is_not_drawn(root):
    layer = bpy.context.view_layer
    ids = lambda: sorted(scene.object_id_of(thing) for thing in gather.splat_parts(layer))  # noqa: E731
    assert ids() == [0, 1, 2, HUGE]
    part(root, 1).hide_set(True)
    next(child for child in layer.layer_collection.children[0].children
         if scene.object_id_of(child.collection) == 2).hide_viewport = True
    assert ids() == [0, HUGE]


def test_places_marks_and_colours_are_those_of_now(root, monkeypatch):
    """Moving, selecting and recolouring need no new arrays."""
    thing = part(root, 1)
    before = gather.gather([thing])[0]
    thing.parent.location.x += 2.0
    thing.select_set(True)
    bpy.context.view_layer.update()
    monkeypatch.setattr(gather.scenes, "recolour_of", lambda _collection: Recolour(value=0.5))
    after = gather.gather([thing], "object")[0]
    assert after.splats is before.splats
    assert np.allclose((after.matrix - before.matrix)[:, 3], (2.0, 0, 0, 0), atol=1e-6)
    assert np.allclose(after.recolour, np.hstack([0.5 * np.eye(3), np.zeros((3, 1))]))
    assert before.highlight == gather.NONE and after.highlight == gather.SELECTED
    assert before.colour == gather.NONE and np.allclose(np.multiply(after.colour, 255), (10, 20, 30, 255), atol=0.1)
    collection = scene.object_collections(root)[1]
    assert gather.gather([thing], pointed_at=collection.session_uid)[0].highlight == gather.POINTED_AT
    assert gather.gather([thing], marks=False)[0].highlight == gather.NONE


def test_a_drawn_carrier_shows_nothing_itself(root):
    """And its preview comes back as the user left it; renders keep theirs."""
    thing = part(root, 1)
    kept = [(modifier.name, modifier.show_viewport, modifier.show_render) for modifier in thing.modifiers]
    seen = evaluated_size(thing)
    show_preview(thing, False)
    show_preview(thing, False)
    bpy.context.view_layer.update()
    assert evaluated_size(thing) == 0
    assert seen > 0 or not hasattr(thing, "evaluated_geometry")
    assert [modifier.show_render for modifier in thing.modifiers] == [False, True, False]
    show_preview(thing, True)
    bpy.context.view_layer.update()
    assert evaluated_size(thing) == seen
    assert [(modifier.name, modifier.show_viewport, modifier.show_render) for modifier in thing.modifiers] == kept


@pytest.mark.parametrize("orthographic", [False, True])
def test_splats_come_from_far_to_near(orthographic):
    depths = np.random.default_rng(0).uniform(-1.0, 50.0, 20_000).astype(np.float32)
    order = back_to_front(depths, -100.0 if orthographic else 0.01, orthographic)
    ahead = depths > (-100.0 if orthographic else 0.01)
    assert sorted(order.tolist()) == np.flatnonzero(ahead).tolist()
    steps = np.diff(depths[order])
    assert (steps <= (0.001 if orthographic else 3e-4 * depths[order][1:])).all()


def test_splats_at_one_depth_keep_their_order():
    assert back_to_front(np.full(5, 2.0, np.float32), 0.1, False).tolist() == [0, 1, 2, 3, 4]
    assert back_to_front(np.full(5, 2.0, np.float32), 0.1, True).tolist() == [0, 1, 2, 3, 4]
    assert len(back_to_front(np.full(5, -2.0, np.float32), 0.1, False)) == 0
