# SPDX-License-Identifier: MIT
"""A splat file → a scene folder: the splats, and a closed mesh around them that is filled and collides in their place.

The splats' opacity is accumulated on a grid. Where it is dense is shell; what the shell separates from the outside is
inside, so a hollow cloud of splats, as every fit to images leaves it, becomes solid. Small holes of the shell are
closed for that."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from ..errors import InputError
from ..events import OnEvent, ignore
from ..gaussians.splat_ply import read_splat_file, write_splats
from ..gaussians.splats import Splats
from ..scene.folder import Scene, load_scene, save_scene
from ..scene.model import Camera, Matrix4, SceneModel, SceneObject
from ..scene.scene_output import replacing_folder
from ..srgb import srgb_to_linear
from ..validation import valid_names
from . import DEFAULT_UP_AXIS, SPLAT_UP_AXES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GRID_CELLS, GRID_BORDER = 96, 14
"""Grid cells along the longest side of the splats' bounding box; and around it, more than any dilation."""
MIN_OPACITY = 0.1
"""Opacity below which a splat is invisible by itself."""
OUTLIER_SHARE = 0.005
"""Fraction of the splats that may lie outside the box on either side along each axis, as outliers."""
BOX_MARGIN = 0.15
"""Margin added to that box on each side, relative to its longest side: splats inside belong to the object."""
MAX_SCALE_OF_BOX = 0.2
"""Relative to the box: splats whose scales are all above it are fog."""
BLUR_CELLS = 0.6
"""Standard deviation in cells by which splats are blurred, or small ones would fall between grid nodes."""
SPLAT_REACH = 2.5
"""Standard deviations at which a splat is cut off."""
SHELL_OPACITY = 0.5
"""Accumulated opacity from which a node is shell."""
CLOSING_RADII = (0, 1, 2, 4, 6, 9)
"""Radii in cells of spheres, tried in turn until the shell keeps them out: smaller holes are closed."""
MIN_ENCLOSED = 0.25
"""Enclosed volume over the shell's own from which the shell counts as closed."""
MIN_PART_VOLUME = 0.05
"""Volume relative to the largest part from which a separate part belongs to the object."""
SURFACE_LAYER, OUTER_SHARE = 3.0, 0.25
"""Depth in cells of the outermost layer of splats, and the fraction of it that the surface leaves outside: splats lie
on the surface that they show."""
MIN_THICKNESS = 0.5
"""Fraction of a sheet's thickness on the grid that is preserved."""
MAX_VERTICES = 12_000
NODE_CLEARANCE = 0.02
"""Distance in cells that the surface keeps from grid nodes, where vertices would coincide and triangles degenerate."""
CHUNK_NODES = 4_000_000


