# SPDX-License-Identifier: GPL-3.0-or-later
"""How a scene's film frames are made; the rest is the scene's own: camera, size, frame range and motion blur."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

SUBFRAMES = 9
"""An odd number, so that one of them is in the middle of the shutter's time."""


class FilmProperties(bpy.types.PropertyGroup):
    """On the scene."""

    folder: StringProperty(
        name="Output", subtype="DIR_PATH",
        description="Folder of the film frames; empty: the folder film in the reconstruction's")
    subframes: IntProperty(
        name="Sub-Frames", default=SUBFRAMES, min=2, soft_max=33,
        description="Moments that make a frame while the shutter is open")
    png: BoolProperty(name="PNG Too", description="Each frame also as a picture of 8 bits with alpha")


def folder_of(scene, reconstruction: Path) -> Path:
    """Where the scene's film frames go."""
    chosen = scene.objectgs_film.folder
    return Path(bpy.path.abspath(chosen)) if chosen else reconstruction / "film"


def samples_of(scene, subframes: int = SUBFRAMES) -> int:
    """How many moments make a frame: one, unless the scene has motion blur."""
    return subframes if scene.render.use_motion_blur else 1


def register():
    bpy.utils.register_class(FilmProperties)
    bpy.types.Scene.objectgs_film = PointerProperty(type=FilmProperties)


def unregister():
    del bpy.types.Scene.objectgs_film
    bpy.utils.unregister_class(FilmProperties)
