# SPDX-License-Identifier: GPL-3.0-or-later
"""Clear viewports: lines, empties, the order of collections, framing and picking in spite of strays; Clean Floaters."""

import json

import pytest

from backend.editing import apply_edits
from backend.export import read_splats
from backend.shared.reconstruction.objects import read_objects

from .first_show import STRAYS, open_reconstruction, open_startup_scene, script, wait, write_reconstruction
from .harness import PACKAGE

MIDDLE = (500, 450)
"""A position in the viewport, in window pixels."""


@pytest.fixture(scope="module")
def folder(blender, tmp_path_factory):
    return write_reconstruction(tmp_path_factory.mktemp("clutter") / "table")


@pytest.fixture(scope="module")
def window(blender, folder):
    open_startup_scene(blender)
    open_reconstruction(blender, folder)
    return blender


def test_viewport_and_outliner_are_not_cluttered(window):
    lines, collections, sizes = window.run(
        script("""
        spaces = [area.spaces.active for screen in bpy.data.screens for area in screen.areas]
        layers = bpy.context.view_layer.layer_collection.children[root.name].children
        result = [[space.overlay.show_relationship_lines for space in spaces if space.type == "VIEW_3D"],
                  [layer.collection.name for layer in layers],
                  [part.empty_display_size for part in root.all_objects if part.type == "EMPTY"]]
    """)
    )
    assert not any(lines)
    assert collections == ["ball", "square", "table capture"]
    assert max(sizes) < 0.4
    window.shot("clutter-opened")


@pytest.mark.parametrize("is_drawn", [False, True])
def test_framing_ignores_strays(window, is_drawn):
    """Frame Selected on the ball with radius 0.5, and Frame All; strays are up to 100 units away."""
    window.run(
        script(f"""
        owner.objectgs.draw_splats = {is_drawn}
        for obj in bpy.context.selected_objects:
            obj.select_set(False)
        part(1).select_set(True)
    """)
    )
    window.move(*MIDDLE)
    window.key("KP_Decimal")
    wait(window, "view.view_distance < 3")
    window.shot(f"clutter-selected-{'drawn' if is_drawn else 'preview'}")
    window.key("Home")
    wait(window, "view.view_distance > 3")
    assert window.run(script("result = view.view_distance")) < 40
    window.shot(f"clutter-all-{'drawn' if is_drawn else 'preview'}")


def test_box_picking_ignores_strays(window):
    """A box around a stray splat of the ball does not pick the ball."""
    result = window.run(
        script(f"""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        from mathutils import Vector
        hit_test = importlib.import_module("{PACKAGE}.objectgs_addon.picking.hit_test")
        view.view_perspective, view.view_location, view.view_distance = "PERSP", (0, 0, 0), 30.0
        view.view_rotation = Vector((0, -1, 0)).to_track_quat("Z", "Y")
        view.update()
        context = window_context()
        result = []
        for place in ({STRAYS[1].tolist()}, (0.0, -0.5, 0.0)):
            x, y = location_3d_to_region_2d(context["region"], view, Vector(place))
            with bpy.context.temp_override(**context):
                found = hit_test.objects_in(bpy.context, x - 6, y - 6, x + 6, y + 6)
            result.append([hit.name for hit in found])
    """)
    )
    assert "ball" not in result[0] and "ball" in result[1]


def test_box_picking_selects_instances(window):
    """A collection instance, as File > Link adds it, is picked with what it is drawn from, or alone."""
    result = window.run(
        script("""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        from mathutils import Vector
        view.view_perspective, view.view_location, view.view_distance = "PERSP", (0, 0, 0), 30.0
        view.view_rotation = Vector((0, -1, 0)).to_track_quat("Z", "Y")
        empty = bpy.data.objects.new("instance", None)
        empty.instance_type, empty.instance_collection = "COLLECTION", part(1).users_collection[0]
        empty.location = 4, 0, 0
        owner.collection.objects.link(empty)
        bpy.context.view_layer.update()
        view.update()
        context = window_context()
        x, y = location_3d_to_region_2d(context["region"], view, Vector((4, 0, 0)))
        result = []
        for box in ((x - 6, y - 6, x + 6, y + 6), (0, 0, context["region"].width, context["region"].height)):
            left, bottom, right, top = map(int, box)
            with bpy.context.temp_override(**context):
                bpy.ops.objectgs.pick_box(left=left, bottom=bottom, right=right, top=top)
            result.append(sorted(obj.name for obj in bpy.context.selected_objects))
        with bpy.context.temp_override(**context):
            bpy.ops.objectgs.pick_box(mode="SUBTRACT", left=left, bottom=bottom, right=right, top=top)
        result.append([obj.name for obj in bpy.context.selected_objects])
        bpy.data.objects.remove(empty)
    """)
    )
    assert result[0] == ["instance"]
    assert "instance" in result[1] and len(result[1]) > 2
    assert result[2] == []


def test_clean_floaters_changes_exports_and_is_undone(window, folder):
    objects = folder / "objects.json"

    def exported():
        edited = apply_edits(read_splats(folder / "splats.ply")[0], read_objects(objects))
        return edited.means[edited.object_ids == 1]

    window.run(
        script("""
        root.objectgs.active_object = 0
        call(bpy.ops.objectgs.clean_floaters)
    """)
    )
    wait(window, "root.objectgs.objects[0].cleaned")
    assert json.loads(objects.read_text())["edits"]["1"] == {"cleaned": True}
    hidden = script("mask = scene.hidden_splats(part(1).data); result = 0 if mask is None else int(mask.sum())")
    assert window.run(hidden) == len(STRAYS) and abs(exported()).max() < 0.6
    window.shot("clutter-cleaned")
    window.move(*MIDDLE)
    window.key("ctrl+z")
    wait(window, "not root.objectgs.objects[0].cleaned")
    assert window.run(hidden) == 0 and abs(exported()).max() > 70
    window.key("ctrl+shift+z")
    wait(window, "root.objectgs.objects[0].cleaned")
    assert window.run(hidden) == len(STRAYS) and abs(exported()).max() < 0.6
    window.run(script("call(bpy.ops.objectgs.clean_floaters, restore=True)"))
    wait(window, "not root.objectgs.objects[0].cleaned")
    assert window.run(hidden) == 0
