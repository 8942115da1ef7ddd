# SPDX-License-Identifier: GPL-3.0-or-later
"""Textured meshes: an object's lies in its collection, the whole scene's and those of sets in the reconstruction's."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ...backend.mesh_file import Mesh, read_mesh
from ...backend.palette import to_linear
from ...backend.protocol import InputError, Reconstruction, read_json
from . import carrier
from .capture import origin_of
from .edits import show_edits
from .kinds import (
    ANCHORS,
    MESH,
    MESH_KEY,
    MESH_MATERIAL,
    OBJECT_PARENT,
    SPLATS,
    TEXTURE,
    adopt,
    copies_of,
    kind_of,
    mark,
    object_collections,
    object_id_of,
    parent_of,
    parts_of,
)
from .object_collection import (
    NAME,
    centre_of,
    new_collection,
    pivot_of,
    remove,
    remove_if_empty,
    textures_of,
)
from .objects_file import Objects
from .places import into_world
from .preview import Graph

WRITTEN = "objectgs_written"
"""On a mesh: when the files that it shows were written."""
SHOW = "objectgs_show"
"""On the root: which of SHOWS it shows."""

SHOWS = ("splats", "meshes", "both")
UV_MAP, COLOURS, INVENTED = "UVMap", "Col", "invented"

ROUGHNESS = 0.8
SPECULAR = 0.2
"""The photos' highlights are in the texture already, so little is added to them."""


@dataclass
class ShownMeshes:
    """What `show_meshes` put into Blender: how many meshes there are now, how many of them were read just now."""

    meshes: int = 0
    updated: int = 0
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Entry:
    """A mesh that the folder holds: key in meshes.json, IDs it was made of (None: of everything), files, name."""

    key: str
    ids: tuple[int, ...] | None
    mesh: Path
    texture: Path
    name: str

    @property
    def is_object(self) -> bool:
        # A set may have a number for its name.
        return self.ids is not None and self.key.isdecimal() and int(self.key) in self.ids

    def written(self) -> str:
        """When its files were written, as text: Blender's integers are too short for nanoseconds."""
        return " ".join(_modified(path) for path in (self.mesh, self.texture))


def show_meshes(root: bpy.types.Collection, folder: Path) -> ShownMeshes:
    """As `update_meshes`, with all edits of the objects."""
    shown = update_meshes(root, folder)
    show_edits(root, Objects.read(folder))
    return shown


def update_meshes(root: bpy.types.Collection, folder: Path) -> ShownMeshes:
    """Show the meshes that meshes.json lists, each exactly where its splats are.

    What is there is updated in place where its files are newer: transforms, names, modifiers, materials and their
    slots stay as the user left them; a mesh whose files are the same is not touched at all. A mesh that was made of
    other objects than its collection shows now goes. Raises InputError, before anything is changed, where meshes.json
    or objects.json cannot be used; a mesh that cannot be read is a warning, and stays as it is.
    """
    folder = Path(folder)
    entries = _read_entries(folder)
    objects = Objects.read(folder)
    collections = object_collections(root)
    there = _meshes_of(root, collections)
    if not entries and not there:
        return ShownMeshes()
    carrier.require_object_mode(there.values())
    had_meshes = bool(there)
    wanted, warnings = _wanted(entries, objects)
    shown = ShownMeshes(warnings=warnings)
    maker = _Maker(root, objects, collections)
    for entry, target in wanted:
        thing = there.pop(entry.key, None)
        try:
            shown.updated += maker.show(entry, target, thing)
            shown.meshes += 1
        except InputError as error:
            shown.warnings.append(str(error))
            shown.meshes += thing is not None
    for thing in there.values():
        maker.leave(thing)
        remove(thing)
    shown.warnings += maker.warnings
    if SHOW not in root and shown.meshes:
        show_kinds(root, "meshes")
    elif maker.changed:
        # The unlabelled rest, which never has a mesh, follows the first mesh that comes and the last that goes.
        apply_shown(root, {*maker.changed, 0} if had_meshes != bool(shown.meshes) else maker.changed)
    for object_id in maker.changed:
        if object_id is not None and object_id not in maker.new:
            remove_if_empty(collections[object_id])
    for object_id in maker.new:
        root.children.link(collections[object_id])
    return shown


def has_shown_meshes(root: bpy.types.Collection) -> bool:
    """Whether the reconstruction ever showed meshes, so that there is a choice."""
    return SHOW in root


def shown_kinds(root: bpy.types.Collection) -> str:
    """Which of SHOWS a reconstruction shows."""
    chosen = root.get(SHOW)
    return chosen if chosen in SHOWS else SHOWS[0]


