# SPDX-License-Identifier: GPL-3.0-or-later
"""How far objects reach in the world, in Blender's units."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from .export_meshes import read_points


def box_corners(item: bpy.types.Object) -> NDArray[np.float64]:
    """Corners (8, 3) of the box around ``item`` along its own axes, as it is seen."""
    return np.array([item.matrix_world @ Vector(corner) for corner in item.bound_box])


def rest_bounds(item: bpy.types.Object) -> tuple[Vector, Vector]:
    """Lowest and highest corner of the mesh as it is before its modifiers, a bake's among them."""
    points = read_points(item.data)
    matrix = np.asarray(item.matrix_world)
    world = (points if len(points) else np.zeros((1, 3))) @ matrix[:3, :3].T + matrix[:3, 3]
    return Vector(world.min(axis=0)), Vector(world.max(axis=0))
