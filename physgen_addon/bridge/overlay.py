# SPDX-License-Identifier: GPL-3.0-or-later
"""Two bakes of a scene over each other: the one with the found effect solid, the one without as a ghost."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from ...sim.scene.folder import SceneFolder, load_scene
from ...sim.scene.meshes import load_object_mesh
from . import caches
from . import capture_materials as materials
from .capture_materials import FOUND, NOMINAL

BEFORE, AFTER = "before", "after"
WHICH = "physgen_bake"
COLOURS = {BEFORE: materials.COLOURS[NOMINAL], AFTER: materials.COLOURS[FOUND]}


def build(scene: bpy.types.Scene, scene_root: Path, bake: Path, which: str) -> bpy.types.Collection:
    """Add the objects of the scene folder, moving as in ``bake``, to ``scene``; nothing is left behind when it fails.

    Raises InputError for a scene, mesh or bake that cannot be used, or that do not belong together.
    """
    folder = load_scene(scene_root)
    opened = caches.open_bake(bake, folder.scene)
    caches.require_world(opened)
    caches.require_scene(opened, folder)
    root = bpy.data.collections.new(f"PhysGen {which}")
    root[WHICH] = which
    try:
        scene.collection.children.link(root)
        for source, cache in zip(folder.scene.objects, opened.caches, strict=True):
            item = _add_object(root, folder, source.name, which)
            caches.attach(item, cache, opened.first_frame)
    except Exception:
        remove(root)
        raise
    return root


def remove(root: bpy.types.Collection) -> None:
    """Delete the collection of ``build``."""
    objects = list(root.all_objects)
    meshes = {item.data for item in objects}
    bpy.data.batch_remove([*objects, root])
    bpy.data.batch_remove([mesh for mesh in meshes if mesh.users == 0])


def bounds(root: bpy.types.Collection) -> tuple[Vector, Vector]:
    """Lowest and highest corner of the objects at rest, m."""
    corners = np.array([tuple(corner) for item in root.objects for corner in item.bound_box])
    return Vector(corners.min(axis=0).tolist()), Vector(corners.max(axis=0).tolist())


def frame_range(scene_root: Path, bake: Path) -> tuple[int, int, float]:
    """First and last frame and frames a second of ``bake``."""
    opened = caches.open_bake(bake, load_scene(scene_root).scene)
    return opened.first_frame, opened.last_frame, opened.manifest.fps


def show(before: bpy.types.Collection | None, after: bpy.types.Collection | None, *, choice: str) -> None:
    """choice: ``BEFORE``, ``AFTER`` or ``BOTH``. Alone a bake is solid; over the other, ``before`` is a ghost."""
    for collection, which in ((before, BEFORE), (after, AFTER)):
        if collection is None:
            continue
        collection.hide_viewport = collection.hide_render = choice not in (which.upper(), "BOTH")
        ghost = which == BEFORE and choice == "BOTH"
        for item in collection.objects:
            item.data.materials[0] = _material(which, ghost=ghost)
            item.color = (*COLOURS[which], materials.GHOST_ALPHA if ghost else 1.0)


def _material(which: str, *, ghost: bool) -> bpy.types.Material:
    if ghost:
        return materials.plain(f"{which} ghost", COLOURS[which], alpha=materials.GHOST_ALPHA)
    return materials.plain(which, COLOURS[which])


def _add_object(root: bpy.types.Collection, folder: SceneFolder, name: str, which: str) -> bpy.types.Object:
    source = next(item for item in folder.scene.objects if item.name == name)
    shape = load_object_mesh(folder, source)
    mesh = bpy.data.meshes.new(f"{name} {which}")
    # Neither welded nor reordered: the cache goes by the file's order of vertices.
    mesh.from_pydata(np.asarray(shape.vertices).tolist(), [], np.asarray(shape.faces).tolist())
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=math.radians(35.0))
    mesh.materials.append(_material(which, ghost=False))
    item = bpy.data.objects.new(f"{name} {which}", mesh)
    root.objects.link(item)
    return item
