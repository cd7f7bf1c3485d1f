# SPDX-License-Identifier: GPL-3.0-or-later
"""Baked particles and torn skins of a shown bake, beside an object's mesh, which they cover or replace.

Particles are a vertex-only mesh that follows its point cache, and geometry nodes that make grains or a surface. A torn
skin is a second mesh that replaces the object's own from the first crack on. All of it is native Blender data: it plays
and renders without this extension.
"""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.cache.bake_folder import BakedObject
from ...sim.cache.pc2 import Pc2Reader
from ...sim.cache.torn_skin_file import TornSkin, read_torn_skin
from ...sim.mpm.geometry.triangles import signed_volume
from .. import compat, paths
from . import point_caches
from .bake_record import BakeRecord
from .geometry_nodes import Tree, set_input

POINTS_OF = "physgen_particles_of"
"""Custom property of objects created here: name of the object in the bake."""
MODIFIER, UNTIL, SINCE = "PhysGen particles", "PhysGen mesh until", "PhysGen mesh since"
GRAINS_GROUP, SURFACE_GROUP, UNTIL_GROUP = "PhysGen grains", "PhysGen surface", "PhysGen mesh until"
RADIUS, FROM, MATERIAL, BARE = "Radius", "From Frame", "Material", "Bare Vertices"
GRAIN = 0.55
"""Radius of a grain over the particle spacing: neighbours just touch."""
STRAY, SMALLEST, LARGEST = 0.6, 0.75, 1.15
"""Variation of grains, over their radius: offset along each axis, and smallest and largest size. Without it the initial
lattice would be visible in a heap.
"""
SURFACE, VOXEL, SHRINK, BLUR = 1.1, 0.6, 0.7, 2
"""Surface parameters, over the particle spacing: radius of the merged balls, which closes gaps between neighbours;
voxel size; inward offset afterwards, so that it ends about at the material's boundary. And the number of smoothing
steps.
"""
STEPS, FARTHEST = 3, 0.4
"""Corrections of the surface's offset, so that it holds the volume of its particles, and the largest of each, over the
particle spacing.
"""


def find(scene: bpy.types.Scene, name: str) -> bpy.types.Object | None:
    """Return the particles object of the object ``name`` in the bake, or None."""
    return next((item for item in scene.objects if item.get(POINTS_OF) == name), None)


def show(
    scene: bpy.types.Scene,
    body: bpy.types.Object,
    name: str,
    cache: Pc2Reader,
    path: str,
    first_frame: int,
    *,
    surface: bool,
    from_frame: int,
    distance: float,
) -> bpy.types.Object:
    """Show the particles of ``cache`` from ``from_frame`` on, and the mesh of ``body`` before.

    name: of the object in the bake. path: of the cache as stored in the file. surface: a surface around the particles
    instead of grains. distance: of neighbouring particles, m. Samples are in the space of ``body``, which is therefore
    the parent.
    """
    item = find(scene, name)
    if item is not None and len(item.data.vertices) != cache.vertex_count:
        remove(item)
        item = None
    if item is None:
        item = _add(body, name, cache.sample(0))
        if surface:
            distance = spacing_inside(body.data, cache.vertex_count) or distance
        _add_look(item, distance, surface=surface)
    point_caches.attach_as_first(item, cache, path, first_frame)
    set_input(item.modifiers[MODIFIER], FROM, from_frame)
    cover(body, from_frame)
    return item


def cover(body: bpy.types.Object, from_frame: int) -> None:
    """Show the mesh of ``body`` before ``from_frame`` only."""
    until = body.modifiers.get(UNTIL)
    if until is None:
        until = body.modifiers.new(UNTIL, "NODES")
        until.node_group = _switch_group(UNTIL_GROUP, shown_first=True)
    set_input(until, FROM, from_frame)


def begin(item: bpy.types.Object, from_frame: int) -> None:
    """Show ``item`` from ``from_frame`` on only."""
    start = item.modifiers.get(SINCE)
    if start is None:
        start = item.modifiers.new(SINCE, "NODES")
        start.node_group = _switch_group(SINCE, shown_first=False)
    set_input(start, FROM, from_frame)


def remove(item: bpy.types.Object) -> None:
    """Delete what ``show`` added for one body, except the modifier on it (``uncover``)."""
    mesh = item.data
    bpy.data.objects.remove(item)
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)


