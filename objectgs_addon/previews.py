# SPDX-License-Identifier: GPL-3.0-or-later
"""What training looks like right now: an icon for the panel, an image for the Image Editor."""

from pathlib import Path

import bpy
import bpy.utils.previews

from .jobs import Job

_icons = None
_written: dict[str, int] = {}
"""Folder -> when the picture that its icon shows was written."""


def update(job: Job) -> None:
    """Take the job's preview picture if it is a newer one."""
    global _icons
    if _icons is None:
        _icons = bpy.utils.previews.new()
    key = str(job.folder)
    try:
        written = job.preview.stat().st_mtime_ns
    except OSError:
        return
    if _written.get(key) == written:
        return
    _written[key] = written
    if key in _icons:
        del _icons[key]
    _icons.load(key, str(job.preview), "IMAGE")
    for image in bpy.data.images:
        if image.get("objectgs_preview") == key:
            image.reload()


def icon_of(folder: Path) -> int:
    """The icon's number for layouts; 0 where there is no preview yet."""
    return _icons[str(folder)].icon_id if _icons is not None and str(folder) in _icons else 0


def image_of(folder: Path, picture: Path):
    """The image that follows the training in `folder`; made where it is not there."""
    for image in bpy.data.images:
        if image.get("objectgs_preview") == str(folder):
            image.reload()
            return image
    image = bpy.data.images.load(str(picture))
    image.name = f"{folder.name} preview"
    image["objectgs_preview"] = str(folder)
    return image


def clear() -> None:
    """Forget all icons."""
    global _icons
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None
    _written.clear()