def show_kinds(root: bpy.types.Collection, which: str) -> None:
    """Show splats, meshes or both, in viewports and renders; an object without a mesh always shows its splats.

    Hiding single objects, by their collection or their eye, is left to the user and goes on top of this.
    """
    if which not in SHOWS:
        raise ValueError(f"{which} cannot be shown")
    root[SHOW] = which
    apply_shown(root, object_collections(root))


def apply_shown(root: bpy.types.Collection, changed) -> None:
    """Show what the reconstruction shows in the collections of IDs whose parts have come or gone."""
    which, collections, copies = shown_kinds(root), object_collections(root), copies_of(root)
    meshes, whole = object_meshes(root), scene_meshes(root)
    hidden = {} if meshes else {thing: which == "splats" for thing in whole}
    for object_id in set(changed) & set(collections):
        # The unlabelled rest would lie about between the meshes of the others.
        replaced = object_id in meshes or (object_id == 0 and bool(meshes or whole))
        both = (collections[object_id], *copies.get(object_id, ()))
        for thing in [thing for collection in both for thing in parts_of(collection)]:
            if kind_of(thing) == SPLATS:
                hidden[thing] = which == "meshes" and replaced
            elif kind_of(thing) == MESH:
                hidden[thing] = which == "splats"
    _hide(hidden)


def scene_meshes(root: bpy.types.Collection) -> list[bpy.types.Object]:
    """The meshes of the whole scene and of sets of objects, which lie in the reconstruction's own collection."""
    return [thing for thing in root.objects if kind_of(thing) == MESH and object_id_of(thing) is None]


def object_meshes(root: bpy.types.Collection) -> dict[int, list[bpy.types.Object]]:
    """Object ID -> the meshes in its collection, of the objects that have one."""
    found = {object_id: [thing for thing in parts_of(collection) if kind_of(thing) == MESH]
             for object_id, collection in object_collections(root).items()}
    return {object_id: meshes for object_id, meshes in found.items() if meshes}


def mark_asset(collection: bpy.types.Collection, meshes: list[bpy.types.Object]) -> None:
    """Offer an object's collection in the asset browser; dropped, it stands where the mouse is, upright and in size.

    The collection, since a mesh alone has its uprightness from what it hangs on.
    """
    low, high = bounds(meshes)
    collection.instance_offset = (*((low + high) / 2)[:2], low[2])
    if collection.asset_data is None:
        collection.asset_mark()
        collection.asset_data.description = f"{collection.name}, reconstructed from photos"
    collection.asset_data.tags.new("ObjectGS", skip_if_exists=True)
    collection.asset_generate_preview()


def bounds(meshes: list[bpy.types.Object]) -> np.ndarray:
    """(2, 3) float64: the least and the greatest coordinates of meshes in the world."""
    ends = []
    for thing in meshes:
        local = np.empty(3 * len(thing.data.vertices), np.float32)
        thing.data.vertices.foreach_get("co", local)
        matrix = into_world(thing)
        world = local.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
        ends += [world.min(0), world.max(0)]
    return np.stack([np.min(ends, axis=0), np.max(ends, axis=0)])


def _hide(hidden: dict[bpy.types.Object, bool]) -> None:
    """Hide objects or show them, in viewports and renders.

    All but one at once and without Blender's notice, since it goes through every object of the file each time.
    """
    things = bpy.data.objects
    places = {thing: place for place, thing in enumerate(things)}
    for name in ("hide_viewport", "hide_render"):
        flags = np.empty(len(things), bool)
        things.foreach_get(name, flags)
        changed = [thing for thing, value in hidden.items() if flags[places[thing]] != value]
        if not changed:
            continue
        for thing in changed[:-1]:
            flags[places[thing]] = hidden[thing]
        things.foreach_set(name, flags)
        for thing in changed[:-1]:
            thing.update_tag(refresh={"OBJECT"})  # Else what Blender evaluates hides it again.
        setattr(changed[-1], name, hidden[changed[-1]])


def _read_entries(folder: Path) -> list[_Entry]:
    """What meshes.json lists as made, in its order; nothing where there is no such file."""
    place = Reconstruction(folder).meshes
    path = place / "meshes.json"
    if not path.exists():
        return []
    content = read_json(path)
    try:
        return [_entry(str(key), values, place) for key, values in content["meshes"].items() if "file" in values]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} does not list meshes as expected ({error!r}); make the meshes again.") from error


def _entry(key: str, values: dict, place: Path) -> _Entry:
    ids = values.get("ids")
    if ids is None and key.isdecimal():
        ids = [int(key)]
    # Names, not paths: nothing outside of the folder is read.
    mesh, texture = (os.path.basename(str(values.get(name) or f"{key}{suffix}"))
                     for name, suffix in (("file", ".ply"), ("texture", ".png")))
    return _Entry(key, None if ids is None else tuple(sorted(int(i) for i in ids)), place / mesh, place / texture,
                  " ".join(str(values.get("name") or key).split()))


