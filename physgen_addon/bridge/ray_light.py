# SPDX-License-Identifier: GPL-3.0-or-later
"""The light of a scene's lamps on the vertices at rest, by rays towards the lamps and without a render engine."""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from numpy.typing import NDArray

from .objects import RenderObject
from .scene import BlenderScene

RAY_BUDGET = 400_000
"""Rays of one object, shared by its vertices and the lamps."""
MAX_DIRECTIONS = 8
"""Of one lamp."""


def surfaces(
    objects: Sequence[RenderObject],
) -> tuple[NDArray[np.float64], NDArray[np.int64], BVHTree]:
    """All vertices at rest (V, 3) world metres, where each object's begin among them, and a tree of all faces."""
    vertices = np.concatenate([target.mesh.vertices for target in objects])
    offsets = np.cumsum([0, *(len(target.mesh.vertices) for target in objects)])
    faces = np.concatenate([t.mesh.faces + o for t, o in zip(objects, offsets[:-1], strict=True)])
    return vertices, offsets, BVHTree.FromPolygons(vertices.tolist(), faces.tolist(), all_triangles=True)


def cast(built: BlenderScene, target: RenderObject) -> NDArray[np.float64]:
    """Radiance (V, 3) of a white diffuse surface at the vertices of ``target``, under the lamps of the light scene."""
    tree = surfaces(built.objects)[2]
    lamps = [item for item in built.light_scene.objects if item.type == "LIGHT"]
    points = target.mesh.vertices
    normals = np.empty(3 * len(points), dtype=np.float32)
    target.item.data.vertex_normals.foreach_get("vector", normals)
    normals = normals.reshape(-1, 3).astype(np.float64)
    size = float(np.ptp(points, axis=0).max())
    starts = points + 1e-3 * size * normals
    count = int(np.clip(RAY_BUDGET / max(len(points) * len(lamps), 1), 1, MAX_DIRECTIONS))
    radiance = np.zeros((len(points), 3))
    for lamp in lamps:
        colour = np.array(lamp.data.color[:]) * lamp.data.energy / math.pi
        for direction in _directions(lamp, count):
            cosine = normals @ direction
            towards = Vector(direction.tolist())
            for index in np.nonzero(cosine > 0)[0]:
                if tree.ray_cast(Vector(starts[index].tolist()), towards)[0] is None:
                    radiance[index] += colour * (cosine[index] / count)
    return radiance


def _directions(lamp: bpy.types.Object, count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3) towards places spread evenly over the disc of ``lamp`` (Vogel's spiral)."""
    turn = np.array(lamp.rotation_euler.to_matrix())
    index = np.arange(count)
    radius = np.sqrt((index + 0.5) / count) if count > 1 else np.zeros(1)
    around = index * math.pi * (3.0 - math.sqrt(5.0))
    radius = radius * math.tan(lamp.data.angle / 2)
    local = np.stack([radius * np.cos(around), radius * np.sin(around), np.ones(count)], axis=1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    return np.asarray(local @ turn.T)
