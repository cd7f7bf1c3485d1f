# SPDX-License-Identifier: MIT
"""The path of a body in a picture, cut into pieces between impacts, each with one acceleration; its noise."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .pose_estimation import Array

LEAST_PIECE = 6
"""Frames of the shortest piece between two impacts."""
JUMP_SHARE, PUSH_SHARE, JUMP_SIGMAS = 0.3, 0.6, 7.0
"""Change of velocity that is an impact: as a share of the largest speed, on a surface (where an outline that turns
wobbles), and in standard deviations."""
GAP = 3.5
"""Time between two samples over the usual one from which the body was out of sight between them."""
STILL = 0.05
"""Share of the greatest speed below which a body lies still before or after its motion."""
LET_GO = 5.0
"""Distance from the later motion, in its own scatter, up to which a body counts as let go."""
REST_SHARE = 0.12
"""Time at rest after a stop that is kept, as a share of the motion."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Piece:
    """Samples ``first`` to ``last`` of a path with one acceleration.

    stops: the sample after which it lies still; ``last`` if it does not. acceleration: (2,) px/s². begin, end:
    velocities (2,) px/s. miss: RMS residual of a coordinate, px.
    """

    first: int
    last: int
    stops: int
    acceleration: Array
    begin: Array
    end: Array
    miss: float


def piece_of(times: Array, places: Array, first: int, last: int) -> Piece:
    """Return the piece; its acceleration is that of its motion, less the rest before and after."""
    begins, ends = _moving_part(times[first : last + 1], places[first : last + 1])
    part = slice(first + begins, first + ends + 1)
    t = times[part]
    fit, miss = _parabola(t, places[part])
    middle = t.mean()

    def speed(at: float) -> Array:
        return np.asarray(2 * fit[0] * (at - middle) + fit[1])

    return Piece(
        first=first, last=last, stops=first + ends, acceleration=2 * fit[0],
        begin=speed(t[0]), end=speed(t[-1]), miss=miss,
    )  # fmt: skip


def pieces_between(times: Array, places: Array, impacts: list[int]) -> list[Piece]:
    """Return the pieces of the path ``places`` (N, 2) px at ``times`` (N,) s between the samples ``impacts``."""
    edges = [0, *impacts, len(times) - 1]
    return [
        piece_of(times, places, a + (a > 0), b - (b < len(times) - 1))
        for a, b in pairwise(edges)
        if b - a >= LEAST_PIECE
    ]


def longest(pieces: list[Piece], places: Array) -> Piece:
    """Return the piece whose ends are farthest apart."""
    return max(pieces, key=lambda p: float(np.linalg.norm(places[p.last] - places[p.first])))


def most_curved(times: Array, pieces: list[Piece]) -> Piece:
    """Return the piece that shows most of what slows or speeds it up: the way that its acceleration takes it."""
    return max(
        pieces,
        key=lambda p: float(np.linalg.norm(p.acceleration)) * float(times[p.stops] - times[p.first]) ** 2,
    )


