# SPDX-License-Identifier: MIT
"""The body's surface: marching cubes over pixels and depth, relaxed, carried to the world along the pixels' rays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...scene.model import Camera
from .body import NO_BASE, STABLE, Reference, references, stability
from .inflate import Silhouette
from .surface import relax, surface_of_size

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

BARE_THICKNESS = 0.8
"""Of things that are neither round nor boxes, over their widest inscribed circle: few are as deep as they are wide."""
FLAT = 0.0
"""``Reference.back`` of a body that lies all in front of its reference surface."""
GROUND_TOLERANCE_PX = 0.75
"""Vertices nearer to the ground than this are put onto it; marching cubes leaves them a little off."""


@dataclass(frozen=True)
class BodyMesh:
    """A closed triangle surface. vertices: (V, 3) world units; faces: (T, 3), counter-clockwise from outside.

    pixels: (V, 2) where the camera sees each vertex, in photo pixels. colours: (V, 2) photo pixels whose colours the
    vertices wear; None for ``pixels``.
    """

    vertices: Points
    faces: Faces
    pixels: Points
    colours: Points | None = None


class _DepthField:
    """φ(x, y, t) > 0 inside: x, y in crop pixels (centres at integers), t in pixels along the ray from the reference.

    φ = min(h² − t², 2 h_max (t_ground − t)): the inflated silhouette, cut by the ground; t / b for t behind the
    reference, where the body is b times as thick.
    """

    def __init__(self, silhouette: Silhouette, reference: Reference) -> None:
        self._square = silhouette.square_height
        height, width = self._square.shape
        rows, columns = np.mgrid[:height, :width]
        pixels = np.stack([silhouette.left + columns + 0.5, silhouette.top + rows + 0.5], axis=-1).reshape(-1, 2)
        middle, ground, rays = reference.depths(pixels)
        self.half_thickness = silhouette.half_thickness
        self._back = reference.back
        cap = 4.0 * self._back * self.half_thickness + 16.0
        with np.errstate(invalid="ignore"):
            below = (ground - middle) * np.linalg.norm(rays, axis=1) / reference.unit_per_pixel
        self._ground = np.minimum(np.nan_to_num(below, nan=cap, posinf=cap), cap).reshape(height, width)

    def sample(self, points: Points) -> tuple[Points, Points]:
        """Both sides of the minimum (n), (n) at ``points`` (n, 3) as x, y, t."""
        at = points[:, 1::-1].T
        square = ndimage.map_coordinates(self._square, at, order=1, mode="nearest")
        ground = ndimage.map_coordinates(self._ground, at, order=1, mode="nearest")
        t = points[:, 2]
        return self._film(square, t), 2.0 * self.half_thickness * (ground - t)

    def _film(self, square: Points, t: Points) -> Points:
        if self._back == FLAT:
            return np.asarray(np.minimum(square - t**2, -2.0 * self.half_thickness * t))
        return np.asarray(square - np.where(t > 0, t / self._back, t) ** 2)

    def value(self, points: Points) -> Points:
        """φ (n) at ``points`` (n, 3)."""
        film, ground = self.sample(points)
        return np.minimum(film, ground)

    def grid(self, spacing: float) -> tuple[NDArray[np.float32], Points, Points]:
        """φ on a grid (x, y, t) of ``spacing`` pixels, the grid's first corner (3,) and its spacing along each axis.

        Thin bodies get finer steps in depth, or they would slip between two layers of the grid.
        """
        steps = np.array([spacing, spacing, min(spacing, self.half_thickness / 3.0)])
        height, width = self._square.shape
        front, behind = (int(np.ceil(factor * self.half_thickness / steps[2])) + 2 for factor in (1.0, self._back))
        # Half a cell off t = 0, so that no grid node lies exactly on the surface along the outline.
        first = np.array([0.25, 0.25, -(front + 0.5) * steps[2]])
        counts = (
            int((width - 1) // spacing) + 1,
            int((height - 1) // spacing) + 1,
            front + behind + 2,
        )
        axes = [first[i] + steps[i] * np.arange(counts[i]) for i in range(3)]
        flat = np.stack(np.meshgrid(axes[0], axes[1], [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
        at = flat[:, 1::-1].T
        square = ndimage.map_coordinates(self._square, at, order=1, mode="nearest")
        ground = 2.0 * self.half_thickness * ndimage.map_coordinates(self._ground, at, order=1, mode="nearest")
        shape = (counts[0], counts[1], 1)
        t = axes[2][None, None, :]
        field = np.minimum(self._film(square.reshape(shape), t), ground.reshape(shape) - 2.0 * self.half_thickness * t)
        # A closed surface needs a border outside.
        for axis in range(3):
            edge = [slice(None)] * 3
            for end in (0, -1):
                edge[axis] = end  # type: ignore[call-overload]
                field[tuple(edge)] = np.minimum(field[tuple(edge)], -1e-3)
        field[np.abs(field) < 1e-4] = -1e-4
        return field.astype(np.float32), first, steps


def build_mesh(camera: Camera, silhouette: Silhouette, target: int = 12_000) -> tuple[BodyMesh, float]:
    """``inflated_mesh`` with a round back, without the share that floated."""
    return inflated_mesh(camera, silhouette, target)[:2]


def inflated_mesh(
    camera: Camera, silhouette: Silhouette, target: int = 12_000, *, flat: bool = False
) -> tuple[BodyMesh, float, float]:
    """The closed surface of the body with about ``target`` vertices, standing on the ground.

    Also its stability and the share of its surface that floated and was removed. Of the body's references it takes
    the first that makes it stand safely, or the best. That is judged on the surface itself: what touches the ground
    is often a narrow strip, which anything coarser would miss.

    flat: nothing behind the reference surface. Raises InputError when the silhouette is too thin for a closed surface.
    """
    best: tuple[BodyMesh, float, float] | None = None
    for reference in references(camera, silhouette):
        if flat:
            reference = replace(reference, back=FLAT)
        field = _DepthField(silhouette, reference)
        points, faces, lost = surface_of_size(field, float(silhouette.mask.sum()), target)
        body = _to_world(silhouette, reference, relax(field, points, faces), faces)
        margin = stability(body.vertices, body.faces)
        if best is None or margin > best[1]:
            best = (body, margin, lost)
        # A relief need not stand by itself, as long as it touches the ground: moved back, it would only grow.
        if margin >= STABLE or (flat and margin > NO_BASE):
            break
    assert best is not None
    return best


def bare_mesh(camera: Camera, silhouette: Silhouette, target: int = 3000) -> BodyMesh:
    """The body as its outline alone has it: neither moved back nor filled behind so that it stands safely.

    For what must be where the thing in the photo is, and need not carry it: the shadow that it casts. Raises
    InputError as ``build_mesh`` does.
    """
    thin = 1.0 if silhouette.slab else 1.0 - (1.0 - BARE_THICKNESS) * (1.0 - silhouette.roundness)
    silhouette = replace(silhouette, square_height=silhouette.square_height * thin**2)
    reference = replace(next(references(camera, silhouette)), back=1.0)
    points, faces, _ = surface_of_size(_DepthField(silhouette, reference), float(silhouette.mask.sum()), target)
    return _to_world(silhouette, reference, points, faces)


def _to_world(silhouette: Silhouette, reference: Reference, points: Points, faces: Faces) -> BodyMesh:
    pixels = points[:, :2] + np.array([silhouette.left + 0.5, silhouette.top + 0.5])
    middle, ground, rays = reference.depths(pixels)
    per_depth = reference.unit_per_pixel / np.linalg.norm(rays, axis=1)
    depth = np.maximum(middle + points[:, 2] * per_depth, 0.02 * middle)
    near_ground = np.abs(depth - ground) < GROUND_TOLERANCE_PX * per_depth
    depth = np.where(near_ground, ground, np.minimum(depth, ground))
    return standing_mesh(reference.camera, pixels, depth, faces)


def standing_mesh(camera: Camera, pixels: Points, depth: Points, faces: Faces) -> BodyMesh:
    """The closed surface with vertices at ``depth`` (V,) along the rays through ``pixels`` (V, 2), on the ground."""
    position = camera.position
    vertices = position + depth[:, None] * camera.rays(pixels)
    # Scaling about the centre of projection moves nothing in the photo: bring the lowest point onto the ground.
    lowest = float(vertices[:, 2].min())
    factor = position[2] / (position[2] - lowest)
    vertices = position + factor * (vertices - position)
    vertices[np.abs(vertices[:, 2]) < 1e-9 * position[2], 2] = 0.0
    if _volume(vertices, faces) < 0:
        faces = faces[:, ::-1].copy()
    return BodyMesh(vertices=vertices, faces=faces, pixels=pixels)


def _volume(vertices: Points, faces: Faces) -> float:
    a, b, c = (vertices[faces[:, i]] - vertices.mean(axis=0) for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
