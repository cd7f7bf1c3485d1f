# SPDX-License-Identifier: GPL-3.0-or-later
"""Which frames are to be made, from which inputs, and which of them are equal."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...sim.app.bake_inputs import file_hash
from ...sim.cache.pc2 import Pc2Reader
from ...sim.errors import InputError
from ...sim.scene.folder import SceneFolder
from ...sim.scene.json_fields import to_json
from ...sim.version import VERSION
from .caches import Bake
from .options import RenderOptions

RENDER_REVISION = 2
"""Raised with every change of rendering that changes what a frame looks like."""

STILL_PX = 0.02
"""Two frames are the same when no vertex moved farther than this on the image."""


@dataclass(frozen=True)
class Frame:
    """Frame ``number`` shows ``sample`` of every cache; ``inputs`` is the hash of all that it depends on.

    Frames in which nothing moved share the sample of the first of them, and so the hash.
    """

    number: int
    sample: int
    inputs: str


def parse_range(text: str | None, first: int, last: int, remedy: str = "bake more or ask for fewer") -> list[int]:
    """Frame numbers of ``1-48``, ``1,5,9``, ``1-48x2`` or mixtures; None is ``first`` to ``last``, all there are.

    Raises InputError for anything else, and for frames that are not baked, with ``remedy``.
    """
    if text is None:
        return list(range(first, last + 1))
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+)(?:x(\d+))?)?\s*", part)
        if match is None or match[3] == "0":
            raise InputError(f"frames {text!r}: write 1-48, 1,5,9 or 1-48x2")
        start = int(match[1])
        stop = int(match[2]) if match[2] else start
        if stop < start:
            raise InputError(f"frames {text!r}: {start} comes after {stop}")
        if start < first or stop > last:
            raise InputError(f"frames {text!r}: frames {first} to {last} are baked; {remedy}")
        numbers.update(range(start, stop + 1, int(match[3] or 1)))
    return sorted(numbers)


def plan_frames(
    folder: SceneFolder,
    bake: Bake,
    numbers: Sequence[int],
    *,
    options: RenderOptions,
    blender: str,
) -> list[Frame]:
    """Hash the inputs of the frames ``numbers`` (ascending); ``blender`` names the renderer and its version."""
    base = _scene_hash(folder, options, blender)
    first_frame = bake.first_frame
    still = _still_distance(folder, bake.every, options)
    key = rest = _pose(bake, 0)
    key_index, key_hash = 0, _hash(base, rest)
    rest_hash = key_hash
    frames, wanted = [], set(numbers)
    for index in range(max(numbers) - first_frame + 1 if numbers else 0):
        now = _pose(bake, index)
        if now.same(rest, still):
            key, key_index, key_hash = rest, 0, rest_hash
        elif not now.same(key, still):
            key, key_index, key_hash = now, index, _hash(base, now)
        if first_frame + index in wanted:
            frames.append(Frame(number=first_frame + index, sample=key_index, inputs=key_hash))
    return frames


@dataclass(frozen=True)
class _Pose:
    """Where everything is: positions (N, 3) by cache, and which objects show their particles."""

    positions: list[NDArray[np.float32]]
    flowing: tuple[bool, ...]

    def same(self, other: _Pose, within: float) -> bool:
        """Whether nothing is farther than ``within`` metres from where it is in ``other``."""
        pairs = zip(self.positions, other.positions, strict=True)
        return self.flowing == other.flowing and all(float(np.abs(a - b).max()) <= within for a, b in pairs)


def _pose(bake: Bake, sample: int) -> _Pose:
    flowing = tuple(flow is not None and flow.shown_at(sample) for flow in bake.flows)
    return _Pose([cache.sample(sample) for cache in bake.every], flowing)


def _still_distance(folder: SceneFolder, caches: Sequence[Pc2Reader], options: RenderOptions) -> float:
    """World metres that nothing can move by and be seen to: ``STILL_PX`` at the nearest vertex of the rest pose."""
    camera = folder.scene.camera
    depth = min(float(camera.project(cache.sample(0))[:, 2].min()) for cache in caches)
    return max(depth, 0.0) / (max(camera.fx, camera.fy) * options.scale) * STILL_PX


def _scene_hash(folder: SceneFolder, options: RenderOptions, blender: str) -> str:
    """Everything but motion; what only moves things (material, velocity, effects, gravity) does not count."""
    scene = folder.scene
    settings = to_json(options)
    del settings["threads"]
    files = [scene.photo, scene.background, scene.light.environment]
    objects = []
    for item in scene.objects:
        files += [item.mesh, item.mask, item.shadow]
        objects.append([item.name, to_json(item.world_from_mesh), item.size_m])
    content = {
        "revision": [RENDER_REVISION, VERSION, blender],
        "camera": to_json(scene.camera),
        "ground": [scene.ground.point, scene.ground.normal],
        "light": to_json(scene.light),
        "objects": objects,
        "files": [[name, _file_hash(folder, name)] for name in files if name is not None],
        "options": settings,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _file_hash(folder: SceneFolder, name: str) -> str:
    path: Path = folder.file(name)
    return file_hash(path)


def _hash(base: str, pose: _Pose) -> str:
    digest = hashlib.sha256(f"{base} {pose.flowing}".encode())
    for sample in pose.positions:
        digest.update(np.ascontiguousarray(sample, dtype="<f4").tobytes())
    return digest.hexdigest()
