# SPDX-License-Identifier: GPL-3.0-or-later
"""Loading of mesh textures as Blender images."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..kinds import MESH_KEY, TEXTURE, mark


def load_texture(path: Path, name: str, key: str) -> bpy.types.Image:
    """Load a mesh's texture; if the file does not exist yet, return an image that refers to it.

    Args:
        path: the texture file.
        name: the image's name in Blender.
        key: the mesh's key in meshes.json.
    """
    if path.is_file():
        image = bpy.data.images.load(str(path), check_existing=False)
    else:
        image = bpy.data.images.new(name, 1, 1)
        image.source = "FILE"
    image.name = name
    # Setting `filepath` instead would make Blender visit every node in the file.
    image.filepath_raw = _stored_path(path)
    mark(image, TEXTURE)
    image[MESH_KEY] = key
    return image


def reload_texture(image: bpy.types.Image, path: Path) -> None:
    """Reload a texture from its file; one packed into the .blend stays packed, also without a file."""
    packed = image.packed_file is not None
    if packed and not path.is_file():
        return
    if packed:
        image.unpack(method="REMOVE")
    image.filepath_raw = _stored_path(path)
    image.reload()
    if packed:
        image.pack()


def _stored_path(path: Path) -> str:
    """Return a path relative to the .blend if the preferences ask for that and the .blend is saved; else unchanged."""
    if not bpy.data.filepath or not bpy.context.preferences.filepaths.use_relative_paths:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive
        return str(path)
