# SPDX-License-Identifier: GPL-3.0-or-later
"""What the .blend remembers: the reconstruction a scene works on, its list of objects and how to train it.

`Collection.objectgs` holds a reconstruction's state, `Scene.objectgs` which one is active. Everything here is undone
and saved with the .blend; what runs in the background is not here (see `running`).
"""

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

from ..backend.expectation import PRESET_STEPS
from . import drawing, object_edits
from .scene import SHOWS, colour_points_by, kind_of, show_kinds, shown_kinds


def _slider(name: str, default: float, least: float, most: float, description: str):
    return FloatProperty(name=name, default=default, min=least, soft_max=most, max=most if most <= 1.0 else 10.0,
                         subtype="FACTOR", options=set(), description=description,
                         update=object_edits.recolour_changed)


def _shade(name: str, default: float, description: str):
    return FloatVectorProperty(name=name, subtype="COLOR_GAMMA", size=3, min=0.0, soft_max=1.0, max=10.0,
                               default=(default,) * 3, options=set(), description=description,
                               update=object_edits.recolour_changed)


class ObjectItem(bpy.types.PropertyGroup):
    """A row of the objects list. IDs above 2^31 - 1 are stored as the int32 of the same bits."""

    name: StringProperty(name="Name", description="Name of the object, kept in the reconstruction",
                         update=object_edits.name_changed)
    colour: FloatVectorProperty(name="Color", description="Color that stands for the object", subtype="COLOR_GAMMA",
                                size=3, min=0.0, max=1.0, update=object_edits.colour_changed)
    chosen: BoolProperty(name="Reconstruct", default=True, update=object_edits.chosen_changed,
                         description="Make this object when training; otherwise it stays part of the unlabelled rest")
    object_id: IntProperty(name="ID", description="Value of the object's pixels in the masks")
    points: IntProperty(name="Points", description="Points of the capture that were voted to be this object")
    splats: IntProperty(name="Splats", description="Gaussian splats of this object")
    faces: IntProperty(name="Faces", description="Faces of this object's mesh; 0 where it has none")
    is_merged: BoolProperty(name="Merged", description="Shown as a part of another object")
    merged_into: IntProperty(name="Merged into", description="ID of the object that this one is a part of")
    removed: BoolProperty(name="Removed", description="Not to be seen, until it is restored")
    floaters: BoolProperty(name="Floaters Too", description="Removed with what floats unlabelled inside it")
    fill: BoolProperty(name="Fill", description="The ground or wall that it hid is closed with what is around")
    replace: _shade("New Color", 0.5, "Takes the place of the object's own color; its shading stays")
    amount: _slider("Amount", 0.0, 0.0, 1.0, "How much of the new color")
    hue: _slider("Hue", 0.0, -0.5, 0.5, "Turns of the color wheel; brightness stays")
    saturation: _slider("Saturation", 1.0, 0.0, 2.0, "0 is grey, 1 as it is")
    value: _slider("Brightness", 1.0, 0.0, 2.0, "Times as bright")
    contrast: _slider("Contrast", 1.0, 0.0, 2.0, "About the object's average brightness; 1 is as it is")
    tint: _shade("Tint", 1.0, "Each channel is multiplied by this; white is as it is")
    middle: FloatProperty(name="Average Brightness", description="Of the object's splats; 0 where it is not known yet")
    stored: StringProperty(name="Stored", description="What objects.json says: what a refused edit goes back to")


class PlanChoice(bpy.types.PropertyGroup):
    """What the user wants of a decision of the plan; `name` is its key."""

    done: BoolProperty(name="Done", description="Whether training does it")


