# SPDX-License-Identifier: MIT
"""The motion of a baked object in a USD stage: poses of what stays rigid, points of everything else."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..cache.bake_folder import MESH_SPACE, Bake, BakedObject
from ..cache.pc2 import Pc2Reader
from ..errors import Cancelled
from ..events import IsCancelled
from ..rigid_alignment import nearest_pose

Array = NDArray[np.float64]
RIGID_FIT = 1e-4
"""Farthest that a vertex of a rigid body may be from the fitted pose, over its size; beyond it, points are written."""


@dataclass(frozen=True, eq=False)
class UsdObject:
    """An object in a stage. path: of its prim. shape: the prim of its mesh. vertices: (V, 3) of the mesh at rest, world
    metres; in the stage they count from ``centre`` (3,). pose: operations for translation and orientation."""

    path: str
    shape: Any
    vertices: Array
    centre: Array
    pose: tuple[Any, Any]


@dataclass(frozen=True)
class UsdMotion:
    """What ``bake`` holds of an object, as samples of a stage: time code n is frame n.

    world_from_mesh: (4, 4). cancelled: polled at each sample.
    """

    bake: Bake
    baked: BakedObject
    world_from_mesh: Array
    cancelled: IsCancelled

    def write(self, stage: Any, item: UsdObject, *, rigid: bool) -> list[str]:
        """Write the samples: of the pose of a ``rigid`` one, else of its points; return notes on what is lacking.

        Raises Cancelled.
        """
        if rigid and self._write_poses(item):
            return []
        name, notes = item.path.rsplit("/", 1)[-1], []
        if rigid:
            notes.append(f"{name} does not stay rigid in the bake: its points were written")
        self._write_points(item)
        if self.baked.points_file is not None:
            self._write_particles(stage, item, self.baked.points_file)
        if self.baked.splats:
            notes.append(f"the splats of {name} are not written")
        if self.baked.torn_file is not None:
            notes.append(f"{name} tears in the bake: the skin before the crack is written, as it stretches")
        return notes

    def _samples(self, file: str) -> Iterator[tuple[int, Array]]:
        """Frames, and the points (N, 3) of the cache ``file`` in world metres."""
        turn = self.world_from_mesh if self.baked.space == MESH_SPACE else np.eye(4)
        reader = Pc2Reader(self.bake.root / file)
        for index in range(self.bake.manifest.frames_done):
            if self.cancelled():
                raise Cancelled("export cancelled; nothing was written")
            yield self.bake.manifest.frame_start + index, reader.sample(index) @ turn[:3, :3].T + turn[:3, 3]

    def _write_poses(self, item: UsdObject) -> bool:
        """Write a pose a frame; return False, with nothing written, where the mesh does not stay rigid."""
        from pxr import Gf

        rest, poses, error = item.vertices - item.centre, [], 0.0
        for frame, points in self._samples(self.baked.file):
            rotation, shift = nearest_pose(rest, points)
            error = max(error, float(np.linalg.norm(rest @ rotation.T + shift - points, axis=1).max()))
            poses.append((frame, rotation, shift))
        if not error < RIGID_FIT * max(float(np.ptp(item.vertices, axis=0).max()), 1e-9):
            return False
        before = None
        for frame, rotation, shift in poses:
            turned = quaternion(rotation)
            # Of q and -q the one that is nearer: readers interpolate component by component.
            if before is not None and Gf.Dot(before, turned) < 0:
                turned = -turned
            before = turned
            item.pose[0].Set(Gf.Vec3d(*map(float, shift)), frame)
            item.pose[1].Set(turned, frame)
        return True

    def _write_points(self, item: UsdObject) -> None:
        from pxr import UsdGeom

        mesh = UsdGeom.Mesh(item.shape)
        for frame, points in self._samples(self.baked.file):
            local = points - item.centre
            mesh.GetPointsAttr().Set(vectors(local), frame)
            mesh.GetExtentAttr().Set(extent(local), frame)

    def _write_particles(self, stage: Any, item: UsdObject, file: str) -> None:
        from pxr import UsdGeom, Vt

        cloud = UsdGeom.Points.Define(stage, f"{item.path}/particles")
        found = None
        for frame, points in self._samples(file):
            found = points if found is None else found
            cloud.GetPointsAttr().Set(vectors(points), frame)
            cloud.GetExtentAttr().Set(extent(points), frame)
        assert found is not None
        cloud.GetPointsAttr().Set(vectors(found))
        width = 2 * (3 * _volume(item) / (4 * math.pi * len(found))) ** (1 / 3)
        cloud.CreateWidthsAttr(Vt.FloatArray([width]))
        cloud.SetWidthsInterpolation(UsdGeom.Tokens.constant)


def _volume(item: UsdObject) -> float:
    from pxr import UsdGeom

    faces = np.asarray(UsdGeom.Mesh(item.shape).GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    a, b, c = (item.vertices[faces[:, i]] for i in range(3))
    return max(abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6, 1e-12)


def vectors(points: Array) -> Any:
    """Return ``points`` (N, 3) as an attribute has them."""
    from pxr import Vt

    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))


def extent(points: Array) -> Any:
    """Return the corners of the box around ``points`` (N, 3) as an attribute has them."""
    return vectors(np.stack([points.min(axis=0), points.max(axis=0)]))


def quaternion(rotation: Array) -> Any:
    """Return ``rotation`` (3, 3) as an attribute has it."""
    from pxr import Gf
    from scipy.spatial.transform import Rotation

    x, y, z, w = map(float, Rotation.from_matrix(rotation).as_quat())
    return Gf.Quatd(w, x, y, z)
