# SPDX-License-Identifier: MIT
"""Numbers with units in a model's answer, as SI."""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass

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
