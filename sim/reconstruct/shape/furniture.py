# SPDX-License-Identifier: MIT
"""Chairs, tables and shelves: what stands on straight thin legs, as upright and level boards cut by the outline.

A leg is a straight run of the outline that ends on the ground, thin against the whole. The feet give the piece's
direction and depth: legs whose feet lie farther back stand farther back. What lies above the front legs is a folded
sheet, as the camera sees it from the front: an apron above the front legs, a level seat or table top back to the hind
legs, and an upright back over them. Each of these is a board: a slab of the world times a region of the photo, so that
holes stay holes and the outline is kept exactly. Hind legs that the front ones hide are added behind them. A frame with
holes and without such legs, a shelf, becomes one deep lattice. The mesh is the union of the boards, by marching cubes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from ..camera.ground_camera import ground_depth, on_ground
from .inflate import Crop, is_box, signed_distance
from .inflated_mesh import BodyMesh, standing_mesh
from .legs import Leg, find_legs, outline_size
from .surface_mesh import RayField, relax, surface_of_size

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
OVERLAP_PX = 3.0
"""Pixels by which neighbouring regions overlap, so that their boards are joined."""


@dataclass(frozen=True)
class Slab:
    """All points of the world whose position · normal lies between ``low`` and ``high``. normal: (3,) unit."""

    normal: Points
    low: float
    high: float


@dataclass(frozen=True)
class Board:
    """Material inside all ``slabs`` where the photo shows ``region`` (h, w), bool on the crop."""

    region: Mask
    slabs: tuple[Slab, ...]


def _level(low: float, high: float) -> Slab:
    return Slab(np.array([0.0, 0.0, 1.0]), low, high)


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


@dataclass(frozen=True)
class _Frame:
    """Axes on the ground: across and away, (2,) unit; foot: (2,) a point of the front line."""

    across: Points
    away: Points

    def v(self, points: Points) -> Points:
        return np.asarray(points[..., :2] @ self.away)

    def u(self, points: Points) -> Points:
        return np.asarray(points[..., :2] @ self.across)

    def slab(self, low: float, high: float) -> Slab:
        return Slab(np.array([self.away[0], self.away[1], 0.0]), low, high)


MAX_YAW = np.radians(50.0)


def _axes(feet: Points) -> _Frame:
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
    return _Frame(np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)]))


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
    frame = _axes(feet) if len(feet) >= 2 else _Frame(np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    unit = float(ground_depth(camera, camera.rays(lowest))) / camera.fx
    depth = FRAME_DEPTH * min(len(columns), len(rows)) * unit
    front = float(frame.v(touch))
    return _framed(camera, crop, frame, front, front + depth, unit, legs)


def _framed(
    camera: Camera, crop: Crop, frame: _Frame, front: float, back: float, unit: float, legs: list[Leg]
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
    z_front = _height_on(camera, rays, frame, front).reshape(mask.shape)
    labels, count = ndimage.label(bars)
    levels, depths = [], []
    for index in range(1, count + 1):
        part = labels == index
        lowest = float(
            np.median([z_front[np.flatnonzero(part[:, c])[-1], c] for c in np.flatnonzero(part.any(axis=0))])
        )
        reach = _reach_on(camera, rays, frame, lowest + thick).reshape(mask.shape)[part]
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
        boards.append(Board(part, (_level(lowest - unit, lowest + thick), frame.slab(front, back))))
        face = part & (z_front <= lowest + thick)
        behind = part & (_reach_on(camera, rays, frame, lowest + thick).reshape(mask.shape) > back)
        boards.append(Board(face, (frame.slab(front, front + thick), _level(-np.inf, lowest + thick))))
        boards.append(Board(behind, (frame.slab(back - thick, back),)))
    boards.append(Board(upright | (mask & ~bars), (frame.slab(front, back),)))
    return [board for board in boards if board.region.any()]


def _line(width: int, height: int) -> NDArray[np.uint8]:
    return np.ones(
        (max(3, height), max(3, width)) if min(width, height) > 1 else (max(1, height), max(1, width)), np.uint8
    )


def _runs(line: NDArray[np.bool_]) -> list[int]:
    """Lengths of the runs of ones in ``line``."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    return [int(n) for n in ends[1::2] - ends[::2]]


