# SPDX-License-Identifier: MIT
"""Ground whose pattern repeats in two directions, as tiles, checks and dots do: its lattice, and what it foretells.

In a top view the pattern's autocorrelation has a peak at every vector of the lattice (Liu, Collins & Tsin, "A
computational model for periodic pattern perception", PAMI 2004), as far away as the view's vanishing line is right. So
that is found with it: whatever else of the camera is wrong stretches the lattice, but does not bend it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize

from ...scene.model import Camera
from ..segmentation.mask_geometry import grown
from .surface_inpainting import light_field
from .top_view import lens_matrix

Mask = NDArray[np.bool_]
Picture = NDArray[np.float32]
Values = NDArray[np.float64]

PIXELS = 160_000
"""Largest size of the copy in which the lattice is looked for."""
VIEW = 160
"""Side of the top view in pixels, about."""
FARTHER = 2.2
"""Depth of the ground that is looked at over that of the hole's farthest."""
SLOW = 14.0
"""Blur over the view's longer side beyond which nothing is of the pattern."""
OVERLAP = 0.15
"""Least share of known pixels with a partner at a distance, for the correlation there to count."""
NEAREST = 6.0
"""Pixels of the view below which two places are the same mark."""
PITCHES, ROLLS = np.radians(np.arange(-20.0, 21.0, 4.0)), np.radians((-6.0, -3.0, 0.0, 3.0, 6.0))
"""Turns of the ground's normal that are tried, about the photo's horizontal and about the optical axis."""
MOST = 12
"""Multiples of a vector at which the correlation is looked at."""
REPEATS = 8
"""Places, twice along either vector among them, at which a lattice has to be repeated."""
LIKELY, CLEAR = 0.2, 0.5
"""Mean correlation at the lattice's vectors, less that half-way between them, from which turns are refined; and from
which it is one. Floors with a lattice had 0.64 to 0.96 in the pictures of the benchmark; marble, where few vectors fit
in, up to 0.67, boards and cloth 0.5."""
FORETOLD = 0.55
"""Share of the variance beside the hole that the lattice foretells, from which it is one: 0.6 to 0.98; marble 0.51."""
REACH, NEAR = 6, 3.0
"""Multiples of both vectors from which a hidden place is foretold; spread of their weights, in multiples."""
SHARPER = 3.0
"""Power of the depths' ratio by which places farther away count less."""
ENOUGH = 1e-3
"""Sum of weights below which nothing is foretold."""
FEWEST = 100
"""Places beyond an edge from which the pattern can be seen to go on there."""
JOINT, BRIGHTEST = 7, 0.98
"""Pixels of the copy up to which a dark line is a joint of tiles; share of the darkest that counts no more."""
BESIDE, SAMPLES = 0.06, 2_500
"""Reach beside the hole over the longer side, and number of places there, at which the lattice is judged."""
ROWS_AT_ONCE = 20_000
"""Places that are sampled at once: OpenCV's limit for one row is 32,767."""


