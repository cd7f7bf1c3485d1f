# SPDX-License-Identifier: MIT
"""A diagnosis (``physgen-diagnosis/1``): what is concluded, as dataclasses and as files. CAPTURE's counterpart."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..errors import InputError
from ..scene.json_fields import read_json, to_json
from .analysis import Estimate
from .capture import read_arrays

FORMAT = "physgen-diagnosis/1"
REPORT_FILE, WHERE_FILE, PREDICTION_FILE, PAGE_FILE = "report.json", "where.npz", "prediction.npz", "report.html"

NONE, UNKNOWN = "none", "unknown"

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """effect: the most probable single name; alternatives: what the data cannot tell from it.

    effects: all effects found, in the order found (two causes at once); () for ``none`` and ``unknown``.
    """

    effect: str
    probability: float
    alternatives: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RankedEffect:
    """One candidate as the report lists it; NaN where a number does not exist for it."""

    name: str
    kind: str
    probability: float
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    heldout_rms_m: float = math.nan
    closed_fraction: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Gap:
    """Root mean square distances in m on data that no fit saw; closed_fraction with its 95 % bootstrap interval.

    numerics_rms_m: how much of the gap is the simulator's own (two resolutions).
    """

    before_rms_m: float
    refitted_rms_m: float
    after_rms_m: float
    noise_floor_rms_m: float
    closed_fraction: float
    closed_fraction_ci95: tuple[float, float]
    resolvable: bool
    numerics_rms_m: float = math.nan


@dataclass(frozen=True, kw_only=True)
class ObjectShare:
    """Share of the discrepancy that sits in an object."""

    name: str
    share: float


@dataclass(frozen=True, kw_only=True)
class IntervalShare:
    """Share of the discrepancy in a stretch of a take."""

    trial: str
    start_s: float
    end_s: float
    phase: str
    share: float


@dataclass(frozen=True, kw_only=True)
class Where:
    """Shares by object, by stretch of time and by direction; each sums to 1."""

    objects: tuple[ObjectShare, ...]
    intervals: tuple[IntervalShare, ...]
    direction: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class TrialArrays:
    """Per trial. frame_score (T,) and point_score (T, K) in m/s², residual (T, K, 3 or 2); before and after (P, K, 3).

    nominal and found: (T, K, 3) m, where the points are under the nominal model and with the verdict's effect.
    """

    times: Array
    frame_score: Array
    point_score: Array
    residual: Array
    nominal: Array
    found: Array
    before: Array | None = None
    after: Array | None = None


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What is concluded from a capture.

    effects: all candidates tried, ``none`` and ``unknown``, most probable first; probabilities sum to 1.
    controls: ``wrong_effect_rms_m`` and ``last_residual_rms_m``.
    summary: the verdict in a sentence. warnings: of the capture and of the diagnosis.
    """

    verdict: Verdict
    effects: tuple[RankedEffect, ...]
    gap: Gap
    controls: Mapping[str, float]
    next_experiment: str | None
    where: Where
    trials: Mapping[str, TrialArrays]
    summary: str
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    confirmation: Mapping[str, Any] = field(default_factory=dict)


def write_diagnosis(diagnosis: Diagnosis, out: Path) -> None:
    """Write ``report.json``, ``where.npz`` and ``prediction.npz`` into the folder ``out``."""
    where, prediction = {}, {}
    for name, trial in diagnosis.trials.items():
        for key in ("frame_score", "point_score", "residual"):
            where[f"{name}.{key}"] = getattr(trial, key)
        if trial.before is not None and trial.after is not None:
            prediction[f"{name}.before"], prediction[f"{name}.after"] = trial.before, trial.after
        for key in ("times", "nominal", "found"):
            where[f"{name}.{key}"] = getattr(trial, key)
    np.savez_compressed(out / WHERE_FILE, **where)  # type: ignore[arg-type]
    np.savez_compressed(out / PREDICTION_FILE, **prediction)  # type: ignore[arg-type]
    write_json(out / REPORT_FILE, report_json(diagnosis))


def report_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """``report.json`` as plain values; numbers that do not exist are null."""
    effects = []
    for item in diagnosis.effects:
        parameters = {
            name: {"value": e.value, "unit": e.unit, "ci95": [e.low, e.high]} for name, e in item.parameters.items()
        }
        effects.append({**to_json(item), "parameters": parameters})
    return _plain(
        {
            "format": FORMAT,
            "verdict": to_json(diagnosis.verdict),
            "summary": diagnosis.summary,
            "effects": effects,
            "gap": to_json(diagnosis.gap),
            "controls": dict(diagnosis.controls),
            "next_experiment": diagnosis.next_experiment,
            "where": {
                "objects": [to_json(o) for o in diagnosis.where.objects],
                "intervals": [to_json(i) for i in diagnosis.where.intervals],
                "direction": dict(diagnosis.where.direction),
            },
            "confirmation": dict(diagnosis.confirmation),
            "warnings": list(diagnosis.warnings),
            "seconds": diagnosis.seconds,
        }
    )


def read_diagnosis(out: Path) -> tuple[dict[str, Any], Mapping[str, NDArray[Any]], Mapping[str, NDArray[Any]]]:
    """(report, where arrays, prediction arrays) of the folder ``out``.

    Raises InputError where it is none, a file is missing or not readable.
    """
    path = out / REPORT_FILE
    report = read_json(path)
    if not isinstance(report, dict) or report.get("format") != FORMAT:
        raise InputError(f"{path}: this is no {FORMAT}; run `physgen diagnose` first")
    for key, kind in (("verdict", dict), ("effects", list), ("gap", dict), ("where", dict)):
        if not isinstance(report.get(key), kind):
            raise InputError(f"{path}.{key}: missing or malformed; run `physgen diagnose` again")
    return report, read_arrays(out / WHERE_FILE), read_arrays(out / PREDICTION_FILE)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value
