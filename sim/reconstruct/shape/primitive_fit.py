# SPDX-License-Identifier: MIT
"""Fit a sphere, a cylinder or cone, or a box that rests on the ground to an outline.

Least squares of the distance between the outline and the primitive's own, which is exact: the projected convex hull of
a few points. The loss is robust, so a handle does not pull a cup's wall. Edges that the photo shows inside the outline
settle the depth of boxes. Several starts; lengths as logarithms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import least_squares

from ...scene.model import Camera
from ..camera.ground_camera import on_ground
from .primitives import Box, Outline, Primitive, Sphere, SurfaceOfRevolution, distance_to_convex, hull_polygon

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]

SIDE = 240
"""Pixels along the longer side of the object in the picture in which edges are detected."""
SAMPLES = 14
"""Points along each edge."""
_PLACES = np.linspace(0.08, 0.92, SAMPLES)[:, None]
FACES = ((0, 0), (0, 1), (1, 0), (1, 1), (2, 1))
"""Axis and end of the faces that can be visible: all but the base."""
STRONG = 90.0
"""Percentile of the gradient inside the object that counts as an edge."""


class InnerEdges:
    """The gradient inside an object, at ``SIDE`` pixels."""

    def __init__(self, pixels: NDArray[np.uint8], full: Mask, seen: Mask) -> None:
        """pixels: (H, W, 3) sRGB; full, seen: (H, W) whole mask and visible part; not empty."""
        rows, columns = np.flatnonzero(full.any(axis=1)), np.flatnonzero(full.any(axis=0))
        self._top, self._left = int(rows[0]), int(columns[0])
        window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        height, width = rows[-1] + 1 - rows[0], columns[-1] + 1 - columns[0]
        self._scale = min(1.0, SIDE / max(height, width))
        size = (max(8, round(width * self._scale)), max(8, round(height * self._scale)))
        small = cv2.resize(pixels[window], size, interpolation=cv2.INTER_AREA).astype(np.float64)
        inside = cv2.resize(seen[window].astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
        self._ratio = np.array([size[0] / width, size[1] / height])
        self._inside = ndimage.binary_erosion(inside, iterations=5)
        # Logarithm: a shaded face differs from a lit one by a factor.
        tone = np.log1p(small.mean(axis=2))
        blurred = [ndimage.gaussian_filter(channel, 1.8) for channel in (tone, *_chroma(small))]
        gradients = [np.stack([ndimage.sobel(c, axis=1), ndimage.sobel(c, axis=0)]) for c in blurred]
        self._gradients, self._known = np.concatenate(gradients), self._inside.astype(np.float64)
        strength = np.sqrt(sum((g**2).sum(axis=0) for g in gradients))
        values = strength[self._inside]
        self._strong = max(float(np.percentile(values, STRONG)) if len(values) else 0.0, 0.05)

    def missing(self, camera: Camera, box: Box) -> NDArray[np.float64]:
        """Return 0 (a clear edge in the photo) to 1 for each inner edge of ``box``; always three values."""
        corners = box.corners()
        projected = camera.project(corners)
        if not (projected[:, 2] > 1e-6).all():
            return np.ones(3)
        at = (projected[:, :2] - [self._left, self._top]) * self._ratio
        edges = []
        for first, second in _inner_edges(camera, box, corners):
            along = at[second] - at[first]
            length = float(np.linalg.norm(along))
            if length >= 6.0:
                edges.append((at[first] + _PLACES * along - 0.5, np.array([-along[1], along[0]]) / length, length))
        if not edges:
            return np.zeros(3)
        # All edges and pictures at once: a call for so few places is mostly its checks.
        where = np.concatenate([places for places, _, _ in edges])[:, ::-1].T
        count, total = len(self._gradients), SAMPLES * len(edges)
        stacked = np.empty((3, count, total))
        stacked[0], stacked[1:] = np.arange(count)[:, None], where[:, None]
        known = ndimage.map_coordinates(self._known, where, order=1, mode="constant").reshape(-1, SAMPLES)
        found = ndimage.map_coordinates(self._gradients, stacked.reshape(3, -1), order=1, mode="nearest")
        parts = found.reshape(-1, 2, len(edges), SAMPLES)
        answers = []
        for index, (_, normal, length) in enumerate(edges):
            across = np.zeros(SAMPLES)
            for dx, dy in parts[:, :, index]:
                across += (dx * normal[0] + dy * normal[1]) ** 2
            shown, inside = np.minimum(np.sqrt(across) / self._strong, 1.0), known[index]
            if inside.sum() < 3.0:
                continue
            share = float((shown * inside).sum() / inside.sum())
            answers.append((1.0 - share) * min(1.0, length / 40.0))
        return np.array(([*answers, 0.0, 0.0, 0.0])[:3])


def _chroma(small: Points) -> tuple[Points, Points]:
    total = small.sum(axis=2) + 30.0
    return 2.0 * small[..., 0] / total, 2.0 * small[..., 2] / total


def _inner_edges(camera: Camera, box: Box, corners: Points) -> list[tuple[int, int]]:
    """Pairs of corners: edges between two faces that both face the camera."""
    across, along = box.axes
    away = camera.position - np.array([box.x, box.y, 0.0])
    seen = {
        (0, 0): -(away[:2] @ across) > box.width / 2.0,
        (0, 1): away[:2] @ across > box.width / 2.0,
        (1, 0): -(away[:2] @ along) > box.depth / 2.0,
        (1, 1): away[:2] @ along > box.depth / 2.0,
        (2, 1): away[2] > box.height,
    }
    faces = [face for face in FACES if seen[face]]
    edges = []
    for i, (axis, end) in enumerate(faces):
        for other, other_end in faces[i + 1 :]:
            if axis == other:
                continue
            shared = [c for c in range(8) if (c >> axis & 1) == end and (c >> other & 1) == other_end]
            edges.append((shared[0], shared[1]))
    return edges


Parameters = NDArray[np.float64]

COARSE, FINE = 60, 160
"""Outline points that the search and the last refinement use."""
INDEPENDENT = 40.0
"""Effective number of independent measurements of an outline: neighbouring points err together."""
NOISE = (0.7, 0.004)
"""Standard deviation of an outline: pixels, and share of the object's size; the larger one."""
ROBUST = 2.0
"""Standard deviations beyond which the loss grows only linearly."""
STEP = 1e-4
"""Relative step of the numerical derivatives; hulls are picked in single precision."""
FAR = 1e3
"""Residual of an impossible primitive, one that reaches behind the camera."""
REFINED = 4
"""Starts that are refined."""
ROUND = 8.0
"""Weight of the prior that a sphere is as high as wide."""
EDGE_WEIGHT = 2.5
"""Penalty in standard deviations for an inner edge that the photo does not show."""
SQUARE = 0.3
"""Weight of the prior that a box' base is square; of a known proportion, 1.5."""
KNOWN = 1.5
FIXED = 100.0
"""Weight of a user-given proportion."""
POOR = 400.0
"""Cost above which a fit describes nothing: the outline is ten standard deviations off on average."""
STUMP = 0.25
"""Height over the sum of both radii below which a body of revolution is fitted again as a stump of this proportion."""
STUMP_WEIGHT = 1.0
"""Weight of that proportion for what is still flatter."""
AS_WELL = 1.5
"""Difference in cost up to which an outline does not tell two bodies apart, below two standard deviations."""


