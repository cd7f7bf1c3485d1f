# SPDX-License-Identifier: GPL-3.0-or-later
"""Colliders as the artist sees them: with their modifiers, where their animation takes them.

They get no cache, so that what they are hit with may have other vertices than their mesh.
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.atomic import replacing
from ...sim.errors import InputError
from ...sim.scene.model import Motion
from ...sim.scene.vertex_tracks import MAX_BYTES
from .animation import channels, why_it_moves
from .export_meshes import Triangles, read_corners, read_points, read_triangles
from .export_motion import rigid_motion
from .export_refusals import foreign_modifiers
from .export_units import Clock, placed

STILL_MODIFIERS = {
    "ARRAY",
    "BEVEL",
    "COLLISION",
    "DATA_TRANSFER",
    "DECIMATE",
    "EDGE_SPLIT",
    "LAPLACIANSMOOTH",
    "MASK",
    "MIRROR",
    "MULTIRES",
    "NORMAL_EDIT",
    "REMESH",
    "SCREW",
    "SIMPLE_DEFORM",
    "SKIN",
    "SMOOTH",
    "SOLIDIFY",
    "SUBSURF",
    "TRIANGULATE",
    "UV_PROJECT",
    "UV_WARP",
    "VERTEX_WEIGHT_EDIT",
    "VERTEX_WEIGHT_MIX",
    "WEIGHTED_NORMAL",
    "WELD",
    "WIREFRAME",
}
"""Kinds of modifiers that give the same at every frame, unless they are animated or look at another object."""


class Collider:
    """A collider as it is read, frame by frame.

    item: the object. moves: whether it could be elsewhere or look different at another frame. unit: in metres.
    """

    def __init__(self, item: bpy.types.Object, unit: float, clock: Clock) -> None:
        self.item = item
        self._unit, self._clock = unit, clock
        self._shown = bool(foreign_modifiers(item)) or item.data.shape_keys is not None
        self._deforms = _may_deform(item)
        self.moves = self._deforms or why_it_moves(item) is not None
        self._mesh: Triangles | None = None
        self._corners: NDArray[np.int32] | None = None
        self._matrices: list[NDArray[np.float64]] = []
        self._points: list[NDArray[np.float32]] = []

    def read(self, graph: bpy.types.Depsgraph) -> None:
        """Take in the frame that ``graph`` has evaluated."""
        evaluated = self.item.evaluated_get(graph)
        self._matrices.append(placed(evaluated.matrix_world, self._unit))
        if self._mesh is not None and not self._deforms:
            return
        if not self._shown:
            self._read_mesh(self.item.data)
            return
        mesh = evaluated.to_mesh()
        try:
            self._read_mesh(mesh)
        finally:
            evaluated.to_mesh_clear()

    def _read_mesh(self, mesh: bpy.types.Mesh) -> None:
        if self._mesh is None:
            self._mesh = read_triangles(mesh)
            self._corners = read_corners(mesh)
            self._require_room(len(mesh.vertices))
        elif len(mesh.vertices) != len(self._mesh.points) or not np.array_equal(read_corners(mesh), self._corners):
            raise InputError(
                f"object {self.item.name!r}: has other vertices or faces at frame {self._frame} than at frame "
                f"{self._clock.start}, and a collider must keep them: hide the modifier that does this in the viewport"
            )
        points = read_points(mesh)
        if len(self._matrices) > 1 and not np.isfinite(points).all():
            raise InputError(f"object {self.item.name!r}: has vertices that are nowhere at frame {self._frame}")
        self._points.append(points)

    @property
    def _frame(self) -> int:
        return self._clock.start + len(self._matrices) - 1

    def _require_room(self, vertices: int) -> None:
        if self._deforms and vertices * len(self._clock.frames) * 24 > MAX_BYTES:
            raise InputError(
                f"object {self.item.name!r}: deforms, and {vertices} vertices over {len(self._clock.frames)} frames "
                f"are more than {MAX_BYTES >> 20} MiB: simplify it (Decimate modifier), or simulate fewer frames"
            )

    @property
    def mesh(self) -> Triangles:
        """Its surface at the first frame that was read, in its own space."""
        assert self._mesh is not None
        return self._mesh

    @property
    def matrix(self) -> NDArray[np.float64]:
        """From its own space to world metres (4, 4), at the first frame that was read."""
        return self._matrices[0]

    def motion(self, root: Path, name: str) -> Motion | None:
        """How it moves, None where it does not; what deforms is written to ``name`` in the folder ``root``."""
        if len(self._matrices) < 2:
            return None
        matrices = np.stack(self._matrices)
        size = float(np.ptp(self._placed(0), axis=0).max())
        shapes = self._points if len(self._points) > 1 else []
        if all(np.array_equal(points, self.mesh.points) for points in shapes):
            whole = rigid_motion(self._clock, matrices, size)
            if whole is not None:
                return whole if whole.translations or whole.rotations else None
        vertices = np.stack([self._placed(i) for i in range(len(matrices))])
        self._require_room(vertices.shape[1])
        times = np.array([self._clock.seconds(frame) for frame in self._clock.frames])
        with replacing(root / name) as partial, partial.open("wb") as file:
            np.savez(file, times=times, vertices=vertices)
        return Motion(vertices_file=name)

    def _placed(self, index: int) -> NDArray[np.float64]:
        """Vertices (V, 3) in world metres at the frame of that index."""
        points = self._points[index if len(self._points) > 1 else 0].astype(np.float64)
        matrix = self._matrices[index]
        return points @ matrix[:3, :3].T + matrix[:3, 3]


def _may_deform(item: bpy.types.Object) -> bool:
    """Whether the shape of ``item``, in its own space, could depend on the frame."""
    data = item.data
    shape_keys = data.shape_keys
    if channels(data) or (shape_keys is not None and channels(shape_keys)):
        return True
    modifiers = foreign_modifiers(item)
    animated = any(path.startswith("modifiers[") for path, _ in channels(item))
    return bool(modifiers) and (animated or any(_looks_around(modifier) for modifier in modifiers))


def _looks_around(modifier: bpy.types.Modifier) -> bool:
    """Whether ``modifier`` depends on time or on other objects."""
    if modifier.type not in STILL_MODIFIERS:
        return True
    pointers = [p.identifier for p in modifier.bl_rna.properties if p.type == "POINTER"]
    return any(isinstance(getattr(modifier, name), bpy.types.Object) for name in pointers)
