# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussian splats in Blender: a vertex-only mesh that follows its point cache, and geometry nodes that make ellipsoids.

Each splat is four vertices: its centre and the ends of its three half axes, as in ``sim.gaussians.splats.as_points``,
so a Mesh Cache moves, rotates and stretches it. All of it is native Blender data: it plays and renders without this
extension.
"""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.cache.pc2 import Pc2Reader
from ...sim.gaussians.splats import Splats, as_points, from_points, half_axes
from .. import compat
from . import point_caches
from .geometry_nodes import Tree, set_input

SPLATS = "physgen_splats"
"""Custom property of objects created here."""
MODIFIER, GROUP, MATERIAL = "PhysGen splats", "PhysGen splats", "PhysGen splats"
COLOUR, OPACITY = "splat_colour", "splat_opacity"
"""Attributes of the vertices, and of the instances and points made from them."""
AS_POINTS, LOOK = "As Points", "Material"
ELLIPSOIDS, POINTS, MESH = "ELLIPSOIDS", "POINTS", "MESH"
SIGMAS = 2.0
"""Radius of an ellipsoid in standard deviations; towards it the splat fades to zero."""
DOT = 1.0
"""Radius of a point over the splat's mean standard deviation: neighbours on a surface just touch."""
FAINT = 0.1
"""Opacity below which a splat is not shown as a point, which would be opaque."""
BOUNCES = 128
"""Transparent surfaces that Cycles looks through: two an ellipsoid."""


def find(body: bpy.types.Object) -> bpy.types.Object | None:
    """Return the splats object of ``body``, or None."""
    return next((item for item in body.children if SPLATS in item), None)


def add(body: bpy.types.Object, splats: Splats) -> bpy.types.Object:
    """Add ``splats``, in object space, to ``body``, shown instead of its mesh; return their object."""
    points = as_points(splats.centres, half_axes(splats))
    mesh = bpy.data.meshes.new(f"{body.name} splats")
    mesh.vertices.add(len(points))
    mesh.attributes["position"].data.foreach_set("vector", points.astype(np.float32).ravel())
    colours = np.concatenate([splats.colours, np.ones((len(splats), 1))], axis=1)
    colour = mesh.attributes.new(COLOUR, "FLOAT_COLOR", "POINT")
    colour.data.foreach_set("color_srgb", np.repeat(colours, 4, axis=0).astype(np.float32).ravel())
    opacity = mesh.attributes.new(OPACITY, "FLOAT", "POINT")
    opacity.data.foreach_set("value", np.repeat(splats.opacities, 4).astype(np.float32))
    mesh.materials.append(_material())
    item = bpy.data.objects.new(f"{body.name} splats", mesh)
    item[SPLATS] = True
    for collection in body.users_collection:
        collection.objects.link(item)
    item.parent = body
    item.matrix_parent_inverse = Matrix.Identity(4)
    item.hide_select = True
    modifier = item.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = _group()
    set_input(modifier, LOOK, mesh.materials[0])
    show_as(body, body.physgen.splats_as)
    return item


def read(item: bpy.types.Object) -> Splats:
    """Return the splats of an object made by ``add``, at rest, in the space of its body."""
    mesh = item.data
    points = np.empty(3 * len(mesh.vertices), dtype=np.float32)
    mesh.attributes["position"].data.foreach_get("vector", points)
    colours: NDArray[Any] = np.empty(4 * len(mesh.vertices), dtype=np.float32)
    mesh.attributes[COLOUR].data.foreach_get("color_srgb", colours)
    opacities = np.empty(len(mesh.vertices), dtype=np.float32)
    mesh.attributes[OPACITY].data.foreach_get("value", opacities)
    count = len(opacities) // 4
    blank = Splats(
        centres=np.zeros((count, 3)),
        scales=np.ones((count, 3)),
        rotations=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        opacities=np.clip(opacities[::4], 0.0, 1.0),
        colours=colours.reshape(-1, 4)[::4, :3],
    )
    return from_points(blank, points.reshape(-1, 3))


def show_as(body: bpy.types.Object, shape: str) -> None:
    """Show ``body`` as ``ELLIPSOIDS``, ``POINTS``, or ``MESH``; no effect without splats."""
    item = find(body)
    if item is None:
        return
    seen = shape != MESH
    item.hide_viewport = item.hide_render = not seen
    # The mesh remains selectable and movable.
    body.hide_render = seen
    body.display_type = "BOUNDS" if seen else "TEXTURED"
    modifier = item.modifiers.get(MODIFIER)
    if modifier is not None and modifier.node_group is not None:
        set_input(modifier, AS_POINTS, shape == POINTS)
        item.update_tag()


