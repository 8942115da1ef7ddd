"""Application of the edits of single splats, before those of objects."""

from __future__ import annotations

from dataclasses import replace

from ..model.splats import Splats
from ..shared.reconstruction.edits.splat_edits import missing_sentence, read_splat_edits
from ..shared.reconstruction.folder import Reconstruction
from ..shared.splats.keys import splat_keys


def apply_splat_edits(splats: Splats, folder: Reconstruction) -> tuple[Splats, list[str]]:
    """Apply a folder's edits of single splats: delete them, assign them to other objects, and crop the scene.

    Args:
        splats: The captured splats, as `read_splats` returns them.
        folder: The reconstruction.

    Returns:
        The edited splats, in the same order, and a warning if edits match none of the splats.

    Raises:
        InputError: splat-edits.ply is invalid.
    """
    edits = read_splat_edits(folder)
    if not edits:
        return splats, []
    applied = edits.apply(splat_keys(splats.means, splats.sh[:, 0]), splats.object_ids, splats.means)
    edited = replace(splats, object_ids=applied.object_ids).select(applied.kept)
    warnings = [missing_sentence(applied.missing, edits, folder.splat_edits)] if applied.missing else []
    return edited, warnings
