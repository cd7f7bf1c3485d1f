# SPDX-License-Identifier: MIT
"""Coarse runs for the live preview: few particles, a bounded number of time steps, vertices of proxy meshes.

A material that is too stiff for those steps is previewed softer, with a notice by how much. A run's folder holds for
each moving object ``NAME.faces.npy``, (T, 3) int32 vertex indices, and ``NAME.pc2``, the proxy's vertices in world
metres; a PC2 file can be read while it grows.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cache.pc2 import Pc2Writer
from ..constitutive import RIGID, SHAPED, cohesion_of
from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent
from ..mpm.colliders import Surface
from ..mpm.cost_estimate import stable_step
from ..mpm.solver_options import SolverOptions
from ..scene.bake_quality import Quality
from ..scene.folder import Scene, load_scene
from ..scene.meshes import ObjectMesh, load_object_mesh
from ..scene.model import GROUND, Box, Material, SceneModel, SceneObject
from ..scene.overrides import apply_overrides
from ..skinning import Binding, bind, deform
from .bake_options import BakeOptions
from .preview_server import PreviewRequest
from .scene_to_world import PreparedWorld, prepare_world
from .scene_to_world_checks import cell_size, mesh_volume, vertices_at
from .simulation import Simulation, start_world

MAX_VERTICES = 20_000


@dataclass(frozen=True, eq=False)
class ProxyMesh:
    """vertices: (V, 3) world metres; faces: (T, 3) vertex indices."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


def proxy_mesh(mesh: ProxyMesh | ObjectMesh, most: int = MAX_VERTICES) -> ProxyMesh:
    """Return ``mesh`` decimated to at most ``most`` vertices by vertex clustering; degenerate faces are dropped.

    Coincident vertices are always merged, so that a seam is never drawn as an edge.
    """
    points, owners = np.unique(mesh.vertices, axis=0, return_inverse=True)
    owners = owners.reshape(-1)
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    cells = float(np.sqrt(most))
    while len(points) > most and cells >= 2:
        keys = np.floor((mesh.vertices - low) * (cells / extent)).astype(np.int64)
        _, owners = np.unique(keys, axis=0, return_inverse=True)
        owners = owners.reshape(-1)
        counts = np.bincount(owners)
        points = np.stack([np.bincount(owners, weights=mesh.vertices[:, c]) / counts for c in range(3)], axis=1)
        cells *= 0.8
    faces = owners[mesh.faces]
    a, b, c = faces.T
    return ProxyMesh(vertices=points, faces=faces[(a != b) & (b != c) & (c != a)].astype(np.int64))


PARTICLES_PER_CELL = 8

MAX_STEP = 1.5e-3
"""Longest substep in s: the error of a fall of half a second is 0.3 %."""

CFL_ELASTIC, CFL_VELOCITY = 0.5, 0.4

STEPS_PER_SECOND = 1800.0
"""Substeps per second of motion: 75 per frame at 24 fps. With two thousand elastic particles each takes 1 ms on two
cores, so that a frame takes less than a tenth of a second."""

GRANULAR_STEPS_PER_SECOND = 750.0
GRANULAR_PARTICLE_SHARE = 0.6
"""The same with granular or fluid material, whose substeps take over twice as long, and its share of the particles."""

NOTICE_BELOW = 0.7
"""A body whose stiffness is reduced below this share gets a notice."""

MAX_EXCESS = 3.0
"""Small objects may raise the number of particles by this factor; beyond that they are left out."""

MAX_RIGID_FACTOR = 10
"""Rigid bodies are sampled as finely as deformable ones, but with at most this many times as many particles."""


def prepare_preview(
    folder: Scene, meshes: Sequence[ObjectMesh], *, frames: int, fps: float, particles: int
) -> tuple[PreparedWorld, list[str]]:
    """Return the coarse world of the scene in ``folder``, and notices about it.

    meshes, frames, fps: as for a bake. particles: of all deformable bodies together. Raises InputError as
    ``prepare_world``.
    """
    options = BakeOptions(frames=frames, fps=fps)
    quality = preview_quality(folder.model, meshes, particles)
    coarse = _coarsened(folder.model, meshes, quality)
    prepared = prepare_world(Scene(root=folder.root, model=coarse), meshes, options, quality)
    soft, notices = _softened(coarse, prepared)
    if soft != coarse:
        prepared = prepare_world(Scene(root=folder.root, model=soft), meshes, options, quality)
    return dataclasses.replace(prepared, solver=_faster(prepared.solver)), [*prepared.warnings, *notices]


