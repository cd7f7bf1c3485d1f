# SPDX-License-Identifier: MIT
"""``Fits`` of a soft capture: what the searches found, as estimates, predictions and places of discrepancy."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...events import IsCancelled, OnEvent
from ..analysis import CandidateFit, Discrepancy, Estimate
from ..capture import Capture
from .candidates import NAMES
from .laws import Laws
from .search import LOST, ContactFit
from .survey import Found, Survey
from .takes import Take
from .where import discrepancy_of, raw_discrepancy

Array = NDArray[np.float64]

DRAWS = 400


class SoftFits:
    """``Fits`` of one soft capture (sim/diagnose/analysis.py)."""

    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    numerics_rms_m: float

    def __init__(self, survey: Survey) -> None:
        self._survey = survey
        self._takes, self._fit_takes, self._flights = survey.takes, survey.fit_takes, survey.flights
        self._laws: dict[int, Laws] = {}
        self._found: dict[int, Found] = {}
        self.numerics_rms_m = survey.numerics_rms_m
        self._summarize(survey.plain, survey.believed, survey.found)

    # What the fits say

    def _summarize(self, plain: Found, believed: ContactFit, found: list[Found]) -> None:
        ranked = sorted(found, key=self._survey.evidence, reverse=True)
        chosen: dict[tuple[str, ...], Found] = {}
        for entry in ranked:
            chosen.setdefault(entry.effects, entry)
        takes = [self._takes[i] for i in self._fit_takes]
        whole = self._whole_takes([believed.laws, plain.fit.laws, *(f.fit.laws for f in list(chosen.values())[:2])])
        self._windows_nominal = self._window_rms(plain.search.judge(believed.free, believed.motions).residuals)
        self._whole_nominal = self._rms(takes, whole[0])
        nominal = Found(search=plain.search, fit=dataclasses.replace(believed, jacobians=None), airborne=None)
        self.nominal = self._candidate_fit(nominal, self._whole_nominal, believed=True)
        self.refitted = self._candidate_fit(plain, self._rms(takes, whole[1]))
        fits = []
        for i, entry in enumerate(chosen.values()):
            rms = self._rms(takes, whole[2 + i]) if i < 2 and len(whole) > 2 + i else None
            fits.append(self._candidate_fit(entry, rms))
        self.candidates = tuple(fits)
        self.floor_rms_m = math.sqrt(3) * self._flights.sigma

    def _candidate_fit(self, found: Found, rms: float | None, *, believed: bool = False) -> CandidateFit:
        search, fit = found.search, found.fit
        scores, residuals = search.held_out(fit)
        flights = self._survey.flight_part(found)
        by_take = -0.5 * flights
        for window, score in zip(self._survey.problem.windows, scores, strict=True):
            by_take[self._fit_takes.index(window.take)] += score
        covariance = search.covariance(fit)
        draws = np.random.default_rng(0).multivariate_normal(fit.free, covariance, size=DRAWS, method="eigh")
        parameters = {name: _estimates(name, [values], values) for name, values, _ in found.before}
        if search.candidate is not None:
            c = search.candidate
            inside = [c.values(np.clip(d[: search.own], c.low, c.high)) for d in draws]
            parameters[c.name] = _estimates(c.name, inside, c.values(fit.free[: search.own]))
        spread = math.sqrt(max(covariance[search.own, search.own], 0.0)) if search.moves[search.own] else 0.0
        beliefs = {}
        if not believed and search.moves[search.own]:
            f = fit.laws.friction
            beliefs["friction"] = Estimate(
                value=f, unit="1", low=f * math.exp(-1.96 * spread), high=f * math.exp(1.96 * spread)
            )
        if rms is None and fit.cost >= LOST:
            takes = [self._takes[i] for i in self._fit_takes]
            rms = self._rms(takes, self._whole_takes([fit.laws])[0])
        if rms is None:
            rms = self._whole_nominal * self._window_rms(residuals) / max(self._windows_nominal, 1e-12)
        result = CandidateFit(
            effects=found.effects,
            parameters=parameters,
            beliefs=beliefs,
            log_evidence=self._survey.evidence(found),
            heldout_log_score=by_take,
            heldout_rms_m=rms,
            misfit=max(self._survey.contact_misfit(found), self._survey.flight_misfit(found)),
        )
        self._found[id(result)], self._laws[id(result)] = found, fit.laws
        return result

    def simulate(self, fit: CandidateFit) -> dict[str, Array]:
        """As ``Fits`` says."""
        return self._motion(self.laws(fit), [t.times for t in self._takes])

    def predict(self, fit: CandidateFit) -> dict[str, Array]:
        """As ``Fits`` says."""
        asked = [t.predict_times for t in self._takes]
        return self._motion(self.laws(fit), asked)

    def laws(self, fit: CandidateFit) -> Laws:
        """The model that ``fit`` stands for; the fit is one of this object's."""
        return self._laws[id(fit)]

    def discrepancy(self, fit: CandidateFit | None) -> dict[str, Discrepancy]:
        """As ``Fits`` says."""
        nominal = {t.name: p for t, p in zip(self._takes, self._in_ground(self._survey.base), strict=True)}
        if fit is None or not fit.effects:
            return {
                t.name: raw_discrepancy(t, nominal[t.name], self._flights, i, self._survey.base)
                for i, t in enumerate(self._takes)
            }
        laws = self.laws(fit)
        return discrepancy_of(self._flights, self._survey.worlds, laws, self._survey.base, nominal)

    def _motion(self, laws: Laws, times: Sequence[Array | None]) -> dict[str, Array]:
        wanted = [(i, t) for i, t in enumerate(times) if t is not None and len(t)]
        found = self._flights.lasting_motion([i for i, _ in wanted], [laws] * len(wanted), [t for _, t in wanted])
        return {self._takes[i].name: self._survey.frame.back(p) for (i, _), p in zip(wanted, found, strict=True)}

    def _in_ground(self, laws: Laws) -> list[Array]:
        n = len(self._takes)
        return self._flights.lasting_motion(list(range(n)), [laws] * n, [t.times for t in self._takes])

    def _whole_takes(self, laws: list[Laws]) -> list[list[Array]]:
        n = len(self._fit_takes)
        pairs = list(itertools.product(laws, self._fit_takes))
        found = self._flights.lasting_motion(
            [i for _, i in pairs], [a for a, _ in pairs], [self._takes[i].times for _, i in pairs]
        )
        return [found[k * n : (k + 1) * n] for k in range(len(laws))]

    # Numbers

    @staticmethod
    def _rms(takes: list[Take], motions: list[Array]) -> float:
        """Distance in m from the first contact on: what a prediction from the flight alone would miss by."""
        squares = []
        for take, motion in zip(takes, motions, strict=True):
            d = (take.points - motion)[take.flying :]
            squares.append((d[take.seen[take.flying :]] ** 2).sum(axis=1))
        found = np.concatenate(squares) if squares else np.zeros(1)
        return float(np.sqrt(found.mean())) if len(found) else 0.0

    @staticmethod
    def _window_rms(residuals: list[Array]) -> float:
        every = np.concatenate(residuals) if residuals else np.zeros(3)
        every = every[np.isfinite(every)]
        return math.sqrt(3 * float((every**2).mean())) if len(every) else 0.0


