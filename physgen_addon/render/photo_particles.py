# SPDX-License-Identifier: GPL-3.0-or-later
"""Grains and liquid surfaces that replace an object of sand, snow or a liquid where its skin tears.

Until its skin tears an object is its mesh, which equals the photo at rest. Afterwards grains show where the skin is
gone (``photo_grains.py``), and a liquid is the surface around its particles, each of which keeps the colour, and the
reference lighting, of the nearest skin at rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...sim.cache.pc2 import Pc2Reader
from ...sim.scene.folder import Scene
from ...sim.scene.meshes import load_object_mesh
from ...sim.skinning import TORN_STRETCH, first_torn
from ...sim.srgb import srgb_to_linear
from ..playback import particles, point_caches
from ..playback.bake_record import spacing
from ..playback.geometry_nodes import Tree, set_input
from .object_material import COLOUR_LAYER, REST_LIGHT
from .render_scene import UV, RenderObject, get_rest_light, texture_colours, texture_coordinates

SKIN, SURFACE = "PhysGen photo skin", "PhysGen photo surface"
REST_LENGTH = "rest_length"
"""Attribute of the skin's edges, m."""
FADES, FADED = "Fades After", "Faded After"
STEP = "Step"
COLOUR, MIXED = "flow_colour", "flow_mixed"
"""Attributes of particles and of a fluid's surface: texture colour, linear; and how mixed it is."""
BLUR = 6
"""Smoothing steps of particle attributes along a fluid's surface."""
MIXED_FROM, MIXED_TO = 0.7, 2.0
"""Distance on the image of the parts of a fluid that meet, over the spacing of neighbouring particles, at which the
texture starts and ends to give way to the mean of its colours.
"""


def find_tears(bake: point_caches.OpenedBake, folder: Scene) -> point_caches.OpenedBake:
    """Return ``bake`` with the first samples at which particles are shown."""

    def samples(cache: Pc2Reader) -> Iterator[NDArray[np.float32]]:
        return (cache.sample(index) for index in range(cache.sample_count))

    flows = []
    for source, cache, flow in zip(folder.model.objects, bake.caches, bake.flows, strict=True):
        if flow is not None:
            torn = first_torn(samples(cache), load_object_mesh(folder, source).faces)
            flow = dataclasses.replace(flow, from_sample=torn)
        flows.append(flow)
    return dataclasses.replace(bake, flows=tuple(flows))


def add_surface(
    target: RenderObject, flow: point_caches.Flow, first_frame: int, *, carried: tuple[str, ...] = ()
) -> tuple[bpy.types.Object, float]:
    """Add the surface around the particles of the liquid ``flow`` of ``target``, which has reference lighting.

    carried: vector attributes of particles to transfer to the surface. Returns the object that holds the particles, and
    the maximum distance at which they are visible around a particle's centre, m.
    """
    assert flow.from_sample is not None
    rest = flow.cache.sample(0)
    distance = particles.spacing_inside(target.item.data, len(rest)) or spacing(rest)
    radius = distance * particles.SURFACE
    mesh = bpy.data.meshes.new(f"{target.item.name} particles")
    mesh.vertices.add(len(rest))
    mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(rest, dtype=np.float32).ravel())
    _wear(mesh, target, rest)
    mesh.materials.append(_material(target.item.data.materials[0]))
    item = bpy.data.objects.new(mesh.name, mesh)
    for collection in target.item.users_collection:
        collection.objects.link(item)
    point_caches.attach(item, flow.cache, first_frame)
    look = item.modifiers.new(particles.MODIFIER, "NODES")
    look.node_group = _surface_group(carried)
    set_input(look, particles.RADIUS, radius)
    set_input(look, STEP, _step(mesh, rest, distance))
    set_input(look, particles.FROM, first_frame + flow.from_sample)
    set_input(look, particles.MATERIAL, mesh.materials[0])
    return item, radius


