# SPDX-License-Identifier: GPL-3.0-or-later
"""Text for users: numbers as typed, error reports of operators, and labels (Blender neither wraps nor rounds them)."""

from __future__ import annotations

import functools
import math
import re
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

import bpy

from ..sim.errors import PhysGenError


def decimal(value: float) -> float:
    """Return the number as typed: Blender stores 32 bits, where 0.4 is 0.4000000059604645."""
    return float(f"{value:.7g}")


POPUP = 80
"""Characters on a line of a popup: 640 px, which is half of a laptop's window."""


def popup(message: str) -> str:
    """Return ``message`` broken into lines for a report that pops up: Blender breaks none, and lets them run off.

    Unchanged without a window: scripts and logs take a message as one line.
    """
    if bpy.app.background:
        return message
    lines = (textwrap.wrap(line, POPUP - 1, break_on_hyphens=False) for line in message.splitlines())
    # The status bar shows it in one line and drops the breaks, so that each line ends with a blank.
    return " \n".join(part for wrapped in lines for part in wrapped)


_OPTION = re.compile(r"(?<!\S)--[a-z]")
_IN_BRACKETS = re.compile(r"\s*\((?=--[a-z])[^()]*\)")


def without_options(message: str) -> str:
    """Return ``message`` without the brackets and clauses that name options of the command line, which Blender's user
    does not have; unchanged if nothing else would be left.
    """
    parts = re.split(r"([.;] )", _IN_BRACKETS.sub("", message))
    clauses = zip(parts[::2], [*parts[1::2], ""], strict=True)
    kept = "".join(clause + end for clause, end in clauses if not _OPTION.search(clause)).rstrip(" ;.")
    return kept or message


Execute = Callable[[Any, bpy.types.Context], set[str]]


def report_errors(execute: Execute) -> Execute:
    """Decorate an operator's ``execute``: a PhysGenError is reported and the operator cancelled."""

    # Blender inspects the signature, so arguments are named.
    @functools.wraps(execute)
    def guarded(self: bpy.types.Operator, context: bpy.types.Context) -> set[str]:
        try:
            return execute(self, context)
        except PhysGenError as error:
            self.report({"ERROR"}, popup(str(error)))
            return {"CANCELLED"}

    return guarded


def sentences(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, *, icon: str = "NONE") -> None:
    """Draw ``text`` on as many lines as the sidebar's width requires."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    most = max(room(context, 70 if icon == "NONE" else 95), 16)
    for index, line in enumerate(textwrap.wrap(text.replace(" %", "\N{NO-BREAK SPACE}%"), most)):
        column.label(text=line, icon=icon if index == 0 else ("NONE" if icon == "NONE" else "BLANK1"))


def room(context: bpy.types.Context, sides: float) -> int:
    """Return how many characters fit beside each other in the region but for ``sides``, px at the usual scale."""
    # It has the screen's resolution and the scale that the user has chosen.
    scale = context.preferences.system.ui_scale
    width = context.region.width if context.region is not None else 300
    return int((width - sides * scale) / (5.8 * scale))


def brief(message: str, most: int = 300) -> str:
    """Return ``message`` shortened for a panel: first and last of many lines, as in the traceback of a crash."""
    lines = message.strip().splitlines()
    if len(lines) > 3:
        message = f"{lines[0]} … {lines[-1]}"
    return message if len(message) <= most else f"{message[: most // 2]} … {message[-most // 2 :]}"


def paragraph(layout: bpy.types.UILayout, text: str, room: int) -> None:
    """Draw ``text`` on lines of up to ``room`` characters, for popups of known width."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    for line in textwrap.wrap(text, room):
        column.label(text=line)


def readable(name: str) -> str:
    """Return ``air_drag`` as ``Air drag``."""
    return name.replace("_", " ").capitalize()


def count(number: int, what: str) -> str:
    """Return ``1 object``, ``2 objects``, ``2 boxes``."""
    plural = f"{what}es" if what.endswith("x") else f"{what}s"
    return f"{number} {what if number == 1 else plural}"


PRESSURE = {
    "METRIC": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "IMPERIAL": {"psi": 6894.757, "ksi": 6894.757e3},
}
DENSITY = {"METRIC": {"kg/m³": 1.0}, "IMPERIAL": {"lb/ft³": 16.018463}}
VISCOSITY = {"METRIC": {"mPa s": 1e-3, "Pa s": 1.0}}
"""Units of a kind of number by Blender's unit system, from the smallest to the largest, and each in that of SI.

Blender's own properties have lengths, angles, times, velocities and the like, but none of these.
"""
Units = Mapping[str, Mapping[str, float]]
_TYPED = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)")


