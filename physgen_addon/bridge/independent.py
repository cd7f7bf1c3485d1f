# SPDX-License-Identifier: GPL-3.0-or-later
"""A file that needs nothing of this extension: native modifiers on point caches beside it, images inside it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ...sim.errors import InputError
from .. import paths
from . import caches, points, splats


def strip() -> list[str]:
    """Make the open file independent; the files that must travel with it. InputError before it was ever saved."""
    if not bpy.data.filepath:
        raise InputError("the file was never saved; save it first, so that its caches lie beside it")
    _pack_images()
    for modifier in _cache_modifiers():
        modifier.filepath = paths.stored(paths.absolute(modifier.filepath))
    for item in bpy.data.objects:
        item.pop(points.POINTS_OF, None)
        item.pop(splats.SPLATS, None)
        item.property_unset("physgen")
    for scene in bpy.data.scenes:
        scene.property_unset("physgen")
    return _needed(Path(bpy.data.filepath))


def save_copy(target: Path) -> list[str]:
    """Save an independent copy of the open file as ``target``, with the caches it plays in ``NAME_caches`` beside it.

    The open file stays as it is. Returns the files that must travel with the copy. Raises InputError when something
    cannot be written.
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
            # Relative to this file, if it has a place: Blender turns it into relative to the copy then.
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
    """What the open file was like."""

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
        item.modifiers[caches.MODIFIER]
        for item in bpy.data.objects
        # What is linked is its own file's, and its paths are from there.
        if item.type == "MESH" and item.library is None and caches.MODIFIER in item.modifiers
    ]


def _copied(source: Path, folder: Path) -> Path:
    """A copy of the cache ``source`` in ``folder``; of equal names each gets its own."""
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
    """Pack images that are files; those that this changed. Raises InputError for one that is not there."""
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
    """Files that the open file refers to and does not hold, as the file ``blend`` names them."""
    found = {Path(path) for path in bpy.utils.blend_paths(absolute=True, packed=False)}
    found |= {paths.absolute(modifier.filepath) for modifier in _cache_modifiers()}
    return sorted(paths.stored(path, blend) for path in found)
