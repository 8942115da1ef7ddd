# SPDX-License-Identifier: GPL-3.0-or-later
"""Import of mesh files as Blender objects, created or updated in the collections of their objects."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ....backend.shared.color.palette import to_linear
from ....backend.shared.errors import InputError
from ....backend.shared.formats.mesh_ply import Mesh, read_mesh
from ....backend.shared.formats.splat_ply import UNOBSERVED
from .. import carrier
from ..capture import origin_of
from ..edits.axes import attach, put_below
from ..edits.placement import move_to_transforms
from ..kinds import ANCHORS, MESH, MESH_COLORS, MESH_KEY, OBJECT_PARENT, SPLATS, adopt, mark, parent_of, part_of
from ..object_collection import NAME, center_of, ensure_pivot, new_collection, textures_of
from ..object_display import Objects
from ..shading.materials import mesh_material
from .listed import ListedMesh, stamp_of
from .shading import shading_of
from .textures import load_texture, reload_texture

WRITTEN = "objectgs_written"
"""Custom property of a mesh object: the stamps of the mesh file and the texture that it shows, with a space between."""

UV_MAP = "UVMap"


class MeshImporter:
    """Importer of meshes into the collections of a reconstruction.

    Attributes:
        changed: IDs of the objects whose collections gained or lost a mesh; None for the reconstruction's own.
        new: IDs of the objects whose collections were created; these are not linked yet.
        warnings: warnings about missing textures.
    """

    def __init__(
        self, root: bpy.types.Collection, objects: Objects, collections: dict[int, bpy.types.Collection]
    ) -> None:
        self.root, self.objects, self.collections = root, objects, collections
        self.origin = origin_of(root)
        self.parent = parent_of(root)
        self.changed: set[int | None] = set()
        self.new: list[int] = []
        self.warnings: list[str] = []
        self._material: bpy.types.Material | None = None

    def show(self, listed: ListedMesh, target: int | None, obj: bpy.types.Object | None) -> bool:
        """Create or update one mesh.

        Args:
            listed: the mesh and its files.
            target: ID of the object whose collection receives the mesh; None for the reconstruction's own.
            obj: the Blender object that already shows the mesh, or None.

        Returns:
            Whether its geometry or its texture was updated.

        Raises:
            InputError: The mesh's file cannot be shown; nothing is changed.
        """
        collection = self.root if target is None else self.collections.get(target)
        in_place = obj is not None and collection is not None and _contains(collection, obj)
        before = "" if obj is None else str(obj.get(WRITTEN, ""))
        known_mesh, _, known_texture = before.partition(" ")
        mesh_stamp, same_mesh = stamp_of(listed.mesh, known_mesh)
        texture_stamp, same_texture = stamp_of(listed.texture, known_texture)
        written = f"{mesh_stamp} {texture_stamp}"
        has_pivot = target is None or (in_place and part_of(collection, OBJECT_PARENT) is not None)
        if obj is not None and in_place and has_pivot and same_mesh:
            is_new = not same_texture or (listed.texture.is_file() and any(map(_is_lost, _textures(obj))))
            if is_new:
                self._update_texture(obj, listed)
            if written != before:
                obj[WRITTEN] = written
            return is_new
        loaded = _read(listed)
        positions = loaded.vertices - self.origin
        if target is not None and collection is None:
            collection = self.collections[target] = new_collection(target, self.objects)
            adopt(collection, self.root, (OBJECT_PARENT, SPLATS, ANCHORS, MESH), target)
            in_place = obj is not None and _contains(collection, obj)
            self.new.append(target)
        pivot, center = self.parent, np.zeros(3)
        if target is not None:
            pivot = ensure_pivot(collection, self.parent, target, positions)
            center = center_of(pivot)
        if obj is None:
            obj = self._new(listed, target, collection)
            put_below(obj, pivot)
        elif not in_place:
            self.unlink(obj)
            collection.objects.link(obj)
            mark(obj, MESH, target)
            self.changed.add(target)
            attach(obj, pivot)
        move_to_transforms(obj.data)
        fill_mesh(obj.data, positions - center, loaded)
        self._update_texture(obj, listed)
        obj[WRITTEN] = written
        return True

    def unlink(self, obj: bpy.types.Object) -> None:
        """Unlink a mesh from its collection after a merge, a split or a removal."""
        for object_id, collection in ((None, self.root), *self.collections.items()):
            if _contains(collection, obj):
                collection.objects.unlink(obj)
                self.changed.add(object_id)

    def _new(self, listed: ListedMesh, target: int | None, collection: bpy.types.Collection) -> bpy.types.Object:
        name = listed.name
        if target is not None:
            name = collection[NAME] if str(target) == listed.key else self.objects.name(int(listed.key))
        obj = bpy.data.objects.new(f"{name} {MESH}", bpy.data.meshes.new(f"{name} {MESH}"))
        mark(obj, MESH, target)
        obj[MESH_KEY] = listed.key
        if target is None:
            obj.hide_viewport = obj.hide_render = True
        else:
            obj.color = (*to_linear(self.objects.rgb(target)), 1.0)
        collection.objects.link(obj)
        self.changed.add(target)
        return obj

    def _update_texture(self, obj: bpy.types.Object, listed: ListedMesh) -> None:
        if not listed.texture.is_file() and not any(image.packed_file for image in _textures(obj)):
            self.warnings.append(f"{listed.texture} is missing, so {obj.name} has no texture; extract the mesh again.")
        self._update_material(obj, listed)

    def _update_material(self, obj: bpy.types.Object, listed: ListedMesh) -> None:
        """Add the add-on's material to a mesh without materials; otherwise only reload the add-on's textures."""
        if not obj.material_slots:
            image = load_texture(listed.texture, obj.name, listed.key)
            self._material = material = mesh_material(obj.name, image, self._material, shading_of(self.root))
            material.diffuse_color = obj.color
            obj.data.materials.append(material)
            return
        for image in _textures(obj):
            reload_texture(image, listed.texture)


def _textures(obj: bpy.types.Object) -> list[bpy.types.Image]:
    """Return the add-on's textures of a mesh, without those of other meshes in the user's own materials."""
    images = dict.fromkeys(image for slot in obj.material_slots for image in textures_of(slot.material))
    return [image for image in images if image.get(MESH_KEY) == obj.get(MESH_KEY)]


def _is_lost(image: bpy.types.Image) -> bool:
    """Return whether an image's file is missing, as where the .blend or the reconstruction folder was moved alone."""
    return image.packed_file is None and not Path(bpy.path.abspath(image.filepath, library=image.library)).is_file()


