# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects by strokes in a real window: a capture without masks is trained, marked, undone and separated."""

import shutil
import time

import numpy as np
import pytest

from backend.capture import load_capture
from backend.labels import vote

from .test_splat_edits import trace
from .test_workflow import IDLE, capture, import_capture, next_step, script, wait  # noqa: F401

pytestmark = pytest.mark.slow

MARKING = """
from bl_ext.user_default.objectgs.objectgs_addon.running import pointing
from bl_ext.user_default.objectgs.objectgs_addon.picking import marks
"""
VASE, MONKEY, TABLE = 8, 6, 9
"""IDs in the demo capture."""
TOOL = "bpy.context.workspace.tools.from_space_view3d_mode('OBJECT', create=False).idname"


@pytest.fixture(scope="module")
def centers(capture, tmp_path_factory):  # noqa: F811
    """The centers of the demo's objects in the capture, from the masks that Blender does not get."""
    labeled = load_capture(capture, tmp_path_factory.mktemp("cache"))
    ids, xyz = vote(labeled).ids, labeled.points.xyz
    return {object_id: np.median(xyz[ids == object_id], 0) for object_id in (VASE, MONKEY, TABLE)}


@pytest.fixture(scope="module")
def imported(blender, capture):  # noqa: F811
    """Blender with the capture without its masks, seen through its first camera."""
    unlabeled, folder = blender.folder / "unlabeled", blender.folder / "unlabeled-splats"
    shutil.copytree(capture, unlabeled, ignore=shutil.ignore_patterns("masks", "labels.json", "truth"))
    import_capture(blender, unlabeled, folder)
    return blender


@pytest.fixture(scope="module")
def window(imported):
    """The same, with a short training."""
    imported.run(
        script("""
        root.objectgs.length, root.objectgs.minutes = "minutes", 0.2
        call(bpy.ops.objectgs.train)
    """)
    )
    wait(imported, f"scene.object_collections(root) and {IDLE}", 240)
    return imported


def asked(window, expression: str):
    return window.run(script(MARKING + f"result = {expression}"))


def settled(window) -> dict[int, int]:
    """Return the number of splats of each marked object, when the strokes are answered.

    The first answer waits for kernels, which are compiled for each place of the extension; users get them by set-up.
    """
    deadline = time.monotonic() + 480
    while asked(window, "pointing.state() != (1.0, False)"):
        assert time.monotonic() < deadline, "the strokes are not answered"
        time.sleep(0.3)
    objects, counts = asked(
        window,
        "[pointing._session.objects.tolist(), __import__('numpy').bincount(pointing._session.classes, "
        "minlength=len(pointing._session.objects)).tolist()]",
    )
    return dict(zip(objects, counts, strict=True))


def at(window, center) -> tuple[float, float]:
    """Return the pixel of the screen, from the upper left, of a place in the capture."""
    return tuple(
        window.run(
            script(f"""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        context = window_context()
        place = scene.capture_to_world(root) @ [*{list(map(float, center))}, 1.0]
        x, y = location_3d_to_region_2d(context["region"], context["area"].spaces.active.region_3d, place[:3])
        result = [context["region"].x + x, context["window"].height - context["region"].y - y]
    """)
        )
    )


def draw_over(window, center) -> None:
    x, y = at(window, center)
    trace(window, [(x - 8, y), (x + 8, y)])


def test_points_are_marked_before_the_training(imported, centers):
    """The strokes are kept for after it."""
    assert next_step(imported) == "objectgs.train"
    imported.run(script("result = call(bpy.ops.objectgs.start_marking)"))
    points = settled(imported)[0]
    draw_over(imported, centers[VASE])
    found = settled(imported)
    assert found[1] > 10 and sum(found.values()) == points
    imported.shot("marked-points")
    assert not asked(imported, "bpy.ops.objectgs.separate_marked.poll()")
    imported.run(script("call(bpy.ops.objectgs.clear_marks); call(bpy.ops.objectgs.stop_marking)"))
    assert not asked(imported, "pointing.is_active(root)")


def test_marking_is_the_step_after_a_training_without_masks(window):
    assert next_step(window) == "objectgs.start_marking"
    window.run(script("result = call(bpy.ops.objectgs.start_marking)"))
    assert settled(window) == {0: asked(window, "len(pointing._session.keys)")}
    assert asked(window, TOOL) == "objectgs.mark"
    assert asked(window, "[item.name for item in root.objectgs.marked]") == ["Object 1"]


def test_suggested_objects_are_shown_and_merged(window):
    window.run(script("result = call(bpy.ops.objectgs.suggest_objects)"))
    wait(window, "len(root.objectgs.marked) > 4", 120)
    found = settled(window)
    shown = [number for object_id, number in found.items() if object_id]
    assert len(shown) == asked(window, "len(root.objectgs.marked)") and min(shown) > 0
    window.shot("suggested")
    count = len(shown)
    window.run(
        script("""
        root.objectgs.active_marked = 0
        with bpy.context.temp_override(**window_context()):
            result = list(bpy.ops.objectgs.merge_marked("EXEC_DEFAULT", True, into="1"))
    """)
    )
    assert len([i for i in settled(window) if i]) == count - 1
    window.run(script("result = call(bpy.ops.objectgs.clear_marks)"))
    window.run(script("result = call(bpy.ops.objectgs.add_marked_object)"))
    assert asked(window, "[item.name for item in root.objectgs.marked]") == ["Object 1"]


