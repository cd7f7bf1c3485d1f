# SPDX-License-Identifier: MIT
"""A file of Gaussian splats → a scene folder: the splats, and a closed mesh around them that is filled and collides."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..composite.transfer import srgb_to_linear
from ..errors import InputError
from ..events import OnEvent, ignore
from ..gaussians.ply.read import read_splat_file
from ..gaussians.ply.write import write_splats
from ..gaussians.splats import Splats
from ..importers.splat_surface import SplatSurface, surface_of
from ..reconstruct.output import replacing_folder
from ..scene.folder import SceneFolder, load_scene, save_scene
from ..scene.model import Camera, Matrix4, Scene, SceneObject
from ..scene.names import fitting_names

Array = NDArray[np.float64]

DEFAULT_SIZE_M = 0.15
UPS = ("x", "y", "z", "x-down", "y-down", "z-down")
DEFAULT_UP = "y-down"
"""Cameras of structure from motion look along z with y down, and most fits of splats keep their axes."""
NEAREST = 8
"""Splats whose mean colour a vertex of the mesh wears."""
PICTURE = (960, 720)
FIELD_DEG = 40.0


def import_splats(
    file: Path, out: Path, *, size_m: float | None = None, up: str = DEFAULT_UP, on_event: OnEvent = ignore
) -> SceneFolder:
    """Turn the splats in the PLY ``file`` into the scene folder ``out``: one object, on the ground, without a photo.

    size_m: its largest extent in metres, 1e-4 to 1e3; None takes 0.15, for such files have no unit.
    up: the axis of the file that points up, or, with ``-down``, down; one of ``UPS``.

    Raises InputError for a file that cannot be read or shows no body, a size or axis that there is not, or where
    ``out`` holds something else than a scene.
    """
    if size_m is not None and not (math.isfinite(size_m) and 1e-4 <= size_m <= 1e3):
        raise InputError(f"size_m is {size_m!r}: give metres from 0.0001 to 1000")
    if up not in UPS:
        raise InputError(f"up is {up!r}: choose one of {', '.join(UPS)}")

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    read = read_splat_file(file)
    (name,) = fitting_names([file.stem])
    for note in read.notes:
        notice(f"{name}: {note}")
    surface = surface_of(read.splats, name, notice)
    if size_m is None:
        notice(f"{name} is taken to be {DEFAULT_SIZE_M:g} m large, the file does not say; --size sets it")
    size = size_m or DEFAULT_SIZE_M
    # About the origin, where float32 is at its finest, in which both files are.
    middle = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    surface = dataclasses.replace(surface, vertices=surface.vertices - middle)
    splats = read.splats.chosen(surface.inside)
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
        save_scene(folder, Scene(camera=_camera(size), objects=(item,), photo=None, background=None))
    return load_scene(out)


def _write_mesh(path: Path, surface: SplatSurface, splats: Splats) -> None:
    """As GLB, whose colours at vertices are linear; those of splats are not."""
    count = min(NEAREST, len(splats))
    _, near = cKDTree(splats.centres).query(surface.vertices, k=count)
    near = np.reshape(near, (-1, count))
    weights = splats.opacities[near][..., None] + 1e-6
    mean = (weights * splats.colours[near]).sum(axis=1) / weights.sum(axis=1)
    colours = np.rint(255 * srgb_to_linear(np.clip(mean, 0, 1))).astype(np.uint8)
    trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=colours, process=False).export(path)


def _on_the_ground(vertices: Array, up: str, size: float) -> Matrix4:
    """World from file: turned upright, ``size`` m large, its lowest point at the height 0 and its middle above 0, 0."""
    upwards, right = np.zeros(3), np.zeros(3)
    upwards["xyz".index(up[0])] = -1.0 if up.endswith("-down") else 1.0
    # X stays to the right where it can, so that what faced the camera faces it again.
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
    """One that sees all of an object of ``size`` m on the ground, from in front and a little above."""
    width, height = PICTURE
    focal = height / 2 / math.tan(math.radians(FIELD_DEG) / 2)
    away, pitch = 3.0 * size, math.radians(15.0)
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, -math.sin(pitch), -math.cos(pitch)])
    forward = np.cross(right, down)
    place = np.array([0.0, 0.0, size / 2]) - away * forward
    rows = np.column_stack([right, down, forward, place])
    a, b, c = ((float(w), float(x), float(y), float(z)) for w, x, y, z in rows)
    pose = (a, b, c, (0.0, 0.0, 0.0, 1.0))
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, world_from_camera=pose)
