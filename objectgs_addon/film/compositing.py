# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes in a scene's compositor that join film frames of splats with Blender's own rendering, by depth.

    frames of splats (EXR) --- Depth --------> nearer than Blender's? ---- yes: 1, no: 0
                           `-- Combined -> behind -> Blender's rendering over it -> in front -> output
    Cryptomatte of the same files, for mattes of single objects

Splats lie behind Blender's rendering where that is nearer, and before it elsewhere, and what is before lets through
what its alpha lets through. Blender 4.2 to 4.5 keep a scene's nodes in the scene, 5.0 and newer in a node group.
"""

from pathlib import Path

import bpy

from ...backend.protocol import InputError
from ..scene.kinds import KIND, kind_of, mark
from ..scene.preview import Graph

FILM = "film"
"""Kind of the nodes' image and of the nodes."""

PATTERN = "splats.{:04d}.exr"
NEAREST_IN = 1
"""Pixels around one whose nearest depth counts for Blender's rendering, so that its soft edges are as near as what
they belong to."""


def set_up_compositor(scene: bpy.types.Scene, view_layer: bpy.types.ViewLayer, root: bpy.types.Collection,
                      folder: Path, matte: str = "") -> None:
    """Make the scene's compositor join the film frames in `folder` with its rendering, which from now on leaves the
    reconstruction out. matte: the name of an object that the Cryptomatte node begins with.

    Whatever led to the compositor's output is taken for Blender's rendering. Where the nodes are there already, they
    only get the folder's frames. Raises InputError where `folder` has none.
    """
    frames = _frames_in(folder)
    if not frames:
        raise InputError(f"{folder} holds no film frames yet; render them first.")
    tree = _tree(scene)
    if _image_node(tree) is None:
        _join(scene, view_layer, tree, _load(folder, frames), matte)
    _use(tree, folder, frames)
    scene.render.use_compositing = True
    scene.render.film_transparent = True
    view_layer.use_pass_z = True
    root.hide_render = True


def has_frames(scene: bpy.types.Scene) -> bool:
    """Whether the scene's compositor shows film frames."""
    tree = _tree_if_any(scene)
    return tree is not None and _image_node(tree) is not None


def show_frames(scene: bpy.types.Scene, folder: Path) -> None:
    """Let the compositor, where it shows film frames of `folder`, show those that are there now."""
    tree = _tree_if_any(scene)
    node = _image_node(tree) if tree is not None else None
    frames = _frames_in(folder)
    if node is not None and frames and _path(node.image).parent == folder:
        _use(tree, folder, frames)


def _frames_in(folder: Path) -> list[int]:
    """Numbers of the frames there, ascending."""
    words = [path.name.split(".") for path in folder.glob("splats.*.exr")]
    return sorted(int(word[1]) for word in words if len(word) == 3 and word[1].isdecimal())


def _tree_if_any(scene):
    return scene.compositing_node_group if hasattr(scene, "compositing_node_group") else scene.node_tree


def _tree(scene) -> bpy.types.NodeTree:
    """The scene's compositor nodes, with what Blender itself begins with where there are none."""
    if not hasattr(scene, "compositing_node_group"):  # 4.2 to 4.5
        scene.use_nodes = True
        return scene.node_tree
    tree = scene.compositing_node_group
    if tree is None:
        tree = scene.compositing_node_group = bpy.data.node_groups.new("Compositor", "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    return tree


def _image_node(tree):
    return next((node for node in tree.nodes if node.get(KIND) == FILM and node.type == "IMAGE"), None)


def _load(folder: Path, frames: list[int]) -> bpy.types.Image:
    path = str(folder / PATTERN.format(frames[0]))
    # Of its own, so that nothing else of the file changes with it.
    image = bpy.data.images.load(path)
    image.source = "SEQUENCE"
    image.name = "Splats"
    mark(image, FILM)
    return image


def _path(image) -> Path:
    return Path(bpy.path.abspath(image.filepath)) if image is not None else Path()


def _use(tree, folder: Path, frames: list[int]) -> None:
    """Let our nodes read the frames of a folder, each at its own number."""
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


def _join(scene, view_layer, tree, image, matte: str) -> None:
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
    mattes.label = "Mattes of Objects"
    mattes.matte_id = matte
    tree.links.new(joined, mattes.inputs["Image"])

    nodes = list(tree.nodes)[new:]
    right = output.node.location.x = max(output.node.location.x, depth.node.location.x + 220.0 * (len(nodes) + 1))
    for index, node in enumerate(nodes):
        node[KIND] = FILM
        node.location = (right - 220.0 * (len(nodes) - 1 - index), output.node.location.y - 420.0)
    splats.location.y -= 160.0
    mattes.location = (output.node.location.x, output.node.location.y - 240.0)


def _output(scene, tree) -> bpy.types.NodeSocket:
    """The socket that takes the finished picture."""
    is_group = hasattr(scene, "compositing_node_group")
    node = next((node for node in tree.nodes if node.type == ("GROUP_OUTPUT" if is_group else "COMPOSITE")), None)
    if node is None:
        node = tree.nodes.new("NodeGroupOutput" if is_group else "CompositorNodeComposite")
        node.location = (900.0, 300.0)
    return node.inputs[0]


def _rendering(scene, view_layer, graph: Graph, tree, output):
    """What has led to the output so far, or the rendering of the view layer; and that rendering's depth."""
    view_layer.use_pass_z = True
    layers = next((node for node in tree.nodes if node.type == "R_LAYERS" and node.layer == view_layer.name), None)
    if layers is None:
        layers = graph.node("CompositorNodeRLayers", scene=scene, layer=view_layer.name)
        layers.location = (output.node.location.x - 2000.0, output.node.location.y)
    rendered = output.links[0].from_socket if output.links else layers.outputs["Image"]
    return rendered, layers.outputs["Depth"]


def _math(graph: Graph, operation: str, *values) -> bpy.types.NodeSocket:
    """Output of a Math node: compositors have had shaders' since Blender 5.0."""
    kind = "ShaderNodeMath" if bpy.app.version >= (5, 0) else "CompositorNodeMath"
    return graph.node(kind, dict(enumerate(values)), operation=operation).outputs[0]


def _over(graph: Graph, factor, background, foreground) -> bpy.types.NodeSocket:
    """Output of an Alpha Over node, whose sockets had no names of their own before Blender 5.0."""
    keys = ("Factor", "Background", "Foreground") if bpy.app.version >= (5, 0) else (0, 1, 2)
    return graph.node("CompositorNodeAlphaOver", dict(zip(keys, (factor, background, foreground)))).outputs[0]
