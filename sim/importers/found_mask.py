# SPDX-License-Identifier: MIT
"""A mask as a file of another program has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class FoundMask:
    """name: what the file calls it, any text; kind: what it is, or None; mask: (h, w), of any size."""

    name: str
    kind: str | None
    mask: NDArray[np.bool_]
