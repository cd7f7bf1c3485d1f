# SPDX-License-Identifier: GPL-3.0-or-later
"""The material of an object that the photo shows: its light over that at rest, its colours, and its highlights.

Where a thing turns, its texture passes over to the one without highlights, and these are added by its normals, so that
they stay where the light is. At rest the texture is the photo's.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.composite.highlights import CELLS, HEADROOM, Highlights, find_highlights
from ...sim.mpm.geometry.triangles import area_normals
from ...sim.reconstruct.mesh_raster import Paint, colours, visible_pixels
from ...sim.scene.meshes import ObjectMesh
from ...sim.scene.model import Camera
from ...sim.srgb import srgb_to_linear
from .. import compat

REST_LIGHT = "rest_light"
"""Vertex colour attribute: L₀ + k, radiance of a white surface at rest plus the ambient term."""
REST_NORMAL = "rest_normal"
"""Vertex attribute: the unit normal at rest, in the world. Geometry that is made later has none, and no highlights."""
COLOUR_LAYER = "texture"
"""Name of the pass with the photo's colours."""
LACK_LAYER = "lack"
"""Name of the pass whose red is what the texture's alpha leaves uncovered (materials without it cover all), and whose
green is the highlights of what has turned."""
AMBIENT_NODE = "ambient"
TURNED = (0.05, 0.25)
"""Turn of the normal, radians, up to which highlights are the photo's, and from which they lie where its light is."""
SEARCHED = 200
"""Pixels along the longer side of an object on which its highlights are looked for."""


def object_material(name: str, image: bpy.types.Image) -> bpy.types.Material:
    """Return a material: diffuse with albedo 1 / (L₀ + k) plus emission k / (L₀ + k); radiance (L + k) / (L₀ + k), 1 at
    rest.
    """
    material = bpy.data.materials.new(name)
    # Emission towards the camera only: emission that Cycles samples as a lamp costs time and adds noise.
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"
    tree = compat.node_tree(material)
    new, link = tree.nodes.new, tree.links.new
    rest = new("ShaderNodeAttribute")
    rest.attribute_name = REST_LIGHT
    inverse = new("ShaderNodeVectorMath")
    inverse.operation = "DIVIDE"
    inverse.inputs[0].default_value = (1.0, 1.0, 1.0)
    link(rest.outputs["Color"], inverse.inputs[1])
    ambient = new("ShaderNodeVectorMath")
    ambient.operation = "SCALE"
    ambient.name = AMBIENT_NODE
    ambient.inputs["Scale"].default_value = 0.0
    link(inverse.outputs["Vector"], ambient.inputs[0])
    diffuse, emission, both = (new(f"ShaderNode{kind}") for kind in ("BsdfDiffuse", "Emission", "AddShader"))
    link(inverse.outputs["Vector"], diffuse.inputs["Color"])
    link(ambient.outputs["Vector"], emission.inputs["Color"])
    # Cycles' last ray still meets surfaces: the ground would be lit by the bodies' undersides, most at contact.
    link(new("ShaderNodeLightPath").outputs["Is Camera Ray"], emission.inputs["Strength"])
    link(diffuse.outputs["BSDF"], both.inputs[0])
    link(emission.outputs["Emission"], both.inputs[1])
    output = new("ShaderNodeOutputMaterial")
    link(both.outputs["Shader"], output.inputs["Surface"])
    texture = new("ShaderNodeTexImage")
    texture.image = image
    # Area-averaged whole texels, so that at rest a pixel shows the photo's pixel without interpolation.
    texture.interpolation = "Closest"
    texture.extension = "EXTEND"
    colour = new("ShaderNodeOutputAOV")
    colour.aov_name = COLOUR_LAYER
    link(texture.outputs["Color"], colour.inputs["Color"])
    uncovered, lack = new("ShaderNodeInvert"), new("ShaderNodeOutputAOV")
    lack.aov_name = LACK_LAYER
    link(texture.outputs["Alpha"], uncovered.inputs["Color"])
    second = new("ShaderNodeCombineXYZ")
    second.name = LACK_LAYER
    link(uncovered.outputs["Color"], second.inputs["X"])
    link(second.outputs["Vector"], lack.inputs["Color"])
    return material


def photo_highlights(
    camera: Camera, mesh: ObjectMesh, uv: NDArray[np.floating], picture: NDArray[np.uint8]
) -> Highlights | None:
    """Return the highlights that the photo of ``camera`` shows on ``mesh``, whose texture is ``picture`` (h, w, 3) at
    ``uv`` (V, 2)."""
    at = camera.project(mesh.vertices)
    extent = float(np.ptp(at[:, :2], axis=0).max())
    shown = visible_pixels(camera, mesh.vertices, mesh.faces, min(1.0, SEARCHED / max(extent, 1.0)))
    if not len(shown.rows):
        return None
    light = srgb_to_linear(colours(shown, at, mesh.faces, Paint(texture=picture, uv=np.asarray(uv))) / 255.0)
    normals = shown.interpolated(mesh.faces, _unit(area_normals(mesh.vertices, mesh.faces)))
    return find_highlights(light, _unit(normals) @ _axes(camera))


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)