def _wear(mesh: bpy.types.Mesh, target: RenderObject, rest: NDArray[np.float32]) -> None:
    """Give the vertices of ``mesh`` at ``rest`` (N, 3) the texture and light of the nearest skin."""
    uv = texture_coordinates(target)
    colours = srgb_to_linear(texture_colours(target, uv).astype(np.float32) / 255.0)
    _, nearest = KDTree(target.mesh.vertices).query(rest)
    three = np.concatenate([uv, np.zeros((len(uv), 1), np.float32)], axis=1)
    for name, values in ((UV, three), (REST_LIGHT, get_rest_light(target)), (COLOUR, colours)):
        attribute = mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", np.ascontiguousarray(values[nearest], dtype=np.float32).ravel())


def _step(mesh: bpy.types.Mesh, rest: NDArray[np.float32], distance: float) -> float:
    """Return the distance of neighbouring particles of ``mesh`` on the image, in texture coordinates.

    rest: (N, 3) world positions, ``distance`` apart.
    """
    uv = np.empty(3 * len(rest), dtype=np.float32)
    mesh.attributes[UV].data.foreach_get("vector", uv)
    extent = np.percentile(uv.reshape(-1, 3), 98, axis=0) - np.percentile(uv.reshape(-1, 3), 2, axis=0)
    size = np.percentile(rest, 98, axis=0) - np.percentile(rest, 2, axis=0)
    return float(np.linalg.norm(extent) / max(float(np.linalg.norm(size)), 1e-9)) * distance


def _material(skin: bpy.types.Material) -> bpy.types.Material:
    """Return the material of the ``skin`` for geometry with texture coordinates as an attribute instead of a UV map,
    blended to the mixed colours.
    """
    material = skin.copy()
    tree = material.node_tree

    def attribute(name: str, socket: str) -> bpy.types.NodeSocket:
        node = tree.nodes.new("ShaderNodeAttribute")
        node.attribute_name = name
        return node.outputs[socket]

    picture = next(node for node in tree.nodes if node.type == "TEX_IMAGE")
    layer = next(node for node in tree.nodes if node.type == "OUTPUT_AOV" and node.aov_name == COLOUR_LAYER)
    tree.links.new(attribute(UV, "Vector"), picture.inputs["Vector"])
    mix = tree.nodes.new("ShaderNodeMix")
    mix.data_type = "VECTOR"
    values = (attribute(MIXED, "Fac"), picture.outputs["Color"], attribute(COLOUR, "Vector"))
    for value, socket in zip(values, [item for item in mix.inputs if item.enabled], strict=True):
        tree.links.new(value, socket)
    tree.links.new(next(item for item in mix.outputs if item.enabled), layer.inputs["Color"])
    return material


def open_skin(
    target: RenderObject, cache: Pc2Reader, from_frame: int, *, gone: bool, fading: tuple[float, float] = (0.0, 0.0)
) -> None:
    """Open the skin where it is stretched, from ``from_frame`` on; and remove it if it is ``gone``.

    fading: between how many frames after ``from_frame`` its faces go, one after another; all at once by default.
    """
    data = target.item.data
    ends = np.empty(2 * len(data.edges), dtype=np.int32)
    data.edges.foreach_get("vertices", ends)
    rest = cache.sample(0)[ends.reshape(-1, 2)]
    attribute = data.attributes.new(REST_LENGTH, "FLOAT", "EDGE")
    attribute.data.foreach_set("value", np.linalg.norm(rest[:, 1] - rest[:, 0], axis=1).astype(np.float32))
    modifier = target.item.modifiers.new(SKIN, "NODES")
    modifier.node_group = _skin_group()
    set_input(modifier, particles.FROM, from_frame)
    set_input(modifier, "Gone", gone)
    set_input(modifier, FADES, float(fading[0]))
    set_input(modifier, FADED, float(fading[1]))