def play(body: bpy.types.Object, cache: Pc2Reader, path: str, first_frame: int) -> None:
    """Attach ``cache``, stored as ``path``, to the splats of ``body``. Raises InputError if it is of other splats."""
    item = find(body)
    if item is not None:
        point_caches.attach_as_first(item, cache, path, first_frame)


def rest(body: bpy.types.Object) -> None:
    """Detach the cache from the splats of ``body``."""
    item = find(body)
    if item is not None:
        point_caches.detach(item)


def allow_transparency(scene: bpy.types.Scene) -> None:
    """Raise Cycles' limit of transparent bounces; beyond it surfaces render black."""
    if hasattr(scene, "cycles"):
        scene.cycles.transparent_max_bounces = max(scene.cycles.transparent_max_bounces, BOUNCES)


def _group() -> bpy.types.NodeTree:
    """Return a group: groups of four vertices → an ellipsoid instance each, or a point."""
    found = bpy.data.node_groups.get(GROUP)
    if found is not None:
        return found
    tree = Tree(GROUP, {AS_POINTS: ("Bool", False), LOOK: ("Material", None)})
    geometry, index = tree.inputs["Geometry"], tree.out("GeometryNodeInputIndex")
    is_centre = tree.compare("LESS_THAN", tree.math("MODULO", index, 4.0), 0.5)
    # One point a splat, with the attributes of its centre; renumbered.
    cloud = tree.out("GeometryNodeMeshToPoints", geometry, is_centre)
    corners = [_corner(tree, geometry, index, number) for number in range(4)]
    axes = [tree.out("ShaderNodeVectorMath", corner, corners[0], operation="SUBTRACT") for corner in corners[1:]]
    ball = tree.out("GeometryNodeMeshIcoSphere", 1.0, 2)
    ball = tree.out("GeometryNodeSetMaterial", ball, None, tree.inputs[LOOK])
    instances = tree.out("GeometryNodeInstanceOnPoints", cloud, None, ball)
    ellipsoids = tree.out("GeometryNodeSetInstanceTransform", instances, None, _matrix(tree, axes, corners[0]))
    lengths = [_length(tree, axis) for axis in axes]
    total = tree.math("ADD", tree.math("ADD", lengths[0], lengths[1]), lengths[2])
    visible = tree.compare("LESS_THAN", tree.attribute(OPACITY, "FLOAT"), FAINT)
    dots = tree.out("GeometryNodeDeleteGeometry", cloud, visible, domain="POINT")
    dots = tree.out("GeometryNodeSetPointRadius", dots, None, tree.math("MULTIPLY", total, DOT / 3.0))
    dots = tree.out("GeometryNodeSetMaterial", dots, None, tree.inputs[LOOK])
    return tree.finish(tree.out("GeometryNodeSwitch", tree.inputs[AS_POINTS], ellipsoids, dots, input_type="GEOMETRY"))


def _corner(tree: Tree, geometry: Any, index: Any, number: int) -> Any:
    """Return the vertex ``number`` of the splat ``index``."""
    place = tree.math("ADD", tree.math("MULTIPLY", index, 4.0), float(number))
    place = tree.out("FunctionNodeFloatToInt", place, rounding_mode="ROUND")
    position = tree.out("GeometryNodeInputPosition")
    return tree.out(
        "GeometryNodeSampleIndex", geometry, position, place, data_type="FLOAT_VECTOR", domain="POINT", clamp=True
    )


def _length(tree: Tree, vector: Any) -> Any:
    return next(s for s in tree.node("ShaderNodeVectorMath", vector, operation="LENGTH").outputs if s.name == "Value")


def _matrix(tree: Tree, axes: list[Any], centre: Any) -> Any:
    """Return [a b c | centre], the axes scaled by ``SIGMAS``: maps the unit ball to the ellipsoid."""
    combine = tree.node("FunctionNodeCombineMatrix")
    for column, vector in enumerate((*axes, centre)):
        if column < 3:
            scale = tree.node("ShaderNodeVectorMath", vector, operation="SCALE")
            scale.inputs["Scale"].default_value = SIGMAS
            vector = scale.outputs[0]
        parts = tree.node("ShaderNodeSeparateXYZ", vector).outputs
        for row in range(3):
            tree.group.links.new(parts[row], combine.inputs[4 * column + row])
    return combine.outputs[0]


