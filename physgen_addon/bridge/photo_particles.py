# SPDX-License-Identifier: GPL-3.0-or-later
"""Particles of a photo's objects: grains or a liquid's surface, in the photo's colours and light, where the skin tears.

Until its skin tears an object is its mesh, which is the photo at rest. From then on grains show where the skin is
gone, and a liquid is the surface around its particles. A particle keeps the colour, and the light at rest, of the skin
that was nearest to it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...sim.cache.pc2 import Pc2Reader
from ...sim.composite.transfer import srgb_to_linear
from ...sim.scene.folder import SceneFolder
from ...sim.scene.meshes import load_object_mesh
from ...sim.skinning.tearing import TORN_STRETCH, first_torn
from ..bake_record import spacing
from . import caches, points
from .capture_nodes import Tree, set_input
from .objects import COLOUR_LAYER, REST_LIGHT, UV, RenderObject, get_rest_light

SKIN, GRAINS, SURFACE = "PhysGen photo skin", "PhysGen photo grains", "PhysGen photo surface"
REST_LENGTH = "rest_length"
"""Attribute of the skin's edges, m."""
STEP = "Step"
EACH, SMALLER = 8, 0.5
"""How many grains a particle stands for, and their size over that of one. A particle is millimetres of sand, and begins
on a lattice that one grain each would show."""
COLOUR, MIXED = "flow_colour", "flow_mixed"
"""Attributes of particles: the picture's colour there, linear; of a liquid's surface too, and how mixed it is there."""
BLUR = 6
"""How often what a liquid's surface has from its particles is averaged along it: each part is of one particle."""
MIXED_FROM, MIXED_TO = 0.7, 2.0
"""Of a liquid, over the distance of neighbouring particles on the picture: how far the places on it that meet were
apart before its picture gives way to the mean of its colours. Between them lies another part of the picture."""


def find_tears(bake: caches.Bake, folder: SceneFolder) -> caches.Bake:
    """``bake`` with the samples from which on particles are shown."""

    def samples(cache: Pc2Reader) -> Iterator[NDArray[np.float32]]:
        return (cache.sample(index) for index in range(cache.sample_count))

    flows = []
    for source, cache, flow in zip(folder.scene.objects, bake.caches, bake.flows, strict=True):
        if flow is not None:
            torn = first_torn(samples(cache), load_object_mesh(folder, source).faces)
            flow = dataclasses.replace(flow, from_sample=torn)
        flows.append(flow)
    return dataclasses.replace(bake, flows=tuple(flows))


def add(
    target: RenderObject, flow: caches.Flow, cache: Pc2Reader, first_frame: int, *, carried: tuple[str, ...] = ()
) -> tuple[bpy.types.Object, float]:
    """Let ``target``, which plays ``cache`` and whose light at rest is known, show the particles of ``flow``.

    carried: vectors of particles that what is shown of them is to have too. Returns what holds the particles, and how
    far beyond a particle's centre something of it can be seen, m.
    """
    assert flow.from_sample is not None
    rest = flow.cache.sample(0)
    distance = spacing(rest)
    radius = distance * (points.SURFACE if flow.surface else points.GRAIN)
    mesh = bpy.data.meshes.new(f"{target.item.name} particles")
    mesh.vertices.add(len(rest))
    mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(rest, dtype=np.float32).ravel())
    _wear(mesh, target, rest)
    mesh.materials.append(_material(target.item.data.materials[0], mixes=flow.surface))
    item = bpy.data.objects.new(mesh.name, mesh)
    for collection in target.item.users_collection:
        collection.objects.link(item)
    caches.attach(item, flow.cache, first_frame)
    look = item.modifiers.new(points.MODIFIER, "NODES")
    look.node_group = _surface_group(carried) if flow.surface else _grains_group()
    set_input(look, points.RADIUS, radius)
    set_input(look, STEP, _step(mesh, rest, distance))
    set_input(look, points.FROM, first_frame + flow.from_sample)
    set_input(look, points.MATERIAL, mesh.materials[0])
    _tear(target, cache, first_frame + flow.from_sample, gone=flow.surface)
    # Grains stray by half the particles' distance along each of three axes.
    reach = radius if flow.surface else radius * SMALLER * points.LARGEST + math.sqrt(0.75) * distance
    return item, reach


