# SPDX-License-Identifier: GPL-3.0-or-later
"""Export the splats with all edits, in the background."""

import bpy
from bpy.props import EnumProperty, StringProperty

from ...objectgs_addon import scene
from ...objectgs_addon.environment import locations
from ...objectgs_addon.running import background
from ..common import need
from ..common.export_dialog import ExportDialog, objects_choice
from ..common.jobs import store_edits
from ..common.reporting import reports_errors


class ExportSplats(ExportDialog, bpy.types.Operator):
    bl_idname = "objectgs.export_splats"
    bl_label = "Export Splats"
    bl_description = "Export the splats with all edits: without removed objects, recolored, moved, and with duplicates"
    bl_options = {"REGISTER"}

    filter_glob: StringProperty(default="*.ply;*.spz;*.splat;*.glb;*.usdc", options={"HIDDEN"})
    format: EnumProperty(
        name="Format",
        items=[
            ("ply", "PLY", "The format of 3D Gaussian splatting programs: exact, with object IDs"),
            ("spz", "SPZ", "About a fifth of the size, slightly rounded"),
            ("splat", "Splat", "For web viewers: one color per splat, independent of the view direction"),
            ("glb", "glTF", "KHR_gaussian_splatting: exact, each object a node with its name"),
            ("usdc", "USD", "ParticleField3DGaussianSplat of OpenUSD 26.03: exact, each object a prim with its name"),
        ],
    )
    objects: objects_choice("Everything except objects that are removed or left out")
    coordinates: EnumProperty(
        name="Coordinates",
        items=[
            (
                "blender",
                "Blender",
                "Positions in Blender, with Set Ground and Set Distance. PLY, Splat and USD are Z up, as USD meshes; "
                "SPZ and glTF are Y up, as glTF and OBJ meshes",
            ),
            ("capture", "Capture", "Coordinates of the captured cameras"),
        ],
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return (
            need.backend(cls)
            and need.reconstruction(cls, context)
            and need.idle(cls, context)
            and need.splats(cls, context)
        )

    @reports_errors
    def execute(self, context: bpy.types.Context) -> set[str]:
        root = need.active_root(context)
        folder = scene.folder_of(root)
        out, ids = self.choices(context)
        arguments = [
            "export",
            str(folder),
            "--out",
            str(out),
            "--format",
            self.format,
            "--coordinates",
            self.coordinates,
        ]
        if self.coordinates == "blender":
            to_world = scene.matrix_of_root(root).ravel()
            arguments.append(f"--to-world={','.join(map(repr, to_world.tolist()))}")
        if ids is not None:
            arguments += ["--objects", *map(str, ids)]
        if self.per_object:
            arguments.append("--per-object")
        store_edits(root)
        job = locations.backend_job(f"Export {out.name}", "export", folder, *arguments)
        return background.submit(job, context.scene, self.report)


CLASSES = (ExportSplats,)
