# SPDX-License-Identifier: MIT
"""All candidates with their probabilities: as a picture, and as rows of the page's table."""

from __future__ import annotations

import math

from ...page.markup import Markup, Picture, element, join, label, shortened
from ..analysis import Estimate
from ..diagnosis import Diagnosis, RankedEffect
from .axes import Scale
from .quantities import NOTHING, estimate_text, percent_text, quantity_text
from .words import effect_label, found_effects

LEAST = 0.005
"""Candidates less probable than this stand in the folded part of the table, but for the first few."""
ALWAYS = 5

_ROW = 24.0
_BAR, _BAR_HEIGHT = 110.0, 12.0


def ranking_picture(diagnosis: Diagnosis, *, width: float) -> Picture:
    """Bars of all candidates, most probable first; ``width`` in CSS pixels."""
    left, right = 190.0, width - 60.0
    scale = Scale(low=0.0, high=1.0, start=0.0, end=max(right - left, 10.0))
    parts: list[Markup] = []
    for row, item in enumerate(diagnosis.effects):
        y = row * _ROW + 17
        class_ = bar_class(diagnosis, item)
        parts += [
            label(shortened(effect_label(item.name), 28), left - 10, y, anchor="end"),
            element("rect", x=left, y=y - 11, width=scale.end, height=14, rx=2, class_="panel"),
            element("rect", x=left, y=y - 11, width=max(scale(item.probability), 1.0), height=14, rx=2, class_=class_),
            label(percent_text(item.probability), right + 8, y, class_="ink"),
        ]
    if not parts:
        parts.append(label("No candidate was tried.", 0, 17, class_="quiet"))
    first = ", ".join(f"{effect_label(e.name)} {percent_text(e.probability)}" for e in diagnosis.effects[:5])
    return Picture(
        width=width,
        height=max(len(diagnosis.effects), 1) * _ROW + 6,
        title="How probable each cause is",
        description=first or "No candidate was tried.",
        body=join(parts),
    )


def bar_class(diagnosis: Diagnosis, item: RankedEffect) -> str:
    """How the bar of a candidate is filled: the verdict, an alternative that cannot be told from it, or another."""
    verdict = diagnosis.verdict
    if item.name == verdict.effect or item.name in found_effects(verdict):
        return "found-fill"
    return "nominal-fill" if item.name in verdict.alternatives else "other-fill"


def table(diagnosis: Diagnosis, items: tuple[RankedEffect, ...], *, caption: str) -> Markup:
    """The candidates ``items`` with everything that is known of them."""
    head = ("Cause", "Probability", "Kind", "Fitted numbers", "Error left", "Gap closed")
    rows = [element("tr", *(element("th", name, scope="col") for name in head))]
    return element(
        "table",
        element("caption", caption),
        element("thead", *rows),
        element("tbody", *(_row(diagnosis, item) for item in items)),
        class_="ranking",
    )


def split(diagnosis: Diagnosis) -> tuple[tuple[RankedEffect, ...], tuple[RankedEffect, ...]]:
    """The candidates to show at once, and those to fold away."""
    shown = tuple(
        item
        for index, item in enumerate(diagnosis.effects)
        if index < ALWAYS or (math.isfinite(item.probability) and item.probability >= LEAST)
    )
    return shown, diagnosis.effects[len(shown) :]


def _row(diagnosis: Diagnosis, item: RankedEffect) -> Markup:
    mark = {"found-fill": "verdict", "nominal-fill": "cannot be told from it"}.get(bar_class(diagnosis, item))
    name = join(
        [
            element("bdi", shortened(effect_label(item.name), 60)),
            element("span", mark, class_="mark") if mark else None,
        ]
    )
    numbers = [element("div", _parameter(key, value)) for key, value in item.parameters.items()]
    cells = (
        ("Probability", join([_bar(diagnosis, item), element("span", percent_text(item.probability))]), "probability"),
        ("Kind", shortened(item.kind, 24) if item.kind else NOTHING, None),
        ("Fitted numbers", join(numbers) if numbers else NOTHING, "numbers"),
        ("Error left", quantity_text(item.heldout_rms_m, "m"), "number"),
        ("Gap closed", percent_text(item.closed_fraction), "number"),
    )
    return element(
        "tr",
        element("th", name, scope="row"),
        *(element("td", content, data_label=head, class_=class_) for head, content, class_ in cells),
    )


def _parameter(name: str, estimate: Estimate) -> Markup:
    return join([element("span", name.replace("_", " "), class_="quiet"), " ", estimate_text(estimate)])


def _bar(diagnosis: Diagnosis, item: RankedEffect) -> Markup:
    scale = Scale(low=0.0, high=1.0, start=0.0, end=_BAR)
    return element(
        "svg",
        element("rect", x=0, y=0, width=_BAR, height=_BAR_HEIGHT, rx=2, class_="panel"),
        element(
            "rect",
            x=0,
            y=0,
            width=max(scale(item.probability), 1.0),
            height=_BAR_HEIGHT,
            rx=2,
            class_=bar_class(diagnosis, item),
        ),
        viewBox=f"0 0 {_BAR:.0f} {_BAR_HEIGHT:.0f}",
        width=_BAR,
        height=_BAR_HEIGHT,
        class_="picture bar",
        aria_hidden="true",
    )
