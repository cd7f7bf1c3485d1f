# SPDX-License-Identifier: MIT
"""The page of an evaluation: frames in a strip, figures in tables, curves over time; without scripts."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..atomic import write_bytes
from ..diagnose.report.diagnosis_charts import Scale, curve, round_up
from ..html import Markup, Picture, element, join, label, page_head, prose, render, shortened
from ..page_style import page_style
from ..version import VERSION
from .evaluation import HIGHER, LOWER, PAGE_FILE, Curve, Evaluation, Measure, Section, value_text
from .footage import Footage, Frame, reduced

STRIP = 8
"""Frames in the strip, evenly spaced, the first and the last among them."""
STRIP_SIDE = 240
WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 400.0, 190.0, 52.0, 36.0, 12.0
SIZE = 12
"""Of the text in a chart, pixels; 11 on a phone, which shows it smaller."""
LINES = ("found", "nominal", "observed", "other")
"""Colours of a chart's curves, in their order; more curves share the last."""
DASHES = (None, "6 3", "2 3", "8 3 2 3")
"""Of the same curves, which so differ without their colours, too."""
MOST_LABELS = 6

_TEMPLATE = Path(__file__).with_name("evaluation_page.html")


def strip_frames(video: Footage, most: int) -> list[Frame]:
    """Return ``STRIP`` frames of ``video``, reduced, evenly spaced over its first ``most`` frames."""
    count = video.count(most)
    wanted = {round(i * (count - 1) / max(STRIP - 1, 1)) for i in range(STRIP)}
    return [reduced(frame, STRIP_SIDE) for index, frame in enumerate(video.frames(count)) if index in wanted]


def write_page(found: Evaluation, strip: Sequence[Frame], folder: Path) -> None:
    """Write ``report.html`` into ``folder``; it loads nothing and runs nothing."""
    write_bytes(folder / PAGE_FILE, page(found, strip).encode())


def page(found: Evaluation, strip: Sequence[Frame]) -> str:
    """Return the page as text."""
    return render(
        _TEMPLATE,
        head=page_head(f"Evaluation: {found.subject}", page_style()),
        subject=shortened(found.subject, 80),
        version=VERSION,
        strip=[_encoded(frame) for frame in strip],
        below=[measure.title for measure in found.below_still],
        notices=found.notices,
        sections=[(section, _charts(section)) for section in found.sections],
        facts=_facts(found),
        value=lambda item: value_text(item.value, item.unit),
        prose=prose,
        views=any(section.name == "physics_iq" and section.measures for section in found.sections),
        still=lambda item: "–" if item.still is None else value_text(item.still, item.unit),
        better={HIGHER: "more", LOWER: "less"},
    )


def _facts(found: Evaluation) -> list[tuple[str, str, str]]:
    """Return (title, value, beside) of the figures at the top: of each section the first that are known."""
    chosen = {
        "against": ("physics_iq", "spatial_iou", "spatiotemporal_iou", "mse"),
        "physics_iq": ("physics_iq", "physics_iq_verified", "spatial_iou"),
        "alone": ("interpolation_error", "background_psnr"),
        "bake": ("ground_penetration", "object_penetration", "energy_gain"),
    }
    facts: list[tuple[str, str, str]] = []
    for section in found.sections:
        names = chosen.get(section.name, tuple(item.name for item in section.measures[:2]))
        by_name = {item.name: item for item in section.measures if item.value is not None}
        known: list[Measure] = [by_name[name] for name in names if name in by_name]
        for item in known[:3]:
            beside = "" if item.still is None else f"standing still: {value_text(item.still, item.unit)}"
            facts.append((item.title, value_text(item.value, item.unit), beside))
    return facts


def _encoded(frame: Frame) -> str:
    """Return ``frame`` as the address of a JPEG inside the page."""
    content = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(content).decode('ascii')}"