def _axes(camera: Camera) -> NDArray[np.float64]:
    """Columns (3, 3): the ways to the right, up and towards ``camera`` in the world."""
    return np.asarray(camera.world_from_camera, dtype=np.float64)[:3, :3] * (1.0, -1.0, -1.0)


def show_highlights(data: bpy.types.Mesh, camera: Camera, found: Highlights, matt: bpy.types.Image) -> None:
    """Let the first material of ``data``, at rest, show the highlights ``found`` by ``camera`` where light puts them.

    matt: its texture without them, ``Highlights.taken_out``.
    """
    normals = np.empty(3 * len(data.vertices), dtype=np.float32)
    data.vertex_normals.foreach_get("vector", normals)
    data.attributes.new(REST_NORMAL, "FLOAT_VECTOR", "POINT").data.foreach_set("vector", normals)
    tree = data.materials[0].node_tree
    normal = tree.nodes.new("ShaderNodeNewGeometry").outputs["Normal"]
    turned = _turned(tree, normal)
    picture = next(node for node in tree.nodes if node.type == "TEX_IMAGE")
    layer = next(node for node in tree.nodes if node.type == "OUTPUT_AOV" and node.aov_name == COLOUR_LAYER)
    plain = _picture(tree, matt, picture.interpolation)
    plain = _maths(tree, "ShaderNodeVectorMath", "MULTIPLY", plain.outputs["Color"], (HEADROOM,) * 3)
    mix = tree.nodes.new("ShaderNodeMix")
    mix.data_type = "VECTOR"
    values = (turned, picture.outputs["Color"], plain)
    for value, socket in zip(values, [item for item in mix.inputs if item.enabled], strict=True):
        tree.links.new(value, socket)
    tree.links.new(next(item for item in mix.outputs if item.enabled), layer.inputs["Color"])
    right, up, towards = _axes(camera).T
    place = tree.nodes.new("ShaderNodeCombineXYZ")
    for axis, way in (("X", right), ("Y", up)):
        along = _maths(tree, "ShaderNodeVectorMath", "DOT_PRODUCT", normal, way.tolist())
        tree.links.new(_maths(tree, "ShaderNodeMath", "MULTIPLY_ADD", along, 0.5, 0.5), place.inputs[axis])
    lobe = _picture(tree, _lobe_image(data.name, found.lobe), "Linear")
    tree.links.new(place.outputs["Vector"], lobe.inputs["Vector"])
    facing = _maths(tree, "ShaderNodeVectorMath", "DOT_PRODUCT", normal, towards.tolist())
    shown = _maths(tree, "ShaderNodeMath", "MULTIPLY", turned, lobe.outputs["Color"])
    shown = _maths(
        tree, "ShaderNodeMath", "MULTIPLY", shown, _maths(tree, "ShaderNodeMath", "GREATER_THAN", facing, 0.0)
    )
    tree.links.new(shown, tree.nodes[LACK_LAYER].inputs["Y"])


def _turned(tree: bpy.types.NodeTree, normal: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Node output: how far, 0 to 1, the surface has turned from its normal at rest; 0 where it has none."""
    rest = tree.nodes.new("ShaderNodeAttribute")
    rest.attribute_name = REST_NORMAL
    unit = _maths(tree, "ShaderNodeVectorMath", "NORMALIZE", rest.outputs["Vector"])
    apart = _maths(tree, "ShaderNodeVectorMath", "DISTANCE", normal, unit)
    step = tree.nodes.new("ShaderNodeMapRange")
    step.interpolation_type = "SMOOTHSTEP"
    step.inputs["From Min"].default_value, step.inputs["From Max"].default_value = TURNED
    tree.links.new(apart, step.inputs["Value"])
    length = _maths(tree, "ShaderNodeVectorMath", "LENGTH", unit)
    return _maths(tree, "ShaderNodeMath", "MULTIPLY", step.outputs["Result"], length)


def _maths(tree: bpy.types.NodeTree, kind: str, operation: str, *given: Any) -> Any:
    """The result of ``operation`` of ``given``: sockets or values."""
    node = tree.nodes.new(kind)
    node.operation = operation
    for value, socket in zip(given, [item for item in node.inputs if item.enabled], strict=True):
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, socket)
        else:
            socket.default_value = value
    return next(item for item in node.outputs if item.enabled)


def _picture(tree: bpy.types.NodeTree, image: bpy.types.Image, interpolation: str) -> bpy.types.Node:
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image, node.interpolation, node.extension = image, interpolation, "EXTEND"
    return node


def _lobe_image(name: str, lobe: NDArray[np.float32]) -> bpy.types.Image:
    image = bpy.data.images.new(f"{name} highlights", CELLS, CELLS, float_buffer=True, is_data=True)
    grey = np.repeat(lobe[..., None], 4, axis=2)
    grey[..., 3] = 1.0
    image.pixels.foreach_set(np.ascontiguousarray(grey, dtype=np.float32).ravel())
    image.pack()
    return image
