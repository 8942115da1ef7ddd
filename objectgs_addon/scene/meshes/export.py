# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of object meshes, including edits, with Blender's own exporters."""

from __future__ import annotations

import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ....backend.shared.errors import InputError
from ....backend.shared.formats.file_names import distinct_stems
from ....backend.shared.reconstruction.folder import Reconstruction
from ....backend.shared.reconstruction.objects import is_singular
from ... import scene
from ...blender.quiet import quiet
from ..edits.axes import AXES, map_to, part_axes
from ..kinds import parent_of
from ..object_collection import our_materials
from ..object_display import Objects
from .shading import lit

_EXPORTERS = {"glb": (bpy.ops.export_scene, "gltf"), "usdc": (bpy.ops.wm, "usd_export")}
"""File suffix -> the operator that exports it, which is in an add-on or a part of Blender that may be missing."""
_COARSEST = 1e-4
"""Largest rounding of positions in mesh files, relative to the size of the meshes."""
_SHEARED = 1e-5
"""Difference of location, rotation and scale from a placement, relative to its scale, from which on it has shear."""


def export(
    root: bpy.types.Collection, out: Path, suffix: str, ids: list[int] | None, per_object: bool, in_capture: bool
) -> list[Path]:
    """Write the meshes of objects and of their duplicates; removed objects and objects without a mesh are skipped.

    If no object has a mesh and all are chosen, meshes of the whole scene or of sets of objects are written: those that
    are shown, or else all.

    Args:
        root: the reconstruction's collection.
        out: the file, or with `per_object` the folder.
        suffix: file suffix, which selects the format: "glb", "usdc", or another for OBJ.
        ids: object IDs, or None for all.
        per_object: write one file per object.
        in_capture: use COLMAP's coordinates and axes instead of Blender's.

    Returns:
        The written files.

    Raises:
        InputError: There is nothing to write, a mesh is in Edit Mode, Blender lacks the exporter, or `out` is a file
            where a folder is needed.
        OSError: A file cannot be written.
        RuntimeError: The exporter failed.
    """
    collections, copies = scene.object_collections(root), scene.duplicates_of(root)
    chosen = [
        object_id
        for object_id in sorted(scene.object_meshes(root))
        if (ids is None or object_id in ids) and not scene.is_removed(collections[object_id])
    ]
    whole = scene.scene_meshes(root) if ids is None and not scene.object_meshes(root) else []
    whole = [mesh for mesh in whole if not mesh.hide_render] or whole
    if not chosen and not whole:
        if not scene.object_meshes(root) and scene.scene_meshes(root):
            raise InputError("The only meshes are of the whole scene or of sets of objects; choose All for Objects.")
        raise InputError(
            "No chosen object has a mesh, or all of them are removed; extract meshes, or choose other objects."
        )
    if suffix in _EXPORTERS and _EXPORTERS[suffix][1] not in dir(_EXPORTERS[suffix][0]):
        raise InputError(
            f"This Blender has no exporter of {suffix.upper()} files; enable its add-on in the preferences, or choose "
            "another format."
        )
    if per_object and out.is_file():
        raise InputError(f"{out} is a file; choose another name for the folder.")
    named_parts: dict[int, tuple[str, list[tuple[bpy.types.Collection, bpy.types.Object]]]] = {
        object_id: (
            collections[object_id].name,
            [
                (collection, mesh)
                for collection in (collections[object_id], *copies.get(object_id, ()))
                for mesh in scene.parts_of(collection)
                if scene.kind_of(mesh) == "mesh"
            ],
        )
        for object_id in chosen
    } or {number: (mesh.name, [(root, mesh)]) for number, mesh in enumerate(whole)}
    parts_of = {out: [part for _, parts in named_parts.values() for part in parts]}
    if per_object:
        stems = distinct_stems({key: name for key, (name, _) in named_parts.items()})
        parts_of = {out / f"{stem}.{suffix}": named_parts[key][1] for key, stem in stems.items()}
    scene.require_object_mode(mesh for parts in parts_of.values() for _, mesh in parts if mesh.data.is_editmode)
    for path in parts_of:
        Reconstruction(scene.folder_of(root)).require_foreign(path)
    if in_capture:
        for parts in parts_of.values():
            _require_near(root, [mesh for _, mesh in parts])
    for path, parts in parts_of.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        # Other formats than GLB have textures beside them, where those of another file must not be replaced.
        prefix = "" if suffix == "glb" else f"{bpy.path.clean_name(path.stem)}_"
        bakes = not in_capture and suffix in _EXPORTERS  # OBJ files have no rotations.
        with lit(mesh for _, mesh in parts), _stage(root, parts, in_capture, bakes, prefix):
            _write(path, suffix, in_capture)
    return list(parts_of)


