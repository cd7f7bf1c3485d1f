# SPDX-License-Identifier: MIT
"""Split a model's answer into rows: lines, lists, tables, blocks of keys and values, JSON. No value is read yet."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from typing import Any

from .answer_entries import ORDER, STIFFNESSES, field_of, joined_numbers, with_unit_of
from .quantities import has_number, plain

MAX_LINES = 1000
MAX_LINE = 500

SURFACE = re.compile(r"rough|\b(?:surface|ground|table|tabletop|floor|desk|supporting)\b")
"""Words for the supporting surface, in plain letters."""

LONE = re.compile(r"\W{0,2}\d*[.,]?\d+(?:e-?\d)?\s*%?(?:\s*(?:-|–|to)\s*\d*[.,]?\d+\s*%?)?\W{0,2}\Z")
"""A number, a percentage or a range, and nothing else."""


@dataclass
class Row:
    """The content of one line or block: ``cells`` by position or ``named`` by question, and the original ``line``."""

    line: str
    number: int | None = None
    cells: list[str] = field(default_factory=list)
    named: dict[str, str] = field(default_factory=dict)


@dataclass
class Rows:
    """All rows of an answer.

    roughness: (rank, text, line): 2 if the surface is named, 1 if roughness is, 0 for a lone number. other: lines that
    are neither.
    """

    objects: list[Row] = field(default_factory=list)
    roughness: list[tuple[int, str, str]] = field(default_factory=list)
    other: list[str] = field(default_factory=list)


_PREFIX = re.compile(
    r"(?:[-*•+>]\s+)*(?:(?:object|obj|item|number|no|nr)\b[.\s]*)?[#(\[]?(\d{1,3})[\])]?(?:\s*[:.)]\s+|\s*[:)]|\s+[-–—]\s+|\s+(?=[a-z])|\s*\Z)",
    re.IGNORECASE,
)
_BULLET = re.compile(r"(?:[-*•+>]\s+)+")
_SEPARATOR = re.compile(r"[\s|:=+_*~-]*\Z")
_KEY = re.compile(r"([^:=,;|]{1,70}?)\s*[:=]\s*(.*)\Z")
_LAST_ROUGHNESS = re.compile(r"[.;,|]\s+([^.;,|]*\brough[^,;|]*\d[^,;|]*)\Z", re.IGNORECASE)
_INTEGER = re.compile(r"\s*(?:object|obj|item)?\s*[#(\[]?(\d{1,3})[\])]?\s*", re.IGNORECASE)
_HEADING = re.compile(r"[^\W\d][^\d:]{0,40}:\Z")


class LineReader:
    """Read an answer line by line; remembers the columns of a table and the object that a block describes."""

    def __init__(self, rows: Rows, count: int) -> None:
        self._rows, self._count = rows, count
        self._columns: list[tuple[str | None, str]] = []
        self._block: Row | None = None

    def read(self, raw: str) -> None:
        """Read the next line of the answer."""
        line = re.sub(r"\*\*|__(?=\W|$)|(?<!\w)__|`", "", raw).strip()
        if _SEPARATOR.match(line):
            return
        while len(line) > 1 and line[0] + line[-1] in ('""', "''", "“”", "[]", "()", "{}"):
            line = line[1:-1].strip()
        line = re.sub(r"\A#{1,6}\s+", "", line)
        if line.count(",") >= 3 and (match := _LAST_ROUGHNESS.search(line)):
            # The surface's roughness at the end of an object's line.
            self.read(match[1])
            raw = line = line[: match.start()]
        table = line.count("|") >= 2
        cells = split_cells(line.strip("|") if table else _BULLET.sub("", line, count=1), table)
        if self._is_header(cells):
            return
        number = None
        if not table:
            match = _PREFIX.match(line)
            if match and not LONE.match(_BULLET.sub("", line, count=1)):
                number, line = int(match[1]), line[match.end() :].strip()
            line = _BULLET.sub("", line, count=1) if number is None else line
            cells = split_cells(line, table)
        if self._columns and len(cells) >= len(self._columns) > 1 and not self._lone(line):
            self._add_by_columns(cells, number, raw)
        elif self._lone(line) and not (number is not None and number <= self._count and "." not in line):
            self._rows.roughness.append((0, line, raw))
        elif not (self._add_named(line, cells, number, raw) or self._add_cells(line, cells, number, raw)):
            self._rows.other.append(raw.strip())

    def _lone(self, line: str) -> bool:
        return LONE.match(re.sub(r"\([^()]*\)", "", line).strip()) is not None

    def _is_header(self, cells: list[str]) -> bool:
        columns = [(field_of(cell), cell) for cell in cells]
        known = {name for name, _ in columns if name}
        if len(known) < 3 or len(known) * 2 < len(cells) or any(re.search(r"[:=]\s*\S", c) for c in cells):
            return False
        self._columns = columns
        return True

    def _add_by_columns(self, cells: list[str], number: int | None, raw: str) -> None:
        row = Row(raw.strip(), number)
        columns = self._columns
        if number is not None and len(cells) == len(columns) - 1 and columns[0][0] == "number":
            columns = columns[1:]
        for (name, key), cell in zip(columns, cells, strict=False):
            if name == "number":
                digits = re.search(r"\d{1,3}", cell)
                row.number = int(digits[0]) if digits else number
            elif name == "roughness":
                self._rows.roughness.append((1, cell, row.line))
            elif name:
                row.named[name] = with_unit_of(key, name, cell)
        self._rows.objects.append(row)

    def _add_named(self, line: str, cells: list[str], number: int | None, raw: str) -> bool:
        """Read "key: value" pairs, one or several in a line; return whether the line had that form."""
        pairs = [(field_of(m[1]), m[1], m[2]) for cell in cells if (m := _KEY.match(cell))]
        known = [(name, key, value) for name, key, value in pairs if name in ORDER and value]
        if len(known) >= 2 or (len(known) == 1 and len(cells) <= 2 and "rough" not in plain(line)):
            fresh = number is not None or len(known) >= 2
            first = known[0][0]
            if fresh or self._block is None or first in self._block.named:
                self._block = Row(raw.strip(), number)
                self._rows.objects.append(self._block)
                lead = cells[0] if not _KEY.match(cells[0]) else ""
                if lead and "name" not in [name for name, _, _ in known]:
                    self._block.named["name"] = lead
            for name, key, value in known:
                self._block.named[str(name)] = with_unit_of(key, str(name), value)
            return True
        if self._has_roughness(line) and (len(cells) <= 3 or "rough" in plain(line)) and has_number(line):
            after = line.partition(":")[2] if has_number(line.partition(":")[2]) else line
            self._rows.roughness.append(
                (2 if re.search("surface|ground|table|floor|support", plain(line)) else 1, after, raw)
            )
            return True
        heading = _HEADING.match(line) is not None and len(line.split()) <= 3 and not self._has_roughness(line)
        if len(cells) == 1 and not has_number(line) and (number is not None or heading):
            # "Object 1: camera" or "Camera:" opens a block.
            self._block = Row(raw.strip(), number, named={"name": line.rstrip(":")} if line else {})
            self._rows.objects.append(self._block)
            return True
        return False

    def _has_roughness(self, line: str) -> bool:
        return SURFACE.search(plain(line)) is not None

    def _add_cells(self, line: str, cells: list[str], number: int | None, raw: str) -> bool:
        match = _KEY.match(cells[0])
        if match and match[2] and field_of(match[1]) is None:
            # "camera_model: 200, soft, 0.15, yes"
            number_first = _INTEGER.fullmatch(match[2])
            small = number_first is not None and int(number_first[1]) <= self._count
            label = small and len(cells) > 1 and re.match(r"[^\W\d]", cells[1]) and cells[1].lower() not in STIFFNESSES
            # "Answer: 1, camera_model, …"
            cells = cells if label else [match[1], match[2], *cells[1:]]
            cells[0] = match[2] if label else cells[0]
        first = _INTEGER.fullmatch(cells[0])
        if number is None and first and len(cells) > 1:
            named_next = bool(re.match(r"\s*[^\W\d]", cells[1]))
            if int(first[1]) <= self._count or named_next:
                number, cells = int(first[1]), cells[1:]
        elif number is not None and first and int(first[1]) == number and len(cells) > len(ORDER):
            # "1. 1, camera, …"
            cells = cells[1:]
        if len(cells) == 1 and self._lone(cells[0]) and number is not None:
            self._rows.roughness.append((0, cells[0], raw))
            return True
        if len(cells) == 1 and 4 <= len(words := line.split()) <= 6 and set(map(str.lower, words)) & set(STIFFNESSES):
            cells = words[1:] if len(words) > len(ORDER) else words
        if len(cells) < 2:
            return False
        if not re.search(r",\s", line):
            cells = joined_numbers(cells)
        self._block = None
        self._rows.objects.append(Row(raw.strip(), number, cells))
        return True


def split_cells(line: str, table: bool = False) -> list[str]:
    """Return the entries of ``line``, split at bars of a table, at semicolons or tabs if there are several, else at
    commas.

    Where commas are followed by spaces, one without a space between two digits belongs to a number.
    """
    if table:
        return [cell.strip() for cell in line.split("|")]
    line = re.sub(r"\([^()]*\)", lambda match: match[0].replace(",", " "), line.replace("，", ", "))
    for mark in (";", "\t"):
        if line.count(mark) >= 2:
            return [cell.strip() for cell in line.split(mark)]
    if "," not in line and len(dashed := re.split(r"\s[-–—]\s", line)) >= 4:
        return [cell.strip() for cell in dashed]
    if len(re.findall(r",\s", line)) >= 2:
        return [cell.strip() for cell in re.split(r",(?!\d)|(?<!\d),", line)]
    return [cell.strip() for cell in line.split(",")]


_STARTS = 8
"""Largest number of lines that are tried as the start of JSON."""


def read_json(text: str, rows: Rows) -> bool:
    """Read the first JSON value in ``text`` that describes objects into ``rows``; return False if there is none."""
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
    """Offsets of the first lines that begin with a brace or bracket."""
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
    """If the JSON describes objects only, read the surface's roughness from a separate line."""
    if rows.roughness:
        return
    for line in text.splitlines()[:MAX_LINES]:
        line = line[:MAX_LINE].strip()
        if LONE.match(line) or ("rough" in plain(line) and has_number(line) and not re.search(r"[{}\[\]]", line)):
            rows.roughness.append((0, line, line))
