# SPDX-License-Identifier: MIT
"""Splats → a closed surface around what they show: what is filled with matter and collides in their place.

Their opacity is spread onto a grid. Where it is dense is shell; what the shell keeps from the outside is inside, so a
hollow cloud of splats, as every fit to pictures leaves it, becomes solid. Small holes of the shell are closed for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from ..errors import InputError
from ..gaussians.splats import Splats

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CELLS, BORDER = 96, 14
"""Along the largest side of the box around the splats; and around it on every side, more than anything is grown."""
SEEN = 0.1
"""Opacity below which a splat shows nothing by itself."""
REST = 0.005
"""Share of the splats that may lie beyond the box to either side along each axis, and then is no part of the object."""
MARGIN = 0.15
"""By which the box around all others is grown on each side, of its largest side: what is in it is the object's."""
HAZE = 0.2
"""Of the box: splats whose scales are all above it are fog, no surface."""
BLUR = 0.6
"""Cells, standard deviation by which splats are blurred, or small ones would slip between the nodes of the grid."""
REACH = 2.5
"""Standard deviations to which a splat counts."""
DENSE = 0.5
"""Opacity, summed over splats, from which on there is shell."""
CLOSING = (0, 1, 2, 4, 6, 9)
"""Cells, radii of balls, tried in turn until the shell keeps them out: the holes that are closed are smaller."""
HOLDS = 0.25
"""Volume inside a shell over its own from which on it is said to hold water."""
PART = 0.05
"""Of the largest part's volume, from which on a separate part belongs to the object."""
LAYER, OUTER = 3.0, 0.25
"""Cells below the surface to which splats are of the outermost layer, and which share of these the surface leaves
outside: splats sit on the surface that they show."""
THINNEST = 0.5
"""Of the thickness that a sheet has on the grid, what is left of it at least."""
MOST_VERTICES = 12_000
CLEAR = 0.02
"""Cells that the surface keeps from the nodes of the grid: vertices would meet there, and triangles vanish."""
CHUNK = 4_000_000


@dataclass(frozen=True, eq=False)
class SplatSurface:
    """A closed surface. vertices: (V, 3) in the splats' coordinates; faces: (T, 3), counter-clockwise from outside.

    inside: (N,) which of the splats belong to it; the others float, or are fog.
    """

    vertices: Array
    faces: NDArray[np.int64]
    inside: Mask


@dataclass(frozen=True, eq=False)
class _Grid:
    """Nodes at first + cell · index."""

    first: Array
    cell: float
    shape: tuple[int, int, int]

    def at(self, points: Array) -> Array:
        """Indices (N, 3), with fractions, of ``points``."""
        return (points - self.first) / self.cell


def surface_of(splats: Splats, name: str, notice: Callable[[str], None]) -> SplatSurface:
    """The surface around ``splats``; ``name`` and ``notice`` are for what is said of them.

    Raises InputError when nothing of them can be seen, or they are nowhere dense enough for a body.
    """
    seen = splats.opacities >= SEEN
    if not seen.any():
        raise InputError(f"{name}: no splat has an opacity above {SEEN}; there is nothing to see in it")
    grid, core = _grid(splats, seen)
    if not core.any():
        raise InputError(f"{name}: the splats have no extent, or are all fog; export the object again")
    opacity = _density(splats.chosen(core), grid)
    solid = _largest_parts(_filled(opacity >= DENSE, name, notice), name, notice)
    depth = _depth(solid)
    at = grid.at(splats.centres[core]).T
    below = ndimage.map_coordinates(depth, at, order=1, mode="nearest")
    outermost = below[(below > 0) & (below < LAYER)]
    shift = float(np.quantile(outermost, OUTER)) if len(outermost) else 0.0
    # Sheets keep some of their thickness: their two sides are the same splats.
    thickness = ndimage.maximum_filter(depth, size=2 * int(np.ceil(shift)) + 1)
    depth = ndimage.gaussian_filter(depth - np.minimum(shift, THINNEST * np.maximum(thickness, 0)), 0.7)
    vertices, faces = _cubes(depth, grid)
    inside = np.zeros(len(splats), dtype=bool)
    inside[core] = below > -LAYER
    if len(splats) - inside.sum() > 0:
        notice(f"{name}: {len(splats) - int(inside.sum())} of {len(splats)} splats left out: afloat, fog, or too faint")
    return SplatSurface(vertices, faces, inside)


def _grid(splats: Splats, seen: Mask) -> tuple[_Grid, Mask]:
    """A grid around all but the outermost splats, and which splats (N,) it is of."""
    low, high = (np.quantile(splats.centres[seen], share, axis=0) for share in (REST, 1 - REST))
    margin = MARGIN * float((high - low).max())
    core = seen & ((splats.centres >= low - margin) & (splats.centres <= high + margin)).all(axis=1)
    core &= splats.scales.min(axis=1) <= HAZE * float((high - low).max())
    if not core.any():
        return _Grid(low, 1.0, (1, 1, 1)), core
    low, high = splats.centres[core].min(axis=0), splats.centres[core].max(axis=0)
    extent = float((high - low).max())
    if not extent > 0:
        return _Grid(low, 1.0, (1, 1, 1)), np.zeros_like(core)
    cell = extent / CELLS
    x, y, z = (np.ceil((high - low) / cell).astype(int) + 1 + 2 * BORDER).tolist()
    return _Grid(low - BORDER * cell, cell, (x, y, z)), core