def set_bare(item: bpy.types.Object, bare: bool) -> None:
    """Make grains vertices of a mesh without faces: exporters skip point clouds made by modifiers."""
    modifier = item.modifiers.get(MODIFIER)
    if modifier is not None and modifier.node_group is not None and modifier.node_group.name.startswith(GRAINS_GROUP):
        set_input(modifier, BARE, bare)
        item.update_tag()


def uncover(body: bpy.types.Object) -> None:
    """Show the mesh of ``body`` at all frames again."""
    until = body.modifiers.get(UNTIL)
    if until is not None:
        body.modifiers.remove(until)


def _add(body: bpy.types.Object, name: str, rest: np.ndarray) -> bpy.types.Object:
    mesh = bpy.data.meshes.new(f"{body.name} particles")
    mesh.vertices.add(len(rest))
    # A hundred times as fast as by the vertices' ``co``.
    mesh.attributes["position"].data.foreach_set("vector", np.ascontiguousarray(rest, dtype=np.float32).ravel())
    material = body.active_material
    if material is not None:
        mesh.materials.append(material)
    return add_part(body, name, mesh, f"{body.name} particles")


def add_part(body: bpy.types.Object, name: str, mesh: bpy.types.Mesh, label: str) -> bpy.types.Object:
    """Return a new object ``label`` of ``mesh`` that stays with ``body`` and belongs to the baked object ``name``."""
    item = bpy.data.objects.new(label, mesh)
    item[POINTS_OF] = name
    item.color = body.color
    for collection in body.users_collection:
        collection.objects.link(item)
    item.parent = body
    item.matrix_parent_inverse = Matrix.Identity(4)
    item.hide_select = True
    return item


