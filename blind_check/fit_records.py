# SPDX-License-Identifier: MIT
"""Fitted candidates of generated captures as small files: decisions are tuned and judged on them in seconds.

Fitting a capture takes seconds to minutes, deciding from its fits a millisecond. A record holds what
``compare_models`` reads, how far each model is from the withheld truth, and the truth itself.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..sim.atomic import write_json
from ..sim.diagnose.fits import CandidateFit, Estimate, Fits
from ..sim.diagnose.run_diagnosis import DiagnoseOptions, allowed_work, fit_candidates
from ..sim.errors import InputError, PhysGenError
from ..sim.events import IsCancelled, never
from ..sim.validation import read_json
from .case import BlindCase
from .check import PlannedCase, make_any
from .scoring import localisation_auc

FORMAT = "physgen-fit-record/1"


@dataclass(frozen=True, kw_only=True)
class FitRecord:
    """Fits of one generated capture, and its truth. It can be given to ``compare_models``.

    matter: ``rigid`` or ``soft``. truth: the label (``Truth.label``). size_m: largest distance of the mesh to its
    middle. withheld_rms_m: by model (effects joined by "+", "" for the nominal one, "refitted"), RMS distance in m to
    the withheld truth. frame_auc: by model ("" for what is measured without one), how well its localisation ranks
    frames in which the cause acts; none where it acts always or never. cpu_s: of the fits. note: why there are no
    fits, or "".
    """

    matter: str
    truth: Mapping[str, Any]
    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    grain_rms_m: float
    withheld_rms_m: Mapping[str, float]
    frame_auc: Mapping[str, float] = field(default_factory=dict)
    size_m: float = math.nan
    cpu_s: float = math.nan
    note: str = ""

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the true causes; () for none and for unknown."""
        return tuple(self.truth.get("effects") or ())

    @property
    def effect(self) -> str:
        """Return the first true cause, ``none`` or ``unknown``."""
        return str(self.truth["effect"])


def record_case(planned: PlannedCase, seed: Sequence[int], cancelled: IsCancelled = never) -> dict[str, Any]:
    """Return the record of a new case, drawn with ``seed``; a note in place of fits where it cannot be diagnosed."""
    case = make_any(planned, seed, cancelled)
    vertices = case.capture.objects[0].vertices
    known = {
        "format": FORMAT,
        "matter": planned.matter,
        "truth": case.truth.label(),
        "size_m": float(np.linalg.norm(vertices - 0.5 * (vertices.min(0) + vertices.max(0)), axis=1).max()),
    }
    started = time.process_time()
    options = DiagnoseOptions(confirm=False)
    try:
        fits = fit_candidates(case.capture, options, allowed_work(case.capture, options), cancelled=cancelled)
    except PhysGenError as error:
        return {**known, "note": str(error)}
    return {
        **known,
        "nominal": _plain_fit(fits.nominal),
        "refitted": _plain_fit(fits.refitted),
        "candidates": [_plain_fit(c) for c in fits.candidates],
        "floor_rms_m": fits.floor_rms_m,
        "grain_rms_m": fits.grain_rms_m,
        "withheld_rms_m": _withheld(case, fits),
        "frame_auc": _frame_auc(case, fits),
        "cpu_s": time.process_time() - started,
    }


def _withheld(case: BlindCase, fits: Fits) -> dict[str, float]:
    truth = {n: t.withheld for n, t in case.truth.trials.items() if t.withheld is not None}
    models = {"": fits.nominal, "refitted": fits.refitted, **{"+".join(c.effects): c for c in fits.candidates}}
    found = {}
    for name, fit in models.items():
        points = fits.predict(fit)
        squares = [np.sum((points[n] - wanted) ** 2, axis=-1).ravel() for n, wanted in truth.items() if n in points]
        found[name] = float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else math.nan
    return found


LOCALISED = 6
"""Likeliest candidates whose localisation is recorded."""


def _frame_auc(case: BlindCase, fits: Fits) -> dict[str, float]:
    truth = case.truth.arrays()
    likeliest = sorted(fits.candidates, key=lambda c: -c.log_evidence)[:LOCALISED]
    found = {}
    for name, fit in (("", None), *(("+".join(c.effects), c) for c in likeliest)):
        where = {f"{trial}.frame_score": d.frame_score for trial, d in fits.discrepancy(fit).items()}
        area = localisation_auc(where, {k: v for k, v in truth.items() if not k.endswith(".point_mask")})[0]
        if area is not None:
            found[name] = area
    return found


