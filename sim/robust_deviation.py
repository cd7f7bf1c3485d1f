# SPDX-License-Identifier: MIT
"""The standard deviation of values of which some are outliers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MEDIAN_TO_DEVIATION = 1.4826
"""Standard deviation of a normal distribution of mean 0 over the median of its absolute values."""


def robust_deviation(residuals: NDArray[np.floating], axis: int | None = None) -> Any:
    """Return the standard deviation of ``residuals`` about 0, along ``axis`` or of all, as their median tells it.

    That of normally distributed ones is the usual one; almost half may be outliers. A number, or an array with the
    other axes, of their type.
    """
    return MEDIAN_TO_DEVIATION * np.median(np.abs(residuals), axis=axis)
