# SPDX-License-Identifier: GPL-3.0-or-later
"""Which frames are to be made, from which inputs, and which of them are equal."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...sim.app.bake_inputs import file_hash
from ...sim.scene.folder import SceneFolder
from ...sim.scene.json_fields import to_json
from ...sim.scene.model import Camera
from ...sim.version import VERSION
from . import stroke
from .caches import Bake
from .options import RenderOptions
from .shot import Shot
from .stroke import Pose

RENDER_REVISION = 3
"""Raised with every change of rendering that changes what a frame looks like."""


@dataclass(frozen=True)
class Frame:
    """Frame ``number`` shows ``sample`` of every cache; ``inputs`` is the hash of all that it depends on.

    Frames in which nothing moved share the sample of the first of them, and, where the camera did not either, the
    hash. A frame that shows motion
    since the sample before it depends on both, and is like no other. ``after`` and ``before`` are the samples of the
    next frame and the one before, where they count (for optical flow); else ``sample`` too. ``cameras`` are this
    frame's, the next one's and that of the one before, in pixels of the photo.
    """

    number: int
    sample: int
    inputs: str
    after: int
    before: int
    cameras: tuple[Camera, Camera, Camera]


def plan_frames(
    folder: SceneFolder,
    bake: Bake,
    numbers: Sequence[int],
    *,
    options: RenderOptions,
    shot: Shot,
    blender: str,
) -> list[Frame]:
    """Hash the inputs of the frames ``numbers`` (ascending); ``blender`` names the renderer and its version."""
    base = _scene_hash(folder, options, blender)
    flow, first_frame = options.frame_format.layered, bake.first_frame
    last = max(numbers) - first_frame + int(flow) if numbers else -1
    count = min(last, bake.last_frame - first_frame) + 1
    shown = _shown(folder, bake, count, base=base, options=options, shot=shot)
    frames = []
    for number in numbers:
        index = number - first_frame
        sample, inputs = shown[index]
        after = before = sample
        if flow:
            # Before the first frame and after the last nothing is known, so nothing moves.
            following, preceding = shown[min(index + 1, len(shown) - 1)], shown[max(index - 1, 0)]
            (after, next_inputs), (before, last_inputs) = following, preceding
            inputs = hashlib.sha256(f"{inputs} {next_inputs} {last_inputs}".encode()).hexdigest()
        cameras = tuple(shot.camera(i) for i in (index, min(index + 1, len(shown) - 1), max(index - 1, 0)))
        frames.append(Frame(number=number, sample=sample, inputs=inputs, after=after, before=before, cameras=cameras))
    return frames


def _shown(
    folder: SceneFolder, bake: Bake, count: int, *, base: str, options: RenderOptions, shot: Shot
) -> list[tuple[int, str]]:
    """For each of the first ``count`` samples the earlier one that looks the same, or itself, and the hash of that.

    The hash is that of what the sample's own camera sees of it.
    """
    before = key = rest = stroke.pose(bake, 0)
    key_index, key_hash, sharp = 0, _hash(base, rest), True
    rest_hash = key_hash
    still = stroke.still_distance(folder.scene.camera, rest, options.scale)
    shown = []
    for index in range(count):
        now = stroke.pose(bake, index)
        if options.motion_blur > 0 and not now.same(before, still):
            key, key_index, key_hash, sharp = now, index, _hash(base, before, now), False
        elif now.same(rest, still):
            key, key_index, key_hash, sharp = rest, 0, rest_hash, True
        elif not sharp or not now.same(key, still):
            key, key_index, key_hash, sharp = now, index, _hash(base, now), True
        before = now
        shown.append((key_index, _seen_hash(folder, key_hash, shot.inputs(index))))
    return shown


def _seen_hash(folder: SceneFolder, inputs: str, view: Any) -> str:
    """The hash ``inputs`` with that of the camera's ``view``; as it is for the photo's own camera, None."""
    if view is None:
        return inputs
    depth = folder.scene.depth
    content = [inputs, view, None if depth is None else _file_hash(folder, depth)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _scene_hash(folder: SceneFolder, options: RenderOptions, blender: str) -> str:
    """Everything but motion; what only moves things (material, velocity, effects, gravity) does not count."""
    scene, ground = folder.scene, folder.scene.ground
    settings = to_json(options)
    # Of the camera's path each frame's own hash holds what concerns it. What computes a picture does not change it, and
    # a run that falls back to the CPU must be able to go on.
    for name in ("threads", "device", "camera", "orbit", "rise", "dolly"):
        del settings[name]
    files = [scene.photo, scene.background, scene.light.environment]
    objects = []
    for item in scene.objects:
        files += [item.mesh, item.mask, item.shadow]
        objects.append([item.name, to_json(item.world_from_mesh), item.size_m])
    content = {
        "revision": [RENDER_REVISION, VERSION, blender],
        "camera": to_json(scene.camera),
        "ground": ground and [ground.point, ground.normal, ground.reflectivity, ground.reflection_roughness],
        "light": to_json(scene.light),
        "objects": objects,
        "files": [[name, _file_hash(folder, name)] for name in files if name is not None],
        "options": settings,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _file_hash(folder: SceneFolder, name: str) -> str:
    path: Path = folder.file(name)
    return file_hash(path)


def _hash(base: str, *poses: Pose) -> str:
    digest = hashlib.sha256(f"{base} {[pose.flowing for pose in poses]}".encode())
    for pose in poses:
        for sample in pose.every:
            digest.update(np.ascontiguousarray(sample, dtype="<f4").tobytes())
    return digest.hexdigest()
