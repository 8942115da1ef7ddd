# SPDX-License-Identifier: GPL-3.0-or-later
"""Preview images of training: icons for the panel, an image for the Image Editor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import bpy.utils.previews

from ...backend.shared.reconstruction.folder import Reconstruction

COMPARISON = "latest"
"""Name of the photo, render and objects side by side, for the Image Editor."""
RENDER = "render"
"""Name of the render alone, for the panel."""
CURVE = "curve"
"""Name of the plot of PSNR over the run time, for the panel."""

_icons: Any = None
_shown: dict[str, tuple[str, int]] = {}
"""Folder and name -> path and modification time (ns) of the image in the icon."""


def path_of(folder: Path, name: str) -> Path | None:
    """Return the newest preview named `name`, a PNG or JPEG file, or None."""
    found = [
        (path.stat().st_mtime_ns, path)
        for suffix in (".png", ".jpg")
        if (path := Reconstruction(folder).previews / (name + suffix)).is_file()
    ]
    return max(found)[1] if found else None


def icon_of(folder: Path, name: str) -> int:
    """Return the icon value, for layouts, of the newest preview named `name`; 0 without a preview."""
    global _icons
    path = path_of(folder, name)
    if path is None:
        return 0
    if _icons is None:
        _icons = bpy.utils.previews.new()
    key, state = str(folder / name), (str(path), path.stat().st_mtime_ns)
    if _shown.get(key) != state:
        if key in _icons:
            del _icons[key]
        _icons.load(key, str(path), "IMAGE")
        _shown[key] = state
    return _icons[key].icon_id


def image_of(folder: Path) -> bpy.types.Image:
    """Return the image data-block of the newest preview in `folder`; create it if needed."""
    image = next(iter(_images_of(folder)), None)
    if image is None:
        image = bpy.data.images.load(str(path_of(folder, COMPARISON)))
        image.name = f"{folder.name} preview"
        image["objectgs_preview"] = str(folder)
    refresh(folder)
    return image


def refresh(folder: Path) -> None:
    """Reload the preview image data-blocks of a reconstruction folder."""
    path = path_of(folder, COMPARISON)
    for image in _images_of(folder):
        if path is not None:
            if image.filepath != str(path):
                image.filepath = str(path)
            image.reload()


def _images_of(folder: Path) -> list[bpy.types.Image]:
    return [image for image in bpy.data.images if image.get("objectgs_preview") == str(folder)]


def clear() -> None:
    """Remove all icons."""
    global _icons
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None
    _shown.clear()
