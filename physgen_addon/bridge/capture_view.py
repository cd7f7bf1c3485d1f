# SPDX-License-Identifier: GPL-3.0-or-later
"""Which trial and which layers of a built capture are seen. Reads and writes plain data only, so undo covers it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import bpy
import numpy as np
from mathutils import Vector

from . import capture_nodes as nodes
from .capture_materials import LAYERS
from .capture_scene import BODY, FRAMES, LAYER, MODIFIER, POINTS, RATE, ROLE, trial_collections


@dataclass(frozen=True, kw_only=True)
class LayerView:
    """What of a layer is seen."""

    points: bool = False
    trail: bool = False
    body: bool = False


@dataclass(frozen=True, kw_only=True)
class CaptureView:
    """What is seen. radius: of a point, m; trail_s: length of a trail; most: discrepancy of the last colour, m/s²."""

    trial: str
    layers: Mapping[str, LayerView] = field(default_factory=dict)
    colours: bool = False
    most: float = 1.0
    radius: float = 0.003
    trail_s: float = 0.3


def show(root: bpy.types.Collection, view: CaptureView) -> None:
    """Let ``root``, a built capture, look like ``view``.

    The discrepancy is shown on the recorded bodies, or where these are hidden on those of the next layer; all others
    keep the colour of their layer, so that they can be told apart.
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
    """Let the time line of ``scene`` be that of ``trial``: frame 1 is its first, a second lasts a second."""
    collection = trial_collections(root).get(trial)
    if collection is None:
        return
    scene.frame_start, scene.frame_end = 1, int(collection[FRAMES])
    set_rate(scene, float(collection[RATE]))
    if not scene.frame_start <= scene.frame_current <= scene.frame_end:
        scene.frame_set(scene.frame_start)


def set_rate(scene: bpy.types.Scene, rate: float) -> None:
    """Frames a second, of which Blender stores a whole number and what to divide it by."""
    scene.render.fps = max(1, round(rate))
    scene.render.fps_base = scene.render.fps / rate


def bounds(root: bpy.types.Collection, trial: str) -> tuple[Vector, Vector]:
    """Lowest and highest corner of what was observed in ``trial``, m; twice the same where there is nothing."""
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
    """The first body of ``trial`` that is seen."""
    for item in trial_collections(root)[trial].objects:
        if item.get(ROLE) == BODY and not item.hide_viewport:
            return item
    return None


def follow(root: bpy.types.Collection, trial: str) -> None:
    """Let viewports that are locked to a body of another trial go with that of ``trial``."""
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
