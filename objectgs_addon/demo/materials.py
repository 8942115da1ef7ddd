# SPDX-License-Identifier: GPL-3.0-or-later
"""Procedural textures with details of at least 1.5 cm, about 3 pixels in a 320x240 view from 1.4 m."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ...backend.shared.color.srgb import decode


class Nodes:
    """A material's node tree with shorthand methods for the patterns."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        if self.material.node_tree is None:
            self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()

    def add(self, kind: str, inputs: Any = None, **settings: Any) -> Any:
        """Add a node; `inputs` maps socket names or indices to values or other nodes' outputs."""
        node = self.tree.nodes.new("ShaderNode" + kind)
        for key, value in settings.items():
            setattr(node, key, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def math(self, operation: str, *values: Any) -> Any:
        return self.add("Math", dict(enumerate(values)), operation=operation).outputs[0]

    def mix(self, factor: Any, a: Any, b: Any, blend: str = "MIX") -> Any:
        node = self.add("Mix", {0: factor, 6: a, 7: b}, data_type="RGBA", blend_type=blend)
        return node.outputs[2]

    def ramp(self, value: Any, colors: Any, soft: bool = False, stops: Any = None) -> Any:
        """Map a value in 0..1 to colors, in steps or blended (`soft`)."""
        node = self.add("ValToRGB", {0: value})
        ramp = node.color_ramp
        ramp.interpolation = "EASE" if soft else "CONSTANT"
        n = len(colors)
        stops = stops or ([i / max(n - 1, 1) for i in range(n)] if soft else [i / n for i in range(n)])
        while len(ramp.elements) < n:
            ramp.elements.new(1.0)
        for element, stop, color in zip(ramp.elements, stops, colors):
            element.position, element.color = stop, color
        return node.outputs[0]

    def step(self, value: Any, edge: float, width: float) -> Any:
        """Return 0 below and 1 above `edge`, blended over `width`."""
        node = self.add("MapRange", {0: value, 1: edge - width / 2, 2: edge + width / 2, 3: 0.0, 4: 1.0})
        return node.outputs[0]

    def place(self, offset: Any) -> Any:
        """Return object coordinates in meters, and the same moved by an offset."""
        coordinates = self.add("TexCoord").outputs["Object"]
        return coordinates, self.add("VectorMath", {0: coordinates, 1: offset}, operation="ADD").outputs[0]

    def wrap(self, coordinates: Any, around: int) -> Any:
        """Return cylindrical coordinates around the z axis: (turns * `around`, height in meters)."""
        x, y, z = self.add("SeparateXYZ", {0: coordinates}).outputs
        turn = self.math("DIVIDE", self.math("ARCTAN2", y, x), 2 * math.pi)
        return self.math("MULTIPLY", turn, float(around)), z

    def join(self, x: Any, y: Any, z: Any = 0.0) -> Any:
        return self.add("CombineXYZ", {0: x, 1: y, 2: z}).outputs[0]

    def noise(self, vector: Any, scale: float, detail: float = 1.0) -> Any:
        return self.add("TexNoise", {"Vector": vector, "Scale": scale, "Detail": detail, "Roughness": 0.45}).outputs[0]

    def cells(self, vector: Any, scale: float, feature: str = "F1", random: float = 1.0) -> Any:
        node = self.add("TexVoronoi", {"Vector": vector, "Scale": scale, "Randomness": random}, feature=feature)
        return node.outputs

    def vary(self, color: Sequence[float], place: Any, amount: float = 0.35, scale: float = 14.0) -> Any:
        """Multiply a color by lighter and darker patches, which make repeats of a pattern distinguishable."""
        grays = [_gray(1 - amount), _gray(1.0), _gray(1 - amount / 2), _gray(1.0)]
        patches = self.ramp(self.noise(place, scale, 1.5), grays, soft=True, stops=[0.3, 0.45, 0.58, 0.72])
        return self.mix(1.0, color, patches, "MULTIPLY")

    def glow(self, color: Sequence[float]) -> Any:
        """Finish as an emission shader; the room, half of the pixels, then requires no lighting and has no noise."""
        shader = self.add("Emission", {0: color, 1: 0.9})
        self.tree.links.new(shader.outputs[0], self.add("OutputMaterial").inputs[0])
        self.material.cycles.emission_sampling = "NONE"
        return self.material

    def finish(self, color: Sequence[float], roughness: float = 0.85, specular: float = 0.1) -> Any:
        shader = self.add(
            "BsdfPrincipled", {"Base Color": color, "Roughness": roughness, "Specular IOR Level": specular}
        )
        output = self.add("OutputMaterial")
        self.tree.links.new(shader.outputs[0], output.inputs[0])
        return self.material


def _gray(value: float) -> Any:
    return (value, value, value, 1.0)


def _linear(code: str, turn: float = 0.0) -> Any:
    """Return scene-linear RGBA of an sRGB "rrggbb" code, its hue rotated by `turn` (1 is a full circle)."""
    rgb = [int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    hue, light, color = colorsys.rgb_to_hls(*rgb)
    rgb = colorsys.hls_to_rgb((hue + turn) % 1.0, light, color)
    return (*decode(np.array(rgb)).tolist(), 1.0)


def _checker(n: Any, raw: Any, place: Any, c: Any, size: Any, around: Any) -> Any:
    u, z = n.wrap(raw, 2 * round(around / 2))
    v = n.math("DIVIDE", z, size)
    flags = n.add("TexChecker", {"Vector": n.join(u, v, 0.5), "Scale": 1.0, "Color1": c[0], "Color2": c[1]}).outputs[0]
    return n.mix(n.step(n.noise(place, 9.0), 0.56, 0.06), flags, c[2])


def _bricks(n: Any, raw: Any, place: Any, c: Any, size: Any, around: Any) -> Any:
    u, z = n.wrap(raw, around)
    vector = n.join(n.math("MULTIPLY", u, 0.5), n.math("DIVIDE", z, size * 4))
    sizes = {"Scale": 1.0, "Mortar Size": 0.022, "Mortar Smooth": 0.3, "Brick Width": 0.5, "Row Height": 0.25}
    colors = {"Color1": c[0], "Color2": c[1], "Mortar": c[2]}
    return n.add("TexBrick", {"Vector": vector, **colors, **sizes}).outputs[0]


def _mosaic(n: Any, raw: Any, place: Any, c: Any, size: Any, around: Any) -> Any:
    scale = 1 / (size * 1.5)
    choice = n.add("SeparateColor", {0: n.cells(place, scale)["Color"]}).outputs[0]
    edge = n.cells(place, scale, "DISTANCE_TO_EDGE")[0]
    return n.mix(n.step(edge, 0.07, 0.04), c[-1], n.ramp(choice, c[:-1]))


def _dots(n: Any, raw: Any, place: Any, c: Any, size: Any, around: Any) -> Any:
    out = n.cells(place, 1 / (size * 1.7), random=0.35)
    choice = n.add("SeparateColor", {0: out["Color"]}).outputs[0]
    inside = n.math("SUBTRACT", 1.0, n.step(out["Distance"], 0.36, 0.05))
    return n.mix(inside, c[0], n.ramp(choice, c[1:]))


def _zigzag(n: Any, raw: Any, place: Any, c: Any, size: Any, around: Any) -> Any:
    u, z = n.wrap(raw, max(4, around // 2))
    saw = n.math("PINGPONG", u, 0.5)
    bands = n.math("FRACT", n.math("ADD", n.math("DIVIDE", z, size * 3.2), n.math("MULTIPLY", saw, 0.8)))
    return n.ramp(bands, c)


def _waves(n: Any, raw: Any, place: Any, c: Any, size: Any, around: Any) -> Any:
    values = {"Vector": place, "Scale": 0.09 / size, "Distortion": 5.0, "Detail": 1.0, "Detail Scale": 1.2}
    node = n.add("TexWave", values, wave_type="BANDS", bands_direction="DIAGONAL")
    return n.ramp(node.outputs[1], c)


def _clouds(n: Any, raw: Any, place: Any, c: Any, size: Any, around: Any) -> Any:
    stops = [0] + [0.38 + 0.24 * i / (len(c) - 2) for i in range(len(c) - 1)]
    return n.ramp(n.noise(place, 0.42 / size, 1.5), c, stops=stops)


# Kind: pattern, detail size (m), details around, sRGB colors, roughness, specular level.
LOOKS = {
    "mug": (_checker, 0.025, 14, ("e8e0cf", "c0392b", "e9a23b"), 0.8, 0.1),
    "bottle": (_zigzag, 0.022, 12, ("1f6f5c", "e6dcae", "2f9a76", "d98e32"), 0.8, 0.1),
    "ring": (_dots, 0.020, 12, ("efc94c", "8e3b7c", "d4552f", "3a62a8"), 0.8, 0.1),
    "bowl": (_bricks, 0.024, 22, ("3f7fb5", "86b9d6", "f0ead8"), 0.8, 0.1),
    "books": (_mosaic, 0.026, 16, ("b5413a", "dfb15b", "3c5f86", "e8dcc6", "4b3a36"), 0.85, 0.1),
    "monkey": (_clouds, 0.024, 12, ("6d3f23", "c98a4b", "8a5530", "e3bb82", "5b3520"), 0.85, 0.1),
    "teapot": (_mosaic, 0.022, 16, ("d9e4e3", "4a8f9c", "e8b7a4", "2f5d78", "f4efe4"), 0.42, 0.35),
    "vase": (_waves, 0.024, 12, ("5a3f80", "c9b2dd", "8557a5", "ead9b8"), 0.45, 0.3),
    "cone": (_zigzag, 0.02, 14, ("d1442f", "f2e4c4", "e58a2c"), 0.85, 0.1),
    "ball": (_mosaic, 0.03, 12, ("37966f", "e3c94f", "c9503c", "eee6d2"), 0.8, 0.1),
    "die": (_dots, 0.025, 12, ("35507a", "e8e0cf", "e0a63a"), 0.8, 0.1),
    "pumpkin": (_clouds, 0.022, 12, ("c65a17", "e88c2c", "a8430f", "f2b04e", "8c3a10"), 0.85, 0.1),
    "mushroom": (_dots, 0.022, 12, ("b8302a", "efe6d6", "f0c98a"), 0.8, 0.1),
    "gear": (_waves, 0.024, 12, ("43606b", "9fb6b8", "6f8a90", "d8c27a"), 0.7, 0.2),
}


def material(kind: str, rng: Any) -> bpy.types.Material:
    """Create the material of a kind of object; `rng` varies the hue and the position of the pattern."""
    pattern, size, around, codes, roughness, specular = LOOKS[kind]
    turn = float(rng.uniform(-0.03, 0.03))
    n = Nodes(kind)
    raw, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    color = pattern(n, raw, place, [_linear(code, turn) for code in codes], size, around)
    return n.finish(n.vary(color, place), roughness, specular)


def table(rng: Any) -> bpy.types.Material:
    """Create the table's material: planks of warm wood with grain."""
    n = Nodes("table")
    raw, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    planks = n.add(
        "TexBrick",
        {
            "Vector": raw,
            "Color1": _linear("b98a5c"),
            "Color2": _linear("96683f"),
            "Mortar": _linear("5f4029"),
            "Scale": 1.0,
            "Mortar Size": 0.004,
            "Mortar Smooth": 0.6,
            "Brick Width": 0.42,
            "Row Height": 0.085,
        },
    ).outputs[0]
    stretched = n.add("VectorMath", {0: place, 1: (7.0, 32.0, 20.0)}, operation="MULTIPLY").outputs[0]
    grain = n.ramp(
        n.noise(stretched, 1.0, 1.5),
        [_gray(0.62), _gray(1.0), _gray(0.78), _gray(1.0)],
        soft=True,
        stops=[0.32, 0.46, 0.56, 0.68],
    )
    color = n.mix(1.0, planks, grain, "MULTIPLY")
    return n.finish(n.vary(color, place, 0.25, 6.0))


def floor(rng: Any) -> bpy.types.Material:
    """Create the floor's material: tiles, darker under the table."""
    n = Nodes("floor")
    raw, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    color = n.add(
        "TexChecker", {"Vector": place, "Scale": 4.5, "Color1": _linear("8d857c"), "Color2": _linear("a69c90")}
    ).outputs[0]
    x, y, _ = n.add("SeparateXYZ", {0: raw}).outputs
    away = n.math("SQRT", n.math("ADD", n.math("MULTIPLY", x, x), n.math("MULTIPLY", y, y)))
    shade = n.add("MapRange", {0: away, 1: 0.2, 2: 1.7, 3: 0.35, 4: 0.8}, interpolation_type="SMOOTHSTEP").outputs[0]
    return n.glow(n.mix(1.0, n.vary(color, place, 0.3, 5.0), n.join(shade, shade, shade), "MULTIPLY"))


def wall(rng: Any) -> bpy.types.Material:
    """Create the wall's material: large cells with light joints; details are at least 6 cm for the larger distance."""
    n = Nodes("wall")
    _, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    choice = n.add("SeparateColor", {0: n.cells(place, 3.2)["Color"]}).outputs[0]
    color = n.ramp(choice, [_linear(code) for code in ("8fb0b8", "a9c3c2", "7f9fb0", "b9c6b8", "98b3a6")])
    edge = n.cells(place, 3.2, "DISTANCE_TO_EDGE")[0]
    return n.glow(n.vary(n.mix(n.step(edge, 0.05, 0.06), _linear("dfe3dc"), color), place, 0.28, 4.0))
