# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties saved in the .blend: the active reconstruction, its list of objects and its training settings.

`Collection.objectgs` stores the state of a reconstruction and `Scene.objectgs` the active reconstruction. These
properties support undo and are saved with the .blend, unlike background jobs (see `running`).
"""

from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ...backend.shared.defaults import DETAIL, MAX_SIZE
from ...backend.shared.expectation import PRESET_STEPS
from ...backend.shared.formats.splat_ply import UNOBSERVED
from .. import drawing
from ..picking import marks
from ..scene import SHADINGS, SHOWS, is_linked, kind_of, shade_meshes, shading_of, shown_kinds
from . import object_edits, viewports


def _slider(name: str, default: float, least: float, most: float, description: str) -> Any:
    return FloatProperty(
        name=name,
        default=default,
        min=least,
        soft_max=most,
        max=most if most <= 1.0 else 10.0,
        subtype="FACTOR",
        options=set(),
        description=description,
        update=object_edits.recolor_changed,
    )


def _color_edit(name: str, default: float, description: str) -> Any:
    return FloatVectorProperty(
        name=name,
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        soft_max=1.0,
        max=10.0,
        default=(default,) * 3,
        options=set(),
        description=description,
        update=object_edits.recolor_changed,
    )


def image_size() -> Any:
    """Return the property of the longest side of the images, for a reconstruction and for its import."""
    return IntProperty(
        name="Image Size",
        default=MAX_SIZE,
        min=64,
        soft_max=8192,
        description="Longest side in pixels; larger photos are scaled down",
    )


def _name_changed(item: Any, context: bpy.types.Context) -> None:
    object_edits.name_changed(item, context)
    marks.take_name(item.id_data, item.object_id, item.name)


class ObjectItem(bpy.types.PropertyGroup):
    """A row of the objects list; IDs above 2^31 - 1 are stored as the int32 with the same bits."""

    name: StringProperty(
        name="Name", description="Name of the object, kept in the reconstruction", update=_name_changed
    )
    color: FloatVectorProperty(
        name="Color",
        description="Color that represents the object",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        max=1.0,
        update=object_edits.color_changed,
    )
    chosen: BoolProperty(
        name="Reconstruct",
        default=True,
        update=object_edits.chosen_changed,
        description="Train this object; otherwise it becomes part of the background. After the training, show and "
        "export its splats",
    )
    object_id: IntProperty(name="ID", description="Pixel value of the object in the masks")
    points: IntProperty(
        name="Points", description="Points of the capture that are assigned to this object, and to those merged into it"
    )
    splats: IntProperty(name="Splats", description="Number of Gaussian splats of this object")
    faces: IntProperty(name="Faces", description="Number of faces of this object's mesh; 0 without a mesh")
    is_merged: BoolProperty(name="Merged", description="Merged into another object")
    merged_into: IntProperty(name="Merged Into", description="ID of the object that this one is merged into")
    removed: BoolProperty(name="Removed", description="Hidden until it is restored")
    floaters: BoolProperty(name="With Floaters", description="Removed with the background's splats inside it")
    fill: BoolProperty(
        name="Fill Hole", description="The hole in the ground or wall behind it is filled from its surroundings"
    )
    cleaned: BoolProperty(name="Floaters Hidden", description="Its splats apart from the rest of it are hidden")
    separated: BoolProperty(name="Separated", description="Consists of single splats taken from other objects")
    replace: _color_edit("New Color", 0.5, "Replaces the object's color and keeps its shading")
    amount: _slider("Amount", 0.0, 0.0, 1.0, "Amount of the new color")
    hue: _slider("Hue", 0.0, -0.5, 0.5, "Rotation of the hue in turns of the color wheel; brightness is kept")
    saturation: _slider("Saturation", 1.0, 0.0, 2.0, "0 is gray, 1 is unchanged")
    value: _slider("Brightness", 1.0, 0.0, 2.0, "Factor of the brightness")
    contrast: _slider("Contrast", 1.0, 0.0, 2.0, "Contrast around the object's average brightness; 1 is unchanged")
    tint: _color_edit("Tint", 1.0, "Factor of each channel; white is unchanged")
    middle: FloatProperty(
        name="Average Brightness", description="Average brightness of the object's splats; 0 if it is not known yet"
    )
    stored: StringProperty(name="Stored", description="State in objects.json, which a failed edit reverts to")


class MarkedObject(bpy.types.PropertyGroup):
    """An object that is marked by strokes; `strokes` of the reconstruction has them."""

    name: StringProperty(name="Name", description="Name of the object")
    object_id: IntProperty(name="ID")
    color: FloatVectorProperty(
        name="Color",
        description="Color in which the object is shown",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        max=1.0,
        update=marks.color_set,
    )


class PlanChoice(bpy.types.PropertyGroup):
    """The user's choice for a decision of the plan; `name` is its key."""

    done: BoolProperty(name="Done", description="Apply this decision in training")


