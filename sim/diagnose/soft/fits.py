# SPDX-License-Identifier: MIT
"""All candidates fitted to one soft capture: the order of the search, and what the fits say afterwards."""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...events import IsCancelled, OnEvent, StageProgress
from ..analysis import CandidateFit, Discrepancy, Estimate
from ..capture import Capture
from .airborne import Airborne, fit_airborne
from .body_mesh import body_mesh, coarser
from .candidates import IN_FLIGHT, NAMES, Candidate, candidates
from .grain import Grain, grain_between
from .laws import Laws
from .search import LOST, ContactFit, ContactProblem, Search, Window
from .takes import Flights, GroundFrame, Take, take_of
from .where import discrepancy_of, raw_discrepancy
from .worlds import SoftWorlds

Array = NDArray[np.float64]

HORIZON = 0.085
"""Seconds after first contact that are fitted: the impact and the first ringing, before small differences grow."""

COARSER = 1.5
"""Cells of the lattice that the grain is measured with, over those of the fits' lattice."""

SEEN_IN_FLIGHT = 9.0
"""Gain in chi2 of the flights from which an effect that acts in flight is followed into the contact as well."""

ROUNDS, FINE_ROUNDS = 4, 2
DESCENTS = 2
"""Starts of a candidate that are followed on the rough lattice."""

NEARBY = (-0.12, 0.0, 0.12)
"""Logarithms about the rough lattice's end that are tried on the fine one, which is a little softer."""

FULL_SEARCHES = 3
"""Candidates that are followed on the fine lattice."""

UNEXPLAINED = 1.3
"""Misfit of the best single effect above which two at once are tried."""

FREEDOM = 4.0
"""Nats that a number of an effect fitted before costs: about what Laplace's method takes from one in these fits."""

DRAWS = 400


class Cancelled(Exception):
    """Nobody wants the result any more."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Found:
    """A fit with the search that made it, and the effects before the candidate's own."""

    search: Search
    fit: ContactFit
    airborne: Airborne | None
    before: tuple[tuple[str, dict[str, float], Airborne], ...] = ()

    @property
    def effects(self) -> tuple[str, ...]:
        own = () if self.search.candidate is None else (self.search.candidate.name,)
        return (*(name for name, _, _ in self.before), *own)


