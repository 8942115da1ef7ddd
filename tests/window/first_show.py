# SPDX-License-Identifier: GPL-3.0-or-later
"""A reconstruction of a ball with far strays in front of a square, and Blender's startup scene to open it in."""

import json
import textwrap
import time
from pathlib import Path

import numpy as np

from backend.export import write_splats
from backend.model.splats import Splats
from backend.shared.formats.points_ply import LabeledPoints, write_points
from backend.shared.splats.spherical_harmonics import C0

from . import harness
from .harness import PACKAGE

SIZE = (160, 120)
K = [[160.0, 0, 80.0], [0, 160.0, 60.0], [0, 0, 1]]
CAMERAS = [(0.0, -5.0, 0.4), (1.5, -4.8, 0.4), (-1.5, -4.8, 0.6), (0.8, -4.6, 1.2)]
COLOR = np.array([200, 100, 50]) / 255
"""The square's color."""
STRAYS = np.array([(40.0, 20.0, 0), (0, 50.0, 30.0), (-60.0, 30.0, 79.0)])
LAYERS = 40
"""Splats behind each other in the square."""

PRELUDE = f"""
import importlib, json
import numpy as np
scene = importlib.import_module("{PACKAGE}.objectgs_addon.scene")
object_list = importlib.import_module("{PACKAGE}.objectgs_addon.state.object_list")
owner = bpy.context.scene
root = owner.objectgs.active
view = window_context()["area"].spaces.active.region_3d
def part(object_id, kind="splats"):
    parts = scene.parts_of(scene.object_collections(root)[object_id])
    return next(part for part in parts if scene.kind_of(part) == kind)
def call(operator, **options):
    with bpy.context.temp_override(**window_context()):
        return list(operator("INVOKE_DEFAULT", True, **options))  # True: with an undo step
"""


def script(body: str) -> str:
    return PRELUDE + textwrap.dedent(body)


def write_reconstruction(place: Path) -> Path:
    """Write the reconstruction: object 1 is the ball with radius 0.5, object 2 the square."""
    (place / "images").mkdir(parents=True)
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(400, 3))
    ball *= 0.5 / np.linalg.norm(ball, axis=1, keepdims=True)
    grid = np.linspace(-1.5, 1.5, 12)
    square = np.array([(x, 1.0 + 0.01 * layer, z) for layer in range(LAYERS) for x in grid for z in grid])
    means = np.concatenate([ball, STRAYS, square])
    count, first = len(means), len(ball) + len(STRAYS)
    scales, opacities = np.full((count, 3), 0.06), np.full(count, 0.9)
    scales[len(ball) : first] = 1.0
    scales[first:], opacities[first:] = (0.25, 0.01, 0.25), 0.15
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = (COLOR - 0.5) / C0
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    ids = np.repeat([1, 2], [first, len(square)])
    write_splats(place / "splats.ply", Splats(means.astype(np.float32), quats, scales, opacities, sh, ids))
    points = np.concatenate([rng.uniform(-1, 1, (200, 3)), STRAYS])
    zeros = np.zeros(len(points), int)
    write_points(place / "points.ply", LabeledPoints(points, np.zeros((len(points), 3), np.uint8), zeros, zeros, zeros))
    cameras = [
        {
            "name": f"{i}.png",
            "image": f"images/{i}.png",
            "mask": None,
            "width": SIZE[0],
            "height": SIZE[1],
            "K": K,
            "viewmat": viewmat(np.array(center)).tolist(),
            "held_out": False,
        }
        for i, center in enumerate(CAMERAS)
    ]
    upright = {"rotation": np.eye(3).tolist(), "translation": [0, 0, 0]}
    content = {"capture": str(place), "origin": [0, 0, 0], "cameras": cameras, "upright": upright}
    (place / "cameras.json").write_text(json.dumps(content))
    objects = [
        {"id": i, "name": name, "color": [200, 90 * i, 10], "points": 1} for i, name in ((1, "ball"), (2, "square"))
    ]
    (place / "objects.json").write_text(json.dumps({"edits": {}, "objects": objects}))
    return place


def viewmat(center: np.ndarray) -> np.ndarray:
    """Return the viewmat of a camera at `center` that looks at the square's middle."""
    forward = np.array([0.0, 1.0, 0.0]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1.0))
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ center
    return matrix


def open_startup_scene(blender) -> None:
    """Open Blender's startup file, and show the sidebar."""
    blender.run("""
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
            bpy.ops.wm.read_homefile(app_template="")
    """)
    time.sleep(1.0)
    blender.key("Escape")
    blender.run("""
        window_context()["area"].spaces.active.show_region_ui = True
    """)
    time.sleep(0.5)
    blender.run("""
        for region in window_context()["area"].regions:
            if region.type == "UI":
                region.active_panel_category = "ObjectGS"
                region.tag_redraw()
    """)


def sidebar(blender) -> tuple[float, float, float]:
    """Return the middle, the top and the bottom of the sidebar in pixels of the window, from its upper left."""
    return blender.run("""
        context = window_context()
        region = next(region for region in context["area"].regions if region.type == "UI")
        height = context["window"].height
        result = [region.x + region.width / 2 - 10, height - region.y - region.height, height - region.y]
    """)


def open_reconstruction(blender, folder: Path) -> None:
    """Open a folder by the operator."""
    blender.run(
        script(f"""
        with bpy.context.temp_override(**window_context()):
            bpy.ops.objectgs.open_reconstruction("EXEC_DEFAULT", True, directory={str(folder)!r})
    """)
    )
    wait(blender, "root is not None and scene.object_collections(root)")


def wait(blender, expression: str) -> None:
    """Wait until an expression that can use the prelude's names is true."""
    deadline = time.monotonic() + 20
    while not blender.run(script(f"result = bool({expression})")):
        if time.monotonic() > deadline:
            raise harness.Failed(f"condition timed out: {expression}")
        time.sleep(0.3)
