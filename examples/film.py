# SPDX-License-Identifier: GPL-3.0-or-later
"""A film shot of the demo without a window: one object is removed, one recolored, one moved and one rotating; the
camera travels, and behind the table is a ball that Blender renders.

    OBJECTGS_PYTHON=.venv/bin/python .venv-bpy/bin/python examples/film.py build/demo --out build/film
    OBJECTGS_PYTHON=.venv/bin/python blender -b -P examples/film.py -- build/demo --out build/film

Leaves edited.ply (the edited splats for other programs), film/splats.0001.exr ... (the splats alone),
film/composite.0001.png ... (combined with Blender's rendering by depth) and joined.blend, whose compositor does the
same. The demo itself is not changed.
"""

import argparse
import importlib.util
import math
import shutil
import sys
from pathlib import Path

import bpy
from mathutils import Vector

ROOT = Path(__file__).resolve().parents[1]
KEPT = ("splats.ply", "points.ply", "anchors.ply", "cameras.json", "objects.json", "objectgs.json")


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description="A film shot of the demo without a window.")
    parser.add_argument("demo", type=Path, help="reconstruction folder of `make demo`")
    parser.add_argument("--out", type=Path, required=True, help="folder for the shot")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--size", default="640x360")
    options = parser.parse_args(arguments)
    headless = load_headless()
    scene_folder, blend = options.out / "demo", options.out / "shot.blend"
    scene_folder.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        shutil.copy(options.demo / name, scene_folder / name)
    shutil.copytree(options.demo / "capture" / "images", scene_folder / "capture" / "images", dirs_exist_ok=True)
    for command in (
        ("edit", scene_folder, "--remove", "bowl", "--recolor", "vase:hue=0.35", "--move", "ring:z=0.2,y=-0.05,rz=40"),
        ("export", scene_folder, "--out", options.out / "edited.ply"),
        ("build", scene_folder, "--blend", blend),
    ):
        code = headless.main([str(word) for word in command])
        if code:
            return code
    make_shot(blend, options.frames)
    return headless.main(
        [
            "film",
            str(blend),
            "--out",
            str(options.out / "film"),
            "--size",
            options.size,
            "--composite",
            "png",
            "--png",
            "--samples",
            "32",
            "--save",
            str(options.out / "joined.blend"),
        ]
    )


def make_shot(blend: Path, frames: int) -> None:
    """Add a camera, a ball and a light to the file that `build` has made, and animate camera and monkey."""
    bpy.ops.wm.open_mainfile(filepath=str(blend.absolute()))
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, frames
    scene.render.use_motion_blur = True
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0

    lens = bpy.data.cameras.new("Film")
    camera = bpy.data.objects.new("Film", lens)
    scene.collection.objects.link(camera)
    scene.camera = camera
    monkey = next(obj for obj in scene.objects if obj.name == "monkey" and obj.type == "EMPTY")
    for frame, angle, length, turn in ((1, -0.3, 36.0, 0.0), (frames, 0.3, 44.0, 0.8)):
        camera.location = 1.55 * math.cos(angle), 1.55 * math.sin(angle), 0.55
        towards = Vector((0.0, 0.0, 0.1)) - camera.location
        camera.rotation_euler = towards.to_track_quat("-Z", "Y").to_euler()
        camera.keyframe_insert("location", frame=frame)
        camera.keyframe_insert("rotation_euler", frame=frame)
        lens.lens = length
        lens.keyframe_insert("lens", frame=frame)
        monkey.rotation_euler = 0.0, 0.0, turn
        monkey.keyframe_insert("rotation_euler", frame=frame)

    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.4, location=(-1.0, -0.1, 0.2), segments=96, ring_count=48)
    ball = bpy.context.object
    ball.name = "Ball"
    for face in ball.data.polygons:
        face.use_smooth = True
    material = bpy.data.materials.new("Ball")
    if material.node_tree is None:
        material.use_nodes = True
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value = (0.8, 0.05, 0.03, 1.0)
    shader.inputs["Roughness"].default_value = 0.25
    ball.data.materials.append(material)
    light = bpy.data.lights.new("Sun", "SUN")
    light.energy, light.angle = 3.0, 0.3
    sun = bpy.data.objects.new("Sun", light)
    sun.rotation_euler = 0.5, 0.7, 0.0
    scene.collection.objects.link(sun)
    world = scene.world = bpy.data.worlds.new("Dim")
    if world.node_tree is None:
        world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.25, 0.28, 0.3, 1.0)
    bpy.ops.wm.save_mainfile()


def load_headless():
    """Load headless.py, in the parent folder, as a module."""
    spec = importlib.util.spec_from_file_location("headless", ROOT / "headless.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    sys.exit(main(own))