@dataclass(frozen=True)
class Lattice:
    """A repeating pattern. photo_from_plane: (3, 3) homography; first, second: (2,) its vectors in the plane. share:
    of the variance beside the hole that it foretells, 0 to 1."""

    photo_from_plane: Values
    first: Values
    second: Values
    share: float = 0.0

    def scaled(self, across: float, down: float) -> Lattice:
        """Return the lattice on a copy of the photo that is ``across`` as wide and ``down`` as high."""
        return replace(self, photo_from_plane=np.diag([across, down, 1.0]) @ self.photo_from_plane)

    def moved(self, x: float, y: float) -> Lattice:
        """Return the lattice on a part of the photo whose upper left corner is at ``x``, ``y``."""
        return replace(
            self, photo_from_plane=np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, 1.0]]) @ self.photo_from_plane
        )

    def foretold(self, pattern: Picture, known: Mask, places: Values) -> tuple[Picture, NDArray[np.float32]]:
        """Return the mean (n, c) of ``pattern`` (h, w, c) where the lattice repeats ``places`` (n, 2; x, y in pixels)
        and it is ``known`` (h, w), nearest first, and the sum (n,) of weights, 0 where it is known nowhere."""
        parts = [
            self._foretold(pattern, known.astype(np.float32), places[start : start + ROWS_AT_ONCE])
            for start in range(0, len(places), ROWS_AT_ONCE)
        ]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def _foretold(
        self, pattern: Picture, known: NDArray[np.float32], places: Values
    ) -> tuple[Picture, NDArray[np.float32]]:
        plane, inverse_depth = _carried(np.linalg.inv(self.photo_from_plane), places)
        total = np.zeros((len(places), pattern.shape[2]), np.float32)
        weights = np.zeros(len(places), np.float32)
        for i, j in product(range(-REACH, REACH + 1), repeat=2):
            if i == 0 and j == 0:
                continue
            at, depth = _carried(self.photo_from_plane, plane + i * self.first + j * self.second)
            x, y = (
                np.clip(np.nan_to_num(at[:, k] - 0.5, nan=-9e3), -9e3, 9e3).astype(np.float32)[None] for k in (0, 1)
            )
            seen = cv2.remap(known, x, y, cv2.INTER_LINEAR, borderValue=0)[0] > 0.99
            weight = np.where(seen, np.exp(-0.5 * (i * i + j * j) / NEAR**2), 0.0)
            # Ground farther away is seen less sharply.
            weight *= np.clip(1.0 / np.maximum(np.abs(inverse_depth * depth), 1e-6), 0.0, 1.0) ** SHARPER
            weight = np.nan_to_num(weight).astype(np.float32)
            total += weight[:, None] * cv2.remap(pattern, x, y, cv2.INTER_LINEAR)[0].reshape(len(places), -1)
            weights += weight
        return np.asarray(total / np.maximum(weights, 1e-9)[:, None], dtype=np.float32), weights


