# SPDX-License-Identifier: MIT
"""A diagnosis (``physgen-diagnosis/1``): the conclusion as dataclasses and files, the counterpart of a capture."""

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
from ..validation import read_json, to_json
from .capture_folder import read_arrays
from .fits import Estimate
from .provenance import Provenance
from .work import WorkRecord

Array = NDArray[np.float64]
FORMAT = "physgen-diagnosis/1"
REPORT_FILE, WHERE_FILE, PREDICTION_FILE, PAGE_FILE = "report.json", "where.npz", "prediction.npz", "report.html"
TIMES_FILE = "times.json"

NONE, UNKNOWN = "none", "unknown"

SAME = "the same motion as without it"
"""``RankedEffect.reason`` of an effect that changes nothing in this capture."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """effect: the most probable single name; alternatives: effects that the data cannot distinguish from it.

    effects: all effects found, in the order found (two simultaneous causes); () for ``none`` and ``unknown``.
    """

    effect: str
    probability: float
    alternatives: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class RankedEffect:
    """One candidate as listed in the report; NaN for missing numbers.

    misfit: as of its fit. reason: why it is not the verdict, in a few words; "" for the verdict.
    """

    name: str
    kind: str
    probability: float
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    heldout_rms_m: float = math.nan
    closed_fraction: float = math.nan
    misfit: float = math.nan
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class AddedEffect:
    """One of two causes. parameters: of the fit of both. without_rms_m: held-out error with the other one alone.

    nats: log evidence that it adds to the other one alone.
    """

    effect: str
    parameters: Mapping[str, Estimate]
    without_rms_m: float
    nats: float


@dataclass(frozen=True, kw_only=True)
class FoundPair:
    """Two causes found, fitted together. probability: of the verdict. closed_fraction: NaN where not resolvable."""

    effects: tuple[str, ...]
    probability: float
    heldout_rms_m: float
    closed_fraction: float
    misfit: float
    adds: tuple[AddedEffect, ...]


@dataclass(frozen=True, kw_only=True)
class Gap:
    """RMS distances in m on held-out data; closed_fraction, at most 1, with its 95 % bootstrap interval around it.

    numerics_rms_m: change of the prediction behind ``after`` with resolution or time step.
    noise_rms_m: tracking noise of a point alone; the floor also has what it makes of a prediction from first frames.
    grain_rms_m: how far the simulator's own uncertainty, at contacts and in its steps, moves the nominal prediction.
    """

    before_rms_m: float
    refitted_rms_m: float
    after_rms_m: float
    noise_floor_rms_m: float
    closed_fraction: float
    closed_fraction_ci95: tuple[float, float]
    resolvable: bool
    numerics_rms_m: float = math.nan
    noise_rms_m: float = math.nan
    grain_rms_m: float = math.nan


@dataclass(frozen=True, kw_only=True)
class ObjectShare:
    """Share of the discrepancy in one object."""

    name: str
    share: float


@dataclass(frozen=True, kw_only=True)
class IntervalShare:
    """Share of the discrepancy in one time interval of a trial."""

    trial: str
    start_s: float
    end_s: float
    phase: str
    share: float


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """Shares of the discrepancy by object, time interval and direction; each sums to 1."""

    objects: tuple[ObjectShare, ...]
    intervals: tuple[IntervalShare, ...]
    direction: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class TrialArrays:
    """Arrays of one trial. frame_score (T,) and point_score (T, K) in m/s², residual (T, K, 3) m or (T, K, 2) px.

    nominal and found: (T, K, 3) m, points of the nominal model and of the verdict's model. before and after:
    (P, K, 3) m, their predictions; None unless it is a predict trial.
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
    """The diagnosis of a capture.

    effects: all tested candidates, ``none`` and ``unknown``, most probable first; probabilities sum to 1.
    controls: ``wrong_effect_rms_m`` and ``last_residual_rms_m``.
    summary: the verdict in a sentence. warnings: of the capture and of the diagnosis. confirmation: verification runs.
    pair: the fit of both causes where the verdict names two, else None.
    seconds: wall time, the only number that differs when the same capture is diagnosed again (``times.json``). work:
    budget and use.
    provenance: capture, command, version.

    >>> import physgen
    >>> found = physgen.diagnose(physgen.load_capture("capture"), out="diagnosis")  # doctest: +SKIP
    >>> found.verdict.effect, found.verdict.probability, found.gap.closed_fraction  # doctest: +SKIP
    ('air_drag', 0.99, 0.97)
    """

    verdict: Verdict
    effects: tuple[RankedEffect, ...]
    gap: Gap
    controls: Mapping[str, float]
    next_experiment: str | None
    where: Localisation
    trials: Mapping[str, TrialArrays]
    summary: str
    pair: FoundPair | None = None
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0
    work: WorkRecord | None = None
    provenance: Provenance | None = None
    confirmation: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Diagnosis({self.verdict.effect}, probability {self.verdict.probability:.2f})"


def write_diagnosis(diagnosis: Diagnosis, out: Path) -> None:
    """Write ``report.json``, ``where.npz``, ``prediction.npz`` and ``times.json`` into the folder ``out``.

    How long it took is apart from what was found, so that the same diagnosis has the same bytes.
    """
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
    write_json(out / TIMES_FILE, {"seconds": _plain(diagnosis.seconds)})


def report_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the content of ``report.json`` as plain values; missing numbers are null."""
    effects = []
    for item in diagnosis.effects:
        effects.append({**to_json(item), "parameters": _parameters_json(item.parameters)})
    return _plain(
        {
            "format": FORMAT,
            "verdict": to_json(diagnosis.verdict),
            "summary": diagnosis.summary,
            "effects": effects,
            "pair": None if diagnosis.pair is None else _pair_json(diagnosis.pair),
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
            "work": None if diagnosis.work is None else to_json(diagnosis.work),
            "provenance": None if diagnosis.provenance is None else to_json(diagnosis.provenance),
        }
    )


def _parameters_json(parameters: Mapping[str, Estimate]) -> dict[str, Any]:
    return {name: {"value": e.value, "unit": e.unit, "ci95": [e.low, e.high]} for name, e in parameters.items()}


def _pair_json(pair: FoundPair) -> dict[str, Any]:
    adds = [{**to_json(a), "parameters": _parameters_json(a.parameters)} for a in pair.adds]
    return {**to_json(pair), "adds": adds}


def read_diagnosis(out: Path) -> tuple[dict[str, Any], Mapping[str, NDArray[Any]], Mapping[str, NDArray[Any]]]:
    """Return (report, localisation arrays, prediction arrays) of the folder ``out``.

    Raises InputError where it is not a diagnosis, or a file is missing or unreadable.
    """
    path = out / REPORT_FILE
    report = read_json(path)
    if not isinstance(report, dict) or report.get("format") != FORMAT:
        raise InputError(f"{path}: not in {FORMAT} format; run `physgen diagnose` first")
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
