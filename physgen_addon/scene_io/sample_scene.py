# SPDX-License-Identifier: GPL-3.0-or-later
"""A small scene of meshes to begin with: jelly on a ramp, a wooden block that flies into a heap of sand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import bmesh
import bpy
from mathutils import Euler, Vector

from .. import compat
from .export_animation import metres_per_unit

COLLECTION = "PhysGen Sample"
AROUND = 48
"""Vertices around a turned shape."""
Point = tuple[float, float]


def add_sample(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Add the sample to ``scene`` and return its simulated objects, the one to show first at the front.

    Camera, sun and floor are added, too; what was there is left as it is. Sizes are in metres, whatever the unit.
    """
    collection = bpy.data.collections.new(COLLECTION)
    scene.collection.children.link(collection)
    unit = metres_per_unit(scene)
    jelly = _turned(collection, "Jelly", _pudding(), lambda angle: 1.0 + 0.05 * math.cos(8 * angle))
    sand = _turned(collection, "Sand", _bucket(), lambda angle: 1.0)
    wood = _block(collection, "Wood", (0.16, 0.08, 0.08), bevel=0.006)
    ramp = _wedge(collection, "Ramp", (0.36, 0.3, 0.2))
    floor = _floor(collection)
    jelly.location, sand.location, wood.location, ramp.location = (
        (0.3, 0, 0.33),
        (-0.32, 0, 0),
        (-0.78, 0, 0.3),
        (0, 0, 0),
    )
    wood.rotation_euler = (0.2, 0.5, 0.1)
    for item, colour, rough in (
        (jelly, (0.75, 0.04, 0.06), 0.12),
        (sand, (0.62, 0.42, 0.2), 0.9),
        (wood, (0.35, 0.16, 0.05), 0.5),
        (ramp, (0.16, 0.28, 0.36), 0.4),
        (floor, (0.55, 0.55, 0.53), 0.7),
    ):
        item.data.materials.append(_material(item.name, colour, rough))
    _light_and_camera(scene, collection)
    for item in collection.objects:
        item.location = Vector(item.location) / unit
        item.scale = Vector(item.scale) / unit
    for item, preset in ((jelly, "jelly"), (sand, "sand"), (wood, "wood")):
        item.physgen.enabled, item.physgen.material.preset = True, preset
    ramp.physgen.enabled, ramp.physgen.role = True, "collider"
    wood.physgen.velocity, wood.physgen.spin = (1.4 / unit, 0.0, 0.6 / unit), (0.0, 5.0, 0.0)
    return [jelly, sand, wood, ramp]


def _pudding() -> list[Point]:
    """Profile (radius, height) of a jelly as turned out of its mould."""
    side = [(0.115 - 0.04 * z / 0.13, z) for z in (0.012 * k for k in range(1, 11))]
    return [(0.0, 0.0), (0.04, 0.0), (0.08, 0.0), (0.11, 0.002), *side, (0.068, 0.132), (0.04, 0.138), (0.0, 0.14)]


def _bucket() -> list[Point]:
    """Profile (radius, height) of a heap from a bucket."""
    return [(0.0, 0.0), (0.07, 0.0), (0.14, 0.0), (0.133, 0.07), (0.126, 0.14), (0.12, 0.2), (0.06, 0.2), (0.0, 0.2)]


def _turned(
    collection: bpy.types.Collection, name: str, profile: Sequence[Point], ripple: Callable[[float], float]
) -> bpy.types.Object:
    """Return a closed solid of revolution about z; its first and last point lie on the axis."""
    rings = profile[1:-1]
    points = [(0.0, 0.0, profile[0][1]), (0.0, 0.0, profile[-1][1])]
    for radius, height in rings:
        for index in range(AROUND):
            angle = 2 * math.pi * index / AROUND
            reach = radius * ripple(angle)
            points.append((reach * math.cos(angle), reach * math.sin(angle), height))
    last = 2 + AROUND * (len(rings) - 1)
    faces: list[tuple[int, ...]] = []
    for index in range(AROUND):
        after = (index + 1) % AROUND
        faces.append((0, 2 + after, 2 + index))
        faces.append((1, last + index, last + after))
        for row in range(len(rings) - 1):
            low, high = 2 + AROUND * row, 2 + AROUND * (row + 1)
            faces.append((low + index, low + after, high + after, high + index))
    return _mesh_object(collection, name, points, faces, smooth=True)