def _moving_part(times: Array, places: Array) -> tuple[int, int]:
    """Return the first and last sample of the motion, where a body lies still before or afterwards."""
    width = max(2, len(times) // 40)
    speed = np.linalg.norm(places[width:] - places[:-width], axis=1) / (times[width:] - times[:-width])
    moves = np.flatnonzero(speed > STILL * float(np.percentile(speed, 97))) if len(speed) else np.array([], np.int64)
    if len(moves) < LEAST_PIECE:
        return 0, len(times) - 1
    return int(moves[0]), int(moves[-1]) + width


def moving_from(times: Array, places: Array, piece: Piece) -> int:
    """Return the sample from which the body of ``piece`` is left alone: after the last push, at its greatest
    acceleration along the way; on a slope, after it has begun to move."""
    part: NDArray[np.int64] = np.arange(piece.first, piece.stops + 1)
    width = max(3, len(part) // 16)
    if len(part) < 3 * width:
        return piece.first
    speed = np.linalg.norm(places[part[width:]] - places[part[:-width]], axis=1) / (
        times[part[width:]] - times[part[:-width]]
    )
    top = float(np.percentile(speed, 97))
    wide = max(width, len(part) // 8)
    if speed[-1] <= 0.8 * top and wide > width:
        # It slows down: the outline of a body that turns wobbles, and a mean over a longer time tells its speed.
        width = wide
        speed = np.linalg.norm(places[part[width:]] - places[part[:-width]], axis=1) / (
            times[part[width:]] - times[part[:-width]]
        )
        top = float(np.percentile(speed, 97))
    if speed[-1] > 0.8 * top:  # it gains speed: from where a tenth of it is reached
        first = int(np.argmax(speed > 0.1 * top))
    else:
        first = min(int(np.argmax(speed > 0.93 * top)) + width // 2, len(part) - LEAST_PIECE)
    # A hand lets go gradually: what the motion of the later three quarters does not go back to is left out.
    kept = part[first:]
    later = kept[len(kept) // 4 :]
    if len(later) >= 2 * LEAST_PIECE and speed[-1] > 0.8 * top:
        fit, miss = _parabola(times[later], places[later])
        off = np.linalg.norm(places[kept] - np.vander(times[kept] - times[later].mean(), 3) @ fit, axis=1)
        wrong = np.flatnonzero(off[: len(kept) // 2] > LET_GO * max(miss, noise_px(places[later])))
        first += int(wrong[-1]) + 1 if len(wrong) else 0
    return int(part[min(first, len(part) - LEAST_PIECE)])


def stopped_at(times: Array, points: Array) -> int:
    """Return the last sample worth keeping: shortly after the body has come to rest."""
    left = np.linalg.norm(points - points[-1], axis=1)
    moving = np.flatnonzero(left > 0.01 * max(float(left.max()), 1e-9))
    if len(moving) == 0:
        return len(points) - 1
    end = times[moving[-1]] + REST_SHARE * (times[moving[-1]] - times[0])
    return int(np.searchsorted(times, end, side="right")) - 1


def jumps(times: Array, places: Array, share: float = JUMP_SHARE) -> list[int]:
    """Return the samples of impacts: where the straight lines before and after disagree in velocity."""
    count = len(times)
    width = int(np.clip(count // 24, 4, 9))
    steps = np.zeros((count, 2))
    sigma = noise_px(places)
    for k in range(width, count - width):
        before, after = slice(k - width, k + 1), slice(k, k + width + 1)
        a = np.polyfit(times[before] - times[k], places[before], 2 if width > 5 else 1)
        b = np.polyfit(times[after] - times[k], places[after], 2 if width > 5 else 1)
        steps[k] = b[-2] - a[-2]
    if width <= 5 and count > 2 * width:
        # Straight lines through a curved path disagree by its steady acceleration everywhere.
        steps[width : count - width] -= np.median(steps[width : count - width], axis=0)
    for k in _gaps(times):
        # Fits across frames in which it was not seen, as where another body touched it, would smooth an impact away.
        steps[max(0, k - width + 1) : k + width + 1] = 0.0
        sides = slice(max(0, k - width), k + 1), slice(k + 1, k + 2 + width)
        if all(len(times[side]) >= LEAST_PIECE for side in sides):
            a, b = (np.polyfit(times[side] - times[k], places[side], 1)[0] for side in sides)
            steps[k] = b - a
    change = np.linalg.norm(steps, axis=1)
    paces = np.linalg.norm(places[width:] - places[:-width], axis=1) / np.maximum(times[width:] - times[:-width], 1e-9)
    usual = float(np.percentile(paces, 97)) if len(paces) else 0.0
    span = float(np.median(np.diff(times))) * width
    blur = (4.0 if width > 5 else 1.8) * sigma / max(span, 1e-9) / np.sqrt(width)
    limit = max(share * usual, JUMP_SIGMAS * blur)
    found: list[int] = []
    for k in (int(v) for v in np.argsort(-change)):
        if change[k] < limit:
            break
        if all(abs(int(k) - f) > width for f in found):
            found.append(int(k))
    return sorted(found)


def _gaps(times: Array) -> NDArray[np.int64]:
    """Return the samples after which frames are missing."""
    steps = np.diff(times)
    return np.flatnonzero(steps > GAP * float(np.median(steps))) if len(steps) else np.zeros(0, np.int64)


def _parabola(times: Array, places: Array) -> tuple[Array, float]:
    """Return coefficients (3, 2), highest power first, and the residual of a coordinate; robust to few outliers."""
    t = times - times.mean()
    weights = np.ones(len(t))
    fit = np.zeros((3, 2))
    off = np.zeros(len(t))
    for _ in range(3):
        fit = np.polyfit(t, places, 2, w=weights)
        off = np.linalg.norm(places - (np.vander(t, 3) @ fit), axis=1)
        usual = max(float(np.median(off)), 1e-6)
        weights = 1.0 / np.maximum(1.0, off / (2.5 * usual))
    return fit, float(np.sqrt(np.mean(np.minimum(off, 4 * np.median(off) + 1e-9) ** 2) / 2))


def wobble_px(times: Array, places: Array) -> float:
    """Return the residual of a coordinate about a smooth path: the outline of a body that turns swings about its
    centre, which third differences do not see."""
    begins, ends = _moving_part(times, places)
    part = slice(begins, ends + 1)
    if ends - begins < 3 * LEAST_PIECE:
        return 0.0
    t = (times[part] - times[part].mean()) / max(float(np.ptp(times[part])), 1e-9)
    left = places[part] - np.vander(t, 4) @ np.polyfit(t, places[part], 3)
    return float(np.sqrt(np.mean(left**2) * len(left) / (len(left) - 4)))


def noise_px(places: Array) -> float:
    """Return the noise of a coordinate from third differences, which smooth motion hardly has."""
    third = np.abs(np.diff(places, 3, axis=0)).ravel()
    return max(float(np.median(third)) / 0.6745 / np.sqrt(20), 0.02) if len(third) else 0.1
