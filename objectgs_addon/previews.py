# SPDX-License-Identifier: GPL-3.0-or-later
"""What training looks like right now: an icon for the panel, an image for the Image Editor."""

from pathlib import Path

import bpy
import bpy.utils.previews

from ..backend.protocol import Reconstruction

COMPARISON = "latest"
"""Photo, render and objects side by side, for the Image Editor."""
RENDER = "render"
"""The render alone, for the panel."""
CURVE = "curve"
"""PSNR over the run time, for the panel."""

_icons = None
_shown: dict[str, tuple[str, int]] = {}
"""Folder and name -> picture that its icon shows, and when that was written."""


def picture_of(folder: Path, name: str) -> Path | None:
    """The newest preview of that name: PNG, or JPEG where that would be large; None where there is none yet."""
    found = [(path.stat().st_mtime_ns, path) for suffix in (".png", ".jpg")
             if (path := Reconstruction(folder).previews / (name + suffix)).is_file()]
    return max(found)[1] if found else None


def icon_of(folder: Path, name: str) -> int:
    """The number, for layouts, of an icon that shows the newest preview of that name; 0 where there is none yet."""
    global _icons
    picture = picture_of(folder, name)
    if picture is None:
        return 0
    if _icons is None:
        _icons = bpy.utils.previews.new()
    key, state = str(folder / name), (str(picture), picture.stat().st_mtime_ns)
    if _shown.get(key) != state:
        if key in _icons:
            del _icons[key]
        _icons.load(key, str(picture), "IMAGE")
        _shown[key] = state
    return _icons[key].icon_id


def image_of(folder: Path):
    """The image that follows the training in `folder`; made where it is not there."""
    image = next(iter(_images_of(folder)), None)
    if image is None:
        image = bpy.data.images.load(str(picture_of(folder, COMPARISON)))
        image.name = f"{folder.name} preview"
        image["objectgs_preview"] = str(folder)
    refresh(folder)
    return image


def refresh(folder: Path) -> None:
    """Let the images that follow a training show its newest picture."""
    picture = picture_of(folder, COMPARISON)
    for image in _images_of(folder):
        if picture is not None:
            if image.filepath != str(picture):
                image.filepath = str(picture)
            image.reload()


def _images_of(folder: Path) -> list:
    return [image for image in bpy.data.images if image.get("objectgs_preview") == str(folder)]


def clear() -> None:
    """Forget all icons."""
    global _icons
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None
    _shown.clear()
