# SPDX-License-Identifier: MIT
"""Sim-to-real gap on held-out data, gap closure, negative controls and localisation of the discrepancy."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from .capture import Capture
from .capture_geometry import mean_known, metres_per_unit, observed_residual
from .diagnosis import NONE, UNKNOWN, Array, Gap, IntervalShare, Localisation, ObjectShare
from .fits import DIRECTIONS, CandidateFit, Discrepancy, Fits
from .model_comparison import RESOLVABLE, ModelComparison, closed_fraction

RESAMPLES = 400

KNOWN_SHARE = 0.9
"""Share of the resamples whose gap must be resolvable."""

SHOWN_S = 0.15
"""Seconds counted as the first frames of a trial where no predict trial defines them."""


def measure_gap(capture: Capture, fits: Fits, found: CandidateFit, nominal: Mapping[str, Array]) -> Gap:
    """Return distances on held-out trials, each predicted from its first frames, without the confidence interval.

    nominal: (T, K, 3) m by trial. The floor is an estimate: an error below it is the better one.
    """
    before, after = fits.nominal.heldout_rms_m, found.heldout_rms_m
    floor = min(fits.floor_rms_m, before, after)
    units = [metres_per_unit(capture, t, nominal[t.name]) for t in capture.fit_trials]
    coordinates = 3 if capture.fit_trials[0].points is not None else 2
    return Gap(
        before_rms_m=before,
        refitted_rms_m=fits.refitted.heldout_rms_m,
        after_rms_m=after,
        noise_floor_rms_m=floor,
        closed_fraction=closed_fraction(before, after, floor),
        closed_fraction_ci95=(math.nan, math.nan),
        resolvable=bool(before > RESOLVABLE * floor),
        numerics_rms_m=fits.numerics_rms_m(found),
        grain_rms_m=fits.grain_rms_m,
        noise_rms_m=float(math.sqrt(coordinates) * capture.noise_sigma * np.median(units)),
    )


def bootstrap_interval(
    capture: Capture,
    nominal: Mapping[str, Array],
    found: Mapping[str, Array],
    fit: CandidateFit,
    gap: Gap,
) -> tuple[float, float]:
    """Return the 95 % interval of the closed fraction by bootstrap over trials (Efron, Ann. Statist. 7 (1979)).

    nominal, found: (T, K, 3) m by trial. Complete trials are resampled; the spread of their fraction is centred on the
    fraction measured on held-out trials, and both ends are fractions, from -1 to 1. (NaN, NaN) with fewer than two
    trials, or where the gap of resampled trials is not resolvable.
    """
    rows = []
    for trial in capture.fit_trials:
        unit = metres_per_unit(capture, trial, nominal[trial.name])
        squares = [
            float(mean_known(np.square(observed_residual(capture, trial, points, which)).sum(axis=-1))) * unit**2
            for points, which in ((nominal[trial.name], None), (found[trial.name], fit))
        ]
        if all(math.isfinite(s) for s in squares):
            rows.append(squares)
    if len(rows) < 2 or not math.isfinite(gap.closed_fraction):
        return math.nan, math.nan
    table = np.array(rows)
    picks = np.random.default_rng(0).integers(0, len(table), size=(RESAMPLES, len(table)))
    left = np.sqrt(table[picks].mean(axis=1))
    floor = gap.noise_floor_rms_m
    before, after = np.sqrt(table.mean(axis=0))
    whole = closed_fraction(float(before), float(after), floor)
    fractions = np.array([closed_fraction(float(a), float(b), floor) for a, b in left])
    fractions = fractions[np.isfinite(fractions)]
    if not math.isfinite(whole) or len(fractions) < KNOWN_SHARE * RESAMPLES:
        return math.nan, math.nan
    value = gap.closed_fraction
    low, high = (float(q) for q in np.quantile(fractions, (0.025, 0.975)) + value - whole)
    return max(min(low, value), -1.0), min(max(high, value), 1.0)


def carried_residual(capture: Capture, nominal: Mapping[str, Array]) -> float:
    """Return the RMS distance in m of complete trials from the nominal model with its last residual carried forward.

    nominal: (T, K, 3) m by trial. A baseline without any physics.
    """
    # A single frame has no rate.
    shown = [len(t.times) * np.diff(t.times).mean() for t in capture.predict_trials if len(t.times) > 1]
    lead = float(np.median(shown)) if shown else SHOWN_S
    squares = []
    for trial in capture.fit_trials:
        residual = observed_residual(capture, trial, nominal[trial.name])
        first = int(np.searchsorted(trial.times - trial.times[0], lead))
        if not 0 < first < len(residual):
            continue
        tail = residual[max(0, first - 3) : first]
        known = np.isfinite(tail)
        last = np.where(known, tail, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        off = np.square(residual[first:] - last).sum(axis=-1)
        squares.append(off[np.isfinite(off)] * metres_per_unit(capture, trial, nominal[trial.name]) ** 2)
    known_squares = np.concatenate(squares) if squares else np.empty(0)
    return float(np.sqrt(known_squares.mean())) if len(known_squares) else math.nan


def negative_controls(
    capture: Capture, fits: Fits, weighed: ModelComparison, found: CandidateFit, nominal: Mapping[str, Array]
) -> dict[str, float]:
    """Return the held-out errors of wrong models, which a true cause must beat.

    wrong_effect_rms_m: the least likely effect with a number of parameters closest to the verdict's.
    last_residual_rms_m: the nominal model with its last residual carried forward.
    nominal: (T, K, 3) m by trial, simulated from its first frames.
    """
    parameter_count = sum(len(p) for p in found.parameters.values())
    wrong = [
        fit
        for fit in fits.candidates
        if len(fit.effects) == 1
        and fit.effects[0] not in (weighed.verdict.effect, *weighed.verdict.alternatives, *weighed.verdict.effects)
        and math.isfinite(fit.heldout_rms_m)
    ]
    if weighed.verdict.effect in (NONE, UNKNOWN):
        parameter_count = 1

    def unlike(fit: CandidateFit) -> tuple[int, float]:
        return abs(sum(len(p) for p in fit.parameters.values()) - parameter_count), fit.log_evidence

    chosen = min(wrong, key=unlike).heldout_rms_m if wrong else math.nan
    return {"wrong_effect_rms_m": chosen, "last_residual_rms_m": carried_residual(capture, nominal)}


def localise(capture: Capture, discrepancies: Mapping[str, Discrepancy]) -> Localisation:
    """Return the shares of the discrepancy, each group summing to 1; equal shares without any discrepancy."""
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
    return Localisation(
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
    """Return the duration in s of each frame."""
    edges = np.concatenate([times[:1], 0.5 * (times[1:] + times[:-1]), times[-1:]])
    return np.asarray(np.diff(edges))


def _shares(amounts: Array) -> Array:
    total = amounts.sum()
    return amounts / total if total > 0 else np.full(len(amounts), 1.0 / max(1, len(amounts)))