def _wear(mesh: bpy.types.Mesh, target: RenderObject, rest: NDArray[np.float32]) -> None:
    """Give the vertices of ``mesh`` at ``rest`` (N, 3) the picture and the light of the skin nearest to them."""
    skin = target.item.data
    corners = np.empty(len(skin.loops), dtype=np.int32)
    skin.loops.foreach_get("vertex_index", corners)
    by_corner = np.empty(2 * len(corners), dtype=np.float32)
    skin.uv_layers[UV].data.foreach_get("uv", by_corner)
    uv = np.zeros((len(target.mesh.vertices), 3), dtype=np.float32)
    uv[corners, :2] = by_corner.reshape(-1, 2)
    _, nearest = KDTree(target.mesh.vertices).query(rest)
    for name, values in ((UV, uv), (REST_LIGHT, get_rest_light(target)), (COLOUR, _colours(target, uv))):
        attribute = mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", np.ascontiguousarray(values[nearest], dtype=np.float32).ravel())


def _colours(target: RenderObject, uv: NDArray[np.float32]) -> NDArray[np.float32]:
    """Linear colours (V, 3) of the picture that ``target`` wears, at the texture coordinates ``uv`` (V, 3)."""
    material = target.item.data.materials[0]
    image = next(node for node in material.node_tree.nodes if node.type == "TEX_IMAGE").image
    width, height = image.size
    pixels = np.empty(4 * width * height, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    columns = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    rows = np.clip((uv[:, 1] * height).astype(int), 0, height - 1)
    # The pixels of an 8-bit image are as stored: sRGB.
    return srgb_to_linear(pixels.reshape(height, width, 4)[rows, columns, :3])


def _step(mesh: bpy.types.Mesh, rest: NDArray[np.float32], distance: float) -> float:
    """How far apart neighbouring particles of ``mesh`` are on the picture, in texture coordinates.

    rest: (N, 3) where they are in the world, ``distance`` apart.
    """
    uv = np.empty(3 * len(rest), dtype=np.float32)
    mesh.attributes[UV].data.foreach_get("vector", uv)
    extent = np.percentile(uv.reshape(-1, 3), 98, axis=0) - np.percentile(uv.reshape(-1, 3), 2, axis=0)
    size = np.percentile(rest, 98, axis=0) - np.percentile(rest, 2, axis=0)
    return float(np.linalg.norm(extent) / max(float(np.linalg.norm(size)), 1e-9)) * distance


def _material(skin: bpy.types.Material, *, mixes: bool) -> bpy.types.Material:
    """The material of the ``skin`` for what has its texture coordinates as an attribute instead of a UV map.

    mixes: it also has colours that take over where it is mixed.
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
    if mixes:
        mix = tree.nodes.new("ShaderNodeMix")
        mix.data_type = "VECTOR"
        values = (attribute(MIXED, "Fac"), picture.outputs["Color"], attribute(COLOUR, "Vector"))
        for value, socket in zip(values, [item for item in mix.inputs if item.enabled], strict=True):
            tree.links.new(value, socket)
        tree.links.new(next(item for item in mix.outputs if item.enabled), layer.inputs["Color"])
    return material


def _tear(target: RenderObject, cache: Pc2Reader, from_frame: int, *, gone: bool) -> None:
    """Open the skin where it is stretched, from ``from_frame`` on; or let it be ``gone`` altogether."""
    data = target.item.data
    ends = np.empty(2 * len(data.edges), dtype=np.int32)
    data.edges.foreach_get("vertices", ends)
    rest = cache.sample(0)[ends.reshape(-1, 2)]
    attribute = data.attributes.new(REST_LENGTH, "FLOAT", "EDGE")
    attribute.data.foreach_set("value", np.linalg.norm(rest[:, 1] - rest[:, 0], axis=1).astype(np.float32))
    modifier = target.item.modifiers.new(SKIN, "NODES")
    modifier.node_group = _skin_group()
    set_input(modifier, points.FROM, from_frame)
    set_input(modifier, "Gone", gone)


def _skin_group() -> bpy.types.NodeTree:
    tree = Tree(SKIN, {points.FROM: ("Int", 1), "Gone": ("Bool", False)})
    ends = tree.node("GeometryNodeInputMeshEdgeVertices").outputs
    length = tree.out("ShaderNodeVectorMath", ends["Position 1"], ends["Position 2"], operation="DISTANCE")
    longest = tree.math("MULTIPLY", tree.attribute(REST_LENGTH, "FLOAT"), TORN_STRETCH)
    torn = tree.compare("GREATER_THAN", length, longest)
    open_skin = tree.out("GeometryNodeDeleteGeometry", tree.inputs["Geometry"], torn, domain="EDGE", mode="EDGE_FACE")
    left = points.switch(tree, tree.inputs["Gone"], open_skin, None)
    return tree.finish(points.switch(tree, points.begun(tree), tree.inputs["Geometry"], left))


def _grains_group() -> bpy.types.NodeTree:
    tree = Tree(GRAINS, {**_inputs(), STEP: ("Float", 0.01)})
    radius, step = tree.inputs[points.RADIUS], tree.inputs[STEP]
    # A switch before the costly part: frames without particles pay nothing.
    shown = points.switch(tree, points.begun(tree), None, tree.inputs["Geometry"])
    many = tree.out("GeometryNodeDuplicateElements", shown, None, EACH, domain="POINT")
    half = tree.math("MULTIPLY", radius, 0.5 / points.GRAIN)
    place = _strayed(tree, tree.out("GeometryNodeInputPosition"), half)
    # Each grain takes its own piece of the picture.
    where = _strayed(tree, tree.attribute(UV, "FLOAT_VECTOR"), tree.math("MULTIPLY", step, 0.5), seed=1)
    store = "GeometryNodeStoreNamedAttribute"
    many = tree.out(store, many, None, UV, where, data_type="FLOAT_VECTOR", domain="POINT")
    size = tree.out("FunctionNodeRandomValue", points.SMALLEST, points.LARGEST, data_type="FLOAT")
    size = tree.math("MULTIPLY", tree.math("MULTIPLY", radius, SMALLER), size)
    grains = tree.out("GeometryNodeMeshToPoints", many, None, place, size)
    coloured = tree.out("GeometryNodeSetMaterial", grains, None, tree.inputs[points.MATERIAL])
    return tree.finish(coloured)


def _strayed(tree: Tree, value: Any, reach: Any, seed: int = 0) -> Any:
    """``value`` and something random of up to ``reach`` along each axis."""
    stray = tree.node("FunctionNodeRandomValue", data_type="FLOAT_VECTOR")
    lowest, highest = (item for item in stray.inputs if item.enabled and item.type == "VECTOR")
    tree.group.links.new(tree.math("MULTIPLY", reach, -1.0), lowest)
    tree.group.links.new(reach, highest)
    next(item for item in stray.inputs if item.name == "Seed").default_value = seed
    moved = next(item for item in stray.outputs if item.enabled)
    return tree.out("ShaderNodeVectorMath", value, moved, operation="ADD")


def _surface_group(carried: tuple[str, ...]) -> bpy.types.NodeTree:
    """The surface around the particles, with the attributes of the nearest of them, ``carried`` ones too."""
    tree = Tree(SURFACE, {**_inputs(), STEP: ("Float", 0.01)})
    inputs = tree.inputs
    shown = points.switch(tree, points.begun(tree), None, tree.inputs["Geometry"])
    surface = points.enclosing_surface(tree, shown, tree.inputs[points.RADIUS])
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
    return tree.finish(tree.out("GeometryNodeSetMaterial", surface, None, tree.inputs[points.MATERIAL]))


def _inputs() -> dict[str, tuple[str, Any]]:
    return {points.RADIUS: ("Float", 0.01), points.FROM: ("Int", 1), points.MATERIAL: ("Material", None)}
