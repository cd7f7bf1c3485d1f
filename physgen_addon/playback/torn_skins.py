# SPDX-License-Identifier: GPL-3.0-or-later
"""Torn skins of a shown bake: a second mesh beside the object's own, which it replaces from the first crack on.

All of it is native Blender data: it plays and renders without this extension.
"""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.cache.bake_folder import BakedObject
from ...sim.cache.pc2 import Pc2Reader
from ...sim.cache.torn_skins import TornSkin, read_torn_skin
from .. import paths
from . import particles, point_caches
from .bake_record import BakeRecord


def new_mesh(name: str, vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> bpy.types.Mesh:
    """Return a new smooth mesh of ``vertices`` (V, 3) and triangles ``faces`` (T, 3), in that order."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(np.asarray(vertices, dtype=np.float64), [], np.asarray(faces))
    mesh.shade_smooth()
    return mesh


def corner_values(skin: TornSkin, values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return (T', 3, C) at the corners of the torn skin, of ``values`` (T, 3, C) at those of the whole mesh."""
    return np.asarray(np.einsum("tcb,tbi->tci", skin.corners, values[skin.source]))


def show(scene: bpy.types.Scene, body: bpy.types.Object, baked: BakedObject, record: BakeRecord) -> None:
    """Show the torn skin of ``baked`` from its first crack on, and the mesh of ``body`` before.

    Raises InputError for a damaged file.
    """
    assert baked.torn_file is not None and baked.torn_skin is not None
    data = body.data
    data.calc_loop_triangles()
    file = record.path / baked.torn_file
    skin = read_torn_skin(record.path / baked.torn_skin, len(data.vertices), len(data.loop_triangles))
    found = particles.find(scene, baked.name)
    if found is not None:
        particles.remove(found)
    item = _add(body, baked.name, Pc2Reader(file), skin)
    point_caches.attach_as_first(item, Pc2Reader(file), paths.stored(file), record.frame_start)
    particles.begin(item, record.frame_start + baked.torn_from)
    particles.cover(body, record.frame_start + baked.torn_from)


def _add(body: bpy.types.Object, name: str, cache: Pc2Reader, skin: TornSkin) -> bpy.types.Object:
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
    return particles.add_part(body, name, mesh, mesh.name)
