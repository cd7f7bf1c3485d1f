# SPDX-License-Identifier: GPL-3.0-or-later
"""Geometry nodes that play a capture: points of the current frame, trails, a body coloured by discrepancy.

Everything is stored in the .blend and driven by the current frame: there is no handler that undo, another file or a
render could lose, and it plays without the add-on.
"""

from __future__ import annotations

from typing import Any

import bpy

from .. import compat
from .capture_motion import CARRIERS

POINTS, BODY = "PhysGen capture points", "PhysGen capture body"
COLOUR = "discrepancy"
"""Colour attribute of the vertices of a body's evaluated mesh."""
SAMPLE, SCORE = "sample", "score"
"""Attributes: sample index of a point; discrepancy at a point, m/s²."""
RAMP = ((0.0, (0.42, 0.44, 0.47)), (0.3, (0.98, 0.80, 0.22)), (0.65, (0.86, 0.13, 0.07)), (1.0, (0.30, 0.0, 0.13)))
"""Colours from zero to maximum discrepancy, linear RGB, distinct from the layers' colours."""

Socket = bpy.types.NodeSocket


def carrier_names(index: int) -> tuple[str, str]:
    """Return the names of the vertex attributes for the ``index``-th carrier point and its weight."""
    return f"carrier_{index}", f"weight_{index}"


def set_input(modifier: bpy.types.Modifier, name: str, value: Any) -> None:
    """Set the input ``name`` of a geometry nodes ``modifier``."""
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            compat.set_modifier_input(modifier, item.identifier, value)
            return
    raise KeyError(name)


