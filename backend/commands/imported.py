"""Files of reconstructions whose splats are those of another program."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..export import write_splats
from ..model.splats import Splats
from ..shared.color.palette import object_colors
from ..shared.events import Reporter
from ..shared.reconstruction.folder import Reconstruction
from ..shared.reconstruction.objects import default_name, write_objects


def write_labeled(
    folder: Reconstruction, splats: Splats, ids: np.ndarray, names: Mapping[int, str], reporter: Reporter
) -> None:
    """Write splats.ply with other objects, and objects.json.

    Args:
        folder: the reconstruction.
        splats: the splats, which get the objects.
        ids: (N,) the ID of each splat's object.
        names: names of objects by ID.
        reporter: receives warnings.
    """
    splats.object_ids = ids
    for sentence in write_splats(folder.splats, splats):
        reporter.warning(sentence)
    write_objects_of(folder, splats, names)


def write_objects_of(folder: Reconstruction, splats: Splats, names: Mapping[int, str]) -> int:
    """Write objects.json for the objects that splats have.

    Args:
        folder: the reconstruction.
        splats: the splats with their objects' IDs.
        names: names of objects by ID; others get a default name.

    Returns:
        The number of objects.
    """
    found, counts = np.unique(splats.object_ids[splats.object_ids > 0], return_counts=True)
    colors = object_colors(found)
    objects = [
        {"id": i, "name": names.get(i) or default_name(i), "color": list(colors[i]), "points": n}
        for i, n in zip(found.tolist(), counts.tolist(), strict=True)
    ]
    write_objects(folder.objects, objects)
    return len(objects)
