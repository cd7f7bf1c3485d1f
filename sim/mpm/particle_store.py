# SPDX-License-Identifier: MIT
"""The particles of all worlds on the device, sorted by field and block; lengths in cells."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from .block_lists import block_keys, bytes_of
from .kernels import layout, sorting
from .kernels.constitutive_response import LawSet
from .kernels.kernel_arrays import ParticleArrays, ParticleState
from .kernels.layout import FIXED_ONE, ivec3, mat3, vec3, vec4
from .kernels.runtime import new_array
from .packing import NewParticles

Array = NDArray[np.float64]
State = dict[str, NDArray[np.generic]]

KINDS = {
    "x": ivec3,
    "v": vec3,
    "C": mat3,
    "F": mat3,
    "constants": vec4,
    "reaction": vec4,
    "ids": ti.i32,
    "memory": ti.f32,
    "material": ti.i32,
    "volumes": ti.f32,
    "anchors": vec4,
    "slopes": vec3,
    "conformation": mat3,
}
"""Type of the elements of each array; ``kernel_arrays.ParticleArrays`` describes them. ids: the caller's numbers."""

ALWAYS = (*ParticleState._fields, "constants", "ids")
"""Arrays that every particle needs."""

HELD = {
    "constants": sorting.permute_held_vectors,
    "ids": sorting.permute_held_integers,
    "material": sorting.permute_held_integers,
    "volumes": sorting.permute_held_numbers,
    "anchors": sorting.permute_held_vectors,
}
"""Arrays that no substep changes, and what sorts each. There is one of each; of the others two, between which a sort
moves them, because the state from before it must be there for another try."""

MOVERS = {
    "memory": sorting.permute_numbers,
    "slopes": sorting.permute_triples,
    "conformation": sorting.permute_matrices,
}
"""What sorts the arrays that substeps change, other than those of ``ParticleState``, which are sorted at once."""

MATTER = ("memory", "material")
"""Arrays that only models other than plain fixed-corotated elasticity need."""


class ParticleStore:
    """Arrays with one row a particle. names: of those that there are. count: particles so far.

    keys, targets: (capacity,) block key of each before a sort, and its row after it.
    """

    def __init__(self, *, capacity: int, models: LawSet, several: bool, anchored: bool) -> None:
        """models: of the particles. several: whether a world has several fields. anchored: whether one is held."""
        self.names = ALWAYS + (() if models.only_elastic else MATTER)
        self.names += ("volumes",) if several else ()
        self.names += ("anchors",) if anchored else ()
        self.names += ("slopes",) if models.volumetric else ()
        self.names += ("conformation",) if models.relaxing else ()
        self.count = 0
        self._capacity = max(1, capacity)
        held = self._new_arrays(name for name in self.names if name in HELD)
        moving = [name for name in self.names if name not in HELD]
        # Of the second set only a sort makes use: it writes there, and swaps the two.
        self._sets = [{**self._new_arrays(moving), **held} for _ in range(2)]
        self.keys = new_array(ti.i64, self._capacity)
        self.targets = new_array(ti.i32, self._capacity)

    def _new_arrays(self, names: Iterable[str]) -> dict[str, ti.Ndarray]:
        return {name: new_array(KINDS[name], self._capacity) for name in names}

    def __getitem__(self, name: str) -> ti.Ndarray:
        """The present array ``name``."""
        return self._sets[0][name]

    @property
    def device_bytes(self) -> int:
        """Bytes of all arrays."""
        arrays = [*self._sets[0].values(), *(a for n, a in self._sets[1].items() if n not in HELD)]
        return sum(bytes_of(a) for a in (*arrays, self.keys, self.targets))

    def bundle(self, spares: Mapping[str, ti.Ndarray]) -> ParticleArrays:
        """The arrays as the kernels take them. Those that no kernel reads are stood in for by others of the same type:
        by ``spares``, and by arrays of this store."""
        here = self._sets[0]
        spare = {**spares, "slopes": here["v"], "conformation": here["C"]}
        return ParticleArrays(**{name: here.get(name, spare.get(name)) for name in ParticleArrays._fields})

    def values(self, name: str) -> NDArray[np.generic]:
        """The array ``name`` of all particles, on the host."""
        return np.asarray(self._sets[0][name].to_numpy()[: self.count])

    def download(self, names: Sequence[str] | None = None) -> State:
        """All arrays or those named, on the host."""
        return {name: self.values(name) for name in names or self.names}

    def put(self, name: str, values: NDArray[np.generic]) -> None:
        """Let the first particles have these ``values`` in the array ``name``."""
        _put_first(self._sets[0][name], values)

    def begin(self, keys: NDArray[np.int64]) -> None:
        """Go on with the particles that were put, whose blocks these ``keys`` name; they are to be sorted next."""
        _put_first(self.keys, keys)
        self.count = len(keys)

    def set_moduli(self, first: int, shares: ti.Ndarray, shear: float, bulk: float) -> None:
        """Set 2 mu V0 and lambda V0 of the particles from number ``first`` on to ``shares`` of these two numbers, see
        ``sorting.set_moduli``."""
        end = first + shares.shape[0]
        sorting.set_moduli(self.count, first, end, shear, bulk, shares, self["ids"], self["constants"])

    def sort(self, *, again: bool) -> None:
        """Move all particles to their ``targets``.

        again: after ``unsort``. What no substep changes has been moved already, and a card would find another order.
        """
        old, new = self._sets
        if not again:
            for name, move in HELD.items():
                if name in self.names:
                    move.launch(self.count, self.targets, old[name], new["reaction"])
        sorting.permute.launch(self.count, self.targets, _state_of(old), _state_of(new))
        for name in self.names:
            if name in MOVERS:
                MOVERS[name].launch(self.count, self.targets, old[name], new[name])
        self._sets.reverse()

    def unsort(self) -> None:
        """Go back to the state from before the last sort, which the second set still holds, to sort it again."""
        self._sets.reverse()


