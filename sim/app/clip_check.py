# SPDX-License-Identifier: MIT
"""Checks of a clip before it is rendered: objects that leave the picture or never move, and when it is over.

A ballistic estimate knows a motion up to the first contact. The engine knows the rest, and a coarse bake costs seconds:
it tells what leaves the picture, what falls over, and when the action ends.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cache.bake_folder import Bake
from ..cache.pc2 import Pc2Reader
from ..rigid_alignment import nearest_rotation
from ..scene.bake_quality import COARSEST
from ..scene.folder import Scene
from ..scene.meshes import load_object_mesh
from ..scene.model import Camera
from ..scene.scene_object import SceneObject
from .bake_options import BakeOptions
from .default_motion import LONGEST_S, SLOW, DefaultMotion, fitted
from .free_space import Surface, thing_at_rest
from .moves import Move

Array = NDArray[np.floating]

STILL_PX = 1.0
"""Way in pixels of the photo below which a thing is taken to stand still over the whole clip."""

STEP = 4e-4
"""Way from frame to frame, over the picture's longer side, below which all is over: a quarter of a pixel in 640."""

GONE, CUT = 0.1, 0.7
"""Share of what is seen of a thing at most, below which it has left the picture, or is cut by its edge."""

END = 0.9
"""Share of the clip after which a thing may leave without a word."""

SHORT_S, SHORT_SHARE = 0.75, 0.45
"""An action that takes no longer, nor more of the clip, is over before it is understood."""

MOST_POINTS = 500
"""Points of each object that are looked at."""


@dataclass(frozen=True, kw_only=True)
class Clip:
    """Frames that are going to be rendered. first: number of the first one. fps: of the video. slow: how many times
    slower than real it is.
    """

    first: int
    fps: float
    slow: float = 1.0


def clip_notices(
    names: Sequence[str], poses: Iterable[Sequence[Array]], cameras: Iterable[Camera], clip: Clip
) -> list[str]:
    """Return a line for each thing that leaves the picture early, and one where nothing moves or all is over at once.

    names: of the objects. poses: for every frame, the vertices (V, 3) of each object in world metres. cameras: one for
    every frame.
    """
    lens = list(cameras)
    tracks = seen_tracks(len(names), poses, lens)
    if len(lens) < 2:
        return []
    texts = [text for name, track in zip(names, tracks, strict=True) if (text := leaving(name, track, lens[0], clip))]
    return [*texts, *_pace(tracks, lens, clip)]


def seen_tracks(count: int, poses: Iterable[Sequence[Array]], cameras: Iterable[Camera]) -> list[NDArray[np.float64]]:
    """Return for each of ``count`` objects the pixels and depth (F, N, 3) of some of its points in every frame.

    poses, cameras: as of ``clip_notices``.
    """
    seen: list[list[NDArray[np.float64]]] = [[] for _ in range(count)]
    for pose, camera in zip(poses, cameras, strict=False):
        for found, vertices in zip(seen, pose, strict=True):
            found.append(camera.project(vertices[:: max(1, math.ceil(len(vertices) / MOST_POINTS))]))
    return [np.array(found) for found in seen]


def leaving(name: str, track: NDArray[np.float64], camera: Camera, clip: Clip, *, end: float = END) -> str | None:
    """Return the warning about an object whose points (F, N, 3) are projected; None without one, or where it leaves
    after the share ``end`` of the clip.
    """
    x, y, depth = np.moveaxis(track, -1, 0)
    beyond = np.stack([-x, x - camera.width, -y, y - camera.height])
    inside = np.mean((beyond.max(axis=0) <= 0) & (depth > 0), axis=1)
    most, count = float(inside.max()), len(inside)
    if most == 0.0:
        return f"{name} is never in the picture; place it, or aim its velocity, so that the camera sees it"
    # What is thrown into the picture begins outside.
    begin = int(np.argmax(inside >= CUT * most))
    poor = np.nonzero(inside[begin:] < CUT * most)[0]
    if len(poor) == 0 or (at := begin + int(poor[0])) >= end * count:
        return None
    edges = ("left", "right", "upper", "lower")
    edge = edges[int(np.argmax(np.mean(beyond[:, at], axis=1)))]
    gone = inside[at:] < GONE * most
    lost = at + int(np.argmax(gone)) if gone.any() else None
    back = [n for n in range(at if lost is None else lost, count) if inside[n] >= CUT * most]
    when = f"frame {clip.first + at} of {clip.first + count - 1} ({at / clip.fps:.2g} s)"
    again = f"until frame {clip.first + back[0]}" if back else "to the end"
    if lost is None:
        return f"{name} is cut by the {edge} edge of the picture from {when} {again}; {_LOWER}"
    ends = "and is back at frame " + str(clip.first + back[0]) if back else "and does not come back"
    return f"{name} leaves the picture over its {edge} edge at {when} {ends}; {_LOWER}, or fewer frames (--frames)"


