# SPDX-License-Identifier: GPL-3.0-or-later
"""Show a bake in a Blender scene, hide it, and save a .blend file that plays without this extension."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ...sim.cache.bake_folder import BakedObject
from ...sim.cache.pc2 import Pc2Reader
from ...sim.constitutive import COHERENT, FLUID, GRANULAR, cohesion_of
from ...sim.errors import InputError
from .. import paths
from ..props.body_props import bodies
from ..scene_io.export_animation import export_names
from . import particles, point_caches, splat_clouds
from .bake_record import GRAINS, MESH, SURFACE, BakeRecord, Look, manifest_of, playable, spacing


def look_of(item: bpy.types.Object, name: str, frame_start: int) -> Look:
    """Return how to show ``item``, called ``name`` in the bake: as mesh, or as particles if it is granular or fluid."""
    body = item.physgen
    if body.role != "dynamic":
        return Look(name=name)
    cohesion = cohesion_of(body.material.law)
    if cohesion == FLUID:
        return Look(name=name, shape=SURFACE, from_frame=frame_start)
    if cohesion in (COHERENT, GRANULAR):
        return Look(name=name, shape=GRAINS, from_frame=frame_start)
    if body.sandy:
        return Look(name=name, shape=GRAINS, from_frame=max(body.sandy_frame, frame_start))
    return Look(name=name)


def looks_of(scene: bpy.types.Scene, names: Mapping[str, str]) -> tuple[Look, ...]:
    """Return how to show the bodies of ``scene`` from its first frame on. names: in the bake, by those in Blender."""
    start = scene.physgen.simulation.frame_start
    return tuple(look_of(item, names[item.name], start) for item in bodies(scene))


def bound(scene: bpy.types.Scene) -> dict[str, bpy.types.Object]:
    """Return bodies of ``scene`` by name in the bake: the stored name, else the name an export would give."""
    found: dict[str, bpy.types.Object] = {}
    names = None
    for item in bodies(scene):
        name = item.physgen.cache
        if not name:
            names = export_names(scene) if names is None else names
            name = names.get(item.name, "")
        # A copy of a body has the stored name too; the original keeps it.
        if name and (name not in found or item.name == name):
            found[name] = item
    return found


def show(scene: bpy.types.Scene, record: BakeRecord) -> list[str]:
    """Make ``scene`` play the available part of the bake of ``record``; return problems of single objects, in words.

    Raises InputError if the folder holds no playable bake.
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
    """Remove the bake from ``scene`` and restore every object. Files are kept."""
    for item in [item for item in scene.objects if particles.POINTS_OF in item]:
        particles.remove(item)
    for item in scene.objects:
        if item.type == "MESH":
            point_caches.detach(item)
            particles.uncover(item)
            if item.physgen.cache:
                item.physgen.cache = ""
    scene.physgen.simulation.bake = ""


def misfits(scene: bpy.types.Scene, record: BakeRecord) -> list[str]:
    """Return what no longer matches the shown bake, in words; changes nothing."""
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
    """Return why ``item`` does not show the matching cache ``file`` from ``first_frame`` on, or not it alone."""
    modifier = item.modifiers.get(point_caches.MODIFIER)
    if modifier is None:
        return [f"{item.name} has lost its modifier {point_caches.MODIFIER!r} and does not play; bake again"]
    if not (modifier.show_viewport and modifier.show_render):
        return [f"{item.name}: its modifier {point_caches.MODIFIER!r} is switched off in the viewport or for renders"]
    if (paths.absolute(modifier.filepath), modifier.frame_start) != (file, first_frame):
        return [f"{item.name} plays the bake of another scene that shares it; bake again to play this scene's"]
    before = item.modifiers[: item.modifiers.find(point_caches.MODIFIER)]
    return [
        f"{item.name}: modifier {other.name!r} comes before the bake, which no longer fits then; "
        f"move it below {point_caches.MODIFIER!r}"
        for other in before
        if other.show_viewport or other.show_render
    ]


def detach_misfits(scene: bpy.types.Scene, record: BakeRecord) -> None:
    """Remove the cache from objects whose number of vertices has changed: it would only flood the console with
    warnings.
    """
    manifest, items = manifest_of(record.path), bound(scene)
    for baked in manifest.objects if manifest is not None else ():
        item = items.get(baked.name)
        if item is not None and len(item.data.vertices) != baked.vertices and point_caches.MODIFIER in item.modifiers:
            _hide_object(scene, item, baked.name)


def repoint(scene: bpy.types.Scene, old: Path, new: Path, blend: Path | None = None) -> None:
    """Redirect everything that plays from the folder ``old`` to ``new``.

    blend: target file of a save in progress, to which stored paths are relative.
    """
    for item in scene.objects:
        modifier = item.modifiers.get(point_caches.MODIFIER) if item.type == "MESH" else None
        if modifier is None:
            continue
        path = paths.absolute(modifier.filepath)
        if path.is_relative_to(old):
            # Absolute while the file is being saved: Blender then makes paths of modifiers relative itself.
            target = new / path.relative_to(old)
            modifier.filepath = str(target) if blend else paths.stored(target)
    shown = paths.shown_bake(scene)
    if shown is not None and shown.is_relative_to(old):
        scene.physgen.simulation.bake = paths.stored(new / shown.relative_to(old), blend)


