# SPDX-License-Identifier: MIT
"""How good the diagnoses were, once the seal is broken.

A diagnosis is *right first* when its verdict names the cause (of two causes, either one), *right* when the cause is
the verdict or among its alternatives.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..diagnosis import NONE, UNKNOWN, read_diagnosis

Array = NDArray[np.float64]
Arrays = Mapping[str, NDArray[Any]]

CALIBRATION_BINS = 10
"""Bins of the verdict's probability, equally wide from 0 to 1, for the expected calibration error."""


@dataclass(frozen=True, kw_only=True)
class CaseScore:
    """One case. verdict: None when there is no readable report; note says why.

    closed: 1 - after/before, root mean squares over the withheld points; reach: (before - after)/(before - oracle).
    frame_auc: chance that ``frame_score`` ranks a frame in which the cause acts above one in which it does not; None
    where there are no such two.
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
    """The whole check; None where there was no case to ask. Shares are from 0 to 1.

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
        """As plain values."""
        return asdict(self)


def score_report(
    case: str, report: Path, label: Mapping[str, Any], truth: Arrays, seconds: float | None = None, note: str = ""
) -> CaseScore:
    """Score the diagnosis in the folder ``report``. label, truth: as ``Truth.label`` and ``Truth.arrays`` give them."""
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
            frame_auc, point_auc = _where(where, truth)
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


def total(rows: Iterable[CaseScore], *, seed: int | None = None, digest: str = "") -> BlindScore:
    """The score of all ``rows``; InputError when there is none."""
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
    """Expected calibration error (Guo et al., ICML 2017). probability: (N,) of the verdict; right: (N,) 0 or 1."""
    number = np.minimum((probability * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    inside = [number == b for b in range(CALIBRATION_BINS)]
    gaps = [abs(probability[i].mean() - right[i].mean()) * i.mean() for i in inside if i.any()]
    return float(sum(gaps))


def rank_auc(score: NDArray[Any], truth: NDArray[Any]) -> float | None:
    """Chance that a true entry outranks a false one, ties for a half (Mann-Whitney); None when only one kind is there.

    Entries whose score is not finite are left out.
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


def _takes(truth: Arrays) -> list[str]:
    return sorted({key.split(".")[0] for key in truth})


def _where(where: Arrays, truth: Arrays) -> tuple[float | None, float | None]:
    """Over complete takes: mean AUC of frame scores, and of point scores where the cause acts on some points only."""
    frames, points = [], []
    for take in _takes(truth):
        if f"{take}.points_predict" in truth:
            continue
        active = truth[f"{take}.effect_active"]
        frames.append(rank_auc(_same(where[f"{take}.frame_score"], active.shape), active))
        if f"{take}.point_mask" in truth and active.any():
            shown = _same(where[f"{take}.point_score"], truth[f"{take}.points"].shape[:2])[active]
            seen = np.isfinite(shown)
            mean = np.where(seen, shown, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
            points.append(rank_auc(mean, truth[f"{take}.point_mask"]))
    return _mean(f for f in frames if f is not None), _mean(p for p in points if p is not None)


def _same(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if array.shape != shape:
        raise ValueError(f"shape {array.shape} instead of {shape}")
    return array


def _closure(prediction: Arrays, truth: Arrays, label: Mapping[str, Any]) -> tuple[float, float]:
    names = [t for t in _takes(truth) if f"{t}.points_predict" in truth]
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
    """``points`` turned about the vertical and shifted in the plane onto ``target``: one camera cannot see that."""
    centre, goal = points[:, :2].mean(axis=0), target[:, :2].mean(axis=0)
    p, q = points[:, :2] - centre, target[:, :2] - goal
    angle = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([p @ turn.T + goal, points[:, 2]])
