# SPDX-License-Identifier: MIT
"""Damage and malice, repeatable by seed: bytes that were changed, and JSON whose values are."""

from __future__ import annotations

import copy
import json
import random
import re
from typing import Any

NUMBERS = (0, -1, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 10**30, 10**400, 1e308, -1e308, 1e-320, 0.5)
VALUES = (
    *NUMBERS,
    float("nan"),
    float("inf"),
    True,
    None,
    "",
    "x" * 70_000,
    "\ud800",
    "a\0b",
    "../../etc/passwd",
    "/dev/zero",
    "con",
    "é" * 200,
    "1e999",
    [],
    {},
    [[]],
    [1, "two", None],
    {"x": {"y": 0}},
)
_DIGITS = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")


def mutated(content: bytes, choose: random.Random, *, as_json: bool) -> bytes:
    """Return ``content`` changed in one to three ways."""
    found = content
    if as_json and choose.random() < 0.7:
        try:
            found = _json(content, choose)
        except ValueError:
            found = content
        if choose.random() < 0.8:
            return found
    for _ in range(choose.choice((1, 1, 1, 2, 3))):
        found = choose.choice(_WAYS)(found, choose)
    return found


def _flip(content: bytes, choose: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(choose.choice((1, 1, 2, 8)) if data else 0):
        data[_place(data, choose)] ^= 1 << choose.randrange(8)
    return bytes(data)


def _place(data: bytes | bytearray, choose: random.Random) -> int:
    """Return an index; headers at the beginning and lists at the end are hit more often than what lies between."""
    near = min(len(data), 256)
    return choose.choice((choose.randrange(len(data)), choose.randrange(near), len(data) - 1 - choose.randrange(near)))


def _cut(content: bytes, choose: random.Random) -> bytes:
    return content[: choose.randrange(len(content) + 1)]


def _splice(content: bytes, choose: random.Random) -> bytes:
    """A piece of the content is left out, repeated elsewhere, or replaced by noise."""
    if not content:
        return content
    start = _place(content, choose)
    piece = content[start : start + choose.choice((1, 4, 16, 256, 4096))]
    where = _place(content, choose)
    return choose.choice(
        (
            content[:start] + content[start + len(piece) :],
            content[:where] + piece + content[where:],
            content[:start] + choose.randbytes(len(piece)) + content[start + len(piece) :],
            content[:start] + bytes(len(piece)) + content[start + len(piece) :],
            content[:where] + piece * 50 + content[where:],
        )
    )


def _word(content: bytes, choose: random.Random) -> bytes:
    """Two, four or eight bytes become a number that programs count by."""
    size = choose.choice((2, 4, 8))
    if len(content) < size:
        return content
    value = choose.choice((0, 1, -1, 127, 2**15, 2**31 - 1, -(2**31), 2**32 - 1, 2**62, 255, 65535))
    word = (value & (2 ** (8 * size) - 1)).to_bytes(size, choose.choice(("little", "big")))
    place = min(_place(content, choose), len(content) - size)
    return content[:place] + word + content[place + size :]


def _number(content: bytes, choose: random.Random) -> bytes:
    """A number that is written out becomes another."""
    found = list(_DIGITS.finditer(content[:200_000]))
    if not found:
        return _word(content, choose)
    at = choose.choice(found)
    value = str(choose.choice((*NUMBERS[:-1], "nan", "-inf", "1e400", "0x10", "1_000"))).encode()
    return content[: at.start()] + value[:5000] + content[at.end() :]


def _line(content: bytes, choose: random.Random) -> bytes:
    """A line is left out, repeated, emptied or made long."""
    lines = content.split(b"\n")
    at = choose.randrange(len(lines))
    ways = ([], [lines[at]] * 2, [b""], [lines[at] + b" " + b"x" * 70_000], [b"[" * 3000], [lines[at][::-1]])
    return b"\n".join(lines[:at] + choose.choice(ways) + lines[at + 1 :])


_WAYS = (_flip, _flip, _cut, _splice, _splice, _word, _number, _line)


def _json(content: bytes, choose: random.Random) -> bytes:
    tree = json.loads(content)
    for _ in range(choose.choice((1, 1, 2))):
        holder, key = choose.choice(_slots(tree) or [([tree], 0)])
        way = choose.randrange(10)
        if way == 0:
            del holder[key]
        elif way == 1 and isinstance(holder, dict):
            holder[choose.choice(("unknown", "", "x" * 70_000, "format"))] = holder.pop(key)
        elif way == 2:
            _, other = choose.choice([(None, None), *((h, h[k]) for h, k in _slots(tree))])
            holder[key] = json.loads(json.dumps(other))
        elif way == 3 and isinstance(holder[key], list) and holder[key]:
            holder[key] = holder[key] * choose.choice((2, 3, 1000))
        elif way == 4:
            holder[key] = _deep(choose)
        else:
            # A copy: a second change may be in it, and no input may depend on earlier ones.
            holder[key] = copy.deepcopy(choose.choice(VALUES))
        if isinstance(tree, dict | list) and not tree:
            break
    text = _written(tree)
    if choose.random() < 0.1:
        # The same key twice; the last one counts.
        text = re.sub(r'\{\s*("[^"]{1,40}": )', lambda at: "{" + at[1] + "0, " + at[1], text, count=3)
    return text.encode("utf-8", "surrogatepass")


def _written(tree: object) -> str:
    try:
        return json.dumps(tree, ensure_ascii=False)
    except ValueError:
        # Integers of more than 4300 digits are not printed.
        return "1" + "0" * 5000


def _deep(choose: random.Random) -> object:
    value: object = 0
    for _ in range(choose.choice((20, 500))):
        value = [value] if choose.random() < 0.5 else {"a": value}
    return value


def _slots(tree: object) -> list[tuple[Any, Any]]:
    """Return (holder, key) of every value in ``tree``, to a depth of 13."""
    found: list[tuple[Any, Any]] = []
    level = [tree]
    for _ in range(13):
        below = []
        for holder in level:
            if isinstance(holder, dict):
                found += [(holder, key) for key in holder]
                below += [value for value in holder.values() if isinstance(value, dict | list)]
            elif isinstance(holder, list):
                found += [(holder, index) for index in range(len(holder))]
                below += [value for value in holder if isinstance(value, dict | list)]
        level = below
    return found
