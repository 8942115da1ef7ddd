# SPDX-License-Identifier: GPL-3.0-or-later
"""Compositor nodes that combine film frames of splats with Blender's own rendering, by depth.

    frames of splats (EXR) --- Depth --------> nearer than Blender's? ---- yes: 1, no: 0
                           `-- Combined -> behind -> Blender's rendering over it -> in front -> output
    Cryptomatte of the same files, for mattes of single objects

Splats are behind Blender's rendering where the rendering is nearer, and in front of it elsewhere; both are blended by
alpha.
Blender 4.2 to 4.5 store the compositor nodes in the scene, 5.0 and newer in a node group.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy

from ...backend.shared.errors import InputError
from ..scene.kinds import FILM, KIND, RECONSTRUCTION, kind_of, mark
from ..scene.shading.graph import Graph
from ..scene.shading.render_settings import compositor_of, frames_node

PATTERN = "splats.{:04d}.exr"
_FRAMES = "objectgs_frames"
"""Property of a reconstruction's collection: the folder of the film frames that renders show instead of it."""
NEAREST_IN = 1
"""Radius in pixels of the minimum filter on the depth of Blender's rendering; it gives antialiased edges the depth of
the object in front."""


def set_up_compositor(
    scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, root: bpy.types.Collection, folder: Path, matte: str = ""
) -> None:
    """Set up the scene's compositor to combine film frames with Blender's rendering.

    The current input of the compositor's output is used as Blender's rendering. If the nodes already exist, only their
    frames are updated. The reconstruction is hidden in renders, and the one whose frames these replace is not.

    Args:
        scene: scene whose compositor is changed.
        view_layer: view layer whose depth is used.
        root: the reconstruction's collection.
        folder: folder of the film frames.
        matte: name of the object that the Cryptomatte node shows first.

    Raises:
        InputError: `folder` contains no film frames.
    """
    frames = _frames_in(folder)
    if not frames:
        raise InputError(f"{folder} contains no film frames; render them first.")
    tree = _tree(scene)
    node = frames_node(tree)
    if node is None:
        _join(scene, view_layer, tree, _load(folder, frames), matte)
    elif (former := _path(node.image).parent) != folder and not _shows_elsewhere(scene, former):
        for other in scene.collection.children_recursive:
            if kind_of(other) == RECONSTRUCTION and other.get(_FRAMES) == str(former):
                other.hide_render = False
    _use(tree, folder, frames)
    scene.render.use_compositing = True
    scene.render.film_transparent = True
    view_layer.use_pass_z = True
    root.hide_render, root[_FRAMES] = True, str(folder)


def _shows_elsewhere(scene: bpy.types.Scene, folder: Path) -> bool:
    """Return whether the compositor of another scene, which scenes may share, shows frames of a folder."""
    own = compositor_of(scene)
    trees = (compositor_of(other) for other in bpy.data.scenes if other != scene)
    nodes = (frames_node(tree) for tree in trees if tree != own)
    return any(node is not None and _path(node.image).parent == folder for node in nodes)


def show_frames(scene: bpy.types.Scene, folder: Path) -> None:
    """Update the compositor to the current frames of `folder` if it shows frames of this folder."""
    tree = compositor_of(scene)
    node = frames_node(tree)
    frames = _frames_in(folder)
    if node is not None and frames and _path(node.image).parent == folder:
        _use(tree, folder, frames)


def _frames_in(folder: Path) -> list[int]:
    """Return the frame numbers in a folder, ascending."""
    words = [path.name.split(".") for path in folder.glob("splats.*.exr")]
    return sorted(int(word[1]) for word in words if len(word) == 3 and word[1].isdecimal())