def _charts(section: Section) -> list[Picture]:
    """Return a chart for each figure that has curves, in their order."""
    names = dict.fromkeys(item.name for item in section.curves)
    charts = [chart([item for item in section.curves if item.name == name]) for name in names]
    return [found for found in charts if found is not None]


def chart(curves: Sequence[Curve]) -> Picture | None:
    """Return curves of one figure over time; None where nothing of them is known."""
    known = [item for item in curves if np.isfinite(item.values).any()]
    if not known:
        return None
    values = np.concatenate([item.values[np.isfinite(item.values)] for item in known])
    low, high = min(0.0, float(values.min())), round_up(float(values.max()))
    if low >= 0 and float(values.min()) > 0.5 * float(values.max()):
        # What hovers far above zero, such as decibels.
        low = float(values.min()) - 0.1 * (float(values.max()) - float(values.min()) + 1e-9)
        high = float(values.max()) + 0.1 * (float(values.max()) - float(values.min()) + 1e-9)
    end = max(float(item.times[-1]) for item in known)
    time = Scale(low=0.0, high=max(end, 1e-9), start=LEFT, end=WIDTH - 8)
    scale = Scale(low=low, high=high, start=HEIGHT - BOTTOM, end=TOP)
    parts: list[Markup] = []
    for tick in scale.ticks(4):
        y = scale(tick)
        parts.append(element("line", x1=LEFT, x2=WIDTH - 8, y1=y, y2=y, class_="rule"))
        parts.append(label(f"{tick:g}", LEFT - 6, y + 4, class_="quiet", anchor="end", size=SIZE))
    for tick in time.ticks(5):
        parts.append(label(f"{tick:g}", time(tick), HEIGHT - BOTTOM + 15, class_="quiet", anchor="middle", size=SIZE))
    parts.append(label("time, s", WIDTH - 8, HEIGHT - 4, class_="quiet", anchor="end", size=SIZE))
    for index, item in enumerate(known):
        colour = LINES[min(index, len(LINES) - 1)]
        xs, ys = [time(t) for t in item.times], [scale(v) if math.isfinite(v) else math.nan for v in item.values]
        dash = DASHES[min(index, len(DASHES) - 1)]
        parts.append(
            element("path", d=curve(xs, ys), class_=f"line {colour}-line", stroke_width=1.6, stroke_dasharray=dash)
        )
        # A single known frame between unknown ones is no line.
        parts += [
            element("circle", cx=x, cy=y, r=2, class_=f"{colour}-fill")
            for x, y, before, after in zip(xs, ys, [math.nan, *ys[:-1]], [*ys[1:], math.nan], strict=True)
            if math.isfinite(y) and not math.isfinite(before) and not math.isfinite(after)
        ]
    named = [item for item in known if item.label]
    rows = -(-min(len(named), MOST_LABELS) // 2)
    for index, item in enumerate(named[:MOST_LABELS]):
        x, y = LEFT + (index % 2) * 175, HEIGHT + 16 + 17 * (index // 2)
        colour, dash = LINES[min(index, len(LINES) - 1)], DASHES[min(index, len(DASHES) - 1)]
        key = element(
            "path", d=f"M{x:.0f} {y - 7:.0f}h22", class_=f"line {colour}-line", stroke_width=2, stroke_dasharray=dash
        )
        parts += [key, label(shortened(item.label, 20), x + 28, y - 3, size=SIZE)]
    extra = f", {len(named) - MOST_LABELS} more not named" if len(named) > MOST_LABELS else ""
    unit = f", {known[0].unit}" if known[0].unit else ""
    described = f"{known[0].title} over time{unit}: {', '.join(i.label for i in named) or 'one curve'}{extra}"
    return Picture(
        width=WIDTH,
        height=HEIGHT + 17.0 * rows + (6 if rows else 0),
        title=f"{known[0].title}{unit}",
        description=shortened(described, 300),
        body=join(parts),
    )
