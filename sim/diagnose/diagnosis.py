# SPDX-License-Identifier: MIT
"""A diagnosis: what the fits of one kind of body deliver, and the conclusion as dataclasses and files.

``rigid`` and ``soft`` implement ``Fits``; model comparison and report know nothing else of them. A ``Diagnosis`` is
what is written (``physgen-diagnosis/1``), the counterpart of ``capture``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..errors import InputError
from ..validation import read_json, to_json
from .capture import read_arrays
from .provenance import Provenance
from .work import WorkRecord

Array = NDArray[np.float64]
PHASES = ("flight", "impact", "contact", "rest")
DIRECTIONS = ("normal", "along_velocity", "along_gravity", "other")


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """A fitted number: value in ``unit`` with its 95 % interval [low, high]."""

    value: float
    unit: str
    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class CandidateFit:
    """The nominal model with ``effects`` added, fitted.

    effects: names, as in ``sim.effects``; () for the nominal model.
    parameters: effect → parameter of its schema → estimate, as ``Effect.apply`` takes them.
    beliefs: re-fitted parameters of the nominal model (``friction``, ``restitution``, ``youngs_modulus_pa``).
    log_evidence: log marginal likelihood in nats of all fit trials (Laplace approximation over states, beliefs and
        parameters). Comparable between all candidates of one capture: same data, same noise.
    heldout_log_score: (trials,) log probability in nats of each fit trial when the parameters were fitted without it.
    heldout_rms_m: RMS distance in m between observed and predicted points on held-out data.
    heldout_chi: the same, each trial's over what noise and contacts make of its prediction, RMS of the trials: one that
        tumbled chaotically does not decide whether a model predicts better. NaN where that is not known.
    heldout_trials: what ``heldout_chi`` is the RMS of, in the order of bodies and trials; () where that is not known.
    heldout_elsewhere: of each of these, whether the body comes to lie on another face than predicted.
    bending: nats by which a missing force, beside a slow error of the recording, explains what the model leaves of
        whole trials; of single tracked points, measured for the nominal model and the re-fitted one. Else 0.
    misfit: RMS residual over what noise and numerical error would leave; 1 is explained, far above 1 means that
        something is still missing.
    limit: of a deformable body, misfit above which the right candidate leaves one in six times, by what two lattices
        leave open; NaN of a rigid one, whose limit is a constant of the comparison.
    """

    effects: tuple[str, ...]
    parameters: Mapping[str, Mapping[str, Estimate]]
    beliefs: Mapping[str, Estimate] = field(default_factory=dict)
    log_evidence: float
    heldout_log_score: Array
    heldout_rms_m: float
    misfit: float
    heldout_chi: float = math.nan
    heldout_trials: tuple[float, ...] = ()
    heldout_elsewhere: tuple[bool, ...] = ()
    bending: float = 0.0
    limit: float = math.nan


@dataclass(frozen=True, kw_only=True)
class PhaseInterval:
    """A time interval of a trial in one of ``PHASES``, from start_s to end_s of recorded time."""

    start_s: float
    end_s: float
    phase: str


@dataclass(frozen=True, kw_only=True)
class Discrepancy:
    """Localised discrepancy of the nominal model in one trial. T frames, K points.

    frame_score: (T,) m/s², missing force per mass in each frame, not the accumulated error.
    point_score: (T, K) the same at every point.
    residual: (T, K, 3) m or (T, K, 2) pixels, observed minus nominal; NaN where not seen.
    intervals: the whole trial, split into phases.
    directions: direction of the missing force as shares by ``DIRECTIONS``; they sum to 1.
    """

    frame_score: Array
    point_score: Array
    residual: Array
    intervals: tuple[PhaseInterval, ...]
    directions: Mapping[str, float]


class FittedModels(Protocol):
    """The basis of a verdict: all candidates fitted to one capture.

    nominal: the model as given. refitted: the same with its own parameters fitted. candidates: one or two effects each.
    floor_rms_m: noise floor, distance in m that noise alone leaves on held-out data.
    grain_rms_m: distance in m by which the simulator's own uncertainty, at contacts and in its steps, moves the nominal
        model's prediction of held-out data.
    """

    @property
    def nominal(self) -> CandidateFit:
        """Return the model as given."""
        ...

    @property
    def refitted(self) -> CandidateFit:
        """Return the nominal model with its own parameters fitted."""
        ...

    @property
    def candidates(self) -> tuple[CandidateFit, ...]:
        """Return the fitted candidates."""
        ...

    @property
    def floor_rms_m(self) -> float:
        """Return the noise floor in m."""
        ...

    @property
    def grain_rms_m(self) -> float:
        """Return the simulator's uncertainty in m."""
        ...


class Fits(FittedModels, Protocol):
    """The fits of one capture: what is decided from, and what the models predict."""

    def numerics_rms_m(self, fit: CandidateFit) -> float:
        """Return the distance in m by which predictions of ``fit`` change with resolution or time step."""

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """Return points (P, K, 3) in m at the ``predict_times`` of every predict trial, by its name."""

    def simulate(self, fit: CandidateFit) -> dict[str, Array]:
        """Return points (T, K, 3) in m at the frames of every trial, by its name, simulated from its first frames."""

    def hidden_spins(self, fit: CandidateFit) -> dict[str, Array]:
        """Return the spin (3,) in rad/s at the first frame of every trial, by its name, whose points do not show it: of
        the one body of a capture."""

    def discrepancy(self, fit: CandidateFit | None) -> dict[str, Discrepancy]:
        """Return the discrepancy by trial; with a ``fit`` as that candidate explains it, which is less noisy."""


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