def fill_mesh(mesh: bpy.types.Mesh, positions: np.ndarray, loaded: Mesh) -> None:
    """Replace the geometry of a mesh and keep its materials.

    Args:
        mesh: the Blender mesh.
        positions: (V, 3) positions of the new vertices in the mesh's local coordinates.
        loaded: the new faces, UV map, vertex colors, normals and flags of unobserved faces.
    """
    if mesh.shape_keys is not None:
        for user in [obj for obj in bpy.data.objects if obj.data == mesh]:
            user.shape_key_clear()  # Shape keys belong to the old vertices.
    mesh.clear_geometry()
    count = len(loaded.faces)
    mesh.vertices.add(len(positions))
    mesh.loops.add(3 * count)
    mesh.polygons.add(count)
    carrier.write(mesh, "position", "FLOAT_VECTOR", positions)
    mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(loaded.faces, np.int32).reshape(-1))
    uvs = mesh.uv_layers.new(name=UV_MAP, do_init=False)
    uvs.uv.foreach_set("vector", np.nan_to_num(loaded.uvs).astype(np.float32).reshape(-1))
    colors = mesh.color_attributes.new(MESH_COLORS, "BYTE_COLOR", "POINT")
    rgba = np.ones((len(positions), 4), np.float32)
    rgba[:, :3] = loaded.colors / np.float32(255.0)
    colors.data.foreach_set("color_srgb", rgba.reshape(-1))
    mesh.color_attributes.active_color = colors
    unobserved = mesh.attributes.new(UNOBSERVED, "BOOLEAN", "FACE")
    unobserved.data.foreach_set("value", np.ascontiguousarray(loaded.unobserved, bool))
    mesh.update(calc_edges=True)
    # Removes faces that use a vertex twice, which would crash Blender's tools.
    mesh.validate(clean_customdata=False)
    mesh.normals_split_custom_set_from_vertices(np.nan_to_num(loaded.normals))
    mesh.update()
    carrier.remember_positions(mesh)


def _read(listed: ListedMesh) -> Mesh:
    loaded = read_mesh(listed.mesh)
    if not len(loaded.faces) or not np.isfinite(loaded.vertices).all():
        raise InputError(f"{listed.mesh} contains no surface; extract the meshes again.")
    return loaded


def _contains(collection: bpy.types.Collection, obj: bpy.types.Object) -> bool:
    return collection.objects.get(obj.name) == obj