@dataclass(frozen=True, eq=False)
class SplatSurface:
    """A closed surface. vertices: (V, 3) in the splats' coordinates; faces: (T, 3), counter-clockwise from outside.

    inside: (N,) mask of the splats that belong to it; the others are floaters or fog.
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
        """Return fractional node indices (N, 3) of ``points``."""
        return (points - self.first) / self.cell


def splat_surface(splats: Splats, name: str, notice: Callable[[str], None]) -> SplatSurface:
    """Return the closed surface around ``splats``; name: for messages; notice: called with notes for the user.

    Raises InputError when no splat is visible, or they are nowhere dense enough for a body.
    """
    seen = splats.opacities >= MIN_OPACITY
    if not seen.any():
        raise InputError(f"{name}: no splat has an opacity above {MIN_OPACITY}; nothing is visible")
    grid, core = _grid(splats, seen)
    if not core.any():
        raise InputError(f"{name}: the splats have no extent or are all fog; export the object again")
    opacity = _density(splats.subset(core), grid)
    solid = _largest_parts(_fill_shell(opacity >= SHELL_OPACITY, name, notice), name, notice)
    depth = _depth(solid)
    at = grid.at(splats.centres[core]).T
    below = ndimage.map_coordinates(depth, at, order=1, mode="nearest")
    outermost = below[(below > 0) & (below < SURFACE_LAYER)]
    shift = float(np.quantile(outermost, OUTER_SHARE)) if len(outermost) else 0.0
    # Sheets keep some of their thickness, as both sides are the same splats.
    thickness = ndimage.maximum_filter(depth, size=2 * int(np.ceil(shift)) + 1)
    depth = ndimage.gaussian_filter(depth - np.minimum(shift, MIN_THICKNESS * np.maximum(thickness, 0)), 0.7)
    vertices, faces = _isosurface(depth, grid)
    inside = np.zeros(len(splats), dtype=bool)
    inside[core] = below > -SURFACE_LAYER
    if len(splats) - inside.sum() > 0:
        notice(
            f"{name}: {len(splats) - int(inside.sum())} of {len(splats)} splats left out: floaters, fog or too faint"
        )
    return SplatSurface(vertices, faces, inside)


def _grid(splats: Splats, seen: Mask) -> tuple[_Grid, Mask]:
    """Return a grid around all splats but the outliers, and the mask (N,) of those inside."""
    low, high = (np.quantile(splats.centres[seen], share, axis=0) for share in (OUTLIER_SHARE, 1 - OUTLIER_SHARE))
    margin = BOX_MARGIN * float((high - low).max())
    core = seen & ((splats.centres >= low - margin) & (splats.centres <= high + margin)).all(axis=1)
    core &= splats.scales.min(axis=1) <= MAX_SCALE_OF_BOX * float((high - low).max())
    if not core.any():
        return _Grid(low, 1.0, (1, 1, 1)), core
    low, high = splats.centres[core].min(axis=0), splats.centres[core].max(axis=0)
    extent = float((high - low).max())
    if not extent > 0:
        return _Grid(low, 1.0, (1, 1, 1)), np.zeros_like(core)
    cell = extent / GRID_CELLS
    x, y, z = (np.ceil((high - low) / cell).astype(int) + 1 + 2 * GRID_BORDER).tolist()
    return _Grid(low - GRID_BORDER * cell, cell, (x, y, z)), core


def _density(splats: Splats, grid: _Grid) -> Array:
    """Return opacity (x, y, z) accumulated at the nodes of ``grid``, blurred by ``BLUR_CELLS``."""
    covariances = splats.covariances() / grid.cell**2 + BLUR_CELLS**2 * np.eye(3)
    middles, precisions = grid.at(splats.centres), np.linalg.inv(covariances)
    # Nothing counts beyond the border, however large a splat is.
    spread = np.sqrt(np.einsum("nii->ni", covariances).max(axis=1))
    reach = np.minimum(np.ceil(SPLAT_REACH * spread), 2 * GRID_BORDER).astype(int)
    found = np.zeros(int(np.prod(grid.shape)))
    for radius in np.unique(reach):
        steps = np.arange(-radius, radius + 1)
        offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        for rows in _chunks(np.flatnonzero(reach == radius), len(offsets)):
            nodes = np.rint(middles[rows]).astype(int)[:, None, :] + offsets
            away = nodes - middles[rows][:, None, :]
            square = np.einsum("nki,nij,nkj->nk", away, precisions[rows], away, optimize=True)
            value = splats.opacities[rows][:, None] * np.exp(-0.5 * square)
            there = ((nodes >= 0) & (nodes < grid.shape)).all(axis=2) & (square < SPLAT_REACH**2)
            index = np.ravel_multi_index(tuple(nodes[there].T), grid.shape)
            found += np.bincount(index, weights=value[there], minlength=len(found))
    return found.reshape(grid.shape)


def _chunks(rows: NDArray[np.intp], each: int) -> Iterator[NDArray[np.intp]]:
    size = max(1, CHUNK_NODES // each)
    for start in range(0, len(rows), size):
        yield rows[start : start + size]


def _fill_shell(shell: Mask, name: str, notice: Callable[[str], None]) -> Mask:
    """Return ``shell`` and the region it encloses, closing holes as far as needed."""
    if not shell.any():
        raise InputError(
            f"{name}: the splats are nowhere dense enough for a body; fit the object with more or more opaque splats"
        )
    clearance = ndimage.distance_transform_edt(~shell)
    for radius in CLOSING_RADII:
        # Centres that a sphere from outside can reach without touching the shell; solid is what it cannot touch.
        free = ndimage.label(clearance > radius)[0]
        solid = ndimage.distance_transform_edt(free != free[0, 0, 0]) > radius
        if (solid & ~shell).sum() >= MIN_ENCLOSED * shell.sum():
            if radius > 1:
                notice(f"{name}: the splat cloud has holes, which are closed to fill it")
            return np.asarray(solid | shell)
    notice(f"{name}: the splats enclose no volume; the body is as thick as they are")
    return np.asarray(ndimage.binary_fill_holes(shell))


def _largest_parts(solid: Mask, name: str, notice: Callable[[str], None]) -> Mask:
    labels = ndimage.label(solid, structure=np.ones((3, 3, 3)))[0]
    volumes = np.bincount(labels.ravel())[1:]
    kept = np.flatnonzero(volumes >= MIN_PART_VOLUME * volumes.max()) + 1
    if len(kept) > 1:
        notice(f"{name}: consists of {len(kept)} separate parts that are not connected")
    return np.isin(labels, kept)


def _depth(solid: Mask) -> Array:
    """Return the distance (x, y, z) to the surface of ``solid`` in cells, positive inside."""
    inwards, outwards = ndimage.distance_transform_edt(solid), ndimage.distance_transform_edt(~solid)
    return np.asarray(ndimage.gaussian_filter(np.where(solid, inwards - 0.5, 0.5 - outwards), 0.7))


def _isosurface(depth: Array, grid: _Grid) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices and faces of the surface depth = 0, on a coarser grid above ``MAX_VERTICES`` vertices."""
    depth = np.maximum(depth, -2.0 * GRID_BORDER)
    vertices, faces = _marching_cubes(depth)
    scale = np.ones(3)
    if len(vertices) > MAX_VERTICES:
        coarser = ndimage.zoom(depth, np.sqrt(MAX_VERTICES / len(vertices)), order=1)
        scale = (np.array(depth.shape) - 1) / (np.array(coarser.shape) - 1)
        vertices, faces = _marching_cubes(coarser)
    points = grid.first + vertices * scale * grid.cell
    a, b, c = (points[faces[:, i]] - points.mean(axis=0) for i in range(3))
    if np.einsum("ij,ij->i", a, np.cross(b, c)).sum() < 0:
        faces = faces[:, ::-1]
    return points, faces