_LOWER = "give it a lower velocity (--velocity)"


def _pace(tracks: Sequence[NDArray[np.float64]], cameras: Sequence[Camera], clip: Clip) -> list[str]:
    """Return the warning about how long objects move; tracks: projected points (F, N, 3) of each object."""
    if any(a != b for a, b in itertools.pairwise(cameras)):
        # A moving camera shows something all the time, and pixels do not tell which of the two moved.
        return []
    with np.errstate(invalid="ignore"):
        ways = [np.nan_to_num(np.linalg.norm(track - track[:1], axis=-1).max(axis=1)) for track in _flat(tracks)]
        steps = [np.nan_to_num(np.linalg.norm(np.diff(track, axis=0), axis=-1).max(axis=1)) for track in _flat(tracks)]
    count = len(cameras)
    if max(float(way.max()) for way in ways) < STILL_PX:
        return [
            f"nothing moves in these {count} frames; give an object a velocity (--velocity right,away,up in m/s), or "
            "leave out --still"
        ]
    moving = np.nonzero(np.maximum.reduce(steps) > _least_step(cameras[0]))[0]
    if len(moving) == 0:
        return []
    action, whole = (int(moving[-1]) + 1) / clip.fps, count / clip.fps
    fitting = [slow for slow in SLOW if slow / clip.slow * action <= whole]
    if action > SHORT_S or action > SHORT_SHARE * whole or not fitting or fitting[-1] <= clip.slow:
        return []
    return [
        f"all motion is over after {action:.2g} s of {whole:.2g} s; slow motion shows it longer: --slow {fitting[-1]:g}"
    ]


def _least_step(camera: Camera) -> float:
    """Return the way in pixels from frame to frame below which nothing is seen to move."""
    return STEP * max(camera.width, camera.height)


