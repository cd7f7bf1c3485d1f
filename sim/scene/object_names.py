# SPDX-License-Identifier: MIT
"""Object and file names that scenes and every file system accept."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence

GROUND = "ground"
"""Name of the ground in ``contacts`` and overrides; no object may have it."""

MAX_CHARACTERS = 64
MAX_BYTES = 120
"""In UTF-8; file names have at most 255 bytes, and suffixes are added."""

DEVICES = frozenset({"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))})
"""File names, in lower case, that Windows reserves for devices."""


def valid_names(wanted: Sequence[str]) -> list[str]:
    """Return unique valid object names in the order of ``wanted``, changed as little as possible.

    A name that is valid and not taken by an earlier equal one stays unchanged.
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
    """Return the longest prefix of ``name`` within the limits, with ``reserve`` characters to spare."""
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