def preview_quality(scene: SceneModel, meshes: Sequence[ObjectMesh], particles: int) -> Quality:
    """Return a quality that gives deformable bodies about ``particles`` together, and small ones still some."""
    moving = [i for i, item in enumerate(scene.objects) if item.role == "dynamic"]
    volumes = {i: abs(mesh_volume(meshes[i])) for i in moving}
    total = max(sum(volumes.values()), 1e-18)
    soft = sum(volume for i, volume in volumes.items() if scene.objects[i].material.law != "rigid") or total
    particles = int(particles * (GRANULAR_PARTICLE_SHARE if _is_granular_or_fluid(scene) else 1.0))
    wanted = int(np.clip(particles * total / max(soft, 1e-18), 500, MAX_RIGID_FACTOR * particles))
    for cells in (4, 3):
        quality = Quality(
            description="live preview",
            particles=wanted,
            particles_per_cell=PARTICLES_PER_CELL,
            smallest_cells=cells,
        )
        if not moving or total / cell_size([meshes[i] for i in moving], quality) ** 3 * PARTICLES_PER_CELL < 2 * wanted:
            return quality
    return dataclasses.replace(quality, smallest_cells=2)


def _coarsened(scene: SceneModel, meshes: Sequence[ObjectMesh], quality: Quality) -> SceneModel:
    """Return ``scene`` with walls at least a cell thick and pins a particle wider, to suit few particles."""
    moving = [mesh for item, mesh in zip(scene.objects, meshes, strict=True) if item.role == "dynamic"]
    if not moving:
        return scene
    cell = cell_size(moving, quality)
    objects = []
    for item in scene.objects:
        if item.shell_thickness is not None and item.shell_thickness < cell:
            item = dataclasses.replace(item, shell_thickness=cell)
        if item.pins:
            item = dataclasses.replace(item, pins=tuple(_wider(box, 0.5 * cell) for box in item.pins))
        objects.append(item)
    return dataclasses.replace(scene, objects=tuple(objects))


def _wider(box: Box, margin: float) -> Box:
    (a, b, c), (d, e, f) = box.low, box.high
    return Box(low=(a - margin, b - margin, c - margin), high=(d + margin, e + margin, f + margin))


def _is_granular_or_fluid(scene: SceneModel) -> bool:
    if any(effect.name == "sandy" for effect in scene.effects):
        return True
    moving = [item.material.law for item in scene.objects if item.role == "dynamic"]
    return any(cohesion_of(law) not in (SHAPED, RIGID) for law in moving)


def without_tiny(
    scene: SceneModel, meshes: Sequence[ObjectMesh], particles: int
) -> tuple[SceneModel, list[int], list[str]]:
    """Return ``scene`` without moving objects that are so small that the others would need far too many particles.

    Also returns the indices of the remaining objects, and a sentence for each that was left out.
    """
    left = list(range(len(scene.objects)))
    small = scene
    while True:
        shapes = [meshes[i] for i in left]
        moving = [i for i in left if scene.objects[i].role == "dynamic"]
        if len(moving) < 2:
            break
        quality = preview_quality(small, shapes, particles)
        volume = sum(abs(mesh_volume(meshes[i])) for i in moving)
        cell = cell_size([meshes[i] for i in moving], quality)
        if volume / cell**3 * PARTICLES_PER_CELL <= MAX_EXCESS * max(quality.particles, particles):
            break
        left.remove(min(moving, key=lambda i: float(np.ptp(meshes[i].vertices, axis=0).max())))
        small = _only(scene, {scene.objects[i].name for i in left})
    gone = [item.name for i, item in enumerate(scene.objects) if i not in left]
    return (
        small,
        left,
        [f"{name}: too small relative to the other objects for a preview; it is left out" for name in gone],
    )


def _only(scene: SceneModel, names: set[str]) -> SceneModel:
    """Return ``scene`` with only the objects ``names``, and their effects and contacts."""
    effects = []
    for effect in scene.effects:
        objects = tuple(name for name in effect.objects if name in names)
        if objects or not effect.objects:
            effects.append(dataclasses.replace(effect, objects=objects))
    return dataclasses.replace(
        scene,
        objects=tuple(item for item in scene.objects if item.name in names),
        effects=tuple(effects),
        contacts=tuple(c for c in scene.contacts if all(name in names or name == GROUND for name in c.between)),
    )


def _faster(solver: SolverOptions) -> SolverOptions:
    return dataclasses.replace(
        solver, max_step=MAX_STEP, cfl_elastic=CFL_ELASTIC, cfl_velocity=CFL_VELOCITY, implicit=False
    )


def _softened(scene: SceneModel, prepared: PreparedWorld) -> tuple[SceneModel, list[str]]:
    """Return ``scene`` with stiffness limited to the preview's time step, and a sentence for each softened body."""
    bodies = prepared.setup.bodies
    steps = GRANULAR_STEPS_PER_SECOND if _is_granular_or_fluid(scene) else STEPS_PER_SECOND
    solver = _faster(prepared.solver)
    cell = solver.cell_size(prepared.similarity)
    objects, notices = list(scene.objects), []
    for i, item in enumerate(scene.objects):
        index = prepared.body_of_object[i]
        if index is None or bodies[index].rigid:
            continue
        at_rest = dataclasses.replace(bodies[index], velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), velocity_keys=None)
        # The stable step is inversely proportional to the root of the stiffness.
        share = (stable_step([at_rest], cell, solver) * steps) ** 2
        if share < 1.0:
            objects[i] = dataclasses.replace(item, material=_softer(item.material, share))
        if share < NOTICE_BELOW:
            notices.append(
                f"{item.name}: shown {1 / share:.2g} times softer than specified; the bake uses the specified stiffness"
            )
    return dataclasses.replace(scene, objects=tuple(objects)), notices


