# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures of meshes as images in Blender."""

from __future__ import annotations

from pathlib import Path

import bpy

from ..kinds import MESH_KEY, TEXTURE, mark


def load_texture(path: Path, name: str, key: str) -> bpy.types.Image:
    """Load a mesh's texture; a file that does not exist yet is shown as soon as it does.

    Args:
        path: the texture.
        name: the image's name in Blender.
        key: of the mesh, in meshes.json.
    """
    if path.is_file():
        image = bpy.data.images.load(str(path), check_existing=False)
    else:
        image = bpy.data.images.new(name, 1, 1)
        image.source = "FILE"
    image.name = name
    # Raw, since Blender visits every node of the file otherwise.
    image.filepath_raw = _stored_path(path)
    mark(image, TEXTURE)
    image[MESH_KEY] = key
    return image


def reload_texture(image: bpy.types.Image, path: Path) -> None:
    """Show the present content of a texture's file; an image that the user packed into the .blend is packed again."""
    packed = image.packed_file is not None
    if packed:
        image.unpack(method="REMOVE")
    image.filepath_raw = _stored_path(path)
    image.reload()
    if packed and path.is_file():
        image.pack()


def _stored_path(path: Path) -> str:
    """A path as the .blend stores it: relative to the .blend if the user prefers that and the .blend is saved."""
    if not bpy.data.filepath or not bpy.context.preferences.filepaths.use_relative_paths:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive
        return str(path)