def _put_first(array: ti.Ndarray, values: NDArray[np.generic]) -> None:
    host = array.to_numpy()
    host[: len(values)] = values
    array.from_numpy(host)


def _state_of(arrays: Mapping[str, ti.Ndarray]) -> ParticleState:
    return ParticleState(*(arrays[name] for name in ParticleState._fields))


def new_rows(added: NewParticles) -> tuple[State, NDArray[np.int64]]:
    """Rows of all arrays for new particles, and the block key of each (n,)."""
    x, keys = places_in_blocks(added.field, added.x)
    count = len(x)
    rows: State = {
        "x": x,
        "v": added.v.astype(np.float32),
        "C": added.C.astype(np.float32),
        "F": added.F.astype(np.float32),
        "constants": added.constants.astype(np.float32),
        "reaction": np.zeros((count, 4), dtype=np.float32),
        "ids": added.ids.astype(np.int32),
        "memory": np.zeros(count, dtype=np.float32),
        "material": added.material.astype(np.int32),
        "volumes": added.volumes.astype(np.float32),
        "anchors": added.anchors.astype(np.float32),
        "slopes": np.zeros((count, 3), dtype=np.float32),
        "conformation": np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3)),
    }
    return rows, keys


def positions_of(keys: NDArray[np.int64], x: NDArray[np.generic]) -> Array:
    """Return positions (n, 3) in cells of particles at ``x`` (n, 3) in the blocks of these keys."""
    cells = np.stack([(keys >> shift & 0xFFFF) - sorting.BIAS for shift in (32, 16, 0)], axis=1)
    return np.asarray(4 * cells - 1 + x.astype(np.float64) / FIXED_ONE)


def places_in_blocks(field: int, cells: Array) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Return the places ``cells`` (n, 3) in ``field`` as the arrays have them: "x" (n, 3), from the corner of the block
    of each, and "keys" (n,)."""
    block = np.clip(np.floor(cells - 0.5).astype(np.int64) >> 2, -layout.FARTHEST_BLOCK, layout.FARTHEST_BLOCK)
    return np.rint((cells - (4 * block - 1)) * FIXED_ONE).astype(np.int32), block_keys(np.int64(field), block)