def spacing_inside(mesh: bpy.types.Mesh, count: int) -> float | None:
    """Return the side (m) of a cube of the volume of each of ``count`` particles that fill ``mesh``; None where that
    is not closed. The distance of neighbours is no measure of a volume: on a lattice it gives one a third too large.
    """
    mesh.calc_loop_triangles()
    corners = np.empty(3 * len(mesh.loop_triangles), dtype=np.int32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    places = np.empty(3 * len(mesh.vertices), dtype=np.float32)
    mesh.vertices.foreach_get("co", places)
    triangles, points = corners.reshape(-1, 3).astype(np.int64), places.reshape(-1, 3).astype(np.float64)
    # Each edge once in either direction.
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    closed = len(ends) > 0 and np.array_equal(np.unique(ends, axis=0), np.unique(ends[:, ::-1], axis=0))
    found = signed_volume(points, triangles) if closed else 0.0
    return (found / count) ** (1 / 3) if count and found > 0 else None


def _add_look(item: bpy.types.Object, distance: float, *, surface: bool) -> None:
    modifier = item.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = _surface_group() if surface else _grains_group()
    set_input(modifier, RADIUS, distance * (SURFACE if surface else GRAIN))
    if item.data.materials:
        set_input(modifier, MATERIAL, item.data.materials[0])


def begun(tree: Tree) -> Any:
    """Return a condition, true from frame FROM on; half a frame early, because subframes of motion blur belong to their
    frame.
    """
    frame = tree.node("GeometryNodeInputSceneTime").outputs["Frame"]
    return tree.compare("GREATER_EQUAL", frame, tree.math("SUBTRACT", tree.inputs[FROM], 0.5))


def switch(tree: Tree, when: Any, no: Any, yes: Any) -> Any:
    """Return a switch between the geometries ``yes`` and ``no``."""
    return tree.out("GeometryNodeSwitch", when, no, yes, input_type="GEOMETRY")


def _grains_group() -> bpy.types.NodeTree:
    """Return a group: points → a point cloud of round grains, which engines draw as spheres, far lighter than
    instances.
    """
    found = bpy.data.node_groups.get(GRAINS_GROUP)
    if found is not None:
        return found
    inputs = {RADIUS: ("Float", 0.01), FROM: ("Int", 1), MATERIAL: ("Material", None), BARE: ("Bool", False)}
    tree = Tree(GRAINS_GROUP, inputs)
    grains = grain_cloud(tree, tree.inputs["Geometry"], tree.inputs[RADIUS])
    coloured = tree.out("GeometryNodeSetMaterial", grains, None, tree.inputs[MATERIAL])
    shown = switch(tree, tree.inputs[BARE], coloured, tree.inputs["Geometry"])
    return tree.finish(switch(tree, begun(tree), None, shown))


def grain_cloud(tree: Tree, geometry: Any, radius: Any) -> Any:
    """Return a grain of about ``radius`` near each vertex of ``geometry``."""
    reach = tree.math("MULTIPLY", radius, STRAY)
    stray = tree.out("FunctionNodeRandomValue", tree.math("MULTIPLY", reach, -1.0), reach, data_type="FLOAT_VECTOR")
    size = tree.out("FunctionNodeRandomValue", SMALLEST, LARGEST, data_type="FLOAT")
    size = tree.math("MULTIPLY", radius, size)
    place = tree.out("ShaderNodeVectorMath", tree.out("GeometryNodeInputPosition"), stray, operation="ADD")
    return tree.out("GeometryNodeMeshToPoints", geometry, None, place, size)


def _surface_group() -> bpy.types.NodeTree:
    """Return a group: points → the surface of merged balls around them."""
    found = bpy.data.node_groups.get(SURFACE_GROUP)
    if found is not None:
        return found
    tree = Tree(SURFACE_GROUP, {RADIUS: ("Float", 0.02), FROM: ("Int", 1), MATERIAL: ("Material", None)})
    radius = tree.inputs[RADIUS]
    # Switch before the expensive part: frames without particles cost nothing.
    shown = switch(tree, begun(tree), None, tree.inputs["Geometry"])
    surface = enclosing_surface(tree, shown, radius)
    return tree.finish(tree.out("GeometryNodeSetMaterial", surface, None, tree.inputs[MATERIAL]))


def enclosing_surface(tree: Tree, points: Any, radius: Any) -> Any:
    """Return the smoothed surface of balls of ``radius`` around the vertices ``points``, offset inward to the
    material's boundary.
    """
    count = tree.node("GeometryNodeAttributeDomainSize", points, component="MESH").outputs["Point Count"]
    points = tree.out("GeometryNodeMeshToPoints", points, None, None, radius)
    volume = tree.node("GeometryNodePointsToVolume")
    compat.set_resolution(volume, "Size")
    tree.group.links.new(points, volume.inputs["Points"])
    tree.group.links.new(radius, volume.inputs["Radius"])
    tree.group.links.new(tree.math("MULTIPLY", radius, VOXEL / SURFACE), volume.inputs["Voxel Size"])
    mesh = tree.node("GeometryNodeVolumeToMesh", volume.outputs[0])
    compat.set_resolution(mesh, "Grid")
    mesh.inputs["Threshold"].default_value = 0.1
    place, normal = tree.out("GeometryNodeInputPosition"), tree.out("GeometryNodeInputNormal")
    even = tree.out("GeometryNodeBlurAttribute", place, BLUR, data_type="FLOAT_VECTOR")
    inwards = tree.node("ShaderNodeVectorMath", normal, operation="SCALE")
    tree.group.links.new(tree.math("MULTIPLY", radius, -SHRINK / SURFACE), inwards.inputs["Scale"])
    surface = tree.out("GeometryNodeSetPosition", mesh.outputs[0], None, even, inwards.outputs[0])
    wanted = tree.math("MULTIPLY", count, tree.math("POWER", tree.math("DIVIDE", radius, SURFACE), 3.0))
    farthest = tree.math("MULTIPLY", radius, FARTHEST / SURFACE)
    for _ in range(STEPS):
        surface = _towards_volume(tree, surface, wanted, farthest)
    return tree.out("GeometryNodeSetShadeSmooth", surface)


def _towards_volume(tree: Tree, surface: Any, wanted: Any, farthest: Any) -> Any:
    """Return the closed ``surface``, moved evenly along its normals, at most by ``farthest`` (m), to hold the volume
    ``wanted`` (m³): a step of Newton's method, since volume changes with the offset at the rate of the area.
    """
    place, normal = tree.out("GeometryNodeInputPosition"), tree.out("GeometryNodeInputNormal")
    face = tree.out("GeometryNodeInputMeshFaceArea")
    # From the middle of the surface, or digits would be lost far from the origin.
    middle = tree.node("GeometryNodeAttributeStatistic", surface, None, place, data_type="FLOAT_VECTOR")
    arm = tree.out("ShaderNodeVectorMath", place, _enabled(middle, "Mean"), operation="SUBTRACT")
    height = tree.node("ShaderNodeVectorMath", arm, normal, operation="DOT_PRODUCT").outputs["Value"]
    total = {}
    for name, value in (("volume", tree.math("MULTIPLY", height, face)), ("area", face)):
        found = tree.node("GeometryNodeAttributeStatistic", surface, None, value, data_type="FLOAT", domain="FACE")
        total[name] = _enabled(found, "Sum")
    lacking = tree.math("SUBTRACT", wanted, tree.math("DIVIDE", total["volume"], 3.0))
    step = tree.math("DIVIDE", lacking, total["area"])
    step = tree.math("MAXIMUM", tree.math("MINIMUM", step, farthest), tree.math("MULTIPLY", farthest, -1.0))
    outwards = tree.node("ShaderNodeVectorMath", normal, operation="SCALE")
    tree.group.links.new(step, outwards.inputs["Scale"])
    return tree.out("GeometryNodeSetPosition", surface, None, None, outwards.outputs[0])


def _enabled(node: bpy.types.Node, name: str) -> Any:
    """Return the visible output ``name`` of ``node``, which may have several of that name."""
    return next(s for s in node.outputs if s.enabled and s.name == name)


def _switch_group(name: str, *, shown_first: bool) -> bpy.types.NodeTree:
    """Return the group ``name``: the mesh before frame FROM and nothing afterwards, or the other way round."""
    found = bpy.data.node_groups.get(name)
    if found is not None:
        return found
    tree = Tree(name, {FROM: ("Int", 1)})
    geometry = tree.inputs["Geometry"]
    first, then = (geometry, None) if shown_first else (None, geometry)
    return tree.finish(switch(tree, begun(tree), first, then))


def new_mesh(name: str, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> bpy.types.Mesh:
    """Return a new smooth mesh of ``vertices`` (V, 3) and triangles ``faces`` (T, 3), in that order."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(vertices, dtype=np.float64), [], np.asarray(faces))
    mesh.shade_smooth()
    return mesh


def corner_values(skin: TornSkin, values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return (T', 3, C) at the corners of the torn skin, of ``values`` (T, 3, C) at those of the whole mesh."""
    return np.asarray(np.einsum("tcb,tbi->tci", skin.corners, values[skin.source]))


def show_torn_skin(scene: bpy.types.Scene, body: bpy.types.Object, baked: BakedObject, record: BakeRecord) -> None:
    """Show the torn skin of ``baked`` from its first crack on, and the mesh of ``body`` before.

    Raises InputError for a damaged file.
    """
    assert baked.torn_file is not None and baked.torn_skin is not None
    data = body.data
    data.calc_loop_triangles()
    file = record.path / baked.torn_file
    skin = read_torn_skin(record.path / baked.torn_skin, len(data.vertices), len(data.loop_triangles))
    found = find(scene, baked.name)
    if found is not None:
        remove(found)
    item = _add_torn_skin(body, baked.name, Pc2Reader(file), skin)
    point_caches.attach_as_first(item, Pc2Reader(file), paths.stored(file), record.frame_start)
    begin(item, record.frame_start + baked.torn_from)
    cover(body, record.frame_start + baked.torn_from)


def _add_torn_skin(body: bpy.types.Object, name: str, cache: Pc2Reader, skin: TornSkin) -> bpy.types.Object:
    data = body.data
    mesh = new_mesh(f"{body.name} torn", cache.sample(0), skin.faces)
    loops = np.empty((len(data.loop_triangles), 3), dtype=np.int32)
    data.loop_triangles.foreach_get("loops", loops.ravel())
    ends = np.empty(len(data.loops), dtype=np.int32)
    data.loops.foreach_get("vertex_index", ends)
    # A mirrored object is baked with its triangles turned round.
    sharp = np.flatnonzero((skin.corners[:, :, 0] == 1).any(axis=1) & ~skin.inside)
    if len(sharp):
        face = int(sharp[0])
        corner = int((skin.corners[face, :, 0] == 1).argmax())
        if ends[loops[skin.source[face], 0]] != skin.parents[skin.faces[face, corner], 0]:
            loops = loops[:, ::-1]
    for layer in data.uv_layers:
        values = np.empty(2 * len(data.loops), dtype=np.float32)
        layer.data.foreach_get("uv", values)
        placed = corner_values(skin, values.reshape(-1, 2)[loops])
        mesh.uv_layers.new(name=layer.name).data.foreach_set("uv", placed.astype(np.float32).ravel())
    slots = np.empty(len(data.polygons), dtype=np.int32)
    data.polygons.foreach_get("material_index", slots)
    polygons = np.empty(len(data.loop_triangles), dtype=np.int32)
    data.loop_triangles.foreach_get("polygon_index", polygons)
    for slot in body.material_slots:
        mesh.materials.append(slot.material)
    mesh.polygons.foreach_set("material_index", slots[polygons[skin.source]])
    return add_part(body, name, mesh, mesh.name)
