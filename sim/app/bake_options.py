# SPDX-License-Identifier: MIT
"""What a bake depends on, as one hash: the same inputs never run twice, and any change runs again.

Asked by Blender's own process, which has neither SciPy nor trimesh: nothing here may import more than numpy.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..cache.bake_folder import SPACES, WORLD_SPACE
from ..errors import InputError
from ..scene.folder import Scene
from ..scene.model import Ground
from ..validation import to_json

ENGINE_REVISION = 3
"""Raised with every change of the engine or the skinning that changes what a scene does."""


@dataclass(frozen=True, kw_only=True)
class BakeOptions:
    """How a scene is simulated.

    frames: samples to bake, 1 to 100000; the first is the scene at rest.
    fps: frames a second, above 0 and up to 1000.
    quality: name of a preset in ``presets/qualities``.
    arch: ``cpu``, ``cuda``, ``vulkan`` or ``metal``; what is not there falls back to ``cpu`` with a notice.
    seed: of the particles' places, 0 or more; 0 is the even lattice, every other moves each a little its own way.
    space: what samples are in, ``world`` (metres) or ``mesh`` (the coordinates of the object's mesh file, so that an
        object that stands by its matrix goes on standing by it).
    points: whether all particles of what flows (sand, fluid, snow) get caches of their own.
    """

    frames: int = 48
    fps: float = 24.0
    quality: str = "standard"
    arch: str = "cpu"
    seed: int = 0
    space: str = WORLD_SPACE
    points: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= 100_000:
            raise InputError(f"frames is {self.frames}: give 1 to 100000")
        if not 0 < self.fps <= 1000:
            raise InputError(f"fps is {self.fps}: give frames a second above 0 and up to 1000")
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}: give a whole number, 0 or more")
        if self.space not in SPACES:
            raise InputError(f"space is {self.space!r}: choose one of {', '.join(SPACES)}")


def inputs_hash(folder: Scene, options: BakeOptions) -> str:
    """SHA-256 over everything that the motion depends on; photo, camera and light do not count."""
    scene = folder.model
    objects = []
    for item in scene.objects:
        fields: dict[str, Any] = to_json(item)
        for irrelevant in ("mask", "shadow", "occlusion_order", "size_m"):
            del fields[irrelevant]
        fields["material"].pop("preset")
        fields["mesh"] = file_hash(folder.file(item.mesh))
        if item.splats is None:
            # As before there were any, so that older bakes stay in use.
            del fields["splats"]
        else:
            fields["splats"] = file_hash(folder.file(item.splats))
        if item.motion is not None and item.motion.vertices_file is not None:
            fields["motion"]["vertices_file"] = file_hash(folder.file(item.motion.vertices_file))
        objects.append(fields)
    content = {
        "engine": ENGINE_REVISION,
        "objects": objects,
        "ground": _ground(scene.ground),
        "gravity": scene.gravity,
        "gravity_track": to_json(scene.gravity_track),
        "contacts": to_json(scene.contacts),
        "effects": to_json(scene.effects),
        "options": _said(options),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _ground(ground: Ground | None) -> dict[str, Any] | None:
    """The ground without what is only seen."""
    if ground is None:
        return None
    fields: dict[str, Any] = to_json(ground)
    for irrelevant in ("reflectivity", "reflection_roughness"):
        del fields[irrelevant]
    return fields


def _said(options: BakeOptions) -> dict[str, Any]:
    """The options without those that came later and say what went without saying, so that older bakes stay in use."""
    fields: dict[str, Any] = to_json(options)
    for name, before in (("space", WORLD_SPACE), ("points", False)):
        if fields[name] == before:
            del fields[name]
    return fields


def geometry_hash(folder: Scene) -> str:
    """SHA-256 over the objects' names, meshes and rest poses: what a bake must share with the scene it is shown in."""
    content = [[o.name, file_hash(folder.file(o.mesh)), o.world_from_mesh] for o in folder.model.objects]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes; InputError when it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