def _tree(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """Return the scene's compositor node tree, created if missing."""
    if not hasattr(scene, "compositing_node_group"):  # 4.2 to 4.5
        scene.use_nodes = True
        return scene.node_tree
    tree = scene.compositing_node_group
    if tree is None:
        tree = scene.compositing_node_group = bpy.data.node_groups.new("Compositor", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    return tree


def _load(folder: Path, frames: list[int]) -> bpy.types.Image:
    path = str(folder / PATTERN.format(frames[0]))
    # Load a separate image, so that other images in the file do not change.
    image = bpy.data.images.load(path)
    image.source = "SEQUENCE"
    image.name = "Splats"
    mark(image, FILM)
    return image


def _path(image: bpy.types.Image) -> Path:
    # A relative path may lead upwards first.
    return Path(os.path.normpath(bpy.path.abspath(image.filepath))) if image is not None else Path()


def _use(tree: bpy.types.NodeTree, folder: Path, frames: list[int]) -> None:
    """Set the add-on's nodes to read the frames of a folder, each at its own frame number."""
    first, last = frames[0], frames[-1]
    for node in tree.nodes:
        if node.get(KIND) != FILM or node.type not in ("IMAGE", "CRYPTOMATTE_V2"):
            continue
        if node.image is None or kind_of(node.image) != FILM:
            node.image = _load(folder, frames)
        node.image.filepath = str(folder / PATTERN.format(first))
        node.image.reload()
        node.frame_start, node.frame_offset, node.frame_duration = first, first - 1, last - first + 1
        node.use_auto_refresh = True


def _join(
    scene: bpy.types.Scene,
    view_layer: bpy.types.ViewLayer,
    tree: bpy.types.NodeTree,
    image: bpy.types.Image,
    matte: str,
) -> None:
    graph = Graph(tree)
    output = _output(scene, tree)
    rendered, depth = _rendering(scene, view_layer, graph, tree, output)
    new = len(tree.nodes)

    splats = graph.node("CompositorNodeImage", image=image)
    splats.label = "Splats"
    near = graph.node("CompositorNodeDilateErode", {"Mask": depth})
    if "Size" in near.inputs:
        near.inputs["Size"].default_value = -NEAREST_IN
    else:
        near.distance = -NEAREST_IN
    is_nearer = _math(graph, "LESS_THAN", splats.outputs["Depth"], near.outputs[0])
    is_behind = _math(graph, "SUBTRACT", 1.0, is_nearer)
    behind = _over(graph, is_behind, (0.0, 0.0, 0.0, 0.0), splats.outputs["Combined"])
    middle = _over(graph, 1.0, behind, rendered)
    joined = _over(graph, is_nearer, middle, splats.outputs["Combined"])
    tree.links.new(joined, output)
    mattes = graph.node("CompositorNodeCryptomatteV2", source="IMAGE", image=image)
    mattes.label = "Object Mattes"
    mattes.matte_id = matte
    tree.links.new(joined, mattes.inputs["Image"])

    nodes = list(tree.nodes)[new:]
    right = output.node.location.x = max(output.node.location.x, depth.node.location.x + 220.0 * (len(nodes) + 1))
    for index, node in enumerate(nodes):
        node[KIND] = FILM
        node.location = (right - 220.0 * (len(nodes) - 1 - index), output.node.location.y - 420.0)
    splats.location.y -= 160.0
    mattes.location = (output.node.location.x, output.node.location.y - 240.0)


def _output(scene: bpy.types.Scene, tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Return the input socket of the compositor's output node, created if missing."""
    is_group = hasattr(scene, "compositing_node_group")
    node = next((node for node in tree.nodes if node.type == ("GROUP_OUTPUT" if is_group else "COMPOSITE")), None)
    if node is None:
        node = tree.nodes.new("NodeGroupOutput" if is_group else "CompositorNodeComposite")
        node.location = (900.0, 300.0)
    return node.inputs[0]


def _rendering(
    scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, graph: Graph, tree: bpy.types.NodeTree, output: Any
) -> Any:
    """Return the current input of the output, or else the view layer's rendering, and the view layer's depth."""
    view_layer.use_pass_z = True
    layers = next(
        (
            node
            for node in tree.nodes
            if node.type == "R_LAYERS" and node.scene == scene and node.layer == view_layer.name
        ),
        None,
    )
    if layers is None:
        layers = graph.node("CompositorNodeRLayers", scene=scene, layer=view_layer.name)
        layers.location = (output.node.location.x - 2000.0, output.node.location.y)
    rendered = output.links[0].from_socket if output.links else layers.outputs["Image"]
    return rendered, layers.outputs["Depth"]


def _math(graph: Graph, operation: str, *values: Any) -> bpy.types.NodeSocket:
    """Add a Math node and return its output; since Blender 5.0, the compositor uses shader nodes."""
    kind = "ShaderNodeMath" if bpy.app.version >= (5, 0) else "CompositorNodeMath"
    return graph.node(kind, dict(enumerate(values)), operation=operation).outputs[0]


def _over(graph: Graph, factor: Any, background: Any, foreground: Any) -> bpy.types.NodeSocket:
    """Add an Alpha Over node and return its output; its sockets have unique names since Blender 5.0."""
    keys = ("Factor", "Background", "Foreground") if bpy.app.version >= (5, 0) else (0, 1, 2)
    return graph.node("CompositorNodeAlphaOver", dict(zip(keys, (factor, background, foreground)))).outputs[0]