def _estimates(name: str, draws: list[dict[str, float]], values: dict[str, float]) -> dict[str, Estimate]:
    from ...effects.registry import effect

    out = {}
    for parameter in effect(name).parameters:
        found = np.array([d[parameter.name] for d in draws])
        value = float(np.clip(values[parameter.name], parameter.low, parameter.high))
        low, high = (float(q) for q in np.quantile(found, [0.025, 0.975]))
        out[parameter.name] = Estimate(value=value, unit=parameter.unit, low=min(low, value), high=max(high, value))
    return out


def fit_soft(
    capture: Capture, names: Sequence[str] | None, *, on_event: OnEvent, cancelled: IsCancelled, budget_s: float
) -> SoftFits:
    """Fit the effects ``names`` (None: all that mean something for a soft body) to a capture of one deforming object.

    budget_s: seconds that the search may take; the most promising candidates are refined first. Directions among the
    parameters are in the mesh's rest frame, those of the surroundings (wind, anchor, tilt) in the frame of the ground.
    Raises InputError for captures of pixels, of several objects or of a rigid one, ``Cancelled`` when told to stop.
    """
    if len(capture.objects) != 1:
        raise InputError(f"there are {len(capture.objects)} objects: a soft diagnosis handles one")
    if capture.objects[0].belief.youngs_modulus_pa is None:
        raise InputError("youngs_modulus_pa is null: diagnose the object as a rigid one, or give its modulus")
    if any(t.points is None for t in capture.trials):
        raise InputError("a trial has pixels: a soft object needs 3D points")
    wanted = NAMES if names is None else tuple(n for n in NAMES if n in set(names))
    survey = Survey(capture, on_event=on_event, cancelled=cancelled, budget_s=budget_s)
    survey.run(wanted)
    return SoftFits(survey)
