# SPDX-License-Identifier: MIT
"""What the scene's classes check their fields with: the message names the field, its value and the way out."""

from __future__ import annotations

import math

from ..errors import InputError


def require(condition: bool, field_name: str, value: object, remedy: str) -> None:
    """Raise InputError for ``field_name`` unless ``condition`` holds."""
    if not condition:
        raise InputError(f"{field_name} is {value!r}: {remedy}")


def finite(*numbers: float) -> bool:
    """Whether all ``numbers`` are finite."""
    return all(math.isfinite(n) for n in numbers)


def require_range(field_name: str, value: float | None, low: float, high: float, unit: str = "a number") -> None:
    """Raise InputError unless ``value`` is None or lies from ``low`` to ``high``."""
    good = value is None or (finite(value) and low <= value <= high)
    require(good, field_name, value, f"give {unit} from {low:g} to {high:g}")
