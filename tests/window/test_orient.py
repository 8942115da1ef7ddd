# SPDX-License-Identifier: GPL-3.0-or-later
"""Points picked in a real window, which give a reconstruction its size."""

import time

import numpy as np
import pytest

from .test_workflow import capture, import_capture, script  # noqa: F401

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def imported(blender, capture):  # noqa: F811
    import_capture(blender, capture, blender.folder / "to-scale")
    return blender


def scale_of(window) -> float:
    return window.run(script("result = float(__import__('numpy').linalg.det(scene.capture_to_world(root)))")) ** (1 / 3)


def modal(window) -> list[str]:
    return window.run("result = [each.bl_idname for each in window_context()['window'].modal_operators]")


def registered(window) -> list[str]:
    return window.run("result = [each.bl_idname for each in bpy.context.window_manager.operators]")


def pick_two(window) -> None:
    """Start Set Distance, and click the points that the view shows farthest to the left and right of its middle."""
    window.run(script("result = call(bpy.ops.objectgs.set_distance)"))
    places = window.run(
        script("""
        from bpy_extras.view3d_utils import location_3d_to_region_2d
        context = window_context()
        region = context["region"]
        cloud = next(part for part in root.all_objects if scene.kind_of(part) == "points")
        result = []
        for vertex in list(cloud.data.vertices)[::7]:
            place = location_3d_to_region_2d(
                region, context["area"].spaces.active.region_3d, cloud.matrix_world @ vertex.co)
            if place is not None and 200 < place.x < region.width - 500 and 150 < place.y < region.height - 150:
                result.append([region.x + place.x, context["window"].height - region.y - place.y])
    """)
    )
    across = np.array(places)
    for index in (across[:, 0].argmin(), across[:, 0].argmax()):
        window.click(*across[index])
    time.sleep(1.0)


def test_distance_is_asked_for_after_two_clicks_that_end_the_picking(imported):
    """The clicks that follow are ordinary ones, whether the dialog was confirmed or not."""
    before = scale_of(imported)
    pick_two(imported)
    imported.shot("set-distance")
    imported.key("Escape")
    assert modal(imported) == [] and scale_of(imported) == pytest.approx(before)
    assert "OBJECTGS_OT_set_distance" not in registered(imported)
    pick_two(imported)
    imported.move(700, 500)
    imported.key("Return")
    assert modal(imported) == [] and registered(imported)[-1] == "OBJECTGS_OT_set_distance"
    assert scale_of(imported) == pytest.approx(before, rel=1e-3), "the distance that they have is offered"
    imported.click(600, 450)
    assert modal(imported) == []