def _density(splats: Splats, grid: _Grid) -> Array:
    """Opacity (x, y, z) at the nodes of ``grid``, summed over splats, blurred by ``BLUR`` cells."""
    covariances = splats.covariances() / grid.cell**2 + BLUR**2 * np.eye(3)
    middles, precisions = grid.at(splats.centres), np.linalg.inv(covariances)
    # Beyond the border nothing counts, however large a splat is.
    spread = np.sqrt(np.einsum("nii->ni", covariances).max(axis=1))
    reach = np.minimum(np.ceil(REACH * spread), 2 * BORDER).astype(int)
    found = np.zeros(int(np.prod(grid.shape)))
    for radius in np.unique(reach):
        steps = np.arange(-radius, radius + 1)
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        for rows in _chunks(np.flatnonzero(reach == radius), len(offsets)):
            nodes = np.rint(middles[rows]).astype(int)[:, None, :] + offsets
            away = nodes - middles[rows][:, None, :]
            square = np.einsum("nki,nij,nkj->nk", away, precisions[rows], away, optimize=True)
            value = splats.opacities[rows][:, None] * np.exp(-0.5 * square)
            there = ((nodes >= 0) & (nodes < grid.shape)).all(axis=2) & (square < REACH**2)
            index = np.ravel_multi_index(tuple(nodes[there].T), grid.shape)
            found += np.bincount(index, weights=value[there], minlength=len(found))
    return found.reshape(grid.shape)


def _chunks(rows: NDArray[np.intp], each: int) -> Iterator[NDArray[np.intp]]:
    size = max(1, CHUNK // each)
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


def _filled(shell: Mask, name: str, notice: Callable[[str], None]) -> Mask:
    """``shell`` with what it encloses. Its holes are closed as far as that takes."""
    if not shell.any():
        raise InputError(
            f"{name}: the splats are nowhere dense enough for a body; fit it with more, or more opaque ones"
        )
    clearance = ndimage.distance_transform_edt(~shell)
    for radius in CLOSING:
        # Where the middle of a ball from outside gets that keeps off the shell; solid is what such a ball cannot touch.
        free = ndimage.label(clearance > radius)[0]
        solid = ndimage.distance_transform_edt(free != free[0, 0, 0]) > radius
        if (solid & ~shell).sum() >= HOLDS * shell.sum():
            if radius > 1:
                notice(f"{name}: the cloud of splats has holes, which are closed to fill it")
            return np.asarray(solid | shell)
    notice(f"{name}: the splats enclose nothing to fill; the body is as thick as they are")
    return np.asarray(ndimage.binary_fill_holes(shell))


def _largest_parts(solid: Mask, name: str, notice: Callable[[str], None]) -> Mask:
    labels = ndimage.label(solid, structure=np.ones((3, 3, 3)))[0]
    volumes = np.bincount(labels.ravel())[1:]
    kept = np.flatnonzero(volumes >= PART * volumes.max()) + 1
    if len(kept) > 1:
        notice(f"{name}: it is {len(kept)} separate parts, which nothing holds together")
    return np.isin(labels, kept)


def _depth(solid: Mask) -> Array:
    """Distance (x, y, z) to the surface of ``solid`` in cells, above 0 inside."""
    inwards, outwards = ndimage.distance_transform_edt(solid), ndimage.distance_transform_edt(~solid)
    return np.asarray(ndimage.gaussian_filter(np.where(solid, inwards - 0.5, 0.5 - outwards), 0.7))


def _cubes(depth: Array, grid: _Grid) -> tuple[Array, NDArray[np.int64]]:
    """The surface depth = 0, on a coarser grid where it would have more than ``MOST_VERTICES``."""
    depth = np.maximum(depth, -2.0 * BORDER)
    vertices, faces = _cut(depth)
    scale = np.ones(3)
    if len(vertices) > MOST_VERTICES:
        coarser = ndimage.zoom(depth, np.sqrt(MOST_VERTICES / len(vertices)), order=1)
        scale = (np.array(depth.shape) - 1) / (np.array(coarser.shape) - 1)
        vertices, faces = _cut(coarser)
    points = grid.first + vertices * scale * grid.cell
    a, b, c = (points[faces[:, i]] - points.mean(axis=0) for i in range(3))
    if np.einsum("ij,ij->i", a, np.cross(b, c)).sum() < 0:
        faces = faces[:, ::-1]
    return points, faces


def _cut(depth: Array) -> tuple[Array, NDArray[np.int64]]:
    vertices, faces, _, _ = marching_cubes(np.where(np.abs(depth) < CLEAR, -CLEAR, depth), level=0.0)
    return vertices.astype(np.float64), faces.astype(np.int64)
