# SPDX-License-Identifier: MIT
"""Cost of a bake, without baking: the scene is sampled and checked as for the bake itself."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..cache.bake_folder import BakedObject
from ..errors import InputError
from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from .bake_options import BakeOptions
from .bake_samples import baked_objects, load_object_splats
from .world_setup import PreparedWorld, prepare_world

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

    Raises InputError as ``world_setup.prepare_world`` does; ``require_affordable`` says what the bake would refuse.
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