def _softer(material: Material, share: float) -> Material:
    return dataclasses.replace(
        material,
        youngs_modulus=max(material.youngs_modulus * share, 1e2),
        bulk_modulus=max(material.bulk_modulus * share, 1e2),
        fibre_modulus=material.fibre_modulus * share,
    )


CANCEL_CHECKS_PER_SECOND = 96.0
"""Cancelling is checked this many times per second of motion."""

MAX_CACHED_MESHES = 64


class PreviewRunner:
    """Runs requests one after the other, caching meshes and data derived from them."""

    def __init__(self) -> None:
        self._meshes: OrderedDict[tuple[Any, ...], tuple[ObjectMesh, ProxyMesh]] = OrderedDict()

    def run(self, request: PreviewRequest, out: Path, on_event: OnEvent, cancelled: IsCancelled) -> None:
        """Run ``request`` into the new folder ``out``.

        Events: ``started`` with the ``objects`` {name, vertices, triangles} and ``notices``, ``frame`` with ``done``
        after each, ``done``. Raises InputError, SimulationError, or Cancelled as soon as ``cancelled()``.
        """
        folder = load_scene(Path(request.scene))
        folder = folder.with_model(apply_overrides(folder.model, request.overrides))
        pairs = [self._mesh(folder, item) for item in folder.model.objects]
        scene, left, gone = without_tiny(folder.model, [mesh for mesh, _ in pairs], request.particles)
        folder, pairs = folder.with_model(scene), [pairs[i] for i in left]
        prepared, notices = prepare_preview(
            folder, [mesh for mesh, _ in pairs], frames=request.frames, fps=request.fps, particles=request.particles
        )
        _raise_if_cancelled(cancelled)
        simulation = start_world(prepared)
        _raise_if_cancelled(cancelled)
        shown = _shown(folder.model, simulation, [small for _, small in pairs])
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

    def _mesh(self, folder: Scene, item: SceneObject) -> tuple[ObjectMesh, ProxyMesh]:
        """Return the mesh of ``item`` and its proxy, cached while file and placement are unchanged."""
        path = folder.file(item.mesh)
        stat = path.stat()
        key = (str(path), stat.st_size, stat.st_mtime_ns, item.world_from_mesh)
        if key not in self._meshes:
            mesh = load_object_mesh(folder, item)
            self._meshes[key] = (mesh, proxy_mesh(mesh))
        self._meshes.move_to_end(key)
        while len(self._meshes) > MAX_CACHED_MESHES:
            self._meshes.popitem(last=False)
        return self._meshes[key]


Shown = tuple[str, ProxyMesh, Callable[[], Any]]


def _shown(scene: SceneModel, simulation: Simulation, proxies: list[ProxyMesh]) -> list[Shown]:
    """Return the moving objects: name, proxy mesh, and a function that returns the proxy's current vertices."""
    found: list[Shown] = []
    colliders = simulation.prepared.setup.colliders
    for slot, (item, small) in enumerate(zip(scene.objects, proxies, strict=True)):
        body, rest = simulation.body_of_object[slot], simulation.rest_positions[slot]
        collider = simulation.prepared.collider_of_object[slot]
        if body is not None and rest is not None:
            found.append((item.name, small, _follower(simulation, body, bind(small.vertices, rest))))
        elif collider is not None and colliders[collider].moves and colliders[collider].vertices is None:
            found.append((item.name, small, _driven(simulation, collider, small)))
    return found


def _follower(simulation: Simulation, body: int, binding: Binding) -> Callable[[], Any]:
    world = simulation.world
    return lambda: deform(binding, world.positions(body), world.deformation_gradients(body))


def _driven(simulation: Simulation, collider: int, small: ProxyMesh) -> Callable[[], Any]:
    source = simulation.prepared.setup.colliders[collider]
    surface = Surface(vertices=small.vertices, faces=small.faces)
    stand_in = dataclasses.replace(source, surface=surface, pivot=tuple(source.middle.tolist()))
    return lambda: vertices_at(stand_in, simulation.world.time)


def _advance(simulation: Simulation, end: float, cancelled: IsCancelled) -> None:
    world = simulation.world
    start = world.time
    parts = max(1, round((end - start) * CANCEL_CHECKS_PER_SECOND))
    for part in range(1, parts + 1):
        _raise_if_cancelled(cancelled)
        target = start + (end - start) * part / parts
        if target > world.time:
            world.advance(target - world.time)


def _raise_if_cancelled(cancelled: IsCancelled) -> None:
    if cancelled():
        raise Cancelled("superseded by a newer request")
