# SPDX-License-Identifier: MIT
"""Options of a bake, and the hash of all that it depends on: the same inputs never run twice.

Blender's own process imports this, without SciPy and trimesh: nothing here may import more than numpy.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from typing import Any

from ..cache.bake_folder import SPACES, WORLD_SPACE
from ..errors import InputError
from ..scene.folder import Scene
from ..validation import quantity, to_json

ENGINE_REVISION = 17
"""Raised with every change of the engine or the skinning that changes what a scene does."""


@dataclass(frozen=True, kw_only=True)
class BakeOptions:
    """Options of a bake.

    frames: samples to bake, 1 to 100000; the first is the scene at rest.
    fps: frames a second of the clip, above 0 and up to 1000.
    slow: how many times slower than real the clip shows the motion, 0.01 to 100: from frame to frame 1 / (fps slow)
        seconds go by in the scene. Motion blur and everything else follows that, as in a camera with so many frames a
        second.
    quality: name of a preset in ``presets/qualities``.
    arch: ``cpu``, ``cuda``, ``vulkan`` or ``metal``; what is not there falls back to ``cpu`` with a notice.
    seed: of the particles' places, 0 or more; 0 is the even lattice, every other moves each a little its own way. Sand
        and snow are scattered without a lattice by every seed.
    space: what samples are in, ``world`` (metres) or ``mesh`` (the coordinates of the object's mesh file, so that an
        object that stands by its matrix goes on standing by it).
    points: whether all particles of what flows (sand, fluid, snow) get caches of their own.
    implicit: whether stiff elastic objects take implicit steps while they fly, slide or rest, where these cost less:
        of scenes whose other objects are colliders, or asleep. Needs ``arch`` ``cpu``.
    """

    frames: int = quantity(48, 1, 100_000, "samples")
    fps: float = quantity(24.0, 0.0, 1000.0, "frames per second")
    slow: float = quantity(1.0, 0.01, 100.0, "times slower than real")
    quality: str = "standard"
    arch: str = "cpu"
    seed: int = quantity(0, 0, math.inf, "a whole number")
    space: str = WORLD_SPACE
    points: bool = True
    implicit: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= 100_000:
            raise InputError(f"frames is {self.frames}: give 1 to 100000")
        if not 0 < self.fps <= 1000:
            raise InputError(f"fps is {self.fps}: give frames a second above 0 and up to 1000")
        if not 0.01 <= self.slow <= 100:
            raise InputError(f"slow is {self.slow}: give 0.01 to 100 times slower than real")
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}: give a whole number, 0 or more")
        if self.space not in SPACES:
            raise InputError(f"space is {self.space!r}: choose one of {', '.join(SPACES)}")

    @property
    def rate(self) -> float:
        """Return frames per second of the scene's own time."""
        return self.fps * self.slow


def inputs_hash(scene: Scene, options: BakeOptions) -> str:
    """Return the SHA-256 over everything that the bake of ``scene`` depends on: what ``scene.hash()`` covers, the
    options and the engine. Raises InputError when a file of the scene cannot be read.
    """
    content = {"engine": ENGINE_REVISION, **scene.motion_inputs(), "options": _options_json(options)}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _options_json(options: BakeOptions) -> dict[str, Any]:
    """Return the options as JSON without later ones at their former default, so that older bakes stay in use."""
    fields: dict[str, Any] = to_json(options)
    for name, before in (("space", WORLD_SPACE), ("points", False), ("slow", 1.0)):
        if fields[name] == before:
            del fields[name]
    return fields
