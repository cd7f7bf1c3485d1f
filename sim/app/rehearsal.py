# SPDX-License-Identifier: MIT
"""What a coarse bake tells of a motion before the real one: when it is over, what leaves the picture, what falls over.

A ballistic estimate knows a motion up to the first contact. The engine knows the rest, and a coarse run costs seconds.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from ..cache.bake_folder import Bake
from ..cache.pc2 import Pc2Reader
from ..rigid_alignment import nearest_rotation
from ..scene.bake_quality import COARSEST
from ..scene.folder import Scene
from ..scene.scene_object import SceneObject
from .bake_options import BakeOptions
from .clip_check import STEP_PX, Clip, leaving, seen_tracks
from .default_motion import LONGEST_S, SLOW, DefaultMotion, fitted
from .free_space import thing_at_rest

RATE = 60.0
"""Samples a second of the scene."""

LONGER, AT_LEAST_S, AT_MOST_S = 2.0, 0.6, LONGEST_S / 2.0
"""Length of a rehearsal over the estimated action, and its bounds in seconds of the scene."""

TAMED = 0.75
"""Share of the speed that is left to a motion of which something leaves the picture: little over half as far."""

TOPPLED = math.radians(40.0)
"""Turn from rest at which a thing that does not roll counts as fallen over: it shows sides that the photo does not."""

MOST_REHEARSALS = 4


@dataclass(frozen=True, kw_only=True)
class Rehearsed:
    """motion: with the clip that ends when nothing is seen to move any more. leaving: the warning about each object
    that leaves the picture within that clip. toppled: names of the objects that fall over in it.
    """

    motion: DefaultMotion
    leaving: tuple[str, ...]
    toppled: tuple[str, ...] = ()

    def tamed(self, scene: Scene) -> DefaultMotion:
        """Return the motion with less speed, of which a rehearsal is to be made again."""
        motion = self.motion
        moves = tuple(move.slower(TAMED) for move in motion.moves)
        # Those after the first begin when the one before has come down.
        moves = tuple(dataclasses.replace(move, start_s=round(TAMED * move.start_s, 4)) for move in moves)
        ends = dict.fromkeys(SLOW, TAMED * motion.action_s)
        return fitted(scene, moves, ends, fps=motion.fps, frames=motion.frames, slow=motion.slow)


def rehearsal_options(motion: DefaultMotion, options: BakeOptions) -> BakeOptions:
    """Return the options of a coarse bake of ``motion`` in place of a bake with ``options``."""
    seconds = min(max(LONGER * motion.action_s, AT_LEAST_S), AT_MOST_S)
    frames = math.ceil(seconds * RATE) + 1
    return BakeOptions(frames=frames, fps=RATE, quality=COARSEST, arch=options.arch, seed=options.seed, points=False)


def rehearsed(
    scene: Scene, bake: Bake, motion: DefaultMotion, *, frames: int | None = None, slow: float | None = None
) -> Rehearsed:
    """Return what the coarse ``bake`` of ``scene`` tells about ``motion``.

    frames, slow: of the clip, None where they are to be chosen. Raises InputError for a cache that cannot be read.
    """
    camera = scene.model.camera
    caches = [Pc2Reader(bake.root / item.file) for item in bake.manifest.objects]
    count = min(cache.sample_count for cache in caches)
    rate = bake.manifest.rate
    poses = ([cache.sample(number) for cache in caches] for number in range(count))
    tracks = seen_tracks(len(caches), poses, [camera] * count)
    with np.errstate(invalid="ignore"):
        steps = [np.linalg.norm(np.diff(track[..., :2], axis=0), axis=-1).max(axis=1) for track in tracks]
    speed = np.nan_to_num(np.maximum.reduce(steps)) * rate
    ends = {}
    for each in SLOW:
        moving = np.flatnonzero(speed > STEP_PX * motion.fps * each)
        ends[each] = (int(moving[-1]) + 1) / rate if len(moving) else 0.0
    clip = fitted(scene, motion.moves, ends, fps=motion.fps, frames=frames, slow=slow)
    shown = min(count, math.ceil(clip.frames / clip.fps / clip.slow * rate) + 1)
    names = [item.name for item in bake.manifest.objects]
    seen = Clip(first=1, fps=rate)
    gone = [leaving(name, track[:shown], camera, seen) for name, track in zip(names, tracks, strict=True)]
    lying = [
        item.name
        for item, cache in zip(scene.model.objects, caches, strict=True)
        if not _rolls(scene, item) and _turn(cache, shown) > TOPPLED
    ]
    return Rehearsed(motion=clip, leaving=tuple(text for text in gone if text), toppled=tuple(lying))


def _rolls(scene: Scene, item: SceneObject) -> bool:
    """Whether turning is its way of moving, or it has no shape to turn."""
    return item.material.law in ("sand", "snow", "fluid") or thing_at_rest(scene, item, scene.model.ground_plane).round


def _turn(cache: Pc2Reader, count: int) -> float:
    """Largest angle in radians, among the first ``count`` samples of ``cache``, of the rotation that fits best from the
    first one."""
    rest = cache.sample(0).astype(np.float64)
    rest -= rest.mean(axis=0)
    most = 0.0
    for number in range(1, count):
        now = cache.sample(number).astype(np.float64)
        turn = nearest_rotation((now - now.mean(axis=0)).T @ rest)
        most = max(most, math.acos(float(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))))
    return most
