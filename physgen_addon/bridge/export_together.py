# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects that are to fit each other → a scene folder of their own, each mesh vertex for vertex in its own space."""

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
from ...sim.scene.folder import SceneFolder, inside, load_scene, save_scene
from ...sim.scene.glb import read_textured_mesh
from ...sim.scene.model import Ground, Scene, SceneObject
from ...sim.scene.moved_mesh import write_moved_mesh
from ...sim.scene.names import fitting_names
from ..props.body import is_body
from . import export_world
from .export_meshes import Triangles, read_points_file, read_triangles, require_sound, write_mesh
from .export_motion import depsgraph
from .export_refusals import foreign_modifiers, is_smoothing, require_evaluated, require_placed
from .export_units import metres_per_unit, placed

ORIGINAL = "Before Fit Together"
"""Shape key with the shape from before."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """One exported object. uid: Blender's ``session_uid``; label: its name there; name: that in the scene folder."""

    uid: int
    label: str
    name: str


def require_fittable(item: bpy.types.Object) -> None:
    """Raise InputError, with the way out, where the mesh of ``item`` is not what is seen of it or cannot be changed."""
    where = f"object {item.name!r}"
    if item.library is not None or item.data.library is not None:
        raise InputError(f"{where}: is linked from another file: make it local (Object > Relations > Make Local)")
    for modifier in foreign_modifiers(item):
        if not is_smoothing(modifier):
            raise InputError(
                f"{where}: modifier {modifier.name!r} changes its shape, and what is fitted is the mesh before it: "
                "apply it or hide it in the viewport"
            )
    keys = item.data.shape_keys
    others = [key.name for key in keys.key_blocks[1:] if key.name != ORIGINAL] if keys is not None else []
    if others:
        raise InputError(
            f"{where}: has the shape key {others[0]!r}: apply or remove it (Properties > Data > Shape Keys)"
        )
    if keys is not None and any(key.value != 0 and not key.mute for key in keys.key_blocks[1:]):
        raise InputError(f"{where}: its shape key {ORIGINAL!r} is in effect: set its value to 0, or apply it")


def photo_scene(scene: bpy.types.Scene) -> SceneFolder | None:
    """The scene folder with a photo that ``scene`` was imported from; None where there is none, or it is gone."""
    if not scene.physgen.folder:
        return None
    try:
        found = load_scene(Path(bpy.path.abspath(scene.physgen.folder)))
    except InputError:
        return None
    return found if found.scene.photo is not None else None


def export_together(
    scene: bpy.types.Scene, items: Sequence[bpy.types.Object], root: Path, *, photo: SceneFolder | None
) -> tuple[Fitted, ...]:
    """Write ``items`` as they stand in this frame into the new scene folder ``root``; who they are there, in order.

    photo: the scene folder that they were imported from, for its photo and their textures; None: without a picture.

    Raises InputError for an object whose mesh is open, flat, hidden behind modifiers or shape keys; with ``photo``,
    also for one that was not imported from it or has another number of vertices by now.
    """
    unit, graph = metres_per_unit(scene), depsgraph(scene)
    exported = []
    for item, name in zip(items, fitting_names([item.name for item in items]), strict=True):
        require_fittable(item)
        require_evaluated(item, graph)
        mesh = read_triangles(item.data)
        require_sound(mesh, item.name)
        matrix = placed(item.evaluated_get(graph).matrix_world, unit)
        require_placed(matrix, item.name)
        world = mesh.points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        made = SceneObject(
            name=name,
            mesh=f"meshes/{name}.ply",
            world_from_mesh=tuple(tuple(float(number) for number in row) for row in matrix),
            size_m=float(np.ptp(world, axis=0).max()),
        )
        if photo is None:
            write_mesh(root / made.mesh, mesh.points, mesh.faces)
        else:
            made = _from_photo(photo, item, made, mesh, root)
        exported.append(made)
    save_scene(root, _scene(scene, items, tuple(exported), root, photo))
    return tuple(
        Fitted(uid=item.session_uid, label=item.name, name=made.name)
        for item, made in zip(items, exported, strict=True)
    )


def _from_photo(
    photo: SceneFolder, item: bpy.types.Object, made: SceneObject, mesh: Triangles, root: Path
) -> SceneObject:
    """``made`` with the textured mesh and the mask of the photo's scene, in the shape that it has in Blender."""
    source = next((other for other in photo.scene.objects if other.name == item.physgen.source), None)
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
    return dataclasses.replace(made, mesh=name, occlusion_order=source.occlusion_order)


def _scene(
    scene: bpy.types.Scene,
    items: Sequence[bpy.types.Object],
    objects: tuple[SceneObject, ...],
    root: Path,
    photo: SceneFolder | None,
) -> Scene:
    ground = _ground(scene, items)
    if photo is None:
        view = export_world.camera(scene, metres_per_unit(scene), depsgraph(scene))
        return Scene(camera=view, objects=objects, ground=ground, photo=None, background=None)
    for name in (photo.scene.photo, photo.scene.background):
        assert name is not None
        _copy(photo.file(name), inside(root, name))
    return Scene(
        camera=photo.scene.camera,
        objects=objects,
        ground=ground,
        photo=photo.scene.photo,
        background=photo.scene.background,
    )


def _ground(scene: bpy.types.Scene, items: Sequence[bpy.types.Object]) -> Ground | None:
    """The simulation's ground, where one of the objects takes part in it: others do not know that it is there."""
    if not any(is_body(item) for item in items):
        return None
    return export_world.ground(scene, metres_per_unit(scene), depsgraph(scene))


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def read_fitted(folder: SceneFolder, name: str) -> NDArray[np.float64]:
    """Vertices (V, 3) of the object ``name`` in its own space. Raises InputError when they are not there."""
    source = next((item for item in folder.scene.objects if item.name == name), None)
    if source is None:
        raise InputError(f"{folder.root}: has no object {name!r}; fit again")
    path = folder.file(source.mesh)
    return read_points_file(path) if path.suffix == ".ply" else read_textured_mesh(path).vertices