def summary(root: bpy.types.Collection, out: Path, files: list[Path], ids: list[int] | None) -> str:
    """Return the message for the user after `export`, which wrote `files`: what was written, and what was left out."""
    text = f"Wrote {files[0] if len(files) == 1 else f'{len(files)} files to {out}'}."
    meshes, objects = scene.object_meshes(root), Objects.read(scene.folder_of(root))
    without = [
        entry.name
        for entry in objects.entries.values()
        if entry.id not in meshes
        and objects.shown_as(entry.id) == entry.id
        and not entry.removed
        and (ids is None or entry.id in ids)
    ]
    if meshes and without:
        text += f" Left out, since they have no mesh: {', '.join(without)}."
    if any(
        scene.unobserved_splats(part.data).any()
        for object_id, collection in scene.object_collections(root).items()
        if not scene.is_removed(collection) and (ids is None or object_id in ids)
        for part in scene.parts_of(collection)
        if scene.kind_of(part) == "splats"
    ):
        text += (
            " The splats that fill the holes of removed and moved objects are not in meshes, which continue flat "
            "surfaces on their own."
        )
    return text


def _require_near(root: bpy.types.Collection, meshes: list[bpy.types.Object]) -> None:
    """Raise InputError if the numbers of mesh files cannot tell the vertices of meshes apart in capture coordinates."""
    places = [scene.matrix_to_capture(root, mesh) for mesh in meshes]
    rounding = max(float(np.abs(place[:3, 3]).max()) for place in places) * 2.0**-23
    corners = (np.array(mesh.bound_box) @ place[:3, :3].T for mesh, place in zip(meshes, places))
    size = max(float(np.ptp(each, axis=0).max()) for each in corners)
    if rounding > _COARSEST * size:
        raise InputError(
            f"In the capture's coordinates, mesh files would round positions to {rounding:.2g} units; choose Blender's "
            "coordinates."
        )


def _write(path: Path, suffix: str, in_capture: bool) -> None:
    with quiet():
        if suffix == "glb":
            bpy.ops.export_scene.gltf(
                filepath=str(path),
                export_format="GLB",
                export_yup=not in_capture,
                export_apply=True,
                use_active_scene=True,
                export_animations=False,
            )
        elif suffix == "usdc":
            # A mesh with the add-on's properties would be taken for the add-on's where it is imported.
            bpy.ops.wm.usd_export(
                filepath=str(path), export_materials=True, overwrite_textures=True, export_custom_properties=False
            )
        else:
            axes = {"forward_axis": "Y", "up_axis": "Z"} if in_capture else {}
            bpy.ops.wm.obj_export(filepath=str(path), path_mode="COPY", export_materials=True, **axes)


