# SPDX-License-Identifier: GPL-3.0-or-later
"""Floaters, hidden by a carrier attribute: those of cleaned objects, and unlabeled splats inside removed objects.

The rules are the same as in the backend's export.
"""

from collections.abc import Mapping

import bmesh
import bpy
import numpy as np

from ....backend.shared.reconstruction.objects import SceneObject
from ....backend.shared.splats.convex_hull import points_inside, reliable_centers
from ....backend.shared.splats.floaters import distant, floating, near_sphere
from .. import carrier
from ..kinds import OBJECT_ID, OBJECT_PARENT, SPLATS, collection_of, object_collections, part_of, points_of
from ..object_collection import center_of
from ..shading.modifiers import update_groups
from ..shading.node_groups import COVERED, DISTANT, FLOATING, HIDDEN
from .fills import given_way, unobserved_splats
from .single_splats import deleted_splats

FLATTEST = 1e-5
"""A hull that is thinner than this, relative to its length, counts as flat and has no interior."""
TOLERANCE = 1e-5
"""Largest distance of a hull's corner outside one of its faces, relative to the hull's size."""


def hide_floaters(root: bpy.types.Collection, entries: Mapping[int, SceneObject]) -> None:
    """Hide the floaters of cleaned objects and the unlabeled splats inside removed ones, and show all other splats.

    Args:
        root: the reconstruction's collection.
        entries: object ID -> object with the user's edits.

    Raises:
        InputError: Splats that would change are in Edit Mode.
    """
    changes = _changes(root, entries)
    carrier.require_object_mode(obj for obj, _ in changes)
    for obj, hidden in changes:
        update_groups(obj)
        carrier.write(obj.data, HIDDEN, "BOOLEAN", hidden)
        obj.data.update()


def mark_floaters(obj: bpy.types.Object, positions: np.ndarray) -> None:
    """Store which splats of a newly filled carrier are floaters.

    Args:
        obj: the carrier.
        positions: (n, 3) float64 positions of its splats, in any coordinates.
    """
    kept = ~deleted_splats(obj.data)
    found = np.zeros(len(positions), bool)
    found[kept] = floating(positions[kept])
    if found.any():
        update_groups(obj)
    carrier.write(obj.data, FLOATING, "BOOLEAN", found)


def update_floaters(obj: bpy.types.Object) -> None:
    """Find the floaters of a carrier again after some of its splats were deleted."""
    found = _found(obj.data)
    if found.any():
        update_groups(obj)
    carrier.write(obj.data, FLOATING, "BOOLEAN", found)


def _found(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return which captured splats of a carrier float among those that are not deleted, (n,) bool."""
    captured = np.flatnonzero(~unobserved_splats(mesh) & ~deleted_splats(mesh))
    found = np.zeros(len(mesh.vertices), bool)
    found[captured] = floating(carrier.read(mesh, "position")[captured].astype(np.float64))
    return found


def near_sphere_of(root: bpy.types.Collection) -> tuple[np.ndarray, float]:
    """Return the `near_sphere` of the capture's points relative to the reconstruction's origin."""
    points = points_of(root)
    return near_sphere(np.zeros((0, 3)) if points is None else carrier.read(points.data, "position"))


def mark_distant(obj: bpy.types.Object, positions: np.ndarray, sphere: tuple[np.ndarray, float]) -> None:
    """Store which splats of a newly filled carrier show distant surroundings.

    Args:
        obj: the carrier.
        positions: (n, 3) float64 positions of its splats relative to the reconstruction's origin.
        sphere: what `near_sphere_of` returns for the reconstruction.
    """
    found = distant(positions, *sphere)
    if found.any() or DISTANT in obj.data.attributes:
        update_groups(obj)
        carrier.write(obj.data, DISTANT, "BOOLEAN", found)


def floating_splats(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return an (n,) bool mask of a carrier's floaters, hidden or not."""
    if FLOATING in mesh.attributes:
        return carrier.read(mesh, FLOATING)
    return _found(mesh)  # The carrier is of an older version.


def floater_counts(root: bpy.types.Collection) -> dict[int, int]:
    """Map object IDs to the numbers of their floaters, hidden or not."""
    carriers = {object_id: part_of(collection, SPLATS) for object_id, collection in object_collections(root).items()}
    return {object_id: int(floating_splats(obj.data).sum()) for object_id, obj in carriers.items() if obj is not None}


def _changes(
    root: bpy.types.Collection, entries: Mapping[int, SceneObject]
) -> list[tuple[bpy.types.Object, np.ndarray]]:
    """Return the carriers whose hidden splats change, and which of their splats are hidden then."""
    carriers = {
        object_id: obj
        for object_id, collection in object_collections(root).items()
        if (obj := part_of(collection, SPLATS)) is not None
        and obj.data.library is None
        and "radiance:base" in obj.data.attributes
    }
    removed = [
        carriers[entry.id] for entry in entries.values() if entry.removed and entry.floaters and entry.id in carriers
    ]
    found = []
    for object_id, obj in carriers.items():
        cleaned = object_id in entries and entries[object_id].cleaned
        before = carrier.read(obj.data, HIDDEN) if HIDDEN in obj.data.attributes else None
        if before is None and not cleaned and not (object_id == 0 and removed):
            continue
        hidden = given_way(obj.data) | deleted_splats(obj.data)
        if cleaned:
            hidden |= floating_splats(obj.data)
        if object_id == 0:
            hidden |= _inside(obj, removed)
        if not np.array_equal(hidden, np.zeros(len(hidden), bool) if before is None else before):
            found.append((obj, hidden))
    return found


def _inside(unlabeled: bpy.types.Object, removed: list[bpy.types.Object]) -> np.ndarray:
    """Return which splats of the unlabeled rest are of no object and inside one of the removed carriers, (n,) bool."""
    places = _places(unlabeled)
    found = np.zeros(len(places), bool)
    for obj in removed:
        own = ~deleted_splats(obj.data)
        found |= inside_hull(places, _places(obj)[own], carrier.read(obj.data, "radiance:base")[own, 3])
    # Objects merged into the unlabeled rest keep their own IDs and are not floaters.
    return found & (carrier.read(unlabeled.data, OBJECT_ID) == 0) & ~unobserved_splats(unlabeled.data)


def hidden_splats(mesh: bpy.types.Mesh) -> np.ndarray | None:
    """Return an (n,) bool mask of a carrier's individually hidden splats, or None if there are none."""
    reasons = [carrier.read(mesh, name) for name in (HIDDEN, COVERED) if name in mesh.attributes]
    hidden = np.logical_or.reduce(reasons) if reasons else None
    return hidden if hidden is not None and hidden.any() else None


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
    corners = means - middle
    planes = _planes(corners)
    return points_inside(points - middle, corners, planes) if len(planes) else np.zeros(len(points), bool)


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
    collection = collection_of(obj)
    pivot = part_of(collection, OBJECT_PARENT) if collection is not None else None
    center = center_of(pivot) if pivot is not None else np.zeros(3)
    return carrier.read(obj.data, "position").astype(np.float64) + center
