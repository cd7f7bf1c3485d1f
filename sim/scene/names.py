# SPDX-License-Identifier: MIT
"""Names that people and other programs give to things, as scenes and every file system take them."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence

from .model import GROUND

MAX_CHARACTERS = 64
MAX_BYTES = 120
"""In UTF-8; a file's name has at most 255, and suffixes are added."""

DEVICES = frozenset({"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))})
"""Names, in lower case, that Windows keeps for devices and gives no file."""


def fitting_names(wanted: Sequence[str]) -> list[str]:
    """Names for the objects of a scene, as like those ``wanted`` as can be, each once, in the same order.

    A name that can stay does, whatever the others are called.
    """
    cleaned = [_cleaned(name) for name in wanted]
    order = sorted(range(len(wanted)), key=lambda i: (cleaned[i] != wanted[i], wanted[i]))
    found = list(cleaned)
    taken: set[str] = set()
    for index in order:
        found[index] = _unique(cleaned[index], taken)
        taken.add(found[index].casefold())
    return found


def _cleaned(name: str) -> str:
    composed = unicodedata.normalize("NFC", name)
    allowed = "".join(c if c.isalnum() or c in "_- " else "_" for c in composed).strip()
    cut = _cut(allowed, 0) or "object"
    return f"{cut}_" if cut.casefold() in DEVICES | {GROUND} else cut


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
