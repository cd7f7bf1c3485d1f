# SPDX-License-Identifier: MIT
"""Before a bake, without running it: what it costs, and whether the scene's objects stay where they are.

The scene is sampled and checked as for the bake itself; rest is judged by the engine's own rule.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..cache.bake_folder import BakedObject
from ..errors import InputError
from ..mpm.sleeping import Sleepers
from ..scene.bake_quality import COARSEST
from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from ..scene.model import SceneModel
from .bake_options import BakeOptions
from .bake_samples import baked_objects, load_object_splats
from .scene_to_world import PreparedWorld, prepare_world

STATE_BYTES = 190
"""Of a checkpoint, a particle, with all that any law keeps."""

FRAME_BYTES = 512
"""Of ``metrics.json``, a frame, rounded up."""

SPLAT_BYTES = 68
"""Of a PLY file, a splat: seventeen numbers. Its header is within ``FRAME_BYTES``."""

SPARE_BYTES = 64 * 2**20
"""Bytes that stay free for other programs."""


@dataclass(frozen=True, kw_only=True)
class BakeCost:
    """Estimated cost of a bake.

    prepared: the world that it would begin with; its ``cost`` says substeps, seconds and bytes of memory.
    disk_bytes: of the finished bake and its largest checkpoint.
    """

    prepared: PreparedWorld
    disk_bytes: int

    def to_json(self) -> dict[str, Any]:
        """Return the cost as JSON: particles, cells (count, side in m), substeps, seconds, bytes, warnings."""
        prepared, cost = self.prepared, self.prepared.cost
        return {
            "particles": prepared.particle_count,
            "cells": -(-prepared.particle_count // prepared.solver.particles_per_cell),
            "cell_size_m": prepared.solver.cell_size(prepared.similarity),
            "substeps": cost.substeps,
            "seconds": cost.seconds,
            "memory_bytes": cost.bytes,
            "disk_bytes": self.disk_bytes,
            "warnings": list(prepared.warnings),
        }


def estimate_bake(folder: Scene, options: BakeOptions) -> PreparedWorld:
    """Return the world that a bake of ``folder`` starts from; its ``cost`` is time and memory.

    Raises InputError as ``scene_to_world.prepare_world`` does; ``require_affordable`` says what the bake would refuse.
    """
    return bake_cost(folder, options).prepared


def bake_cost(folder: Scene, options: BakeOptions) -> BakeCost:
    """Return the estimated cost of a bake of ``folder``, disk included. Raises InputError as ``estimate_bake`` does."""
    meshes = [load_object_mesh(folder, item) for item in folder.model.objects]
    splats = [load_object_splats(folder, *pair) for pair in zip(folder.model.objects, meshes, strict=True)]
    prepared = prepare_world(folder, meshes, options)
    objects = baked_objects(folder, meshes, splats, prepared, options)
    return BakeCost(prepared=prepared, disk_bytes=disk_bytes(objects, prepared.particle_count, options.frames))


def disk_bytes(objects: Iterable[BakedObject], particles: int, frames: int) -> int:
    """Return the bytes of the caches of ``objects`` and of two checkpoints: one is kept until the next is complete."""
    a_frame = FRAME_BYTES
    for item in objects:
        a_frame += 12 * sum(item.files.values())
        a_frame += SPLAT_BYTES * item.splats + FRAME_BYTES if item.splats else 0
    return frames * a_frame + 2 * STATE_BYTES * particles


def require_disk_space(out: Path, needed: int) -> None:
    """Raise InputError unless ``needed`` bytes and some to spare are free where the folder ``out`` is."""
    free = shutil.disk_usage(out).free
    if free < needed + SPARE_BYTES:
        raise InputError(
            f"{out}: the bake needs about {(needed + SPARE_BYTES) >> 20} MiB and {free >> 20} MiB are free; free "
            "space, bake fewer frames, or choose another disk"
        )


STILL = (0.0, 0.0, 0.0)


def at_rest(folder: Scene, notice: Callable[[str], None]) -> SceneModel:
    """Return the model of ``folder`` in which whatever is said to be asleep stays where it is: what nothing carries is
    held.

    It is judged as a bake judges it (``sim/mpm/sleeping.py``), with the particles of the coarsest quality and before
    anything is thrown: by what carries the object and where its centre of mass is. ``notice`` receives a sentence for
    each object that is held. A scene that cannot be baked is returned as it is; the bake says why.
    """
    model = folder.model
    calm = tuple(dataclasses.replace(item, velocity=STILL, spin=STILL) for item in model.objects)
    scene = Scene(root=folder.root, model=dataclasses.replace(model, objects=calm))
    try:
        meshes = [load_object_mesh(scene, item) for item in calm]
        prepared = prepare_world(scene, meshes, BakeOptions(frames=2, quality=COARSEST), check_surfaces=False)
    except InputError:
        return model
    sleepers = Sleepers(prepared.setup, prepared.solver.cell_size(prepared.similarity))
    restless = {
        body.name
        for body, wants, sleeps in zip(prepared.setup.bodies, sleepers.wanting, sleepers.asleep, strict=True)
        if wants and not sleeps
    }
    for name in sorted(restless):
        notice(
            f"{name}: nothing carries its centre of mass, as if it hung or leaned; it is held where the photo shows it "
            f"until something touches it (--set {name}.held=false lets it go). If it stands by itself, check its mask "
            "and the horizon, or give another shape or a larger thickness"
        )
    objects = tuple(dataclasses.replace(item, held=item.held or item.name in restless) for item in model.objects)
    return dataclasses.replace(model, objects=objects)