class ReconstructionProperties(bpy.types.PropertyGroup):
    """State of one reconstruction, stored on its collection."""

    objects: CollectionProperty(type=ObjectItem)
    plan_choices: CollectionProperty(type=PlanChoice)
    marked: CollectionProperty(type=MarkedObject)
    active_marked: IntProperty(name="Active Object", default=0, options=set())
    strokes: StringProperty(
        name="Strokes", description="The strokes on the marked objects, as JSON", update=marks.strokes_changed
    )
    everything: BoolProperty(
        name="Everything Is Marked",
        description="Every part of the scene belongs to one of the marked objects. Otherwise, what is far from all "
        "strokes belongs to none",
        update=marks.strokes_changed,
    )
    detail: FloatProperty(
        name="Detail",
        default=DETAIL,
        min=0.1,
        max=0.9,
        precision=2,
        subtype="FACTOR",
        description="How finely Suggest Objects divides the scene: lower it if things are in parts, and raise it if "
        "several are one",
    )
    active_object: IntProperty(name="Active Object", default=0, update=object_edits.active_changed, options=set())
    length: EnumProperty(
        name="Quality",
        default="standard",
        description="Total length of the training; a finished one can be extended",
        items=[
            ("preview", "Preview", f"For a quick check, soft ({PRESET_STEPS['preview']:,} steps)"),
            ("standard", "Standard", f"For most work ({PRESET_STEPS['standard']:,} steps)"),
            ("final", "Best", "Until the result stops improving; this takes longest"),
            ("minutes", "Time Limit", "As good as the given time allows"),
        ],
    )
    minutes: FloatProperty(
        name="Minutes",
        default=5.0,
        min=0.1,
        soft_max=120.0,
        precision=1,
        step=50,
        description="Total time of the training. More time gives a sharper result; a finished training can be extended",
    )
    mode: EnumProperty(
        name="Model",
        default="explicit",
        items=[
            ("explicit", "Plain Splats", "The trained model is exactly what Blender shows and the PLY file contains"),
            ("view", "View-Dependent", "Splats depend on the view; the PLY file is an approximation"),
            ("paper", "Paper", "View-dependent, and with heads alone, as in the paper; for comparisons"),
        ],
    )
    sh_degree: IntProperty(
        name="SH Degree",
        default=1,
        min=0,
        max=3,
        description="Degree of the spherical harmonics; higher degrees allow more view-dependent color",
    )
    primitive: EnumProperty(
        name="Splats",
        default="3d",
        items=[
            ("3d", "Ellipsoids", "3D Gaussians, for the best images"),
            ("2d", "Discs", "2D Gaussians, for the best meshes, since discs align with surfaces"),
        ],
    )
    strategy: EnumProperty(
        name="Assignment",
        description="How the masks vote on the object of a point",
        default="majority",
        items=[
            ("majority", "Majority", "The object that most masks show at the point"),
            ("probability", "Probability", "Random choice in proportion to the votes"),
            ("correspondence", "Correspondence", "Only photos in which COLMAP matched the point"),
        ],
    )
    max_size: image_size()
    # Stored in a custom property outside this property group, as in files made without the extension.
    shown: EnumProperty(
        name="Show",
        items=[
            ("splats", "Splats", "The Gaussian splats", 0),
            ("meshes", "Meshes", "The textured meshes; objects without a mesh show their splats", 1),
            ("both", "Both", "Splats and meshes together", 2),
        ],
        get=lambda self: SHOWS.index(shown_kinds(self.id_data)),
        set=lambda self, value: viewports.show_kinds(self.id_data, SHOWS[value]),
    )
    mesh_shading: EnumProperty(
        name="Mesh Shading",
        items=[
            ("captured", "As Captured", "Meshes show the colors of the photos without any light, like splats", 0),
            ("lit", "Lit", "The scene's lights and world light the meshes; without them, meshes are black", 1),
        ],
        get=lambda self: SHADINGS.index(shading_of(self.id_data)),
        set=lambda self, value: shade_meshes(self.id_data, SHADINGS[value]),
    )
    mesh_objects: EnumProperty(
        name="Objects",
        default="all",
        items=[
            ("all", "All", "Every object that is not left out; merged objects become one mesh"),
            ("selected", "Selected", "The objects selected in the viewport, or the active one of the list"),
        ],
    )
    mesh_scene: BoolProperty(name="Whole Scene", description="Also make one mesh of the whole scene, hidden")
    mesh_faces: IntProperty(
        name="Faces",
        default=20_000,
        min=100,
        soft_max=200_000,
        step=1000,
        description="Maximum number of triangles of an object's mesh; five times as many for the scene mesh",
    )
    mesh_closed: BoolProperty(
        name="Closed",
        default=True,
        description=(
            "Close each mesh where no camera saw the object, such as its underside. The attribute "
            f'"{UNOBSERVED}" marks these faces'
        ),
    )
    texture_size: EnumProperty(
        name="Texture",
        default="auto",
        items=[
            ("auto", "Automatic", "Size that matches the resolution of the photos"),
            ("512", "512 px", ""),
            ("1024", "1024 px", ""),
            ("2048", "2048 px", ""),
            ("4096", "4096 px", ""),
        ],
        description="Width and height of each mesh's texture",
    )


