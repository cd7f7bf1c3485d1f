# SPDX-License-Identifier: MIT
"""Single entries of an answer: quantities, stiffness classes, yes or no."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from .quantities import DENSITY, LENGTH, MODULUS, ROUGHNESS, has_number, plain, quantity, unit_kind

STIFFNESSES = ("soft", "medium", "hard")
MAX_NAME = 64

ORDER = ("name", "density", "stiffness", "size", "fill")
"""Order of the entries in a line, after its number (the paper's Listing 2)."""

_CLASS = re.compile(r"\b(soft|squishy|medium|moderate|hard|rigid|stiff)\b")
_CLASS_OF = {"squishy": "soft", "moderate": "medium", "rigid": "hard", "stiff": "hard"}
_YES = re.compile(r"(?:yes|y|true|required|needed|solid|filled|full|✓|✔|✅)(?:\W|$)")
_NO = re.compile(r"(?:no|n|not|false|hollow|shell|empty|✗|✘|❌)(?:\W|$)")
_NOTHING = re.compile(r"\W*(?:n/?a|none|null|unknown|unclear|unsure|nil)?\W*\Z")
_NO_NUMBER = re.compile(r"[-+]?(?:nan|inf(?:inity)?|∞)\b|[-+]?∞")
_BARE = re.compile(
    r"\W{0,3}(?:(?:about|approx\w*|around|roughly|ca|between|from|less than|more than)\.?\s+)?[-+]?[\d.,]*\d"
)
_UNITS_IN_KEYS = (
    ("density", r"g_?(?:/|per)?_?(?:cm\^?3|cc|ml)", "g/cm3"),
    ("size", r"cm|centimet(?:er|re)s?", "cm"),
    ("size", r"mm|millimet(?:er|re)s?", "mm"),
    ("size", r"inch(?:es)?|(?<=[_(\[])in(?=\W|\Z)", "in"),
    ("size", r"ft|feet|foot", "ft"),
    ("stiffness", "kpa", "kPa"),
    ("stiffness", "mpa", "MPa"),
    ("stiffness", "gpa", "GPa"),
)


@dataclass(frozen=True)
class ObjectAnswer:
    """The answer about one object; None where nothing could be read.

    density: kg/m³. stiffness: one of ``STIFFNESSES``. youngs_modulus: Pa, if a number was answered. size_m: m. fill:
    whether the whole interior is filled.
    """

    name: str | None = None
    density: float | None = None
    stiffness: str | None = None
    youngs_modulus: float | None = None
    size_m: float | None = None
    fill: bool | None = None

    @property
    def readable(self) -> int:
        """Number of values among density, stiffness, size and filling."""
        stiff = self.stiffness if self.stiffness is not None else self.youngs_modulus
        return sum(value is not None for value in (self.density, stiff, self.size_m, self.fill))


def field_of(key: str) -> str | None:
    """Return the question that ``key`` names: one of ``ORDER``, "number" or "roughness"; None for anything else."""
    if len(key) > 70:
        return None
    letters = re.sub(r"[^a-z]", "", plain(key))
    for field, pattern in (
        ("roughness", "rough"),
        ("density", "densit"),
        ("stiffness", "young|modulus|stiff|elastic"),
        ("fill", "fill"),
        ("size", "size|length|extent|dimension|diameter"),
        ("number", "^(object|item)?(number|id|index|no|nr)$"),
        ("name", "name|^label$|^object$|^item$"),
    ):
        if re.search(pattern, letters):
            return field
    return "number" if key.strip() == "#" else None


def with_unit_of(key: str, field: str, value: str) -> str:
    """Return ``value`` with the unit in its ``key`` appended, as for ``size_cm``."""
    if has_number(value) and unit_kind(value) is None:
        for where, pattern, unit in _UNITS_IN_KEYS:
            if where == field and re.search(rf"(?<![a-z])(?:{pattern})(?![a-z0-9])", plain(key)):
                return f"{value} {unit}"
    return value


def read_named(named: dict[str, str]) -> tuple[ObjectAnswer, list[str]]:
    """Return the answer from entries by question, and what could not be read."""
    answer, wrong = ObjectAnswer(), []
    for field in ORDER:
        text = named.get(field)
        if text is None or (field != "name" and _NOTHING.match(plain(text))):
            continue
        answer, problem = _with(answer, field, text)
        wrong += [problem] if problem else []
    return answer, wrong


def read_cells(cells: Sequence[str]) -> tuple[ObjectAnswer, list[str]]:
    """Return the answer from the ``cells`` of a line without its number: by position, or by type if some are
    missing."""
    cells = list(cells)
    while len(cells) > len(ORDER) and not cells[-1].strip():
        cells.pop()
    if len(cells) == len(ORDER):
        fitting = sum(_fits(field, cell) for field, cell in zip(ORDER[1:], cells[1:], strict=True))
        if fitting >= 3:
            return read_named(dict(zip(ORDER, cells, strict=True)))
    return _by_kind(cells)


def joined_numbers(cells: list[str]) -> list[str]:
    """Return ``cells`` of a line without blanks, with numbers rejoined that were split at their commas.

    Thousands first, then decimals, and only while there are too many cells: the name comes first, and soft, medium or
    hard and yes or no separate the numbers.
    """
    cells = list(cells)
    for first, second in ((r"\s*[1-9]\d{0,2}", r"\d{3}(?:\.\d+)?(?!\d)"), (r"\s*\d+", r"\d+(?![\d.e])")):
        i = 1
        while len(cells) > len(ORDER) and i + 1 < len(cells):
            cut = re.fullmatch(first, cells[i]) and re.match(second, cells[i + 1])
            if cut and unit_kind(cells[i + 1]) is not MODULUS:
                cells[i : i + 2] = [f"{cells[i].strip()},{cells[i + 1]}"]
            i += 1
    return cells


def _fits(field: str, cell: str) -> bool:
    kind = _kind_of(cell)
    if kind == "bare":
        return field in ("density", "size", "stiffness") or (field == "fill" and cell.strip() in ("0", "1"))
    return kind in (field, "nothing")


def _kind_of(cell: str) -> str:
    """The type of a cell: one of ``ORDER``, "bare" for a number without a unit, or "nothing"."""
    text = plain(cell[: MAX_NAME * 2]).strip()
    if _NOTHING.match(text):
        return "nothing"
    if _NO_NUMBER.match(text):
        return "bare"
    words = len(re.sub(r"\(.*?\)", " ", text).split())
    if words <= 4 and (_YES.match(text) or _NO.match(text)):
        return "fill"
    if words <= 4 and _CLASS.search(text):
        return "stiffness"
    if has_number(text) and _BARE.match(text) and words <= 6:
        kind = unit_kind(text)
        return (
            {DENSITY: "density", LENGTH: "size", MODULUS: "stiffness"}[kind]
            if kind in (DENSITY, LENGTH, MODULUS)
            else "bare"
        )
    return "name"


def _by_kind(cells: Sequence[str]) -> tuple[ObjectAnswer, list[str]]:
    kinds = [_kind_of(cell) for cell in cells]
    named: dict[str, str] = {}
    wrong = []
    for kind, cell in zip(kinds, cells, strict=True):
        if kind not in ("bare", "nothing"):
            if kind not in named:
                named[kind] = cell
            elif kind == "stiffness":
                # Both a class and a modulus.
                named[kind] = f"{named[kind]} ({cell})"
            elif kind != "name":
                wrong.append(f"{cell.strip()[:MAX_NAME]!r} is a second {kind}")
    bare = [i for i, kind in enumerate(kinds) if kind == "bare"]
    anchor = kinds.index("stiffness") if "stiffness" in kinds else None
    free = [field for field in ("density", "size") if field not in named]
    if anchor is not None:
        for i in bare:
            field = "density" if i < anchor else "size"
            if field in named:
                wrong.append(f"number {cells[i].strip()[:MAX_NAME]!r} is one too many")
            else:
                named[field] = cells[i]
    elif len(bare) == len(free):
        named |= {field: cells[i] for field, i in zip(free, bare, strict=True)}
    elif bare:
        wrong.append("the numbers are ambiguous")
    answer, problems = read_named(named)
    return answer, wrong + problems


def _with(answer: ObjectAnswer, field: str, text: str) -> tuple[ObjectAnswer, str]:
    if field == "name":
        name = " ".join("".join(c if c.isprintable() else " " for c in re.sub(r"\([^()]*\)", " ", text)).split()).strip(
            "*`\"'[]().:;,- "
        )
        good = 0 < len(name) <= MAX_NAME and len(name.split()) <= 6 and not _NOTHING.match(plain(name))
        return (replace(answer, name=name), "") if good else (answer, "")
    if field == "stiffness":
        return _stiffness(answer, text)
    if field == "fill":
        fill = yes_or_no(text)
        return replace(
            answer, fill=fill
        ), "" if fill is not None else f"filling {text.strip()[:MAX_NAME]!r} is neither yes nor no"
    kind = DENSITY if field == "density" else LENGTH
    value, problem = quantity(text, kind)
    return (replace(answer, density=value) if kind is DENSITY else replace(answer, size_m=value)), problem


def _stiffness(answer: ObjectAnswer, text: str) -> tuple[ObjectAnswer, str]:
    line = plain(text[: MAX_NAME * 4])
    outside = re.sub(r"\(.*?\)", " ", line)
    for part in (outside, line):
        found = {_CLASS_OF.get(word, word) for word in _CLASS.findall(part)}
        if len(found) > 1:
            return answer, f"stiffness {text.strip()[:MAX_NAME]!r} names several classes"
        if found:
            break
    value, problem = quantity(line, MODULUS) if has_number(line) else (None, "")
    if found:
        return replace(answer, stiffness=found.pop(), youngs_modulus=value), ""
    problem = problem or (
        "" if value is not None else f"stiffness {text.strip()[:MAX_NAME]!r} is not soft, medium or hard"
    )
    return replace(answer, youngs_modulus=value), problem


def yes_or_no(text: str) -> bool | None:
    """Return True for yes, False for no, None for neither."""
    line = plain(text[:MAX_NAME]).strip(" *`\"'.[]()")
    if line in ("0", "1"):
        return line == "1"
    if _NO.match(line):
        return False
    return True if _YES.match(line) else None


def read_roughness(text: str) -> tuple[float | None, str]:
    """Return (roughness, "") from ``text``, ignoring a quoted scale (0 to 1), or (None, reason)."""
    rough = plain(text[:300]).partition("rough")[2]
    text = rough if has_number(rough) else text
    line = re.sub(
        r"\b0(?:\.0)?\s*(?:to|-|–|—|and)\s*1(?:\.0)?\b(?!\.\d)|/\s*1(?:\.0)?\b(?!\.\d)", " ", plain(text[:300])
    )
    return quantity(line, ROUGHNESS)
