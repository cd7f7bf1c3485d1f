# SPDX-License-Identifier: GPL-3.0-or-later
"""A bake in a Blender scene: every body follows its cache, particles stand in for what flows; and out again."""

from __future__ import annotations

from pathlib import Path

import bpy

from ...sim.cache.manifest import BakedObject
from ...sim.cache.pc2 import Pc2Reader
from ...sim.errors import InputError
from .. import paths
from ..bake_record import GRAINS, MESH, SURFACE, BakeRecord, Look, manifest_of, playable, spacing
from ..props.body import bodies
from . import caches, points, splats
from .export_names import export_names

GRANULAR = ("sand", "snow")


def look_of(item: bpy.types.Object, name: str, frame_start: int) -> Look:
    """What to show of ``item``, called ``name`` in the bake: its mesh, or particles if it flows."""
    body = item.physgen
    if body.role != "dynamic":
        return Look(name=name)
    if body.material.law == "fluid":
        return Look(name=name, shape=SURFACE, from_frame=frame_start)
    if body.material.law in GRANULAR:
        return Look(name=name, shape=GRAINS, from_frame=frame_start)
    if body.sandy:
        return Look(name=name, shape=GRAINS, from_frame=max(body.sandy_frame, frame_start))
    return Look(name=name)


def bound(scene: bpy.types.Scene) -> dict[str, bpy.types.Object]:
    """Bodies of ``scene`` by their name in the bake: the one they were baked under, else the one they would have."""
    found: dict[str, bpy.types.Object] = {}
    names = None
    for item in bodies(scene):
        name = item.physgen.cache
        if not name:
            names = export_names(scene) if names is None else names
            name = names.get(item.name, "")
        # A copy of a body carries the name too; the original keeps it.
        if name and (name not in found or item.name == name):
            found[name] = item
    return found


def show(scene: bpy.types.Scene, record: BakeRecord) -> list[str]:
    """Let ``scene`` play the bake of ``record``, as far as it is there; what is wrong with single objects, in words.

    Raises InputError when the folder holds no bake that can be played.
    """
    manifest = manifest_of(record.path)
    if manifest is None or playable(record.path) < 1:
        raise InputError(f"{record.path}: holds no frame that can be played; bake again")
    troubles, items = [], bound(scene)
    for baked in manifest.objects:
        item = items.get(baked.name)
        if item is None:
            troubles.append(f"{baked.name} was baked and is no longer in the scene")
            continue
        try:
            _show_object(scene, item, baked, record)
        except InputError as error:
            _hide_object(scene, item, baked.name)
            troubles.append(str(error))
    baked_names = {baked.name for baked in manifest.objects}
    for name, item in items.items():
        if name not in baked_names:
            _hide_object(scene, item, name)
    scene.physgen.simulation.bake = paths.stored(record.path)
    return troubles


def hide(scene: bpy.types.Scene) -> None:
    """Take the bake out of ``scene``: every object as it was before. Files stay where they are."""
    for item in [item for item in scene.objects if points.POINTS_OF in item]:
        points.remove(item)
    for item in scene.objects:
        if item.type == "MESH":
            caches.detach(item)
            points.uncover(item)
            if item.physgen.cache:
                item.physgen.cache = ""
    scene.physgen.simulation.bake = ""


def misfits(scene: bpy.types.Scene, record: BakeRecord) -> list[str]:
    """What no longer fits the bake that is shown, in words; nothing is changed."""
    manifest, items, troubles = manifest_of(record.path), bound(scene), []
    for baked in manifest.objects if manifest is not None else ():
        item = items.get(baked.name)
        if item is None:
            troubles.append(f"{baked.name} was baked and is no longer in the scene")
        elif len(item.data.vertices) != baked.vertices:
            troubles.append(
                f"{item.name} has {len(item.data.vertices)} vertices and its bake {baked.vertices}; bake again"
            )
        else:
            troubles += _obstacles(item, record.path / baked.file, record.frame_start)
    return troubles


def _obstacles(item: bpy.types.Object, file: Path, first_frame: int) -> list[str]:
    """Why ``item`` does not show the cache ``file``, which fits it, from ``first_frame`` on, or not it alone."""
    modifier = item.modifiers.get(caches.MODIFIER)
    if modifier is None:
        return [f"{item.name} has lost its modifier {caches.MODIFIER!r} and does not play; bake again"]
    if not (modifier.show_viewport and modifier.show_render):
        return [f"{item.name}: its modifier {caches.MODIFIER!r} is switched off in the viewport or for renders"]
    if (paths.absolute(modifier.filepath), modifier.frame_start) != (file, first_frame):
        return [f"{item.name} plays another bake, as objects do that scenes share; bake again to play this scene's"]
    before = item.modifiers[: item.modifiers.find(caches.MODIFIER)]
    return [
        f"{item.name}: modifier {other.name!r} comes before the bake, which no longer fits then; "
        f"move it below {caches.MODIFIER!r}"
        for other in before
        if other.show_viewport or other.show_render
    ]


def detach_misfits(scene: bpy.types.Scene, record: BakeRecord) -> None:
    """Take the cache off objects whose number of vertices has changed: it would only fill the console with warnings."""
    manifest, items = manifest_of(record.path), bound(scene)
    for baked in manifest.objects if manifest is not None else ():
        item = items.get(baked.name)
        if item is not None and len(item.data.vertices) != baked.vertices and caches.MODIFIER in item.modifiers:
            _hide_object(scene, item, baked.name)


def repoint(scene: bpy.types.Scene, old: Path, new: Path, blend: Path | None = None) -> None:
    """Let all that plays from the folder ``old`` play from ``new``.

    blend: where the file is about to be saved; paths are stored for that place.
    """
    for item in scene.objects:
        modifier = item.modifiers.get(caches.MODIFIER) if item.type == "MESH" else None
        if modifier is None:
            continue
        path = paths.absolute(modifier.filepath)
        if path.is_relative_to(old):
            # Absolute while the file is being saved: Blender itself makes paths of modifiers relative then.
            target = new / path.relative_to(old)
            modifier.filepath = str(target) if blend else paths.stored(target)
    shown = paths.shown_bake(scene)
    if shown is not None and shown.is_relative_to(old):
        scene.physgen.simulation.bake = paths.stored(new / shown.relative_to(old), blend)


def _show_object(scene: bpy.types.Scene, item: bpy.types.Object, baked: BakedObject, record: BakeRecord) -> None:
    look, file = record.look(baked.name), record.path / baked.file
    caches.attach_as_first(item, Pc2Reader(file), paths.stored(file), record.frame_start)
    if baked.splats_file is not None:
        seen = record.path / baked.splats_file
        splats.play(item, Pc2Reader(seen), paths.stored(seen), record.frame_start)
    # Splats show what flows themselves.
    if look.shape == MESH or baked.points_file is None or splats.find(item) is not None:
        _hide_points(scene, item, baked.name)
        return
    file = record.path / baked.points_file
    points.show(
        scene,
        item,
        baked.name,
        Pc2Reader(file),
        paths.stored(file),
        record.frame_start,
        surface=look.shape == SURFACE,
        from_frame=look.from_frame,
        distance=look.spacing or spacing(Pc2Reader(file).sample(0)),
    )


def _hide_object(scene: bpy.types.Scene, item: bpy.types.Object, name: str) -> None:
    caches.detach(item)
    splats.rest(item)
    _hide_points(scene, item, name)


def _hide_points(scene: bpy.types.Scene, item: bpy.types.Object, name: str) -> None:
    found = points.find(scene, name)
    if found is not None:
        points.remove(found)
    points.uncover(item)
