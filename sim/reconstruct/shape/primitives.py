# SPDX-License-Identifier: MIT
"""Boxes, balls and bodies of revolution that rest on the ground z = 0: their outlines, and what is inside them.

World axes: Z up. ``inside`` is open below, so that the ground itself cuts the base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from .outline import hull_polygon

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

CIRCLE = 48
"""Points on a circle whose hull stands for it; the area misses 0.3 %."""
FINER = 4
SUNK = 0.01
"""How far a ball is sunk into the ground, over its radius: it rests on a small disc instead of on a point."""


class Primitive(Protocol):
    """A body with few numbers. ``name`` is its shape's name."""

    @property
    def name(self) -> str:
        """``box``, ``cylinder`` or ``sphere``."""

    @property
    def height(self) -> float:
        """Of its top above the ground."""

    @property
    def centre(self) -> Points:
        """(3,) its middle."""

    @property
    def least_extent(self) -> float:
        """Its smallest extent."""

    def pieces(self, camera: Camera) -> list[Points]:
        """Points (n, 3) of convex pieces: the union of the pieces' hulls, projected, is the outline."""

    def inside(self, points: Points, rounding: float) -> Points:
        """Distance (n,) from the surface at ``points`` (n, 3), positive inside; edges rounded by ``rounding``."""


def soft_min(first: Points, second: Points, width: float) -> Points:
    """A smooth minimum that never exceeds either and is the smaller one where they differ by ``width`` or more."""
    blend = np.clip(1.0 - np.abs(first - second) / max(width, 1e-12), 0.0, 1.0)
    return np.minimum(first, second) - blend**2 * width / 4.0


@dataclass(frozen=True)
class Box:
    """Upright; x, y: middle of its base; yaw: radians about Z of its width's direction; width, depth, height."""

    x: float
    y: float
    yaw: float
    width: float
    depth: float
    height: float
    name: str = "box"

    @property
    def centre(self) -> Points:
        """(3,) its middle."""
        return np.array([self.x, self.y, self.height / 2.0])

    @property
    def least_extent(self) -> float:
        """Its smallest extent."""
        return min(self.width, self.depth, self.height)

    @property
    def axes(self) -> tuple[Points, Points]:
        """Unit vectors (2,) of width and depth in the ground."""
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([cosine, sine]), np.array([-sine, cosine])

    def corners(self) -> Points:
        """(8, 3): index bits 1, 2, 4 are the far end of width, depth and height."""
        across, along = self.axes
        bits = np.arange(8)
        u = ((bits & 1) - 0.5) * self.width
        v = ((bits >> 1 & 1) - 0.5) * self.depth
        ground = np.array([self.x, self.y]) + u[:, None] * across + v[:, None] * along
        return np.column_stack([ground, (bits >> 2) * self.height])

    def pieces(self, camera: Camera) -> list[Points]:
        """Its corners."""
        return [self.corners()]

    def inside(self, points: Points, rounding: float) -> Points:
        """Distance from the nearest face, soft where two are equally near."""
        across, along = self.axes
        offset = points[:, :2] - np.array([self.x, self.y])
        sides = soft_min(
            self.width / 2.0 - np.abs(offset @ across), self.depth / 2.0 - np.abs(offset @ along), rounding
        )
        return soft_min(sides, self.height - points[:, 2], rounding)


@dataclass(frozen=True)
class Sphere:
    """A ball; x, y: where it touches the ground; squash: height over width, 0.8 of a mandarin."""

    x: float
    y: float
    radius: float
    squash: float = 1.0
    name: str = "sphere"

    @property
    def centre(self) -> Points:
        """(3,) its middle."""
        return np.array([self.x, self.y, self.squash * self.radius * (1.0 - SUNK)])

    @property
    def height(self) -> float:
        """Of its top."""
        return self.squash * self.radius * (2.0 - SUNK)

    @property
    def least_extent(self) -> float:
        """Its smallest diameter."""
        return 2.0 * self.radius * min(1.0, self.squash)

    @property
    def axes(self) -> Points:
        """Semi-axes (3,)."""
        return self.radius * np.array([1.0, 1.0, self.squash])

    def pieces(self, camera: Camera) -> list[Points]:
        """The ellipse in which the cone of sight touches it."""
        # In units of its semi-axes it is a ball of radius 1, and lines stay lines.
        towards = (self.centre - camera.position) / self.axes
        distance = float(np.linalg.norm(towards))
        axis = towards / distance
        sine = min(1.0 / distance, 0.999)
        first = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(axis, first)
        turn = 2.0 * np.pi * np.arange(CIRCLE) / CIRCLE
        ring = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        return [self.centre + self.axes * (ring * np.sqrt(1.0 - sine**2) - axis * sine)]

    def inside(self, points: Points, rounding: float) -> Points:
        """Distance from the surface; exact on it."""
        scaled = (points - self.centre) / self.axes
        length = np.linalg.norm(scaled, axis=1)
        slope = np.linalg.norm(scaled / self.axes, axis=1) / np.maximum(length, 1e-12)
        return (1.0 - length) / np.maximum(slope, 1e-12)


