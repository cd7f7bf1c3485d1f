# SPDX-License-Identifier: MIT
"""How far simulation and recording are apart on data that no fit saw, and how much of it an effect closes."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from .analysis import Array, CandidateFit, Fits
from .capture import Capture
from .diagnosis import NONE, UNKNOWN, Gap
from .evidence import Weighed
from .projection import metres_per_unit, observed_residual

RESOLVABLE = 1.5
"""A gap below this many noise floors says nothing about how much of it was closed."""

RESAMPLES = 400

SHOWN_S = 0.15
"""Seconds of a take that count as its first frames where no predict trial says how many there are."""


def measured_gap(capture: Capture, fits: Fits, found: CandidateFit) -> Gap:
    """Distances on held-out takes, each predicted from its first frames; the interval is not known yet."""
    before, after, floor = fits.nominal.heldout_rms_m, found.heldout_rms_m, fits.floor_rms_m
    room = before - floor
    return Gap(
        before_rms_m=before,
        refitted_rms_m=fits.refitted.heldout_rms_m,
        after_rms_m=after,
        noise_floor_rms_m=floor,
        closed_fraction=(before - after) / room if room > 0 else math.nan,
        closed_fraction_ci95=(math.nan, math.nan),
        resolvable=bool(before > RESOLVABLE * floor),
        numerics_rms_m=fits.numerics_rms_m,
    )


def bootstrap_interval(
    capture: Capture,
    nominal: Mapping[str, Array],
    found: Mapping[str, Array],
    fit: CandidateFit,
    gap: Gap,
) -> tuple[float, float]:
    """95 % interval of the closed fraction when whole takes are drawn again (Efron, Ann. Statist. 7 (1979)).

    nominal, found: (T, K, 3) m by take. Drawn are complete takes; their ratio moves the fraction that was measured on
    held-out ones. (NaN, NaN) with fewer than two takes.
    """
    rows = []
    for trial in capture.fit_trials:
        unit = metres_per_unit(capture, trial, nominal[trial.name])
        squares = [
            float(np.nanmean(np.square(observed_residual(capture, trial, points, which)).sum(axis=-1))) * unit**2
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
    fractions = (left[:, 0] - left[:, 1]) / np.maximum(left[:, 0] - floor, 1e-12)
    whole = np.sqrt(table.mean(axis=0))
    shift = gap.closed_fraction - (whole[0] - whole[1]) / max(whole[0] - floor, 1e-12)
    low, high = np.quantile(fractions + shift, (0.025, 0.975))
    return float(low), float(high)


def carried_residual(capture: Capture, nominal: Mapping[str, Array]) -> float:
    """Root mean square distance in m of complete takes from the nominal model (T, K, 3) with its residual at the end
    of the first frames carried forward: no physics at all."""
    shown = [len(t.times) * np.diff(t.times).mean() for t in capture.predict_trials]
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
    return float(np.sqrt(np.concatenate(squares).mean())) if squares else math.nan


def controls_of(
    capture: Capture, fits: Fits, weighed: Weighed, found: CandidateFit, nominal: Mapping[str, Array]
) -> dict[str, float]:
    """What the same procedure scores with something wrong.

    wrong_effect_rms_m: the effect of as many parameters as the verdict, or next to that, which the evidence likes
        least. last_residual_rms_m: the nominal model with its last seen residual carried forward.
    nominal: (T, K, 3) m by take, started from its first frames.
    """
    freedom = sum(len(p) for p in found.parameters.values())
    wrong = [
        fit
        for fit in fits.candidates
        if len(fit.effects) == 1
        and fit.effects[0] not in (weighed.verdict.effect, *weighed.verdict.alternatives, *weighed.verdict.effects)
        and math.isfinite(fit.heldout_rms_m)
    ]
    if weighed.verdict.effect in (NONE, UNKNOWN):
        freedom = 1

    def unlike(fit: CandidateFit) -> tuple[int, float]:
        return abs(sum(len(p) for p in fit.parameters.values()) - freedom), fit.log_evidence

    chosen = min(wrong, key=unlike).heldout_rms_m if wrong else math.nan
    return {"wrong_effect_rms_m": chosen, "last_residual_rms_m": carried_residual(capture, nominal)}
