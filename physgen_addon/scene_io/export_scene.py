# SPDX-License-Identifier: GPL-3.0-or-later
"""Export of a Blender scene as a scene folder that the worker simulates.

Every body becomes an object with a mesh in object space: for a simulated one the mesh without modifiers, vertex for
vertex, because the cache precedes all modifiers; for a collider the evaluated mesh. ``world_from_mesh`` is the object's
matrix at the first frame, in metres. Photo and light are not exported: the Blender scene is what is rendered.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.atomic import replacing
from ...sim.constitutive import RIGID
from ...sim.errors import InputError
from ...sim.gaussians.splat_ply import write_splats
from ...sim.scene.folder import SCENE_FILE, Scene, parse_scene, referenced_files, save_scene
from ...sim.scene.model import FactorMap, Ground, SceneModel, SceneObject
from ...sim.validation import read_json
from ..playback import splat_clouds
from ..props.body_props import bodies
from ..text import decimal
from . import export_world
from .export_animation import (
    clock,
    depsgraph,
    export_names,
    matrix_rows,
    metres_per_unit,
    modifiers_off,
    placed,
    sample,
)
from .export_meshes import Triangles, closed, read_triangles, require_sound, write_mesh
from .export_objects import (
    OWN,
    PAINTED,
    MaterialTracks,
    painted_weights,
    physics,
    require_evaluated,
    require_placed,
    require_simulable,
    require_still_settings,
    sand,
)
from .export_world import Collider, PinBoxes

SUNK = 0.25
"""Share of its size by which an object may penetrate the ground; smaller penetrations are judged by the worker."""


def export_scene(scene: bpy.types.Scene, root: Path) -> Scene:
    """Write ``scene.json`` and meshes of ``scene`` to ``root``, for the worker.

    An earlier export there is replaced and its unused files are deleted. Frames are stepped through only if a collider,
    a pin or gravity is animated; the current frame is restored.

    Raises InputError, with the object and a remedy, for anything that cannot be simulated or would look different from
    the viewport, and if ``root`` holds a scene with a photo.
    """
    return _Export(scene, root).write()


class _Export:
    """One export: reads Blender data, then writes files."""

    def __init__(self, scene: bpy.types.Scene, root: Path) -> None:
        self._scene, self._root = scene, root
        self._unit, self._clock = metres_per_unit(scene), clock(scene)
        self._names = export_names(scene)
        self._items = bodies(scene)
        self._before = _previous_files(scene, root)
        self._files: dict[int, tuple[str, Triangles]] = {}
        if not any(item.physgen.role == "dynamic" for item in self._items):
            raise InputError("no object is simulated: choose a mesh and let it take part with the role Moves")
        require_still_settings(scene, "scene")

    def write(self) -> Scene:
        """Read, write, and delete unused files of an earlier export."""
        for item in self._items:
            if item.data.is_editmode:
                item.update_from_editmode()
        colliders = [item for item in self._items if item.physgen.role == "collider"]
        own = [m for item in colliders for m in item.modifiers if m.name.startswith(OWN) and m.show_viewport]
        with modifiers_off(own):
            result = save_scene(self._root, self._read())
        for name in self._before - set(referenced_files(result.model)):
            with contextlib.suppress(OSError):
                result.file(name).unlink()
        return result

    def _read(self) -> SceneModel:
        scene, unit, times = self._scene, self._unit, self._clock
        graph = depsgraph(scene)
        for item in self._items:
            require_still_settings(item, f"object {item.name!r}")
            require_evaluated(item, graph)
            if item.physgen.role == "dynamic":
                require_simulable(item)
        gravity = export_world.GravityTrack(scene, unit, times)
        colliders = {item.name: Collider(item, unit, times) for item in self._items if item.physgen.role == "collider"}
        pins = {
            item.name: PinBoxes(item, scene, unit, times)
            for item in self._items
            if item.physgen.role == "dynamic" and len(item.physgen.pins)
        }
        matter = {item.name: MaterialTracks(item, times) for item in self._items if item.physgen.role == "dynamic"}
        tracks: list[export_world.GravityTrack | Collider | PinBoxes | MaterialTracks] = [gravity]
        tracks += [*colliders.values(), *pins.values(), *matter.values()]
        for track in tracks:
            if not track.moves:
                track.read(graph)
        sample(scene, times, [track.read for track in tracks if track.moves])
        graph = depsgraph(scene)
        ground = export_world.ground(scene, unit, graph)
        objects = []
        for item in self._items:
            if item.name in colliders:
                objects.append(self._collider(colliders[item.name]))
            else:
                objects.append(self._dynamic(item, pins.get(item.name), matter[item.name], ground, graph))
        effects = export_world.effects(scene, self._names)
        for item in self._items:
            effects += sand(item, self._names[item.name], times)
        return SceneModel(
            camera=export_world.camera(scene, unit, graph),
            objects=tuple(objects),
            ground=ground,
            gravity=gravity.first,
            gravity_track=gravity.keys(),
            effects=tuple(effects),
            photo=None,
            background=None,
        )

    def _dynamic(
        self,
        item: bpy.types.Object,
        pins: PinBoxes | None,
        matter: MaterialTracks,
        ground: Ground | None,
        graph: bpy.types.Depsgraph,
    ) -> SceneObject:
        file, mesh = self._base_mesh(item)
        matrix = placed(item.evaluated_get(graph).matrix_world, self._unit)
        require_placed(matrix, item.name)
        world = _to_world(mesh, matrix)
        if ground is not None:
            _require_above(item, world, ground)
        fields = physics(item, self._unit, self._clock) | self._painted(item)
        tracks = matter.tracks()
        if tracks:
            # The present frame's numbers are not those of the first.
            first = {track.field: track.keys[0].value for track in tracks}
            fields |= {"material_tracks": tracks, "material": replace(fields["material"], **first)}
        return SceneObject(
            name=self._names[item.name],
            mesh=file,
            world_from_mesh=matrix_rows(matrix),
            size_m=float(np.ptp(world, axis=0).max()),
            splats=self._splats(item),
            pins=() if pins is None else pins.boxes(),
            pin_motion=() if pins is None else pins.motion(),
            **fields,
        )

    def _painted(self, item: bpy.types.Object) -> dict[str, FactorMap]:
        """Write the weights of ``item`` and return its maps by field."""
        found = {}
        for field, group, factor in PAINTED:
            name = getattr(item.physgen, group)
            if name and not (field == "stiffness_map" and item.physgen.material.law == RIGID):
                file = f"meshes/{self._names[item.name]} {field.partition('_')[0]}.npz"
                with replacing(self._root / file) as partial, partial.open("wb") as stream:
                    np.savez(stream, weights=painted_weights(item, name))
                found[field] = FactorMap(file=file, at_one=decimal(getattr(item.physgen, factor)))
        return found

    def _base_mesh(self, item: bpy.types.Object) -> tuple[str, Triangles]:
        """Return the mesh of ``item`` and its file, shared by objects with the same mesh."""
        key = item.data.as_pointer()
        if key not in self._files:
            mesh = closed(read_triangles(item.data))
            require_sound(mesh, item.name)
            file = f"meshes/{self._names[item.name]}.ply"
            write_mesh(self._root / file, mesh.points, mesh.faces)
            self._files[key] = file, mesh
        return self._files[key]

    def _splats(self, item: bpy.types.Object) -> str | None:
        """Return the file of the splats of ``item``, in object space; None without splats."""
        found = splat_clouds.find(item)
        if found is None or not len(found.data.vertices):
            return None
        file = f"splats/{self._names[item.name]}.ply"
        write_splats(self._root / file, splat_clouds.read(found))
        return file

    def _collider(self, collider: Collider) -> SceneObject:
        item, name = collider.item, self._names[collider.item.name]
        require_sound(collider.mesh, item.name)
        require_placed(collider.matrix, item.name)
        file = f"meshes/{name}.ply"
        write_mesh(self._root / file, collider.mesh.points, collider.mesh.faces)
        motion = collider.motion(self._root, f"meshes/{name}.npz")
        return SceneObject(
            name=name,
            mesh=file,
            world_from_mesh=matrix_rows(collider.matrix),
            size_m=float(np.ptp(_to_world(collider.mesh, collider.matrix), axis=0).max()),
            motion=motion,
            # A deforming collider has no motion that splats could follow.
            splats=self._splats(item) if motion is None or motion.vertices_file is None else None,
            **physics(item, self._unit, self._clock),
        )


def _previous_files(scene: bpy.types.Scene, root: Path) -> set[str]:
    """Return the files of an earlier export in ``root``. Raises InputError if it holds another scene."""
    imported = scene.physgen.folder
    if imported and Path(bpy.path.abspath(imported)).resolve() == root.resolve():
        raise InputError(f"{root}: is the folder that this scene was imported from; choose another for its export")
    path = root / SCENE_FILE
    if not path.exists():
        return set()
    content = read_json(path)
    if not isinstance(content, dict) or content.get("photo", "") is not None:
        raise InputError(f"{root}: holds a scene with a photo, which is never overwritten; choose another folder")
    try:
        return set(referenced_files(parse_scene(content, str(path))))
    except InputError:
        # An export by another version is replaced, but its files are kept because they are unknown.
        return set()


def _to_world(mesh: Triangles, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vertices (V, 3) in world metres."""
    return mesh.points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def _require_above(item: bpy.types.Object, vertices: NDArray[np.float64], ground: Ground) -> None:
    """Raise InputError if dynamic ``item`` is deep in the ground; the worker checks smaller penetrations."""
    depth = -float(ground.heights(vertices).min())
    if depth > SUNK * float(np.ptp(vertices, axis=0).max()):
        raise InputError(
            f"object {item.name!r}: reaches {depth:.3g} m into the ground: lift it, lower the ground, or let it be "
            "a collider"
        )