def _standing(camera: Camera, crop: Crop, legs: list[Leg]) -> list[Board] | None:
    feet = np.array([on_ground(camera, _photo(crop, leg)) for leg in legs])
    frame = _axes(feet)
    v, u = frame.v(feet), frame.u(feet)
    unit = float(ground_depth(camera, camera.rays(_photo(crop, legs[int(np.argmin(v))])))) / camera.fx
    width = float(np.median([leg.width for leg in legs])) * unit
    span = max(float(np.ptp(u)), 4.0 * width)
    is_front = v < v.min() + 0.3 * span
    if is_front.sum() < 2:
        is_front = v <= np.sort(v)[1]
    # What touches the ground visibly is the front edge of a foot.
    v = v + 0.5 * width
    front = float(np.mean(v[is_front]))
    shape = crop.mask.shape
    pixels = crop.pixels()
    rays = camera.rays(pixels)
    z_front = _height_on(camera, rays, frame, front).reshape(shape)
    tops = []
    for leg, first in zip(legs, is_front, strict=True):
        if first:
            tops.append(float(z_front[leg.rows[-1], (leg.left[-1] + leg.right[-1]) // 2]))
    under = float(np.median(tops))
    if under < 2.0 * width:
        return None
    leg_pixels = np.zeros(shape, dtype=bool)
    parts: list[tuple[Mask, float]] = []
    for leg, depth in zip(legs, v, strict=True):
        own = leg.region(shape) & crop.mask
        leg_pixels |= own
        parts.append((own, float(depth)))
    # What else is seen below the seat: hind legs beside the front ones, and rungs.
    below = crop.mask & ~leg_pixels & (z_front < under - 0.25 * width)
    hind = [float(depth) for depth, first in zip(v, is_front, strict=True) if not first]
    for part, depth in _below(camera, crop, frame, below, legs, front - 0.5 * width, span):
        depth += 0.5 * width
        parts.append((part, depth))
        if depth > front + 0.25 * span:
            hind.append(depth)
    top, half = under + width, width / 2.0
    sheet = crop.mask & ~leg_pixels & ~below
    apron = sheet & (z_front <= top)
    on_top = _reach_on(camera, rays, frame, top).reshape(shape)
    back = float(np.median(hind)) if hind else front + USUAL_DEPTH * span
    beyond = sheet & ~apron & (on_top > back + half)
    rise = float(_height_on(camera, rays, frame, back).reshape(shape)[beyond].max()) - top if beyond.any() else 0.0
    edge = back
    if (sheet & ~apron).any() and rise < LOW_BACK * top:
        # No back: the far edge of a table top, which overhangs its legs.
        edge = float(np.quantile(on_top[sheet & ~apron], 0.995))
        beyond = np.zeros_like(beyond)
    if not hind:
        back = min(back, edge - half)
    back = max(back, front + 3.0 * half)
    edge = max(edge, back)
    upright = [(part, depth) for part, depth in parts if part.any()]
    z_of = {depth: _height_on(camera, rays, frame, depth).reshape(shape) for _, depth in upright}
    boards = []
    for part, depth in upright:
        # The seat's front edge hides the upper ends of the legs behind it.
        region = part if depth < front + half else _raised(part, z_of[depth] <= top) & crop.mask
        boards.append(Board(region, (frame.slab(depth - half, depth + half), _level(-np.inf, top))))
    boards.append(Board(apron, (frame.slab(front - half, front + half), _level(-np.inf, top))))
    seat = (sheet & ~beyond) | apron
    boards.append(Board(seat, (_level(top - width, top), frame.slab(front - half, edge + half))))
    boards.append(Board(beyond, (frame.slab(back - half, back + half), _level(top - width, np.inf))))
    if len(hind) < 2:
        # Hind legs are hidden behind the outer front legs.
        z_back = _height_on(camera, rays, frame, back).reshape(shape)
        outer = [leg for leg, first in zip(legs, is_front, strict=True) if first]
        for leg in {id(item): item for item in (outer[0], outer[-1])}.values():
            region = _raised(leg.region(shape), z_back <= top) & crop.mask
            boards.append(Board(region, (frame.slab(back - half, back + half), _level(-np.inf, top))))
    return [board for board in boards if board.region.any()]


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
    frame: _Frame,
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
        depth = float(frame.v(on_ground(camera, lowest)))
        rung = wide > 2.0 * len(rows)
        if not np.isfinite(depth) or rung or depth > front + 2.0 * span or part.sum() < 12:
            nearest = min(legs, key=lambda leg: abs(float(_photo(crop, leg)[0]) - lowest[0]))
            depth = float(frame.v(on_ground(camera, _photo(crop, nearest))))
            depth = front if depth < front + 0.3 * span or rung else depth
        found.append((part, max(depth, front)))
    return found


def _height_on(camera: Camera, rays: Points, frame: _Frame, v: float) -> Points:
    """Heights (n) at which ``rays`` (n, 3) meet the upright plane at ``v``."""
    facing = np.maximum(rays[:, :2] @ frame.away, 1e-3)
    depth = (v - float(frame.v(camera.position))) / facing
    return np.asarray(camera.position[2] + depth * rays[:, 2])


def _reach_on(camera: Camera, rays: Points, frame: _Frame, height: float) -> Points:
    """Distances ``v`` (n) at which ``rays`` (n, 3) meet the level plane at ``height``; inf if they do not."""
    down = -rays[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(down > 1e-9, (camera.position[2] - height) / np.maximum(down, 1e-12), np.inf)
        found = float(frame.v(camera.position)) + depth * (rays[:, :2] @ frame.away)
    return np.asarray(np.where(np.isfinite(depth), found, np.inf))


Faces = NDArray[np.int64]
MARGIN_PX = 6.0
"""Depth of the grid before and behind the boards."""
FOOT_PX = 2.0
"""Height over the ground in pixels of what stands on it: outlines of feet are no better known."""
FINEST_SHARE = 0.25
"""Smallest step in depth over the step in the photo's plane."""


class BoardField(RayField):
    """φ of the union of boards, in pixels. t: pixels behind the depth of their middle."""

    def __init__(self, camera: Camera, crop: Crop, boards: Sequence[Board]) -> None:
        self._camera, self._crop, self._boards = camera, crop, boards
        self._regions = [np.minimum(crop.distance, signed_distance(board.region) + OVERLAP_PX) for board in boards]
        low, high = np.inf, -np.inf
        rays = camera.rays(crop.pixels())
        ground = ground_depth(camera, rays)
        for board in boards:
            inside = board.region.ravel()
            slab = board.slabs[0]
            facing = rays[inside] @ slab.normal
            facing = np.where(np.abs(facing) < 1e-3, np.copysign(1e-3, facing), facing)
            ends = np.stack([(side - camera.position @ slab.normal) / facing for side in (slab.low, slab.high)])
            ends = np.minimum(ends, ground[inside])
            ends = ends[:, np.isfinite(ends).all(axis=0) & (ends > 0).all(axis=0)]
            if ends.size:
                low, high = min(low, float(ends.min())), max(high, float(np.quantile(ends.max(axis=0), 0.999)))
        self._middle = (low + high) / 2.0
        self.unit = self._middle / camera.fx
        self._range = ((low - self._middle) / self.unit - MARGIN_PX, (high - self._middle) / self.unit + MARGIN_PX)
        self.thinnest = min((slab.high - slab.low) / self.unit for board in boards for slab in board.slabs)

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Return boards and ground (n), (n) at ``points`` (n, 3), in pixels."""
        at, world = points[:, 1::-1].T, self.world(points[:, :2], points[:, 2])
        best = np.full(len(points), -np.inf)
        for board, region in zip(self._boards, self._regions, strict=True):
            inside = np.full(len(points), np.inf)
            for slab in board.slabs:
                along = world @ slab.normal
                inside = np.minimum(inside, np.minimum(along - slab.low, slab.high - along) / self.unit)
            near = inside > best
            if near.any():
                cut = ndimage.map_coordinates(region, at[:, near], order=1, mode="nearest")
                best[near] = np.maximum(best[near], np.minimum(inside[near], cut))
        return best, world[:, 2] / self.unit

    def value(self, points: Points) -> Points:
        """Return φ (n,) at ``points`` (n, 3)."""
        body, ground = self.sample(points)
        return np.minimum(body, ground)

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """Return φ on a grid (x, y, t), its first corner (3,) and its steps (3,)."""
        height, width = self._crop.mask.shape
        steps = np.array([spacing, spacing, max(min(spacing, self.thinnest / 3.0), FINEST_SHARE * spacing)])
        low, high = self._range
        first = np.array([0.25, 0.25, low])
        counts = (int((width - 1) // spacing) + 1, int((height - 1) // spacing) + 1, int((high - low) // steps[2]) + 2)
        return self.sampled(first, steps, counts), first, steps


def furniture_mesh(camera: Camera, crop: Crop, boards: Sequence[Board], target: int) -> tuple[BodyMesh, float]:
    """Return the closed surface of ``boards`` with the outline of ``crop``, about ``target`` vertices, on the ground.

    Also the share of it that was disconnected and removed. Raises InputError when the outline is too thin for a closed
    surface.
    """
    field = BoardField(camera, crop, boards)
    points, faces, lost = surface_of_size(field, float(crop.mask.sum()), target)
    points = relax(field, points, faces)
    pixels, depth, ground = field.depths(points)
    # Feet that end within a pixel or two of the ground stand on it.
    height = camera.position[2] + depth * camera.rays(pixels)[:, 2]
    depth = np.where(height < FOOT_PX * field.unit, ground, np.minimum(depth, ground))
    return standing_mesh(camera, pixels, depth, faces), lost
