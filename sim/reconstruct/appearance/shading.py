# SPDX-License-Identifier: MIT
"""How bright a white matt surface would be: irradiance over π of sky, sun and ground, with what hides them.

What is not hidden of the sky is summed over its whole map; the hidden part is known in ``LATTICE`` directions, as the
ratio to the same sum over them without anything in the way. In hidden directions the surface sees other surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...scene.equirectangular import directions
from ..light.cast import surface_points
from .around import summed_around
from .occlusion import CELLS, Occluders
from .surroundings import Surroundings, lattice, sun_points

Points = NDArray[np.float64]
Mesh = tuple[Points, NDArray[np.integer]]

POINTS_A_CELL, POINTS = 4.0, (4000, 200_000)
"""On each surface, for the depth maps."""
PATCH = 20
"""Points along a side of the ground that is looked at."""
PATCH_REACH = 2.5
"""Of it, beyond the object, over the object's largest extent."""


@dataclass(frozen=True, eq=False)
class Shading:
    """At N points. ambient: (N, 3) by sky, ground and other surfaces; sun: (N,). reached: (N,) 0 to 1 of the sun's
    light past what is in the way, before the cosine; openness: (N,) 0 to 1 of the sky and the ground in view.
    """

    ambient: Points
    sun: NDArray[np.float64]
    reached: NDArray[np.float64]
    openness: NDArray[np.float64]

    @property
    def total(self) -> Points:
        """Brightness (N, 3) of a white matt surface."""
        return self.ambient + self.sun[:, None]


def shade(
    scene: Surroundings,
    points: Points,
    normals: Points,
    own: Mesh,
    others: Sequence[Mesh],
    surface_colour: Points,
) -> Shading:
    """The light at ``points`` (N, 3) with unit ``normals`` (N, 3) on the surface ``own`` among ``others``.

    surface_colour: (3,) albedo that is taken for all surfaces which give back light.
    """
    extent = float(np.ptp(own[0], axis=0).max())
    solid = np.concatenate([_dense(mesh, extent / CELLS) for mesh in (own, *others)])
    occluders = Occluders(solid, points, normals)
    towards = lattice()
    sky = _gathered(scene.sky, towards)
    patch = _GroundPatch(scene, own[0].mean(axis=0), extent * PATCH_REACH, solid, towards, sky)
    unoccluded, seen_light = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    bounced, hidden = np.zeros((len(points), 3)), np.zeros(len(points))
    for direction, light in zip(towards, sky, strict=True):
        cosine = np.maximum(normals @ direction, 0.0) * (4.0 / len(towards))
        reached = occluders.reached(direction)
        hidden += cosine * (1.0 - reached)
        if direction[2] > 0:
            unoccluded += cosine[:, None] * light
            seen_light += (cosine * reached)[:, None] * light
        else:
            bounced += (cosine * reached)[:, None] * patch.radiance(points, direction)
    exact = _sky_irradiance(scene.sky, normals)
    ratio = np.where(unoccluded > 1e-6, seen_light / np.maximum(unoccluded, 1e-6), 1.0)
    sun, reached_sun = np.zeros(len(points)), np.zeros(len(points))
    if scene.sun is not None:
        disc = sun_points(scene)
        for direction in disc:
            reached = occluders.reached(direction) / len(disc)
            reached_sun += reached
            sun += scene.sun_radiance * reached * np.maximum(normals @ direction, 0.0)
    direct = exact * np.minimum(ratio, 1.0) + bounced
    usual = float(np.median((direct + sun[:, None]).mean(axis=1)))
    ambient = direct + hidden[:, None] * surface_colour * usual
    return Shading(ambient, sun, reached_sun, np.clip(1.0 - hidden, 0.0, 1.0))


def _dense(mesh: Mesh, cell: float) -> Points:
    """Points over ``mesh``, several in each square of side ``cell``, or light would fall through it."""
    a, b, c = (mesh[0][mesh[1][:, corner]] for corner in range(3))
    area = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2.0
    count = np.clip(POINTS_A_CELL * area / max(cell, 1e-12) ** 2, *POINTS)
    return surface_points(*mesh, count=int(count))


