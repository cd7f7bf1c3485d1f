# SPDX-License-Identifier: GPL-3.0-or-later
"""Visible trial and layers of a loaded capture; two bakes of a scene overlaid. Undo covers all of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import bpy
import numpy as np
from mathutils import Vector

from ...sim.cache.bake_folder import Bake
from ...sim.scene.folder import Scene
from ...sim.scene.meshes import load_object_mesh
from . import geometry_nodes as nodes
from . import point_caches
from .capture_materials import COLOURS, FOUND, GHOST_ALPHA, LAYERS, NOMINAL, plain_material
from .capture_scene import BODY, FRAMES, LAYER, MODIFIER, POINTS, RATE, ROLE, trial_collections

BEFORE, AFTER = "before", "after"
OVERLAID_BAKES = "physgen_bake"
OVERLAY_COLOURS = {BEFORE: COLOURS[NOMINAL], AFTER: COLOURS[FOUND]}


def build_overlay(scene: bpy.types.Scene, folder: Scene, bake: Bake, which: str) -> bpy.types.Collection:
    """Return a collection in ``scene`` with the objects of ``folder``, animated by ``bake``; on failure none is left.

    which: ``BEFORE`` or ``AFTER``. Raises InputError for a mesh or bake that cannot be used, or that do not match.
    """
    opened = point_caches.open_bake(bake, folder)
    point_caches.require_world(opened)
    point_caches.require_scene(opened, folder)
    root = bpy.data.collections.new(f"PhysGen {which}")
    root[OVERLAID_BAKES] = which
    try:
        scene.collection.children.link(root)
        for source, cache in zip(folder.model.objects, opened.caches, strict=True):
            item = _add_object(root, folder, source.name, which)
            point_caches.attach(item, cache, opened.first_frame)
    except Exception:
        remove_overlay(root)
        raise
    return root


def remove_overlay(root: bpy.types.Collection) -> None:
    """Delete the collection of ``build_overlay``."""
    objects = list(root.all_objects)
    meshes = {item.data for item in objects}
    bpy.data.batch_remove([*objects, root])
    bpy.data.batch_remove([mesh for mesh in meshes if mesh.users == 0])


def overlay_bounds(root: bpy.types.Collection) -> tuple[Vector, Vector]:
    """Return lowest and highest corner of the objects at rest, m."""
    corners = np.array([tuple(corner) for item in root.objects for corner in item.bound_box])
    return Vector(corners.min(axis=0).tolist()), Vector(corners.max(axis=0).tolist())


def overlay_frame_range(folder: Scene, bake: Bake) -> tuple[int, int, float]:
    """Return first and last frame and frame rate of ``bake``, whose caches hold the objects of ``folder``."""
    opened = point_caches.open_bake(bake, folder)
    return opened.first_frame, opened.last_frame, opened.manifest.fps


def show_overlay(before: bpy.types.Collection | None, after: bpy.types.Collection | None, *, choice: str) -> None:
    """Show bakes by ``choice``: ``BEFORE``, ``AFTER`` or ``BOTH``. With both, ``before`` is a translucent ghost."""
    for collection, which in ((before, BEFORE), (after, AFTER)):
        if collection is None:
            continue
        collection.hide_viewport = collection.hide_render = choice not in (which.upper(), "BOTH")
        ghost = which == BEFORE and choice == "BOTH"
        for item in collection.objects:
            item.data.materials[0] = _material(which, ghost=ghost)
            item.color = (*OVERLAY_COLOURS[which], GHOST_ALPHA if ghost else 1.0)


def _material(which: str, *, ghost: bool) -> bpy.types.Material:
    if ghost:
        return plain_material(f"{which} ghost", OVERLAY_COLOURS[which], alpha=GHOST_ALPHA)
    return plain_material(which, OVERLAY_COLOURS[which])


def _add_object(root: bpy.types.Collection, folder: Scene, name: str, which: str) -> bpy.types.Object:
    source = next(item for item in folder.model.objects if item.name == name)
    shape = load_object_mesh(folder, source)
    mesh = bpy.data.meshes.new(f"{name} {which}")
    # Neither merged nor reordered: the cache uses the file's vertex order.
    mesh.from_pydata(np.asarray(shape.vertices).tolist(), [], np.asarray(shape.faces).tolist())
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=math.radians(35.0))
    mesh.materials.append(_material(which, ghost=False))
    item = bpy.data.objects.new(f"{name} {which}", mesh)
    root.objects.link(item)
    return item


@dataclass(frozen=True, kw_only=True)
class LayerView:
    """Visibility of a layer."""

    points: bool = False
    trail: bool = False
    body: bool = False


@dataclass(frozen=True, kw_only=True)
class CaptureView:
    """Visibility settings. radius: of a point, m; trail_s: length of a trail; most: discrepancy of the last colour,
    m/s².
    """

    trial: str
    layers: Mapping[str, LayerView] = field(default_factory=dict)
    colours: bool = False
    most: float = 1.0
    radius: float = 0.003
    trail_s: float = 0.3


def show_layers(root: bpy.types.Collection, view: CaptureView) -> None:
    """Apply ``view`` to ``root``, a built capture.

    The discrepancy is shown on the recorded bodies, or if these are hidden on those of the next layer; all others keep
    the colour of their layer.
    """
    coloured = next((name for name in LAYERS if view.layers.get(name, LayerView()).body), None)
    for name, collection in trial_collections(root).items():
        collection.hide_viewport = collection.hide_render = name != view.trial
        for item in collection.objects:
            layer = view.layers.get(item.get(LAYER, ""), LayerView())
            if item.get(ROLE) == POINTS:
                _show_points(item, layer, view, collection[RATE])
            elif item.get(ROLE) == BODY:
                _set(item, Colours=view.colours and item[LAYER] == coloured, Most=view.most)
                item.hide_viewport = item.hide_render = not layer.body


def play_range(scene: bpy.types.Scene, root: bpy.types.Collection, trial: str) -> None:
    """Set the time line of ``scene`` to that of ``trial``: frame 1 is its first, played in real time."""
    collection = trial_collections(root).get(trial)
    if collection is None:
        return
    scene.frame_start, scene.frame_end = 1, int(collection[FRAMES])
    set_rate(scene, float(collection[RATE]))
    if not scene.frame_start <= scene.frame_current <= scene.frame_end:
        scene.frame_set(scene.frame_start)


def set_rate(scene: bpy.types.Scene, rate: float) -> None:
    """Set the frame rate, which Blender stores as an integer and a divisor."""
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate


def capture_bounds(root: bpy.types.Collection, trial: str) -> tuple[Vector, Vector]:
    """Return lowest and highest corner of what was observed in ``trial``, m; equal corners if there is nothing."""
    found = []
    for item in trial_collections(root)[trial].objects:
        if item.get(ROLE) == POINTS and len(item.data.vertices):
            places = np.empty(3 * len(item.data.vertices), dtype=np.float32)
            item.data.vertices.foreach_get("co", places)
            found.append(places.reshape(-1, 3))
    if not found:
        return Vector(), Vector()
    low, high = np.percentile(np.concatenate(found), [1, 99], axis=0)
    return Vector(low.tolist()), Vector(high.tolist())


def shown_body(root: bpy.types.Collection, trial: str) -> bpy.types.Object | None:
    """Return the first visible body of ``trial``."""
    for item in trial_collections(root)[trial].objects:
        if item.get(ROLE) == BODY and not item.hide_viewport:
            return item
    return None


def follow(root: bpy.types.Collection, trial: str) -> None:
    """Make viewports that are locked to a body of another trial follow that of ``trial``."""
    mine = set(root.all_objects)
    for screen in bpy.data.screens:
        for area in screen.areas:
            space = area.spaces.active
            if area.type == "VIEW_3D" and space.lock_object in mine:
                space.lock_object = shown_body(root, trial)


def _show_points(item: bpy.types.Object, layer: LayerView, view: CaptureView, rate: float) -> None:
    _set(item, Radius=view.radius, Points=layer.points, Trail=view.trail_s * rate if layer.trail else 0.0)
    item.hide_viewport = item.hide_render = not (layer.points or layer.trail)


def _set(item: bpy.types.Object, **inputs: float | bool) -> None:
    for name, value in inputs.items():
        nodes.set_input(item.modifiers[MODIFIER], name.replace("_", " "), value)
    item.update_tag()