class Tree:
    """Builder of a node group."""

    def __init__(self, name: str, inputs: dict[str, tuple[str, Any]]) -> None:
        self.group = bpy.data.node_groups.new(name, "GeometryNodeTree")
        new_socket = self.group.interface.new_socket
        new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
        new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
        for label, (kind, default) in inputs.items():
            socket = new_socket(label, in_out="INPUT", socket_type=f"NodeSocket{kind}")
            if default is not None:
                socket.default_value = default
        self.inputs = self.group.nodes.new("NodeGroupInput").outputs

    def node(self, kind: str, *values: Any, **settings: Any) -> bpy.types.Node:
        """Add a node with its properties set and its visible inputs, in order, linked or set; None leaves one
        as it is.
        """
        node = self.group.nodes.new(kind)
        for name, value in settings.items():
            setattr(node, name, value)
        for socket, value in zip([s for s in node.inputs if s.enabled], values, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.group.links.new(value, socket)
            elif value is not None:
                socket.default_value = value
        return node

    def out(self, kind: str, *values: Any, **settings: Any) -> Socket:
        """Return the first visible output of such a node."""
        return next(s for s in self.node(kind, *values, **settings).outputs if s.enabled)

    def attribute(self, name: Any, kind: str) -> Socket:
        """Add a named attribute of the geometry."""
        return self.out("GeometryNodeInputNamedAttribute", name, data_type=kind)

    def math(self, operation: str, *values: Any) -> Socket:
        """Add a math node."""
        return self.out("ShaderNodeMath", *values, operation=operation)

    def compare(self, operation: str, *values: Any) -> Socket:
        """Add a comparison of two numbers."""
        return self.out("FunctionNodeCompare", *values, operation=operation, data_type="FLOAT")

    def both(self, operation: str, a: Any, b: Any) -> Socket:
        """Add a logical AND."""
        return self.out("FunctionNodeBooleanMath", a, b, operation=operation)

    def finish(self, geometry: Socket) -> bpy.types.NodeTree:
        """Return the group, with ``geometry`` as its output."""
        output = self.group.nodes.new("NodeGroupOutput")
        self.group.links.new(geometry, output.inputs[0])
        for index, node in enumerate(self.group.nodes):
            node.location = (220 * (index // 6), -180 * (index % 6))
        return self.group


def points_group() -> bpy.types.NodeTree:
    """Return a group: points of all samples → small spheres at those of the current frame, tubes along earlier ones."""
    found = bpy.data.node_groups.get(POINTS)
    if found is not None:
        return found
    tree = Tree(
        POINTS,
        {
            "Radius": ("Float", 0.003),
            "Points": ("Bool", True),
            "Trail": ("Float", 0.0),
            "Material": ("Material", None),
            "Trail material": ("Material", None),
        },
    )
    given = tree.inputs
    now = tree.math("SUBTRACT", tree.node("GeometryNodeInputSceneTime").outputs["Frame"], 1.0)
    sample = tree.attribute(SAMPLE, "INT")
    current = tree.compare("EQUAL", sample, now, 0.499)
    ball = tree.out("GeometryNodeMeshIcoSphere", given["Radius"], 2)
    ball = tree.out("GeometryNodeSetMaterial", ball, None, given["Material"])
    smooth = tree.out("GeometryNodeSetShadeSmooth", ball)
    chosen = tree.both("AND", current, given["Points"])
    spheres = tree.out("GeometryNodeInstanceOnPoints", given["Geometry"], chosen, smooth)
    early = tree.compare("LESS_THAN", sample, tree.math("SUBTRACT", now, given["Trail"]))
    other = tree.both("OR", early, tree.compare("GREATER_THAN", sample, now))
    lines = tree.out("GeometryNodeDeleteGeometry", given["Geometry"], other, domain="POINT")
    profile = tree.out("GeometryNodeCurvePrimitiveCircle", 5, tree.math("MULTIPLY", given["Radius"], 0.32))
    tubes = tree.out("GeometryNodeCurveToMesh", tree.out("GeometryNodeMeshToCurve", lines), profile)
    tubes = tree.out("GeometryNodeSetMaterial", tubes, None, given["Trail material"])
    join = tree.node("GeometryNodeJoinGeometry")
    tree.group.links.new(tubes, join.inputs[0])
    tree.group.links.new(spheres, join.inputs[0])
    return tree.finish(join.outputs[0])


def body_group() -> bpy.types.NodeTree:
    """Return a group: body at rest → with its points' non-rigid residuals, and their discrepancy as colour.

    Samples is an object with one vertex per frame and point, frame by frame, addressed by index.
    """
    found = bpy.data.node_groups.get(BODY)
    if found is not None:
        return found
    tree = Tree(
        BODY,
        {
            "Samples": ("Object", None),
            "Frames": ("Int", 1),
            "Points": ("Int", 1),
            "First": ("Int", 0),
            "Shift": ("String", ""),
            "Known": ("String", ""),
            "Deform": ("Bool", False),
            "Colours": ("Bool", False),
            "Most": ("Float", 1.0),
            "Plain": ("Color", (0.5, 0.5, 0.5, 1.0)),
            "Material": ("Material", None),
        },
    )
    given = tree.inputs
    samples = tree.node("GeometryNodeObjectInfo", given["Samples"]).outputs["Geometry"]
    now = tree.math("SUBTRACT", tree.node("GeometryNodeInputSceneTime").outputs["Frame"], 1.0)
    last = tree.math("SUBTRACT", given["Frames"], 1.0)
    frame = tree.math("MAXIMUM", tree.math("MINIMUM", tree.math("ROUND", now), last), 0.0)
    row = tree.math("MULTIPLY", frame, given["Points"])
    score = shift = None
    for index in range(CARRIERS):
        carrier, weight_name = carrier_names(index)
        weight = tree.attribute(weight_name, "FLOAT")
        place = tree.out(
            "FunctionNodeFloatToInt", tree.math("ADD", row, tree.attribute(carrier, "INT")), rounding_mode="ROUND"
        )
        here = _sample(tree, samples, tree.attribute(SCORE, "FLOAT"), place, "FLOAT")
        part = tree.math("MULTIPLY", here, weight)
        score = part if score is None else tree.math("ADD", score, part)
        moved = _sample(tree, samples, tree.attribute(given["Shift"], "FLOAT_VECTOR"), place, "FLOAT_VECTOR")
        scaled = tree.node("ShaderNodeVectorMath", moved, operation="SCALE")
        tree.group.links.new(weight, scaled.inputs["Scale"])
        step = scaled.outputs[0]
        shift = step if shift is None else tree.out("ShaderNodeVectorMath", shift, step, operation="ADD")
    body = tree.out("GeometryNodeSetPosition", given["Geometry"], given["Deform"], None, shift)
    share = tree.math("DIVIDE", score, tree.math("MAXIMUM", given["Most"], 1e-9))
    ramp = tree.node("ShaderNodeValToRGB", share)
    _fill(ramp.color_ramp)
    colour = tree.out("GeometryNodeSwitch", given["Colours"], given["Plain"], ramp.outputs["Color"], input_type="RGBA")
    body = tree.out(
        "GeometryNodeStoreNamedAttribute", body, None, COLOUR, colour, data_type="FLOAT_COLOR", domain="POINT"
    )
    body = tree.out("GeometryNodeSetMaterial", body, None, given["Material"])
    # One value for the whole body, so that a switch suffices: deleting vertices would cost a copy in every frame.
    first = tree.out("FunctionNodeFloatToInt", tree.math("ADD", row, given["First"]), rounding_mode="ROUND")
    known = _sample(tree, samples, tree.attribute(given["Known"], "BOOLEAN"), first, "BOOLEAN")
    return tree.finish(tree.out("GeometryNodeSwitch", known, None, body, input_type="GEOMETRY"))


def _sample(tree: Tree, samples: Socket, value: Socket, index: Socket, kind: str) -> Socket:
    return tree.out("GeometryNodeSampleIndex", samples, value, index, data_type=kind, domain="POINT", clamp=True)


def _fill(ramp: bpy.types.ColorRamp) -> None:
    while len(ramp.elements) < len(RAMP):
        ramp.elements.new(0.5)
    for element, (position, colour) in zip(ramp.elements, RAMP, strict=True):
        element.position, element.color = position, (*colour, 1.0)
