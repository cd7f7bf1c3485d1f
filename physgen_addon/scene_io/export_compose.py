# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of objects to be composed: a scene folder of their own, each mesh vertex for vertex in object space."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.folder import Scene, inside, load_scene, save_scene
from ...sim.scene.model import Ground, SceneModel, SceneObject
from ...sim.scene.textured_mesh import read_textured_mesh, write_moved_mesh
from ...sim.validation import valid_names
from ..paths import require_folder
from ..props.body_props import is_body
from . import export_world
from .export_animation import depsgraph, matrix_rows, metres_per_unit, placed
from .export_meshes import Triangles, read_points_file, read_triangles, require_sound, write_mesh
from .export_objects import foreign_modifiers, is_smoothing, require_evaluated, require_placed

ORIGINAL = "Before Compose"
"""Shape key of the original shape."""
ORIGINALS = (ORIGINAL, "Before Fit Together")
"""Includes its name in files saved by earlier versions."""


@dataclass(frozen=True, kw_only=True)
class ComposedObject:
    """One exported object. uid: Blender's ``session_uid``; label: name in Blender; name: name in the scene folder."""

    uid: int
    label: str
    name: str


def require_composable(item: bpy.types.Object) -> None:
    """Raise InputError, with a remedy, if the mesh of ``item`` differs from its visible shape or is not editable."""
    where = f"object {item.name!r}"
    if item.library is not None or item.data.library is not None:
        raise InputError(f"{where}: is linked from another file: make it local (Object > Relations > Make Local)")
    for modifier in foreign_modifiers(item):
        if not is_smoothing(modifier):
            raise InputError(
                f"{where}: modifier {modifier.name!r} changes its shape, but composing uses the mesh before it: "
                "apply it or hide it in the viewport"
            )
    keys = item.data.shape_keys
    others = [key.name for key in keys.key_blocks[1:] if key.name not in ORIGINALS] if keys is not None else []
    if others:
        raise InputError(
            f"{where}: has the shape key {others[0]!r}: apply or remove it (Properties > Data > Shape Keys)"
        )
    if keys is not None and any(key.value != 0 and not key.mute for key in keys.key_blocks[1:]):
        raise InputError(
            f"{where}: its shape key {keys.key_blocks[1].name!r} is in effect: set its value to 0, or apply it"
        )


def photo_scene(scene: bpy.types.Scene) -> Scene | None:
    """Return the scene folder with a photo from which ``scene`` was imported; None if there is none any more."""
    if not scene.physgen.folder:
        return None
    try:
        found = load_scene(require_folder(scene.physgen.folder, "Scene"))
    except InputError:
        return None
    return found if found.model.photo is not None else None


def export_composition(
    scene: bpy.types.Scene, items: Sequence[bpy.types.Object], root: Path, *, photo: Scene | None
) -> tuple[ComposedObject, ...]:
    """Write ``items`` as they are in this frame to the new scene folder ``root``; return their entries in order.

    photo: scene folder they were imported from, for its photo and their textures; None: without an image.

    Raises InputError for an object whose mesh is open, flat, or hidden by modifiers or shape keys; with ``photo``, also
    for one that was not imported from it or whose number of vertices has changed.
    """
    unit, graph = metres_per_unit(scene), depsgraph(scene)
    exported = []
    for item, name in zip(items, valid_names([item.name for item in items]), strict=True):
        require_composable(item)
        require_evaluated(item, graph)
        mesh = read_triangles(item.data)
        require_sound(mesh, item.name)
        matrix = placed(item.evaluated_get(graph).matrix_world, unit)
        require_placed(matrix, item.name)
        world = mesh.points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        made = SceneObject(
            name=name,
            mesh=f"meshes/{name}.ply",
            world_from_mesh=matrix_rows(matrix),
            size_m=float(np.ptp(world, axis=0).max()),
        )
        if photo is None:
            write_mesh(root / made.mesh, mesh.points, mesh.faces)
        else:
            made = _from_photo(photo, item, made, mesh, root)
        exported.append(made)
    save_scene(root, _scene(scene, items, tuple(exported), root, photo))
    return tuple(
        ComposedObject(uid=item.session_uid, label=item.name, name=made.name)
        for item, made in zip(items, exported, strict=True)
    )


def _from_photo(photo: Scene, item: bpy.types.Object, made: SceneObject, mesh: Triangles, root: Path) -> SceneObject:
    """Return ``made`` with texture and mask of the photo's scene, in its current shape."""
    source = next((other for other in photo.model.objects if other.name == item.physgen.source), None)
    if source is None:
        raise InputError(f"object {item.name!r}: was not imported with the photo: fit it by physics, without the photo")
    path = photo.file(source.mesh)
    textured = read_textured_mesh(path)
    if len(textured.vertices) != len(mesh.points):
        raise InputError(
            f"object {item.name!r}: has {len(mesh.points)} vertices and its texture is for {len(textured.vertices)}: "
            "undo what changed its mesh, or fit it by physics, without the photo"
        )
    name = f"meshes/{made.name}{path.suffix.lower()}"
    write_moved_mesh(path, inside(root, name), mesh.points.astype(np.float64), textured.faces)
    if source.mask is not None:
        _copy(photo.file(source.mask), inside(root, f"masks/{made.name}.png"))
        made = dataclasses.replace(made, mask=f"masks/{made.name}.png")
    if source.shading is not None:
        _copy(photo.file(source.shading), inside(root, f"shading/{made.name}.png"))
        made = dataclasses.replace(made, shading=f"shading/{made.name}.png")
    return dataclasses.replace(made, mesh=name, occlusion_order=source.occlusion_order)


def _scene(
    scene: bpy.types.Scene,
    items: Sequence[bpy.types.Object],
    objects: tuple[SceneObject, ...],
    root: Path,
    photo: Scene | None,
) -> SceneModel:
    ground = _ground(scene, items)
    if photo is None:
        view = export_world.camera(scene, metres_per_unit(scene), depsgraph(scene))
        return SceneModel(camera=view, objects=objects, ground=ground, photo=None, background=None)
    for name in (photo.model.photo, photo.model.background):
        assert name is not None
        _copy(photo.file(name), inside(root, name))
    return SceneModel(
        camera=photo.model.camera,
        objects=objects,
        ground=ground,
        photo=photo.model.photo,
        background=photo.model.background,
    )


def _ground(scene: bpy.types.Scene, items: Sequence[bpy.types.Object]) -> Ground | None:
    """Return the simulation's ground if one of the objects is simulated, else None."""
    if not any(is_body(item) for item in items):
        return None
    return export_world.ground(scene, metres_per_unit(scene), depsgraph(scene))


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def read_composed(folder: Scene, name: str) -> NDArray[np.float64]:
    """Return vertices (V, 3) of object ``name`` in object space. Raises InputError if they are missing."""
    source = next((item for item in folder.model.objects if item.name == name), None)
    if source is None:
        raise InputError(f"{folder.root}: has no object {name!r}; fit again")
    path = folder.file(source.mesh)
    return read_points_file(path) if path.suffix == ".ply" else read_textured_mesh(path).vertices