def _plain_fit(fit: CandidateFit) -> dict[str, Any]:
    return {
        "effects": list(fit.effects),
        "log_evidence": fit.log_evidence,
        "heldout_rms_m": fit.heldout_rms_m,
        "heldout_chi": fit.heldout_chi,
        "heldout_trials": list(fit.heldout_trials),
        "heldout_elsewhere": list(fit.heldout_elsewhere),
        "bending": fit.bending,
        "misfit": fit.misfit,
        "limit": fit.limit,
        "heldout_log_score": [float(s) for s in fit.heldout_log_score],
        "parameters": {
            name: {k: [e.value, e.low, e.high, e.unit] for k, e in values.items()}
            for name, values in fit.parameters.items()
        },
    }


def _read_fit(value: Mapping[str, Any]) -> CandidateFit:
    return CandidateFit(
        effects=tuple(value["effects"]),
        log_evidence=_number(value["log_evidence"]),
        heldout_rms_m=_number(value["heldout_rms_m"]),
        heldout_chi=_number(value.get("heldout_chi")),
        heldout_trials=tuple(_number(x) for x in value.get("heldout_trials") or ()),
        heldout_elsewhere=tuple(bool(x) for x in value.get("heldout_elsewhere") or ()),
        bending=float(value.get("bending") or 0.0),
        misfit=_number(value["misfit"]),
        limit=_number(value.get("limit")),
        heldout_log_score=np.array([_number(s) for s in value["heldout_log_score"]]),
        parameters={
            name: {
                k: Estimate(value=_number(v), low=_number(low), high=_number(high), unit=str(unit))
                for k, (v, low, high, unit) in values.items()
            }
            for name, values in value["parameters"].items()
        },
    )


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def save_record(record: Mapping[str, Any], path: Path) -> None:
    """Write ``record`` (``record_case``) to ``path`` at once; numbers that are not finite become null."""
    write_json(path, _finite(record))


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def load_records(folder: Path, *, numbers: range | None = None) -> list[FitRecord]:
    """Return the records in ``folder`` by name, without captures that could not be diagnosed.

    numbers: of the cases to read, None for all: what is looked at and what is kept for the end stay apart.
    Raises InputError where a file is none, or no file is there.
    """
    found = []
    paths = sorted(folder.glob("case-*.json"))
    if numbers is not None:
        wanted = {f"case-{i:04d}" for i in numbers}
        paths = [p for p in paths if p.stem in wanted]
    for path in paths:
        value = read_json(path)
        if not isinstance(value, dict) or value.get("format") != FORMAT:
            raise InputError(f"{path}: not in {FORMAT} format; make it again")
        if value.get("note"):
            continue
        try:
            found.append(_read_record(value))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(f"{path}: malformed ({error!r}); delete it and run the calibration again") from None
    if not paths:
        some = "" if numbers is None else f" from {numbers.start} to {numbers.stop - 1}"
        raise InputError(f"{folder}: holds no records{some}; run the calibration with --cases first")
    return found


def _read_record(value: Mapping[str, Any]) -> FitRecord:
    return FitRecord(
        matter=str(value["matter"]),
        truth=dict(value["truth"]),
        nominal=_read_fit(value["nominal"]),
        refitted=_read_fit(value["refitted"]),
        candidates=tuple(_read_fit(c) for c in value["candidates"]),
        floor_rms_m=_number(value["floor_rms_m"]),
        grain_rms_m=_number(value["grain_rms_m"]),
        withheld_rms_m={k: _number(v) for k, v in value["withheld_rms_m"].items()},
        frame_auc={k: _number(v) for k, v in (value.get("frame_auc") or {}).items()},
        size_m=_number(value.get("size_m")),
        cpu_s=_number(value.get("cpu_s")),
    )


def missing_cases(folder: Path, count: int, shard: tuple[int, int]) -> Sequence[int]:
    """Return the indices below ``count`` of ``shard`` (number from 0, of how many) without a record in ``folder``."""
    number, of = shard
    if not 0 <= number < of:
        raise InputError(f"shard is {number}/{of}: give 0/{of} to {of - 1}/{of}")
    return [i for i in range(number, count, of) if not (folder / f"case-{i:04d}.json").exists()]