@dataclass(frozen=True)
class Start:
    """Start of the fits. x, y: the nearest point of the outline on the ground; away: (2,) unit, from the camera.

    size: square root of the outline's area at that distance; ratio: height over width of the outline.
    """

    x: float
    y: float
    away: Points
    size: float
    ratio: float


def start_of(camera: Camera, outline: Outline) -> Start | None:
    """Return the start; None if no part of the outline can be on the ground."""
    ground = on_ground(camera, outline.points)
    ground = ground[np.isfinite(ground).all(axis=1)]
    if not len(ground):
        return None
    offset = ground[:, :2] - camera.position[:2]
    # The nearest percentile: robust against stray pixels.
    nearest = ground[np.argsort(np.linalg.norm(offset, axis=1))[len(ground) // 100]]
    depth = float(camera.project(nearest)[2])
    forward = np.asarray(camera.world_from_camera)[:2, 2]
    away = nearest[:2] - camera.position[:2]
    if np.linalg.norm(away) < 1e-6:
        away = forward
    away = away / max(float(np.linalg.norm(away)), 1e-12)
    extent = np.ptp(outline.points, axis=0)
    return Start(
        x=float(nearest[0]),
        y=float(nearest[1]),
        away=away,
        size=outline.size * depth / camera.fx,
        ratio=float(extent[1] / max(extent[0], 1.0)),
    )


def _residuals(camera: Camera, primitive: Primitive, outline: Outline) -> NDArray[np.float64]:
    points = np.concatenate(primitive.pieces(camera))
    projected = camera.project(points)
    if not ((projected[:, 2] > 1e-6) & (np.abs(projected[:, :2]) < 1e6).all(axis=1)).all():
        return np.full(len(outline.points), FAR)
    noise = max(NOISE[0], NOISE[1] * outline.size)
    distance = distance_to_convex(outline.points, hull_polygon(projected[:, :2]))
    share = np.sqrt(INDEPENDENT / max(float(outline.weights.sum()), 1.0))
    # Apply the robust loss before the weight, or a distant guess would count as much as a visible point.
    off = np.clip(distance / (ROBUST * noise), -FAR, FAR)
    return ROBUST * np.sign(off) * np.sqrt(2.0 * (np.sqrt(1.0 + off**2) - 1.0)) * outline.weights * share


def _search(
    build: Callable[[Parameters], Primitive],
    starts: Iterable[Parameters],
    camera: Camera,
    outline: Outline,
    extra: Callable[[Primitive], NDArray[np.float64]] | None = None,
    rounds: tuple[int, int] = (12, 25),
    refined: int = REFINED,
) -> tuple[Primitive, float] | None:
    """The best primitive over all ``starts`` and its cost."""

    def follow(start: Parameters, points: Outline, most: int, more: bool) -> tuple[float, Parameters]:
        def residuals(values: Parameters) -> NDArray[np.float64]:
            primitive = build(values)
            parts = [_residuals(camera, primitive, points)]
            if more and extra is not None:
                parts.append(extra(primitive))
            return np.concatenate(parts)

        found = least_squares(residuals, start, diff_step=STEP, max_nfev=most, x_scale=1.0)
        return float(found.cost), np.asarray(found.x)

    thin, thick = outline.thinned(COARSE), outline.thinned(FINE)
    with np.errstate(all="ignore"):
        tried = sorted((follow(start, thin, rounds[0], True) for start in starts), key=lambda item: item[0])
        best = [follow(values, thick, rounds[1], True) for _, values in tried[:refined]]
    if not best:
        return None
    cost, values = min(best, key=lambda item: item[0])
    if not np.isfinite(values).all() or (_residuals(camera, build(values), thin) == FAR).all():
        return None
    return build(values), cost


def _log(values: Parameters) -> NDArray[np.float64]:
    return np.exp(np.clip(values, -12.0, 12.0))


def fit_sphere(camera: Camera, outline: Outline) -> tuple[Primitive, float] | None:
    """Return the sphere whose outline is nearest to ``outline``, and its cost; None if it cannot stand on the
    ground."""
    start = start_of(camera, outline)
    if start is None:
        return None
    # A sphere on the ground subtends the angle a around a ray b below the horizontal: 1 − D sin b = D sin a.
    middle = camera.rays((outline.points.min(axis=0) + outline.points.max(axis=0)) / 2.0)
    below = -float(middle[2]) / float(np.linalg.norm(middle))
    angle = outline.size / np.sqrt(np.pi) / camera.fx / float(np.linalg.norm(middle))
    distance = float(camera.position[2]) / max(below + angle, 0.02)
    centre = camera.position + distance * middle / np.linalg.norm(middle)
    radius = max(distance * angle, 1e-9)

    def build(p: Parameters) -> Sphere:
        size, squash = _log(p[2:4])
        return Sphere(centre[0] + p[0] * radius, centre[1] + p[1] * radius, radius * float(size), float(squash))

    def round_(primitive: Primitive) -> NDArray[np.float64]:
        assert isinstance(primitive, Sphere)
        return np.array([ROUND * np.log(primitive.squash)])

    return _search(build, [np.zeros(4), np.array([0.0, 0.3, 0.2, 0.0])], camera, outline, round_)


def fit_cylinder(camera: Camera, outline: Outline, thickness: float | None = None) -> tuple[Primitive, float] | None:
    """Return the upright cylinder or (truncated) cone nearest to ``outline``, and its cost."""
    start = start_of(camera, outline)
    if start is None:
        return None

    def build(p: Parameters) -> SurfaceOfRevolution:
        height, low, high = start.size * _log(p[2:5])
        foot = np.array([start.x, start.y]) + start.size * (p[0] * start.away + p[1] * _left(start.away))
        return SurfaceOfRevolution(float(foot[0]), float(foot[1]), (0.0, float(height)), (float(low), float(high)))

    def slender(primitive: Primitive) -> NDArray[np.float64]:
        assert isinstance(primitive, SurfaceOfRevolution)
        low, high = primitive.radii
        # Prefer a cylinder; penalise mushrooms.
        return np.array([0.15 * np.log(high / low), max(0.0, np.log(high / low / 3.0)) * 5.0])

    radius = 0.5 / np.sqrt(max(start.ratio, 0.2))

    def starts(radius: float, heights: tuple[float, ...], tapers: tuple[float, ...]) -> list[Parameters]:
        return [
            np.array([radius, 0.0, np.log(height), np.log(radius), np.log(radius * taper)])
            for height in heights
            for taper in tapers
        ]

    found = _search(build, starts(radius, (0.25, 0.7, 1.5), (1.0, 0.3)), camera, outline, slender)
    if found is not None and found[1] > POOR:
        # Slow starts are dropped early, and may be the only ones that do not end in a wrong minimum.
        more = starts(radius, (0.25, 0.7, 1.0, 1.5), (1.0, 0.6, 0.3)) + starts(0.6 * radius, (1.0, 2.0), (1.0, 0.6))
        other = _search(build, more, camera, outline, slender, refined=len(more))
        found = other if other is not None and other[1] < found[1] else found
    if found is None or not _flat(found[0]):
        return found

    # From above, the top of a stump may lie within the outline of its base. A disc of no height has that outline too,
    # and needs no taper: the stump is preferred where it fits as well. What is seen to be flat stays as it was found.
    def stump(primitive: Primitive) -> NDArray[np.float64]:
        assert isinstance(primitive, SurfaceOfRevolution)
        flatness = np.log(primitive.height / (STUMP * sum(primitive.radii)))
        return np.append(slender(primitive), STUMP_WEIGHT * min(0.0, flatness))

    stumps = starts(0.5 * np.sqrt(max(start.ratio, 0.2)), (0.25, 0.7), (0.8, 0.5))
    higher = _search(build, stumps, camera, outline, stump)
    if higher is None or _flat(higher[0], 0.9) or higher[1] > found[1] + AS_WELL:
        return found
    return higher


def _flat(primitive: Primitive, share: float = 1.0) -> bool:
    assert isinstance(primitive, SurfaceOfRevolution)
    return primitive.height < share * STUMP * sum(primitive.radii)


DISC = 0.12
"""Height over diameter of a disc that lies: coins and buttons have 0.06 to 0.2."""


def fit_disc(camera: Camera, outline: Outline) -> tuple[Primitive, float] | None:
    """Return the disc that lies on the ground with the outline nearest to ``outline``, and its cost."""
    start = start_of(camera, outline)
    if start is None:
        return None
    middle = on_ground(camera, (outline.points.min(axis=0) + outline.points.max(axis=0))[None] / 2.0)[0]
    if not np.isfinite(middle).all():
        return None
    radius = start.size / np.sqrt(np.pi)

    def build(p: Parameters) -> SurfaceOfRevolution:
        wide = radius * float(_log(p[2:3])[0])
        x, y = middle[:2] + radius * p[:2]
        return SurfaceOfRevolution(float(x), float(y), (0.0, 2.0 * DISC * wide), (wide, wide))

    return _search(build, [np.zeros(3)], camera, outline)


def fit_box(
    camera: Camera,
    outline: Outline,
    edges: InnerEdges | None = None,
    *,
    flatness: float | None = None,
    thickness: float | None = None,
) -> tuple[Primitive, float] | None:
    """Return the box nearest to ``outline``, and its cost.

    edges: of the photo inside the outline; they separate depth from height. flatness: smallest extent over the largest
    one, typical of the object's kind. thickness: depth over width.
    """
    start = start_of(camera, outline)
    if start is None:
        return None
    facing = float(np.arctan2(start.away[1], start.away[0]) - np.pi / 2.0)

    def build(p: Parameters) -> Box:
        width, depth, height = start.size * _log(p[3:6])
        foot = np.array([start.x, start.y]) + start.size * (p[0] * start.away + p[1] * _left(start.away))
        return Box(float(foot[0]), float(foot[1]), facing + float(p[2]), float(width), float(depth), float(height))

    def extra(primitive: Primitive) -> NDArray[np.float64]:
        assert isinstance(primitive, Box)
        width, depth, height = primitive.width, primitive.depth, primitive.height
        parts = []
        if thickness is not None:
            parts.append(FIXED * (np.log(depth / width) - np.log(thickness)))
        elif flatness is not None:
            ordered = np.sort([width, depth, height])
            parts.append(KNOWN * (np.log(ordered[0] / ordered[2]) - np.log(flatness)))
        else:
            parts.append(SQUARE * np.log(depth / width))
        parts.append(0.1 * np.log(height / np.sqrt(width * depth)))
        known = np.array(parts)
        if edges is None:
            return known
        return np.concatenate([known, EDGE_WEIGHT * edges.missing(camera, primitive)])

    ratios = (thickness,) if thickness is not None else (1.0, 0.25)
    starts = []
    for yaw in np.radians([-35.0, -12.0, 12.0, 35.0]):
        for ratio in ratios:
            shapes = (
                ((1.0, ratio, 0.6), (ratio, 1.0, 0.6)) if ratio < 0.5 and thickness is None else ((1.0, ratio, 0.8),)
            )
            for width, depth, height in shapes:
                starts.append(np.array([0.5 * max(depth, 0.3), 0.0, yaw, *np.log([width, depth, height])]))
        starts.append(np.array([0.5, 0.0, yaw, 0.0, 0.0, np.log(0.12)]))
    return _search(build, starts, camera, outline, extra)


def _left(away: Points) -> Points:
    return np.array([-away[1], away[0]])
