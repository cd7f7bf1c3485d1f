# SPDX-License-Identifier: MIT
"""Single entries of an answer: numbers with units to SI, stiffness classes, yes or no."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace

MAX_CHARS = 300
"""Largest length of one entry."""

_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺", "0123456789-+")
# Atomic, so that 1e-3 is never split into 1 and a rest. 1.200,5 and 1,200.5 are both accepted; 1.200 is 1.2.
_NUMBER = (
    r"(?>[-+]?(?:\d{1,3}(?:,\d{3})+(?![\d,])(?:\.\d+)?|\d{1,3}(?:\.\d{3})+,\d+|\d{1,3}(?:[ '_]\d{3})+(?!\d)(?:\.\d+)?"
    r"|\d+(?:[.,]\d+)?|[.,]\d+)(?:e[-+]?\d{1,4})?)"
)
_UNIT = r"[a-z%\"'](?:[a-z0-9%^/*().]|-(?=\d\b(?!.*\d)))*(?:\s*/\s*[a-z]+\^?\d?|\s(?:m|cm|mm|ft|in)\^?-3)?"
_RANGE = re.compile(
    rf"({_NUMBER})\s*({_UNIT})?\s*(?:-|–|—|~|\.{{2,3}}|…|\bto\b|\band\b|\bor\b)\s*({_NUMBER})\s*({_UNIT})?"
)
_SINGLE = re.compile(rf"({_NUMBER})\s*({_UNIT})?")
_BETWEEN_SIDES = re.compile(r"\s*(?:x|\*|\bby\b)\s*(?=[\d.,])")
_PHRASES = tuple(
    (re.compile(pattern), short)
    for pattern, short in (
        (r"(?<=\d)\s*(?:x|\*|\\times)\s*10\s*(?:\^|\*\*)\s*\{?\s*([-+]?\d{1,4})\s*\}?", r"e\1"),
        (r"(?<![\d.,])10\s*(?:\^|\*\*)\s*\{?\s*([-+]?\d{1,4})\s*\}?", r"1e\1"),
        (r"\bkilograms?\b|\bkgs\b", "kg"),
        (r"\bgrams?\b", "g"),
        (r"\s*(?:\bper\b|/)\s*\(?(?:cubic|cu\.?)\s+met(?:er|re)s?\)?|\s*\bper\s+m\^?3", "/m3"),
        (r"\s*(?:\bper\b|/)\s*\(?(?:cubic|cu\.?)\s+centimet(?:er|re)s?\)?|\s*\bper\s+cm\^?3", "/cm3"),
        (r"\s*(?:\bper\b|/)\s*\(?(?:cubic|cu\.?)\s+(?:foot|feet|ft)\)?", "/ft3"),
    )
)

_LENGTH = {
    "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0, "cm": 0.01, "centimeter": 0.01,
    "centimeters": 0.01, "centimetre": 0.01, "centimetres": 0.01, "mm": 1e-3, "millimeter": 1e-3, "millimeters": 1e-3,
    "millimetre": 1e-3, "millimetres": 1e-3, "dm": 0.1, "km": 1e3, "um": 1e-6, "in": 0.0254, "inch": 0.0254,
    "inches": 0.0254, '"': 0.0254, "ft": 0.3048, "foot": 0.3048, "feet": 0.3048, "'": 0.3048, "yd": 0.9144,
}  # fmt: skip
_PRESSURE = {
    "pa": 1.0, "pascal": 1.0, "pascals": 1.0, "n/m2": 1.0, "kpa": 1e3, "mpa": 1e6, "n/mm2": 1e6, "gpa": 1e9,
    "psi": 6894.757, "ksi": 6.894757e6, "bar": 1e5,
}  # fmt: skip
_DENSITY = {
    "kg/m3": 1.0, "g/cm3": 1e3, "g/cc": 1e3, "g/ml": 1e3, "kg/l": 1e3, "kg/dm3": 1e3, "t/m3": 1e3, "g/l": 1.0,
    "mg/cm3": 1.0, "g/m3": 1e-3, "lb/ft3": 16.018463, "lbs/ft3": 16.018463, "lb/in3": 27679.905, "kgm-3": 1.0,
    "gcm-3": 1e3, "kgpercubicmeter": 1.0, "kgpercubicmetre": 1.0,
}  # fmt: skip
_OTHER = dict.fromkeys(("kg", "g", "mg", "lb", "lbs", "n", "s", "l", "ml", "m2", "m3", "cm3", "j", "w"), math.nan)
_SHARE = {"%": 0.01, "percent": 0.01}


@dataclass(frozen=True, eq=False)
class QuantityType:
    """A quantity: its name, units, and the least and largest plausible value in SI units."""

    name: str
    units: dict[str, float]
    low: float
    high: float
    unit: str


DENSITY = QuantityType("density", _DENSITY, 1.0, 23_000.0, "kg/m³")
"""From aerogel and feathers to osmium."""
LENGTH = QuantityType("size", _LENGTH, 1e-3, 200.0, "m")
"""From a grain to a large building; anything larger is not an object on a surface."""
MODULUS = QuantityType("Young's modulus", _PRESSURE, 1e2, 1.5e12, "Pa")
"""From the softest gels to diamond."""
ROUGHNESS = QuantityType("roughness", _SHARE, 0.0, 1.0, "")

QUANTITY_TYPES = (DENSITY, LENGTH, MODULUS, ROUGHNESS)


def plain(text: str) -> str:
    """Return ``text`` normalised for the patterns here: lower case, ASCII digits, minus signs and exponents."""
    text = re.sub(r"10([⁻⁺]?[⁰¹²³⁴⁵⁶⁷⁸⁹]+)", lambda m: "10^" + m[1].translate(_SUPERSCRIPTS), text)
    text = text.replace("×", "x").replace("·", "*").replace("−", "-").replace("’", "'").replace("″", '"')
    text = unicodedata.normalize("NFKC", text.translate(_SUPERSCRIPTS)).replace("μ", "µ").lower()
    text = text.replace("µm", "um").replace("$", "").replace("\\,", " ")
    for pattern, short in _PHRASES:
        text = pattern.sub(short, text)
    return text


def unit_kind(text: str) -> QuantityType | None:
    """Return the quantity of the unit beside the first number of ``text``; None without a number or a known unit."""
    match = _SINGLE.search(plain(text[:MAX_CHARS]))
    name = _unit_name(match[2]) if match else ""
    return next((kind for kind in QUANTITY_TYPES if name in kind.units), None)


def has_number(text: str) -> bool:
    """Return whether ``text`` contains a digit."""
    return any("0" <= c <= "9" for c in text)


def quantity(text: str, kind: QuantityType) -> tuple[float | None, str]:
    """Return (value in SI units, "") of the number in ``text``, or (None, reason).

    A range gives its middle: arithmetic for roughness or where an end is 0, else geometric, because ranges of material
    constants span factors. Of several measures (15 x 10 x 5 cm) the largest is used. A number without a unit is in SI
    units. A tolerance (±) is ignored. Never raises.
    """
    line = plain(text[:MAX_CHARS])
    bare = re.sub(r"\([^()]*\)", " ", line)
    line = bare if has_number(bare) else line
    line = re.split(r"±|\+/-|\+-", line)[0]
    if kind is LENGTH and len(sides := _BETWEEN_SIDES.split(line)) > 1:
        return _largest(sides)
    match = _RANGE.search(line)
    if match and not _is_one_number(match):
        unit = match[4] if _known(match[4]) else match[2]
        first, wrong = _scaled(match[1], match[2] if _known(match[2]) else unit, kind)
        second, wrong_too = _scaled(match[3], unit, kind)
        if first is None or second is None:
            return None, wrong or wrong_too
        middle = (first + second) / 2 if kind is ROUGHNESS or min(first, second) <= 0 else math.sqrt(first * second)
        return _plausible(middle, kind)
    single = _SINGLE.search(line)
    if single is None:
        return None, f"{kind.name} {text.strip()[:40]!r} is not a number"
    value, wrong = _scaled(single[1], single[2], kind)
    return (None, wrong) if value is None else _plausible(value, kind)


def _is_one_number(match: re.Match[str]) -> bool:
    """Whether an apparent range is the exponent of a number, as in 10^-3, or a unit's, as in kg m^-3."""
    unit = match[2] or ""
    return unit.endswith(("^", "m")) and match[3] in ("3", "-3") and _unit_name(unit + "-3") in _DENSITY


