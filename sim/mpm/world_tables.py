# SPDX-License-Identifier: MIT
"""The tables of all worlds on the device: rows of worlds, fields, contacts and materials, and how far each world is."""

from __future__ import annotations

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from .block_lists import bytes_of
from .kernels import layout
from .kernels.kernel_arrays import AdhesionArrays, WorldArrays
from .kernels.runtime import new_array
from .packing import PackedWorlds

Array = NDArray[np.float64]


class WorldTables:
    """``numbers`` on the device; ``layout`` names the columns. Lengths in cells.

    mean_fields: how many fields have means: all, or none where none is asked for; of_field: (F,) the world of each.
    """

    def __init__(self, numbers: PackedWorlds) -> None:
        self.count = len(numbers.worlds)
        self.field_count = len(numbers.fields)
        self.mean_fields = self.field_count if numbers.field_integers[:, layout.WANTS_MEANS].any() else 0
        self.of_field = numbers.field_integers[:, layout.WORLD].copy()
        self.adheres = numbers.adheres
        self._integers = upload_new(numbers.world_integers)
        self._numbers = upload_new(numbers.worlds)
        self._field_integers = upload_new(numbers.field_integers)
        self._field_numbers = upload_new(numbers.fields)
        self._contacts = upload_new(numbers.touches)
        self._pairs = upload_new(numbers.pairs)
        self._materials = upload_new(numbers.table)
        self.adhesion = _new_adhesion(numbers)
        self._means = new_array(ti.f32, max(1, self.field_count) * layout.MEAN_ROW)
        self._control = new_array(ti.f64, self.count * layout.CONTROL_ROW)
        control = np.zeros((self.count, layout.CONTROL_ROW))
        control[:, layout.CFL_SCALE] = 1.0
        control[:, layout.STATUS] = layout.DONE
        control[:, layout.LONGEST_STEP] = math.inf
        self.put_control(control)

    @property
    def device_bytes(self) -> int:
        """Bytes of all arrays."""
        return sum(bytes_of(a) for a in (*vars(self).values(), *self.adhesion) if isinstance(a, ti.Ndarray))

    def arrays(self) -> WorldArrays:
        """The bundle for kernels."""
        return WorldArrays(
            count=self.count,
            mean_fields=self.mean_fields,
            integers=self._integers,
            numbers=self._numbers,
            field_integers=self._field_integers,
            field_numbers=self._field_numbers,
            contacts=self._contacts,
            pairs=self._pairs,
            materials=self._materials,
            control=self._control,
            means=self._means,
        )

    def set_rows(self, *, worlds: NDArray[np.float32], fields: NDArray[np.float32]) -> None:
        """Set the parameters of worlds and fields for the next segment of time."""
        self._numbers.from_numpy(np.ascontiguousarray(worlds, dtype=np.float32).ravel())
        if self.field_count:
            self._field_numbers.from_numpy(np.ascontiguousarray(fields, dtype=np.float32).ravel())

    def set_materials(self, table: NDArray[np.float32]) -> None:
        """Set the rows of the materials for the next segment of time."""
        self._materials.from_numpy(np.ascontiguousarray(table, dtype=np.float32).ravel())

    def control(self) -> Array:
        """Progress of the worlds (W, CONTROL_ROW)."""
        return np.asarray(self._control.to_numpy().reshape(self.count, layout.CONTROL_ROW))

    def put_control(self, control: Array) -> None:
        """Set the progress of the worlds (W, CONTROL_ROW)."""
        self._control.from_numpy(np.ascontiguousarray(control).ravel())

    def expect(self, world: int, *, speed: float = 0.0, wave_speed: float = 0.0) -> None:
        """Let the next substep of ``world`` be stable for particles and waves of these speeds, cells/s."""
        control = self.control()
        row = control[world]
        row[layout.SPEED] = max(row[layout.SPEED], speed)
        row[layout.WAVE_SPEED] = max(row[layout.WAVE_SPEED], wave_speed)
        self.put_control(control)

    def means(self) -> NDArray[np.float32]:
        """Means of the fields, flat, MEAN_ROW numbers each."""
        return np.asarray(self._means.to_numpy())

    def put_means(self, means: NDArray[np.float32]) -> None:
        """Set the means of the fields."""
        self._means.from_numpy(means)


def _new_adhesion(numbers: PackedWorlds) -> AdhesionArrays:
    """The arrays of bonds; empty where nothing adheres."""
    touches, pairs = numbers.touch_adhesion, numbers.pair_adhesion
    if not numbers.adheres:
        touches, pairs = touches[:0], pairs[:0]
    return AdhesionArrays(
        touch_count=len(touches),
        pair_count=len(pairs),
        touches=upload_new(touches),
        pairs=upload_new(pairs),
        touch_sums=new_array(ti.i64, max(1, len(touches))),
        pair_sums=new_array(ti.i64, max(1, len(pairs))),
    )


def upload_new(values: NDArray[np.generic]) -> ti.Ndarray:
    """A new array on the device with the numbers of ``values``, flat; at least one long."""
    kind = ti.i32 if values.dtype == np.int32 else ti.f32
    array = new_array(kind, max(1, values.size))
    if values.size:
        array.from_numpy(np.ascontiguousarray(values).ravel())
    return array
