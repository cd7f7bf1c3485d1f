# SPDX-License-Identifier: MIT
"""What the engine is told: rows of numbers for worlds, fields and contacts, and particles. Lengths in cells.

``packing`` makes them from setups; ``layout`` names the columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Numbers:
    """What the kernels know of the worlds and their fields, packed as ``layout`` says; see ``packing``."""

    laws: int
    table: NDArray[np.float32]
    world_integers: NDArray[np.int32]
    worlds: NDArray[np.float32]
    field_integers: NDArray[np.int32]
    fields: NDArray[np.float32]
    touches: NDArray[np.float32]
    pairs: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Added:
    """Particles to add to field ``field``, N of them, as ``transfer.advance_particles`` describes them."""

    field: int
    x: Array
    v: Array
    C: Array
    F: Array
    constants: Array
    ids: NDArray[np.int32]
    material: NDArray[np.int32]
    volumes: Array
    anchors: Array