def _block(collection: bpy.types.Collection, name: str, size: Sequence[float], *, bevel: float) -> bpy.types.Object:
    mesh = bmesh.new()
    try:
        bmesh.ops.create_cube(mesh, size=1.0)
        bmesh.ops.scale(mesh, vec=Vector(size), verts=mesh.verts)
        bmesh.ops.bevel(mesh, geom=mesh.edges, offset=bevel, segments=2, affect="EDGES", profile=0.5)
        data = bpy.data.meshes.new(name)
        mesh.to_mesh(data)
    finally:
        mesh.free()
    item = bpy.data.objects.new(name, data)
    collection.objects.link(item)
    return item


def _wedge(collection: bpy.types.Collection, name: str, size: Sequence[float]) -> bpy.types.Object:
    """Return a ramp that rises to the right, its lower edge at the origin."""
    length, width, height = size
    points = [(x * length, y * width / 2, 0.0) for x in (0, 1) for y in (-1, 1)]
    points += [(length, -width / 2, height), (length, width / 2, height)]
    faces = [(0, 1, 3, 2), (0, 2, 4), (1, 5, 3), (2, 3, 5, 4), (0, 4, 5, 1)]
    return _mesh_object(collection, name, points, faces, smooth=False)


def _floor(collection: bpy.types.Collection) -> bpy.types.Object:
    """Return the floor that is seen; what collides is the infinite ground at the same height."""
    points = [(-4.0, -4.0, 0.0), (4.0, -4.0, 0.0), (4.0, 4.0, 0.0), (-4.0, 4.0, 0.0)]
    return _mesh_object(collection, "Floor", points, [(0, 1, 2, 3)], smooth=False)


def _mesh_object(
    collection: bpy.types.Collection,
    name: str,
    points: Sequence[tuple[float, float, float]],
    faces: Sequence[tuple[int, ...]],
    *,
    smooth: bool,
) -> bpy.types.Object:
    data = bpy.data.meshes.new(name)
    data.from_pydata(points, [], faces)
    if smooth:
        data.shade_smooth()
    item = bpy.data.objects.new(name, data)
    collection.objects.link(item)
    return item


def _material(name: str, colour: tuple[float, float, float], roughness: float) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    tree = compat.node_tree(material)
    shader, output = tree.nodes.new("ShaderNodeBsdfPrincipled"), tree.nodes.new("ShaderNodeOutputMaterial")
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    tree.links.new(shader.outputs[0], output.inputs[0])
    # What the Solid view shows.
    material.diffuse_color, material.roughness = (*colour, 1.0), roughness
    return material


def _light_and_camera(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    sun = bpy.data.lights.new("Sample Sun", "SUN")
    sun.energy, sun.angle = 3.0, 0.1
    lamp = bpy.data.objects.new("Sample Sun", sun)
    lamp.location, lamp.rotation_euler = (-1.0, -1.0, 2.0), Euler((0.6, -0.3, 0.2))
    lens = bpy.data.cameras.new("Sample Camera")
    lens.lens, lens.clip_start = 40.0, 0.01
    camera = bpy.data.objects.new("Sample Camera", lens)
    camera.location = (-0.1, -1.75, 0.75)
    camera.rotation_euler = (Vector((-0.1, 0.0, 0.14)) - camera.location).to_track_quat("-Z", "Y").to_euler()
    for item in (lamp, camera):
        collection.objects.link(item)
    scene.camera = camera
