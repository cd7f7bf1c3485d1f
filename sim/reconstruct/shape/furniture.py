# SPDX-License-Identifier: MIT
"""Chairs, tables and shelves: what stands on straight thin legs, as upright and level boards cut by the outline.

A leg is a straight run of the outline that ends on the ground, thin against the whole. The feet give the piece's
direction and depth: legs whose feet lie farther back stand farther back. What lies above the front legs is a folded
sheet, as the camera sees it from the front: an apron above the front legs, a level seat or table top back to the hind
legs, and an upright back over them. Each of these is a board: a slab of the world times a region of the photo, so that
holes stay holes and the outline is kept exactly. Hind legs that the front ones hide are added behind them. A frame with
holes and without such legs, a shelf, becomes one deep lattice.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.ground_camera import ground_depth, on_ground
from .boards import Board, GroundAxes, level_slab
from .inflate import Crop, is_box
from .legs import Leg, find_legs, outline_size

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

THIN = 0.075
"""Largest width of a leg over the outline's longer side."""
LONG = 3.0
"""Least length of a leg over its width."""
TALL = 0.2
"""Least height of legs over that of the piece; a shelf's feet are shorter."""
NUB = 0.012
"""Width of what is noise of the mask, over the outline's longer side."""
LEAST_LEGS = 3
"""Legs that make furniture of an unknown thing."""
USUAL_DEPTH = 0.8
"""Depth over width of a piece whose hind legs are not visible."""
FRAME_DEPTH = 0.35
"""Depth of a shelf over the smaller one of width and height."""
FRAME_HOLES = (2, 0.02)
"""Number of holes that make a frame, and the least share of its bounding box of each."""
FRAME_RODS = 0.2
"""Largest width of a frame's widest rod over the outline's longer side."""
LOW_BACK = 0.25
"""Least height of a back over that of the seat."""


def furniture_legs(crop: Crop) -> list[Leg]:
    """Return the straight thin legs in ``crop``, from left to right."""
    size = outline_size(crop.mask)
    # Nubs along a mask's edge are no feet, and end no leg.
    nub = 2 * round(NUB * size / 2.0) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (nub, nub))
    closed = cv2.morphologyEx(crop.mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    legs = find_legs(cv2.morphologyEx(closed, cv2.MORPH_OPEN, kernel) > 0, max(THIN * size, 3.0), LONG)
    return [leg for leg in legs if leg.straight]


def _photo(crop: Crop, leg: Leg) -> Points:
    """The foot of ``leg`` (2,) in photo pixels."""
    return leg.foot + np.array([crop.left, crop.top], dtype=np.float64)


def is_frame(crop: Crop) -> bool:
    """Return whether ``crop`` is an upright frame: thin rods around two or more holes, in a rectangular outline."""
    filled = ndimage.binary_fill_holes(crop.mask)
    size = float(max(np.ptp(np.flatnonzero(filled.any(axis=1))), np.ptp(np.flatnonzero(filled.any(axis=0)))) + 1)
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    window = filled[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    # Below its lowest board a shelf is open.
    open_below = ~crop.mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    labels, count = ndimage.label(open_below)
    areas = ndimage.sum_labels(open_below, labels, np.arange(1, count + 1)) / window.size if count else np.zeros(0)
    hull = cv2.convexHull(cv2.findNonZero(filled.astype(np.uint8)))
    solid = np.zeros_like(filled, dtype=np.uint8)
    cv2.fillConvexPoly(solid, hull, 1)
    large = int((np.asarray(areas) > FRAME_HOLES[1]).sum())
    return large >= FRAME_HOLES[0] and 2.0 * float(crop.distance.max()) < FRAME_RODS * size and is_box(solid > 0)


MAX_YAW = np.radians(50.0)


def _axes(feet: Points) -> GroundAxes:
    """Axes of the piece from its ``feet`` (n, 3) on the ground: along the longest front side of their hull."""
    best = (0.0, 0.0)
    front = float(feet[:, 1].min())
    for i in range(len(feet)):
        for j in range(len(feet)):
            side = feet[j, :2] - feet[i, :2]
            length = float(np.linalg.norm(side))
            if side[0] <= 0 or length < 1e-9:
                continue
            yaw = float(np.arctan2(side[1], side[0]))
            away = np.array([-np.sin(yaw), np.cos(yaw)])
            ahead = (feet[:, :2] - feet[i, :2]) @ away
            if abs(yaw) <= MAX_YAW and ahead.min() > -0.12 * length and min(feet[i, 1], feet[j, 1]) < front + length:
                score = length * float(np.cos(yaw))
                if score > best[0]:
                    best = (score, yaw)
    yaw = best[1]
    return GroundAxes(np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)]))