def _is_reconstruction(_scene: Any, collection: bpy.types.Collection) -> bool:
    return kind_of(collection) == "reconstruction" and not is_linked(collection)


class SceneProperties(bpy.types.PropertyGroup):
    """The active reconstruction of a scene and its display settings."""

    active: PointerProperty(
        type=bpy.types.Collection,
        name="Reconstruction",
        poll=_is_reconstruction,
        description="Active reconstruction of the scene",
    )
    select_whole: BoolProperty(
        name="Select Whole Objects",
        default=True,
        description="Clicking a part of an object selects all its parts, so that they move together",
    )
    draw_splats: BoolProperty(
        name="Draw Splats",
        default=True,
        update=drawing.switch,
        description="Draw splats in the 3D viewports as in the final image, instead of a preview by points",
    )
    colors: EnumProperty(
        name="Colors",
        default="photo",
        description="Colors of points and splats in the 3D viewports",
        items=[
            ("photo", "Photo", "Colors of the photos"),
            ("object", "Objects", "Colors that represent the objects"),
        ],
        update=viewports.colors_changed,
    )

    mark_shape: EnumProperty(
        name="Shape",
        description="How the tool Mark Object marks",
        default="STROKE",
        items=[
            ("STROKE", "Stroke", "What is under the stroke or click", "GREASEPENCIL", 0),
            ("LASSO", "Lasso", "What is inside an outline", "GP_SELECT_POINTS", 1),
            ("BOX", "Box", "What is inside a rectangle", "SELECT_SET", 2),
        ],
    )
    splat_shape: EnumProperty(
        name="Shape",
        description="How the tool Select Splats selects",
        default="BRUSH",
        items=[
            ("BRUSH", "Brush", "Splats under a brush", "MESH_CIRCLE", 0),
            ("LASSO", "Lasso", "Splats in an outline", "GP_SELECT_POINTS", 1),
            ("BOX", "Box", "Splats in a rectangle", "SELECT_SET", 2),
            ("SPHERE", "Sphere", "Splats in a sphere around the surface under the mouse", "SPHERE", 3),
        ],
    )
    splat_radius: IntProperty(
        name="Radius", description="Radius of the brush", default=30, min=1, soft_max=300, max=2000, subtype="PIXEL"
    )
    splat_depth: EnumProperty(
        name="Depth",
        description="Whether splats that others hide are selected, too",
        default="THROUGH",
        items=[
            ("THROUGH", "Through", "Select all splats, whether or not others hide them"),
            ("VISIBLE", "Visible Only", "Select only splats that are not hidden by others in front of them"),
        ],
    )


CLASSES = (ObjectItem, MarkedObject, PlanChoice, ReconstructionProperties, SceneProperties)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Collection.objectgs = PointerProperty(type=ReconstructionProperties)
    bpy.types.Scene.objectgs = PointerProperty(type=SceneProperties)


def unregister() -> None:
    del bpy.types.Scene.objectgs
    del bpy.types.Collection.objectgs
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
