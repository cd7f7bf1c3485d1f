# SPDX-License-Identifier: MIT
"""Which object stands on which, and at what distance from the camera.

Where the photo shows another object right below an object's foot, the foot touches that object. Scaling a body about
the camera moves nothing in the photo, so it is moved to the depth at which the ray through its foot meets its support.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.model import Camera
from ..camera.ground_camera import stands_below

Mask = NDArray[np.bool_]
Points = NDArray[np.float64]
TriangleMesh = tuple[Points, NDArray[np.int64]]

BELOW = 0.012
"""Height of the band below a foot, over the photo's longer side."""
SHARE = 0.6
"""Share of the foot's width that another object must cover below it."""
FOOT = 0.06
"""Lowest share of an object's height that is its foot."""
NEAREST = 0.2
"""Least distance of a moved body from the camera, over its distance on the ground."""


@dataclass(frozen=True)
class Support:
    """``upper`` stands on ``lower`` (indices); ``factor``: its distance from the camera over that where it was."""

    upper: int
    lower: int
    factor: float


def resting_on(seen: Sequence[Mask]) -> dict[int, int]:
    """Return, by index of an object, the index of its support: the object that the photo shows below its foot.

    seen: (H, W) visible pixels of each object. Objects on the ground, and cycles, are left out.
    """
    found: dict[int, int] = {}
    for i, mask in enumerate(seen):
        below = _below_foot(mask)
        if not below.any():
            continue
        shares = [0.0 if j == i else float((below & other).sum() / below.sum()) for j, other in enumerate(seen)]
        best = int(np.argmax(shares))
        if shares[best] >= SHARE and not _stands_on(found, best, i):
            found[i] = best
    return found


def _stands_on(found: dict[int, int], upper: int, lower: int) -> bool:
    """Whether ``upper`` stands on ``lower``, directly or indirectly."""
    while upper in found:
        upper = found[upper]
        if upper == lower:
            return True
    return False


def _below_foot(mask: Mask) -> Mask:
    """A band of pixels (H, W) right below the lowest part of ``mask``."""
    rows = np.flatnonzero(mask.any(axis=1))
    band = max(2, round(BELOW * max(mask.shape)))
    bottom = int(rows[-1]) + 1
    foot = mask[bottom - max(1, round(FOOT * len(rows))) : bottom].any(axis=0)
    result = np.zeros_like(mask)
    # Skip the seam between two objects, which mixes both.
    result[bottom + 1 : bottom + 1 + band] = foot
    return np.asarray(result & ~mask)


def place_on_supports(camera: Camera, seen: Sequence[Mask], meshes: Sequence[TriangleMesh]) -> list[Support]:
    """Return how bodies must be scaled about ``camera`` to stand on the supports that the photo shows.

    seen: (H, W); meshes: vertices (V, 3) and faces (T, 3) of all objects, standing on z = 0, or hanging where the foot
    lies above the horizon, in the camera's unit. Lower ones come first. A body whose ray misses its support stays.
    """
    on = resting_on(seen)
    factors = [1.0] * len(seen)
    placed: list[Support] = []
    for upper in sorted(on, key=lambda i: _height(on, i)):
        lower = on[upper]
        vertices = camera.position + factors[lower] * (meshes[lower][0] - camera.position)
        pixel = _foot_pixel(seen[upper])
        ray = camera.rays(pixel)
        depth = first_hit(camera.position, ray, vertices, meshes[lower][1])
        own = float(camera.project(meshes[upper][0])[:, 2].min())
        if stands_below(camera, pixel):
            factor = depth / (-camera.position[2] / ray[2])
            placeable = NEAREST < factor < 0.999
        else:
            projected = camera.project(meshes[upper][0])
            factor = depth / projected[np.linalg.norm(projected[:, :2] - pixel, axis=1).argmin(), 2]
            placeable = bool(np.isfinite(factor))
        if placeable and own > 0:
            factors[upper] = float(factor)
            placed.append(Support(upper, lower, float(factor)))
    return placed


def _height(on: dict[int, int], index: int) -> int:
    steps = 0
    while index in on:
        index, steps = on[index], steps + 1
    return steps


def _foot_pixel(mask: Mask) -> Points:
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask[rows[-1]])
    return np.array([(columns[0] + columns[-1] + 1) / 2.0, rows[-1] + 1.0])


def first_hit(origin: Points, ray: Points, vertices: Points, faces: NDArray[np.int64]) -> float:
    """Return the distance in lengths of ``ray`` (3,) from ``origin`` (3,) to the first triangle that it meets; inf for
    none.

    Möller & Trumbore, Journal of Graphics Tools 2(1), 1997.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    edge, other = b - a, c - a
    across = np.cross(ray, other)
    determinant = np.einsum("ti,ti->t", edge, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        start = origin - a
        u = np.einsum("ti,ti->t", start, across) / determinant
        turned = np.cross(start, edge)
        v = turned @ ray / determinant
        distance = np.einsum("ti,ti->t", other, turned) / determinant
        hit = (np.abs(determinant) > 1e-15) & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 1e-9)
    return float(distance[hit].min()) if hit.any() else float("inf")