class ReconstructionProperties(bpy.types.PropertyGroup):
    """State of one reconstruction, on its collection."""

    objects: CollectionProperty(type=ObjectItem)
    plan_choices: CollectionProperty(type=PlanChoice)
    active_object: IntProperty(name="Active Object", default=0, update=object_edits.active_changed, options=set())
    length: EnumProperty(name="Length", default="minutes", description="How long to train in all", items=[
        ("preview", "Preview", f"{PRESET_STEPS['preview']:,} steps: a first look, to see whether all is well"),
        ("standard", "Standard", f"{PRESET_STEPS['standard']:,} steps"),
        ("final", "Until It Stops Improving", "Until the error on held-out photos has flattened"),
        ("minutes", "Minutes", "As long as you say; a finished training can be extended")])
    minutes: FloatProperty(
        name="Minutes", default=5.0, min=0.1, soft_max=120.0, precision=1, step=50,
        description="How long to train in all. More gives a sharper result; a finished training can be extended")
    mode: EnumProperty(name="Model", default="explicit", items=[
        ("explicit", "Plain splats", "What Blender shows and the PLY holds is exactly the model"),
        ("view", "View-dependent", "As in the paper: splats change with the camera; the PLY is a fit")])
    sh_degree: IntProperty(name="SH Degree", default=1, min=0, max=3,
                           description="How much colours may change with the direction they are seen from")
    primitive: EnumProperty(name="Splats", default="3d", items=[
        ("3d", "Ellipsoids", "3D Gaussians: the best pictures"),
        ("2d", "Discs", "2D Gaussians: the best meshes, since discs lie on surfaces")])
    strategy: EnumProperty(name="Votes", default="majority", items=[
        ("majority", "Majority", "The object that most masks show at a point"),
        ("probability", "Probability", "Drawn by chance, in proportion to the votes"),
        ("correspondence", "Correspondence", "Only the photos in which COLMAP found the point")])
    max_size: IntProperty(name="Image Size", default=1600, min=64, soft_max=8192,
                          description="Larger photos are reduced to this longest side, in pixels")
    colour_by: EnumProperty(name="Color Points By", default="photo", items=[
        ("photo", "Photo", "Colors of the photos"), ("object", "Object", "Color of the object voted for")],
        update=lambda self, _context: colour_points_by(self.id_data, self.colour_by))
    # Kept where files made without the extension's properties have it, too.
    shown: EnumProperty(name="Show", items=[
        ("splats", "Splats", "The Gaussian splats", 0),
        ("meshes", "Meshes", "The textured meshes; objects that have none show their splats", 1),
        ("both", "Both", "Splats and meshes in the same place", 2)],
        get=lambda self: SHOWS.index(shown_kinds(self.id_data)),
        set=lambda self, value: show_kinds(self.id_data, SHOWS[value]))
    mesh_objects: EnumProperty(name="Objects", default="all", items=[
        ("all", "All", "Every object that is not left out; merged objects become one mesh"),
        ("selected", "Selected", "Those selected in the viewport, or else the active one of the list")])
    mesh_scene: BoolProperty(name="Whole Scene", description=(
        "Also one mesh of everything, hidden beside those of the objects"))
    mesh_faces: IntProperty(
        name="Faces", default=20_000, min=100, soft_max=200_000, step=1000,
        description="Most triangles of an object's mesh; that of the whole scene may have five times as many")
    mesh_closed: BoolProperty(name="Closed", default=True, description=(
        "Close each mesh where no camera saw the object, such as its underside; the attribute \"invented\" tells "
        "these faces"))
    texture_size: EnumProperty(name="Texture", default="auto", items=[
        ("auto", "Automatic", "As the photos' resolution asks for"), ("512", "512 px", ""), ("1024", "1024 px", ""),
        ("2048", "2048 px", ""), ("4096", "4096 px", "")], description="Side of the texture of each mesh")


def _is_reconstruction(_scene, collection) -> bool:
    return kind_of(collection) == "reconstruction"


class SceneProperties(bpy.types.PropertyGroup):
    """What a scene works on."""

    active: PointerProperty(type=bpy.types.Collection, name="Reconstruction", poll=_is_reconstruction,
                            description="The reconstruction that the panel works on")
    select_whole: BoolProperty(
        name="Select Whole Objects", default=True,
        description="Clicking one part of an object selects all of it, so that it moves as a whole")
    draw_splats: BoolProperty(
        name="Draw Splats", default=False, update=drawing.show,
        description="Show splats in the 3D viewports as they are rendered, instead of a preview by points")
    splat_colours: EnumProperty(name="Splat Colors", default="photo", items=[
        ("photo", "Photo", "Colors of the photos"), ("object", "Object", "Colors that stand for the objects")],
        update=drawing.redraw)


CLASSES = (ObjectItem, PlanChoice, ReconstructionProperties, SceneProperties)


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Collection.objectgs = PointerProperty(type=ReconstructionProperties)
    bpy.types.Scene.objectgs = PointerProperty(type=SceneProperties)


def unregister():
    del bpy.types.Scene.objectgs
    del bpy.types.Collection.objectgs
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