def _wanted(entries: list[_Entry], objects: Objects) -> tuple[list[tuple[_Entry, int | None]], list[str]]:
    """The meshes to show, with the ID of the collection that each belongs into (None: the reconstruction's)."""
    wanted: list[tuple[_Entry, int | None]] = []
    warnings = []
    for entry in entries:
        if not entry.is_object:
            wanted.append((entry, None))
            continue
        targets = {objects.shown_as(object_id) for object_id in entry.ids}
        target = targets.pop() if len(targets) == 1 else None
        if target is not None:
            wanted.append((entry, target))
        elif targets:
            warnings.append(f"The mesh of {objects.name(int(entry.key))} was made when other objects were merged with "
                            "it and is not shown; extract it again.")
    of_target: dict[int, list[set[int]]] = {}
    for entry, target in wanted:
        if target is not None:
            of_target.setdefault(target, []).append(set(entry.ids))
    # What was merged before its mesh was made is a part of that one.
    return [(entry, target) for entry, target in wanted if target is None or not any(
        other > set(entry.ids) for other in of_target[target])], warnings


def _meshes_of(root, collections) -> dict[str, bpy.types.Object]:
    """Key -> mesh, the first where the user duplicated one."""
    found: dict[str, bpy.types.Object] = {}
    for collection in (root, *collections.values()):
        for thing in parts_of(collection):
            if kind_of(thing) == MESH and thing.data is not None:
                found.setdefault(str(thing.get(MESH_KEY, "")), thing)
    return found


def _modified(path: Path) -> str:
    try:
        return str(path.stat().st_mtime_ns)
    except OSError:
        return ""


class _Maker:
    """Puts meshes into their collections. changed: IDs whose collections have got or lost one (None: the
    reconstruction's); new: IDs whose collections it made, which are not linked yet."""

    def __init__(self, root, objects: Objects, collections: dict[int, bpy.types.Collection]) -> None:
        self.root, self.objects, self.collections = root, objects, collections
        self.origin = origin_of(root)
        self.parent = parent_of(root)
        self.changed: set[int | None] = set()
        self.new: list[int] = []
        self.warnings: list[str] = []
        self._material: bpy.types.Material | None = None

    def show(self, entry: _Entry, target: int | None, thing) -> bool:
        """Make or update one mesh, `thing` where it is there; whether its files were read."""
        collection = self.root if target is None else self.collections.get(target)
        placed = thing is not None and collection is not None and _lies_in(thing, collection)
        written = entry.written()
        if placed and thing.parent is not None and thing.get(WRITTEN) == written:
            return False
        loaded = _read(entry)
        positions = loaded.vertices - self.origin
        if collection is None:
            collection = self.collections[target] = new_collection(target, self.objects)
            adopt(collection, self.root, (OBJECT_PARENT, SPLATS, ANCHORS, MESH), target)
            placed = thing is not None and _lies_in(thing, collection)
            self.new.append(target)
        pivot, centre = self.parent, np.zeros(3)
        if target is not None:
            pivot = pivot_of(collection, self.parent, target, positions)
            centre = centre_of(pivot)
        if thing is None:
            thing = self._new(entry, target, collection)
        elif not placed:
            self.leave(thing)
            collection.objects.link(thing)
            mark(thing, MESH, target)
            self.changed.add(target)
        if thing.parent is None or not placed:
            thing.parent = pivot
        fill(thing.data, positions - centre, loaded)
        self._dress(thing, entry)
        thing[WRITTEN] = written
        if not entry.texture.is_file():
            self.warnings.append(f"{entry.texture} is missing, so {thing.name} has no texture; make the mesh again.")
        return True

    def leave(self, thing) -> None:
        """Take a mesh out of where it lies: its objects were merged or split, or it goes altogether."""
        for object_id, collection in ((None, self.root), *self.collections.items()):
            if _lies_in(thing, collection):
                collection.objects.unlink(thing)
                self.changed.add(object_id)

    def _new(self, entry: _Entry, target: int | None, collection) -> bpy.types.Object:
        name = entry.name
        if target is not None:
            name = collection[NAME] if str(target) == entry.key else self.objects.name(int(entry.key))
        thing = bpy.data.objects.new(f"{name} {MESH}", bpy.data.meshes.new(f"{name} {MESH}"))
        mark(thing, MESH, target)
        thing[MESH_KEY] = entry.key
        if target is None:
            thing.hide_viewport = thing.hide_render = True
        else:
            thing.color = (*to_linear(self.objects.rgb(target)), 1.0)
        collection.objects.link(thing)
        self.changed.add(target)
        return thing

    def _dress(self, thing, entry: _Entry) -> None:
        """Give the mesh our material where it has none; where it has, only bring our textures up to date."""
        slots = [slot.material for slot in thing.material_slots]
        if not slots:
            image = _load(entry, thing.name)
            self._material = material = _material(thing.name, image, self._material)
            material.diffuse_color = thing.color
            thing.data.materials.append(material)
            return
        for image in dict.fromkeys(image for material in slots for image in textures_of(material)):
            if image.get(MESH_KEY) == thing.get(MESH_KEY):
                _reload(image, entry.texture)


