# SPDX-License-Identifier: GPL-3.0-or-later
"""The command `export-meshes`."""

from __future__ import annotations

import argparse

from ...backend.shared.errors import InputError
from ...backend.shared.reconstruction.folder import Reconstruction
from ...backend.shared.reconstruction.objects import find_object, read_objects
from ..scene.meshes import export as mesh_export
from .commands import absolute, show_reconstruction

FORMATS = ("glb", "usdc", "obj")


def export_meshes(options: argparse.Namespace) -> None:
    """Write the meshes of a reconstruction with all edits; with --per-object, a folder named as --out."""
    folder, out = absolute(options.folder), absolute(options.out)
    suffix = out.suffix[1:].lower()
    if suffix not in FORMATS:
        raise InputError(f"{out} has no known format of meshes; name it .glb, .usdc or .obj.")
    root = show_reconstruction(folder, options.reporter)
    path, ids = Reconstruction(folder).objects, None
    if options.objects:
        objects = read_objects(path)
        ids = [find_object(objects, word, path).id for word in options.objects]
    out = out.with_suffix("") if options.per_object else out
    try:
        files = mesh_export.export(root, out, suffix, ids, options.per_object, options.coordinates == "capture")
    except RuntimeError as error:
        raise InputError(f"{out} could not be written; check its folder and the free space.") from error
    options.reporter.status(mesh_export.summary(root, out, files, ids))