def _marching_cubes(depth: Array) -> tuple[Array, NDArray[np.int64]]:
    vertices, faces, _, _ = marching_cubes(np.where(np.abs(depth) < NODE_CLEARANCE, -NODE_CLEARANCE, depth), level=0.0)
    return vertices.astype(np.float64), faces.astype(np.int64)


DEFAULT_SIZE_M = 0.15
COLOUR_NEIGHBOURS = 8
"""Splats over which the colour of a mesh vertex is averaged."""
IMAGE_SIZE = (960, 720)
FIELD_OF_VIEW_DEG = 40.0


def import_splats(
    file: Path, *, out: Path, size_m: float | None = None, up: str = DEFAULT_UP_AXIS, on_event: OnEvent = ignore
) -> Scene:
    """Return the scene folder ``out`` made of the splats in the PLY ``file``: one object on the ground, no photo.

    size_m: its largest extent in metres, 1e-4 to 1e3; None: 0.15, because such files have no unit.
    up: the axis of the file that points up, or, with ``-down``, down; one of ``SPLAT_UP_AXES``.

    Raises InputError for a file that cannot be read or shows no body, for a size or axis out of range, and where
    ``out`` holds anything but a scene.
    """
    if size_m is not None and not (math.isfinite(size_m) and 1e-4 <= size_m <= 1e3):
        raise InputError(f"size_m is {size_m!r}: give metres from 0.0001 to 1000")
    if up not in SPLAT_UP_AXES:
        raise InputError(f"up is {up!r}: choose one of {', '.join(SPLAT_UP_AXES)}")

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    read = read_splat_file(file)
    (name,) = valid_names([file.stem])
    for note in read.notes:
        notice(f"{name}: {note}")
    surface = splat_surface(read.splats, name, notice)
    if size_m is None:
        notice(f"{name} is assumed to be {DEFAULT_SIZE_M:g} m large, because the file gives no size; --size sets it")
    size = size_m or DEFAULT_SIZE_M
    # Centred on the origin, where float32, which both files use, is most precise.
    middle = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    surface = dataclasses.replace(surface, vertices=surface.vertices - middle)
    splats = read.splats.subset(surface.inside)
    splats = splats.changed(centres=splats.centres - middle)
    with replacing_folder(out) as folder:
        (folder / "meshes").mkdir()
        _write_mesh(folder / "meshes" / f"{name}.glb", surface, splats)
        write_splats(folder / "splats" / f"{name}.ply", splats)
        item = SceneObject(
            name=name,
            mesh=f"meshes/{name}.glb",
            splats=f"splats/{name}.ply",
            world_from_mesh=_on_the_ground(surface.vertices, up, size),
            size_m=size,
        )
        save_scene(folder, SceneModel(camera=_camera(size), objects=(item,), photo=None, background=None))
    return load_scene(out)


