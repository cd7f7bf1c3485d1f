# SPDX-License-Identifier: MIT
"""JSON in an answer → rows."""

from __future__ import annotations

import json
import re
from typing import Any

from .answer_lines import LineReader
from .answer_rows import LONE, MAX_LINE, MAX_LINES, SURFACE, Row, Rows
from .entries import ORDER, field_of, with_unit_of
from .quantity import has_number, plain

_STARTS = 8
"""So many lines may begin what could be JSON."""


def read_json(text: str, rows: Rows) -> bool:
    """Take the first JSON value in ``text`` that speaks of objects; False where there is none."""
    decoder = json.JSONDecoder()
    for start in _beginnings(text):
        try:
            value, _ = decoder.raw_decode(text, start)
        except (ValueError, RecursionError):
            continue
        found = Rows()
        _walk(value, found, None, 4)
        if found.objects:
            rows.objects, rows.roughness = found.objects, found.roughness
            _trailing_roughness(text, rows)
            return True
    return False


def _beginnings(text: str) -> list[int]:
    """Where the first lines that begin with a brace or bracket do so."""
    place = 0
    starts: list[int] = []
    for line in text.splitlines(keepends=True)[:MAX_LINES]:
        bare = line.lstrip(" \t`").removeprefix("json").lstrip()
        if bare[:1] in ("{", "[") and len(starts) < _STARTS:
            starts.append(place + len(line) - len(bare))
        place += len(line)
    return starts


def _walk(value: Any, rows: Rows, number: int | None, depth: int) -> None:
    if depth == 0:
        return
    if isinstance(value, list):
        if value and all(isinstance(item, str) and item.count(",") >= 3 for item in value):
            reader = LineReader(rows, len(value))
            for item in value[:MAX_LINES]:
                reader.read(item[:MAX_LINE])
            return
        if len(value) >= 4 and not any(isinstance(item, dict | list) for item in value):
            _walk_list(value, rows)
            return
        for item in value[:MAX_LINES]:
            _walk(item, rows, None, depth - 1)
    elif isinstance(value, dict):
        named = {}
        row_number = number
        for key, item in list(value.items())[:MAX_LINES]:
            name = field_of(key)
            digits = re.search(r"\d{1,3}\Z", key)
            if isinstance(item, dict) and SURFACE.search(plain(key[:70])):
                rough = [_word(value) for name, value in item.items() if field_of(name) == "roughness"]
                rows.roughness += [(2, word, f"{key[:70]}: {word}") for word in rough[:1]]
            elif isinstance(item, dict | list) and not (name in ORDER and isinstance(item, list)):
                _walk(item, rows, int(digits[0]) if digits else None, depth - 1)
            elif name == "roughness" or (name is None and SURFACE.search(plain(key[:70]))):
                rows.roughness.append((2 if depth == 4 else 1, _word(item), f"{key[:70]}: {_word(item)}"))
            elif name == "number" or (key.lower() == "object" and isinstance(item, int)):
                row_number = item if isinstance(item, int) and 0 <= item < 1000 else number
            elif name:
                named[name] = with_unit_of(key, name, _word(item))
        if len(named) >= 2:
            rows.objects.append(
                Row(json.dumps(value, ensure_ascii=False, default=str)[:MAX_LINE], row_number, named=named)
            )


def _walk_list(value: list[Any], rows: Rows) -> None:
    cells = [_word(item) for item in value]
    number = (
        value[0] if isinstance(value[0], int) and not isinstance(value[0], bool) and len(value) > len(ORDER) else None
    )
    rows.objects.append(Row(", ".join(cells)[:MAX_LINE], number, cells[1:] if number is not None else cells))


def _word(item: Any) -> str:
    if isinstance(item, list):
        # Three sides, or the ends of a range.
        joined = " x " if len(item) > 2 else " - "
        return joined.join(_word(part) for part in item[:3] if not isinstance(part, list | dict))
    return "" if item is None else str(item)[:MAX_LINE]


def _trailing_roughness(text: str, rows: Rows) -> None:
    """Where JSON tells of objects only, a line of its own may tell of the surface."""
    if rows.roughness:
        return
    for line in text.splitlines()[:MAX_LINES]:
        line = line[:MAX_LINE].strip()
        if LONE.match(line) or ("rough" in plain(line) and has_number(line) and not re.search(r"[{}\[\]]", line)):
            rows.roughness.append((0, line, line))
