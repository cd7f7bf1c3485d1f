# SPDX-License-Identifier: GPL-3.0-or-later
"""Procedural surfaces for Cycles: floors, cloths, prints."""

from __future__ import annotations

import math

import bpy
from numpy.typing import NDArray
from physgen.physgen_addon import compat

from .cases import Case, Item

PAINT = "paint"
"""Attribute of vertices with their albedo, where a body has its own colours."""


class _Nodes:
    """Nodes of one material with the wires between them."""

    def __init__(self, name: str) -> None:
        self.material = bpy.data.materials.new(name)
        self.tree = compat.node_tree(self.material)

    def add(self, kind: str, **settings: object) -> bpy.types.Node:
        node = self.tree.nodes.new(f"ShaderNode{kind}")
        for key, value in settings.items():
            setattr(node, key, value)
        return node

    def put(self, node: bpy.types.Node, slot: str | int, value: object) -> None:
        """A number, a colour of three, or another node's output into ``slot``."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, node.inputs[slot])
        elif isinstance(value, float | int):
            node.inputs[slot].default_value = float(value)
        else:
            values = tuple(float(v) for v in value)  # type: ignore[attr-defined]
            target = node.inputs[slot].default_value
            node.inputs[slot].default_value = (*values, 1.0) if len(target) == 4 else values

    def made(self, kind: str, inputs: dict[str | int, object], output: str | int = 0, **settings: object) -> object:
        """The output of a new node with these inputs."""
        node = self.add(kind, **settings)
        for slot, value in inputs.items():
            self.put(node, slot, value)
        return node.outputs[output]

    def mixed(self, share: object, first: object, second: object) -> object:
        """Colour between two by ``share``."""
        node = self.add("Mix", data_type="RGBA")
        colours = [s for s in node.inputs if s.type == "RGBA"]
        self.put(node, 0, share)
        for socket, value in zip(colours, (first, second), strict=True):
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, socket)
            else:
                socket.default_value = (*(float(v) for v in value), 1.0)  # type: ignore[attr-defined]
        return next(s for s in node.outputs if s.type == "RGBA")

    def stepped(self, value: object, low: float, high: float) -> object:
        """0 below ``low``, 1 above ``high``, straight between."""
        return self.made("MapRange", {"Value": value, "From Min": low, "From Max": high})

    def noise(self, place: object, scale: float, detail: float = 4.0, twist: float = 0.0) -> object:
        """Noise around 0.5."""
        return self.made("TexNoise", {"Vector": place, "Scale": scale, "Detail": detail, "Distortion": twist})

    def finish(self, colour: object, roughness: float, relief: object | None, height: float) -> bpy.types.Material:
        """Wire the surface; ``relief`` is a bump of ``height`` metres."""
        shader = self.add("BsdfPrincipled")
        self.put(shader, "Base Color", colour)
        self.put(shader, "Roughness", roughness)
        self.put(shader, "Specular IOR Level", 0.35)
        if relief is not None:
            bump = self.made("Bump", {"Height": relief, "Distance": height, "Strength": 0.6})
            self.put(shader, "Normal", bump)
        output = self.add("OutputMaterial")
        self.tree.links.new(shader.outputs[0], output.inputs["Surface"])
        return self.material


def floor(case: Case) -> bpy.types.Material:
    """The ground's surface; lengths of its pattern are multiples of ``case.grain``."""
    nodes = _Nodes("ground")
    position = nodes.made("NewGeometry", {}, "Position")
    turned = nodes.made("VectorRotate", {"Vector": position, "Angle": case.ground_turn}, rotation_type="Z_AXIS")
    place = nodes.made("VectorMath", {0: turned, "Scale": 1.0 / case.grain}, operation="SCALE")
    bright, dark, third = case.ground_paint
    fine = nodes.noise(place, 14.0, 3.0)
    soft = nodes.noise(place, 0.9, 1.0)
    kind = case.ground
    relief, height, roughness = fine, 0.002 * case.grain, 0.6
    if kind == "boards":
        long = nodes.made("VectorMath", {0: place, 1: (1.5, 22.0, 1.0)}, operation="MULTIPLY")
        grain = nodes.stepped(nodes.noise(long, 1.0, 4.0, 0.6), 0.35, 0.68)
        board = nodes.made(
            "TexBrick",
            {
                "Vector": place,
                "Color1": bright,
                "Color2": (bright + dark) / 2,
                "Mortar": third,
                "Scale": 1.0,
                "Mortar Size": 0.006,
                "Mortar Smooth": 0.2,
                "Brick Width": 2.6,
                "Row Height": 0.45,
            },
        )
        veins = nodes.made("MapRange", {"Value": grain, "To Min": 0.0, "To Max": 0.55})
        colour = nodes.mixed(veins, board, dark)
        roughness = 0.45
    elif kind == "tiles":
        relief = nodes.made(
            "TexBrick",
            {
                "Vector": place,
                "Color1": (1, 1, 1),
                "Color2": (0.86, 0.86, 0.86),
                "Mortar": (0, 0, 0),
                "Scale": 1.0,
                "Mortar Size": 0.022,
                "Mortar Smooth": 0.15,
                "Brick Width": 1.0,
                "Row Height": 1.0,
            },
            offset=0.0,
        )
        stone = nodes.mixed(nodes.stepped(nodes.noise(place, 3.0, 4.0, 1.0), 0.3, 0.75), bright, (bright + third) / 2)
        colour = nodes.mixed(relief, dark * 0.6, stone)
        roughness = 0.4
    elif kind == "checks":
        share = nodes.made("TexChecker", {"Vector": place, "Scale": 1.6}, 1)
        cloth = nodes.mixed(share, bright, dark)
        colour = nodes.mixed(nodes.stepped(fine, 0.2, 1.4), cloth, third)
    elif kind == "marble":
        veins = nodes.stepped(nodes.noise(place, 1.3, 5.0, 2.2), 0.42, 0.62)
        colour = nodes.mixed(veins, bright, dark)
        relief, roughness = soft, 0.35
    elif kind == "plain":
        colour = nodes.mixed(nodes.stepped(soft, 0.2, 1.6), bright, dark)
    elif kind == "cloth":
        across = nodes.made("TexWave", {"Vector": place, "Scale": 5.0, "Distortion": 0.6}, 1, bands_direction="X")
        along = nodes.made("TexWave", {"Vector": place, "Scale": 5.0, "Distortion": 0.6}, 1, bands_direction="Y")
        relief = nodes.made("Math", {0: across, 1: along}, operation="MULTIPLY")
        colour = nodes.mixed(relief, dark, nodes.mixed(nodes.stepped(soft, 0.3, 0.7), bright, (bright + third) / 2))
        roughness = 0.9
    elif kind == "stripes":
        band = nodes.made("TexWave", {"Vector": place, "Scale": 0.55}, 1, bands_direction="X")
        colour = nodes.mixed(nodes.stepped(band, 0.45, 0.55), bright, dark)
        colour = nodes.mixed(nodes.stepped(fine, 0.3, 1.3), colour, third)
        roughness = 0.85
    elif kind == "concrete":
        share = nodes.stepped(nodes.noise(place, 2.2, 6.0), 0.3, 0.72)
        colour = nodes.mixed(share, bright, dark)
    elif kind == "prints":
        cells = nodes.made("TexVoronoi", {"Vector": place, "Scale": 1.1, "Randomness": 0.9})
        wobble = nodes.made("Math", {0: cells, 1: nodes.noise(place, 5.0, 2.0)}, operation="MULTIPLY")
        colour = nodes.mixed(nodes.stepped(wobble, 0.14, 0.155), dark, bright)
    elif kind == "dots":
        cells = nodes.made("TexVoronoi", {"Vector": place, "Scale": 1.8, "Randomness": 0.0})
        colour = nodes.mixed(nodes.stepped(cells, 0.24, 0.26), dark, bright)
        colour = nodes.mixed(nodes.stepped(soft, 0.3, 1.4), colour, third)
    else:
        tufts = nodes.made("TexVoronoi", {"Vector": place, "Scale": 26.0})
        relief, height = tufts, 0.02 * case.grain
        blotch = nodes.mixed(nodes.stepped(nodes.noise(place, 2.5, 3.0), 0.3, 0.7), bright, (bright + dark) / 2)
        colour = nodes.mixed(nodes.stepped(tufts, 0.0, 0.9), blotch, dark)
        roughness = 0.95
    return nodes.finish(colour, roughness, relief, height)


