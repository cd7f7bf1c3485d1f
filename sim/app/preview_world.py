# SPDX-License-Identifier: MIT
"""A scene's world as coarse as a live preview bears: few particles, and never more time steps than it has time for.

What is stiffer than those steps bear is previewed softer, and the asker is told by how much.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..mpm.estimate import stable_step
from ..mpm.options import SolverOptions
from ..scene.folder import SceneFolder
from ..scene.meshes import ObjectMesh
from ..scene.model import GROUND, Box, Material, Scene
from .bake_inputs import BakeOptions
from .quality import Quality
from .setup_resolution import cell_size, mesh_volume
from .setup_world import PreparedWorld, prepare_world

PARTICLES_PER_CELL = 8

MAX_STEP = 1.5e-3
"""Longest substep in s: a fall of half a second is wrong by 0.3 %."""

CFL_ELASTIC, CFL_VELOCITY = 0.5, 0.4

STEPS_A_SECOND = 1800.0
"""Substeps for a second of motion: 75 a frame at 24 frames a second. Two thousand elastic particles take 1 ms each on
two cores, so that a frame is there in less than a tenth of a second."""

FLOWING = frozenset(("sand", "snow", "fluid"))
FLOWING_STEPS_A_SECOND = 750.0
FLOWING_SHARE = 0.6
"""The same where such matter is, whose substeps take more than twice as long, and the share of the particles then."""

WORTH_SAYING = 0.7
"""A body whose stiffness is cut to less than this share is told of."""

MOST_EXCESS = 3.0
"""Small objects may cost this many times as many particles as are wanted; beyond that they are left out."""

MOST_RIGID = 10
"""Rigid bodies are sampled as finely as the soft ones, but with at most this many times as many particles in all."""


def prepare_preview(
    folder: SceneFolder, meshes: Sequence[ObjectMesh], *, frames: int, fps: float, particles: int
) -> tuple[PreparedWorld, list[str]]:
    """The coarse world of the scene in ``folder``, and what a person should know about it.

    meshes, frames, fps: as for a bake. particles: of all soft bodies together. Raises InputError as ``prepare_world``.
    """
    options = BakeOptions(frames=frames, fps=fps)
    quality = preview_quality(folder.scene, meshes, particles)
    coarse = _coarsened(folder.scene, meshes, quality)
    prepared = prepare_world(SceneFolder(root=folder.root, scene=coarse), meshes, options, quality)
    soft, notices = _softened(coarse, prepared)
    if soft != coarse:
        prepared = prepare_world(SceneFolder(root=folder.root, scene=soft), meshes, options, quality)
    return dataclasses.replace(prepared, solver=_faster(prepared.solver)), [*prepared.warnings, *notices]


def preview_quality(scene: Scene, meshes: Sequence[ObjectMesh], particles: int) -> Quality:
    """How finely to sample so that soft bodies get about ``particles`` together, and small ones still some."""
    moving = [i for i, item in enumerate(scene.objects) if item.role == "dynamic"]
    volumes = {i: abs(mesh_volume(meshes[i])) for i in moving}
    total = max(sum(volumes.values()), 1e-18)
    soft = sum(volume for i, volume in volumes.items() if scene.objects[i].material.law != "rigid") or total
    particles = int(particles * (FLOWING_SHARE if _flows(scene) else 1.0))
    wanted = int(np.clip(particles * total / max(soft, 1e-18), 500, MOST_RIGID * particles))
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


def _coarsened(scene: Scene, meshes: Sequence[ObjectMesh], quality: Quality) -> Scene:
    """``scene`` with walls and pins that few particles still make out: a cell thick, and a particle wider."""
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


def _flows(scene: Scene) -> bool:
    if any(effect.name == "sandy" for effect in scene.effects):
        return True
    return any(item.role == "dynamic" and item.material.law in FLOWING for item in scene.objects)


def without_tiny(scene: Scene, meshes: Sequence[ObjectMesh], particles: int) -> tuple[Scene, list[int], list[str]]:
    """``scene`` without moving objects so small beside the others that these would take far too many particles.

    Returns the scene, which of its objects are left, and a sentence for each that is not.
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
        if volume / cell**3 * PARTICLES_PER_CELL <= MOST_EXCESS * max(quality.particles, particles):
            break
        left.remove(min(moving, key=lambda i: float(np.ptp(meshes[i].vertices, axis=0).max())))
        small = _only(scene, {scene.objects[i].name for i in left})
    gone = [item.name for i, item in enumerate(scene.objects) if i not in left]
    return small, left, [f"{name}: too small beside the other objects for a preview; it is left out" for name in gone]


def _only(scene: Scene, names: set[str]) -> Scene:
    """``scene`` with the objects of these ``names``, and what concerns them."""
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
    return dataclasses.replace(solver, max_step=MAX_STEP, cfl_elastic=CFL_ELASTIC, cfl_velocity=CFL_VELOCITY)


def _softened(scene: Scene, prepared: PreparedWorld) -> tuple[Scene, list[str]]:
    """``scene`` with no body stiffer than the preview has steps for, and a sentence for each that was softened."""
    bodies = prepared.setup.bodies
    steps = FLOWING_STEPS_A_SECOND if _flows(scene) else STEPS_A_SECOND
    solver = _faster(prepared.solver)
    cell = solver.cell_size(prepared.similarity)
    objects, notices = list(scene.objects), []
    for i, item in enumerate(scene.objects):
        index = prepared.body_of_object[i]
        if index is None or bodies[index].rigid:
            continue
        at_rest = dataclasses.replace(bodies[index], velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), velocity_keys=None)
        # The step goes with the root of the stiffness.
        share = (stable_step([at_rest], cell, solver) * steps) ** 2
        if share < 1.0:
            objects[i] = dataclasses.replace(item, material=_softer(item.material, share))
        if share < WORTH_SAYING:
            notices.append(f"{item.name}: shown {1 / share:.2g} times softer than it is; the bake will not do that")
    return dataclasses.replace(scene, objects=tuple(objects)), notices


def _softer(material: Material, share: float) -> Material:
    return dataclasses.replace(
        material,
        youngs_modulus=max(material.youngs_modulus * share, 1e2),
        bulk_modulus=max(material.bulk_modulus * share, 1e2),
        fibre_modulus=material.fibre_modulus * share,
    )