class _Copy:
    """A copy of the photo in which a lattice is looked for, without its light: ``pattern`` (h, w, 3) where it is
    ``known`` (h, w), and the ``hole`` (h, w)."""

    def __init__(self, picture: Picture, target: Mask, closed: Mask, camera: Camera) -> None:
        height, width = target.shape
        scale = min(1.0, float(np.sqrt(PIXELS / target.size)))
        self.size = (max(8, round(width * scale)), max(8, round(height * scale)))
        self.across, self.down = self.size[0] / width, self.size[1] / height
        logs = np.asarray(cv2.resize(picture, self.size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        self.hole, barred = (
            cv2.resize(mask.astype(np.float32), self.size, interpolation=cv2.INTER_AREA) > 0.01
            for mask in (target, closed)
        )
        self.ground = _Ground(camera, self.across, self.down)
        self.region = self.ground.around(self.hole)
        self.known = ~grown(self.hole | barred, 2) & self.region
        slow, lack = light_field(logs, self.known, self.hole)
        self.pattern = np.where(self.known[..., None], logs - slow - lack, 0.0).astype(np.float32)

    def beside(self, among: Mask | None = None) -> NDArray[np.int64]:
        """Return at most ``SAMPLES`` known places (n, 2) beside the hole, ``among`` (H, W) those of the photo."""
        near = self.known & grown(self.hole, round(BESIDE * max(self.size)))
        if among is not None:
            near &= cv2.resize(among.astype(np.uint8), self.size, interpolation=cv2.INTER_NEAREST) > 0
        places = np.argwhere(near)[:, ::-1]
        return np.asarray(places[np.linspace(0, len(places) - 1, min(SAMPLES, len(places))).round().astype(int)])

    def within(self, among: Mask) -> NDArray[np.int64]:
        """Return the known places (n, 2) ``among`` (H, W) those of the photo."""
        small = cv2.resize(among.astype(np.uint8), self.size, interpolation=cv2.INTER_NEAREST) > 0
        return np.asarray(np.argwhere(self.known & small)[:, ::-1])

    def share(self, lattice: Lattice, places: NDArray[np.int64]) -> float:
        """Return the share of the variance at ``places`` (n, 2) that ``lattice``, of this copy, foretells: at most 1, 0
        where it foretells less than half of them."""
        if not len(places):
            return 0.0
        truth = self.pattern[places[:, 1], places[:, 0]]
        found, weights = lattice.foretold(self.pattern, self.known, places.astype(np.float64) + 0.5)
        told = weights > ENOUGH
        if told.sum() < max(1.0, 0.5 * len(places)):
            return 0.0
        spread = float(np.square(truth[told] - truth[told].mean(axis=0)).sum())
        return 1.0 - float(np.square(truth[told] - found[told]).sum()) / max(spread, 1e-12)


def find_lattice(picture: Picture, target: Mask, closed: Mask, camera: Camera) -> Lattice | None:
    """Return the lattice of the ground's pattern around ``target`` (H, W); None where it has none.

    picture: (H, W, 3) logarithms of light. closed: (H, W) other pixels that tell nothing: things, shadows, walls.
    camera: above the ground z = 0; only where its horizon is counts, and that is refined.
    """
    copy = _Copy(picture, target, closed, camera)
    found = _lattice_in(copy)
    return None if found is None else found.scaled(1.0 / copy.across, 1.0 / copy.down)


def _lattice_in(copy: _Copy) -> Lattice | None:
    """The lattice on ``copy``; None where it has none."""
    if copy.known.sum() < SAMPLES:
        return None
    places = np.asarray(np.argwhere(copy.region)[::37, ::-1] + 0.5, dtype=np.float64)
    light = np.asarray(copy.pattern.mean(axis=2), dtype=np.float32)
    found = _search(copy.ground, light, copy.known, places)
    if found is None:
        # Tiles may differ from each other more than from their joints.
        found = _search(copy.ground, *_joints(light, copy.known), places)
    if found is None:
        return None
    refined = _refined(found, copy)
    return refined if refined.share >= FORETOLD else None


def goes_on(
    lattice: Lattice, picture: Picture, target: Mask, closed: Mask, camera: Camera, beyond: Sequence[Mask]
) -> list[bool]:
    """Return of each part ``beyond`` (H, W) whether the pattern goes on in it beside ``target`` (H, W), so that it is
    the same surface. The others: as for ``find_lattice``."""
    if not beyond:
        return []
    copy = _Copy(picture, target, closed, camera)
    small, parts = lattice.scaled(copy.across, copy.down), [copy.beside(part) for part in beyond]
    return [len(places) >= FEWEST and copy.share(small, places) >= FORETOLD for places in parts]


def repeated(picture: Picture, target: Mask, closed: Mask, camera: Camera, things: Mask) -> Mask:
    """Return those of the connected ``things`` (H, W) that are marks of a pattern which repeats around ``target``.
    The others: as for ``find_lattice``."""
    result = np.zeros_like(things)
    copy = _Copy(picture, target, closed, camera)
    lattice = _lattice_in(copy)
    if lattice is None:
        return result
    count, labels = cv2.connectedComponents(things.astype(np.uint8), connectivity=8)
    for index in range(1, count):
        # With what is around it: by itself it may be of one colour.
        places = copy.within(grown(labels == index, max(2, round(0.005 * max(things.shape)))))
        if len(places) and copy.share(lattice, places) >= FORETOLD:
            result |= labels == index
    return result


def _joints(light: NDArray[np.float32], known: Mask) -> tuple[NDArray[np.float32], Mask]:
    """How much darker thin lines of ``light`` (h, w) are than what is beside them, and where that is ``known``."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (JOINT, JOINT))
    inner = cv2.erode(known.astype(np.uint8), kernel) > 0
    dark = cv2.morphologyEx(light, cv2.MORPH_CLOSE, kernel) - light
    most = float(np.quantile(dark[inner], BRIGHTEST)) if inner.any() else 0.0
    soft = cv2.GaussianBlur(np.minimum(dark, most), (0, 0), JOINT / 6.0)
    return np.asarray(soft, dtype=np.float32), np.asarray(inner)


@dataclass(frozen=True)
class _Turned:
    """Turns of the ground's normal in radians, the score there, and the lattice's vectors in the plane."""

    turns: Values
    score: float
    vectors: Values


class _Ground:
    """The plane of the ground below ``camera`` in a copy of the photo that is ``across`` as wide and ``down`` as high,
    in units of the camera's height above it."""

    def __init__(self, camera: Camera, across: float, down: float) -> None:
        rotation = np.asarray(camera.world_from_camera, dtype=np.float64)[:3, :3]
        self.normal = rotation.T @ np.array([0.0, 0.0, 1.0])
        self.lens = np.diag([across, down, 1.0]) @ lens_matrix(camera)

    def photo_from_plane(self, turns: Values) -> Values:
        """Return the (3, 3) homography with the normal turned by ``turns`` (2,), pitch and roll in radians."""
        pitch, roll = (cv2.Rodrigues(np.asarray(axis) * turn)[0] for axis, turn in zip(AXES, turns, strict=True))
        normal = pitch @ roll @ self.normal
        right = np.cross(normal, [0.0, 0.0, 1.0])
        length = float(np.linalg.norm(right))
        # Seen straight from above, any direction of the plane will do.
        right = right / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
        return np.asarray(self.lens @ np.stack([right, np.cross(normal, right), -normal], axis=1))

    def around(self, hole: Mask) -> Mask:
        """Return the pixels (h, w) of the ground up to ``FARTHER`` of the depth of the ``hole`` (h, w)."""
        y, x = np.mgrid[: hole.shape[0], : hole.shape[1]] + 0.5
        _, inverse = _carried(np.linalg.inv(self.photo_from_plane(np.zeros(2))), np.stack([x.ravel(), y.ravel()], 1))
        depth = np.where(inverse > 1e-9, 1.0 / np.maximum(inverse, 1e-9), np.inf).reshape(hole.shape)
        seen = hole & np.isfinite(depth)
        return np.asarray(depth < FARTHER * np.quantile(depth[seen], 0.98)) if seen.any() else np.zeros_like(hole)


AXES = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def _carried(matrix: Values, points: Values) -> tuple[Values, Values]:
    """``points`` (n, 2) carried by ``matrix`` (3, 3), and their depths (n,); NaN behind."""
    x, y, depth = matrix @ np.stack([points[:, 0], points[:, 1], np.ones(len(points))])
    ahead = np.where(depth > 1e-9, depth, np.nan)
    return np.stack([x / ahead, y / ahead], axis=1), depth


def _search(ground: _Ground, pattern: NDArray[np.float32], known: Mask, places: Values) -> _Turned | None:
    """Return the turns at which the autocorrelation of ``pattern`` (h, w) has the clearest lattice."""
    tried = [_turned(ground, np.array(turns), pattern, known, places) for turns in product(PITCHES, ROLLS)]
    tried.sort(key=lambda item: -item.score)
    best = tried[0]
    for start in tried[:2]:
        if start.score < LIKELY:
            break
        simplex = start.turns + np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.02]])
        found = optimize.minimize(
            lambda turns: -_turned(ground, turns, pattern, known, places).score,
            start.turns,
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": 40},
        )
        if -found.fun > best.score:
            best = _turned(ground, np.asarray(found.x), pattern, known, places)
    return best if best.score >= CLEAR else None


