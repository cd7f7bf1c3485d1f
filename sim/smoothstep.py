# SPDX-License-Identifier: MIT
"""The smooth step of computer graphics, 3t² - 2t³."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Real = TypeVar("Real", bound=np.floating)


def smoothstep(values: NDArray[Real], start: float = 0.0, end: float = 1.0) -> NDArray[Real]:
    """Return 0 for ``values`` up to ``start``, 1 from ``end``, and a cubic between without kinks; same shape and type.

    ``end`` below ``start`` falls instead of rising.
    """
    t = np.clip((values - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), dtype=values.dtype)