def quantity(value: float, units: Units, system: str = "METRIC", *, digits: int = 4) -> str:
    """Return ``value``, of the unit of SI, in the unit of ``system`` that suits it: ``500 kPa``, ``72.5 psi``.

    A bare number where the scene has no units.
    """
    if system == "NONE":
        return _digits(value, digits)
    known = units.get(system, units["METRIC"])
    fitting = [unit for unit, size in known.items() if abs(value) >= size * (1 - 0.5 * 0.1**digits)]
    unit = fitting[-1] if fitting else next(iter(known))
    if not fitting and value == 0 and 1.0 in known.values():
        unit = next(name for name, size in known.items() if size == 1.0)
    return f"{_digits(value / known[unit], digits)} {unit}"


def _digits(value: float, digits: int) -> str:
    """Return ``value`` with so many digits, and never as a power of ten where it is large."""
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.10g}"


def typed_quantity(words: str, units: Units, shown: str) -> float | None:
    """Return the number of SI that ``words`` name, such as ``0.5 MPa``, ``1 g/cm3`` or ``20``; None if they name none.

    units: of the kind, whose units of every system are known. shown: what the field showed before: a bare number has
    its unit, as in Blender's own fields.
    """
    match = _TYPED.fullmatch(words.strip())
    if match is None:
        return None
    number, unit = float(match[1]), _plain(match[2])
    sizes = {_plain(name): size for known in units.values() for name, size in known.items()}
    if units is DENSITY:
        sizes |= {"g/cm3": 1e3, "g/l": 1.0}
    if not unit:
        before = _TYPED.fullmatch(shown.strip())
        unit = _plain(before[2]) if before is not None else ""
    if not unit:
        return number
    # No kind has both milli- and mega-, so that capitals need not be minded.
    size = {name.lower(): size for name, size in sizes.items()}.get(unit.lower())
    return None if size is None else number * size


def _plain(unit: str) -> str:
    return unit.replace("³", "3").replace("^3", "3").replace("·", "").replace("*", "").replace(" ", "")


def pressure(pascals: float) -> str:
    """Return a pressure such as ``25 kPa`` or ``70 GPa``."""
    return quantity(pascals, PRESSURE, digits=3)


def storage(size: int) -> str:
    """Return a size such as ``12 MB``."""
    for unit, unit_size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= unit_size:
            return f"{size / unit_size:.3g} {unit}"
    return f"{size} bytes"


def duration(seconds: float) -> str:
    """Return a duration such as ``12 s``, ``3 min``, ``2.5 h``."""
    if seconds < 100:
        return f"{max(seconds, 1.0):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def age(seconds: float) -> str:
    """Return an age such as ``just now``, ``5 min ago``, ``3 h ago``, ``2 days ago``."""
    if seconds < 60:
        return "just now"
    for unit, size, most in (("min", 60, 60), ("h", 3600, 48)):
        if seconds < most * size:
            return f"{seconds / size:.0f} {unit} ago"
    return f"{seconds / 86400:.0f} days ago"


def length(metres: float) -> str:
    """Return a length such as ``1.2 mm`` or ``34 cm``; a dash if unknown (below zero)."""
    if not math.isfinite(metres) or metres < 0:
        return "–"
    for unit, size in (("m", 1.0), ("cm", 1e-2)):
        if metres >= size:
            return f"{metres / size:.3g} {unit}"
    return f"{metres / 1e-3:.2g} mm" if metres >= 1e-4 else f"{metres / 1e-6:.2g} µm"


def number(value: float, unit: str) -> str:
    """Return three digits and the unit, or a dash if not finite."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.3g}" if unit in ("", "1") else f"{value:.3g} {unit}"


def interval(low: float, high: float) -> str:
    """Return ``0.349 and 0.352``, with as many digits, three at least, as tell both ends apart by more than a digit."""
    most = max(abs(low), abs(high))
    digits = 3
    if high > low:
        digits = min(7, max(3, 1 + math.ceil(math.log10(most / (high - low)))))
    return f"{low:.{digits}g} and {high:.{digits}g}"


def percent(share: float) -> str:
    """Return three digits of ``share`` in per cent, or a dash if not finite."""
    return number(100 * share, "%")


def volume(cubic_metres: float) -> str:
    """Return a volume such as ``2.4 cm³`` or ``0.13 m³``."""
    for unit, size in (("m³", 1.0), ("dm³", 1e-3), ("cm³", 1e-6)):
        if cubic_metres >= 0.1 * size:
            return f"{cubic_metres / size:.3g} {unit}"
    return f"{cubic_metres / 1e-9:.2g} mm³"