def _turned(ground: _Ground, turns: Values, pattern: NDArray[np.float32], known: Mask, places: Values) -> _Turned:
    """The lattice of ``pattern`` in the top view with ``turns``; a score of 0 where there is none."""
    nothing = _Turned(turns, 0.0, np.zeros((2, 2)))
    matrix = ground.photo_from_plane(turns)
    plane, _ = _carried(np.linalg.inv(matrix), places)
    plane = plane[np.isfinite(plane).all(axis=1)]
    if len(plane) < 50:
        return nothing
    low, high = np.percentile(plane, 1.0, axis=0), np.percentile(plane, 99.0, axis=0)
    step = float(np.sqrt(max(float((high - low).prod()), 1e-12))) / VIEW
    width, height = np.clip(np.ceil((high - low) / step), 16, 3 * VIEW).astype(int)
    steps = (high - low) / (width, height)
    x, y = np.meshgrid(low[0] + (np.arange(width) + 0.5) * steps[0], low[1] + (np.arange(height) + 0.5) * steps[1])
    at, _ = _carried(matrix, np.stack([x.ravel(), y.ravel()], axis=1))
    photo = np.clip(np.nan_to_num(at - 0.5, nan=-9e3), -9e3, 9e3).astype(np.float32).reshape(height, width, 2)
    seen = cv2.remap(known.astype(np.float32), photo[..., 0], photo[..., 1], cv2.INTER_LINEAR, borderValue=0) > 0.99
    view = cv2.remap(pattern, photo[..., 0], photo[..., 1], cv2.INTER_LINEAR)
    blur = max(height, width) / SLOW
    total, weight = (cv2.GaussianBlur(part.astype(np.float32), (0, 0), blur) for part in (view * seen, seen))
    inner = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if inner.sum() < 500:
        return nothing
    flat = np.asarray(view - total / np.maximum(weight, 0.05), dtype=np.float32)
    correlation = _autocorrelation(flat, inner)
    score, vectors = _lattice_of(correlation)
    return _Turned(turns, score, vectors * steps)


