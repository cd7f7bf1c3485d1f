# SPDX-License-Identifier: MIT
"""Charts of the report: axes, ranking of the candidates, timeline of the discrepancy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...html import Markup, Picture, element, join, label, short_number, shortened, translated
from ..capture import Capture
from ..diagnosis import Diagnosis, IntervalShare, RankedEffect
from ..fits import PHASES
from .effect_words import PHASES as PHASE_WORDS
from .effect_words import effect_label, found_effects
from .number_format import counted, number_text, percent_text, tick_text

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Linear scale from [low, high] to [start, end]; ``root``: square root scale."""

    low: float
    high: float
    start: float
    end: float
    root: bool = False

    def __call__(self, value: float) -> float:
        """Return the position of ``value``, clamped to start and end; start for NaN."""
        if not math.isfinite(value) or not self.high > self.low:
            return self.start
        share = min(max((value - self.low) / (self.high - self.low), 0.0), 1.0)
        return self.start + (self.end - self.start) * (math.sqrt(share) if self.root else share)

    def ticks(self, count: int = 4) -> list[float]:
        """Return about ``count`` round numbers between low and high."""
        if self.root:
            return [t for t in (0.0, *_decades(self.high)) if self.low <= t <= self.high]
        return round_numbers(self.low, self.high, count)


def round_numbers(low: float, high: float, count: int = 4) -> list[float]:
    """Return about ``count`` multiples of 1, 2 or 5 times a power of ten between low and high."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return []
    rough = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(rough))
    step = next((power * factor for factor in (1, 2, 5) if power * factor >= rough * 0.999), power * 10)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    if last - first > 100:
        return []
    return [round(index * step, 12) for index in range(first, last + 1)]


def round_up(value: float) -> float:
    """Return the next 1, 1.5, 2, 3, 4, 5, 6 or 8 times a power of ten; 1 unless ``value`` is positive and finite."""
    if not math.isfinite(value) or not 1e-300 < value < 1e300:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next((power * f for f in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if power * f >= value * 0.9999), power * 10)


def _decades(high: float) -> list[float]:
    """Return three round numbers up to about ``high`` whose square roots are roughly evenly spaced."""
    if not (math.isfinite(high) and high > 0):
        return []
    return sorted({_round_down(high / part) for part in (16, 3.5, 1)})


def _round_down(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return max((power * f for f in (1, 2, 5) if power * f <= value * 1.0001), default=power)


def curve(xs: Sequence[float] | Array, ys: Sequence[float] | Array) -> str:
    """Return the path data (``d``) through points (N,), (N,), broken at NaN; "" without points."""
    parts, pen_down, last = [], False, ""
    for x, y in zip(xs, ys, strict=True):
        if not (math.isfinite(x) and math.isfinite(y)):
            pen_down = False
            continue
        place = f"{short_number(float(x))} {short_number(float(y))}"
        if pen_down and place == last:
            continue
        parts.append(f"{'L' if pen_down else 'M'}{place}")
        pen_down, last = True, place
    return "".join(parts)


def peaks(times: Array, values: Array, *, start: float, end: float, count: int) -> tuple[Array, Array]:
    """Return times and values (N,) of the maximum in each of ``count`` equal bins from start to end.

    Downsampling by the maximum keeps short peaks.
    """
    good = np.isfinite(values) & np.isfinite(times)
    times, values = times[good], values[good]
    if len(times) <= count or end <= start:
        return times, values
    slots = np.clip(((times - start) / (end - start) * count).astype(int), 0, count - 1)
    order = np.lexsort((-values, slots))
    first = np.unique(slots[order], return_index=True)[1]
    chosen = np.sort(order[first])
    return times[chosen], values[chosen]


LEAST = 0.005
"""Candidates below this probability are folded away in the table, except the first ``ALWAYS``."""
ALWAYS = 5

_ROW = 24.0


def ranking_picture(diagnosis: Diagnosis, *, width: float) -> Picture:
    """Return bars of all candidates, most probable first; ``width`` in CSS pixels."""
    left, right = 190.0, width - 60.0
    scale = Scale(low=0.0, high=1.0, start=0.0, end=max(right - left, 10.0))
    parts: list[Markup] = []
    verdict = diagnosis.verdict
    # Two causes share a bar.
    items = [item for item in diagnosis.effects if item.name not in verdict.effects[1:]]
    names = {verdict.effect: "+".join(verdict.effects)} if verdict.effects else {}
    for row, item in enumerate(items):
        y = row * _ROW + 17
        class_ = bar_class(diagnosis, item)
        parts += [
            label(shortened(effect_label(names.get(item.name, item.name)), 28), left - 10, y, anchor="end"),
            element("rect", x=left, y=y - 11, width=scale.end, height=14, rx=2, class_="panel"),
            element("rect", x=left, y=y - 11, width=max(scale(item.probability), 1.0), height=14, rx=2, class_=class_),
            label(percent_text(item.probability), right + 8, y, class_="ink"),
        ]
    if not parts:
        parts.append(label("No candidates were tested.", 0, 17, class_="quiet"))
    first = ", ".join(f"{effect_label(e.name)} {percent_text(e.probability)}" for e in diagnosis.effects[:5])
    return Picture(
        width=width,
        height=max(len(items), 1) * _ROW + 6,
        title="Probability of each cause",
        description=first or "No candidates were tested.",
        body=join(parts),
    )


def bar_class(diagnosis: Diagnosis, item: RankedEffect) -> str:
    """Return the fill class of a candidate's bar: verdict, alternative that cannot be ruled out, or other."""
    verdict = diagnosis.verdict
    if item.name == verdict.effect or item.name in found_effects(verdict):
        return "found-fill"
    return "nominal-fill" if item.name in verdict.alternatives else "other-fill"


