# SPDX-License-Identifier: MIT
"""Align a user's mesh to the photo: rotation, position on the ground and size.

Rotations all around are tried coarsely, each moved to the outline's height and position; the best are refined by the
overlap of silhouettes (Nelder & Mead, 1965) and clicked points, and distinguished by the mesh's own colours.
Silhouettes are drawn by points sampled on the surface: a few milliseconds, whatever the mesh is like.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from ...mpm.geometry.triangles import SurfaceSamples, sample_surface
from ...scene.model import Camera
from ..camera.ground_camera import on_ground

Points = NDArray[np.float64]
Faces = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class SilhouetteWindow:
    """A part of the photo at a coarser scale. left, top: photo pixels of its corner; cell: photo pixels per pixel.

    target: (h, w) wanted silhouette; open: (h, w) unknown pixels.
    """

    left: float
    top: float
    cell: float
    target: Mask
    open: Mask

    @staticmethod
    def around(seen: Mask, unknown: Mask, side: int) -> SilhouetteWindow:
        """Return the window around ``seen`` (H, W) with half its size as a border, the object ``side`` pixels large in
        it."""
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        extent = max(len(range(rows[0], rows[-1] + 1)), len(range(columns[0], columns[-1] + 1)))
        cell, pad = extent / side, 0.5 * extent
        left, top = columns[0] - pad, rows[0] - pad
        size = (
            round((columns[-1] + 1 - columns[0] + 2 * pad) / cell),
            round((rows[-1] + 1 - rows[0] + 2 * pad) / cell),
        )
        matrix = np.array([[cell, 0, left + cell / 2 - 0.5], [0, cell, top + cell / 2 - 0.5]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP

        def shrunk(mask: Mask, beyond: float) -> Mask:
            smooth = cv2.blur(mask.astype(np.float32), (max(1, round(cell)),) * 2)
            return np.asarray(cv2.warpAffine(smooth, matrix, size, flags=flags, borderValue=beyond) > 0.5)

        # Beyond the photo's border everything is unknown.
        return SilhouetteWindow(float(left), float(top), float(cell), shrunk(seen, 0.0), shrunk(unknown, 1.0))

    def cells(self, pixels: Points) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask]:
        """Return rows and columns (n) of photo ``pixels`` (n, 2+), and which of them are inside."""
        columns = np.floor((pixels[:, 0] - self.left) / self.cell)
        rows = np.floor((pixels[:, 1] - self.top) / self.cell)
        height, width = self.target.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        return rows[inside].astype(np.int64), columns[inside].astype(np.int64), np.asarray(inside)

    def silhouette(self, camera: Camera, places: Points) -> Mask:
        """Return the silhouette (h, w) of ``places`` (n, 3), with small gaps between points closed."""
        seen = camera.project(places)
        rows, columns, _ = self.cells(np.where(seen[:, 2:] > 0, seen, np.inf))
        picture = np.zeros(self.target.shape, dtype=np.uint8)
        picture[rows, columns] = 1
        return np.asarray(cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0)

    def overlap(self, found: Mask) -> float:
        """Return the intersection over union of ``found`` (h, w) with the target, over known pixels."""
        known = ~self.open
        union = int(((found | self.target) & known).sum())
        return int((found & self.target & known).sum()) / max(1, union)


YAWS = 36
COARSE_SIDE, FINE_SIDE = 48, 110
COARSE_POINTS, FINE_POINTS = 12_000, 70_000
REFINED = 5
"""Number of rotations that are refined."""
LOOKED_AT = 8
"""Rotations about each axis that get a few steps before the best are selected."""
TILT_DEG = 12.0
"""Tilt of the mesh beyond which it is penalised: exported meshes stand nearly straight."""
POINT_WEIGHT = 4.0
COLOUR_WEIGHT = 0.25
UPS: dict[str, Points] = {
    "+y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "+z": np.eye(3),
    "-z": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
    "+x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}
"""Rotation that maps the axis to +Z."""


@dataclass(frozen=True)
class Pose:
    """up: axis of the file that points up. world = scale · rotation · mesh + shift, in the camera's unit.

    overlap: of silhouettes, 0 to 1; clear: margin over the best other rotation, in the same measure.
    """

    up: str
    rotation: Points
    scale: float
    shift: Points
    overlap: float
    clear: float

    def place(self, points: Points) -> Points:
        """Return ``points`` (n, 3) of the mesh in the world."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)


@dataclass(frozen=True)
class _Candidate:
    up: str
    numbers: Points
    """yaw, log scale, x, y, two tilts."""
    cost: float


