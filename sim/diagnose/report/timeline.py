# SPDX-License-Identifier: MIT
"""When the simulation lacks something: a band a take, coloured by phase, with the curve of the discrepancy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...page.markup import Markup, Picture, element, join, label, moved, shortened
from ..analysis import PHASES
from ..capture import Capture
from ..diagnosis import Diagnosis, IntervalShare
from .axes import Scale, curve, peaks, round_up
from .quantities import number_text, percent_text, tick_text
from .words import PHASES as PHASE_WORDS

Array = NDArray[np.float64]

_BAND = 62.0
_ROOT_FROM = 12.0
"""Largest score over the median above which the axis is a square root, so that the ordinary frames stay visible."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """The worst frame of a take: its time in s and its score in m/s²."""

    time: float
    score: float


@dataclass(frozen=True, kw_only=True)
class Band:
    """One take as the timeline shows it. times, scores: (T,) s and m/s². worst is None without any score."""

    name: str
    role: str
    times: Array
    scores: Array
    intervals: tuple[IntervalShare, ...]
    worst: Moment | None


def bands(diagnosis: Diagnosis, capture: Capture) -> list[Band]:
    """All takes in the capture's order, then those that only the diagnosis names."""
    roles = {trial.name: trial.role for trial in capture.trials}
    names = [n for n in roles if n in diagnosis.trials] + [n for n in diagnosis.trials if n not in roles]
    found = []
    for name in names:
        arrays = diagnosis.trials[name]
        count = min(len(arrays.times), len(arrays.frame_score))
        times, scores = np.asarray(arrays.times[:count], float), np.asarray(arrays.frame_score[:count], float)
        good = np.isfinite(times) & np.isfinite(scores)
        worst = None
        if good.any():
            at = int(np.flatnonzero(good)[scores[good].argmax()])
            worst = Moment(time=float(times[at]), score=float(scores[at]))
        intervals = tuple(
            i for i in diagnosis.where.intervals if i.trial == name and math.isfinite(i.start_s + i.end_s)
        )
        found.append(
            Band(name=name, role=roles.get(name, "fit"), times=times, scores=scores, intervals=intervals, worst=worst)
        )
    return found


def timeline_picture(diagnosis: Diagnosis, capture: Capture, *, width: float) -> Picture:
    """All takes below each other over recorded time, one scale for all; ``width`` in CSS pixels."""
    shown = bands(diagnosis, capture)
    wide = width >= 600
    left, right = (150.0 if wide else 34.0), width - 12.0
    time, score = _scales(shown, left, right)
    parts: list[Markup] = [_legend(width)]
    y = 30.0 if wide else 48.0
    for band in shown:
        y += 0 if wide else 20
        parts.append(moved(0, y, _band(band, time, score, wide)))
        y += _BAND + (14 if wide else 12)
    if not shown:
        parts.append(label("There is no take to show.", left, y + 16, class_="quiet"))
        y += 30
    parts.append(moved(0, y - 6, _time_axis(time)))
    overall = max((b.worst.score for b in shown if b.worst), default=math.nan)
    return Picture(
        width=width,
        height=y + 34,
        title="When the simulation lacks something",
        description=(
            f"{len(shown)} takes over recorded time, coloured by phase; the curve is the force per mass that the "
            f"simulation as believed lacks, up to {number_text(overall)} m/s²."
            + (" The scale is a square root." if score.root else "")
        ),
        body=join(parts),
    )


def is_root(diagnosis: Diagnosis, capture: Capture) -> bool:
    """Whether the timeline's vertical scale is a square root."""
    return _scales(bands(diagnosis, capture), 0.0, 1.0)[1].root


def _scales(shown: list[Band], left: float, right: float) -> tuple[Scale, Scale]:
    edges = [float(t) for b in shown for t in b.times if math.isfinite(t)]
    edges += [t for b in shown for i in b.intervals for t in (i.start_s, i.end_s)]
    low, high = (min(edges), max(edges)) if edges else (0.0, 1.0)
    scores = np.concatenate([b.scores[np.isfinite(b.scores)] for b in shown] or [np.empty(0)])
    top = round_up(float(scores.max())) if len(scores) else 1.0
    root = bool(len(scores)) and float(scores.max()) > _ROOT_FROM * max(float(np.median(scores)), 1e-12)
    time = Scale(low=low, high=high if high > low else low + 1.0, start=left, end=right)
    return time, Scale(low=0.0, high=top, start=_BAND, end=4.0, root=root)