class SoftFits:
    """``Fits`` of one soft capture (sim/diagnose/analysis.py)."""

    nominal: CandidateFit
    refitted: CandidateFit
    candidates: tuple[CandidateFit, ...]
    floor_rms_m: float
    numerics_rms_m: float

    def __init__(
        self, capture: Capture, names: Sequence[str], *, on_event: OnEvent, cancelled: IsCancelled, budget_s: float
    ) -> None:
        self._begin, self._budget, self._cancelled = time.monotonic(), budget_s, cancelled
        self._progress = StageProgress(on_event, "diagnose", 100)
        self._frame = GroundFrame(capture)
        item = capture.objects[0]
        belief = item.belief
        assert belief.youngs_modulus_pa is not None
        mesh = body_mesh(item.vertices, item.faces)
        self._takes = [take_of(t, self._frame, mesh.nodes) for t in capture.trials]
        rest = capture.trials[0].rest_points
        if any(t.rest_points.shape != rest.shape or np.abs(t.rest_points - rest).max() > 1e-9 for t in capture.trials):
            raise InputError("rest_points differ between trials: track the same points in all trials of a soft object")
        self._worlds = SoftWorlds(mesh, belief.density_kg_m3, rest)
        self._flights = Flights(self._takes, self._worlds, capture.noise_sigma)
        x, y, z = (float(c) for c in self._frame.direction(np.asarray(capture.gravity)))
        self._base = Laws(
            modulus=belief.youngs_modulus_pa,
            poisson_ratio=belief.poisson_ratio,
            friction=max(capture.ground.friction, 1e-3),
            gravity=(x, y, z),
        )
        self._size = float(np.ptp(mesh.nodes, axis=0).mean() / 2)
        self._fit_takes = [i for i, t in enumerate(self._takes) if t.role == "fit"]
        self._check()
        coarse_mesh = coarser(mesh, item.vertices, item.faces, factor=COARSER)
        self._coarse = Flights(self._takes, SoftWorlds(coarse_mesh, belief.density_kg_m3, rest), capture.noise_sigma)
        self._motions: dict[Laws, dict[str, Array]] = {}
        self._found: dict[int, _Found] = {}
        self._laws: dict[int, Laws] = {}
        found = (self._window(i) for i in self._fit_takes)
        windows = [w for w in found if w is not None]
        grain = self._measure_grain(windows)
        self._problem = ContactProblem(self._flights, windows, self._base, grain=grain, size=self._size)
        self._rough = ContactProblem(self._coarse, windows, self._base, grain=grain.times(1.5), size=self._size)
        self._run(tuple(names))

    # The search

    def _run(self, names: tuple[str, ...]) -> None:
        base, problem = self._base, self._problem
        middle = np.mean([np.nanmean(t.points[: t.flying], axis=(0, 1)) for t in self._takes], axis=0)
        known = candidates(base, self._size, middle)
        neutral = Search(problem, None)
        rough = Search(self._rough, None)
        end = rough.descend(rough.try_all([rough.mean])[0], ROUNDS, self._stop)
        believed, refitted = neutral.try_all([neutral.mean, end.free])
        refitted = neutral.descend(min(believed, refitted, key=lambda f: f.cost), 2, self._stop)
        self._report(10, "nominal model")
        self._flight_chi2 = np.array([self._flights.fit(i, base).chi2 for i in self._fit_takes])
        self._flight_count = sum(self._flights.fit(i, base).count for i in self._fit_takes)
        airborne: list[tuple[Candidate, Airborne]] = []
        for candidate in (c for name in IN_FLIGHT if name in names for c in known[name]):
            self._stop()
            airborne.append((candidate, fit_airborne(self._flights, self._fit_takes, base, candidate)))
        self._report(25, "flights")
        found = self._contact_effects(problem, self._rough, [c for n in names if n not in IN_FLIGHT for c in known[n]])
        for candidate, air in airborne:
            gain = float(self._flight_chi2.sum() - air.chi2.sum())
            search = Search(problem, candidate, air)
            start = np.concatenate([air.free, refitted.free[-2:]])
            if gain > SEEN_IN_FLIGHT and not self._late(0.8):
                fit = search.descend(search.try_all([start])[0], 2, self._stop)
            else:
                jacobians = None
                if refitted.jacobians is not None:
                    jacobians = [
                        np.concatenate([np.zeros((len(j), len(air.free))), j], axis=1) for j in refitted.jacobians
                    ]
                fit = search.judge(start, refitted.motions, jacobians)
            found.append(_Found(search=search, fit=fit, airborne=air))
        self._report(80, "single effects")
        found += self._pairs(found, known, names)
        self._report(92, "held-out motion")
        plain = _Found(search=neutral, fit=refitted, airborne=None)
        self._summarize(plain, believed, found)

    def _contact_effects(self, problem: ContactProblem, rough: ContactProblem, tried: list[Candidate]) -> list[_Found]:
        """Search all of ``tried`` on the rough lattice, from all their starts; then the best on the fine one."""
        begun: list[tuple[Candidate, Search, list[ContactFit]]] = []
        for candidate in tried:
            self._stop()
            search = Search(rough, candidate)
            starts = [np.concatenate([s, np.zeros(2)]) for s in candidate.starts]
            begun.append((candidate, search, sorted(search.try_all(starts), key=lambda f: f.cost)))
        # Should time run out, the promising ones have had theirs.
        begun.sort(key=lambda entry: entry[2][0].cost)
        found: list[tuple[float, Candidate, ContactFit]] = []
        for rank, (candidate, search, ends) in enumerate(begun):
            followed = ends[: DESCENTS if rank < FULL_SEARCHES else 1]
            if not self._late(0.45):
                followed = [search.descend(e, ROUNDS, self._stop) for e in followed]
            end = min(followed, key=lambda f: f.cost)
            found.append((end.cost, candidate, end))
            self._report(30 + 20 * (rank + 1) // len(tried), candidate.name)
        found.sort(key=lambda entry: entry[0])
        out = []
        for rank, (_, candidate, end) in enumerate(found):
            search = Search(problem, candidate)
            near = rank < FULL_SEARCHES and len(candidate.mean) == 1
            first = np.eye(len(end.free))[0]
            about = [end.free + d * first for d in (NEARBY if near else (0.0,))]
            fit = min(search.try_all(about), key=lambda f: f.cost)
            if rank < FULL_SEARCHES and not self._late(0.6 if rank else 0.85):
                fit = search.descend(fit, FINE_ROUNDS, self._stop)
            else:
                fit = dataclasses.replace(fit, jacobians=end.jacobians)
            self._report(50 + 30 * (rank + 1) // len(found), candidate.name)
            out.append(_Found(search=search, fit=fit, airborne=None))
        return out

    def _pairs(
        self, found: list[_Found], known: dict[str, tuple[Candidate, ...]], names: Sequence[str]
    ) -> list[_Found]:
        """An effect that the flights show, with one that acts in contact, where neither alone explains all."""
        flying = [f for f in found if f.airborne is not None and self._gain(f) > SEEN_IN_FLIGHT * 3]
        if not flying or self._late(0.6):
            return []
        best = max(flying, key=self._evidence)
        if self._contact_misfit(best) < UNEXPLAINED:
            return []
        assert best.search.candidate is not None and best.airborne is not None
        values = best.search.candidate.values(best.airborne.free)
        base = best.search.candidate.laws(self._base, best.airborne.free)
        problem = ContactProblem(self._flights, self._problem.windows, base, grain=self._problem.grain, size=self._size)
        rough = ContactProblem(self._coarse, self._problem.windows, base, grain=self._rough.grain, size=self._size)
        tried = [c for n in names if n not in IN_FLIGHT for c in known[n]]
        before = ((best.search.candidate.name, values, best.airborne),)
        return [dataclasses.replace(f, before=before) for f in self._contact_effects(problem, rough, tried)]

    # What the fits say

    def _summarize(self, plain: _Found, believed: ContactFit, found: list[_Found]) -> None:
        ranked = sorted(found, key=self._evidence, reverse=True)
        chosen: dict[tuple[str, ...], _Found] = {}
        for entry in ranked:
            chosen.setdefault(entry.effects, entry)
        takes = [self._takes[i] for i in self._fit_takes]
        whole = self._whole_takes([believed.laws, plain.fit.laws, *(f.fit.laws for f in list(chosen.values())[:2])])
        self._windows_nominal = self._window_rms(plain.search.judge(believed.free, believed.motions).residuals)
        self._whole_nominal = self._rms(takes, whole[0])
        nominal = _Found(search=plain.search, fit=dataclasses.replace(believed, jacobians=None), airborne=None)
        self.nominal = self._candidate_fit(nominal, self._whole_nominal, believed=True)
        self.refitted = self._candidate_fit(plain, self._rms(takes, whole[1]))
        fits = []
        for i, entry in enumerate(chosen.values()):
            rms = self._rms(takes, whole[2 + i]) if i < 2 and len(whole) > 2 + i else None
            fits.append(self._candidate_fit(entry, rms))
        self.candidates = tuple(fits)
        self.believed_rms_m = self._whole_nominal
        self.floor_rms_m = math.sqrt(3) * self._flights.sigma

    def _candidate_fit(self, found: _Found, rms: float | None, *, believed: bool = False) -> CandidateFit:
        search, fit = found.search, found.fit
        scores, residuals = search.held_out(fit)
        flights = self._flight_part(found)
        by_take = -0.5 * flights
        for window, score in zip(self._problem.windows, scores, strict=True):
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
        if rms is None:
            rms = self._whole_nominal * self._window_rms(residuals) / max(self._windows_nominal, 1e-12)
        result = CandidateFit(
            effects=found.effects,
            parameters=parameters,
            beliefs=beliefs,
            log_evidence=self._evidence(found),
            heldout_log_score=by_take,
            heldout_rms_m=rms,
            misfit=max(self._contact_misfit(found), self._flight_misfit(found)),
        )
        self._found[id(result)], self._laws[id(result)] = found, fit.laws
        return result

    def _flight_part(self, found: _Found) -> Array:
        """(takes,) chi2 of the flights."""
        if found.airborne is not None:
            return found.airborne.chi2_at(found.fit.free[: found.search.own])
        if found.before:
            return found.before[0][2].chi2.copy()
        return self._flight_chi2.copy()

    def _gain(self, found: _Found) -> float:
        return float(self._flight_chi2.sum() - self._flight_part(found).sum())

    def _evidence(self, found: _Found) -> float:
        """With the flights' part, which ``Search`` has only for effects that act there."""
        if found.fit.cost >= LOST:
            return -LOST
        value = found.search.log_evidence(found.fit)
        if found.airborne is None:
            value -= 0.5 * float(self._flight_part(found).sum())
        for _, _, air in found.before:
            value -= FREEDOM * len(air.free)
        return value

    def _contact_misfit(self, found: _Found) -> float:
        chi2, count = found.search.chi2(found.fit)
        return math.sqrt(chi2 / max(count, 1))

    def _flight_misfit(self, found: _Found) -> float:
        return math.sqrt(float(self._flight_part(found).sum()) / max(self._flight_count, 1))

    # Motions

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
        nominal = {t.name: p for t, p in zip(self._takes, self._in_ground(self._base), strict=True)}
        if fit is None or not fit.effects:
            return {
                t.name: raw_discrepancy(t, nominal[t.name], self._flights, i, self._base)
                for i, t in enumerate(self._takes)
            }
        laws = self.laws(fit)
        return discrepancy_of(self._flights, self._worlds, laws, self._base, nominal)

    def _motion(self, laws: Laws, times: Sequence[Array | None]) -> dict[str, Array]:
        wanted = [(i, t) for i, t in enumerate(times) if t is not None and len(t)]
        found = self._flights.motion([i for i, _ in wanted], [laws] * len(wanted), [t for _, t in wanted])
        return {self._takes[i].name: self._frame.back(p) for (i, _), p in zip(wanted, found, strict=True)}

    def _in_ground(self, laws: Laws) -> list[Array]:
        n = len(self._takes)
        return self._flights.motion(list(range(n)), [laws] * n, [t.times for t in self._takes])

    def _whole_takes(self, laws: list[Laws]) -> list[list[Array]]:
        n = len(self._fit_takes)
        pairs = list(itertools.product(laws, self._fit_takes))
        found = self._flights.motion(
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
        return math.sqrt(3 * float((every**2).mean())) if len(every) else 0.0

    def _window(self, index: int) -> Window | None:
        take, start = self._takes[index], self._flights.start(index, self._base)
        if start is None:
            return None
        chosen = (take.times > start.time) & (take.times <= start.time + HORIZON)
        if not (take.seen[chosen].any()):
            return None
        return Window(
            take=index, times=take.times[chosen], points=take.points[chosen], seen=take.seen[chosen], contact=start.time
        )

    def _measure_grain(self, windows: list[Window]) -> Grain:
        self.numerics_rms_m = 0.0
        if not windows:
            return Grain(drift=0.02, ringing=5e-4)
        args = [w.take for w in windows], [self._base] * len(windows), [w.times for w in windows]
        fine, coarse = self._flights.motion(*args), self._coarse.motion(*args)
        apart = np.concatenate([((a - b) ** 2).sum(axis=2).ravel() for a, b in zip(fine, coarse, strict=True)])
        self.numerics_rms_m = math.sqrt(float(np.nanmean(apart)))
        return grain_between(fine, coarse, [w.times - w.contact for w in windows], self._size)

    def _check(self) -> None:
        if not self._fit_takes:
            raise InputError('no trial has role "fit": mark the complete takes as such')
        for take in self._takes:
            if (take.seen[: take.flying].sum(axis=1) >= 3).sum() < 3:
                raise InputError(
                    f"trial {take.name!r}: fewer than 3 frames with 3 points each before the first contact; "
                    "start the recording earlier"
                )

    def _late(self, share: float) -> bool:
        return time.monotonic() - self._begin > share * self._budget

    def _stop(self) -> bool:
        if self._cancelled():
            raise Cancelled
        return self._late(0.85)

    def _report(self, done: int, message: str) -> None:
        self._progress.report(done, message)


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
    return SoftFits(capture, wanted, on_event=on_event, cancelled=cancelled, budget_s=budget_s)