def _material() -> bpy.types.Material:
    """Return the splats' material: their colours towards the camera, with a Gaussian's opacity along the line of sight.

    On a line that passes the centre at b standard deviations a splat absorbs opacity · exp(-b²/2) of the light (Kerbl
    et al. 2023). In the ellipsoid's unit ball b is exact, however coarse its faces: b² = |p|² - (p·d)² for any point p
    on the line and its direction d. Only front faces count. To rays other than the camera's splats are matte, so they
    emit no light. A point is opaque.
    """
    found = bpy.data.materials.get(MATERIAL)
    if found is not None:
        return found
    material = bpy.data.materials.new(MATERIAL)
    material.diffuse_color = (0.6, 0.6, 0.6, 1.0)
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"
    material.use_backface_culling = True
    shader = _Shader(compat.node_tree(material))
    of_instance = [shader.attribute(name, "INSTANCER") for name in (COLOUR, OPACITY)]
    of_point = [shader.attribute(name, "GEOMETRY") for name in (COLOUR, OPACITY)]
    # A missing attribute reads as zero.
    colour = shader.vector("ADD", of_instance[0].outputs["Color"], of_point[0].outputs["Color"])
    place = shader.new("TexCoord").outputs["Object"]
    look = shader.new("VectorTransform", vector_type="VECTOR", convert_from="WORLD", convert_to="OBJECT")
    geometry = shader.new("NewGeometry")
    shader.link(geometry.outputs["Incoming"], look.inputs[0])
    line = shader.vector("NORMALIZE", look.outputs[0])
    along = shader.dot(place, line)
    beside = shader.math("SUBTRACT", shader.dot(place, place), shader.math("MULTIPLY", along, along))
    bell = shader.math("EXPONENT", shader.math("MULTIPLY", beside, -0.5 * SIGMAS**2))
    end = math.exp(-0.5 * SIGMAS**2)
    # Fade to zero at the ellipsoid's boundary, or its outline would be visible.
    bell = shader.math("DIVIDE", shader.math("SUBTRACT", bell, end), 1.0 - end)
    front = shader.math("SUBTRACT", 1.0, geometry.outputs["Backfacing"])
    alpha = shader.math("MULTIPLY", shader.math("MULTIPLY", bell, of_instance[1].outputs["Fac"]), front)
    alpha = shader.math("MAXIMUM", alpha, shader.math("GREATER_THAN", of_point[1].outputs["Fac"], 0.0))
    matt, light, clear = shader.new("BsdfDiffuse"), shader.new("Emission"), shader.new("BsdfTransparent")
    shader.link(colour, matt.inputs["Color"])
    shader.link(colour, light.inputs["Color"])
    body = shader.mix(shader.new("LightPath").outputs["Is Camera Ray"], matt, light)
    shader.link(shader.mix(alpha, clear, body).outputs[0], shader.new("OutputMaterial").inputs["Surface"])
    return material


class _Shader:
    """Builder of a material's nodes."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self._tree = tree
        self.link = tree.links.new

    def new(self, kind: str, **settings: Any) -> bpy.types.Node:
        node = self._tree.nodes.new(f"ShaderNode{kind}")
        for name, value in settings.items():
            setattr(node, name, value)
        count = len(self._tree.nodes)
        node.location = (200 * (count // 5), -170 * (count % 5))
        return node

    def attribute(self, name: str, source: str) -> bpy.types.Node:
        return self.new("Attribute", attribute_name=name, attribute_type=source)

    def math(self, operation: str, *values: Any) -> Any:
        return self._filled(self.new("Math", operation=operation), values).outputs[0]

    def vector(self, operation: str, *values: Any) -> Any:
        return self._filled(self.new("VectorMath", operation=operation), values).outputs["Vector"]

    def dot(self, one: Any, other: Any) -> Any:
        return self._filled(self.new("VectorMath", operation="DOT_PRODUCT"), (one, other)).outputs["Value"]

    def mix(self, share: Any, one: bpy.types.Node, other: bpy.types.Node) -> bpy.types.Node:
        node = self.new("MixShader")
        for source, target in zip((share, one.outputs[0], other.outputs[0]), node.inputs, strict=True):
            self.link(source, target)
        return node

    def _filled(self, node: bpy.types.Node, values: tuple[Any, ...]) -> bpy.types.Node:
        for value, socket in zip(values, node.inputs, strict=False):
            if isinstance(value, bpy.types.NodeSocket):
                self.link(value, socket)
            else:
                socket.default_value = value
        return node