def _show_object(scene: bpy.types.Scene, item: bpy.types.Object, baked: BakedObject, record: BakeRecord) -> None:
    look, file = record.look(baked.name), record.path / baked.file
    point_caches.attach_as_first(item, Pc2Reader(file), paths.stored(file), record.frame_start)
    if baked.splats_file is not None:
        seen = record.path / baked.splats_file
        splat_clouds.play(item, Pc2Reader(seen), paths.stored(seen), record.frame_start)
    if baked.torn_file is not None and splat_clouds.find(item) is None:
        particles.show_torn_skin(scene, item, baked, record)
        return
    # Splats show granular and fluid objects themselves.
    if look.shape == MESH or baked.points_file is None or splat_clouds.find(item) is not None:
        _hide_points(scene, item, baked.name)
        return
    file = record.path / baked.points_file
    particles.show(
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
    point_caches.detach(item)
    splat_clouds.rest(item)
    _hide_points(scene, item, name)


def _hide_points(scene: bpy.types.Scene, item: bpy.types.Object, name: str) -> None:
    found = particles.find(scene, name)
    if found is not None:
        particles.remove(found)
    particles.uncover(item)


def strip_extension_data() -> list[str]:
    """Make the open file independent; return the files that must accompany it. InputError if it was never saved."""
    if not bpy.data.filepath:
        raise InputError("the file was never saved; save it first, so that its caches lie beside it")
    _pack_images()
    for modifier in _cache_modifiers():
        modifier.filepath = paths.stored(paths.absolute(modifier.filepath))
    for item in bpy.data.objects:
        item.pop(particles.POINTS_OF, None)
        item.pop(splat_clouds.SPLATS, None)
        item.property_unset("physgen")
    for scene in bpy.data.scenes:
        scene.property_unset("physgen")
    return _needed(Path(bpy.data.filepath))


def save_independent_copy(target: Path) -> list[str]:
    """Save an independent copy of the open file as ``target``, with its caches in ``NAME_caches`` beside it.

    The open file is unchanged. Returns the files that must accompany the copy. Raises InputError if something cannot be
    written.
    """
    target = target if target.suffix == ".blend" else target.with_name(f"{target.name}.blend")
    if bpy.data.filepath and Path(bpy.data.filepath) == target:
        raise InputError(f"{target}: is this file; choose another name for the copy, or leave the name empty")
    paths.require_writable(target.parent)
    folder = target.with_name(f"{target.stem}_caches")
    before = _Before()
    try:
        before.packed = _pack_images()
        for modifier in _cache_modifiers():
            before.files.append((modifier, modifier.filepath))
            # Relative to this file, if it has a path: Blender then remaps it relative to the copy.
            modifier.filepath = paths.stored(_copied(paths.absolute(modifier.filepath), folder))
        for scene in bpy.data.scenes:
            before.bakes.append((scene, scene.physgen.simulation.bake))
            scene.physgen.simulation.bake = ""
        bpy.ops.wm.save_as_mainfile(filepath=str(target), copy=True, relative_remap=True)
        needed = _needed(target)
    finally:
        before.restore()
    return needed


@dataclass
class _Before:
    """Original state of the open file, to be restored."""

    packed: list[bpy.types.Image] = field(default_factory=list)
    files: list[tuple[bpy.types.Modifier, str]] = field(default_factory=list)
    bakes: list[tuple[bpy.types.Scene, str]] = field(default_factory=list)

    def restore(self) -> None:
        for modifier, path in self.files:
            modifier.filepath = path
        for scene, bake in self.bakes:
            scene.physgen.simulation.bake = bake
        for image in self.packed:
            image.unpack(method="REMOVE")


def _cache_modifiers() -> list[bpy.types.Modifier]:
    return [
        item.modifiers[point_caches.MODIFIER]
        for item in bpy.data.objects
        # Linked data belong to their own file, and their paths are relative to it.
        if item.type == "MESH" and item.library is None and point_caches.MODIFIER in item.modifiers
    ]


def _copied(source: Path, folder: Path) -> Path:
    """Return a copy of the cache ``source`` in ``folder``; equal names are numbered."""
    name, number = source.name, 2
    while (folder / name).exists() and (folder / name).stat().st_size != source.stat().st_size:
        name, number = f"{source.stem}_{number}{source.suffix}", number + 1
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, folder / name)
    except OSError as error:
        raise InputError(
            f"{source}: cannot be copied to {folder} ({error.strerror or error}); free space, or bake again"
        ) from error
    return folder / name


def _pack_images() -> list[bpy.types.Image]:
    """Pack images stored as files; return those changed. Raises InputError for a missing one."""
    packed = []
    for image in bpy.data.images:
        if image.source not in ("FILE", "TILED") or image.packed_file is not None or not image.users:
            continue
        try:
            image.pack()
        except RuntimeError as error:
            raise InputError(f"image {image.name!r} cannot be packed ({error}); find it, or remove it") from error
        packed.append(image)
    return packed


def _needed(blend: Path) -> list[str]:
    """Return files that the open file references and does not contain, as the file ``blend`` names them."""
    found = {Path(path) for path in bpy.utils.blend_paths(absolute=True, packed=False)}
    found |= {paths.absolute(modifier.filepath) for modifier in _cache_modifiers()}
    return sorted(paths.stored(path, blend) for path in found)
