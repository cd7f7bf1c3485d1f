# SPDX-License-Identifier: MIT
"""The whole diagnosis: capture → fits → model comparison → verification run → diagnosis (docs/diagnosis.md)."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..effects.registry import effects
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from .against_none import nominal_or_refitted
from .capture import Capture
from .comparison_settings import ComparisonSettings
from .diagnosis import NONE, UNKNOWN, AddedEffect, Array, Diagnosis, FoundPair, Gap, RankedEffect, TrialArrays
from .fits import CandidateFit, Discrepancy, Fits, FittedModels
from .gap_metrics import bootstrap_interval, localise, measure_gap, negative_controls
from .model_comparison import (
    ModelComparison,
    closed_fraction,
    compare_models,
    kind_of,
)
from .provenance import provenance
from .report.effect_words import effect_label
from .report.wording import verdict_summary
from .suggested_experiments import next_experiment, recorded_setting
from .verification_run import VerificationRun, run_verification
from .work import RIGID_RATE, SOFT_RATE, Work, WorkRecord

CONFIRMED_TAKES = 2
"""Trials of the verification run: each costs seconds, and the second separates chance from confirmation."""


@dataclass(frozen=True, kw_only=True)
class DiagnoseOptions:
    """Options of a diagnosis.

    budget_s: time in s that the fits may take on two idle cores, 10 to 86400, turned into work at a fixed rate
        (``sim.diagnose.work``), so that no verdict depends on the machine; the verification run comes on top.
    work: the same as simulated steps, 10⁵ to 10¹³, instead of ``budget_s``; None: what ``budget_s`` stands for.
    effects: names of the candidates; None for all that can act on these objects.
    confirm: whether to verify the verdict in the particle engine.
    """

    budget_s: float = 300.0
    work: int | None = None
    effects: tuple[str, ...] | None = None
    confirm: bool = True

    def __post_init__(self) -> None:
        if not 10 <= self.budget_s <= 86400:
            raise InputError(f"budget is {self.budget_s!r} s: give 10 s to 24 h")
        if self.work is not None and not 1e5 <= self.work <= 1e13:
            raise InputError(f"work is {self.work!r} steps: give 1e5 to 1e13")
        known = [n for n, e in effects().items() if n != "sandy"]
        for name in self.effects or ():
            if name not in known:
                raise InputError(f"effects names {name!r}: choose from {', '.join(known)}")
        if self.effects is not None and not self.effects:
            raise InputError("effects is empty: name at least one, or leave it out for all")

    def arguments(self) -> tuple[str, ...]:
        """Return the arguments of ``physgen diagnose`` that stand for these options."""
        said = ["--budget", f"{self.budget_s:g}s"] if self.work is None else ["--work", str(self.work)]
        said += [] if self.effects is None else ["--effects", ",".join(self.effects)]
        return (*said, *(() if self.confirm else ("--no-confirm",)))


def diagnose(
    capture: Capture,
    options: DiagnoseOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Diagnosis:
    """Return the diagnosis of ``capture``.

    Raises InputError for a capture that cannot be diagnosed, SimulationError when the nominal model diverges, and
    Cancelled when ``cancelled()`` becomes True.
    """
    options = options or DiagnoseOptions()
    started = time.monotonic()
    work = allowed_work(capture, options)
    fits = fit_candidates(capture, options, work, on_event, cancelled)
    weighed = compare_models(fits, ComparisonSettings())
    warnings = [*capture.warnings, *_left_out(fits, options, work)]
    for warning in warnings[len(capture.warnings) :]:
        on_event({"event": "notice", "stage": "diagnose", "message": warning})
    verdict, found = weighed.verdict, found_fit(fits, weighed)
    nominal_points, found_points = fits.simulate(fits.nominal), fits.simulate(found)
    gap = measure_gap(capture, fits, found, nominal_points)
    if verdict.effect == NONE:
        # Nothing was added, so there is no share to state.
        gap = dataclasses.replace(gap, closed_fraction=math.nan)
    gap = dataclasses.replace(
        gap, closed_fraction_ci95=bootstrap_interval(capture, nominal_points, found_points, found, gap)
    )
    confirmations: list[VerificationRun] = []
    if options.confirm and len(capture.objects) == 1 and verdict.effect not in (NONE, UNKNOWN):
        confirmations, notes = _confirm(capture, fits, found, nominal_points, found_points, on_event, cancelled)
        warnings += notes
    discrepancies = fits.discrepancy(None if verdict.effect in (NONE, UNKNOWN) else found)
    ranked = _ranking(weighed, gap)
    kinds = {item.name: item.kind for item in ranked}
    predictions = fits.predict(fits.nominal), fits.predict(found)
    return Diagnosis(
        verdict=verdict,
        effects=ranked,
        pair=_found_pair(fits, weighed, found, gap),
        gap=gap,
        controls=negative_controls(capture, fits, weighed, found, nominal_points),
        next_experiment=next_experiment(verdict, kinds, resolvable=gap.resolvable, setting=recorded_setting(capture)),
        where=localise(capture, discrepancies),
        trials=_arrays(capture, discrepancies, nominal_points, found_points, *predictions),
        summary=verdict_summary(verdict, gap),
        warnings=tuple(warnings),
        seconds=round(time.monotonic() - started, 2),
        work=WorkRecord(
            budget=int(work.limit),
            spent=work.spent,
            per_second=int(work.rate),
            skipped=dict(sorted(work.skipped.items())),
        ),
        provenance=provenance(capture, options.arguments()),
        confirmation=_confirmation_json(confirmations),
    )


def allowed_work(capture: Capture, options: DiagnoseOptions) -> Work:
    """Return the work that ``options`` allow for ``capture``."""
    rate = RIGID_RATE if all(item.belief.rigid for item in capture.objects) else SOFT_RATE
    return Work(limit=options.budget_s * rate if options.work is None else options.work, rate=rate)


def _left_out(fits: Fits, options: DiagnoseOptions, work: Work) -> list[str]:
    """Return sentences on effects that were not tried or not to the end, and why."""
    said = []
    tried = {name for fit in fits.candidates for name in fit.effects}
    absent = [n for n in options.effects or () if n not in tried and n not in work.skipped]
    if absent:
        said.append(f"{', '.join(absent)}: asked for and not tried, because it cannot act or show in this capture")
    return said + cut_off(work)


def cut_off(work: Work) -> list[str]:
    """Return sentences on what was left out for lack of work."""
    by_kind: dict[str, list[str]] = {}
    for name, what in sorted(work.skipped.items()):
        by_kind.setdefault(what, []).append(effect_label(name))
    return [
        f"{', '.join(names)}: not {what}, because the budget was spent; give a larger --budget or --work"
        for what, names in by_kind.items()
    ]


def fit_candidates(
    capture: Capture,
    options: DiagnoseOptions,
    work: Work,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Fits:
    """Return all candidates fitted to ``capture``. Raises as ``diagnose`` does."""
    # Taichi is imported only here.
    rigid = [item.belief.rigid for item in capture.objects]
    if all(rigid):
        from .rigid.rigid_fits import fit_rigid

        return fit_rigid(capture, options.effects, on_event=on_event, cancelled=cancelled, work=work)
    if len(capture.objects) > 1:
        soft = capture.objects[rigid.index(False)].name
        raise InputError(
            f"object {soft!r} is deformable and not alone: a capture holds either rigid objects or one deformable; "
            "make a capture of it alone"
        )
    from .soft.soft_fits import fit_soft

    return fit_soft(capture, options.effects, on_event=on_event, cancelled=cancelled, work=work)


REFITTED = 0.999
"""Share of the error below which re-fitted contacts count as a change of the motion: less is rounding."""


def found_fit(fits: FittedModels, weighed: ModelComparison) -> CandidateFit:
    """Return the fit that predicts ``after``: the verdict's.

    For ``none`` that is the nominal model, for ``unknown`` the re-fitted one where it predicts better.
    """
    name = weighed.verdict.effect
    if name not in (NONE, UNKNOWN):
        return weighed.best[name]
    other = fits.refitted if name == UNKNOWN else nominal_or_refitted(fits)
    return other if other.heldout_rms_m < REFITTED * fits.nominal.heldout_rms_m else fits.nominal


def _confirm(
    capture: Capture,
    fits: Fits,
    found: CandidateFit,
    nominal_points: Mapping[str, Array],
    found_points: Mapping[str, Array],
    on_event: OnEvent,
    cancelled: IsCancelled,
) -> tuple[list[VerificationRun], list[str]]:
    results: list[VerificationRun] = []
    nominal_spins, found_spins = fits.hidden_spins(fits.nominal), fits.hidden_spins(found)
    for trial in capture.fit_trials[:CONFIRMED_TAKES]:
        on_event({"event": "notice", "stage": "diagnose", "message": f"verification run of {trial.name} in the engine"})
        try:
            results.append(
                run_verification(
                    capture,
                    trial,
                    fits.nominal,
                    found,
                    nominal_points[trial.name],
                    found_points[trial.name],
                    cancelled,
                    nominal_spin=nominal_spins.get(trial.name),
                    verdict_spin=found_spins.get(trial.name),
                )
            )
        except InputError as error:
            return results, [f"the verification run of {trial.name} failed: {error}"]
    against = [c.trial for c in results if c.word == "contradicted"]
    if against:
        return results, [f"the particle engine contradicts the verdict on {', '.join(against)}"]
    if all(c.word == "undecided" for c in results):
        return results, ["the particle engine cannot distinguish verdict and nominal model at its resolution"]
    return results, []


def _confirmation_json(items: list[VerificationRun]) -> Mapping[str, Any]:
    return {"takes": [dataclasses.asdict(c) | {"word": c.word} for c in items]} if items else {}


def _ranking(weighed: ModelComparison, gap: Gap) -> tuple[RankedEffect, ...]:
    verdict = weighed.verdict
    items = []
    for name, probability in weighed.probabilities.items():
        fit = weighed.best.get(name)
        if fit is None:
            items.append(RankedEffect(name=name, kind=kind_of(name), probability=probability))
            continue
        error = fit.heldout_rms_m if fit.effects else min(fit.heldout_rms_m, gap.before_rms_m)
        closed = math.nan
        if gap.resolvable and verdict.effect != NONE:
            closed = closed_fraction(gap.before_rms_m, error, gap.noise_floor_rms_m)
        items.append(
            RankedEffect(
                name=name,
                kind=kind_of(name),
                probability=probability,
                parameters=fit.parameters.get(name, {}),
                heldout_rms_m=error,
                closed_fraction=closed,
                misfit=fit.misfit,
                reason=weighed.reasons.get(name, ""),
            )
        )
    for name in verdict.effects[1:]:
        # The second of two causes takes its parameters from the fit of both.
        fit = weighed.best[verdict.effect]
        items = [
            dataclasses.replace(
                item,
                parameters=fit.parameters[name],
                heldout_rms_m=fit.heldout_rms_m,
                closed_fraction=gap.closed_fraction,
                misfit=fit.misfit,
                reason="",
            )
            if item.name == name
            else item
            for item in items
        ]
    return tuple(sorted(items, key=lambda item: -item.probability))


def _found_pair(fits: FittedModels, weighed: ModelComparison, found: CandidateFit, gap: Gap) -> FoundPair | None:
    """Return the two causes of the verdict, and what each adds to the other; None where it names fewer."""
    names = weighed.verdict.effects
    alone = {c.effects[0]: c for c in fits.candidates if len(c.effects) == 1}
    if len(names) != 2 or not all(n in alone for n in names):
        return None
    adds = []
    for name, other in (names, names[::-1]):
        rest = alone[other]
        adds.append(
            AddedEffect(
                effect=name,
                parameters=found.parameters[name],
                without_rms_m=rest.heldout_rms_m,
                nats=found.log_evidence - rest.log_evidence,
            )
        )
    return FoundPair(
        effects=names,
        probability=weighed.verdict.probability,
        heldout_rms_m=found.heldout_rms_m,
        closed_fraction=gap.closed_fraction,
        misfit=found.misfit,
        adds=tuple(adds),
    )


def _arrays(
    capture: Capture,
    discrepancies: Mapping[str, Discrepancy],
    nominal: Mapping[str, Array],
    found: Mapping[str, Array],
    before: Mapping[str, Array],
    after: Mapping[str, Array],
) -> dict[str, TrialArrays]:
    result = {}
    for trial in capture.trials:
        d = discrepancies[trial.name]
        result[trial.name] = TrialArrays(
            times=trial.times,
            frame_score=d.frame_score,
            point_score=d.point_score,
            residual=d.residual,
            nominal=nominal[trial.name],
            found=found[trial.name],
            before=before.get(trial.name),
            after=after.get(trial.name),
        )
    return result
