# SPDX-License-Identifier: MIT
"""The result of an evaluation: sections of figures and curves, as JSON, as tables and in words."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_bytes, write_json
from ..errors import InputError
from ..version import VERSION

FORMAT = "physgen-evaluation/1"
JSON_FILE, PAGE_FILE = "evaluation.json", "report.html"
MEASURES_FILE, CURVES_FILE = "measures.csv", "curves.csv"

HIGHER, LOWER, NEITHER = "higher", "lower", "neither"
"""Which direction of a figure is better; ``neither`` where it only describes."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """One figure.

    name: identifier, of one meaning (docs/evaluation.md). title: in words. value: None where it cannot be computed,
    and then ``note`` says why. unit: empty for a pure number. better: one of ``HIGHER``, ``LOWER``, ``NEITHER``.
    still: the same figure of a video that stands still; None where that means nothing. note: what else to know.
    """

    name: str
    title: str
    value: float | None
    unit: str = ""
    better: str = NEITHER
    still: float | None = None
    note: str = ""

    @property
    def below_still(self) -> bool:
        """Whether a video that stands still does better."""
        if self.value is None or self.still is None or self.better == NEITHER:
            return False
        return self.value < self.still if self.better == HIGHER else self.value > self.still


@dataclass(frozen=True, kw_only=True)
class Curve:
    """A figure over time. times: (N,) seconds from the first frame. values: (N,), NaN where unknown.

    name: that of the measure it belongs to. label: of which of several curves this is, such as an object.
    """

    name: str
    title: str
    times: NDArray[np.float64]
    values: NDArray[np.float64]
    unit: str = ""
    label: str = ""


@dataclass(frozen=True, kw_only=True)
class Section:
    """Figures of one kind. name: identifier. text: what was compared with what. notices: what to know before.

    failures: those of the notices that name an input which could not be used although it should have been.
    """

    name: str
    title: str
    text: str
    measures: tuple[Measure, ...]
    curves: tuple[Curve, ...] = ()
    notices: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The figures of one video or bake. Made by ``evaluate``; its folder holds a page, JSON and tables.

    root: the folder. subject: name of what was evaluated. sections: figures by kind. notices: of all sections.

    >>> import physgen
    >>> found = physgen.evaluate("video.mp4", against=["take1.mp4"], out="evaluation")  # doctest: +SKIP
    >>> found["spatial_iou"]  # doctest: +SKIP
    0.62
    """

    root: Path
    subject: str
    sections: tuple[Section, ...]

    def __getitem__(self, name: str) -> float | None:
        """Return the value of the figure ``name``. Raises InputError for one that is not there."""
        known = {item.name: item.value for item in self.measures}
        if name not in known:
            raise InputError(f"{name}: is none of the figures {', '.join(known)}")
        return known[name]

    def __repr__(self) -> str:
        return f"Evaluation({self.subject!r}, {', '.join(section.name for section in self.sections)})"

    @property
    def measures(self) -> tuple[Measure, ...]:
        """All figures."""
        return tuple(measure for section in self.sections for measure in section.measures)

    @property
    def notices(self) -> tuple[str, ...]:
        """All notices, each once."""
        return tuple(dict.fromkeys(notice for section in self.sections for notice in section.notices))

    @property
    def failures(self) -> tuple[str, ...]:
        """Those of the notices that name an input which could not be used; a command then ends with exit code 3."""
        return tuple(failure for section in self.sections for failure in section.failures)

    @property
    def below_still(self) -> tuple[Measure, ...]:
        """Figures by which a video that stands still does better."""
        return tuple(measure for measure in self.measures if measure.below_still)


def evaluation_json(found: Evaluation) -> dict[str, Any]:
    """Return ``found`` as the content of ``evaluation.json``; what is not finite is null."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "subject": found.subject,
        "sections": [
            {
                "name": section.name,
                "title": section.title,
                "text": section.text,
                "notices": list(section.notices),
                "failures": list(section.failures),
                "measures": [
                    {
                        "name": item.name,
                        "title": item.title,
                        "value": _number(item.value),
                        "unit": item.unit,
                        "better": item.better,
                        "still": _number(item.still),
                        "below_still": item.below_still,
                        "note": item.note,
                    }
                    for item in section.measures
                ],
                "curves": [
                    {
                        "name": curve.name,
                        "label": curve.label,
                        "unit": curve.unit,
                        "times_s": [_number(float(t)) for t in curve.times],
                        "values": [_number(float(v)) for v in curve.values],
                    }
                    for curve in section.curves
                ],
            }
            for section in found.sections
        ],
    }


def write_evaluation(found: Evaluation, folder: Path) -> None:
    """Write ``evaluation.json``, ``measures.csv`` and ``curves.csv`` into ``folder``."""
    write_json(folder / JSON_FILE, evaluation_json(found))
    write_bytes(folder / MEASURES_FILE, table(_measure_rows(found)))
    write_bytes(folder / CURVES_FILE, table(_curve_rows(found)))


def table(rows: Iterator[list[object]]) -> bytes:
    """Return ``rows``, the headings first, as CSV (RFC 4180) in UTF-8; None is empty.

    A text that a spreadsheet would take for a formula gets an apostrophe before it.
    """
    text = io.StringIO()
    writer = csv.writer(text)
    for row in rows:
        writer.writerow(["" if cell is None else no_formula(cell) for cell in row])
    return text.getvalue().encode()


def no_formula(cell: object) -> object:
    """Return ``cell`` of a table, a text that a spreadsheet would take for a formula with an apostrophe before it."""
    return f"'{cell}" if isinstance(cell, str) and cell[:1] in ("=", "+", "-", "@", "\t", "\r") else cell


def _measure_rows(found: Evaluation) -> Iterator[list[object]]:
    yield ["section", "name", "value", "unit", "better", "still", "below_still", "note"]
    for section in found.sections:
        for item in section.measures:
            value, still = _number(item.value), _number(item.still)
            below = "yes" if item.below_still else "no"
            yield [section.name, item.name, value, item.unit, item.better, still, below, item.note]


def _curve_rows(found: Evaluation) -> Iterator[list[object]]:
    yield ["section", "name", "label", "unit", "time_s", "value"]
    for section in found.sections:
        for curve in section.curves:
            for time, value in zip(curve.times, curve.values, strict=True):
                yield [section.name, curve.name, curve.label, curve.unit, float(time), _number(float(value))]


def value_text(value: float | None, unit: str = "") -> str:
    """Return a figure in words: four digits, a dash where it is unknown, ∞ where it has no bound."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    written = f"{value:.4g}" if 1e-4 <= abs(value) < 1e5 or value == 0 else f"{value:.2e}"
    return f"{written} {unit}".strip()


def summary(found: Evaluation) -> str:
    """Return a line for each figure, and what a video that stands still does better."""
    lines = []
    for section in found.sections:
        lines.append(f"{section.title}: {section.text}")
        for item in section.measures:
            still = "" if item.still is None else f"   (standing still: {value_text(item.still, item.unit)})"
            note = f"   {item.note}" if item.value is None and item.note else ""
            lines.append(f"    {item.title:<44} {value_text(item.value, item.unit)}{still}{note}")
    if found.below_still:
        lines.append("a video that stands still does better: " + ", ".join(m.title for m in found.below_still))
    return "\n".join(lines)


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