@contextmanager
def _stage(root: bpy.types.Collection, parts: Any, in_capture: bool, bakes: bool, prefix: str) -> Any:
    """Show a temporary scene with visible copies of the meshes in the window.

    With `bakes`, the capture's rotation and scale are part of the vertices, so that those of the copies are the user's.
    Recolored textures are replaced by recolored images, since exporters do not support the recolor node group. With a
    prefix, all textures are replaced by copies whose files' names begin with it.
    """
    windows = bpy.context.window_manager.windows
    window = bpy.context.window or windows[0]
    # Other windows may show the same scene.
    before = [(each, each.scene, each.view_layer) for each in windows]
    seen_from = [
        (region, region.view_perspective)
        for each in windows
        for area in each.screen.areas
        for space in area.spaces
        if space.type == "VIEW_3D"
        for region in (space.region_3d, *space.region_quadviews)
    ]
    stage = bpy.data.scenes.new("ObjectGS export")
    made: list[bpy.types.Object] = []
    turned: dict[tuple, bpy.types.Mesh] = {}
    copies: dict[bpy.types.Material, tuple[bpy.types.Material, list[bpy.types.Image]]] = {}
    names: dict[bpy.types.ID, str] = {}
    try:
        with tempfile.TemporaryDirectory() as folder:
            for collection, mesh in parts:
                obj = mesh.copy()
                made.append(obj)
                _take_name(obj, mesh, names)
                place = scene.matrix_to_capture(root, mesh) if in_capture else scene.matrix_to_world(mesh)
                obj.parent = None
                obj.constraints.clear()
                # Exporters evaluate other frames.
                obj.animation_data_clear()
                baked = _capture_axes(root, mesh) if bakes else np.eye(4)
                wanted = place @ np.linalg.inv(baked)
                obj.matrix_basis = Matrix(wanted.tolist())
                difference = np.array(obj.matrix_basis)[:3, :3] - wanted[:3, :3]
                if np.abs(difference).max() > _SHEARED * np.abs(wanted[:3, :3]).max():
                    # Location, rotation and scale cannot express shear.
                    baked, obj.matrix_basis = place, Matrix()
                if not np.array_equal(baked, np.eye(4)):
                    key = mesh.data, baked.tobytes()
                    if key not in turned:
                        turned[key] = mesh.data.copy()
                        _take_name(turned[key], mesh.data, names)
                        turned[key].transform(Matrix(baked.tolist()), shape_keys=True)
                        if np.linalg.det(baked[:3, :3]) < 0:
                            turned[key].flip_normals()
                    obj.data = turned[key]
                obj.hide_viewport = obj.hide_render = False
                stage.collection.objects.link(obj)
                recolor, ours = scene.recolor_of(collection), our_materials(mesh)
                for slot, own in zip(obj.material_slots, mesh.material_slots):
                    material = own.material
                    if material in ours and (prefix or recolor is not None):
                        if material not in copies:
                            copies[material] = scene.with_own_textures(material, recolor, Path(folder), prefix)
                            _take_name(copies[material][0], material, names)
                        material = copies[material][0]
                    slot.link, slot.material = "OBJECT", material
            window.scene = stage
            stage.view_layers[0].update()
            yield
    finally:
        for each, owner, layer in before:
            each.scene = owner
            each.view_layer = layer
        for region, perspective in seen_from:
            # A scene without a camera ends the view through it.
            region.view_perspective = perspective
        for obj in made:
            bpy.data.objects.remove(obj)
        for data in turned.values():
            bpy.data.meshes.remove(data)
        for copy, images in copies.values():
            bpy.data.materials.remove(copy)
            for image in images:
                bpy.data.images.remove(image)
        bpy.data.scenes.remove(stage)
        for original, name in names.items():
            if original.library is None:
                original.name = name


def _capture_axes(root: bpy.types.Collection, mesh: bpy.types.Object) -> np.ndarray:
    """Return the rotation and scale that a mesh has from the capture, (4, 4).

    It is that of the pivot's axes; meshes of the whole scene and objects of earlier versions have none of these.
    """
    if mesh.parent is not None and AXES in mesh.parent:
        return part_axes(mesh.parent)
    found, parent = np.eye(4), parent_of(root)
    if parent is not None:
        found[:3, :3] = map_to(parent, None)[:3, :3]
    return np.eye(4) if is_singular(found) else found


def _take_name(copy: bpy.types.ID, original: bpy.types.ID, names: dict[bpy.types.ID, str]) -> None:
    """Give a copy the original's name, which files use; `names` has the earlier names of all originals."""
    name = names.setdefault(original, original.name)
    if original.library is None:
        original.name = f"{name} (original)"
    copy.name = name
