# SPDX-License-Identifier: MIT
"""Parse a model's answer into physics of each object and the surface, and parsing problems.

Understands the format of PhysGen3D (supplement A.3, Listing 2) and what models send in its place (``answer_rows``).
An implausible value is rejected and reported; none is clamped.
"""

from __future__ import annotations

from dataclasses import dataclass

from .answer_entries import ObjectAnswer, read_cells, read_named, read_roughness
from .answer_rows import MAX_LINE, MAX_LINES, LineReader, Row, Rows, read_json
from .quantities import has_number

MAX_TEXT = 2**16
"""Largest number of characters that are read; a typical answer has a few hundred."""

MAX_UNREAD = 40
"""Largest number of problems that are reported."""


@dataclass(frozen=True)
class Answers:
    """A parsed answer.

    objects: one for each object in the question, in order; empty where the answer has none. roughness: of the
    supporting surface, 0 (polished) to 1 (coarse); None if it could not be read. unread: what could not be read, each
    with its line. raw: the answer as received, cut to ``MAX_TEXT`` characters.
    """

    objects: tuple[ObjectAnswer, ...]
    roughness: float | None = None
    unread: tuple[str, ...] = ()
    raw: str = ""


def read_answer(text: str, count: int) -> Answers:
    """Parse the answer ``text`` about ``count`` objects. Never raises."""
    unread: list[str] = []
    if len(text) > MAX_TEXT:
        unread.append(f"the answer has {len(text)} characters; only the first {MAX_TEXT} are read")
    rows = read_rows(text, count)
    read = [(row, *(read_named(row.named) if row.named else read_cells(row.cells))) for row in rows.objects]
    kept = []
    for row, answer, wrong in read:
        if answer.readable >= 2 or (answer.readable and row.number is not None) or (row.named and answer.readable):
            kept.append((row, answer, wrong))
        else:
            rows.other.append(row.line)
    objects = _assigned(kept, count, unread)
    roughness = _roughness(rows, unread)
    unread += [f"line not understood: {_quoted(line)}" for line in rows.other if has_number(line)]
    for number, found in enumerate(objects, start=1):
        if found is None:
            unread.append(f"object {number}: no line in the answer")
    if roughness is None and not any(item.startswith("roughness") for item in unread):
        unread.append("roughness of the surface: none in the answer")
    if len(unread) > MAX_UNREAD:
        unread[MAX_UNREAD - 1 :] = [f"and {len(unread) - MAX_UNREAD + 1} more"]
    return Answers(
        objects=tuple(found or ObjectAnswer() for found in objects),
        roughness=roughness,
        unread=tuple(unread),
        raw=text[:MAX_TEXT],
    )


def read_rows(text: str, count: int) -> Rows:
    """Return the rows of an answer about ``count`` objects. Never raises; takes time proportional to ``MAX_TEXT``."""
    text = text[: 2 * MAX_TEXT]
    if "</think>" in text:
        # Reasoning models draft answers before the final one.
        text = text.rpartition("</think>")[2]
    text = text[:MAX_TEXT]
    rows = Rows()
    if read_json(text, rows):
        return rows
    reader = LineReader(rows, count)
    for line in text.splitlines()[:MAX_LINES]:
        reader.read(line[:MAX_LINE])
    return rows


def _assigned(
    kept: list[tuple[Row, ObjectAnswer, list[str]]], count: int, unread: list[str]
) -> list[ObjectAnswer | None]:
    """The answers in the order of the objects: by their numbers, the others in the remaining places."""
    numbers = _numbers([row.number for row, _, _ in kept], count)
    objects: list[ObjectAnswer | None] = [None] * count
    by_object: list[list[str]] = [[] for _ in range(count)]
    for (row, answer, wrong), number in zip(kept, numbers, strict=True):
        if number is None:
            continue
        if not 1 <= number <= count:
            unread.append(f"object {number}: there are {count} objects; left out: {_quoted(row.line)}")
            continue
        before = objects[number - 1]
        if before is not None and before != answer:
            unread.append(f"object {number}: answered more than once, the last counts: {_quoted(row.line)}")
        objects[number - 1], by_object[number - 1] = answer, _problems(number, row, answer, wrong)
    for (row, answer, wrong), number in zip(kept, numbers, strict=True):
        if number is None:
            if None not in objects:
                unread.append(f"more lines than the {count} objects; left out: {_quoted(row.line)}")
                continue
            free = objects.index(None)
            objects[free], by_object[free] = answer, _problems(free + 1, row, answer, wrong)
    unread += [problem for problems in by_object for problem in problems]
    return objects


def _numbers(numbers: list[int | None], count: int) -> list[int | None]:
    """``numbers`` counted from 1; all None if they cannot be numbers of objects."""
    given = [number for number in numbers if number is not None]
    if len(given) == len(numbers) == count and sorted(given) == list(range(count)):
        return [number + 1 for number in given]
    if len(given) > 1 and len(given) == count and len(set(given)) == 1:
        # Markdown allows every list item to be "1."
        return [None] * len(numbers)
    return numbers


def _problems(number: int, row: Row, answer: ObjectAnswer, wrong: list[str]) -> list[str]:
    missing = [
        name
        for name, value, mark in (
            ("density", answer.density, "density"),
            ("stiffness", answer.stiffness if answer.stiffness else answer.youngs_modulus, "stiffness"),
            ("size", answer.size_m, "size"),
            ("filling", answer.fill, "filling"),
        )
        if value is None
        and not any(text.startswith(mark) for text in wrong)
        and not (mark == "stiffness" and any(text.startswith("Young") for text in wrong))
    ]
    problems = [*wrong, *([f"no {' and no '.join(missing)}"] if missing else [])]
    return [f"object {number}: {problem} in {_quoted(row.line)}" for problem in problems]


def _roughness(rows: Rows, unread: list[str]) -> float | None:
    """Roughness of the surface: from text that names the surface, else that names roughness, else from a lone
    number."""
    for rank in (2, 1, 0):
        found = []
        for _, text, line in (item for item in rows.roughness if item[0] == rank):
            value, wrong = read_roughness(text)
            if value is None:
                unread.append(f"{wrong if wrong.startswith('roughness') else 'roughness: ' + wrong} in {_quoted(line)}")
            else:
                found.append((value, line))
        if found:
            if len({value for value, _ in found}) > 1:
                unread.append(f"roughness: answered more than once, the last counts: {_quoted(found[-1][1])}")
            return found[-1][0]
    return None


def _quoted(line: str) -> str:
    plain = " ".join("".join(c if c.isprintable() else " " for c in line[:400]).split())
    return repr(plain if len(plain) <= 120 else plain[:119] + "…")
