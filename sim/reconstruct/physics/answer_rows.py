# SPDX-License-Identifier: MIT
"""What the lines of an answer, or its JSON, are turned into before their entries are read."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

MAX_TEXT = 2**16
"""Characters that are read; an answer about a photo has some hundred."""

MAX_LINES = 1000
MAX_LINE = 500

SURFACE = re.compile(r"rough|\b(?:surface|ground|table|tabletop|floor|desk|supporting)\b")
"""Words of the surface on which things stand, in plain letters."""

LONE = re.compile(r"\W{0,2}\d*[.,]?\d+(?:e-?\d)?\s*%?(?:\s*(?:-|–|to)\s*\d*[.,]?\d+\s*%?)?\W{0,2}\Z")
"""A number, a share in per cent or a range, and nothing else."""


@dataclass
class Row:
    """What one line or block says: ``cells`` by position or ``named`` by question, and the ``line`` it was."""

    line: str
    number: int | None = None
    cells: list[str] = field(default_factory=list)
    named: dict[str, str] = field(default_factory=dict)


@dataclass
class Rows:
    """All of an answer.

    roughness: (rank, text, line): 2 where the surface is named, 1 where roughness is, 0 for a number alone.
    other: lines that were taken for neither.
    """

    objects: list[Row] = field(default_factory=list)
    roughness: list[tuple[int, str, str]] = field(default_factory=list)
    other: list[str] = field(default_factory=list)