def _legend(width: float) -> Markup:
    parts, x, y = [], 0.0, 0.0
    for phase in PHASES:
        parts.append(element("rect", x=x, y=y, width=14, height=14, rx=3, class_=f"phase-{phase}"))
        parts.append(label(phase, x + 20, y + 11.5))
        x += 84
    if width < 600:
        x, y = 0.0, 22.0
    parts.append(element("path", d=f"M{x:.0f} {y + 10:.0f}l5 -6 5 4 6 -7", class_="line curve", stroke_width=1.5))
    parts.append(label("what the simulation lacks, m/s²", x + 24, y + 11.5))
    return join(parts)


def _band(band: Band, time: Scale, score: Scale, wide: bool) -> Markup:
    left, right = time.start, time.end
    role = "" if band.role == "fit" else "first frames only"
    if wide:
        names = [
            label(shortened(band.name, 16), 0, 24, class_="ink strong"),
            label(role, 0, 41, class_="quiet") if role else None,
        ]
    else:
        names = [label(f"{shortened(band.name, 22)}{' · ' + role if role else ''}", 0, -7, class_="ink strong")]
    parts = [*names, element("rect", x=left, y=0, width=right - left, height=_BAND, class_="phase-unnamed")]
    for interval in sorted(band.intervals, key=lambda i: (i.start_s, i.end_s)):
        start, end = time(interval.start_s), time(interval.end_s)
        phase = interval.phase if interval.phase in PHASES else "unnamed"
        said = (
            f"{PHASE_WORDS.get(interval.phase, interval.phase)}, {interval.start_s:.3f} to {interval.end_s:.3f} s: "
            f"{percent_text(interval.share)} of the discrepancy"
        )
        parts.append(_hinted(said, start, max(end - start, 1.0), phase))
    for tick in score.ticks(2):
        y = score(tick)
        parts.append(element("line", x1=left, x2=right, y1=y, y2=y, class_="rule", stroke_width=0.6))
        parts.append(label(tick_text(tick), left - 5, y + 4, class_="quiet", anchor="end", size=10.5))
    times, scores = peaks(band.times, band.scores, start=time.low, end=time.high, count=int(right - left))
    xs, ys = [time(t) for t in times], [score(s) for s in scores]
    line = curve(xs, ys)
    if line:
        parts.append(element("path", d=f"{line}L{xs[-1]:.1f} {_BAND:.0f}L{xs[0]:.1f} {_BAND:.0f}Z", class_="area"))
        parts.append(element("path", d=line, class_="line curve", stroke_width=1.3))
    if band.worst is not None:
        parts.append(_mark(band.worst, time, score))
    return join(parts)


def _hinted(said: str, x: float, width: float, phase: str) -> Markup:
    shape = element("rect", x=x, y=0, width=width, height=_BAND, class_=f"phase-{phase}")
    return element("g", element("title", said), shape)


def _mark(worst: Moment, time: Scale, score: Scale) -> Markup:
    x, y = time(worst.time), score(worst.score)
    at_end = x > time.end - 70
    return join(
        [
            element("circle", cx=x, cy=y, r=3.6, class_="nominal-fill halo", stroke_width=1.5),
            label(
                number_text(worst.score, digits=2),
                x - 7 if at_end else x + 7,
                y - 6 if y > 18 else 11,
                class_="ink strong halo",
                anchor="end" if at_end else None,
                size=11,
            ),
        ]
    )


def _time_axis(time: Scale) -> Markup:
    parts = []
    for tick in time.ticks(6 if time.end - time.start > 450 else 4):
        x = time(tick)
        parts.append(element("line", x1=x, x2=x, y1=0, y2=5, class_="tick"))
        parts.append(label(tick_text(tick), x, 18, class_="quiet", anchor="middle", size=11))
    parts.append(label("recorded time, s", time.end, 34, class_="quiet", anchor="end", size=11))
    return join(parts)
