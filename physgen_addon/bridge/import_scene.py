# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene folder into a Blender scene: who looks through its camera sees the photo.

Everything is read and checked before anything is built, and nothing that was there goes before all is built.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import bpy

from ...sim.effects.registry import effect
from ...sim.errors import InputError
from ...sim.gaussians.splats import Splats
from ...sim.scene.folder import SCENE_FILE, SceneFolder, load_scene
from ...sim.scene.glb import TexturedMesh, read_textured_mesh
from . import import_objects, import_physics, import_splats, import_view, splats
from .import_view import MARK

NOTES = "physgen_notes"
"""Custom property of the collection: what of the folder Blender does not show, one sentence a line."""


@dataclass(frozen=True)
class _Read:
    """A scene folder in memory."""

    folder: SceneFolder
    meshes: tuple[TexturedMesh, ...]
    splats: tuple[Splats | None, ...]


def scene_root(path: Path) -> Path:
    """The scene folder that ``path``, a folder or its scene.json, stands for. Raises InputError where it is none."""
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; choose a PhysGen scene folder")
    root = path if path.is_dir() else path.parent
    if path.is_file() and path.name != SCENE_FILE:
        raise InputError(f"{path.name}: is no scene; choose the file {SCENE_FILE} of a PhysGen scene folder")
    if not (root / SCENE_FILE).is_file():
        raise InputError(f"{path}: there is no {SCENE_FILE} in it; choose a PhysGen scene folder")
    return root


def import_scene(scene: bpy.types.Scene, root: Path) -> bpy.types.Collection:
    """Put the scene folder ``root`` (scene.json is fine too) into ``scene``; the collection of all that was made.

    Camera, resolution, world and gravity become the scene's, objects get their ``physgen`` fields, and an earlier
    import in the scene goes. Raises InputError when anything is missing or not readable; then nothing has changed.
    ``import_notes`` says what could not be taken over.
    """
    read = _read(scene_root(root))
    made = import_view.Made()
    try:
        collection = made.add(bpy.data.collections.new(f"PhysGen {read.folder.root.resolve().name}"))
        items = [
            import_objects.add_object(made, collection, read.folder, source, mesh)
            for source, mesh in zip(read.folder.scene.objects, read.meshes, strict=True)
        ]
        for item, source, seen in zip(items, read.folder.scene.objects, read.splats, strict=True):
            if seen is not None:
                made.add(import_splats.add_splats(item, source, seen))
        view = import_view.build(made, collection, read.folder, items)
    except BaseException:
        made.remove()
        raise
    old = scene.physgen.photo_root
    scene.collection.children.link(collection)
    import_view.show(scene, collection, view, read.folder.scene.camera)
    if any(seen is not None for seen in read.splats):
        splats.allow_transparency(scene)
    notes = import_physics.fill(scene, collection, read.folder.scene, items, view.ground)
    for item in collection.all_objects:
        item[MARK] = True
    if old is not None:
        remove_import(scene, old)
    # Without the ".001" that an earlier import's names have caused; none of these names has a full stop.
    for named in (view.world, *(owner for item in collection.all_objects for owner in (item, item.data) if owner)):
        named.name = named.name.split(".")[0]
    state = scene.physgen
    state.photo_root, state.folder, state.simulation.bake = collection, _stored(read.folder.root), ""
    collection[NOTES] = "\n".join(notes)
    return collection


def import_notes(collection: bpy.types.Collection) -> list[str]:
    """Sentences: what of the scene folder is not in Blender."""
    return [line for line in collection.get(NOTES, "").splitlines() if line]


def remove_import(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Delete what an import has made and nothing else uses; what people added to its collection stays in ``scene``."""
    data: set[bpy.types.ID] = set()
    for item in list(collection.all_objects):
        if MARK in item:
            data |= import_view.data_of(item)
            bpy.data.objects.remove(item)
        elif item.name not in scene.collection.objects:
            scene.collection.objects.link(item)
    for child in list(collection.children):
        if child.name not in scene.collection.children:
            scene.collection.children.link(child)
    bpy.data.collections.remove(collection)
    data |= {world for world in bpy.data.worlds if MARK in world}
    import_view.remove_unused(data)


def _read(root: Path) -> _Read:
    folder = load_scene(root)
    if folder.scene.photo is None:
        raise InputError(
            f"{root}: is a scene without a photo, as a bake in Blender leaves it; open the .blend that it comes from"
        )
    for entry in folder.scene.effects:
        known = effect(entry.name)
        try:
            known.checked({**known.defaults, **dict(entry.parameters)})
        except InputError as error:
            raise InputError(f"effect {entry.name!r}: {error}") from None
    meshes, seen = [], []
    for item in folder.scene.objects:
        try:
            meshes.append(read_textured_mesh(folder.file(item.mesh)))
            seen.append(import_splats.read_object_splats(folder, item))
        except InputError as error:
            raise InputError(f"object {item.name}: {error}") from None
    return _Read(folder=folder, meshes=tuple(meshes), splats=tuple(seen))


def _stored(root: Path) -> str:
    """``root`` as the .blend keeps it: relative where it lies beside or below the file, so that both can move."""
    root = root.resolve()
    if bpy.data.filepath:
        beside = Path(bpy.data.filepath).resolve().parent
        if root.is_relative_to(beside):
            return "//" + root.relative_to(beside).as_posix()
    return str(root)
