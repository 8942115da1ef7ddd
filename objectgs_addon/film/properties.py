# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of film frames in addition to the scene's own camera, resolution, frame range and motion blur."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

SUBFRAMES = 9
"""Default number of sub-frames, odd so that one is at the middle of the exposure."""


class FilmProperties(bpy.types.PropertyGroup):
    """Film settings of a scene."""

    folder: StringProperty(
        name="Output",
        subtype="DIR_PATH",
        description="Output folder of the film frames; if empty, the folder film in the reconstruction folder",
    )
    subframes: IntProperty(
        name="Sub-Frames",
        default=SUBFRAMES,
        min=2,
        soft_max=33,
        description="Number of time samples of a frame while the shutter is open",
    )
    png: BoolProperty(name="Also PNG", description="Also write each frame as an 8-bit PNG with alpha")


def folder_of(scene: bpy.types.Scene, reconstruction: Path) -> Path:
    """Return the output folder of the scene's film frames, by default `film` in the reconstruction folder."""
    chosen = scene.objectgs_film.folder
    return Path(bpy.path.abspath(chosen)) if chosen else reconstruction / "film"


def samples_of(scene: bpy.types.Scene, subframes: int = SUBFRAMES) -> int:
    """Return the number of sub-frames per frame, which is 1 without motion blur."""
    return subframes if scene.render.use_motion_blur else 1


def register() -> None:
    bpy.utils.register_class(FilmProperties)
    bpy.types.Scene.objectgs_film = PointerProperty(type=FilmProperties)


def unregister() -> None:
    del bpy.types.Scene.objectgs_film
    bpy.utils.unregister_class(FilmProperties)
