# SPDX-License-Identifier: MIT
"""Search over all candidates: nominal model, flights, contacts on a coarse and a fine lattice, pairs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress
from ..capture import Capture
from ..capture_geometry import mean_known
from ..work import Work
from .body_mesh import body_mesh, coarser, extrapolated
from .contact_search import (
    COMMON,
    COMMON_STEP,
    LEAST_MODULUS,
    LOST,
    MOST_MODULUS,
    CandidateSearch,
    ContactFit,
    ContactProblem,
    Window,
)
from .flight_fits import FlightEstimate, Flights, GroundFrame, fit_in_flight, soft_trial
from .model_errors import ModelError, misfit_left_open, model_error_between, modulus_between
from .soft_candidates import IN_FLIGHT, Candidate, WorldParameters, candidates
from .soft_simulator import SoftWorlds

Array = NDArray[np.float64]

HORIZON = 0.085
"""Fitted time in s after first contact: impact and first ringing, before small differences grow."""

COARSER = 1.5
"""Cell size of the coarse lattice over the fine one's; their difference gives the model error."""

SEEN_IN_FLIGHT = 9.0
"""Gain in chi² of the flights from which an effect that acts in flight is also searched in contact."""

ROUNDS, FINE_ROUNDS, LAST_ROUNDS = 4, 2, 4
HOPELESS, HOPELESS_ROUNDS = 2000.0, 2
"""Cost above the best candidate's, and the few rounds that such a start gets."""

OTHER_GROUND = 0.5
"""Log ground stiffness of the fitted nominal model beyond which candidates also start from it."""

DESCENTS = 2
"""Starts of a candidate that are descended from on the coarse lattice."""

NEARBY = (-0.12, 0.0, 0.12)
"""Log offsets from the coarse optimum tried on the fine lattice, which is a little softer."""

FULL_SEARCHES = 3
"""Candidates searched on the fine lattice."""

PROMISING = 10.0
"""Nats that the linear model must promise of a candidate that begins beside the model without it, to be followed."""

SOFT_GROUND = math.log(0.2)
"""Second starting value of the log ground stiffness, besides its default."""

UNEXPLAINED = 1.3
"""Misfit of the best single effect above which pairs are tested."""