def _write_mesh(path: Path, surface: SplatSurface, splats: Splats) -> None:
    """Write the surface as GLB with vertex colours, which are linear; those of splats are sRGB."""
    count = min(COLOUR_NEIGHBOURS, len(splats))
    _, near = cKDTree(splats.centres).query(surface.vertices, k=count)
    near = np.reshape(near, (-1, count))
    weights = splats.opacities[near][..., None] + 1e-6
    mean = (weights * splats.colours[near]).sum(axis=1) / weights.sum(axis=1)
    colours = np.rint(255 * srgb_to_linear(np.clip(mean, 0, 1))).astype(np.uint8)
    trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=colours, process=False).export(path)


def _on_the_ground(vertices: Array, up: str, size: float) -> Matrix4:
    """Return world from file: upright, ``size`` m large, lowest point at height 0, centred above 0, 0."""
    upwards, right = np.zeros(3), np.zeros(3)
    upwards["xyz".index(up[0])] = -1.0 if up.endswith("-down") else 1.0
    # X stays to the right where possible, so that the front keeps facing the camera.
    right[1 if up.startswith("x") else 0] = 1.0
    turn = np.stack([right, np.cross(upwards, right), upwards])
    turned = vertices @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    scale = size / float((high - low).max())
    shift = -scale * np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    rows = np.column_stack([scale * turn, shift])
    a, b, c = ((float(w), float(x), float(y), float(z)) for w, x, y, z in rows)
    return a, b, c, (0.0, 0.0, 0.0, 1.0)


def _camera(size: float) -> Camera:
    """Return a camera that sees an object of ``size`` m on the ground from the front and slightly above."""
    width, height = IMAGE_SIZE
    focal = height / 2 / math.tan(math.radians(FIELD_OF_VIEW_DEG) / 2)
    away, pitch = 3.0 * size, math.radians(15.0)
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, -math.sin(pitch), -math.cos(pitch)])
    forward = np.cross(right, down)
    place = np.array([0.0, 0.0, size / 2]) - away * forward
    rows = np.column_stack([right, down, forward, place])
    a, b, c = ((float(w), float(x), float(y), float(z)) for w, x, y, z in rows)
    pose = (a, b, c, (0.0, 0.0, 0.0, 1.0))
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, world_from_camera=pose)
