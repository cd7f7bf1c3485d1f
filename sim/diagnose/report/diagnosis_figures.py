# SPDX-License-Identifier: MIT
"""Figures of the report: gap before and after, error growth over a trial, and all figures gathered."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...html import Markup, Picture, element, join, label, shortened, side_by_side
from ..capture import Capture, Trial
from ..capture_geometry import mean_known
from ..diagnosis import Diagnosis, TrialArrays
from .diagnosis_charts import Scale, curve, is_root, ranking_picture, timeline_picture
from .effect_words import found_effects, found_label
from .number_format import axis_unit, counted, quantity_text, tick_text
from .object_heatmaps import object_pictures
from .trajectory_plots import MAX_TAKES, camera_plane, tracks_legend, tracks_pictures

Array = NDArray[np.float64]

WIDTH = 400.0
_ROW = 42.0
_STEPS = 120


@dataclass(frozen=True, kw_only=True)
class Bar:
    """One error in m. class_: fill; quiet: a control instead of a stage of the model."""

    caption: str
    value: float
    class_: str
    quiet: bool = False


def gap_bars(diagnosis: Diagnosis) -> list[Bar]:
    """Return all errors on held-out data, from the nominal model to the controls."""
    gap, controls = diagnosis.gap, diagnosis.controls
    found = found_effects(diagnosis.verdict)
    bars = [
        Bar(caption="nominal model", value=gap.before_rms_m, class_="nominal-fill"),
        Bar(caption="nominal model, re-fitted", value=gap.refitted_rms_m, class_="other-fill"),
        *([Bar(caption=found_label(diagnosis.verdict), value=gap.after_rms_m, class_="found-fill")] if found else []),
        Bar(caption="noise floor of the recording", value=gap.noise_floor_rms_m, class_="rule-fill"),
        Bar(caption="numerical error of the simulator", value=gap.numerics_rms_m, class_="rule-fill", quiet=True),
    ]
    names = {
        "wrong_effect_rms_m": "control: rejected effect",
        "last_residual_rms_m": "control: last residual carried forward",
    }
    bars += [
        Bar(caption=names.get(key, key.replace("_", " ")), value=value, class_="other-fill", quiet=True)
        for key, value in controls.items()
    ]
    return bars


def bars_picture(diagnosis: Diagnosis) -> Picture:
    """Return the errors as bars on one scale; the mark on each is the noise floor."""
    bars = gap_bars(diagnosis)
    known = [b.value for b in bars if math.isfinite(b.value)]
    scale = Scale(low=0.0, high=max([*known, 1e-12]), start=0.0, end=WIDTH - 70)
    parts: list[Markup | None] = [
        label("RMS error on held-out motion", 0, 13, class_="ink strong"),
    ]
    y, floor = 24.0, diagnosis.gap.noise_floor_rms_m
    for bar in bars:
        parts.append(label(shortened(bar.caption, 58), 0, y + 13, class_="quiet" if bar.quiet else "ink"))
        height = 8.0 if bar.quiet else 12.0
        if math.isfinite(bar.value):
            width = max(scale(bar.value), 1.5)
            parts.append(element("rect", x=0, y=y + 19, width=scale.end, height=height, rx=2, class_="panel"))
            parts.append(element("rect", x=0, y=y + 19, width=width, height=height, rx=2, class_=bar.class_))
            parts.append(label(quantity_text(bar.value, "m", digits=2), scale.end + 8, y + 18 + height))
        else:
            parts.append(label("not known", 0, y + 29, class_="quiet"))
        if math.isfinite(floor) and math.isfinite(bar.value):
            at = f"M{scale(floor):.1f} {y + 17:.0f}v{height + 4:.0f}"
            parts.append(element("path", d=at, class_="line curve", stroke_width=1.2))
        y += _ROW
    return Picture(
        width=WIDTH,
        height=y + 6,
        title="Error before and after",
        description="; ".join(f"{b.caption} {quantity_text(b.value, 'm')}" for b in bars) + ".",
        body=join(parts),
    )


@dataclass(frozen=True, kw_only=True)
class Growth:
    """RMS error over time since the start of a trial: times (N,) s; nominal and found (N,) in ``unit``."""

    times: Array
    nominal: Array
    found: Array
    trials: int
    unit: str
    noise: float


def growth(diagnosis: Diagnosis, capture: Capture) -> Growth:
    """Return the mean error over the complete trials, or over all trials where none is complete."""
    both = [(t, diagnosis.trials[t.name]) for t in capture.trials if t.name in diagnosis.trials]
    chosen = [pair for pair in both if pair[0].role == "fit"] or both
    in_pixels = any(t.pixels is not None for t, _ in chosen)
    lengths = [float(t.times[-1] - t.times[0]) for t, _ in chosen]
    times = np.linspace(0.0, max(lengths, default=1.0), _STEPS)
    curves: dict[str, list[Array]] = {"nominal": [], "found": []}
    for trial, arrays in chosen:
        for name, kept in curves.items():
            kept.append(_resampled(times, trial, _errors(name, trial, arrays, capture)))
    means = {name: mean_known(np.stack(kept), 0) if kept else np.full(_STEPS, np.nan) for name, kept in curves.items()}
    return Growth(
        times=times,
        nominal=means["nominal"],
        found=means["found"],
        trials=len(chosen),
        unit="px" if in_pixels else "m",
        noise=capture.noise_sigma * math.sqrt(2 if in_pixels else 3),
    )


def _errors(name: str, trial: Trial, arrays: TrialArrays, capture: Capture) -> Array:
    """Return (T,) RMS distances between observed and modelled points."""
    shape = trial.observed.shape
    modelled = np.asarray(getattr(arrays, name), dtype=np.float64)
    if modelled.shape == (*shape[:2], 3):
        if trial.pixels is not None and capture.camera is not None:
            modelled = camera_plane(capture.camera)(modelled)
        apart = trial.observed - modelled
    elif name == "nominal" and arrays.residual.shape == shape:
        apart = arrays.residual
    else:
        apart = np.full(shape, np.nan)
    with np.errstate(over="ignore"):
        squares = (apart**2).sum(axis=2)
    return np.sqrt(mean_known(np.where(np.isfinite(squares), squares, np.nan), 1))


def _resampled(times: Array, trial: Trial, errors: Array) -> Array:
    since = trial.times - trial.times[0]
    good = np.isfinite(errors)
    if not good.any():
        return np.full(len(times), np.nan)
    values = np.interp(times, since[good], errors[good])
    return np.where((times >= since[good][0]) & (times <= since[good][-1]), values, np.nan)


def growth_picture(diagnosis: Diagnosis, capture: Capture) -> Picture:
    """Return the error over time since the start, nominal and with the effect."""
    data = growth(diagnosis, capture)
    with_found = bool(found_effects(diagnosis.verdict)) and bool(np.isfinite(data.found).any())
    left, right, top, bottom = 40.0, WIDTH - 12, 60.0, 262.0
    drawn = [data.nominal, data.found if with_found else data.nominal]
    highest = max([float(d[np.isfinite(d)].max()) for d in drawn if np.isfinite(d).any()] or [0.0])
    x = Scale(low=0.0, high=max(float(data.times[-1]), 1e-9), start=left, end=right)
    y = Scale(low=0.0, high=max(highest * 1.05, data.noise * 1.5, 1e-12), start=bottom, end=top)
    factor, unit = axis_unit(y.high, data.unit)
    parts: list[Markup | None] = [
        label("Error growth during a trial", 0, 13, class_="ink strong"),
        label(f"in {unit}, mean of the fitted trials; dotted: tracking noise", 0, 31, class_="quiet"),
    ]
    for tick in y.ticks(4):
        at = y(tick)
        parts.append(element("line", x1=left, x2=right, y1=at, y2=at, class_="rule", stroke_width=0.8))
        parts.append(
            label(tick_text(float(f"{tick * factor:.6g}")), left - 7, at + 4, class_="quiet", anchor="end", size=11)
        )
    for tick in x.ticks(5):
        at = x(tick)
        parts.append(element("line", x1=at, x2=at, y1=bottom, y2=bottom + 5, class_="tick"))
        parts.append(label(tick_text(tick), at, bottom + 18, class_="quiet", anchor="middle", size=11))
    parts.append(label("time since start, s", right, bottom + 34, class_="quiet", anchor="end", size=11))
    noise = y(data.noise)
    parts.append(
        element("line", x1=left, x2=right, y1=noise, y2=noise, class_="tick", stroke_dasharray="2 3", stroke_width=1.2)
    )
    lines: list[tuple[Array, str, str, str | None]] = [(data.nominal, "nominal", "nominal model", "6 3")]
    if with_found:
        lines.append((data.found, "found", shortened(found_label(diagnosis.verdict), 30), None))
    at = 0.0
    captions = []
    for values, class_, words, dashes in lines:
        path = curve([x(t) for t in data.times], [y(v) if math.isfinite(v) else math.nan for v in values])
        parts.append(element("path", d=path, class_=f"line {class_}-line", stroke_width=2.2, stroke_dasharray=dashes))
        key = element(
            "path", d=f"M{at:.0f} 46h20", class_=f"line {class_}-line", stroke_width=2.2, stroke_dasharray=dashes
        )
        parts += [key, label(words, at + 26, 50)]
        at += 26 + 7 * len(words) + 22
        known = values[np.isfinite(values)]
        if len(known):
            captions.append(f"{words}: {quantity_text(float(known[-1]), data.unit)} at the end")
    if not captions:
        parts.append(
            label("no error available", (left + right) / 2, (top + bottom) / 2, class_="quiet", anchor="middle")
        )
    return Picture(
        width=WIDTH,
        height=bottom + 42,
        title="Error over time since the start of a trial",
        description=f"Mean of {counted(data.trials, 'trial')}. {'; '.join(captions) or 'No error available'}.",
        body=join(parts),
    )


_WIDE, _NARROW = 912.0, 340.0


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """All figures. root: the timeline's vertical scale is a square root. tracks_seen: viewpoint of the tracks."""

    timeline_wide: Picture
    timeline_narrow: Picture
    root: bool
    objects: list[Picture]
    tracks: list[Picture]
    tracks_key: Picture
    tracks_seen: str
    bars: Picture
    growth: Picture
    ranking: Picture

    def files(self) -> dict[str, Picture]:
        """Return the pictures by file name."""
        found = {
            "timeline.svg": self.timeline_wide,
            "object.svg": side_by_side(
                self.objects,
                columns=2,
                gap=24,
                title="Discrepancy on the objects",
                description=" ".join(f"{p.title}: {p.description}" for p in self.objects),
            ),
            "ranking.svg": self.ranking,
            "gap.svg": side_by_side(
                [self.bars, self.growth],
                columns=2,
                gap=40,
                title="Gap closure",
                description=f"{self.bars.description} {self.growth.description}",
            ),
        }
        if self.tracks:
            found["tracks.svg"] = side_by_side(
                [*self.tracks, self.tracks_key],
                columns=3,
                gap=20,
                title="Observed and simulated motion",
                description=" ".join(f"{p.title}: {p.description}" for p in self.tracks),
            )
        return found


def draw_pictures(diagnosis: Diagnosis, capture: Capture) -> Pictures:
    """Return all figures of the report."""
    in_pixels = any(trial.pixels is not None for trial in capture.trials)
    tracks = tracks_pictures(diagnosis, capture)
    seen = "As the camera saw it." if in_pixels else "Seen from the side, across the main direction of motion."
    if len(diagnosis.trials) > len(tracks) >= MAX_TAKES:
        seen += f" The first {len(tracks)} of {len(diagnosis.trials)} trials."
    return Pictures(
        timeline_wide=timeline_picture(diagnosis, capture, width=_WIDE),
        timeline_narrow=timeline_picture(diagnosis, capture, width=_NARROW),
        root=is_root(diagnosis, capture),
        objects=object_pictures(diagnosis, capture),
        tracks=tracks,
        tracks_key=tracks_legend(diagnosis),
        tracks_seen=seen,
        bars=bars_picture(diagnosis),
        growth=growth_picture(diagnosis, capture),
        ranking=ranking_picture(diagnosis, width=640),
    )