def test_strokes_show_objects_at_once_and_are_undone(window, centers):
    draw_over(window, centers[VASE])
    first = settled(window)
    assert first[1] > 20
    window.key("Tab")
    assert asked(window, "[item.name for item in root.objectgs.marked]") == ["Object 1", "Object 2"]
    assert asked(window, "bpy.context.mode") == "OBJECT"
    draw_over(window, centers[MONKEY])
    both = settled(window)
    assert both[1] > 20 and both[2] > 20
    window.hold("ctrl")
    draw_over(window, centers[TABLE])
    window.release("ctrl")
    settled(window)
    assert asked(window, "[stroke['object'] for stroke in marks.strokes_of(root)]") == [1, 2, 0]
    window.shot("marking")
    window.key("ctrl+z")
    wait(window, "len(__import__('json').loads(root.objectgs.strokes)) == 2")
    window.key("ctrl+shift+z")
    wait(window, "len(__import__('json').loads(root.objectgs.strokes)) == 3")


def test_strokes_on_nothing_are_removed(window):
    """Behind the scene, nothing was reconstructed; the other strokes stay."""
    far = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -1e6], [0, 0, 0, 1]]
    asked(
        window,
        "marks.add_stroke(root, 1, marks.View("
        f"__import__('numpy').array({far}), 500.0, 500.0, 100.0, 100.0, 200, 200), [(100, 100)], False)",
    )
    settled(window)
    wait(window, "len(__import__('json').loads(root.objectgs.strokes)) == 3")


def test_marked_objects_get_collections_of_their_own(window, centers):
    window.run(script("root.objectgs.marked[0].name = 'Vase'; call(bpy.ops.objectgs.separate_marked)"))
    wait(window, f"len(root.objectgs.objects) == 2 and {IDLE}", 240)
    names = window.run(script("result = [[item.name, item.splats] for item in root.objectgs.objects]"))
    assert [name for name, _ in names] == ["Vase", "Object 2"] and all(splats > 20 for _, splats in names)
    assert asked(window, TOOL) == "builtin.select_box", "a click selects an object now, and draws no stroke"
    assert not asked(window, "pointing.is_active(root)")
    collections = window.run(script("result = sorted(scene.object_collections(root))"))
    assert {1, 2} <= set(collections)
    window.shot("marked-and-separated")
    # The strokes are kept, and further ones correct the result.
    window.run(script("result = call(bpy.ops.objectgs.start_marking)"))
    assert settled(window)[1] > 20
    window.run(script("result = call(bpy.ops.objectgs.stop_marking)"))
    assert not asked(window, "pointing.is_active(root)")


def test_objects_without_strokes_are_asked_about(window):
    """A separation keeps only what is marked; it names the others, and Escape leaves all as it is."""
    ask = script("""
        with bpy.context.temp_override(**window_context()):
            result = list(bpy.ops.objectgs.separate_marked("INVOKE_DEFAULT"))
    """)
    window.run(script("root.objectgs.active_marked = 0; call(bpy.ops.objectgs.remove_marked_object)"))
    assert asked(window, "marks.names_without_strokes(root)") == ["Vase"]
    for key, names in (("Escape", ["Vase", "Object 2"]), ("Return", ["Object 2"])):
        # The question appears where the mouse is, and only after the splats were drawn anew.
        window.move(600, 450)
        assert window.run(ask) != ["FINISHED"]
        time.sleep(4)
        window.shot(f"objects-without-strokes-{key}")
        window.key(key)
        wait(window, f"[item.name for item in root.objectgs.objects] == {names} and {IDLE}", 240)
    meshes = "[mesh.name for mesh in bpy.data.meshes if mesh.name.startswith('Vase') and mesh.users]"
    assert not asked(window, meshes)


def test_splats_of_another_program_are_marked(window, centers):
    """A file of splats, without a capture: one stroke, and the object has a collection of its own."""
    file, folder = window.folder / "unlabeled-splats" / "splats.ply", window.folder / "foreign-splats"
    window.run(
        script(f"""
        for layer in bpy.context.view_layer.layer_collection.children:
            layer.exclude = True
        paths = {{"filepath": {str(file)!r}, "folder": {str(folder)!r}}}
        with bpy.context.temp_override(**window_context()):
            result = list(bpy.ops.objectgs.import_splats("EXEC_DEFAULT", **paths))
    """)
    )
    wait(window, f"scene.folder_of(root).name == 'foreign-splats' and {IDLE}")
    window.run(
        script("""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.view3d.view_axis(type="FRONT")
            bpy.ops.view3d.view_all()
    """)
    )
    # The objects of the file are those that were marked in it.
    window.run(script("root.objectgs.objects.clear()"))
    assert next_step(window) == "objectgs.start_marking"
    window.run(script("result = call(bpy.ops.objectgs.start_marking)"))
    assert list(settled(window)) == [0]
    draw_over(window, centers[VASE])
    assert settled(window)[1] > 20
    window.shot("marked-in-foreign-splats")
    window.run(script("root.objectgs.marked[0].name = 'Vase'; call(bpy.ops.objectgs.separate_marked)"))
    wait(window, f"[item.name for item in root.objectgs.objects] == ['Vase'] and {IDLE}", 120)
    assert window.run(script("result = root.objectgs.objects[0].splats")) > 20
    assert not (folder / "checkpoint").exists()
    window.shot("separated-in-foreign-splats")
