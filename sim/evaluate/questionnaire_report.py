# SPDX-License-Identifier: MIT
"""The page of a questionnaire's result: means with intervals drawn and in a table, preferences, agreement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..diagnose.report.diagnosis_charts import Scale
from ..html import Markup, Picture, element, join, label, page_head, render, shortened
from ..page_style import page_style
from .judge_question import CRITERIA, TITLES

PAGE_FILE = "report.html"
WIDTH, LEFT, ROW, TOP, BOTTOM = 320.0, 124.0, 26.0, 8.0, 24.0
_TEMPLATE = Path(__file__).with_name("questionnaire_report.html")


def result_page(found: Mapping[str, Any]) -> str:
    """Return the page of a result of ``collect_questionnaire`` as text; it loads nothing and runs nothing."""
    of = {(row["video"], row["criterion"]): row for row in found["means"]}
    videos = list(dict.fromkeys(row["video"] for row in found["means"]))
    people, cases = found["people"], found["cases"]
    return render(
        _TEMPLATE,
        head=page_head("Questionnaire", page_style()),
        title=f"{people} {'person' if people == 1 else 'people'}, {cases} case{'s' * (cases != 1)}",
        notes=found["notes"],
        charts=[_chart(TITLES[c], [of[video, c] for video in videos]) for c in CRITERIA],
        criteria=[TITLES[c] for c in CRITERIA],
        percent=f"{100 * found['confidence']:g} %",
        draws=found["resamples"],
        means=[(video, [(TITLES[c], _mean_text(of[video, c])) for c in CRITERIA]) for video in videos],
        pairs=[(row["first"], row["second"], _pair_cells(row)) for row in found["preferences"]],
        agreement=[(TITLES[r["criterion"]], _two(r["ordinal"]), _two(r["interval"])) for r in found["agreement"]],
        version=found["made_by"],
    )


def _mean_text(row: Mapping[str, Any]) -> str:
    if row["mean"] is None:
        return "no answer"
    return f"{_two(row['mean'])} ({_two(row['low'])} to {_two(row['high'])}), n = {row['count']}"


def _pair_cells(row: Mapping[str, Any]) -> list[str]:
    ties = f"{row['ties']} tie{'s' * (row['ties'] != 1)}"
    return [
        TITLES[row["criterion"]],
        f"{row['wins']} : {row['losses']}, {ties}",
        _p(row["p"]),
        f"{row['people_for_first']} : {row['people_for_second']}",
        _p(row["p_people"]),
    ]


def _chart(title: str, rows: Sequence[Mapping[str, Any]]) -> Picture:
    """Return the mean of each video as a dot on the scale of 1 to 5, with its interval as a line."""
    height = TOP + ROW * len(rows) + BOTTOM
    scale = Scale(low=1.0, high=5.0, start=LEFT, end=WIDTH - 10)
    parts: list[Markup] = []
    for tick in range(1, 6):
        x = scale(tick)
        parts.append(element("line", x1=x, x2=x, y1=TOP, y2=height - BOTTOM, class_="rule"))
        parts.append(label(str(tick), x, height - 7, class_="quiet", anchor="middle", size=12))
    for index, row in enumerate(rows):
        y = TOP + ROW * (index + 0.5)
        parts.append(label(shortened(row["video"], 16), LEFT - 10, y + 4, anchor="end", size=12))
        if row["mean"] is None:
            parts.append(label("no answer", scale(3), y + 4, class_="quiet", anchor="middle", size=12))
            continue
        low, high = scale(row["low"]), scale(row["high"])
        parts.append(element("line", x1=low, x2=high, y1=y, y2=y, class_="line found-line", stroke_width=3))
        parts.append(element("circle", cx=scale(row["mean"]), cy=y, r=5, class_="found-fill"))
    described = "; ".join(f"{row['video']}: {_mean_text(row)}" for row in rows)
    return Picture(
        width=WIDTH,
        height=height,
        title=title,
        description=shortened(f"{title}, means from 1 to 5 with their intervals. {described}", 400),
        body=join(parts),
    )


def _two(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