def _autocorrelation(values: NDArray[np.float32], known: Mask) -> NDArray[np.float32]:
    """Correlation of the ``known`` ``values`` (h, w) at every distance, with distance 0 in the middle; −1 where too few
    have a partner."""
    size = tuple(fft.next_fast_len(2 * count, real=True) for count in known.shape)
    weight = fft.rfft2(known.astype(np.float32), size)
    planes = np.where(known, values - values[known].mean(), 0.0).astype(np.float32)
    spectrum, squares = fft.rfft2(planes, size), fft.rfft2(planes * planes, size)
    pairs, products = (fft.irfft2(np.abs(part) ** 2, size) for part in (weight, spectrum))
    power = fft.irfft2(squares * np.conj(weight), size) * fft.irfft2(np.conj(squares) * weight, size)
    result = np.where(pairs > OVERLAP * known.sum(), products / np.sqrt(np.maximum(power, 1e-12)), -1.0)
    return np.asarray(fft.fftshift(result), dtype=np.float32)


def _lattice_of(correlation: NDArray[np.float32]) -> tuple[float, Values]:
    """Return the score of the clearest lattice of ``correlation`` (h, w), 0 where there is none, and its vectors (2, 2)
    in pixels: mean correlation at all of its vectors less that half-way between."""
    middle = np.array([correlation.shape[1] // 2, correlation.shape[0] // 2])
    smooth = ndimage.gaussian_filter(correlation, 0.7)
    rows, columns = np.nonzero((smooth == ndimage.maximum_filter(smooth, 5)) & (smooth > 0.15))
    away = np.stack([columns, rows], axis=1) - middle
    ahead = (away[:, 1] > 0) | ((away[:, 1] == 0) & (away[:, 0] > 0))
    keep = ahead & (np.linalg.norm(away, axis=1) >= NEAREST)
    away, heights = away[keep].astype(np.float64), smooth[rows[keep], columns[keep]]
    nothing = 0.0, np.zeros((2, 2))
    if len(away) < 4:
        return nothing
    away = away[heights > 0.45 * heights.max()]
    away = away[np.argsort(np.linalg.norm(away, axis=1), kind="stable")]
    best = nothing
    for first in away[:2]:
        across = np.abs(away @ np.array([-first[1], first[0]])) / np.linalg.norm(away, axis=1) / np.linalg.norm(first)
        for second in away[across > 0.3][:4]:
            vectors = _fitted(smooth, middle, np.stack([first, second]))
            score = 0.0 if vectors is None else _score(correlation, middle, vectors)
            if vectors is not None and score > best[0] + 0.02:
                best = score, vectors
    return best


MULTIPLES = np.array([(i, j) for i in range(MOST + 1) for j in range(-MOST, MOST + 1) if i > 0 or j > 0])


def _within(correlation: NDArray[np.float32], middle: Values, places: Values) -> Mask:
    """Which of ``places`` (n, 2) from the ``middle`` have a correlation."""
    inside = (np.abs(places) < middle - 3).all(axis=1)
    at = np.rint(places[inside] + middle).astype(int)
    inside[inside] = correlation[at[:, 1], at[:, 0]] > -0.9
    return np.asarray(inside)


def _fitted(correlation: NDArray[np.float32], middle: Values, vectors: Values) -> Values | None:
    """``vectors`` (2, 2) fitted to the peaks next to their multiples; None where there are too few."""
    offsets = np.array(list(product(range(-2, 3), repeat=2)))
    for _ in range(3):
        places = MULTIPLES @ vectors
        use = _within(correlation, middle, places)
        if use.sum() < 8:
            return None
        near = np.rint(places[use]).astype(int)[:, None] + offsets
        values = correlation[near[..., 1] + middle[1], near[..., 0] + middle[0]]
        peak, weight = values.argmax(axis=1), values.max(axis=1)
        good = weight > 0.3
        if good.sum() < 4:
            return None
        wanted = near[np.arange(len(near)), peak][good]
        multiples = MULTIPLES[use][good] * weight[good, None]
        vectors = np.linalg.lstsq(multiples, wanted * weight[good, None], rcond=None)[0]
        if abs(float(np.linalg.det(vectors))) < NEAREST**2 / 2.0:
            return None
    return np.asarray(vectors)


def _score(correlation: NDArray[np.float32], middle: Values, vectors: Values) -> float:
    """Mean ``correlation`` (h, w) at the multiples of ``vectors`` (2, 2) less that half-way between; 0 where either is
    not repeated twice: along a single edge all is alike."""
    places = MULTIPLES @ vectors
    within = _within(correlation, middle, places)
    places = places[within]
    multiples = np.abs(MULTIPLES[within])
    if len(multiples) < REPEATS or (multiples.max(axis=0) < 2).any():
        return 0.0
    halves = np.concatenate([places + half for half in (*vectors / 2.0, vectors.mean(axis=0))])
    halves = halves[_within(correlation, middle, halves)]
    on, off = (
        float(ndimage.map_coordinates(correlation, (part + middle).T[::-1], order=1).mean()) if len(part) else 0.0
        for part in (places, halves)
    )
    return on - max(off, 0.0)


def _refined(start: _Turned, copy: _Copy) -> Lattice:
    """The lattice refined by what it foretells at known places beside the hole of ``copy``."""
    places = copy.beside()
    unit = np.array([0.005, 0.005, *np.full(4, 0.02 * np.linalg.norm(start.vectors[0]))])

    def lattice(change: Values) -> Lattice:
        turned, moved = start.turns + (change * unit)[:2], start.vectors + (change * unit)[2:].reshape(2, 2)
        return Lattice(copy.ground.photo_from_plane(turned), moved[0], moved[1])

    found = optimize.minimize(
        lambda change: -copy.share(lattice(change), places),
        np.zeros(6),
        method="Nelder-Mead",
        options={"initial_simplex": np.vstack([np.zeros(6), np.eye(6)]), "maxfev": 90},
    )
    return replace(lattice(np.asarray(found.x)), share=float(np.clip(-found.fun, 0.0, 1.0)))
