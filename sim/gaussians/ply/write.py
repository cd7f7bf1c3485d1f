# SPDX-License-Identifier: MIT
"""Splats → a PLY file laid out as the program of Kerbl et al. 2023 writes it, which is what viewers read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...atomic import replacing
from ...errors import InputError
from ..splats import Splats
from .dialects import COLOURS, ROTATION, SCALE, SH_C0

LEAST_OPACITY = 1e-6
"""Opacities are kept this far from 0 and 1, whose logits are infinite."""

PROPERTIES = ("x", "y", "z", "nx", "ny", "nz", *COLOURS[0], "opacity", *SCALE, *ROTATION)
"""In Inria's order, all float32, binary little endian; normals are there because readers expect them, and zero."""


def write_splats(path: Path, splats: Splats) -> None:
    """Write ``splats`` to ``path``, whole or not at all.

    Read again, they are the same to float32, and opacities within 1e-6. Raises InputError when there are none, when a
    coordinate does not fit float32, or when the file cannot be written.
    """
    if not len(splats):
        raise InputError(f"{path}: no splats to write: give at least one")
    opacities = np.clip(splats.opacities, LEAST_OPACITY, 1.0 - LEAST_OPACITY)
    table = np.column_stack(
        [
            splats.centres,
            np.zeros((len(splats), 3)),
            (splats.colours - 0.5) / SH_C0,
            np.log(opacities) - np.log1p(-opacities),
            np.log(splats.scales),
            splats.rotations,
        ]
    )
    if np.abs(table).max() > np.finfo(np.float32).max:
        raise InputError(f"{path}: coordinates or colours beyond 3e38 do not fit float32: scale the splats")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [f"property float {name}" for name in PROPERTIES]
    with replacing(path) as partial, partial.open("wb") as stream:
        stream.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        stream.write(table.astype("<f4").tobytes())
