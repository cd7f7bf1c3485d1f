# SPDX-License-Identifier: GPL-3.0-or-later
"""Materials of a capture's layers."""

from __future__ import annotations

import bpy

from .. import compat
from .geometry_nodes import COLOUR

OBSERVED, NOMINAL, FOUND = "observed", "nominal", "found"
LAYERS = (OBSERVED, NOMINAL, FOUND)
COLOURS = {OBSERVED: (0.9, 0.9, 0.9), NOMINAL: (1.0, 0.36, 0.04), FOUND: (0.0, 0.62, 0.55)}
"""Linear RGB: white, orange, blue-green; distinguishable with red-green colour blindness."""
BODIES = {**COLOURS, OBSERVED: (0.25, 0.27, 0.3)}
"""Of the meshes: white points would be invisible on a white one."""
GROUND = (0.16, 0.17, 0.18)
GHOST_ALPHA = 0.35


def plain_material(name: str, colour: tuple[float, float, float], *, alpha: float = 1.0) -> bpy.types.Material:
    """Return the material ``PhysGen NAME`` of this colour (linear), reusing an existing one."""
    found = bpy.data.materials.get(f"PhysGen {name}")
    if found is not None:
        return found
    material = bpy.data.materials.new(f"PhysGen {name}")
    material.diffuse_color = (*colour, alpha)
    tree = compat.node_tree(material)
    shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = 0.6
    shader.inputs["Alpha"].default_value = alpha
    _show(tree, shader.outputs[0])
    return material


def glowing_material(name: str, colour: tuple[float, float, float]) -> bpy.types.Material:
    """Return a half-emissive material: small points keep their colour in the shade."""
    material = plain_material(name, colour)
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.inputs["Emission Color"].default_value = (*colour, 1.0)
    shader.inputs["Emission Strength"].default_value = 0.5
    return material


def body_material(layer: str) -> bpy.types.Material:
    """Return the material that shows the mesh's colour attribute: the layer's colour, or the discrepancy."""
    found = bpy.data.materials.get(f"PhysGen {layer} body")
    if found is not None:
        return found
    material = bpy.data.materials.new(f"PhysGen {layer} body")
    material.diffuse_color = (*BODIES[layer], 1.0)
    tree = compat.node_tree(material)
    attribute = tree.nodes.new("ShaderNodeAttribute")
    attribute.attribute_name = COLOUR
    shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
    shader.inputs["Roughness"].default_value = 0.7
    tree.links.new(attribute.outputs["Color"], shader.inputs["Base Color"])
    tree.links.new(attribute.outputs["Color"], shader.inputs["Emission Color"])
    shader.inputs["Emission Strength"].default_value = 0.35
    _show(tree, shader.outputs[0])
    return material


def _show(tree: bpy.types.NodeTree, shader: bpy.types.NodeSocket) -> None:
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader, output.inputs["Surface"])
