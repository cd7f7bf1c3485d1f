# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender scene → a scene folder that the worker simulates.

Every body of the scene becomes an object with a mesh in its own space. Of a simulated one that is the mesh without
modifiers, vertex for vertex, because the cache goes in front of all modifiers; of a collider it is what is seen.
``world_from_mesh`` is the object's matrix at the first frame, in metres. Photo and light stay where they are: what is
rendered is the Blender scene.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.gaussians.ply.write import write_splats
from ...sim.scene.folder import SCENE_FILE, SceneFolder, parse_scene, referenced_files, save_scene
from ...sim.scene.json_fields import read_json
from ...sim.scene.model import Ground, Scene, SceneObject
from ..props.body import bodies
from . import export_world, splats
from .export_colliders import Collider
from .export_meshes import Triangles, closed, read_triangles, require_sound, write_mesh
from .export_motion import depsgraph, modifiers_off, sample
from .export_names import export_names
from .export_objects import physics, sand
from .export_pins import PinBoxes
from .export_refusals import OWN, require_evaluated, require_placed, require_simulable, require_still_settings
from .export_units import clock, metres_per_unit, placed

SUNK = 0.25
"""Share of its size by which an object may reach into the ground; finer is the simulation's to judge."""


def export_scene(scene: bpy.types.Scene, root: Path) -> SceneFolder:
    """Write ``scene.json`` and meshes of ``scene`` into ``root``, for the worker.

    An earlier export there is replaced, and what only it needed is deleted. Frames are stepped through only where a
    collider, a pin or gravity is animated; the present one comes back.

    Raises InputError, naming the object and the way out, for what cannot be simulated or would not look like what is
    seen, and where ``root`` holds a scene with a photo.
    """
    return _Export(scene, root).write()


class _Export:
    """One export: what is read of Blender, then what is written of it."""

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

    def write(self) -> SceneFolder:
        """Read, write, and delete what an earlier export left."""
        for item in self._items:
            if item.data.is_editmode:
                item.update_from_editmode()
        colliders = [item for item in self._items if item.physgen.role == "collider"]
        own = [m for item in colliders for m in item.modifiers if m.name.startswith(OWN) and m.show_viewport]
        with modifiers_off(own):
            result = save_scene(self._root, self._read())
        for name in self._before - set(referenced_files(result.scene)):
            with contextlib.suppress(OSError):
                result.file(name).unlink()
        return result

    def _read(self) -> Scene:
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
        tracks = [gravity, *colliders.values(), *pins.values()]
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
                objects.append(self._dynamic(item, pins.get(item.name), ground, graph))
        effects = export_world.effects(scene, self._names)
        for item in self._items:
            effects += sand(item, self._names[item.name], times)
        return Scene(
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
        self, item: bpy.types.Object, pins: PinBoxes | None, ground: Ground | None, graph: bpy.types.Depsgraph
    ) -> SceneObject:
        file, mesh = self._base_mesh(item)
        matrix = placed(item.evaluated_get(graph).matrix_world, self._unit)
        require_placed(matrix, item.name)
        world = _to_world(mesh, matrix)
        if ground is not None:
            _require_above(item, world, ground)
        return SceneObject(
            name=self._names[item.name],
            mesh=file,
            world_from_mesh=_rows(matrix),
            size_m=float(np.ptp(world, axis=0).max()),
            splats=self._splats(item),
            pins=() if pins is None else pins.boxes(),
            pin_motion=() if pins is None else pins.motion(),
            **physics(item, self._unit, self._clock),
        )

    def _base_mesh(self, item: bpy.types.Object) -> tuple[str, Triangles]:
        """The mesh of ``item`` and its file, which objects with the same mesh share."""
        key = item.data.as_pointer()
        if key not in self._files:
            mesh = closed(read_triangles(item.data))
            require_sound(mesh, item.name)
            file = f"meshes/{self._names[item.name]}.ply"
            write_mesh(self._root / file, mesh.points, mesh.faces)
            self._files[key] = file, mesh
        return self._files[key]

    def _splats(self, item: bpy.types.Object) -> str | None:
        """The file of the splats of ``item``, in its own space; None without."""
        found = splats.find(item)
        if found is None or not len(found.data.vertices):
            return None
        file = f"splats/{self._names[item.name]}.ply"
        write_splats(self._root / file, splats.read(found))
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
            world_from_mesh=_rows(collider.matrix),
            size_m=float(np.ptp(_to_world(collider.mesh, collider.matrix), axis=0).max()),
            motion=motion,
            # A collider that bends has no motion that splats could follow.
            splats=self._splats(item) if motion is None or motion.vertices_file is None else None,
            **physics(item, self._unit, self._clock),
        )


def _previous_files(scene: bpy.types.Scene, root: Path) -> set[str]:
    """The files of the export that ``root`` holds. Raises InputError where it holds somebody's scene instead."""
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
        # Another version's export is replaced; what it needed stays, as nobody knows what that was.
        return set()


def _to_world(mesh: Triangles, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vertices (V, 3) in world metres."""
    return mesh.points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def _rows(matrix: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(number) for number in row) for row in matrix)


def _require_above(item: bpy.types.Object, vertices: NDArray[np.float64], ground: Ground) -> None:
    """Raise InputError where dynamic ``item`` stands far in the ground; the worker measures what is less."""
    depth = -float(ground.heights(vertices).min())
    if depth > SUNK * float(np.ptp(vertices, axis=0).max()):
        raise InputError(
            f"object {item.name!r}: reaches {depth:.3g} m into the ground: lift it, lower the ground, or let it be "
            "a collider"
        )
