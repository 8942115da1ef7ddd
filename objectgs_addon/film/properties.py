# SPDX-License-Identifier: GPL-3.0-or-later
"""Settings of film frames in addition to the scene's own camera, resolution, frame range and motion blur."""

import os
from pathlib import Path

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from ..environment import known_folders
from ..scene.kinds import RECONSTRUCTION, is_linked, kind_of

SUBFRAMES = 9
"""Default number of sub-frames, odd so that one is at the middle of the exposure."""


# From Blender 4.5 on, file browsers offer a path relative to the .blend only with this option.
_RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()


def _folder_chosen(settings: bpy.types.PropertyGroup, _context: bpy.types.Context) -> None:
    """Remember an output folder that the user has typed or chosen; Blender does not call this for one of a file."""
    if settings.folder:
        known_folders.remember(Path(bpy.path.abspath(settings.folder)))


class FilmProperties(bpy.types.PropertyGroup):
    """Film settings of a scene."""

    folder: StringProperty(
        name="Output",
        subtype="DIR_PATH",
        options=_RELATIVE,
        update=_folder_chosen,
        description="Output folder of the film frames; if empty, the folder film in the reconstruction folder. With "
        "several reconstructions in the scene, each has a folder in it",
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
    """Return the output folder of a reconstruction's film frames, by default `film` in the reconstruction folder.

    In a scene with several reconstructions that can be filmed, each has a folder of its own in the output folder.
    """
    folder = _chosen_folder(scene)
    if folder is None:
        return reconstruction / "film"
    count = sum(kind_of(each) == RECONSTRUCTION and not is_linked(each) for each in scene.collection.children_recursive)
    return folder / reconstruction.name if count > 1 else folder


def _chosen_folder(scene: bpy.types.Scene) -> Path | None:
    chosen = scene.objectgs_film.folder
    return Path(os.path.normpath(bpy.path.abspath(chosen))) if chosen else None


def is_accepted(scene: bpy.types.Scene, reconstruction: Path) -> bool:
    """Return whether film frames may be written to the output folder without asking the user."""
    folder, chosen = folder_of(scene, reconstruction), _chosen_folder(scene)
    is_chosen = chosen is not None and known_folders.is_known(chosen)
    return is_chosen or known_folders.is_known(folder) or folder.is_relative_to(reconstruction)


def samples_of(scene: bpy.types.Scene, subframes: int = SUBFRAMES) -> int:
    """Return the number of sub-frames per frame, which is 1 without motion blur."""
    return subframes if scene.render.use_motion_blur else 1


def register() -> None:
    bpy.utils.register_class(FilmProperties)
    bpy.types.Scene.objectgs_film = PointerProperty(type=FilmProperties)


def unregister() -> None:
    del bpy.types.Scene.objectgs_film
    bpy.utils.unregister_class(FilmProperties)