FREEDOM = 4.0
"""Evidence cost in nats of a previously fitted parameter, about the Laplace penalty in these fits."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FoundFit:
    """A fit, the search that found it, and the effects added before the candidate's own.

    moved: (p + 3,) by which, with 95 %, the optimum of a body without cells is farther, None where that is unknown.
    """

    search: CandidateSearch
    fit: ContactFit
    in_flight: FlightEstimate | None = None
    moved: Array | None = None
    before: tuple[tuple[str, dict[str, float], FlightEstimate], ...] = ()

    @property
    def effects(self) -> tuple[str, ...]:
        """Return the effect names, the last fitted one at the end."""
        own = () if self.search.candidate is None else (self.search.candidate.name,)
        return (*(name for name, _, _ in self.before), *own)


class Survey:
    """All searches on one capture. ``run`` sets ``believed``, ``plain`` (re-fitted) and ``found`` (with effects)."""

    believed: ContactFit
    plain: FoundFit
    found: list[FoundFit]

    def __init__(self, capture: Capture, *, on_event: OnEvent, cancelled: IsCancelled, work: Work) -> None:
        self._work, self._cancelled = work, cancelled
        self._names: tuple[str, ...] = ()
        self._progress = StageProgress(on_event, "diagnose", 100)
        self.frame = GroundFrame(capture)
        item = capture.objects[0]
        belief = item.belief
        assert belief.youngs_modulus_pa is not None
        mesh = body_mesh(item.vertices, item.faces)
        self.trials = [soft_trial(t, self.frame, mesh.nodes) for t in capture.trials]
        rest = capture.trials[0].rest_points
        if any(t.rest_points.shape != rest.shape or np.abs(t.rest_points - rest).max() > 1e-9 for t in capture.trials):
            raise InputError("rest_points differ between trials: track the same points in all trials of a soft object")
        self.worlds = SoftWorlds(mesh, belief.density_kg_m3, rest, work=work)
        self.flights = Flights(self.trials, self.worlds, capture.noise_sigma)
        x, y, z = (float(c) for c in self.frame.direction(np.asarray(capture.gravity)))
        self.base = WorldParameters(
            modulus=belief.youngs_modulus_pa,
            poisson_ratio=belief.poisson_ratio,
            friction=max(capture.ground.friction, 1e-3),
            gravity=(x, y, z),
        )
        self._size = float(np.ptp(mesh.nodes, axis=0).mean() / 2)
        self.fit_trials = [i for i, t in enumerate(self.trials) if t.role == "fit"]
        self._check()
        coarse_mesh = coarser(mesh, item.vertices, item.faces, factor=COARSER)
        self._extrapolated = extrapolated(mesh, coarse_mesh)
        rough_worlds = SoftWorlds(coarse_mesh, belief.density_kg_m3, rest, work=work)
        self._coarse = Flights(self.trials, rough_worlds, capture.noise_sigma)
        windows = [w for w in map(self._window, self.fit_trials) if w is not None]
        self.numerics_rms_m, model_error, spread = self._measure_grain(windows)
        self.problem = ContactProblem(
            flights=self.flights,
            windows=windows,
            base=self.base,
            model_error=model_error,
            modulus_spread=spread,
            size=self._size,
        )
        self.limit = misfit_left_open(model_error, capture.noise_sigma)
        self._rough = self.problem.coarser(self._coarse)

    def run(self, names: Sequence[str]) -> None:
        """Search all candidates of ``names``."""
        base, problem = self.base, self.problem
        middle = mean_known(np.stack([mean_known(t.points[: t.flying], axis=(0, 1)) for t in self.trials]), axis=0)
        known = candidates(base, self._size, middle)
        neutral = CandidateSearch(problem, None)
        rough = CandidateSearch(self._rough, None)
        grounds = rough.try_all([rough.mean, np.array([0.0, SOFT_GROUND, 0.0])])
        end = min((rough.descend(g, ROUNDS, self._stop) for g in grounds), key=lambda f: f.cost)
        self._common = end.free
        self.believed, refitted = neutral.try_all([neutral.mean, end.free])
        # As far as the best effect: an unfinished re-fit would leave a gain to whatever starts from it.
        refitted = neutral.descend(min(self.believed, refitted, key=lambda f: f.cost), LAST_ROUNDS, self._stop)
        self.plain = FoundFit(search=neutral, fit=refitted)
        self._report(10, "nominal model")
        self.flight_chi2 = np.array([self.flights.fit(i, base).chi2 for i in self.fit_trials])
        self._flight_count = sum(self.flights.fit(i, base).count for i in self.fit_trials)
        in_flight: list[tuple[Candidate, FlightEstimate]] = []
        for candidate in (c for name in IN_FLIGHT if name in names for c in known[name]):
            self._stop()
            in_flight.append((candidate, fit_in_flight(self.flights, self.fit_trials, base, candidate)))
        self._report(25, "flights")
        tried = [c for n in names if n not in IN_FLIGHT for c in known[n]]
        self.found = self._contact_effects(problem, self._rough, tried, refitted)
        self.found += [self._landed(candidate, air) for candidate, air in in_flight]
        self.found += self._pairs(tried)
        self._report(92, "held-out motion")

    def _landed(self, candidate: Candidate, air: FlightEstimate) -> FoundFit:
        """Return an effect fitted in flight, also searched in contact where it is visible there."""
        refitted, search = self.plain.fit, CandidateSearch(self.problem, candidate, air)
        start = np.concatenate([air.free, refitted.free[-COMMON:]])
        if float(self.flight_chi2.sum() - air.chi2.sum()) > SEEN_IN_FLIGHT and not self._late(0.8):
            fit = search.descend(search.try_all([start])[0], 2, self._stop)
        else:
            jacobians = refitted.jacobians
            if jacobians is not None:
                jacobians = [np.concatenate([np.zeros((len(j), len(air.free))), j], axis=1) for j in jacobians]
            fit = search.judge(start, refitted.motions, jacobians)
        return FoundFit(search=search, fit=fit, in_flight=air)

    def _contact_effects(
        self, problem: ContactProblem, rough: ContactProblem, tried: list[Candidate], without: ContactFit
    ) -> list[FoundFit]:
        """Search ``tried`` from all their starts on the coarse lattice, then the best on the fine one.

        without: the fit without any of them, from which the others are searched again.
        """
        begun: list[tuple[Candidate, CandidateSearch, list[ContactFit]]] = []
        for candidate in tried:
            self._stop()
            search = CandidateSearch(rough, candidate)
            starts = [np.concatenate([s, np.zeros(COMMON)]) for s in candidate.starts]
            ends = sorted(search.try_all(starts), key=lambda f: f.cost)
            if abs(self._common[1]) > OTHER_GROUND:
                moved = [np.concatenate([e.free[:-COMMON], self._common]) for e in ends[:DESCENTS]]
                ends = sorted(ends + search.try_all(moved), key=lambda f: f.cost)
            begun.append((candidate, search, ends))
        # Most promising first, in case the budget ends.
        begun.sort(key=lambda entry: entry[2][0].cost)
        found: list[tuple[float, Candidate, ContactFit]] = []
        least = math.inf
        for rank, (candidate, search, ends) in enumerate(begun):
            followed = ends[: DESCENTS if rank < FULL_SEARCHES else 1]
            if not self._late(0.45):
                rounds = [HOPELESS_ROUNDS if e.cost > least + HOPELESS else ROUNDS for e in followed]
                followed = [search.descend(e, n, self._stop) for e, n in zip(followed, rounds, strict=True)]
            else:
                self._work.skip((*self._names, candidate.name), "searched beyond its starting values")
            least = min(least, *(f.cost for f in followed))
            end = min(followed, key=lambda f: f.cost)
            found.append((end.cost, candidate, end))
            self._report(30 + 20 * (rank + 1) // len(tried), candidate.name)
        found.sort(key=lambda entry: entry[0])
        out = []
        for rank, (_, candidate, end) in enumerate(found):
            search, away = CandidateSearch(problem, candidate), None
            near = rank < FULL_SEARCHES and len(candidate.mean) == 1
            first = np.eye(len(end.free))[0]
            about = [end.free + d * first for d in (NEARBY if near else (0.0,))]
            fit = min(search.try_all(about), key=lambda f: f.cost)
            if rank == 0:
                # The best one is always refined: report and predictions depend on it.
                fit = search.descend(fit, LAST_ROUNDS, self._leave)
                away = self._away(end, fit)
            elif rank < FULL_SEARCHES and not self._late(0.6):
                fit = search.descend(fit, FINE_ROUNDS, self._stop)
                away = self._away(end, fit)
            else:
                if rank < FULL_SEARCHES:
                    self._work.skip((*self._names, candidate.name), "refined on the fine lattice")
                fit = dataclasses.replace(fit, jacobians=end.jacobians)
            self._report(50 + 30 * (rank + 1) // len(found), candidate.name)
            out.append(FoundFit(search=search, fit=fit, moved=away))
        return self._begun_weakly(out, without)

    def _away(self, coarse: ContactFit, fine: ContactFit) -> Array:
        """Return ``FoundFit.moved``, by Roache's grid convergence index (J. Fluids Eng. 116, 1994)."""
        return 1.25 * self._extrapolated * (fine.free - coarse.free)

    def _begun_weakly(self, found: list[FoundFit], without: ContactFit) -> list[FoundFit]:
        """Return ``found``, all but the best searched again on the fine lattice from where they hardly act.

        A coarse lattice may lead to a minimum that the fine one does not have, and effects that are small are near
        the fit ``without`` them. What the linear model promises there decides which are followed.
        """
        best = max(found, key=self.evidence, default=None)
        if best is None or not without.jacobians or self._late(0.6):
            return found
        common = [j[:, -COMMON:] for j in without.jacobians]
        begun: list[tuple[float, int, ContactFit]] = []
        for i, entry in enumerate(found):
            candidate, search = entry.search.candidate, entry.search
            if entry is best or candidate is None:
                continue
            self._stop()
            starts = [np.concatenate([w, without.free[-COMMON:]]) for w in candidate.weak]
            weak = min(search.try_all(starts), key=lambda f: f.cost)
            weak = search.with_jacobians(weak, common) if weak.cost < LOST else weak
            begun.append((0.5 * (entry.fit.cost - weak.cost) + search.promised(weak), i, weak))
        begun.sort(key=lambda b: -b[0])
        out = list(found)
        for rank, (promised, i, weak) in enumerate(begun):
            search = found[i].search
            if promised > PROMISING and rank < FULL_SEARCHES and not self._late(0.7):
                weak = search.descend(weak, LAST_ROUNDS, self._stop, fresh=False)
            if weak.cost < out[i].fit.cost:
                out[i] = dataclasses.replace(found[i], fit=weak, moved=None)
        return out

    def _pairs(self, tried: list[Candidate]) -> list[FoundFit]:
        """Return pairs of an effect visible in flight and one that acts in contact, where neither alone suffices."""
        flying = [f for f in self.found if f.in_flight is not None and self._gain(f) > SEEN_IN_FLIGHT * 3]
        if not flying:
            return []
        best = max(flying, key=self.evidence)
        if self.contact_misfit(best) < UNEXPLAINED:
            return []
        if self._late(0.6):
            self._work.skip((*best.effects, "contact effects"), "tried")
            return []
        assert best.search.candidate is not None and best.in_flight is not None
        values = best.search.candidate.values(best.in_flight.free)
        base = best.search.candidate.world(self.base, best.in_flight.free)
        problem, rough = (dataclasses.replace(p, base=base) for p in (self.problem, self._rough))
        before = ((best.search.candidate.name, values, best.in_flight),)
        self._names = best.effects
        own = best.fit.jacobians
        without = dataclasses.replace(
            best.fit, free=best.fit.free[-COMMON:], jacobians=None if own is None else [j[:, -COMMON:] for j in own]
        )
        return [dataclasses.replace(f, before=before) for f in self._contact_effects(problem, rough, tried, without)]

    # Quality of a fit

    def flight_part(self, found: FoundFit) -> Array:
        """Return the chi² of the flights, (trials,)."""
        if found.in_flight is not None:
            return found.in_flight.chi2_at(found.fit.free[: found.search.own])
        if found.before:
            return found.before[0][2].chi2.copy()
        return self.flight_chi2.copy()

    def _gain(self, found: FoundFit) -> float:
        return float(self.flight_chi2.sum() - self.flight_part(found).sum())

    def evidence(self, found: FoundFit) -> float:
        """Return the log evidence including the flights, which the search has only for effects that act there."""
        if found.fit.cost >= LOST:
            return -LOST
        value = found.search.log_evidence(found.fit)
        if found.in_flight is None:
            value -= 0.5 * float(self.flight_part(found).sum())
        for _, _, air in found.before:
            value -= FREEDOM * len(air.free)
        return value

    def contact_misfit(self, found: FoundFit) -> float:
        """Return the RMS of the whitened residual after first contact."""
        chi2, count = found.search.chi2(found.fit)
        return math.sqrt(chi2 / max(count, 1))

    def flight_misfit(self, found: FoundFit) -> float:
        """Return the RMS of the whitened residual in flight."""
        return math.sqrt(float(self.flight_part(found).sum()) / max(self._flight_count, 1))

    # Data

    def _window(self, index: int) -> Window | None:
        trial, start = self.trials[index], self.flights.start(index, self.base)
        if start is None:
            return None
        chosen = (trial.times > start.time) & (trial.times <= start.time + HORIZON)
        if not (trial.seen[chosen].any()):
            return None
        return Window(
            trial=index,
            times=trial.times[chosen],
            points=trial.points[chosen],
            seen=trial.seen[chosen],
            contact=start.time,
        )

    def _measure_grain(self, windows: list[Window]) -> tuple[float, ModelError, float]:
        """Return the distance in m between the motions of both lattices, and what it implies: the model error, and the
        spread of the log modulus."""
        if not windows:
            return 0.0, ModelError(drift=0.02, ringing=5e-4), LEAST_MODULUS
        change = float(COMMON_STEP[2])
        stiffer = dataclasses.replace(self.base, factor=self.base.factor * math.exp(change))
        trials, times = [w.trial for w in windows], [w.times for w in windows]
        both = self.flights.motion(trials * 2, [self.base] * len(times) + [stiffer] * len(times), times * 2)
        fine, other = both[: len(times)], both[len(times) :]
        coarse = self._coarse.motion(trials, [self.base] * len(times), times)
        apart = np.concatenate([((a - b) ** 2).sum(axis=2).ravel() for a, b in zip(fine, coarse, strict=True)])
        apart = apart[np.isfinite(apart)]
        rms = math.sqrt(float(apart.mean())) if len(apart) else 0.0
        since = [w.times - w.contact for w in windows]
        spread = abs(modulus_between(fine, coarse, other, change)) * self._extrapolated
        return (
            rms,
            model_error_between(fine, coarse, since, self._size, extrapolated=self._extrapolated),
            min(max(spread, LEAST_MODULUS), MOST_MODULUS),
        )

    def rough_motions(self, world: WorldParameters) -> list[Array]:
        """Return points (T, K, 3) of every fit trial under ``world`` on the coarse lattice."""
        times = [self.trials[i].times for i in self.fit_trials]
        return self._coarse.lasting_motion(list(self.fit_trials), [world] * len(times), times)

    def _check(self) -> None:
        if not self.fit_trials:
            raise InputError('no trial has role "fit": mark the complete trials as such')
        for trial in self.trials:
            if (trial.seen[: trial.flying].sum(axis=1) >= 3).sum() < 3:
                raise InputError(
                    f"trial {trial.name!r}: fewer than 3 frames with 3 points each before the first contact; "
                    "start the recording earlier"
                )

    # Work

    def _late(self, share: float) -> bool:
        return not self._work.left(share)

    def _stop(self) -> bool:
        self._leave()
        return self._late(0.85)

    def _leave(self) -> bool:
        if self._cancelled():
            raise Cancelled("cancelled while effects were fitted")
        return False

    def _report(self, done: int, message: str) -> None:
        self._progress.report(done, message)