def _skin_group() -> bpy.types.NodeTree:
    inputs: dict[str, tuple[str, Any]] = {particles.FROM: ("Int", 1), "Gone": ("Bool", False)}
    tree = Tree(SKIN, {**inputs, FADES: ("Float", 0.0), FADED: ("Float", 0.0)})
    ends = tree.node("GeometryNodeInputMeshEdgeVertices").outputs
    length = tree.out("ShaderNodeVectorMath", ends["Position 1"], ends["Position 2"], operation="DISTANCE")
    longest = tree.math("MULTIPLY", tree.attribute(REST_LENGTH, "FLOAT"), TORN_STRETCH)
    torn = tree.compare("GREATER_THAN", length, longest)
    open_skin = tree.out("GeometryNodeDeleteGeometry", tree.inputs["Geometry"], torn, domain="EDGE", mode="EDGE_FACE")
    since = tree.math("SUBTRACT", tree.node("GeometryNodeInputSceneTime").outputs["Frame"], tree.inputs[particles.FROM])
    span = tree.math("MAXIMUM", tree.math("SUBTRACT", tree.inputs[FADED], tree.inputs[FADES]), 1e-3)
    share = tree.math("DIVIDE", tree.math("SUBTRACT", since, tree.inputs[FADES]), span)
    # The first faces go with the first frame after FADES, and the last ones not a frame too late.
    lost = tree.compare("LESS_THAN", tree.out("FunctionNodeRandomValue", data_type="FLOAT"), share)
    fading = tree.out("GeometryNodeDeleteGeometry", open_skin, lost, domain="FACE", mode="ALL")
    over = tree.compare("GREATER_EQUAL", share, 1.0)
    left = particles.switch(tree, tree.inputs["Gone"], open_skin, particles.switch(tree, over, fading, None))
    return tree.finish(particles.switch(tree, particles.begun(tree), tree.inputs["Geometry"], left))


def _surface_group(carried: tuple[str, ...]) -> bpy.types.NodeTree:
    """Return a group: the surface around the particles, with attributes of the nearest of them, including
    ``carried``.
    """
    tree = Tree(SURFACE, {**_inputs(), STEP: ("Float", 0.01)})
    inputs = tree.inputs
    shown = particles.switch(tree, particles.begun(tree), None, tree.inputs["Geometry"])
    surface = particles.enclosing_surface(tree, shown, tree.inputs[particles.RADIUS])
    nearest = tree.out("GeometryNodeSampleNearest", shown, tree.out("GeometryNodeInputPosition"), domain="POINT")
    store = "GeometryNodeStoreNamedAttribute"
    for name in (UV, REST_LIGHT, COLOUR, *carried):
        value = tree.attribute(name, "FLOAT_VECTOR")
        there = tree.out("GeometryNodeSampleIndex", shown, value, nearest, data_type="FLOAT_VECTOR", domain="POINT")
        even = tree.out("GeometryNodeBlurAttribute", there, BLUR, data_type="FLOAT_VECTOR")
        if name == UV:
            apart = tree.out("ShaderNodeVectorMath", there, even, operation="DISTANCE")
            apart = tree.math("DIVIDE", apart, inputs[STEP])
            apart = tree.out("GeometryNodeBlurAttribute", apart, BLUR, data_type="FLOAT")
            mixed = tree.out("ShaderNodeMapRange", apart, MIXED_FROM, MIXED_TO, interpolation_type="SMOOTHSTEP")
            surface = tree.out(store, surface, None, MIXED, mixed, data_type="FLOAT", domain="POINT")
        surface = tree.out(store, surface, None, name, even, data_type="FLOAT_VECTOR", domain="POINT")
    return tree.finish(tree.out("GeometryNodeSetMaterial", surface, None, tree.inputs[particles.MATERIAL]))


def _inputs() -> dict[str, tuple[str, Any]]:
    return {particles.RADIUS: ("Float", 0.01), particles.FROM: ("Int", 1), particles.MATERIAL: ("Material", None)}