def furniture_boards(camera: Camera, crop: Crop, *, asked: bool = False) -> list[Board] | None:
    """Return the boards of a chair, table or shelf with the outline of ``crop``; None for anything else.

    asked: the object's kind says that it is furniture; then two legs are enough.
    """
    legs = [leg for leg in furniture_legs(crop) if np.isfinite(on_ground(camera, _photo(crop, leg))).all()]
    rows = np.flatnonzero(crop.mask.any(axis=1))
    tall = [leg for leg in legs if len(leg.rows) > TALL * len(rows)]
    if tall:
        # What ends high up in the photo hangs there.
        depths = [float(on_ground(camera, _photo(crop, leg))[1]) for leg in tall]
        span = len(np.flatnonzero(crop.mask.any(axis=0))) * min(depths) / camera.fx
        legs = [leg for leg in legs if float(on_ground(camera, _photo(crop, leg))[1]) < max(depths) + span]
    if len(tall) >= 2 and sum(1 + leg.beside for leg in legs) >= (2 if asked else LEAST_LEGS):
        return _standing(camera, crop, legs)
    return _lattice(camera, crop) if is_frame(crop) else None


def _lattice(camera: Camera, crop: Crop) -> list[Board] | None:
    rows = np.flatnonzero(crop.mask.any(axis=1))
    columns = np.flatnonzero(crop.mask.any(axis=0))
    lowest = np.array([crop.left + (columns[0] + columns[-1] + 1) / 2.0, crop.top + rows[-1] + 1.0])
    touch = on_ground(camera, lowest)
    if not np.isfinite(touch).all():
        return None
    legs = find_legs(crop.mask, THIN * outline_size(crop.mask), 1.0)
    feet = np.array([on_ground(camera, _photo(crop, leg)) for leg in legs]) if len(legs) >= 2 else touch[None]
    feet = feet[np.isfinite(feet).all(axis=1)]
    axes = _axes(feet) if len(feet) >= 2 else GroundAxes(np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    unit = float(ground_depth(camera, camera.rays(lowest))) / camera.fx
    depth = FRAME_DEPTH * min(len(columns), len(rows)) * unit
    front = float(axes.v(touch))
    return _framed(camera, crop, axes, front, front + depth, unit, legs)


def _framed(
    camera: Camera, crop: Crop, axes: GroundAxes, front: float, back: float, unit: float, legs: list[Leg]
) -> list[Board]:
    """Level boards between deep uprights. The camera sees the boards' upper sides, which tell how deep they are."""
    mask = crop.mask
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    upright = np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _line(1, len(rows) // 5)) > 0)
    bars = np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _line(len(columns) // 2, 1)) > 0)
    # Between the boards the uprights' inner sides are seen as well.
    widths = [leg.width for leg in legs] or [
        run for row in np.flatnonzero(~bars.any(axis=1)) for run in _runs(mask[row])
    ]
    thick = (float(np.median(widths)) if widths else 2.0 * float(crop.distance.max())) * unit
    rays = camera.rays(crop.pixels())
    z_front = axes.heights_on(camera, rays, front).reshape(mask.shape)
    labels, count = ndimage.label(bars)
    levels, depths = [], []
    for index in range(1, count + 1):
        part = labels == index
        lowest = float(
            np.median([z_front[np.flatnonzero(part[:, c])[-1], c] for c in np.flatnonzero(part.any(axis=0))])
        )
        reach = axes.reach_on(camera, rays, lowest + thick).reshape(mask.shape)[part]
        seen = reach[np.isfinite(reach)]
        if len(seen):
            depths.append(float(np.quantile(seen, 0.98)) - front)
        levels.append((part, max(lowest, 0.0)))
    seen_depth = [depth for depth in depths if depth > 2.0 * thick]
    if seen_depth:
        back = front + float(np.median(seen_depth))
    boards = []
    for part, lowest in levels:
        # A pixel lower, or the region's lower edge would not be reached.
        boards.append(Board(part, (level_slab(lowest - unit, lowest + thick), axes.slab(front, back))))
        face = part & (z_front <= lowest + thick)
        behind = part & (axes.reach_on(camera, rays, lowest + thick).reshape(mask.shape) > back)
        boards.append(Board(face, (axes.slab(front, front + thick), level_slab(-np.inf, lowest + thick))))
        boards.append(Board(behind, (axes.slab(back - thick, back),)))
    boards.append(Board(upright | (mask & ~bars), (axes.slab(front, back),)))
    return [board for board in boards if board.region.any()]


def _line(width: int, height: int) -> NDArray[np.uint8]:
    return np.ones(
        (max(3, height), max(3, width)) if min(width, height) > 1 else (max(1, height), max(1, width)), np.uint8
    )


def _runs(line: NDArray[np.bool_]) -> list[int]:
    """Lengths of the runs of ones in ``line``."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    return [int(n) for n in ends[1::2] - ends[::2]]


@dataclass(frozen=True)
class _Stance:
    """How a piece stands on its legs.

    depths: (n,) of the middles of its legs along ``axes.away``, m; is_front: (n,) which of them stand in front, whose
    mean depth is ``front``. width: of a leg, m. span: of the feet along the front, m.
    """

    axes: GroundAxes
    depths: Points
    is_front: Mask
    front: float
    width: float
    span: float


def _stance(camera: Camera, crop: Crop, legs: list[Leg]) -> _Stance:
    feet = np.array([on_ground(camera, _photo(crop, leg)) for leg in legs])
    axes = _axes(feet)
    v, u = axes.v(feet), axes.u(feet)
    unit = float(ground_depth(camera, camera.rays(_photo(crop, legs[int(np.argmin(v))])))) / camera.fx
    width = float(np.median([leg.width for leg in legs])) * unit
    span = max(float(np.ptp(u)), 4.0 * width)
    is_front = v < v.min() + 0.3 * span
    if is_front.sum() < 2:
        is_front = v <= np.sort(v)[1]
    # What touches the ground visibly is the front edge of a foot.
    v = v + 0.5 * width
    return _Stance(axes, v, is_front, float(np.mean(v[is_front])), width, span)


def _standing(camera: Camera, crop: Crop, legs: list[Leg]) -> list[Board] | None:
    """The boards of a piece with a seat or table top on ``legs``; None if those end just above the ground."""
    stance = _stance(camera, crop, legs)
    axes, front, width, span = stance.axes, stance.front, stance.width, stance.span
    shape = crop.mask.shape
    rays = camera.rays(crop.pixels())
    z_front = axes.heights_on(camera, rays, front).reshape(shape)
    tops = [
        float(z_front[leg.rows[-1], (leg.left[-1] + leg.right[-1]) // 2])
        for leg, first in zip(legs, stance.is_front, strict=True)
        if first
    ]
    under = float(np.median(tops))
    if under < 2.0 * width:
        return None
    uprights = [(leg.region(shape) & crop.mask, float(depth)) for leg, depth in zip(legs, stance.depths, strict=True)]
    leg_pixels = np.any([region for region, _ in uprights], axis=0)
    # What else is seen below the seat: hind legs beside the front ones, and rungs.
    below = crop.mask & ~leg_pixels & (z_front < under - 0.25 * width)
    further = [
        (part, depth + 0.5 * width)
        for part, depth in _below(camera, crop, axes, below, legs, front - 0.5 * width, span)
    ]
    hind = [float(depth) for depth, first in zip(stance.depths, stance.is_front, strict=True) if not first]
    hind += [depth for _, depth in further if depth > front + 0.25 * span]
    top = under + width
    sheet = _sheet(camera, rays, crop.mask & ~leg_pixels & ~below, z_front, stance, hind, top)
    boards = _upright_boards(camera, crop, rays, stance, [*uprights, *further], top)
    boards += sheet.boards(stance, top)
    if len(hind) < 2:
        # Hind legs are hidden behind the outer front legs.
        z_back = axes.heights_on(camera, rays, sheet.back).reshape(shape)
        outer = [leg for leg, first in zip(legs, stance.is_front, strict=True) if first]
        for leg in {id(item): item for item in (outer[0], outer[-1])}.values():
            region = _raised(leg.region(shape), z_back <= top) & crop.mask
            boards.append(Board(region, (axes.around(sheet.back, width), level_slab(-np.inf, top))))
    return [board for board in boards if board.region.any()]


@dataclass(frozen=True)
class _Sheet:
    """What lies above the front legs: an apron over them, a seat or table top to the depth ``edge``, m, and beyond it
    an upright back. back: depth of that, or of the hind legs."""

    apron: Mask
    seat: Mask
    beyond: Mask
    back: float
    edge: float

    def boards(self, stance: _Stance, top: float) -> list[Board]:
        """Return the boards of the three; top: height of the seat, m."""
        axes, front, width, half = stance.axes, stance.front, stance.width, stance.width / 2.0
        return [
            Board(self.apron, (axes.around(front, width), level_slab(-np.inf, top))),
            Board(self.seat, (level_slab(top - width, top), axes.slab(front - half, self.edge + half))),
            Board(self.beyond, (axes.around(self.back, width), level_slab(top - width, np.inf))),
        ]


def _sheet(
    camera: Camera, rays: Points, sheet: Mask, z_front: Points, stance: _Stance, hind: list[float], top: float
) -> _Sheet:
    """The ``sheet`` above the legs in its parts. z_front: heights (h, w) on the plane of the front legs, m; hind:
    depths of the hind legs that are seen; top: height of the seat."""
    axes, front, span, half = stance.axes, stance.front, stance.span, stance.width / 2.0
    apron = sheet & (z_front <= top)
    on_top = axes.reach_on(camera, rays, top).reshape(sheet.shape)
    back = float(np.median(hind)) if hind else front + USUAL_DEPTH * span
    beyond = sheet & ~apron & (on_top > back + half)
    rise = float(axes.heights_on(camera, rays, back).reshape(sheet.shape)[beyond].max()) - top if beyond.any() else 0.0
    edge = back
    if (sheet & ~apron).any() and rise < LOW_BACK * top:
        # No back: the far edge of a table top, which overhangs its legs.
        edge = float(np.quantile(on_top[sheet & ~apron], 0.995))
        beyond = np.zeros_like(beyond)
    if not hind:
        back = min(back, edge - half)
    back = max(back, front + 3.0 * half)
    return _Sheet(apron, (sheet & ~beyond) | apron, beyond, back, max(edge, back))


def _upright_boards(
    camera: Camera, crop: Crop, rays: Points, stance: _Stance, parts: list[tuple[Mask, float]], top: float
) -> list[Board]:
    """The boards of legs and rungs ``parts``, each a region and its depth, up to the height ``top``."""
    boards = []
    for part, depth in parts:
        if not part.any():
            continue
        # The seat's front edge hides the upper ends of the legs behind it.
        z = stance.axes.heights_on(camera, rays, depth).reshape(part.shape)
        region = part if depth < stance.front + stance.width / 2.0 else _raised(part, z <= top) & crop.mask
        boards.append(Board(region, (stance.axes.around(depth, stance.width), level_slab(-np.inf, top))))
    return boards


def _raised(part: Mask, below: Mask) -> Mask:
    """``part`` continued upwards in the columns of its upper end, as long as ``below``."""
    rows = np.flatnonzero(part.any(axis=1))
    end = part[rows[0] : rows[0] + max(2, len(rows) // 4)].sum(axis=0)
    columns = end > 0.5 * end.max()
    result = part.copy()
    upper = int(rows[0]) + 2
    result[:upper, columns] |= below[:upper, columns]
    return result


def _below(
    camera: Camera,
    crop: Crop,
    axes: GroundAxes,
    below: Mask,
    legs: list[Leg],
    front: float,
    span: float,
) -> list[tuple[Mask, float]]:
    """Regions below the seat that are no legs, with the distance of each."""
    labels, _ = ndimage.label(below)
    found = []
    for index, window in enumerate(ndimage.find_objects(labels), start=1):
        part = labels == index
        rows = np.arange(window[0].start, window[0].stop)
        wide = window[1].stop - window[1].start
        lowest = np.array([crop.left + float(np.flatnonzero(part[rows[-1]]).mean()) + 0.5, crop.top + rows[-1] + 1.0])
        depth = float(axes.v(on_ground(camera, lowest)))
        rung = wide > 2.0 * len(rows)
        if not np.isfinite(depth) or rung or depth > front + 2.0 * span or part.sum() < 12:
            nearest = min(legs, key=lambda leg: abs(float(_photo(crop, leg)[0]) - lowest[0]))
            depth = float(axes.v(on_ground(camera, _photo(crop, nearest))))
            depth = front if depth < front + 0.3 * span or rung else depth
        found.append((part, max(depth, front)))
    return found
