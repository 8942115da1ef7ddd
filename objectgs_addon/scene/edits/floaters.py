# SPDX-License-Identifier: GPL-3.0-or-later
"""Floaters: unlabeled splats inside removed objects, hidden by a carrier attribute.

The rule is the same as in the backend's export.
"""

import bmesh
import bpy
import numpy as np

from ....backend.shared.splats.convex_hull import points_inside, reliable_centers
from .. import carrier
from ..kinds import OBJECT_ID, SPLATS, object_collections, part_of
from ..object_collection import center_of
from ..shading.modifiers import update_groups
from ..shading.node_groups import HIDDEN
from .fills import given_way, unobserved_splats
from .single_splats import deleted_splats

FLATTEST = 1e-5
"""A hull that is thinner than this, relative to its length, counts as flat and has no interior."""
TOLERANCE = 1e-5
"""Largest distance of a hull's corner outside one of its faces, relative to the hull's size."""


def hide_floaters(root: bpy.types.Collection, removed: list[int]) -> None:
    """Hide the unlabeled splats inside the removed objects with these IDs, and show all other unlabeled splats."""
    collections = object_collections(root)
    carriers = {object_id: part_of(collection, SPLATS) for object_id, collection in collections.items()}
    unlabeled = carriers.pop(0, None)
    if unlabeled is None or "radiance:base" not in unlabeled.data.attributes:
        return
    before = hidden_splats(unlabeled.data)
    if not removed and before is None:
        return
    places = _places(unlabeled)
    hidden = np.zeros(len(places), bool)
    for object_id in removed:
        obj = carriers.get(object_id)
        if obj is not None and "radiance:base" in obj.data.attributes:
            own = ~deleted_splats(obj.data)
            hidden |= inside_hull(places, _places(obj)[own], carrier.read(obj.data, "radiance:base")[own, 3])
    # Objects merged into the unlabeled rest keep their own IDs and are not floaters.
    hidden &= (carrier.read(unlabeled.data, OBJECT_ID) == 0) & ~unobserved_splats(unlabeled.data)
    hidden |= given_way(unlabeled.data) | deleted_splats(unlabeled.data)
    if np.array_equal(hidden, np.zeros(len(places), bool) if before is None else before):
        return
    carrier.require_object_mode([unlabeled])
    update_groups(unlabeled)
    carrier.write(unlabeled.data, HIDDEN, "BOOLEAN", hidden)
    unlabeled.data.update()


def hidden_splats(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return an (n,) bool mask of a carrier's individually hidden splats, or None if there are none."""
    if HIDDEN not in mesh.attributes:
        return None
    hidden = carrier.read(mesh, HIDDEN)
    return hidden if hidden.any() else None


def inside_hull(points: np.ndarray, means: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Return which points lie inside the convex hull of an object's reliable splats, as in the backend.

    Args:
        points: (n, 3) points to test.
        means: (m, 3) means of the object's splats.
        opacities: (m,) opacities of the object's splats.

    Returns:
        (n,) bool mask.
    """
    means = reliable_centers(means, opacities)
    if len(means) < 4:
        return np.zeros(len(points), bool)
    middle = np.median(means, axis=0)
    planes = _planes(means - middle)
    return points_inside(points - middle, planes) if len(planes) else np.zeros(len(points), bool)


def _planes(corners: np.ndarray) -> np.ndarray:
    """Return the planes (p, 4) of the convex hull of `corners` (k, 3), k >= 4; empty for a flat hull.

    Each plane has an outward normal and an offset. Planes are computed from `corners`, since Blender's coordinates are
    single precision; degenerate faces are skipped.
    """
    spread = np.sqrt(np.clip(np.linalg.eigvalsh(np.cov(corners.T)), 0.0, None))
    if spread[0] <= FLATTEST * spread[2]:
        return np.zeros((0, 4))
    shape = bmesh.new()
    try:
        mesh = bpy.data.meshes.new("hull")
        try:
            mesh.vertices.add(len(corners))
            mesh.vertices.foreach_set("co", corners.astype(np.float32).reshape(-1))
            shape.from_mesh(mesh)
        finally:
            bpy.data.meshes.remove(mesh)
        found = bmesh.ops.convex_hull(shape, input=shape.verts, use_existing_faces=False)["geom"]
        faces = [[vertex.index for vertex in face.verts] for face in found if isinstance(face, bmesh.types.BMFace)]
    finally:
        shape.free()
    triangles = np.array([(face[0], face[i], face[i + 1]) for face in faces for i in range(1, len(face) - 1)], int)
    if not len(triangles):
        return np.zeros((0, 4))
    first, second, third = (corners[triangles[:, i]] for i in range(3))
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1)
    longest = np.maximum(np.linalg.norm(second - first, axis=1), np.linalg.norm(third - first, axis=1))
    good = lengths > 1e-6 * longest**2
    normals, first = normals[good] / lengths[good, None], first[good]
    hull = corners[np.unique(triangles)]
    beyond = normals @ hull.T - np.sum(normals * first, axis=1)[:, None]
    # Orient the normals to the side without corners.
    flipped = beyond.max(1) > -beyond.min(1)
    normals[flipped] *= -1.0
    outermost = np.where(flipped, -beyond.min(1), beyond.max(1))
    size = np.ptp(hull, axis=0).max()
    planes = np.column_stack([normals, -np.sum(normals * first, axis=1)])
    return planes[outermost <= TOLERANCE * size]


def _places(obj: bpy.types.Object) -> np.ndarray:
    """Return the captured positions of a carrier's splats in reconstruction coordinates, (n, 3) float64."""
    center = center_of(obj.parent) if obj.parent is not None else np.zeros(3)
    return carrier.read(obj.data, "position").astype(np.float64) + center