@dataclass(frozen=True)
class Revolved:
    """A body of revolution about the vertical through x, y: a cylinder has two equal radii.

    heights: rising from 0; radii: at these, linear between; at least two, all above zero but the last.
    """

    x: float
    y: float
    heights: tuple[float, ...]
    radii: tuple[float, ...]
    name: str = "cylinder"

    @property
    def centre(self) -> Points:
        """(3,) the middle of its axis."""
        return np.array([self.x, self.y, self.height / 2.0])

    @property
    def height(self) -> float:
        """Of its top."""
        return self.heights[-1]

    @property
    def least_extent(self) -> float:
        """Its height or its largest diameter."""
        return min(self.height, 2.0 * max(self.radii))

    def circle(self, height: float, radius: float) -> Points:
        """Points (CIRCLE, 3) around the axis."""
        turn = 2.0 * np.pi * np.arange(CIRCLE) / CIRCLE
        # A polygon with the circle's area stands for it better than the inscribed one.
        wide = radius * np.sqrt(2.0 * np.pi / CIRCLE / np.sin(2.0 * np.pi / CIRCLE))
        return np.column_stack([self.x + wide * np.cos(turn), self.y + wide * np.sin(turn), np.full(CIRCLE, height)])

    def pieces(self, camera: Camera) -> list[Points]:
        """One frustum between every two heights."""
        rings = [self.circle(h, r) for h, r in zip(self.heights, self.radii, strict=True)]
        return [np.concatenate(pair) for pair in pairwise(rings)]

    def inside(self, points: Points, rounding: float) -> Points:
        """Distance from the mantle or the top, soft where both are equally near."""
        heights, radii = np.array(self.heights), np.array(self.radii)
        slopes = np.diff(radii) / np.maximum(np.diff(heights), 1e-12)
        z = points[:, 2]
        rho = np.hypot(points[:, 0] - self.x, points[:, 1] - self.y)
        radius = np.interp(z, heights, radii)
        radius += np.where(z < 0, slopes[0] * z, 0.0) + np.where(z > self.height, slopes[-1] * (z - self.height), 0.0)
        middles = (heights[1:] + heights[:-1]) / 2.0
        slope = np.interp(z, middles, slopes)
        return soft_min((radius - rho) / np.sqrt(1.0 + slope**2), self.height - z, rounding)


def drawn(primitive: Primitive, camera: Camera, shape: tuple[int, int], left: float, top: float) -> Mask:
    """The primitive's outline as a mask of ``shape`` (h, w) whose first pixel is at ``left``, ``top`` in the photo."""
    # OpenCV also fills the pixels that the border touches: drawn finer, that is an eighth of a pixel.
    image = np.zeros((shape[0] * FINER, shape[1] * FINER), np.uint8)
    for polygon in polygons(primitive, camera):
        corners = np.round(((polygon - [left, top]) * FINER - 0.5) * 16).clip(-(2**30), 2**30).astype(np.int32)
        cv2.fillConvexPoly(image, corners, 255, shift=4)
    return np.asarray(cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA) > 127)


def polygons(primitive: Primitive, camera: Camera) -> Sequence[Points]:
    """Convex polygons (m, 2) in photo pixels whose union is the primitive's outline; () when it reaches behind us."""
    result = []
    for piece in primitive.pieces(camera):
        projected = camera.project(piece)
        if not (projected[:, 2] > 1e-6).all():
            return ()
        result.append(hull_polygon(projected[:, :2]))
    return result
