# SPDX-License-Identifier: MIT
"""The camera is not where it was assumed to be.

Equation: X = R (X' - p) + p + d for the camera's axes and place X' in world coordinates, R the rotation by the vector
    ``rotation`` (angle times axis, world axes) about the pivot p.
Source: Hartley and Zisserman, Multiple View Geometry in Computer Vision (2004), chapter 6; Rodrigues (1840) for R.
Bodies: none; a world stays as it is, see ``true_camera``.
Twice: movements follow each other.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .schema import Effect, Values, leave, vector, vector_parameters


def true_camera(
    values: Values, world_from_camera: NDArray[np.float64], *, pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> NDArray[np.float64]:
    """Return the true pose of the camera: the assumed ``world_from_camera`` (4, 4), moved.

    pivot: world point about which ``rotation`` turns. One among the points seen, such as their mean, keeps rotation and
        shift from standing in for each other.
    """
    # Late, so that listing the effects, as Blender does when it starts, loads no scipy.
    from scipy.spatial.transform import Rotation

    complete = EFFECT.checked(values)
    moved = np.array(world_from_camera, dtype=np.float64)
    rotation = Rotation.from_rotvec(vector(complete, "rotation")).as_matrix()
    moved[:3, :3] = rotation @ moved[:3, :3]
    moved[:3, 3] = rotation @ (moved[:3, 3] - pivot) + pivot + vector(complete, "shift")
    return moved


NEUTRAL = {f"{prefix}_{axis}": 0.0 for prefix in ("rotation", "shift") for axis in "xyz"}

EFFECT = Effect(
    name="camera_pose",
    kind="observation",
    parameters=(
        *vector_parameters("rotation", "rad", math.pi, (0.02, 0.0, 0.0), "rotation vector, world axes"),
        *vector_parameters("shift", "m", 1000.0, (0.0, 0.0, 0.0), "d, shift in the world"),
    ),
    description=__doc__,
    transform=leave,
    neutral=NEUTRAL,
    of_world=True,
)
