# SPDX-License-Identifier: MIT
"""Where a discrepancy sits: shares of objects, of stretches of time and of directions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from .analysis import DIRECTIONS, Array, Discrepancy
from .capture import Capture
from .diagnosis import IntervalShare, ObjectShare, Where


def where_of(capture: Capture, discrepancies: Mapping[str, Discrepancy]) -> Where:
    """Shares of the discrepancy, each set together 1; equal ones where there is no discrepancy at all."""
    objects = np.zeros(len(capture.objects))
    spans: list[tuple[IntervalShare, float]] = []
    directions = dict.fromkeys(DIRECTIONS, 0.0)
    for trial in capture.trials:
        found = discrepancies[trial.name]
        weight = _durations(trial.times) * np.nan_to_num(found.frame_score)
        scores = np.nan_to_num(found.point_score).sum(axis=0)
        objects += np.bincount(trial.object_index, weights=scores, minlength=len(objects))
        for interval in found.intervals:
            inside = (trial.times >= interval.start_s) & (trial.times < interval.end_s)
            if interval is found.intervals[-1]:
                inside |= trial.times == interval.end_s
            span = IntervalShare(
                trial=trial.name, start_s=interval.start_s, end_s=interval.end_s, phase=interval.phase, share=0.0
            )
            spans.append((span, float(weight[inside].sum())))
        for name in DIRECTIONS:
            directions[name] += found.directions.get(name, 0.0) * float(weight.sum())
    shares = _shares(np.array([amount for _, amount in spans]))
    return Where(
        objects=tuple(
            ObjectShare(name=item.name, share=float(share))
            for item, share in zip(capture.objects, _shares(objects), strict=True)
        ),
        intervals=tuple(
            IntervalShare(trial=s.trial, start_s=s.start_s, end_s=s.end_s, phase=s.phase, share=float(share))
            for (s, _), share in zip(spans, shares, strict=True)
        ),
        direction=dict(
            zip(DIRECTIONS, (float(v) for v in _shares(np.array([directions[n] for n in DIRECTIONS]))), strict=True)
        ),
    )


def _durations(times: Array) -> Array:
    """Time in s that each frame stands for."""
    edges = np.concatenate([times[:1], 0.5 * (times[1:] + times[:-1]), times[-1:]])
    return np.asarray(np.diff(edges))


def _shares(amounts: Array) -> Array:
    total = amounts.sum()
    return amounts / total if total > 0 else np.full(len(amounts), 1.0 / max(1, len(amounts)))
