# SPDX-License-Identifier: GPL-3.0-or-later
"""Procedural textures.  Details are at least 1.5 cm, so about 3 pixels or more in a 320x240 view from 1.4 m."""

import colorsys
import math

import bpy


class _Nodes:
    """A material's node tree with short words for what the patterns need."""

    def __init__(self, name: str):
        self.material = bpy.data.materials.new(name)
        if self.material.node_tree is None:
            self.material.use_nodes = True
        self.tree = self.material.node_tree
        self.tree.nodes.clear()

    def add(self, kind: str, inputs=None, **settings):
        """New node; `inputs` maps socket name or index to a value or to another node's output."""
        node = self.tree.nodes.new("ShaderNode" + kind)
        for key, value in settings.items():
            setattr(node, key, value)
        for key, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[key])
            else:
                node.inputs[key].default_value = value
        return node

    def math(self, operation: str, *values):
        return self.add("Math", dict(enumerate(values)), operation=operation).outputs[0]

    def mix(self, factor, a, b, blend: str = "MIX"):
        node = self.add("Mix", {0: factor, 6: a, 7: b}, data_type="RGBA", blend_type=blend)
        return node.outputs[2]

    def ramp(self, value, colours, soft: bool = False, stops=None):
        """Colours over 0..1, in steps or (`soft`) blended."""
        node = self.add("ValToRGB", {0: value})
        ramp = node.color_ramp
        ramp.interpolation = "EASE" if soft else "CONSTANT"
        n = len(colours)
        stops = stops or ([i / max(n - 1, 1) for i in range(n)] if soft else [i / n for i in range(n)])
        while len(ramp.elements) < n:
            ramp.elements.new(1.0)
        for element, stop, colour in zip(ramp.elements, stops, colours):
            element.position, element.color = stop, colour
        return node.outputs[0]

    def step(self, value, edge: float, width: float):
        """0 below, 1 above `edge`, blended over `width`."""
        node = self.add("MapRange", {0: value, 1: edge - width / 2, 2: edge + width / 2, 3: 0.0, 4: 1.0})
        return node.outputs[0]

    def place(self, offset):
        """Object coordinates in metres, moved by a seeded offset."""
        coordinates = self.add("TexCoord").outputs["Object"]
        return coordinates, self.add("VectorMath", {0: coordinates, 1: offset}, operation="ADD").outputs[0]

    def wrap(self, coordinates, around: int):
        """(turns x `around`, height in metres) around the z axis."""
        x, y, z = self.add("SeparateXYZ", {0: coordinates}).outputs
        turn = self.math("DIVIDE", self.math("ARCTAN2", y, x), 2 * math.pi)
        return self.math("MULTIPLY", turn, float(around)), z

    def join(self, x, y, z=0.0):
        return self.add("CombineXYZ", {0: x, 1: y, 2: z}).outputs[0]

    def noise(self, vector, scale: float, detail: float = 1.0):
        return self.add("TexNoise", {"Vector": vector, "Scale": scale, "Detail": detail, "Roughness": .45}).outputs[0]

    def cells(self, vector, scale: float, feature: str = "F1", random: float = 1.0):
        node = self.add("TexVoronoi", {"Vector": vector, "Scale": scale, "Randomness": random}, feature=feature)
        return node.outputs

    def vary(self, colour, place, amount: float = .35, scale: float = 14.0):
        """Lighter and darker patches, so that repeats of a pattern can be told apart."""
        greys = [_grey(1 - amount), _grey(1.0), _grey(1 - amount / 2), _grey(1.0)]
        patches = self.ramp(self.noise(place, scale, 1.5), greys, soft=True, stops=[.3, .45, .58, .72])
        return self.mix(1.0, colour, patches, "MULTIPLY")

    def glow(self, colour):
        """Colour that needs no light: none is traced for the room, half of the pixels, and none of it is noisy."""
        shader = self.add("Emission", {0: colour, 1: .9})
        self.tree.links.new(shader.outputs[0], self.add("OutputMaterial").inputs[0])
        self.material.cycles.emission_sampling = "NONE"
        return self.material

    def finish(self, colour, roughness: float = .85, specular: float = .1):
        shader = self.add("BsdfPrincipled", {"Base Color": colour, "Roughness": roughness,
                                             "Specular IOR Level": specular})
        output = self.add("OutputMaterial")
        self.tree.links.new(shader.outputs[0], output.inputs[0])
        return self.material


