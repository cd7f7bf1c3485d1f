# SPDX-License-Identifier: MIT
"""One coarse run for the live preview: a scene, changes to it → vertices of proxy meshes, frame by frame.

A run's folder holds for each object that moves ``NAME.faces.npy``, (T, 3) int32 vertex indices, and ``NAME.pc2``, the
proxy's vertices in world metres; a PC2 file can be read while it grows.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..cache.pc2 import Pc2Writer
from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent
from ..mpm.colliders import Surface
from ..scene.folder import SceneFolder, load_scene
from ..scene.meshes import ObjectMesh, load_object_mesh
from ..scene.model import Scene, SceneObject
from ..scene.overrides import apply_overrides
from ..skinning.binding import Binding, bind, deform
from .collider_motion import moves, vertices_at
from .preview_proxy import Proxy, proxy
from .preview_request import PreviewRequest
from .preview_world import prepare_preview, without_tiny
from .simulation import Simulation, start_world

PARTS_A_SECOND = 96.0
"""Cancelling is looked for this many times in a second of motion."""

MOST_MESHES = 64


class PreviewRunner:
    """Runs requests one after the other, and keeps what the next one needs again: meshes, and what comes of them."""

    def __init__(self) -> None:
        self._meshes: OrderedDict[tuple[Any, ...], tuple[ObjectMesh, Proxy]] = OrderedDict()

    def run(self, request: PreviewRequest, out: Path, on_event: OnEvent, cancelled: IsCancelled) -> None:
        """Carry out ``request`` into the new folder ``out``.

        Events: ``started`` with the ``objects`` {name, vertices, triangles} and ``notices``, ``frame`` with ``done``
        after each, ``done``. Raises InputError, SimulationError, or Cancelled as soon as ``cancelled()``.
        """
        folder = load_scene(Path(request.scene))
        folder = SceneFolder(root=folder.root, scene=apply_overrides(folder.scene, request.overrides))
        pairs = [self._mesh(folder, item) for item in folder.scene.objects]
        scene, left, gone = without_tiny(folder.scene, [mesh for mesh, _ in pairs], request.particles)
        folder, pairs = SceneFolder(root=folder.root, scene=scene), [pairs[i] for i in left]
        prepared, notices = prepare_preview(
            folder, [mesh for mesh, _ in pairs], frames=request.frames, fps=request.fps, particles=request.particles
        )
        _stop_if(cancelled)
        simulation = start_world(prepared)
        _stop_if(cancelled)
        shown = _shown(folder.scene, simulation, [small for _, small in pairs])
        try:
            out.mkdir(parents=True)
            with contextlib.ExitStack() as stack:
                writers = []
                for name, small, _ in shown:
                    np.save(out / f"{name}.faces.npy", small.faces.astype(np.int32), allow_pickle=False)
                    path = out / f"{name}.pc2"
                    writers.append(stack.enter_context(Pc2Writer(path, vertex_count=len(small.vertices))))
                    writers[-1].append(small.vertices)
                objects = [
                    {"name": name, "vertices": len(small.vertices), "triangles": len(small.faces)}
                    for name, small, _ in shown
                ]
                on_event({"event": "started", "objects": objects, "notices": [*gone, *notices], "folder": str(out)})
                on_event({"event": "frame", "done": 1, "total": request.frames})
                for frame in range(1, request.frames):
                    _advance(simulation, frame / request.fps, cancelled)
                    for writer, (_, _, vertices) in zip(writers, shown, strict=True):
                        writer.append(vertices())
                    on_event({"event": "frame", "done": frame + 1, "total": request.frames})
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror or error}); free space") from error
        on_event({"event": "done", "frames": request.frames})

    def _mesh(self, folder: SceneFolder, item: SceneObject) -> tuple[ObjectMesh, Proxy]:
        """The mesh of ``item`` and its proxy; the same objects as long as file and place are the same."""
        path = folder.file(item.mesh)
        stat = path.stat()
        key = (str(path), stat.st_size, stat.st_mtime_ns, item.world_from_mesh)
        if key not in self._meshes:
            mesh = load_object_mesh(folder, item)
            self._meshes[key] = (mesh, proxy(mesh))
        self._meshes.move_to_end(key)
        while len(self._meshes) > MOST_MESHES:
            self._meshes.popitem(last=False)
        return self._meshes[key]


Shown = tuple[str, Proxy, Callable[[], Any]]


def _shown(scene: Scene, simulation: Simulation, proxies: list[Proxy]) -> list[Shown]:
    """What moves: its name, its proxy, and where the proxy's vertices are now."""
    found: list[Shown] = []
    colliders = simulation.prepared.setup.colliders
    for slot, (item, small) in enumerate(zip(scene.objects, proxies, strict=True)):
        body, rest = simulation.body_of_object[slot], simulation.rest_positions[slot]
        collider = simulation.prepared.collider_of_object[slot]
        if body is not None and rest is not None:
            found.append((item.name, small, _follower(simulation, body, bind(small.vertices, rest))))
        elif collider is not None and moves(colliders[collider]) and colliders[collider].vertices is None:
            found.append((item.name, small, _led(simulation, collider, small)))
    return found


def _follower(simulation: Simulation, body: int, binding: Binding) -> Callable[[], Any]:
    world = simulation.world
    return lambda: deform(binding, world.positions(body), world.deformation_gradients(body))


def _led(simulation: Simulation, collider: int, small: Proxy) -> Callable[[], Any]:
    source = simulation.prepared.setup.colliders[collider]
    surface = Surface(vertices=small.vertices, faces=small.faces)
    stand_in = dataclasses.replace(source, surface=surface, pivot=tuple(source.middle.tolist()))
    return lambda: vertices_at(stand_in, simulation.world.time)


def _advance(simulation: Simulation, end: float, cancelled: IsCancelled) -> None:
    world = simulation.world
    start = world.time
    parts = max(1, round((end - start) * PARTS_A_SECOND))
    for part in range(1, parts + 1):
        _stop_if(cancelled)
        target = start + (end - start) * part / parts
        if target > world.time:
            world.advance(target - world.time)


def _stop_if(cancelled: IsCancelled) -> None:
    if cancelled():
        raise Cancelled("a newer request has come")
