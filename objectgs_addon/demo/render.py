# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendering with Cycles on the CPU: images, and exact object IDs and depth at pixel centers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...backend.shared.color.srgb import encode
from ...backend.shared.errors import Cancelled
from ..blender.quiet import quiet
from .scene import FOCAL, View

UNDENOISED = 8
"""Factor on the samples per pixel if Blender has no denoiser."""


class Renderer:
    """Renderer for the views of a scene; it writes temporary files to `folder`, which must exist."""

    def __init__(self, scene: bpy.types.Scene, width: int, height: int, samples: int, seed: int, folder: Path) -> None:
        self.scene, self.folder, self.samples, self.seed = scene, folder, samples, seed
        render = scene.render
        render.engine = "CYCLES"
        render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
        render.pixel_aspect_x = render.pixel_aspect_y = 1.0
        render.use_persistent_data = True
        render.use_compositing = render.use_sequencer = False
        render.use_motion_blur = render.use_border = False
        render.image_settings.file_format = "OPEN_EXR"
        render.image_settings.color_mode, render.image_settings.color_depth = "RGB", "32"
        cycles = scene.cycles
        cycles.device = "CPU"
        cycles.use_light_tree = False
        cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 3, 2, 2
        cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.sample_clamp_indirect = 4.0
        data = bpy.data.cameras.new("demo")
        data.sensor_fit, data.sensor_width, data.lens = "HORIZONTAL", 36.0, 36.0 * FOCAL
        data.clip_start, data.clip_end = 0.01, 100.0
        self.camera = bpy.data.objects.new("demo camera", data)
        scene.collection.objects.link(self.camera)
        scene.camera = self.camera
        self.override, self.world = _id_and_depth(), scene.world
        meshes = {o.data for o in scene.collection.all_objects if isinstance(o.data, bpy.types.Mesh)}
        self.looks = {mesh: list(mesh.materials) for mesh in meshes}

    def _assign_materials(self, looks: Any) -> None:
        """Assign the materials in `looks` to the meshes."""
        for mesh, materials in looks.items():
            for slot, material in enumerate(materials):
                mesh.materials[slot] = material

    def close(self) -> None:
        """Restore materials and world, and remove the override material."""
        self._assign_materials(self.looks)
        self.scene.world = self.world
        bpy.data.materials.remove(self.override)

    def for_pictures(self) -> None:
        """Set up the scene for `picture`."""
        self._assign_materials(self.looks)
        self.scene.world = self.world
        cycles = self.scene.cycles
        cycles.samples, cycles.seed = self.samples, self.seed
        # Texture edges cause half of the noise (42 dB between two seeds), so adaptive sampling concentrates there.
        cycles.use_adaptive_sampling, cycles.adaptive_threshold, cycles.adaptive_min_samples = True, 0.03, 4
        cycles.pixel_filter_type = "BOX"
        cycles.denoising_input_passes, cycles.denoising_prefilter = "RGB_ALBEDO_NORMAL", "NONE"
        cycles.use_denoising = True
        try:
            cycles.denoiser = "OPENIMAGEDENOISE"
        except TypeError:  # Some builds of Blender lack OpenImageDenoise.
            cycles.use_denoising, cycles.samples = False, UNDENOISED * self.samples

    def for_truth(self) -> None:
        """Set up the scene for `truth`: one ray per pixel center (Cycles ignores the width of the box filter)."""
        self._assign_materials({mesh: [self.override] * len(looks) for mesh, looks in self.looks.items()})
        self.scene.world = None  # The sky has the ID 0 and the depth 0.
        cycles = self.scene.cycles
        cycles.samples, cycles.seed, cycles.use_adaptive_sampling = 1, 0, False
        cycles.pixel_filter_type, cycles.filter_width = "GAUSSIAN", 0.01
        cycles.use_denoising = False

    def picture(self, view: View) -> np.ndarray:
        """Render (H, W, 3) uint8 sRGB, equal to the view transform "Standard" without dithering."""
        linear = np.clip(self._render(view), 0, 1)
        return np.round(encode(linear) * 255).astype(np.uint8)

    def truth(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Render (H, W) uint16 object IDs and (H, W) float32 depth along the camera axis in meters."""
        values = self._render(view)
        return np.round(values[..., 0]).astype(np.uint16), np.ascontiguousarray(values[..., 1])

    def _render(self, view: View) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, :3] = view.rotation.T * [1, -1, -1]  # OpenCV camera axes to Blender's.
        pose[:3, 3] = view.center
        self.camera.matrix_world = Matrix(pose.tolist())
        path = self.folder / "view.exr"
        path.unlink(missing_ok=True)
        self.scene.render.filepath = str(path)
        with quiet():
            result = bpy.ops.render.render(write_still=True, scene=self.scene.name)
        if "FINISHED" not in result:
            raise Cancelled
        if not path.exists():
            raise OSError(f"Blender did not write the rendered image to {path}.")
        image = bpy.data.images.load(str(path), check_existing=False)
        try:
            image.colorspace_settings.name = "Non-Color"
            width, height = image.size
            pixels = np.empty(width * height * image.channels, np.float32)
            image.pixels.foreach_get(pixels)
            return pixels.reshape(height, width, image.channels)[::-1, :, :3]
        finally:
            bpy.data.images.remove(image)
            path.unlink()


def _id_and_depth() -> bpy.types.Material:
    """Create a material that emits (object index, depth along the camera axis, 0)."""
    material = bpy.data.materials.new("demo id and depth")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    index = tree.nodes.new("ShaderNodeObjectInfo").outputs["Object Index"]
    depth = tree.nodes.new("ShaderNodeCameraData").outputs["View Z Depth"]
    color = tree.nodes.new("ShaderNodeCombineXYZ")
    glow, output = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(index, color.inputs[0])
    tree.links.new(depth, color.inputs[1])
    tree.links.new(color.outputs[0], glow.inputs["Color"])
    tree.links.new(glow.outputs[0], output.inputs["Surface"])
    material.cycles.emission_sampling = "NONE"  # Otherwise every triangle is sampled as a light: 0.5 s more per view.
    return material
