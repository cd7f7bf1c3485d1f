# SPDX-License-Identifier: GPL-3.0-or-later
"""Names that Blender allows and a scene folder does not: dots, slashes, 255 bytes, names that a file may not have."""

from __future__ import annotations

import unicodedata

import bpy

from ...sim.errors import InputError
from ...sim.scene.model import GROUND
from ..props.body import bodies

MAX_CHARACTERS = 64
MAX_BYTES = 120
"""In UTF-8; a file's name has at most 255, and suffixes are added."""

RESERVED = {GROUND, "con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))}
"""The ground's own name, and names that Windows keeps for devices."""


def export_names(scene: bpy.types.Scene) -> dict[str, str]:
    """The name in the scene folder of every body of ``scene``, by its name in Blender.

    An object whose name can stay keeps it, whatever the others are called. Raises InputError where two bodies share a
    name, which only objects of linked files can.
    """
    found = [item.name for item in bodies(scene)]
    for name in found:
        if found.count(name) > 1:
            raise InputError(f"two objects are called {name!r}, one of them is of a linked file: rename the other")
    taken: set[str] = set()
    names = {}
    for name in sorted(found, key=lambda name: (_cleaned(name) != name, name)):
        names[name] = _unique(_cleaned(name), taken)
        taken.add(names[name].casefold())
    return {name: names[name] for name in found}


def _cleaned(name: str) -> str:
    composed = unicodedata.normalize("NFC", name)
    allowed = "".join(c if c.isalnum() or c in "_- " else "_" for c in composed).strip()
    cut = _cut(allowed, 0) or "object"
    return f"{cut}_" if cut.casefold() in RESERVED else cut


def _cut(name: str, reserve: int) -> str:
    """The beginning of ``name`` that fits, with ``reserve`` characters to spare."""
    name = name[: MAX_CHARACTERS - reserve]
    while len(name.encode()) > MAX_BYTES - reserve:
        name = name[:-1]
    return name.strip()


def _unique(name: str, taken: set[str]) -> str:
    result, number = name, 2
    while result.casefold() in taken:
        ending = f"_{number}"
        result, number = _cut(name, len(ending)) + ending, number + 1
    return result
