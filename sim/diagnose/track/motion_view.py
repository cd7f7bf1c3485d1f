# SPDX-License-Identifier: MIT
"""The path of a body in a picture → what kind of motion it is, which way gravity points, and where the ground is.

Three settings cover what one still camera shows of a free body: a flight with bounces (gravity in the picture), a slope
seen from the side, and motion on a level surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...errors import InputError
from .box_pose import GroundCamera
from .path_pieces import (
    LEAST_PIECE,
    PUSH_SHARE,
    REST_SHARE,
    Piece,
    jumps,
    longest,
    most_curved,
    moving_from,
    noise_px,
    pieces_between,
)
from .pose_estimation import Array

GRAVITY = 9.81
CRUDE = 7.0
"""Residual of a piece over that of its parts from which it hides a push."""
DOWN_COSINE = 0.8
"""Cosine to the picture's downward axis of an acceleration that may be gravity: phones are held upright."""
FLIGHT_SHARE = (0.55, 1.7)
"""Acceleration over g of a flight, with an inexact size and drag."""
ALONG_COSINE = 0.94
"""Cosine between acceleration and velocity of motion along a line."""
SIZE_PX = 0.5
"""Standard deviation of a diameter in px; a fiftieth of the diameter comes on top."""
FLIGHT_SPREAD = 0.03
"""Relative standard deviation of the scale that a flight gives: drag and a tilted picture plane."""
BESIDE_SHARE, BESIDE_FRAMES = 0.5, 16
"""Rest before and after a motion that is looked at, as a share of it and at least, in frames: in a long video the
widths over which velocities are taken would else outgrow a short motion."""
ROUND_TURN, ROUND_MISS = np.radians(240), 0.06
"""Angle around one point, and scatter of the distance from it over the distance, from which a body is held there."""
STEEPEST = 60.0
"""Degrees of the steepest slope: what goes down more steeply falls."""
MOST_BRAKING = 2.0
"""Deceleration over g on a level surface beyond any friction."""
ACROSS_SHARE = 0.5
"""Share of an acceleration across the motion that no friction has."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionView:
    """Where the motion lies in the picture. Pixels are the video's.

    kind: flight, slope or surface. first, last: samples of the path that are free motion. scale: px per m.
    origin: (2,) px. matrix: (2, 3) px per m, from world axes (z up). points: (N, 3) m, the centre at those samples.
    normal: (3,) of the ground, point: (3,) m on it. notes: what was decided, in words. camera: where it is known, with
    ``start``, (3,) m, the origin of ``points`` in the camera's world; ``origin`` and ``matrix`` are then those of a
    picture from straight above. on_rim: a disc that rolls down the slope.
    """

    kind: str
    first: int
    last: int
    scale: float
    origin: Array
    matrix: Array
    points: Array
    normal: Array
    point: Array
    notes: tuple[str, ...]
    camera: GroundCamera | None = None
    start: Array | None = None
    on_rim: bool = False

    def pixels(self, points: Array) -> Array:
        """Return px (..., 2) of world points (..., 3)."""
        if self.camera is not None and self.start is not None:
            return self.camera.pixels(points + self.start)
        return np.asarray(self.origin + points @ self.matrix.T)


def understand_motion(
    times: Array,
    places: Array,
    *,
    diameter_px: float,
    diameter: float,
    clearance: float,
    elevation: float,
    where: str,
    from_above: bool = False,
    rim: float | None = None,
) -> MotionView:
    """Return the view of the free motion in ``places`` (N, 2) px at ``times`` (N,) s.

    diameter_px, diameter: a length of the body in px and m. clearance: m, of its centre above what it stands on.
    elevation: rad, of the camera above a level surface; half a turn's quarter looks straight down. from_above: the
    body's outline shows its upper side, so that no slope is seen from its side, unless it rolls on its rim: radius, m.
    Raises InputError where nothing moves freely for long enough, and for what gains speed on a level surface.
    """
    scale = diameter_px / diameter
    begin, end = _active_part(places)
    times, places = times[begin : end + 1], places[begin : end + 1]
    if _goes_round(places):
        raise InputError(
            f"{where}: what moves goes around one point: a pivot, an axle or a string holds it, which is not "
            "simulated; film a body that is free"
        )
    view = _setting(times, places, scale, diameter_px, clearance, elevation, where, from_above, rim)
    return replace(view, first=view.first + begin, last=view.last + begin)


def _active_part(places: Array) -> tuple[int, int]:
    """Return the first and last sample to look at: the motion with a little of the rest before and after it."""
    count = len(places)
    least = 4 * noise_px(places)
    far = [np.linalg.norm(places - np.median(end, axis=0), axis=1) for end in (places[:5], places[-5:])]
    moved, left = (np.flatnonzero(f > max(0.01 * float(f.max()), least)) for f in far)
    if len(moved) == 0 or len(left) == 0 or left[-1] <= moved[0]:
        return 0, count - 1
    spare = max(BESIDE_FRAMES, round(BESIDE_SHARE * (left[-1] - moved[0])))
    return max(0, int(moved[0]) - spare), min(count - 1, int(left[-1]) + spare)


def _goes_round(places: Array) -> bool:
    """Return whether all of the path lies on one circle and goes around most of it (circle by Kåsa's method)."""
    middle = places.mean(axis=0)
    off = places - middle
    a = np.column_stack([2 * off, np.ones(len(off))])
    x, y, c = np.linalg.lstsq(a, (off**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(c + x * x + y * y, 0.0)))
    arms = off - (x, y)
    if radius <= 0 or np.std(np.linalg.norm(arms, axis=1)) > ROUND_MISS * radius:
        return False
    return float(np.ptp(np.unwrap(np.arctan2(arms[:, 1], arms[:, 0])))) > ROUND_TURN


def _setting(
    times: Array,
    places: Array,
    scale: float,
    diameter_px: float,
    clearance: float,
    elevation: float,
    where: str,
    from_above: bool,
    rim: float | None,
) -> MotionView:
    """Return the view as ``understand_motion`` does, of a path that is mostly motion. scale: px/m by the size."""
    impacts = jumps(times, places)
    pieces = pieces_between(times, places, impacts)
    flights = [p for p in pieces if _flies(p, scale)]
    if flights and longest(pieces, places) in flights:
        return _flight(times, places, pieces, flights, impacts, scale, diameter_px, clearance, where)
    pieces = pieces_between(times, places, jumps(times, places, PUSH_SHARE))
    finer = pieces_between(times, places, impacts)
    if not pieces:
        raise InputError(f"{where}: the body is followed for {len(times)} frames, too few between its impacts")
    best = most_curved(times, pieces)
    if finer and best.miss > CRUDE * max(most_curved(times, finer).miss, noise_px(places)):
        # A push that is weak beside the fastest motion is one all the same if nothing smooth fits across it.
        best = most_curved(times, finer)
    if _curves_down(best, times, places) and _flies(best, scale):
        # Impacts at a wall had cut the flight into pieces shorter than something else.
        known = pieces if any(p is best for p in pieces) else finer
        return _flight(times, places, known, [best], impacts, scale, diameter_px, clearance, where)
    if _runs_down(best, scale, places):
        if from_above and rim is None:
            raise InputError(
                f"{where}: the body gains speed, and its outline is one from above: film a slope from its side"
            )
        way = places[best.last] - places[best.first]
        if np.degrees(np.arctan2(way[1], abs(way[0]))) > STEEPEST:
            raise _strange_fall(best, times, scale, where)
        if from_above and rim is not None:
            rolls = _slope(times, places, best, scale, rim)
            return replace(rolls, on_rim=True, notes=(*rolls.notes, "a disc that rolls on its rim"))
        return _slope(times, places, best, scale, clearance)
    if _curves_down(best, times, places):
        raise _strange_fall(best, times, scale, where)
    braking = -float(best.acceleration @ best.begin) / max(float(np.linalg.norm(best.begin)), 1e-9) / scale
    if braking > MOST_BRAKING * GRAVITY:
        raise InputError(
            f"{where}: it slows down by {braking:.3g} m/s², more than friction can: check the body's size and "
            "--fps-override, or choose a part with --start-frame and --end-frame"
        )
    return _surface(times, places, best, scale, clearance, elevation)


def _curves_down(piece: Piece, times: Array, places: Array) -> bool:
    """Return whether the path bends downwards, all of it by one acceleration that friction cannot have."""
    size = float(np.linalg.norm(piece.acceleration))
    middle = 0.5 * (piece.begin + piece.end)
    if size <= 0 or piece.acceleration[1] / size < ALONG_COSINE:
        return False
    way = middle / max(float(np.linalg.norm(middle)), 1e-9)
    across = float(np.linalg.norm(piece.acceleration - (piece.acceleration @ way) * way))
    sag = across * float(times[piece.stops] - times[piece.first]) ** 2 / 8
    length = float(np.linalg.norm(places[piece.stops] - places[piece.first]))
    return across > ACROSS_SHARE * size and sag > max(10 * piece.miss, 0.04 * length)


def _strange_fall(piece: Piece, times: Array, scale: float, where: str) -> InputError:
    fall = float(np.linalg.norm(piece.acceleration)) / scale
    rate = 1.0 / float(np.median(np.diff(times)))
    return InputError(
        f"{where}: it falls with {fall:.3g} m/s² by the body's size and the frame rate: free fall would be a body "
        f"{GRAVITY / fall:.3g} times as large, or {rate * np.sqrt(GRAVITY / fall):.0f} frames per second in place of "
        f"{rate:.0f}; check --object and --fps-override"
    )


def _flies(piece: Piece, scale: float) -> bool:
    size = float(np.linalg.norm(piece.acceleration))
    if piece.last - piece.first < LEAST_PIECE or size <= 0 or piece.acceleration[1] / size < DOWN_COSINE:
        return False
    strength = size / scale / GRAVITY
    if not FLIGHT_SHARE[0] < strength < FLIGHT_SHARE[1]:
        return False
    middle = 0.5 * (piece.begin + piece.end)
    straight = abs(float(middle @ piece.acceleration)) / max(float(np.linalg.norm(middle)) * size, 1e-9)
    # Straight and not upright: a slope.
    return straight < ALONG_COSINE or piece.acceleration[1] / size > 0.985


def _runs_down(piece: Piece, scale: float, places: Array) -> bool:
    way = places[piece.last] - places[piece.first]
    way = way / max(float(np.linalg.norm(way)), 1e-9)
    along = float(piece.acceleration @ way) / scale / GRAVITY
    faster = float(piece.end @ way) > 1.3 * max(float(piece.begin @ way), 0.0)
    return faster and along > 0.03 and way[1] > 0.05


def _frame(down: Array) -> Array:
    """Return the matrix (2, 3) of a picture plane with gravity along ``down``, in px per px."""
    across = np.array([down[1], -down[0]])
    if across[0] < 0:
        across = -across
    return np.stack([across, np.zeros(2), -down], axis=1)


def _flight_scale(by_size: float, by_flight: float, diameter_px: float) -> tuple[float, str]:
    """The scale in px/m from the body's size and from gravity, both if they agree, and a note on it."""
    spread = float(np.hypot(0.02, SIZE_PX / diameter_px))
    if abs(np.log(by_flight / by_size)) < 2 * np.hypot(spread, FLIGHT_SPREAD):
        # Size and flight both measure the scale; apart from each other they speak of a wrong clock, which stays a gap.
        part = spread**2 / (spread**2 + FLIGHT_SPREAD**2)
        scale = float(np.exp((1 - part) * np.log(by_size) + part * np.log(by_flight)))
        return scale, f"scale {scale:.0f} px/m from the size and the flight"
    note = f"scale {by_size:.0f} px/m from the size; the flight would give {by_flight:.0f}: is the clock off?"
    return by_size, note


def _free_span(
    main: Piece, pieces: list[Piece], flights: list[Piece], impacts: list[int], down: Array, count: int
) -> tuple[int, int]:
    """The first and the last of ``count`` frames in which the body moves freely around its longest flight ``main``."""
    first, last = main.first, main.last
    ordered = sorted(pieces, key=lambda p: p.first)
    at = ordered.index(main)
    for piece in reversed(ordered[:at]):
        if piece not in flights or not _bounce(piece, ordered[ordered.index(piece) + 1], down):
            break
        first = piece.first
    speed = float(np.linalg.norm(main.end))
    previous = main
    for piece in ordered[at + 1 :]:
        settled = np.linalg.norm(piece.begin) < 0.25 * speed
        if not (_bounce(previous, piece, down) and (piece in flights or settled)):
            break
        last, previous = piece.last, piece
    tail = [k for k in impacts if k > last]
    if tail and last == previous.last and count - 1 - last < 3 * LEAST_PIECE:
        last = tail[0] - 1
    return first, last


def _flight(
    times: Array,
    places: Array,
    pieces: list[Piece],
    flights: list[Piece],
    impacts: list[int],
    scale: float,
    diameter_px: float,
    clearance: float,
    where: str,
) -> MotionView:
    main = max(flights, key=lambda p: p.last - p.first)
    total = np.sum([p.acceleration * (p.last - p.first) ** 2 for p in flights], axis=0)
    down = total / np.linalg.norm(total)
    strengths = np.array([float(p.acceleration @ down) for p in flights])
    # Drag grows with the square of the speed: long and slow flights tell gravity.
    speeds = np.array([float(np.mean([p.begin @ p.begin, p.end @ p.end])) for p in flights])
    weights = np.array([float(p.last - p.first) ** 2 for p in flights]) / np.maximum(speeds, 1e-9)
    pull = float(np.average(strengths, weights=weights))
    notes = [f"a flight: things fall with {pull / scale:.3g} m/s² by the body's size"]
    scale, note = _flight_scale(scale, pull / GRAVITY, diameter_px)
    notes.append(note)
    first, last = _free_span(main, pieces, flights, impacts, down, len(times))
    matrix = _frame(down) * scale
    origin = places[first]
    world = (places - origin) @ matrix / scale**2
    bounces = [k for k in impacts if first < k <= last]
    lowest = float(world[first : last + 1, 2].min())
    if bounces:
        touched = [float(world[max(k - 1, 0) : k + 2, 2].min()) for k in bounces]
        ground = float(np.min(touched)) - clearance
        notes.append(f"{len(bounces)} bounce{'s' if len(bounces) > 1 else ''}; the ground lies there")
    else:
        ground = lowest - clearance - 1.0
        notes.append("no bounce; the ground is put a metre below")
    if last - first < 2 * LEAST_PIECE - 4:
        raise InputError(f"{where}: only {last - first + 1} frames of free flight; film at a higher frame rate")
    return MotionView(
        kind="flight", first=first, last=last, scale=scale, origin=origin, matrix=matrix,
        points=world[first : last + 1], normal=np.array([0.0, 0.0, 1.0]), point=np.array([0.0, 0.0, ground]),
        notes=tuple(notes),
    )  # fmt: skip


def _bounce(before: Piece, after: Piece, down: Array) -> bool:
    """Return whether the velocity changes mostly upwards: a wall or a hand pushes sideways."""
    change = after.begin - before.end
    up = -float(change @ down)
    return up > 0.75 * float(np.linalg.norm(change))


def _slope(times: Array, places: Array, piece: Piece, scale: float, clearance: float) -> MotionView:
    first = moving_from(times, places, piece)
    part = places[first : piece.last + 1]
    way = np.linalg.svd(part - part.mean(axis=0), full_matrices=False)[2][0]
    way = way if way[1] > 0 else -way
    matrix = _frame(np.array([0.0, 1.0])) * scale
    origin = part.mean(axis=0)
    world = (part - origin) @ matrix / scale**2
    direction = np.array([way[0], 0.0, -way[1]])
    normal = np.array([way[1], 0.0, way[0]]) * (1 if way[0] > 0 else -1)
    angle = float(np.degrees(np.arctan2(way[1], abs(way[0]))))
    # Across the slope the body keeps its height: what is left there is noise of the picture.
    world = np.outer(world @ direction, direction)
    return MotionView(
        kind="slope", first=first, last=piece.last, scale=scale, origin=origin, matrix=matrix, points=world,
        normal=normal, point=-clearance * normal,
        notes=(f"a slope of {angle:.1f}° seen from the side, the picture's vertical taken as upright",
               f"scale {scale:.0f} px/m from the size"),
    )  # fmt: skip


def _surface(times: Array, places: Array, piece: Piece, scale: float, clearance: float, elevation: float) -> MotionView:
    first = moving_from(times, places, piece)
    last = min(piece.last, piece.stops + max(2, round(REST_SHARE * (piece.stops - first))))
    matrix = np.array([[1.0, 0.0, 0.0], [0.0, -np.sin(elevation), -np.cos(elevation)]]) * scale
    origin = places[first]
    off = (places[first : last + 1] - origin) / scale
    world = np.stack([off[:, 0], -off[:, 1] / np.sin(elevation), np.zeros(len(off))], axis=1)
    notes = [f"motion on a level surface, seen from {np.degrees(elevation):.0f}° above it"]
    notes.append(f"scale {scale:.0f} px/m from the size")
    return MotionView(
        kind="surface", first=first, last=last, scale=scale, origin=origin, matrix=matrix, points=world,
        normal=np.array([0.0, 0.0, 1.0]), point=np.array([0.0, 0.0, -clearance]), notes=tuple(notes),
    )  # fmt: skip