_BAND = 62.0
_ROOT_FROM = 12.0
"""Ratio of largest to median score above which the axis is a square root, so that ordinary frames stay visible."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """The worst frame of a trial: time in s and score in m/s²."""

    time: float
    score: float


@dataclass(frozen=True, kw_only=True)
class Band:
    """One trial in the timeline. times, scores: (T,) s and m/s². worst: None where no force is missing."""

    name: str
    role: str
    times: Array
    scores: Array
    intervals: tuple[IntervalShare, ...]
    worst: Moment | None


def bands(diagnosis: Diagnosis, capture: Capture) -> list[Band]:
    """Return all trials in the capture's order, then those that only the diagnosis names."""
    roles = {trial.name: trial.role for trial in capture.trials}
    names = [n for n in roles if n in diagnosis.trials] + [n for n in diagnosis.trials if n not in roles]
    found = []
    for name in names:
        arrays = diagnosis.trials[name]
        count = min(len(arrays.times), len(arrays.frame_score))
        times, scores = np.asarray(arrays.times[:count], float), np.asarray(arrays.frame_score[:count], float)
        good = np.isfinite(times) & np.isfinite(scores)
        worst = None
        if good.any() and scores[good].max() > 0:
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
    """Return all trials stacked over recorded time on one scale; ``width`` in CSS pixels."""
    shown = bands(diagnosis, capture)
    wide = width >= 600
    left, right = (150.0 if wide else 34.0), width - 12.0
    time, score = _scales(shown, left, right)
    parts: list[Markup] = [_legend(width)]
    y = 30.0 if wide else 48.0
    for band in shown:
        y += 0 if wide else 20
        parts.append(translated(0, y, _band(band, time, score, wide)))
        y += _BAND + (14 if wide else 12)
    if not shown:
        parts.append(label("There are no trials to show.", left, y + 16, class_="quiet"))
        y += 30
    parts.append(translated(0, y - 6, _time_axis(time)))
    overall = max((b.worst.score for b in shown if b.worst), default=0.0)
    most = f"up to {number_text(overall)} m/s²" if overall > 0 else "nowhere above zero"
    return Picture(
        width=width,
        height=y + 34,
        title="Discrepancy over time",
        description=(
            f"{counted(len(shown), 'trial')} over recorded time, coloured by phase; the curve is the force per mass "
            f"missing from the nominal model, {most}." + (" The scale is a square root." if score.root else "")
        ),
        body=join(parts),
    )


def is_root(diagnosis: Diagnosis, capture: Capture) -> bool:
    """Return whether the timeline's vertical scale is a square root."""
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
    parts.append(label("missing force per mass, m/s²", x + 24, y + 11.5))
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
        hint = (
            f"{PHASE_WORDS.get(interval.phase, interval.phase)}, {interval.start_s:.3f} to {interval.end_s:.3f} s: "
            f"{percent_text(interval.share)} of the discrepancy"
        )
        parts.append(_hinted(hint, start, max(end - start, 1.0), phase))
    for tick in _apart(score, score.ticks(2)):
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


_LINE = 11.5
"""Height of a tick's label in CSS pixels."""


def _apart(scale: Scale, ticks: list[float]) -> list[float]:
    """Return the ticks, from the largest and zero on, whose labels do not touch one before."""
    shown: list[float] = []
    for tick in sorted(ticks, key=lambda t: (t > 0, -t)):
        if all(abs(scale(tick) - scale(other)) >= _LINE for other in shown):
            shown.append(tick)
    return sorted(shown)


def _hinted(hint: str, x: float, width: float, phase: str) -> Markup:
    shape = element("rect", x=x, y=0, width=width, height=_BAND, class_=f"phase-{phase}")
    return element("g", element("title", hint), shape)


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
