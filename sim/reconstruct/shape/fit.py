# SPDX-License-Identifier: MIT
"""Fit a ball, a cylinder or a cone, or a box that rests on the ground to an outline.

Least squares of the outline's distance from the primitive's own, which is exact: the projected hull of a few points.
The loss grows only linearly far away, so a handle does not pull a cup's wall. Several starts; lengths as logarithms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ...scene.model import Camera
from ..view.camera import on_ground
from .edges import InnerEdges
from .outline import Outline, distance_to_convex, hull_polygon
from .primitives import Box, Primitive, Revolved, Sphere

Points = NDArray[np.float64]
Parameters = NDArray[np.float64]

COARSE, FINE = 60, 160
"""Outline points that the search and the last refinement use."""
INDEPENDENT = 40.0
"""So many independent measurements an outline is taken for: neighbouring points err together."""
NOISE = (0.7, 0.004)
"""Standard deviation of an outline: pixels, and share of the object's size; the larger one."""
ROBUST = 2.0
"""Standard deviations beyond which the loss grows only linearly."""
STEP = 1e-4
"""Relative step of the numerical derivatives; hulls are picked in single precision."""
FAR = 1e3
"""Residual of what cannot be: a primitive that reaches behind the camera."""
REFINED = 4
"""Starts that are followed to the end."""
ROUND = 8.0
"""Weight of the guess that a ball is as high as wide."""
EDGE_WEIGHT = 2.5
"""Standard deviations that an inner edge where the photo shows none counts."""
SQUARE = 0.3
"""Weight of the guess that a box' base is square, for what the outline leaves open; of a known proportion, 1.5."""
KNOWN = 1.5
FIXED = 100.0
"""Weight of a proportion that the user gives."""


@dataclass(frozen=True)
class Start:
    """Where fits start. x, y: the nearest point of the outline on the ground; away: (2,) unit, from the camera.

    size: square root of the outline's area at that distance; ratio: height over width of the outline.
    """

    x: float
    y: float
    away: Points
    size: float
    ratio: float


def start_of(camera: Camera, outline: Outline) -> Start | None:
    """Where to start; None when no part of the outline can be on the ground."""
    ground = on_ground(camera, outline.points)
    ground = ground[np.isfinite(ground).all(axis=1)]
    if not len(ground):
        return None
    offset = ground[:, :2] - camera.position[:2]
    # The nearest hundredth part: one stray pixel must not decide.
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
    # Made robust before it is weighted, or a guess far off would count as much as what is seen.
    off = np.clip(distance / (ROBUST * noise), -FAR, FAR)
    return ROBUST * np.sign(off) * np.sqrt(2.0 * (np.sqrt(1.0 + off**2) - 1.0)) * outline.weights * share


def _search(
    build: Callable[[Parameters], Primitive],
    starts: Iterable[Parameters],
    camera: Camera,
    outline: Outline,
    extra: Callable[[Primitive], NDArray[np.float64]] | None = None,
    rounds: tuple[int, int] = (12, 25),
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
        best = [follow(values, thick, rounds[1], True) for _, values in tried[:REFINED]]
    if not best:
        return None
    cost, values = min(best, key=lambda item: item[0])
    if not np.isfinite(values).all() or (_residuals(camera, build(values), thin) == FAR).all():
        return None
    return build(values), cost


def _log(values: Parameters) -> NDArray[np.float64]:
    return np.exp(np.clip(values, -12.0, 12.0))


def fit_sphere(camera: Camera, outline: Outline) -> tuple[Primitive, float] | None:
    """The ball whose outline is nearest to ``outline``, and its cost; None when it cannot stand on the ground."""
    start = start_of(camera, outline)
    if start is None:
        return None
    # A ball on the ground is seen under the angle a around a ray b below the horizontal: 1 − D sin b = D sin a.
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
    """The upright cylinder or cone, whole or cut off, nearest to ``outline``, and its cost."""
    start = start_of(camera, outline)
    if start is None:
        return None

    def build(p: Parameters) -> Revolved:
        height, low, high = start.size * _log(p[2:5])
        foot = np.array([start.x, start.y]) + start.size * (p[0] * start.away + p[1] * _left(start.away))
        return Revolved(float(foot[0]), float(foot[1]), (0.0, float(height)), (float(low), float(high)))

    def slender(primitive: Primitive) -> NDArray[np.float64]:
        assert isinstance(primitive, Revolved)
        low, high = primitive.radii
        # A cylinder where nothing speaks against it; never a mushroom.
        return np.array([0.15 * np.log(high / low), max(0.0, np.log(high / low / 3.0)) * 5.0])

    starts = []
    for height in (0.25, 0.7, 1.5):
        radius = 0.5 / np.sqrt(max(start.ratio, 0.2))
        starts += [
            np.array([radius, 0.0, np.log(height), np.log(radius), np.log(radius * taper)]) for taper in (1.0, 0.3)
        ]
    return _search(build, starts, camera, outline, slender)


def fit_box(
    camera: Camera,
    outline: Outline,
    edges: InnerEdges | None = None,
    *,
    flatness: float | None = None,
    thickness: float | None = None,
) -> tuple[Primitive, float] | None:
    """The box nearest to ``outline``, and its cost.

    edges: what the photo shows inside the outline; tells depth from height where the outline leaves it open.
    flatness: smallest extent over the largest one, as things of that kind have it. thickness: depth over width.
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
