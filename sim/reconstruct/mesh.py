# SPDX-License-Identifier: MIT
"""The body's surface: marching cubes over pixels and depth, relaxed, carried to the world along the pixels' rays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from skimage.measure import marching_cubes

from ..errors import InputError
from ..scene.model import Camera
from .body import STABLE, Reference, references, stability
from .inflate import Silhouette

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

RELAXATION_ROUNDS = 6
BARE_THICKNESS = 0.8
"""Of things that are neither round nor boxes, over their widest inscribed circle: few are as deep as they are wide."""
GROUND_TOLERANCE_PX = 0.75
"""Vertices nearer to the ground than this are put onto it; marching cubes leaves them a little off."""


@dataclass(frozen=True)
class BodyMesh:
    """A closed triangle surface. vertices: (V, 3) world units; faces: (T, 3), counter-clockwise from outside.

    pixels: (V, 2) where the camera sees each vertex, in photo pixels.
    """

    vertices: Points
    faces: Faces
    pixels: Points


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
        return square - self._squared(t), 2.0 * self.half_thickness * (ground - t)

    def _squared(self, t: Points) -> Points:
        return np.asarray(np.where(t > 0, t / self._back, t) ** 2)

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
        film, ground = self.sample(flat)
        shape = (counts[0], counts[1], 1)
        t = axes[2][None, None, :]
        field = np.minimum(
            film.reshape(shape) - self._squared(t), ground.reshape(shape) - 2.0 * self.half_thickness * t
        )
        # A closed surface needs a border outside.
        for axis in range(3):
            edge = [slice(None)] * 3
            for end in (0, -1):
                edge[axis] = end  # type: ignore[call-overload]
                field[tuple(edge)] = np.minimum(field[tuple(edge)], -1e-3)
        field[np.abs(field) < 1e-4] = -1e-4
        return field.astype(np.float32), first, steps


def build_mesh(camera: Camera, silhouette: Silhouette, target: int = 12_000) -> tuple[BodyMesh, float]:
    """The closed surface of the body with about ``target`` vertices, standing on the ground, and its stability.

    Of the body's references it takes the first that makes it stand safely, or the best. That is judged on the surface
    itself: what touches the ground is often a narrow strip, which anything coarser would miss.

    Raises InputError when the silhouette is too thin for any closed surface.
    """
    best: tuple[BodyMesh, float] | None = None
    for reference in references(camera, silhouette):
        field = _DepthField(silhouette, reference)
        points, faces = _surface_of_size(field, silhouette, target)
        body = _to_world(silhouette, reference, _relax(field, points, faces), faces)
        margin = stability(body.vertices, body.faces)
        if best is None or margin > best[1]:
            best = (body, margin)
        if margin >= STABLE:
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
    points, faces = _surface_of_size(_DepthField(silhouette, reference), silhouette, target)
    return _to_world(silhouette, reference, points, faces)


def _surface_of_size(field: _DepthField, silhouette: Silhouette, target: int) -> tuple[Points, Faces]:
    """The surface on a grid that gives about ``target`` vertices."""
    # A round body has 2.6 vertices a cell, front and back.
    spacing = max(0.5, float(np.sqrt(2.6 * silhouette.mask.sum() / target)))
    for _ in range(3):
        points, faces = _surface(field, spacing)
        ratio = len(points) / target
        finer = max(0.5, spacing * np.sqrt(ratio))
        if 0.8 < ratio < 1.25 or abs(finer / spacing - 1.0) < 0.05:
            break
        spacing = finer
    return points, faces


def _surface(field: _DepthField, spacing: float) -> tuple[Points, Faces]:
    grid, first, steps = field.grid(spacing)
    if not (grid > 0).any():
        raise InputError("the outline is too thin for a body; draw the box around a larger object")
    vertices, faces, _, _ = marching_cubes(grid, level=0.0, method="lewiner", allow_degenerate=True)
    points = first + vertices.astype(np.float64) * steps
    return _largest_part(points, faces.astype(np.int64))


def _largest_part(points: Points, faces: Faces) -> tuple[Points, Faces]:
    """The connected part with most faces, its vertices renumbered in order."""
    count = len(points)
    ends = faces[:, [0, 1, 2, 1]].reshape(-1, 2)
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    parts, labels = sparse.csgraph.connected_components(links, directed=False)
    if parts > 1:
        keep = np.argmax(np.bincount(labels[faces[:, 0]], minlength=parts))
        faces = faces[labels[faces[:, 0]] == keep]
    used, renumbered = np.unique(faces, return_inverse=True)
    return points[used], renumbered.reshape(faces.shape)


def _relax(field: _DepthField, points: Points, faces: Faces) -> Points:
    """Even out the triangles without leaving the surface: slide towards the neighbours' mean, then back onto φ = 0.

    Vertices at the edge between base and body, and their neighbours, stay: sliding would round the edge.
    """
    count = len(points)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count)).tocsr()
    links = ((links + links.T) > 0).astype(np.float64)
    mean = sparse.diags(1.0 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)) @ links
    film, ground = field.sample(points)
    on_base = (ground < film).astype(np.float64)
    share = mean @ on_base
    free = (np.abs(share - on_base) < 1e-9)[:, None]
    for _ in range(RELAXATION_ROUNDS):
        gradient = _gradient(field, points)
        normal = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        move = mean @ points - points
        move -= (move * normal).sum(axis=1, keepdims=True) * normal
        moved = points + 0.5 * np.where(free, move, 0.0)
        for _ in range(2):
            gradient = _gradient(field, moved)
            step = field.value(moved)[:, None] * gradient / np.maximum((gradient**2).sum(axis=1, keepdims=True), 1e-9)
            length = np.linalg.norm(step, axis=1, keepdims=True)
            moved = moved - np.where(free, step * np.minimum(1.0, 1.0 / np.maximum(length, 1e-12)), 0.0)
        points = moved
    return points


def _gradient(field: _DepthField, points: Points, step: float = 0.5) -> Points:
    result = np.empty_like(points)
    for axis in range(3):
        offset = np.zeros(3)
        offset[axis] = step
        result[:, axis] = (field.value(points + offset) - field.value(points - offset)) / (2.0 * step)
    return result


def _to_world(silhouette: Silhouette, reference: Reference, points: Points, faces: Faces) -> BodyMesh:
    pixels = points[:, :2] + np.array([silhouette.left + 0.5, silhouette.top + 0.5])
    middle, ground, rays = reference.depths(pixels)
    per_depth = reference.unit_per_pixel / np.linalg.norm(rays, axis=1)
    depth = np.maximum(middle + points[:, 2] * per_depth, 0.02 * middle)
    near_ground = np.abs(depth - ground) < GROUND_TOLERANCE_PX * per_depth
    depth = np.where(near_ground, ground, np.minimum(depth, ground))
    position = reference.camera.position
    vertices = position + depth[:, None] * rays
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
