# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender's numbers as the scene format has them: metres, seconds, and without the noise of 32 bits.

What Blender's fields show in metres is what is simulated. With a unit scale of 0.01 an object of 100 units is 1 m, a
velocity field that shows 1 m/s means that, and Blender's own gravity of 9.81 units/s² is the 0.0981 m/s² that its
field shows: objects then fall as slowly as in Blender's own simulations. Without a unit system a unit is a metre.
Parameters of effects are in SI units as they stand. A cache in mesh coordinates is free of all this: the scale is in
``world_from_mesh`` and its inverse takes it out again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.errors import InputError
from ..typed import decimal

Vector = tuple[float, float, float]


def metres_per_unit(scene: bpy.types.Scene) -> float:
    """Length of a Blender unit of ``scene`` in metres."""
    units = scene.unit_settings
    return 1.0 if units.system == "NONE" else decimal(units.scale_length)


def scaled(values: Iterable[float], factor: float = 1.0) -> Vector:
    """Three typed numbers times ``factor``."""
    x, y, z = (decimal(value * factor) for value in values)
    return x, y, z


def placed(matrix: Matrix, unit: float) -> NDArray[np.float64]:
    """``matrix`` from an object's own space to the world (4, 4), with the world in metres; ``unit`` in metres."""
    result = np.array(matrix, dtype=np.float64)
    result[:3] *= unit
    return result


@dataclass(frozen=True, kw_only=True)
class Clock:
    """Which frames are simulated, and when: the first is at 0 s. start, end: frame numbers; fps: frames a second."""

    start: int
    end: int
    fps: float

    @property
    def frames(self) -> range:
        """The frames' numbers."""
        return range(self.start, self.end + 1)

    def seconds(self, frame: float) -> float:
        """When ``frame`` is, in s after the first one; to the last bit when a bake's sample of it is."""
        return (frame - self.start) / self.fps

    def from_frame(self, frame: int) -> float:
        """When what begins with ``frame`` begins; frames before the first are the first."""
        return self.seconds(max(frame, self.start))


def clock(scene: bpy.types.Scene) -> Clock:
    """The frames of ``scene`` that are simulated. Raises InputError where there are none."""
    settings, render = scene.physgen.simulation, scene.render
    if settings.frame_end < settings.frame_start:
        raise InputError(
            f"simulation: ends at frame {settings.frame_end}, before it starts at {settings.frame_start}: raise the end"
        )
    return Clock(start=settings.frame_start, end=settings.frame_end, fps=decimal(render.fps / render.fps_base))
