# SPDX-License-Identifier: MIT
"""Warnings about a clip before it is rendered: objects leave the picture, or nothing moves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..scene.model import Camera
from .default_motion import SLOW

Array = NDArray[np.floating]

STILL_PX = 1.0
"""Way in pixels of the photo below which a thing is taken to stand still over the whole clip."""

STEP_PX = 0.25
"""Way from frame to frame below which the action is over."""

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


def leaving(name: str, track: NDArray[np.float64], camera: Camera, clip: Clip) -> str | None:
    """Return the warning about an object whose points (F, N, 3) are projected; None without one."""
    x, y, depth = np.moveaxis(track, -1, 0)
    beyond = np.stack([-x, x - camera.width, -y, y - camera.height])
    inside = np.mean((beyond.max(axis=0) <= 0) & (depth > 0), axis=1)
    most, count = float(inside.max()), len(inside)
    if most == 0.0:
        return f"{name} is never in the picture; place it, or aim its velocity, so that the camera sees it"
    # What is thrown into the picture begins outside.
    begin = int(np.argmax(inside >= CUT * most))
    poor = np.nonzero(inside[begin:] < CUT * most)[0]
    if len(poor) == 0 or (at := begin + int(poor[0])) >= END * count:
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
    moving = np.nonzero(np.maximum.reduce(steps) > STEP_PX)[0]
    if len(moving) == 0:
        return []
    action, whole = (int(moving[-1]) + 1) / clip.fps, count / clip.fps
    fitting = [slow for slow in SLOW if slow / clip.slow * action <= whole]
    if action > SHORT_S or action > SHORT_SHARE * whole or not fitting or fitting[-1] <= clip.slow:
        return []
    return [
        f"all motion is over after {action:.2g} s of {whole:.2g} s; slow motion shows it longer: --slow {fitting[-1]:g}"
    ]


def _flat(tracks: Sequence[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return the pixels alone (F, N, 2)."""
    return [track[..., :2] for track in tracks]