def _read(entry: _Entry) -> Mesh:
    """The mesh's file; InputError where it cannot be shown."""
    loaded = read_mesh(entry.mesh)
    if not len(loaded.faces) or not np.isfinite(loaded.vertices).all():
        raise InputError(f"{entry.mesh} holds no surface; make the meshes again.")
    return loaded


def fill(mesh: bpy.types.Mesh, positions: np.ndarray, loaded: Mesh) -> None:
    """Replace the geometry of `mesh` by that of `loaded`, its vertices at `positions` (V, 3); materials stay.

    UV map, vertex colours, which faces are invented and the normals come along.
    """
    if mesh.shape_keys is not None:
        for user in [thing for thing in bpy.data.objects if thing.data == mesh]:
            user.shape_key_clear()  # They are of other vertices.
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
    colours = mesh.color_attributes.new(COLOURS, "BYTE_COLOR", "POINT")
    rgba = np.ones((len(positions), 4), np.float32)
    rgba[:, :3] = loaded.colors / np.float32(255.0)
    colours.data.foreach_set("color_srgb", rgba.reshape(-1))
    mesh.color_attributes.active_color = colours
    invented = mesh.attributes.new(INVENTED, "BOOLEAN", "FACE")
    invented.data.foreach_set("value", np.ascontiguousarray(loaded.invented, bool))
    mesh.update(calc_edges=True)
    # A face with a corner twice, which would crash Blender's tools, goes.
    mesh.validate(clean_customdata=False)
    mesh.normals_split_custom_set_from_vertices(np.nan_to_num(loaded.normals))
    mesh.update()


def _lies_in(thing, collection) -> bool:
    return collection.objects.get(thing.name) == thing


def _load(entry: _Entry, name: str) -> bpy.types.Image:
    """The texture as an image; one that is not there yet shows as soon as it is."""
    path = entry.texture
    if path.is_file():
        image = bpy.data.images.load(str(path), check_existing=False)
    else:
        image = bpy.data.images.new(name, 1, 1)
        image.source = "FILE"
    image.name = name
    # Raw, since Blender goes through every node of the file otherwise.
    image.filepath_raw = _kept(path)
    mark(image, TEXTURE)
    image[MESH_KEY] = entry.key
    return image


def _reload(image: bpy.types.Image, path: Path) -> None:
    """Show what the texture's file holds now; one that the user packed into the .blend is packed again."""
    packed = image.packed_file is not None
    if packed:
        image.unpack(method="REMOVE")
    image.filepath_raw = _kept(path)
    image.reload()
    if packed and path.is_file():
        image.pack()


def _kept(path: Path) -> str:
    """A path as the .blend is to keep it: relative to it where the user likes it so, and it is saved already."""
    if not bpy.data.filepath or not bpy.context.preferences.filepaths.use_relative_paths:
        return str(path)
    try:
        return bpy.path.relpath(str(path))
    except ValueError:  # another drive
        return str(path)


def _material(name: str, image: bpy.types.Image, like: bpy.types.Material | None) -> bpy.types.Material:
    """A new material with the texture; a copy of `like`, which is faster, where there is one."""
    if like is not None:
        material = like.copy()
        material.name = name
        next(node for node in material.node_tree.nodes if node.type == "TEX_IMAGE").image = image
        return material
    material = bpy.data.materials.new(name)
    if material.node_tree is None:
        material.use_nodes = True  # always so, and warned about, from Blender 5.0 on
    material.node_tree.nodes.clear()
    mark(material, MESH_MATERIAL)
    graph = Graph(material.node_tree)
    colour = graph.node("ShaderNodeTexImage", location=(-320.0, 0.0))
    colour.image = image
    shader = graph.node("ShaderNodeBsdfPrincipled", {
        "Base Color": colour.outputs["Color"], "Roughness": ROUGHNESS, "Specular IOR Level": SPECULAR})
    graph.node("ShaderNodeOutputMaterial", {"Surface": shader.outputs[0]}, location=(320.0, 0.0))
    return material