def _grey(value: float):
    return (value, value, value, 1.0)


def _linear(code: str, turn: float = 0.0):
    """Scene-linear RGBA of an sRGB "rrggbb", its hue turned by `turn` (1 = full circle)."""
    rgb = [int(code[i:i + 2], 16) / 255 for i in (0, 2, 4)]
    hue, light, colour = colorsys.rgb_to_hls(*rgb)
    rgb = colorsys.hls_to_rgb((hue + turn) % 1.0, light, colour)
    return (*[((c + .055) / 1.055) ** 2.4 if c > .04045 else c / 12.92 for c in rgb], 1.0)


def _checker(n, raw, place, c, size, around):
    u, z = n.wrap(raw, 2 * round(around / 2))
    v = n.math("DIVIDE", z, size)
    flags = n.add("TexChecker", {"Vector": n.join(u, v, .5), "Scale": 1.0, "Color1": c[0], "Color2": c[1]}).outputs[0]
    return n.mix(n.step(n.noise(place, 9.0), .56, .06), flags, c[2])


def _bricks(n, raw, place, c, size, around):
    u, z = n.wrap(raw, around)
    vector = n.join(n.math("MULTIPLY", u, .5), n.math("DIVIDE", z, size * 4))
    sizes = {"Scale": 1.0, "Mortar Size": .022, "Mortar Smooth": .3, "Brick Width": .5, "Row Height": .25}
    colours = {"Color1": c[0], "Color2": c[1], "Mortar": c[2]}
    return n.add("TexBrick", {"Vector": vector, **colours, **sizes}).outputs[0]


def _mosaic(n, raw, place, c, size, around):
    scale = 1 / (size * 1.5)
    choice = n.add("SeparateColor", {0: n.cells(place, scale)["Color"]}).outputs[0]
    edge = n.cells(place, scale, "DISTANCE_TO_EDGE")[0]
    return n.mix(n.step(edge, .07, .04), c[-1], n.ramp(choice, c[:-1]))


def _dots(n, raw, place, c, size, around):
    out = n.cells(place, 1 / (size * 1.7), random=.35)
    choice = n.add("SeparateColor", {0: out["Color"]}).outputs[0]
    inside = n.math("SUBTRACT", 1.0, n.step(out["Distance"], .36, .05))
    return n.mix(inside, c[0], n.ramp(choice, c[1:]))