def wall(colour: NDArray, grain: float) -> bpy.types.Material:
    """Painted plaster."""
    nodes = _Nodes("wall")
    position = nodes.made("NewGeometry", {}, "Position")
    place = nodes.made("VectorMath", {0: position, "Scale": 1.0 / grain}, operation="SCALE")
    rough = nodes.noise(place, 20.0, 2.0)
    shade = nodes.stepped(nodes.noise(place, 0.5, 1.0), 0.1, 1.8)
    return nodes.finish(nodes.mixed(shade, colour, colour * 0.75), 0.8, rough, 0.003 * grain)


def skin(item: Item, which: int) -> bpy.types.Material:
    """The surface of a thing, paint ``which`` of it."""
    nodes = _Nodes(item.name)
    raw = nodes.made("TexCoord", {}, "Object")
    size = float(item.body.mesh.extents.max())
    place = nodes.made("VectorMath", {0: raw, "Scale": 1.0 / size}, operation="SCALE")
    first, second = item.paint if which == 0 else item.paint[::-1]
    fine = nodes.noise(place, 30.0, 2.0)
    relief: object | None = None
    colour: object = first
    style = item.print
    if item.body.colours is not None:
        colour = nodes.made("Attribute", {}, "Color", attribute_name=PAINT)
        relief = fine if item.roughness > 0.6 else None
    elif style == "stripes":
        band = nodes.made("TexWave", {"Vector": place, "Scale": 1.6}, 1, bands_direction="Z")
        colour = nodes.mixed(nodes.stepped(band, 0.47, 0.53), first, second)
    elif style == "dots":
        cells = nodes.made("TexVoronoi", {"Vector": place, "Scale": 5.0, "Randomness": 0.25})
        colour = nodes.mixed(nodes.stepped(cells, 0.27, 0.3), second, first)
    elif style == "noise":
        colour = nodes.mixed(nodes.stepped(nodes.noise(place, 18.0, 4.0), 0.3, 0.7), first, first * 0.6)
        relief = fine
    elif style == "wood":
        long = nodes.made("VectorMath", {0: place, 1: (14.0, 14.0, 1.5)}, operation="MULTIPLY")
        colour = nodes.mixed(nodes.stepped(nodes.noise(long, 1.0, 3.0, 0.5), 0.35, 0.65), first, first * 0.55)
    elif style == "checks":
        colour = nodes.mixed(nodes.made("TexChecker", {"Vector": place, "Scale": 4.63}, 1), first, second)
    elif style == "patches":
        share = nodes.stepped(nodes.noise(place, 3.5, 2.0), 0.5, 0.53)
        colour = nodes.mixed(share, first, second)
    else:
        colour = nodes.mixed(nodes.stepped(fine, 0.2, 2.2), first, first * 0.6)
    if item.kind == "book":
        # Paper on the sides, the cover on top and bottom.
        normal = nodes.made("TexCoord", {}, "Normal")
        parts = nodes.add("SeparateXYZ")
        nodes.put(parts, 0, normal)
        upright = nodes.made("Math", {0: parts.outputs[2]}, operation="ABSOLUTE")
        leaves = nodes.made("TexWave", {"Vector": place, "Scale": 60.0}, 1, bands_direction="Z")
        paper = nodes.mixed(leaves, (0.42, 0.38, 0.3), (0.62, 0.58, 0.48))
        back = nodes.stepped(parts.outputs[0], -0.9, -0.8)
        side = nodes.mixed(back, colour, paper)
        colour = nodes.mixed(nodes.stepped(upright, 0.4, 0.6), side, colour)
    return nodes.finish(colour, item.roughness, relief, 0.004 * size)


def sky(case: Case) -> bpy.types.World:
    """Bright above, dimmer towards and below the horizon; irradiance of open ground about pi."""
    world = bpy.data.worlds.new("sky")
    tree = compat.node_tree(world)
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    parts = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(coordinates.outputs["Generated"], parts.inputs[0])
    ramp = tree.nodes.new("ShaderNodeMapRange")
    tree.links.new(parts.outputs[2], ramp.inputs["Value"])
    ramp.inputs["To Min"].default_value = 1.0 - case.sky_gradient
    ramp.inputs["To Max"].default_value = 1.0 + case.sky_gradient / 2
    shader = tree.nodes.new("ShaderNodeBackground")
    shader.inputs["Color"].default_value = (*case.sky, 1.0)
    tree.links.new(ramp.outputs[0], shader.inputs["Strength"])
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(shader.outputs[0], output.inputs[0])
    return world


def lamp_energy(strength: float, elevation_sine: float, distance: float | None) -> float:
    """Blender's number for a lamp that gives open ground ``strength`` times the sky's pi."""
    if distance is None:
        return math.pi * strength / elevation_sine
    # A disc that looks at the place radiates P / pi per steradian.
    return math.pi * strength * math.pi * distance**2 / elevation_sine