def _flat(tracks: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return the pixels alone (F, N, 2)."""
    return [track[..., :2] for track in tracks]


RATE = 60.0
"""Samples a second of the scene."""

LONGER_S, AT_MOST_S = 0.5, LONGEST_S
"""Seconds in the scene by which a rehearsal is longer than the estimated action, and its greatest length."""

TAMED = 0.75
"""Share of the speed that is left to a motion of which something leaves the picture: little over half as far."""

TOPPLED = math.radians(40.0)
"""Turn from rest at which a thing that does not roll counts as fallen over: it shows sides that the photo does not."""

GUESSED = 0.15
"""Share of a thing's picture, of sides that the photo does not show, above which it has turned too far in a rehearsal.
"""

MOST_REHEARSALS = 4


@dataclass(frozen=True, kw_only=True)
class Rehearsed:
    """motion: with the clip that ends when nothing is seen to move any more. leaving: the warning about each object
    that leaves the picture within that clip, by its name. toppled: names of the objects that fall over in it; turned:
    of those that stay upright and yet show much of sides that the photo does not. good: for each of both how many of
    its moves had come to an end before that. frames, slow: as asked for, None where they are chosen.
    """

    motion: DefaultMotion
    leaving: Mapping[str, str]
    toppled: tuple[str, ...] = ()
    turned: tuple[str, ...] = ()
    good: Mapping[str, int] = dataclasses.field(default_factory=dict)
    frames: int | None = None
    slow: float | None = None

    def shortened(self, scene: Scene) -> DefaultMotion | None:
        """Return the motion less the moves in which things fall over or turn too far, where these had moved well
        before, and what these do later; None where none had."""
        motion = self.motion
        kept: list[Move] = []
        for move in motion.moves:
            good = self.good.get(move.name, 0)
            if good == 0 or sum(other.name == move.name for other in kept) < good:
                kept.append(move)
        if len(kept) == len(motion.moves):
            return None
        settles = dict.fromkeys(SLOW, kept[-1].settle_s)
        return fitted(scene, tuple(kept), settles, fps=motion.fps, frames=self.frames, slow=self.slow)

    def tamed(self, scene: Scene) -> DefaultMotion:
        """Return the motion with less speed, of which a rehearsal is to be made again."""
        motion = self.motion
        moves = tuple(move.slower(TAMED) for move in motion.moves)
        settles = dict.fromkeys(SLOW, TAMED * (motion.action_s - motion.moves[-1].landed_s))
        return fitted(scene, moves, settles, fps=motion.fps, frames=motion.frames, slow=motion.slow)


def rehearsal_options(motion: DefaultMotion, options: BakeOptions) -> BakeOptions:
    """Return the options of a coarse bake of ``motion`` in place of a bake with ``options``."""
    # How long something soft or round goes on is the least known.
    seconds = min(motion.action_s + 2.0 * motion.moves[-1].settle_s + LONGER_S, AT_MOST_S)
    frames = math.ceil(seconds * RATE) + 1
    return BakeOptions(
        frames=frames,
        fps=RATE,
        quality=COARSEST,
        arch=options.arch,
        seed=options.seed,
        points=False,
        implicit=options.implicit,
    )


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
    settles = {}
    for each in SLOW:
        moving = np.flatnonzero(speed > _least_step(camera) * motion.fps * each)
        end = (int(moving[-1]) + 1) / rate if len(moving) else 0.0
        settles[each] = max(0.0, end - motion.moves[-1].landed_s)
    clip = fitted(scene, motion.moves, settles, fps=motion.fps, frames=frames, slow=slow)
    # The clip may have its moves at other times.
    seconds = clip.frames / clip.fps / clip.slow - clip.moves[-1].start_s + motion.moves[-1].start_s
    shown = min(count, math.ceil(seconds * rate) + 1)
    names = [item.name for item in bake.manifest.objects]
    seen = Clip(first=1, fps=rate)
    gone = [leaving(name, track[:shown], camera, seen, end=1.0) for name, track in zip(names, tracks, strict=True)]
    lying: list[str] = []
    turned: list[str] = []
    good: dict[str, int] = {}
    for item, cache in zip(scene.model.objects, caches, strict=True):
        if _rolls(scene, item):
            continue
        lies, shows = _turns(cache, shown) > TOPPLED, _guessed(scene, item, cache, shown) > GUESSED
        if lies.any() or shows.any():
            (lying if lies.any() else turned).append(item.name)
            first = float(np.argmax(lies | shows)) / rate
            begun = sum(move.name == item.name and move.start_s < first for move in motion.moves)
            good[item.name] = max(0, begun - 1)
    return Rehearsed(
        motion=clip,
        leaving={name: text for name, text in zip(names, gone, strict=True) if text},
        toppled=tuple(lying),
        turned=tuple(turned),
        good=good,
        frames=frames,
        slow=slow,
    )


def _rolls(scene: Scene, item: SceneObject) -> bool:
    """Whether turning is its way of moving, or it has no shape to turn."""
    return item.material.law in ("sand", "snow", "fluid") or thing_at_rest(scene, item, scene.model.ground_plane).round


def _turns(cache: Pc2Reader, count: int) -> NDArray[np.float64]:
    """Angles in radians, of the first ``count`` samples of ``cache``, of the rotation that fits best from the first
    one."""
    rest = cache.sample(0).astype(np.float64)
    rest -= rest.mean(axis=0)
    angles = np.zeros(count)
    for number in range(1, count):
        now = cache.sample(number).astype(np.float64)
        turn = nearest_rotation((now - now.mean(axis=0)).T @ rest)
        angles[number] = math.acos(float(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
    return angles


def _guessed(scene: Scene, item: SceneObject, cache: Pc2Reader, count: int) -> NDArray[np.float64]:
    """Shares of the picture of ``item``, in the first ``count`` samples of ``cache``, that the photo does not show
    (``Surface.guessed``)."""
    faces = load_object_mesh(scene, item).faces
    surfaces = [Surface.of(cache.sample(number).astype(np.float64), faces) for number in range(count)]
    return np.array([surfaces[0].guessed(now, scene.model.camera.position) for now in surfaces])