def _zigzag(n, raw, place, c, size, around):
    u, z = n.wrap(raw, max(4, around // 2))
    saw = n.math("PINGPONG", u, .5)
    bands = n.math("FRACT", n.math("ADD", n.math("DIVIDE", z, size * 3.2), n.math("MULTIPLY", saw, .8)))
    return n.ramp(bands, c)


def _waves(n, raw, place, c, size, around):
    values = {"Vector": place, "Scale": .09 / size, "Distortion": 5.0, "Detail": 1.0, "Detail Scale": 1.2}
    node = n.add("TexWave", values, wave_type="BANDS", bands_direction="DIAGONAL")
    return n.ramp(node.outputs[1], c)


def _clouds(n, raw, place, c, size, around):
    stops = [0] + [.38 + .24 * i / (len(c) - 2) for i in range(len(c) - 1)]
    return n.ramp(n.noise(place, .42 / size, 1.5), c, stops=stops)


# kind: pattern, size of a detail (m), details around, sRGB colours, roughness, specular level
LOOKS = {
    "mug": (_checker, .025, 14, ("e8e0cf", "c0392b", "e9a23b"), .8, .1),
    "bottle": (_zigzag, .022, 12, ("1f6f5c", "e6dcae", "2f9a76", "d98e32"), .8, .1),
    "ring": (_dots, .020, 12, ("efc94c", "8e3b7c", "d4552f", "3a62a8"), .8, .1),
    "bowl": (_bricks, .024, 22, ("3f7fb5", "86b9d6", "f0ead8"), .8, .1),
    "books": (_mosaic, .026, 16, ("b5413a", "dfb15b", "3c5f86", "e8dcc6", "4b3a36"), .85, .1),
    "monkey": (_clouds, .024, 12, ("6d3f23", "c98a4b", "8a5530", "e3bb82", "5b3520"), .85, .1),
    "teapot": (_mosaic, .022, 16, ("d9e4e3", "4a8f9c", "e8b7a4", "2f5d78", "f4efe4"), .42, .35),
    "vase": (_waves, .024, 12, ("5a3f80", "c9b2dd", "8557a5", "ead9b8"), .45, .3),
    "cone": (_zigzag, .02, 14, ("d1442f", "f2e4c4", "e58a2c"), .85, .1),
    "ball": (_mosaic, .03, 12, ("37966f", "e3c94f", "c9503c", "eee6d2"), .8, .1),
    "die": (_dots, .025, 12, ("35507a", "e8e0cf", "e0a63a"), .8, .1),
    "pumpkin": (_clouds, .022, 12, ("c65a17", "e88c2c", "a8430f", "f2b04e", "8c3a10"), .85, .1),
    "mushroom": (_dots, .022, 12, ("b8302a", "efe6d6", "f0c98a"), .8, .1),
    "gear": (_waves, .024, 12, ("43606b", "9fb6b8", "6f8a90", "d8c27a"), .7, .2),
}


def material(kind: str, rng) -> bpy.types.Material:
    """The material of one kind of object; hue and place of the pattern vary with the random generator `rng`."""
    pattern, size, around, codes, roughness, specular = LOOKS[kind]
    turn = float(rng.uniform(-.03, .03))
    n = _Nodes(kind)
    raw, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    colour = pattern(n, raw, place, [_linear(code, turn) for code in codes], size, around)
    return n.finish(n.vary(colour, place), roughness, specular)


def table(rng) -> bpy.types.Material:
    """Planks of warm wood with knots."""
    n = _Nodes("table")
    raw, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    planks = n.add("TexBrick", {"Vector": raw, "Color1": _linear("b98a5c"), "Color2": _linear("96683f"),
                                "Mortar": _linear("5f4029"), "Scale": 1.0, "Mortar Size": .004, "Mortar Smooth": .6,
                                "Brick Width": .42, "Row Height": .085}).outputs[0]
    stretched = n.add("VectorMath", {0: place, 1: (7.0, 32.0, 20.0)}, operation="MULTIPLY").outputs[0]
    grain = n.ramp(n.noise(stretched, 1.0, 1.5), [_grey(.62), _grey(1.0), _grey(.78), _grey(1.0)], soft=True,
                   stops=[.32, .46, .56, .68])
    colour = n.mix(1.0, planks, grain, "MULTIPLY")
    return n.finish(n.vary(colour, place, .25, 6.0))


def floor(rng) -> bpy.types.Material:
    """Tiles, darker under the table."""
    n = _Nodes("floor")
    raw, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    colour = n.add("TexChecker", {"Vector": place, "Scale": 4.5, "Color1": _linear("8d857c"),
                                  "Color2": _linear("a69c90")}).outputs[0]
    x, y, _ = n.add("SeparateXYZ", {0: raw}).outputs
    away = n.math("SQRT", n.math("ADD", n.math("MULTIPLY", x, x), n.math("MULTIPLY", y, y)))
    shade = n.add("MapRange", {0: away, 1: .2, 2: 1.7, 3: .35, 4: .8}, interpolation_type="SMOOTHSTEP").outputs[0]
    return n.glow(n.mix(1.0, n.vary(colour, place, .3, 5.0), n.join(shade, shade, shade), "MULTIPLY"))


def wall(rng) -> bpy.types.Material:
    """Large cells with light joints; details of 6 cm and more, as the wall is farther away."""
    n = _Nodes("wall")
    _, place = n.place(tuple(map(float, rng.uniform(-5, 5, 3))))
    choice = n.add("SeparateColor", {0: n.cells(place, 3.2)["Color"]}).outputs[0]
    colour = n.ramp(choice, [_linear(code) for code in ("8fb0b8", "a9c3c2", "7f9fb0", "b9c6b8", "98b3a6")])
    edge = n.cells(place, 3.2, "DISTANCE_TO_EDGE")[0]
    return n.glow(n.vary(n.mix(n.step(edge, .05, .06), _linear("dfe3dc"), colour), place, .28, 4.0))