def align(
    camera: Camera,
    seen: Mask,
    unknown: Mask,
    vertices: Points,
    faces: Faces,
    *,
    ups: Sequence[str],
    points: Sequence[tuple[tuple[float, float, float], tuple[float, float]]] = (),
    colours: NDArray[np.float64] | None = None,
    pixels: NDArray[np.uint8] | None = None,
) -> Pose:
    """Return the pose in which the mesh, standing on z = 0, has the silhouette ``seen`` (H, W).

    unknown: (H, W) occluded pixels. vertices (V, 3), faces (T, 3): in the file's own coordinates. ups: axes to try, the
    likeliest first. points: points on the mesh and their photo pixels. colours: (V, 3) 0 to 255 of the mesh, and
    pixels: (H, W, 3) the photo, which distinguish front from back.
    """
    fit = _Fit(camera, seen, unknown, vertices, faces, points)
    tried = [fit.coarse(up, yaw) for up in ups for yaw in np.arange(YAWS) * 2 * np.pi / YAWS]
    # Prefer the likelier axis slightly, so that a sphere stands as its file says.
    ranked = sorted(tried, key=lambda c: c.cost + 0.01 * ups.index(c.up))
    # A slightly wrong rotation can score worse than a very wrong one: refine all promising ones a few steps first.
    nearer = sorted((fit.refined(c, 30) for c in _apart(ranked, LOOKED_AT * len(ups))), key=lambda c: c.cost)
    best = [fit.refined(candidate, 110) for candidate in _apart(nearer, REFINED)]
    if colours is not None and pixels is not None:
        best = [_Candidate(c.up, c.numbers, c.cost - COLOUR_WEIGHT * fit.likeness(c, colours, pixels)) for c in best]
    best.sort(key=lambda c: c.cost)
    final = fit.finest(best[0])
    return fit.pose(final, best[1].cost - best[0].cost if len(best) > 1 else 1.0)


def _apart(ranked: Sequence[_Candidate], count: int) -> list[_Candidate]:
    """The best of ``ranked`` that are not neighbours of better ones."""
    chosen: list[_Candidate] = []
    for candidate in ranked:
        near = 2.5 * 2 * np.pi / YAWS
        if all(c.up != candidate.up or _turn(c.numbers[0], candidate.numbers[0]) > near for c in chosen):
            chosen.append(candidate)
        if len(chosen) == count:
            break
    return chosen


def _turn(first: float, second: float) -> float:
    return abs((first - second + np.pi) % (2 * np.pi) - np.pi)


