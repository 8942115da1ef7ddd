# SPDX-License-Identifier: GPL-3.0-or-later
"""Orient and scale a reconstruction by points picked in the viewport."""

from typing import Any

import bpy
from bpy.props import FloatProperty, FloatVectorProperty
from mathutils import Vector

from ...objectgs_addon import scene
from ...objectgs_addon.picking import point_picker
from ...objectgs_addon.state import viewports
from ..common import need
from ..common.reporting import reports_errors

_NAVIGATION = {
    "MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "TRACKPADPAN", "TRACKPADZOOM", "MOUSEROTATE", "MOUSESMARTZOOM",
}  # fmt: skip
"""Events that turn, move or zoom the view."""


class _PicksPoints:
    """Modal part: clicks collect the nearest points of the reconstruction, then `finish` uses them."""

    bl_options = {"REGISTER", "UNDO"}
    count = 0
    where = ""

    points: Any
    picker: point_picker.PointPicker | None = None
    report: Any
    poll_message_set: Any

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return need.shown(cls, context) and need.object_mode(cls, context)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        if context.area is None or context.area.type != "VIEW_3D":
            self.report({"ERROR"}, "Start this from a 3D viewport")
            return {"CANCELLED"}
        self.picker = point_picker.PointPicker(need.active_root(context), context.view_layer, context.space_data)
        if not self.picker.has_points:
            self.report({"ERROR"}, "There are no points to pick; show the points or splats of the reconstruction")
            return {"CANCELLED"}
        self.picker.begin(context, self._text())
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if event.type in {"ESC", "RIGHTMOUSE"}:
            self.picker.end(context)
            return {"CANCELLED"}
        if event.type in _NAVIGATION or event.type.startswith(("NUMPAD", "NDOF_")):
            return {"PASS_THROUGH"}
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            if not self.picker.pick(context, event):
                self.report({"WARNING"}, "There is no point here; click nearer to one")
            if len(self.picker.picked) == self.count:
                self.picker.end(context)
                self.points = tuple(value for point in self.picker.picked for value in point)
                return self.finish(context)
            self.picker.show_status(context, self._text())
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End picking if the window is closed or another file is opened."""
        if self.picker is not None:
            self.picker.end(context)

    def finish(self, context: bpy.types.Context) -> set[str]:
        """Use the points once all are picked."""
        raise NotImplementedError

    def _text(self) -> str:
        return f"Click point {len(self.picker.picked) + 1} of {self.count} {self.where}; Esc: cancel"

    def _points(self) -> list[Vector]:
        return [Vector(self.points[i : i + 3]) for i in range(0, 3 * self.count, 3)]


class SetGround(_PicksPoints, bpy.types.Operator):
    bl_idname = "objectgs.set_ground"
    bl_label = "Set Ground"
    bl_description = "Click three points on the ground to place it at Z = 0, with the scene above it"

    points: FloatVectorProperty(name="Points", size=9, options={"HIDDEN", "SKIP_SAVE"})
    count = 3
    where = "on the ground"

    def finish(self, context: bpy.types.Context) -> set[str]:
        return self.execute(context)

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        scene.orient_to_ground(need.active_root(context), *self._points())


class SetDistance(_PicksPoints, bpy.types.Operator):
    bl_idname = "objectgs.set_distance"
    bl_label = "Set Distance"
    bl_description = "Click two points and enter their distance to scale the reconstruction"

    points: FloatVectorProperty(name="Points", size=6, options={"HIDDEN", "SKIP_SAVE"})
    distance: FloatProperty(
        name="Distance", default=1.0, min=1e-6, unit="LENGTH", description="True distance of the two points"
    )
    count = 2
    where = "of a known distance"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.properties.is_property_set("points"):
            return context.window_manager.invoke_props_dialog(self)
        return super().invoke(context, event)

    def finish(self, _context: bpy.types.Context) -> set[str]:
        first, second = self._points()
        distance = max((second - first).length, 1e-6)
        # The dialog belongs to an operator of its own, since this one would go on to receive events.
        bpy.ops.objectgs.set_distance("INVOKE_DEFAULT", points=self.points, distance=distance)
        return {"CANCELLED"}

    @reports_errors
    def execute(self, context: bpy.types.Context) -> None:
        root = need.active_root(context)
        scene.scale_to_distance(root, *self._points(), self.distance)
        viewports.widen_clipping(root)


CLASSES = (SetGround, SetDistance)
