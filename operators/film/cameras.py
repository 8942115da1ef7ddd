# SPDX-License-Identifier: GPL-3.0-or-later
"""New cameras: one that sees what the viewport shows, and one that moves along the captured views."""

import bpy

from ...backend.shared.errors import InputError
from ...backend.shared.formats.photos_source import natural_order
from ...objectgs_addon import film, scene
from ..common import need
from ..common.reporting import reports_errors


class CameraFromView(bpy.types.Operator):
    bl_idname = "objectgs.camera_from_view"
    bl_label = "New Camera from View"
    bl_description = "Add a camera that sees what the 3D viewport shows, and make it the scene's camera"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.region_data is not None:
            return True
        cls.poll_message_set("This needs a 3D viewport")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        space, region = context.space_data, context.region_data
        matrix = region.view_matrix.inverted()
        seen = space.camera if region.view_perspective == "CAMERA" else None
        camera = film.new_camera(context.scene, "Camera", None if seen is None else seen.data)
        if seen is None:
            camera.data.lens = space.lens / 2.0  # The viewport's lens is for twice the sensor of a camera.
            camera.data.clip_start, camera.data.clip_end = space.clip_start, space.clip_end
        camera.matrix_world = matrix
        space.camera = camera  # The viewport may have a local camera.
        region.view_perspective = "CAMERA"
        return {"FINISHED"}


class CameraPath(bpy.types.Operator):
    bl_idname = "objectgs.camera_path"
    bl_label = "New Camera Path"
    bl_description = (
        "Add a camera that moves along the captured views over the scene's frame range, and make it the scene's camera"
    )
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown(cls, context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        owner = context.scene
        context.view_layer.update()
        cameras = [part for part in need.active_root(context).all_objects if scene.kind_of(part) == "camera"]
        if len(cameras) < 2:
            raise InputError("A path needs at least two captured views; import the capture again")
        cameras.sort(key=lambda camera: natural_order(camera["objectgs_image"]))
        film.make_path(owner, cameras, owner.frame_start, owner.frame_end)
        owner.frame_set(owner.frame_current)  # Otherwise the camera stays at its last key.


CLASSES = (CameraFromView, CameraPath)