def _largest(sides: list[str]) -> tuple[float | None, str]:
    """The longest of several measures; those without a unit have that of the last one."""
    found = [match for side in sides if (match := _SINGLE.search(side))]
    last = next((match[2] for match in reversed(found) if _known(match[2])), "")
    values = []
    for match in found:
        value, wrong = _scaled(match[1], match[2] if _known(match[2]) else last, LENGTH)
        if value is None:
            return None, wrong
        values.append(value)
    return _plausible(max(values), LENGTH) if values else (None, "size has no number")


def _known(unit: str | None) -> bool:
    name = _unit_name(unit)
    return bool(name) and (name in _OTHER or any(name in kind.units for kind in QUANTITY_TYPES))


def _unit_name(unit: str | None) -> str:
    """``unit`` in the spelling of the tables here."""
    return re.sub(r"[\s^*(){}\\]|(?<=[a-z])\.", "", unit or "").rstrip(".,;:-")


def _scaled(number: str, unit: str | None, kind: QuantityType) -> tuple[float | None, str]:
    value = _value(number)
    name = _unit_name(unit)
    if name in kind.units:
        return value * kind.units[name], ""
    if name in _OTHER or any(name in other.units for other in QUANTITY_TYPES):
        return None, f"{kind.name} in {name!r} instead of {kind.unit or 'a number from 0 to 1'}"
    return value, ""


def _value(number: str) -> float:
    """``number`` as matched by ``_NUMBER``; infinite if it overflows."""
    mantissa, mark, exponent = re.sub(r"[ '_]", "", number).partition("e")
    if re.fullmatch(r"[-+]?[1-9]\d{0,2}(,\d{3})+(\.\d+)?", mantissa):
        mantissa = mantissa.replace(",", "")
    elif "," in mantissa:
        mantissa = mantissa.replace(".", "").replace(",", ".")
    return float(f"{mantissa}{mark}{exponent}")


def _plausible(value: float, kind: QuantityType) -> tuple[float | None, str]:
    if not (math.isfinite(value) and kind.low <= value <= kind.high):
        return None, f"{kind.name} {value:g} {kind.unit}".rstrip() + f" is not within {kind.low:g} to {kind.high:g}"
    return value, ""


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