def _gathered(sky: NDArray[np.float64], towards: Points) -> Points:
    """Mean radiance (D, 3) of ``sky`` in the part of the sphere around each of ``towards`` (D, 3); no light is lost."""
    pixels, solid = directions(*sky.shape[:2])
    nearest = np.argmax(pixels.reshape(-1, 3) @ towards.T, axis=1)
    result = np.zeros((len(towards), 3))
    np.add.at(result, nearest, (sky * solid[..., None]).reshape(-1, 3))
    return result / (4 * np.pi / len(towards))


def _sky_irradiance(sky: NDArray[np.float64], normals: Points) -> Points:
    """Irradiance over π (N, 3) by ``sky`` alone at unit ``normals`` (N, 3), through a map over all normals."""
    table = summed_around(sky, lambda cosine: np.maximum(cosine, 0.0) / np.pi)
    return looked_up(table, normals)


def looked_up(table: NDArray[np.float64], towards: Points) -> Points:
    """``table`` (H, 2 H, 3), equirectangular, in the unit vectors ``towards`` (N, 3), bilinear."""
    height, width = table.shape[:2]
    around = np.concatenate([table[:, -1:], table, table[:, :1]], axis=1).astype(np.float32)
    column = (0.5 - np.arctan2(towards[:, 1], towards[:, 0]) / (2 * np.pi)) * width + 0.5
    row = (0.5 - np.arcsin(np.clip(towards[:, 2], -1, 1)) / np.pi) * height - 0.5
    return remapped(around, column, row)


def remapped(picture: NDArray[np.float32], column: NDArray[np.float64], row: NDArray[np.float64]) -> Points:
    """``picture`` (H, W, C) at pixel indices (N,), bilinear. OpenCV allows at most 32767 of them a row."""
    count, columns = len(column), 1024
    padded = -(-max(count, 1) // columns) * columns
    x, y = (np.pad(v.astype(np.float32), (0, padded - count)).reshape(-1, columns) for v in (column, row))
    found = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float64).reshape(padded, -1)[:count]


class _GroundPatch:
    """The ground around an object, darker where objects stand in its light."""

    def __init__(
        self, scene: Surroundings, middle: Points, reach: float, solid: Points, towards: Points, sky: Points
    ) -> None:
        self._scene, self._low, self._step = scene, middle[:2] - reach, 2 * reach / (PATCH - 1)
        steps = np.arange(PATCH) * self._step
        x, y = np.meshgrid(self._low[0] + steps, self._low[1] + steps)
        places = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        up = np.broadcast_to((0.0, 0.0, 1.0), places.shape)
        above = Occluders(solid, places, up)
        upper = towards[:, 2] > 0
        total, found = np.zeros(3), np.zeros((len(places), 3))
        for direction, light in zip(towards[upper], sky[upper], strict=True):
            total += light * direction[2]
            found += above.reached(direction)[:, None] * light * direction[2]
        sky_share = float((_sky_irradiance(scene.sky, np.array([[0.0, 0.0, 1.0]]))).mean())
        light_here = found / np.maximum(total, 1e-9) * sky_share
        if scene.sun is not None:
            disc = sun_points(scene)
            for direction in disc:
                reached = above.reached(direction) * max(float(direction[2]), 0.0)
                light_here += scene.sun_radiance * reached[:, None] / len(disc)
        self._light = np.asarray(light_here * scene.ground, dtype=np.float32).reshape(PATCH, PATCH, 3)

    def radiance(self, points: Points, direction: Points) -> Points:
        """RGB (N, 3) of the ground where rays from ``points`` (N, 3) along ``direction`` (3,), downward, meet it."""
        far = np.maximum(points[:, 2], 0.0) / max(-float(direction[2]), 1e-3)
        at = (points[:, :2] + far[:, None] * direction[:2] - self._low) / self._step
        inside = ((at >= 0) & (at <= PATCH - 1)).all(axis=1)
        return np.where(inside[:, None], remapped(self._light, at[:, 0], at[:, 1]), self._scene.ground_radiance)