class _Fit:
    def __init__(
        self,
        camera: Camera,
        seen: Mask,
        unknown: Mask,
        vertices: Points,
        faces: Faces,
        points: Sequence[tuple[tuple[float, float, float], tuple[float, float]]],
    ) -> None:
        self._camera = camera
        self._middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        self._size = float(np.ptp(vertices, axis=0).max())
        # The mesh about its centre, of size 1: all search parameters are then of order 1.
        own = (vertices - self._middle) / self._size
        self._vertices = own
        self._coarse, self._fine = (sample_surface(own, faces, n) for n in (COARSE_POINTS, FINE_POINTS))
        self._windows = {side: SilhouetteWindow.around(seen, unknown, side) for side in (COARSE_SIDE, FINE_SIDE)}
        self._places = np.array([(np.array(place) - self._middle) / self._size for place, _ in points]).reshape(-1, 3)
        self._pixels = np.array([pixel for _, pixel in points], dtype=np.float64).reshape(-1, 2)
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        self._box = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], dtype=np.float64)
        self._faces = faces

    def coarse(self, up: str, yaw: float) -> _Candidate:
        """Return the mesh with this rotation, moved to the mask's position and size."""
        x0, y0, x1, y1 = self._box
        foot = on_ground(self._camera, np.array([(x0 + x1) / 2, y1 - 0.08 * (y1 - y0)]))
        if not np.isfinite(foot).all():
            foot = on_ground(self._camera, np.array([(x0 + x1) / 2, y1]))
        distance = float(np.linalg.norm(foot - self._camera.position))
        numbers = np.array([yaw, np.log(max(x1 - x0, y1 - y0) / self._camera.fx * distance), foot[0], foot[1], 0, 0])
        for _ in range(6):
            seen = self._camera.project(self._placed(up, numbers, self._coarse.places))
            if not (seen[:, 2] > 1e-6).all():
                break
            low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
            ratio = np.sqrt((x1 - x0) * (y1 - y0) / max(float(np.prod(high - low)), 1e-9))
            numbers[1] += np.log(np.clip(ratio, 0.5, 2.0))
            there = np.array([(low[0] + high[0]) / 2, high[1]])
            wanted = np.array([(x0 + x1) / 2, y1])
            now, goal = on_ground(self._camera, there), on_ground(self._camera, wanted)
            if not (np.isfinite(now).all() and np.isfinite(goal).all()):
                break
            numbers[2:4] += (goal - now)[:2]
        return _Candidate(up, numbers, self._cost(up, numbers, COARSE_SIDE))

    def refined(self, candidate: _Candidate, rounds: int) -> _Candidate:
        """Return ``candidate`` refined in yaw, position and size for a coarse overlap, in ``rounds`` evaluations."""
        size = float(np.exp(candidate.numbers[1]))
        return self._searched(candidate, np.array([0.12, 0.06, 0.06 * size, 0.06 * size]), COARSE_SIDE, rounds)

    def finest(self, candidate: _Candidate) -> _Candidate:
        """Return ``candidate`` refined in all parameters, including tilts, for a fine overlap."""
        size = float(np.exp(candidate.numbers[1]))
        steps = np.array([0.06, 0.03, 0.03 * size, 0.03 * size, 0.02, 0.02])
        return self._searched(candidate, steps, FINE_SIDE, 160)

    def _searched(self, candidate: _Candidate, steps: Points, side: int, rounds: int) -> _Candidate:
        free = len(steps)

        def numbers(change: Points) -> Points:
            changed = candidate.numbers.copy()
            changed[:free] += change * steps
            return changed

        def cost(change: Points) -> float:
            return self._cost(candidate.up, numbers(change), side)

        simplex = np.vstack([np.zeros(free), np.eye(free)])
        options = {"initial_simplex": simplex, "maxfev": rounds, "xatol": 0.02, "fatol": 2e-4}
        found = minimize(cost, np.zeros(free), method="Nelder-Mead", options=options)
        return _Candidate(candidate.up, numbers(found.x), float(found.fun))

    def pose(self, candidate: _Candidate, clear: float) -> Pose:
        """Return ``candidate`` as a map from the file's own coordinates."""
        rotation, scale, shift = self._map(candidate.up, candidate.numbers)
        window = self._windows[FINE_SIDE]
        silhouette = window.silhouette(self._camera, scale * self._fine.places @ rotation.T + shift)
        return Pose(
            up=candidate.up,
            rotation=rotation,
            scale=scale / self._size,
            shift=shift - scale / self._size * rotation @ self._middle,
            overlap=window.overlap(silhouette),
            clear=clear,
        )

    def likeness(self, candidate: _Candidate, colours: NDArray[np.float64], pixels: NDArray[np.uint8]) -> float:
        """Return the correlation, -1 to 1, of the mesh's colours with the photo's where both are visible."""
        window, points = self._windows[COARSE_SIDE], self._fine
        seen = self._camera.project(self._placed(candidate.up, candidate.numbers, points.places))
        own = np.einsum("nc,nci->ni", points.weights, colours[self._faces[points.faces]])
        rows, columns, inside = window.cells(seen)
        order = np.argsort(-seen[inside, 2], kind="stable")
        picture = np.zeros((*window.target.shape, 3))
        drawn = np.zeros(window.target.shape, dtype=bool)
        picture[rows[order], columns[order]] = own[inside][order]
        drawn[rows[order], columns[order]] = True
        both = drawn & window.target & ~window.open
        if both.sum() < 50:
            return 0.0
        y, x = np.nonzero(both)
        at = (
            np.clip(window.top + (y + 0.5) * window.cell, 0, pixels.shape[0] - 1).astype(int),
            np.clip(window.left + (x + 0.5) * window.cell, 0, pixels.shape[1] - 1).astype(int),
        )
        smooth = cv2.blur(pixels, (max(1, round(window.cell)),) * 2)
        first, second = picture[both].astype(np.float64), smooth[at].astype(np.float64)
        first, second = first - first.mean(axis=0), second - second.mean(axis=0)
        norm = float(np.sqrt((first**2).sum() * (second**2).sum()))
        return float((first * second).sum()) / norm if norm > 1e-6 else 0.0

    def _map(self, up: str, numbers: Points) -> tuple[Points, float, Points]:
        yaw, log_scale, x, y, first, second = numbers
        turn = cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0]
        tilt = cv2.Rodrigues(np.array([first, second, 0.0]))[0]
        rotation = np.asarray(turn @ tilt @ UPS[up], dtype=np.float64)
        scale = float(np.exp(log_scale))
        lowest = float((self._vertices @ rotation[2]).min())
        return rotation, scale, np.array([x, y, -scale * lowest])

    def _placed(self, up: str, numbers: Points, places: Points) -> Points:
        rotation, scale, shift = self._map(up, numbers)
        return np.asarray(scale * places @ rotation.T + shift)

    def _cost(self, up: str, numbers: Points, side: int) -> float:
        window = self._windows[side]
        points: SurfaceSamples = self._coarse if side == COARSE_SIDE else self._fine
        found = window.silhouette(self._camera, self._placed(up, numbers, points.places))
        if not found.any():
            return 3.0
        known = ~window.open
        # Distance between the outlines where they do not overlap: a gradient where the overlap is flat.
        outside, missing = found & ~window.target & known, window.target & ~found & known
        away = 0.0
        if outside.any():
            away += float(cv2.distanceTransform((~window.target).astype(np.uint8), cv2.DIST_L2, 3)[outside].sum())
        if missing.any():
            away += float(cv2.distanceTransform((~found).astype(np.uint8), cv2.DIST_L2, 3)[missing].sum())
        cost = 1.0 - window.overlap(found) + away / (window.target.sum() * side)
        cost += float(((np.abs(numbers[4:]) / np.radians(TILT_DEG)) ** 4).sum()) * 0.01
        if len(self._places):
            seen = self._camera.project(self._placed(up, numbers, self._places))
            extent = max(self._box[2] - self._box[0], self._box[3] - self._box[1])
            apart = np.linalg.norm(seen[:, :2] - self._pixels, axis=1) / extent
            cost += POINT_WEIGHT * float(np.minimum(apart, 1.0).mean())
        return cost
