# SPDX-License-Identifier: MIT
"""Numbers of the report as text: significant digits, units, percentages, estimates with their intervals."""

from __future__ import annotations

import math

from ..fits import Estimate

NOTHING = "–"
"""Placeholder for a missing number."""

_SCALES: dict[str, tuple[tuple[float, float, str], ...]] = {
    "m": ((1e-4, 1e6, "µm"), (0.1, 1e3, "mm"), (math.inf, 1.0, "m")),
    "s": ((0.1, 1e3, "ms"), (math.inf, 1.0, "s")),
    "Pa": ((1e3, 1.0, "Pa"), (1e6, 1e-3, "kPa"), (1e9, 1e-6, "MPa"), (math.inf, 1e-9, "GPa")),
    "rad": ((math.inf, 180 / math.pi, "°"),),
    "px": ((math.inf, 1.0, "px"),),
}
"""Unit → (upper limit, factor, display name) in rising order."""


LEAST_LENGTH_M = 1e-9
"""Lengths below are rounding errors, and shown as that."""


def quantity_text(value: float | None, unit: str, *, digits: int = 3) -> str:
    """Return ``value`` with ``digits`` significant digits and a suitable unit, such as "3.4 mm"; a dash for NaN."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if unit == "m" and 0 < abs(value) < LEAST_LENGTH_M:
        return "<\u00a01\u00a0nm"
    factor, name = _scale(abs(value), unit)
    return with_unit(number_text(value * factor, digits=digits), name)


def finite_or_zero(value: float) -> float:
    """Return ``value``, 0 where it is not finite."""
    return value if math.isfinite(value) else 0.0


def counted(number: int, what: str) -> str:
    """Return "1 trial" or "3 trials"."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def with_unit(number: str, unit: str) -> str:
    """Return ``number`` and its unit, joined by a no-break space; no unit for "1"."""
    if unit in ("", "1"):
        return number
    return f"{number}{unit}" if unit == "°" else f"{number}\u00a0{unit}"


def number_text(value: float | None, *, digits: int = 3) -> str:
    """Return ``value`` with ``digits`` significant digits, in powers of ten where it is very large or small."""
    if value is None or not math.isfinite(value):
        return NOTHING
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".split("e")[1])
    if not -4 <= exponent < 5:
        mantissa = f"{value:.{digits - 1}e}".split("e")[0]
        return f"{_signed(mantissa)}\u00a0×\u00a010{_raised(exponent)}"
    return _signed(f"{value:.{max(digits - 1 - exponent, 0)}f}")


def tick_text(value: float) -> str:
    """Return an axis tick label without trailing zeros."""
    return _signed(f"{value:.6g}") if value == 0 or 1e-4 <= abs(value) < 1e6 else number_text(value, digits=1)


def axis_unit(largest: float, unit: str) -> tuple[float, str]:
    """Return (factor, name) of the display unit of an axis that ends at ``largest``."""
    return _scale(abs(largest), unit) if math.isfinite(largest) else (1.0, unit)


def percent_text(value: float | None) -> str:
    """Return a share as a percentage, with a decimal below 1 %; never 0 or 100 % unless exactly that."""
    if value is None or not math.isfinite(value):
        return NOTHING
    per_cent = round(100 * value, 9)  # sums of shares miss 100 by rounding errors
    if 0 < per_cent < 0.1:
        return "<\u00a00.1\u00a0%"
    if 99.5 <= per_cent < 100:
        return "99.9\u00a0%" if per_cent >= 99.9 else f"{math.floor(per_cent * 10) / 10:.1f}\u00a0%"
    return f"{_signed(f'{per_cent:.1f}' if 0 < abs(per_cent) < 0.95 else f'{per_cent:.0f}')}\u00a0%"


def estimate_text(estimate: Estimate) -> str:
    """Return the value with unit and 95 % interval, with as many digits as the interval supports.

    "0.0405 1/m (95 %: 0.0381 to 0.0429)"; without the interval where it is unknown. Radians are shown in degrees.
    """
    known = [abs(x) for x in (estimate.value, estimate.low, estimate.high) if math.isfinite(x)]
    if not math.isfinite(estimate.value):
        return NOTHING
    factor, unit = _scale(max(known), estimate.unit)
    value, low, high = (x * factor for x in (estimate.value, estimate.low, estimate.high))
    if not (math.isfinite(low) and math.isfinite(high)) or not (high - low) / 2 > 0:
        return with_unit(number_text(value), unit)
    largest = max(abs(value), abs(low), abs(high))
    if not 1e-4 <= largest < 1e5:
        return f"{with_unit(number_text(value), unit)} (95\u00a0%: {number_text(low)} to {number_text(high)})"
    # Two digits of the half width, but at most five of the largest number.
    finest = max(math.floor(math.log10((high - low) / 2)) - 1, math.floor(math.log10(largest)) - 4)
    places = max(-finest, 0)
    shown, from_, to = (_signed(f"{x:.{places}f}") for x in (value, low, high))
    return f"{with_unit(shown, unit)} (95\u00a0%: {from_} to {to})"


def parameter_text(name: str, estimate: Estimate) -> str:
    """Return a fitted parameter on one line: name in words, value, unit and 95 % interval.

    "drag per mass 0.0405 1/m (95 %: 0.0381 to 0.0429)". Radians are shown in degrees, lengths in mm where small.
    """
    return f"{name.replace('_', ' ')} {estimate_text(estimate)}"


def _scale(size: float, unit: str) -> tuple[float, str]:
    if unit not in _SCALES:
        return 1.0, unit
    if size == 0:
        return (180 / math.pi, "°") if unit == "rad" else (1.0, unit)
    return next((factor, name) for limit, factor, name in _SCALES[unit] if size < limit or limit == math.inf)


def _signed(number: str) -> str:
    bare = number.removeprefix("-")
    return bare if bare == number or not any(c in "123456789" for c in bare) else f"−{bare}"


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
