# SPDX-License-Identifier: GPL-3.0-or-later
"""Sentences and numbers for people: Blender's labels neither wrap nor round."""

from __future__ import annotations

import math
import textwrap

import bpy


def sentences(layout: bpy.types.UILayout, context: bpy.types.Context, text: str, *, icon: str = "NONE") -> None:
    """``text`` on as many lines as the sidebar's width asks for."""
    scale = context.preferences.system.ui_scale * context.preferences.view.ui_scale
    width = context.region.width if context.region is not None else 300
    room = max(int((width - (70 if icon == "NONE" else 95) * scale) / (5.8 * scale)), 16)
    column = layout.column(align=True)
    column.scale_y = 0.8
    for index, line in enumerate(textwrap.wrap(text.replace(" %", "\N{NO-BREAK SPACE}%"), room)):
        column.label(text=line, icon=icon if index == 0 else ("NONE" if icon == "NONE" else "BLANK1"))


def brief(message: str, most: int = 300) -> str:
    """``message`` for a panel: of many lines, as a crashed process leaves them, the first and the last."""
    lines = message.strip().splitlines()
    if len(lines) > 3:
        message = f"{lines[0]} … {lines[-1]}"
    return message if len(message) <= most else f"{message[: most // 2]} … {message[-most // 2 :]}"


def paragraph(layout: bpy.types.UILayout, text: str, room: int) -> None:
    """``text`` on lines of up to ``room`` characters, for popups, whose width is known beforehand."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    for line in textwrap.wrap(text, room):
        column.label(text=line)


def readable(name: str) -> str:
    """``air_drag`` as ``Air drag``."""
    return name.replace("_", " ").capitalize()


def count(number: int, what: str) -> str:
    """``1 object``, ``2 objects``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def pressure(pascals: float) -> str:
    """Such as ``25 kPa`` or ``70 GPa``."""
    for unit, size in (("GPa", 1e9), ("MPa", 1e6), ("kPa", 1e3)):
        if pascals >= size * 0.9995:
            return f"{pascals / size:.3g} {unit}"
    return f"{pascals:.3g} Pa"


def storage(size: int) -> str:
    """Bytes, such as ``12 MB``."""
    for unit, unit_size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= unit_size:
            return f"{size / unit_size:.3g} {unit}"
    return f"{size} bytes"


def duration(seconds: float) -> str:
    """Such as ``12 s``, ``3 min``, ``2.5 h``."""
    if seconds < 100:
        return f"{max(seconds, 1.0):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def length(metres: float) -> str:
    """Such as ``1.2 mm`` or ``34 cm``; a dash for what is not known (below zero)."""
    if not math.isfinite(metres) or metres < 0:
        return "–"
    for unit, size in (("m", 1.0), ("cm", 1e-2)):
        if metres >= size:
            return f"{metres / size:.3g} {unit}"
    return f"{metres / 1e-3:.2g} mm" if metres >= 1e-4 else f"{metres / 1e-6:.2g} µm"


def number(value: float, unit: str) -> str:
    """Three digits and the unit, a dash for what is no number."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.3g}" if unit in ("", "1") else f"{value:.3g} {unit}"


def volume(cubic_metres: float) -> str:
    """Such as ``2.4 cm³`` or ``0.13 m³``."""
    for unit, size in (("m³", 1.0), ("dm³", 1e-3), ("cm³", 1e-6)):
        if cubic_metres >= 0.1 * size:
            return f"{cubic_metres / size:.3g} {unit}"
    return f"{cubic_metres / 1e-9:.2g} mm³"
