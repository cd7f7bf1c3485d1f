# SPDX-License-Identifier: GPL-3.0-or-later
"""Pins: the boxes of empties, which hold or lead what of an object is in them."""

from __future__ import annotations

import itertools

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.model import Box, Keys
from .animation import why_it_moves
from .export_motion import STILL, keys
from .export_units import Clock, placed, scaled


class PinBoxes:
    """The boxes that hold one object, as they are read frame by frame. moves: whether any of them could move."""

    def __init__(self, item: bpy.types.Object, scene: bpy.types.Scene, unit: float, clock: Clock) -> None:
        self._item, self._unit, self._clock = item, unit, clock
        self._boxes = [pin.box for pin in item.physgen.pins]
        for number, box in enumerate(self._boxes, start=1):
            if box is None or scene.objects.get(box.name) != box:
                raise InputError(
                    f"object {item.name!r}: pin {number} has no box in this scene: choose an empty for it, or remove it"
                )
        self.moves = any(why_it_moves(box) is not None for box in self._boxes)
        self._corners: list[NDArray[np.float64]] = []

    def read(self, graph: bpy.types.Depsgraph) -> None:
        """Take in the frame that ``graph`` has evaluated."""
        self._corners.append(np.stack([_corners(box.evaluated_get(graph), self._unit) for box in self._boxes]))

    def boxes(self) -> tuple[Box, ...]:
        """What they hold at the first frame that was read: boxes along the world's axes, around the empties' own."""
        result = []
        for box, corners in zip(self._boxes, self._corners[0], strict=True):
            low, high = corners.min(axis=0), corners.max(axis=0)
            if not (np.isfinite(corners).all() and (low < high).all()):
                raise InputError(f"object {self._item.name!r}: its pin {box.name!r} is flat: scale it up on every axis")
            result.append(Box(low=scaled(low), high=scaled(high)))
        return tuple(result)

    def motion(self) -> Keys:
        """Where they lead what they hold, m. Raises InputError where they do not all go the same way, or turn."""
        corners = np.stack(self._corners)
        steps = corners - corners[0]
        size = max(float(np.ptp(corners[0], axis=1).max()), float(np.abs(steps).max()))
        first = steps[:, :1, :1]
        if np.abs(steps - first).max() > 10 * STILL * size:
            raise InputError(
                f"object {self._item.name!r}: its pins turn, grow or move differently, and what they hold is moved "
                "along as a whole: animate the location alone, the same for all of them (parent them to one empty)"
            )
        way = first[:, 0, 0]
        return keys(self._clock, way) if np.abs(way).max() > STILL * size else ()


def _corners(box: bpy.types.Object, unit: float) -> NDArray[np.float64]:
    """Corners (8, 3) of ``box`` in world metres; of other objects than empties, those of the box around them."""
    if box.type == "EMPTY":
        own = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * box.empty_display_size
    else:
        own = np.array(box.bound_box)
    matrix = placed(box.matrix_world, unit)
    return own @ matrix[:3, :3].T + matrix[:3, 3]
