# SPDX-License-Identifier: MIT
"""All assets by name, each made once a process."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from . import figures, people, vessels
from .asset import Asset

MAKERS: dict[str, Callable[[], Asset]] = {
    "ring": people.ring,
    "hat": people.hat,
    "sleeve": vessels.sleeve,
    "bowl": vessels.bowl,
    "belt": figures.belt,
    "sock": people.sock,
    "cap": vessels.cap,
    "scarf": figures.scarf,
    "snow": figures.snow,
}
NAMES = tuple(MAKERS)


@cache
def asset(name: str) -> Asset:
    """The asset of one of ``NAMES``."""
    return MAKERS[name]()
