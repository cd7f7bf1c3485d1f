# SPDX-License-Identifier: MIT
"""The ground around the objects as the photo shows it: where its points are, how bright, and how open to the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...composite.transfer import bytes_to_linear
from ...scene.model import Camera, Ground
from .cast import Caster, even_sky, surface_points
from .ground_light import smooth_terms

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
Mesh = tuple[Points, NDArray[np.integer]]

OBJECT_SIDE, LONGEST_SIDE = 110, 1600
"""Pixels that the largest object has in the picture in which shadows are compared, and the most that it has itself."""
MAX_POINTS = 7000
MIN_POINTS = 300
REACH = 2.8
"""How far around an object the ground is looked at, over its height: the shadow of a sun 20° high."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True)
class GroundView:
    """Points of the ground that the photo shows.

    caster: shadows at them. brightness: (N,) natural logarithm of the luminance. terms: (N, 6), ``smooth_terms``.
    sky: (N,) share of the environment's light that reaches them past the objects. rows, columns: (N,) where they are
    in a picture of ``size`` (width, height).
    """

    caster: Caster
    brightness: Points
    terms: Points
    sky: Points
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    size: tuple[int, int]


def ground_axes(ground: Ground) -> Points:
    """Rows: two unit vectors along the ground, and its normal."""
    normal = ground.unit_normal
    helper = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.9 else np.array([0.0, 0.0, -1.0])
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first), normal])


def look_at_ground(
    camera: Camera,
    ground: Ground,
    pixels: NDArray[np.uint8],
    masks: Sequence[Mask],
    meshes: Sequence[tuple[Points, NDArray[np.integer]]],
    sky: tuple[Points, Points] | None,
) -> GroundView | None:
    """What the photo ``pixels`` (H, W, 3) sRGB shows of the ground around objects, or None when that is too little.

    Arguments as for ``sun.estimate_sun``.
    """
    axes, origin = ground_axes(ground), np.asarray(ground.point, dtype=np.float64)
    surfaces = [(surface_points(vertices, faces) - origin) @ axes.T for vertices, faces in meshes]
    height, width = pixels.shape[:2]
    shrink = min(1.0, OBJECT_SIDE / _largest_side(masks), LONGEST_SIDE / max(width, height))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    linear = bytes_to_linear(pixels)
    clipped = (pixels.max(axis=2) >= 254) | (pixels.max(axis=2) <= 2)
    luminance = cv2.resize(linear @ LUMINANCE, size, interpolation=cv2.INTER_AREA)
    objects = np.logical_or.reduce(masks) | (cv2.erode(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    covered = cv2.resize(objects.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    # Pixels along an outline are mixtures of object and ground.
    covered = cv2.dilate(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    rows, columns = np.nonzero(~covered & (luminance > 1e-4))
    seen = np.column_stack([(columns + 0.5) * width / size[0], (rows + 0.5) * height / size[1]])
    rays = camera.rays(seen) @ axes.T
    eye = (camera.position - origin) @ axes.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[:, 2] < -1e-9, -eye[2] / rays[:, 2], np.nan)
        flat = eye[:2] + depth[:, None] * rays[:, :2]
    near = np.zeros(len(flat), dtype=bool)
    for surface in surfaces:
        low, high = surface[:, :2].min(axis=0), surface[:, :2].max(axis=0)
        tall = max(float(surface[:, 2].max()), 1e-9)
        with np.errstate(invalid="ignore"):
            outside = np.linalg.norm(np.maximum(np.maximum(low - flat, flat - high), 0.0), axis=1)
            near |= outside < REACH * tall
    if near.sum() < MIN_POINTS:
        return None
    index = np.flatnonzero(near)
    if len(index) > MAX_POINTS:
        index = np.random.default_rng(0).choice(index, MAX_POINTS, replace=False)
    points = flat[index]
    caster = Caster(surfaces, points)
    brightness = np.log(luminance[rows[index], columns[index]].astype(np.float64))
    above = caster.reaching(*(sky or even_sky()))
    return GroundView(
        caster=caster,
        brightness=brightness,
        terms=smooth_terms(points),
        sky=above,
        rows=rows[index],
        columns=columns[index],
        size=size,
    )


def _largest_side(masks: Sequence[Mask]) -> int:
    """Pixels along the longer side of the largest mask's box."""
    return max(max(int(np.ptp(i)) + 1 for i in np.nonzero(mask)) if mask.any() else 1 for mask in masks)
