# SPDX-License-Identifier: MIT
"""Calibration of verdicts on recorded fits: reliability, intervals, pairs, and constants chosen without their effects.

Nothing here is blind: the truth lies beside the fits. It sets constants and measures them; ``blind_check`` examines.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..sim.diagnose.against_none import nominal_or_refitted
from ..sim.diagnose.comparison_settings import ComparisonSettings
from ..sim.diagnose.diagnosis import NONE, UNKNOWN
from ..sim.diagnose.fits import CandidateFit
from ..sim.diagnose.model_comparison import ModelComparison, compare_models
from .fit_records import FitRecord
from .scoring import calibration_error

Array = NDArray[np.float64]

TRUE_VALUES: Mapping[str, tuple[str, str]] = {
    "air_drag": ("drag_per_mass", "drag_per_mass_1_per_m"),
    "wind": ("drag_per_mass", "drag_per_mass_1_per_m"),
    "magnus": ("lift_per_mass", "lift_per_mass"),
    "buoyancy": ("fraction", "fraction"),
    "gravity_tilt": ("angle", "angle"),
    "tether": ("stiffness_per_mass", "stiffness_per_mass"),
    "friction": ("friction", "mu"),
    "restitution": ("restitution", "e"),
    "adhesion": ("pull_per_mass", "pull_per_mass"),
    "time_scale": ("rate", "rate"),
    "inertia": ("factor", "factor"),
    "stiffness": ("youngs_modulus", "E"),
}
"""Effect → (its main parameter, the generator's name for it)."""

FOLDED: Mapping[str, str] = {"wind": "air_drag", "time_scale": "buoyancy"}
"""Effects that are left out together: one contains the other, or is the same motion."""


@dataclass(frozen=True, kw_only=True)
class JudgedCase:
    """A record and its verdict. right: the first cause is a true one (or ``none``, ``unknown``). pair: two named.

    both: both causes of two named. closed: share of the withheld gap that the verdict's model closes; NaN without one.
    reach: the same of what the true model, from states of the shown frames, would close. frame_auc: of its
    localisation; NaN where that was not recorded.
    """

    record: FitRecord
    verdict: str
    probability: float
    unknown: float
    right: bool
    among: bool
    pair: bool
    both: bool
    closed: float
    reach: float
    frame_auc: float


def judge(record: FitRecord, settings: ComparisonSettings) -> JudgedCase:
    """Return ``record`` judged with ``settings``."""
    found = compare_models(record, settings)
    verdict = found.verdict
    wanted = set(record.effects) or {record.effect}
    names = {verdict.effect, *verdict.effects}
    before = record.withheld_rms_m.get("", math.nan)
    after = record.withheld_rms_m.get(_model(record, found), math.nan)
    oracle = float(record.truth.get("oracle_rms_m") or 0.0)
    return JudgedCase(
        record=record,
        verdict=verdict.effect,
        probability=verdict.probability,
        unknown=found.probabilities.get(UNKNOWN, 0.0),
        right=verdict.effect in wanted,
        among=bool(wanted & {*names, *verdict.alternatives}),
        pair=len(verdict.effects) > 1,
        both=len(verdict.effects) > 1 and wanted == names,
        closed=1.0 - after / before if before > 0 and record.effect != NONE else math.nan,
        reach=(before - after) / max(before - oracle, 1e-4) if record.effect != NONE else math.nan,
        frame_auc=math.nan
        if record.effect == NONE
        else record.frame_auc.get(_model(record, found) if verdict.effects else "", math.nan),
    )


def _model(record: FitRecord, found: ModelComparison) -> str:
    """Return the key of the verdict's model in ``withheld_rms_m``."""
    if found.verdict.effects:
        return "+".join(found.best[found.verdict.effect].effects)
    refitted = record.refitted.heldout_rms_m < record.nominal.heldout_rms_m
    return "refitted" if found.verdict.effect == UNKNOWN and refitted else ""


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """Quality of verdicts on N cases; shares are in [0, 1], NaN where no case applies.

    verdict_error, unknown_error: expected calibration error of the verdict's probability, and of that of ``unknown``
    against whether the cause lies outside the vocabulary; verdict_chance, unknown_chance: where it lies in nine of ten
    sets with these probabilities if they are right (``chance_errors``). frame_auc: mean of the localisation. rows: of
    the reliability table, (low, high, cases, mean probability, share right) for verdicts, then for unknown.
    """

    cases: int
    first: float
    among: float
    false_alarms: float
    abstains: float
    verdict_error: float
    unknown_error: float
    verdict_chance: tuple[float, float]
    unknown_chance: tuple[float, float]
    frame_auc: float
    closed_median: float
    reach_median: float
    pairs_first: float
    pairs_both: float
    false_pairs: float
    covered: tuple[int, int]
    rows: tuple[tuple[tuple[float, float, int, float, float], ...], tuple[tuple[float, float, int, float, float], ...]]

    def text(self) -> str:
        """Return a table of everything."""
        lines = [
            f"cases {self.cases}; first right {_percent(self.first)}, with alternatives {_percent(self.among)}",
            f"false alarms {_percent(self.false_alarms)}, abstains on unknown {_percent(self.abstains)}",
            f"two causes: first {_percent(self.pairs_first)}, both {_percent(self.pairs_both)}; "
            f"false pairs on one cause {_percent(self.false_pairs)}",
            f"withheld gap closed, median {self.closed_median:.2f}, of what the true model closes "
            f"{self.reach_median:.2f}; "
            f"95 % intervals hold the truth {self.covered[0]} of {self.covered[1]}",
            f"localisation of the frames (AUC) {self.frame_auc:.2f}",
            f"expected calibration error: verdicts {self.verdict_error:.3f}, unknown {self.unknown_error:.3f}",
            "  if the probabilities are right, in nine of ten such sets: "
            + ", ".join(f"{low:.3f} to {high:.3f}" for low, high in (self.verdict_chance, self.unknown_chance)),
        ]
        for title, rows in zip(("verdict", "unknown"), self.rows, strict=True):
            lines.append(f"probability of the {title}: cases, mean, share right")
            lines += [f"  {a:.1f} to {b:.1f}: {n:4d}  {mean:.2f}  {share:.2f}" for a, b, n, mean, share in rows]
        return "\n".join(lines)


def reliability(cases: Sequence[JudgedCase]) -> Reliability:
    """Return the reliability of ``cases``."""
    p, right = np.array([c.probability for c in cases]), np.array([c.right for c in cases], dtype=float)
    q = np.array([c.unknown for c in cases])
    outside = np.array([c.record.effect == UNKNOWN for c in cases], dtype=float)
    two = [c for c in cases if len(c.record.effects) > 1]
    inside = [covered(c.record) for c in cases if len(c.record.effects) == 1]
    known = [i for i in inside if i is not None]
    closed = [c.closed for c in cases if c.record.effects and math.isfinite(c.closed)]
    reach = [c.reach for c in cases if c.record.effects and math.isfinite(c.reach)]
    return Reliability(
        cases=len(cases),
        first=_share(c.right for c in cases),
        among=_share(c.among for c in cases),
        false_alarms=_share(c.verdict != NONE for c in cases if c.record.effect == NONE),
        abstains=_share(c.verdict == UNKNOWN for c in cases if c.record.effect == UNKNOWN),
        verdict_error=calibration_error(p, right),
        unknown_error=calibration_error(q, outside),
        verdict_chance=chance_errors(p),
        unknown_chance=chance_errors(q),
        frame_auc=_mean(c.frame_auc for c in cases if math.isfinite(c.frame_auc)),
        closed_median=float(np.median(closed)) if closed else math.nan,
        reach_median=float(np.median(reach)) if reach else math.nan,
        pairs_first=_share(c.right for c in two),
        pairs_both=_share(c.both for c in two),
        false_pairs=_share(c.pair for c in cases if len(c.record.effects) == 1),
        covered=(sum(known), len(known)),
        rows=(_bins(p, right), _bins(q, outside)),
    )


CHANCE_DRAWS = 2000


def chance_errors(probability: Array) -> tuple[float, float]:
    """Return the 5 and 95 % quantiles of the calibration error of outcomes drawn with ``probability`` (N,) itself.

    Few cases have an error by chance, however right their probabilities are.
    """
    drawn = np.random.default_rng(0).random((CHANCE_DRAWS, len(probability))) < probability
    errors = [calibration_error(probability, outcome) for outcome in drawn.astype(float)]
    low, high = np.quantile(errors, (0.05, 0.95))
    return float(low), float(high)


def covered(record: FitRecord) -> bool | None:
    """Return whether the true cause's 95 % interval holds its main parameter; None where that is not defined."""
    names = TRUE_VALUES.get(record.effect)
    fit = next((c for c in record.candidates if c.effects == (record.effect,)), None)
    truth = dict(record.truth.get("parameters") or {})
    if names is None or fit is None or names[1] not in truth or names[0] not in fit.parameters[record.effect]:
        return None
    estimate = fit.parameters[record.effect][names[0]]
    return bool(estimate.low <= float(truth[names[1]]) <= estimate.high)


GRID: Mapping[str, Sequence[Any]] = {
    "temperature": (2.0, 4.0, 8.0, 16.0),
    "enough": (1.4, 1.7, 2.2),
    "enough_explained": (2.0, 3.0, 4.5),
    "sharpness": (4.0, 8.0),
    "predicted": ((0.7, 0.95), (0.8, 0.95), (0.9, 0.98)),
}
"""Constants that ``cross_validated`` chooses among."""


def cross_validated(
    records: Sequence[FitRecord],
    base: ComparisonSettings,
    report: Callable[[str], None] = lambda line: None,
) -> tuple[list[JudgedCase], ComparisonSettings]:
    """Return ``records`` judged with constants chosen without their effect, and the constants chosen with all.

    The loss is the mean logarithmic score of the truth's probability, every effect counting the same.
    """
    choices = [dict(zip(GRID, values, strict=True)) for values in itertools.product(*GRID.values())]
    groups = [_group(r) for r in records]
    table = np.array(
        [[_loss(r, dataclasses.replace(base, **choice)) for r in records] for choice in choices], dtype=float
    )
    chosen: list[JudgedCase] = []
    for group in sorted(set(groups)):
        others = [i for i, g in enumerate(groups) if g != group]
        best = choices[int(np.argmin(_balanced(table[:, others], [groups[i] for i in others])))] if others else {}
        report(f"without {group}: {best}")
        settings = dataclasses.replace(base, **best)
        chosen += [judge(r, settings) for r, g in zip(records, groups, strict=True) if g == group]
    return chosen, dataclasses.replace(base, **choices[int(np.argmin(_balanced(table, groups)))])


def _balanced(table: Array, groups: Sequence[str]) -> Array:
    """Return the mean loss (choices,) of the groups' mean losses."""
    names = sorted(set(groups))
    own = np.array(groups)
    return np.asarray(np.mean([table[:, own == n].mean(axis=1) for n in names], axis=0))


def _group(record: FitRecord) -> str:
    if len(record.effects) > 1:
        return "two causes"
    return FOLDED.get(record.effect, record.effect)


def _loss(record: FitRecord, settings: ComparisonSettings) -> float:
    found = compare_models(record, settings)
    wanted = set(record.effects) or {record.effect}
    if len(record.effects) == 1 and record.truth.get("ambiguous_with"):
        wanted |= set(record.truth["ambiguous_with"])
    return -math.log(max(sum(found.probabilities.get(n, 0.0) for n in wanted), 1e-3))


def pair_gain(record: FitRecord) -> tuple[tuple[str, ...], float, CandidateFit | None]:
    """Return the best pair, its nats over the best model of at most one effect, and that model."""
    singles = [c for c in record.candidates if len(c.effects) == 1]
    pairs = [c for c in record.candidates if len(c.effects) > 1]
    single = max([*singles, nominal_or_refitted(record)], key=lambda c: c.log_evidence)
    if not pairs:
        return (), -math.inf, single
    best = max(pairs, key=lambda c: c.log_evidence)
    return best.effects, best.log_evidence - single.log_evidence, single


def _bins(p: Array, right: Array) -> tuple[tuple[float, float, int, float, float], ...]:
    number = np.minimum((p * 10).astype(int), 9)
    rows = []
    for k in range(10):
        own = number == k
        if own.any():
            rows.append((k / 10, (k + 1) / 10, int(own.sum()), float(p[own].mean()), float(right[own].mean())))
    return tuple(rows)


def _share(values: Iterable[bool]) -> float:
    return _mean(float(v) for v in values)


def _mean(values: Iterable[float]) -> float:
    found = list(values)
    return float(np.mean(found)) if found else math.nan


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100 * share:.0f} %"
