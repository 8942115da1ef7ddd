# SPDX-License-Identifier: GPL-3.0-or-later
"""From a folder of photos to trained splats by clicks: Import Photos or Video, its file browser, Train."""

import time

import av
import numpy as np
import pytest
from PIL import Image

from tests.backend.rendered_photos import photo, ring

from .first_show import open_startup_scene, sidebar
from .test_workflow import IDLE, script, wait

pytestmark = pytest.mark.slow

VIEWS = 12


@pytest.fixture(scope="module", params=["photos", "film"])
def source(request, tmp_path_factory):
    """A folder of photos, and one of a film with three frames for each of them."""
    folder = tmp_path_factory.mktemp("source") / request.param
    folder.mkdir()
    images = [photo(matrix) for matrix in ring(VIEWS if request.param == "photos" else 3 * VIEWS)]
    if request.param == "photos":
        for number, image in enumerate(images):
            Image.fromarray(image).save(folder / f"{number}.png")
        return folder
    with av.open(str(folder / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=15, options={"crf": "15"})
        stream.pix_fmt, (stream.height, stream.width) = "yuv420p", images[0].shape[:2]
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")))
        container.mux(stream.encode(None))
    return folder


BROWSER = """
    found = [(window, area) for window in bpy.context.window_manager.windows for area in window.screen.areas
             if area.type == "FILE_BROWSER"]
"""


def click_until(window, happened: str) -> None:
    """Click on one place after another of the sidebar, below its first header, until a script's result is true."""
    x, top, bottom = sidebar(window)
    for y in range(round(top) + 40, round(bottom), 12):
        window.click(x, y)
        time.sleep(1.0)
        if window.run(script(happened)):
            return
    raise AssertionError(f"no button led to: {happened}")


def test_three_clicks_from_photos_to_splats(blender, source):
    """The buttons are those of the panel and of the file browser; only its folder is set by a script."""
    open_startup_scene(blender)
    time.sleep(2)
    click_until(blender, BROWSER + "    result = len(found) == 1")
    operator, x, y = blender.run(
        script(
            BROWSER
            + f"""
    window, area = found[0]
    area.spaces.active.params.directory = {str(source).encode()!r}
    with bpy.context.temp_override(window=window, area=area):
        bpy.ops.file.refresh()
    buttons = next(region for region in area.regions if region.type == "EXECUTE")
    height = bpy.context.window_manager.windows[0].height
    result = [area.spaces.active.active_operator.bl_idname, window.x + buttons.x + buttons.width - 50,
              height - window.y - buttons.y - buttons.height / 2]
    """
        )
    )
    assert operator == "OBJECTGS_OT_import_photos"
    time.sleep(1)
    blender.shot(f"{source.name}-1-browser")
    blender.click(x, y)
    time.sleep(3)
    blender.shot(f"{source.name}-2-running")
    wait(blender, f"owner.objectgs.active is not None and {IDLE}", 480)  # includes compiling kernels
    time.sleep(2)
    blender.shot(f"{source.name}-3-imported")
    cameras = blender.run(script("result = len([obj for obj in root.all_objects if obj.type == 'CAMERA'])"))
    assert cameras >= VIEWS
    blender.run(script("    root.objectgs.length, root.objectgs.minutes = 'minutes', 0.2"))
    click_until(blender, f"    result = not {IDLE}")
    wait(blender, f"{IDLE} and any(scene.kind_of(obj) == 'splats' for obj in root.all_objects)", 600)
    time.sleep(2)
    blender.shot(f"{source.name}-4-trained")
