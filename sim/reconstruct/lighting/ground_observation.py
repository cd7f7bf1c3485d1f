# SPDX-License-Identifier: MIT
"""The visible ground around the objects, point by point: what shadows may reach, and how bright it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera, Ground
from ...srgb import bytes_to_linear
from .ground_lighting import ShadowCaster, overcast_sky, smooth_terms, surface_points
from .standing_surface import ground_before, standing_surface

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Mesh = tuple[Points, NDArray[np.integer]]

OBJECT_SIDE, LONGEST_SIDE = 110, 1600
"""Size in pixels of the largest object in the picture in which shadows are compared, and the picture's longest side."""
MAX_POINTS = 7000
MIN_POINTS = 300
REACH = 2.8
"""Range of ground around an object, over its height: the shadow of a sun 20° high."""
WHITE_GROUND = 0.5
"""Share of clipped pixels beside the objects above which they are the lit ground, white paper, and not highlights on
it: without them only its shadows are left to be compared with each other."""
WHITE_SHARE = 2
"""Most clipped points that are kept, over the others."""
LUMINANCE_F32 = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True)
class GroundObservation:
    """Visible ground points.

    caster: shadows at them. brightness: (N,) natural logarithm of the luminance. terms: (N, 6), ``smooth_terms``. sky:
    (N,) share of the environment's light that reaches them past the objects. rows, columns: (N,) their pixels in a
    picture of ``size`` (width, height). white: (N,) where the photo is clipped, on ground that mostly is.
    """

    caster: ShadowCaster
    brightness: Points
    terms: Points
    sky: Points
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    size: tuple[int, int]
    white: Mask


def ground_axes(ground: Ground) -> Points:
    """Return rows (3, 3): two unit vectors along the ground, and its normal."""
    normal = ground.unit_normal
    helper = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.9 else np.array([0.0, 0.0, -1.0])
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first), normal])


def observe_ground(
    camera: Camera,
    ground: Ground,
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    meshes: Sequence[tuple[Points, NDArray[np.integer]]],
    sky: tuple[Points, Points] | None,
    things: Mask | None = None,
) -> GroundObservation | None:
    """Return the visible ground around the objects in ``pixels`` (H, W, 3) sRGB, or None if there is too little.

    Arguments as for ``estimate_lamps``.
    """
    axes, origin = ground_axes(ground), np.asarray(ground.point, dtype=np.float64)
    surfaces = [(surface_points(vertices, faces) - origin) @ axes.T for vertices, faces in meshes]
    height, width = pixels.shape[:2]
    shrink = min(1.0, OBJECT_SIDE / _largest_side(masks), LONGEST_SIDE / max(width, height))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    linear = bytes_to_linear(pixels)
    light = np.asarray(cv2.resize(linear, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    luminance = light @ LUMINANCE_F32
    covered, white = _covered_and_white(pixels, masks, things, size)
    rows, columns = np.nonzero(~covered & (luminance > 1e-4))
    seen = np.column_stack([(columns + 0.5) * width / size[0], (rows + 0.5) * height / size[1]])
    rays = camera.rays(seen) @ axes.T
    eye = (camera.position - origin) @ axes.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[:, 2] < -1e-9, -eye[2] / rays[:, 2], np.nan)
        flat = eye[:2] + depth[:, None] * rays[:, :2]
    near = _within_reach(flat, surfaces)
    if near.sum() < MIN_POINTS:
        return None
    near &= _standing(light, rows, columns, near, ground_before(flat, eye[:2], surfaces))
    blank = near & white[rows, columns]
    most = max(MIN_POINTS, WHITE_SHARE * int((near & ~blank).sum()))
    if blank.sum() > most:
        # Robust fits would take the few points that show a shadow for outliers.
        drawn = np.random.default_rng(0).choice(np.flatnonzero(blank), most, replace=False)
        near = near & ~blank
        near[drawn] = True
    index = np.flatnonzero(near)
    if len(index) > MAX_POINTS:
        index = np.random.default_rng(0).choice(index, MAX_POINTS, replace=False)
    points = flat[index]
    caster = ShadowCaster(surfaces, points)
    brightness = np.log(luminance[rows[index], columns[index]].astype(np.float64))
    above = caster.reaching(*(sky or overcast_sky()))
    return GroundObservation(
        caster=caster,
        brightness=brightness,
        terms=smooth_terms(points),
        sky=above,
        rows=rows[index],
        columns=columns[index],
        size=size,
        white=white[rows[index], columns[index]],
    )


def _covered_and_white(
    pixels: NDArray[np.uint8], masks: Sequence[Mask], things: Mask | None, size: tuple[int, int]
) -> tuple[Mask, Mask]:
    """Return where objects or clipped pixels cover the ground, and where it is clipped white paper.

    Both in a picture of ``size`` (width, height).
    """
    objects = np.logical_or.reduce(masks if things is None else [*masks, things])
    bright, black = pixels.max(axis=2) >= 254, pixels.max(axis=2) <= 2
    beside = bright[_beside(masks) & ~objects]
    on_white = len(beside) > 0 and bool(beside.mean() > WHITE_GROUND)
    clipped = black if on_white else bright | black
    objects = objects | (cv2.erode(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    covered = cv2.resize(objects.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    # Pixels along an outline mix object and ground.
    covered = cv2.dilate(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    white = cv2.resize((bright & on_white).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    return covered, white


def _within_reach(flat: Points, surfaces: Sequence[Points]) -> Mask:
    """Return which points ``flat`` (N, 2) on the ground a shadow of the ``surfaces`` may reach; NaN never."""
    near = np.zeros(len(flat), dtype=bool)
    for surface in surfaces:
        low, high = surface[:, :2].min(axis=0), surface[:, :2].max(axis=0)
        tall = max(float(surface[:, 2].max()), 1e-9)
        with np.errstate(invalid="ignore"):
            outside = np.linalg.norm(np.maximum(np.maximum(low - flat, flat - high), 0.0), axis=1)
            near |= outside < REACH * tall
    return near


def _standing(
    light: NDArray[np.float32], rows: NDArray[np.int64], columns: NDArray[np.int64], near: Mask, before: Mask
) -> Mask:
    """Which (N,) of the pixels ``rows``, ``columns`` show the surface on which the objects stand.

    light: (h, w, 3) linear. near: (N,) those that count as ground; before: (N,) those close before the objects.
    """
    pictures = [np.zeros(light.shape[:2], dtype=bool) for _ in range(2)]
    for picture, values in zip(pictures, (near, before & near), strict=True):
        picture[rows, columns] = values
    surface = standing_surface(np.log(np.maximum(light, 1e-3).astype(np.float64)), *pictures)
    return surface[rows, columns] if surface.sum() >= MIN_POINTS else near


def _beside(masks: Sequence[Mask]) -> Mask:
    """Pixels (H, W) no farther from one of ``masks`` than its own size, by boxes."""
    found = np.zeros(masks[0].shape, dtype=bool)
    for mask in masks:
        if mask.any():
            window = []
            for axis in (1, 0):
                lines = np.flatnonzero(mask.any(axis=axis))
                extent = int(lines[-1] - lines[0]) + 1
                window.append(slice(max(0, int(lines[0]) - extent), int(lines[-1]) + 1 + extent))
            found[tuple(window)] = True
    return found


def _largest_side(masks: Sequence[Mask]) -> int:
    """Pixels along the longer side of the largest mask's box."""
    return max(max(int(np.ptp(i)) + 1 for i in np.nonzero(mask)) if mask.any() else 1 for mask in masks)
