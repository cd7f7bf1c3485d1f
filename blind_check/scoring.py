# SPDX-License-Identifier: MIT
"""Score of diagnoses against sealed labels, and its table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..sim.diagnose.diagnosis import NONE, UNKNOWN, read_diagnosis
from ..sim.errors import InputError

Array = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]

CALIBRATION_BINS = 10
"""Bins of the verdict's probability, equally wide from 0 to 1, for the expected calibration error."""


@dataclass(frozen=True, kw_only=True)
class CaseScore:
    """Score of one case. verdict: None without a readable report; note says why.

    closed: 1 - after/before, root mean squares over the withheld points; reach: (before - after)/(before - oracle).
    frame_auc: probability that ``frame_score`` ranks a frame in which the cause acts above one in which it does not;
    None without both.
    """

    case: str
    matter: str
    effect: str
    effects: tuple[str, ...]
    mechanism: str
    verdict: str | None
    alternatives: tuple[str, ...] = ()
    found: tuple[str, ...] = ()
    probability: float = 0.0
    right_first: bool = False
    right: bool = False
    frame_auc: float | None = None
    point_auc: float | None = None
    closed: float | None = None
    reach: float | None = None
    seconds: float | None = None
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class BlindScore:
    """Score of the whole check; None where no case applies. Shares are in [0, 1].

    confusion: truth → verdict → number, ``no report`` among the verdicts. calibration_error: sum over
    ``CALIBRATION_BINS`` bins of the share of cases in it times |mean probability - share right first|.
    two_cause_recall: share of the causes of two-cause cases that are in the verdict's ``effects``, or are its effect.
    """

    cases: int
    right_first: float
    right: float
    false_alarms: float | None
    abstentions: float | None
    calibration_error: float
    brier: float
    frame_auc: float | None
    point_auc: float | None
    closed_median: float | None
    reach_median: float | None
    two_cause_recall: float | None
    two_cause_both: float | None
    seconds_per_case: float | None
    confusion: Mapping[str, Mapping[str, int]]
    rows: tuple[CaseScore, ...]
    seed: int | None = None
    digest: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the score as plain values."""
        return asdict(self)


def score_report(
    case: str, report: Path, label: Mapping[str, Any], truth: Arrays, seconds: float | None = None, note: str = ""
) -> CaseScore:
    """Return the score of the diagnosis in ``report``. label, truth: from ``Truth.label`` and ``Truth.arrays``."""
    effect = str(label["effect"])
    effects = tuple(label.get("effects") or ())
    known: dict[str, Any] = {
        "case": case,
        "matter": "soft" if "soft" in str(label.get("simulator")) else "rigid",
        "effect": effect,
        "effects": effects,
        "mechanism": str(label.get("mechanism", effect)),
        "seconds": seconds,
    }
    try:
        found, where, prediction = read_diagnosis(report)
        verdict = str(found["verdict"]["effect"])
        alternatives = tuple(str(a) for a in found["verdict"].get("alternatives") or ())
        probability = float(np.clip(np.nan_to_num(float(found["verdict"]["probability"])), 0.0, 1.0))
        names = tuple(str(e) for e in found["verdict"].get("effects") or ())
    except (InputError, KeyError, TypeError, ValueError, OSError) as error:
        return CaseScore(**known, verdict=None, note=note or f"no report: {error}")
    wanted = set(effects) or {effect}
    notes = [note] if note else []
    frame_auc = point_auc = closed = reach = None
    if effect != NONE:
        try:
            frame_auc, point_auc = localisation_auc(where, truth)
        except (KeyError, ValueError) as error:
            notes.append(f"where: {error!r}")
        try:
            closed, reach = _closure(prediction, truth, label)
        except (KeyError, ValueError) as error:
            notes.append(f"prediction: {error!r}")
    return CaseScore(
        **known,
        verdict=verdict,
        alternatives=alternatives,
        found=names,
        probability=probability,
        right_first=verdict in wanted,
        right=verdict in wanted or bool(wanted & set(alternatives)),
        frame_auc=frame_auc,
        point_auc=point_auc,
        closed=closed,
        reach=reach,
        note="; ".join(notes),
    )


def total_score(rows: Iterable[CaseScore], *, seed: int | None = None, digest: str = "") -> BlindScore:
    """Return the score of all ``rows``. Raises InputError without any."""
    rows = tuple(rows)
    if not rows:
        raise InputError("there is no case to score")
    named = [r for r in rows if r.effect not in (NONE, UNKNOWN)]
    two = [r for r in rows if len(r.effects) > 1]
    hits = [{r.verdict, *r.found} & set(r.effects) for r in two]
    confusion: dict[str, dict[str, int]] = {}
    for r in rows:
        row = confusion.setdefault(" + ".join(r.effects) if len(r.effects) > 1 else r.effect, {})
        name = r.verdict or "no report"
        row[name] = row.get(name, 0) + 1
    right = np.array([r.right_first for r in rows], dtype=float)
    probability = np.array([r.probability for r in rows])
    false = _mean(r.verdict != NONE for r in rows if r.effect == NONE)
    return BlindScore(
        cases=len(rows),
        right_first=float(right.mean()),
        right=float(np.mean([r.right for r in rows])),
        false_alarms=false,
        abstentions=_mean(r.verdict == UNKNOWN for r in rows if r.effect == UNKNOWN),
        calibration_error=calibration_error(probability, right),
        brier=float(np.mean((probability - right) ** 2)),
        frame_auc=_mean(r.frame_auc for r in rows if r.frame_auc is not None),
        point_auc=_mean(r.point_auc for r in rows if r.point_auc is not None),
        closed_median=float(np.median([r.closed or 0.0 for r in named])) if named else None,
        reach_median=float(np.median([r.reach or 0.0 for r in named])) if named else None,
        two_cause_recall=_mean(len(h) / len(r.effects) for h, r in zip(hits, two, strict=True)),
        two_cause_both=_mean(len(h) == len(r.effects) for h, r in zip(hits, two, strict=True)),
        seconds_per_case=_mean(r.seconds for r in rows if r.seconds is not None),
        confusion=confusion,
        rows=rows,
        seed=seed,
        digest=digest,
    )


def calibration_error(probability: Array, right: Array) -> float:
    """Return the expected calibration error (Guo et al., ICML 2017). probability: (N,); right: (N,) 0 or 1."""
    number = np.minimum((probability * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    inside = [number == b for b in range(CALIBRATION_BINS)]
    gaps = [abs(probability[i].mean() - right[i].mean()) * i.mean() for i in inside if i.any()]
    return float(sum(gaps))


def rank_auc(score: NDArray[Any], truth: NDArray[Any]) -> float | None:
    """Return the area under the ROC curve (Mann-Whitney, ties count half); None unless both classes occur.

    Entries without a finite score are skipped.
    """
    s, y = np.asarray(score, dtype=float).ravel(), np.asarray(truth, dtype=bool).ravel()
    fine = np.isfinite(s)
    s, y = s[fine], y[fine]
    if y.all() or not y.any():
        return None
    _, place, count = np.unique(s, return_inverse=True, return_counts=True)
    rank = (np.cumsum(count) - (count - 1) / 2)[place]
    positive, negative = int(y.sum()), int((~y).sum())
    return float((rank[y].sum() - positive * (positive + 1) / 2) / (positive * negative))


def _mean(values: Iterable[Any]) -> float | None:
    found = [float(v) for v in values]
    return float(np.mean(found)) if found else None


def _trial_names(truth: Arrays) -> list[str]:
    return sorted({key.split(".")[0] for key in truth})


def localisation_auc(where: Arrays, truth: Arrays) -> tuple[float | None, float | None]:
    """Return the mean AUC over complete trials of frame scores, and of point scores where the cause is local."""
    frames, points = [], []
    for trial in _trial_names(truth):
        if f"{trial}.points_predict" in truth:
            continue
        active = truth[f"{trial}.effect_active"]
        frames.append(rank_auc(_same(where[f"{trial}.frame_score"], active.shape), active))
        if f"{trial}.point_mask" in truth and active.any():
            shown = _same(where[f"{trial}.point_score"], truth[f"{trial}.points"].shape[:2])[active]
            seen = np.isfinite(shown)
            mean = np.where(seen, shown, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
            points.append(rank_auc(mean, truth[f"{trial}.point_mask"]))
    return _mean(f for f in frames if f is not None), _mean(p for p in points if p is not None)


def _same(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if array.shape != shape:
        raise ValueError(f"shape {array.shape} instead of {shape}")
    return array


def _closure(prediction: Arrays, truth: Arrays, label: Mapping[str, Any]) -> tuple[float, float]:
    names = [t for t in _trial_names(truth) if f"{t}.points_predict" in truth]
    wanted = [truth[f"{t}.points_predict"].astype(float) for t in names]
    rms = {}
    for which in ("before", "after"):
        found = [_same(prediction[f"{t}.{which}"], w.shape).astype(float) for t, w in zip(names, wanted, strict=True)]
        a, b = (np.concatenate([x.reshape(-1, 3) for x in side]) for side in (found, wanted))
        if not np.isfinite(a).all():
            raise ValueError(f"{which} has numbers that are not finite")
        if "camera_pose" in (label["effect"], *(label.get("effects") or ())):
            a = _aligned(a, b)
        rms[which] = float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))
    gap = rms["before"] - rms["after"]
    floor = float(label.get("oracle_rms_m") or 0.0)
    return gap / max(rms["before"], 1e-9), gap / max(rms["before"] - floor, 1e-4)


def _aligned(points: Array, target: Array) -> Array:
    """Return ``points`` aligned to ``target`` by yaw and horizontal translation, which one camera cannot see."""
    centre, goal = points[:, :2].mean(axis=0), target[:, :2].mean(axis=0)
    p, q = points[:, :2] - centre, target[:, :2] - goal
    angle = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([p @ turn.T + goal, points[:, 2]])


def score_table(score: BlindScore) -> str:
    """Return a text table of all cases, the confusion matrix and the summary numbers."""
    lines = [f"{'case':9} {'truth':38} {'verdict':19} {'p':>5} right where closed seconds"]
    for r in score.rows:
        truth = " + ".join(r.effects) if len(r.effects) > 1 else r.effect
        if r.effect == "unknown":
            truth = f"unknown ({r.mechanism})"
        right = "first" if r.right_first else "among" if r.right else "-"
        numbers = f"{_number(r.frame_auc, 5)} {_number(r.closed, 6)} {_number(r.seconds, 7, 1)}"
        note = f"  {r.note[:60]}" if r.note else ""
        lines.append(
            f"{r.case:9} {truth:38} {r.verdict or 'no report':19} {r.probability:5.2f} {right:5} {numbers}{note}"
        )
    lines += ["", "truth → verdicts"]
    for truth in sorted(score.confusion):
        counts = sorted(score.confusion[truth].items(), key=lambda item: (-item[1], item[0]))
        lines.append(f"  {truth:38} " + ", ".join(f"{name} {n}" for name, n in counts))
    pairs = [
        ("right first", _share(score.right_first), "right or among alternatives", _share(score.right)),
        ("false alarms on none", _share(score.false_alarms), "abstains on unknown", _share(score.abstentions)),
        ("calibration error", _number(score.calibration_error, 5), "where (AUC)", _number(score.frame_auc, 5)),
        ("closed, median", _number(score.closed_median, 5), "two causes, recall", _share(score.two_cause_recall)),
        ("seconds per case", _number(score.seconds_per_case, 5, 1), "cases", f"{score.cases:5d}"),
    ]
    lines += ["", *(f"{a:22} {b:6}   {c:28} {d}" for a, b, c, d in pairs)]
    lines.append(f"seed {score.seed}, SHA-256 of salt and labels {score.digest}")
    return "\n".join(lines)


def _number(value: float | None, width: int, digits: int = 2) -> str:
    return f"{'-':>{width}}" if value is None else f"{value:{width}.{digits}f}"


def _share(value: float | None) -> str:
    return "    -" if value is None else f"{100 * value:3.0f} %"
