# SPDX-License-Identifier: MIT
"""The order in which candidates are searched: the nominal model, flights, contacts on two lattices, pairs, the best."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...errors import Cancelled, InputError
from ...events import IsCancelled, OnEvent, StageProgress
from ..capture import Capture
from .airborne import Airborne, fit_airborne
from .body_mesh import body_mesh, coarser
from .candidates import IN_FLIGHT, Candidate, candidates
from .grain import Grain, grain_between
from .laws import Laws
from .search import LOST, ContactFit, ContactProblem, Search, Window
from .takes import Flights, GroundFrame, take_of
from .worlds import SoftWorlds

Array = NDArray[np.float64]

HORIZON = 0.085
"""Seconds after first contact that are fitted: the impact and the first ringing, before small differences grow."""

COARSER = 1.5
"""Cells of the lattice that the grain is measured with, over those of the fits' lattice."""

SEEN_IN_FLIGHT = 9.0
"""Gain in chi2 of the flights from which an effect that acts in flight is followed into the contact as well."""

ROUNDS, FINE_ROUNDS, LAST_ROUNDS = 4, 2, 4
HOPELESS, HOPELESS_ROUNDS = 2000.0, 2
"""Cost over the best candidate's from which a start gets so few rounds."""

OTHER_GROUND = 0.5
"""Logarithm of the ground's stiffness that the nominal model ends at, from which candidates start there as well."""

DESCENTS = 2
"""Starts of a candidate that are followed on the rough lattice."""

NEARBY = (-0.12, 0.0, 0.12)
"""Logarithms about the rough lattice's end that are tried on the fine one, which is a little softer."""

FULL_SEARCHES = 3
"""Candidates that are followed on the fine lattice."""

SOFT_GROUND = math.log(0.2)
"""Where the nominal model's ground starts as well as at its default."""

UNEXPLAINED = 1.3
"""Misfit of the best single effect above which two at once are tried."""

FREEDOM = 4.0
"""Nats that a number of an effect fitted before costs: about what Laplace's method takes from one in these fits."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """A fit with the search that made it, and the effects before the candidate's own."""

    search: Search
    fit: ContactFit
    airborne: Airborne | None = None
    before: tuple[tuple[str, dict[str, float], Airborne], ...] = ()

    @property
    def effects(self) -> tuple[str, ...]:
        """Names, the one that was fitted last at the end."""
        own = () if self.search.candidate is None else (self.search.candidate.name,)
        return (*(name for name, _, _ in self.before), *own)


class Survey:
    """All searches on one capture. After ``run``: ``believed`` and ``plain`` without an effect, ``found`` with them."""

    believed: ContactFit
    plain: Found
    found: list[Found]

    def __init__(self, capture: Capture, *, on_event: OnEvent, cancelled: IsCancelled, budget_s: float) -> None:
        self._begin, self._budget, self._cancelled = time.monotonic(), budget_s, cancelled
        self._progress = StageProgress(on_event, "diagnose", 100)
        self.frame = GroundFrame(capture)
        item = capture.objects[0]
        belief = item.belief
        assert belief.youngs_modulus_pa is not None
        mesh = body_mesh(item.vertices, item.faces)
        self.takes = [take_of(t, self.frame, mesh.nodes) for t in capture.trials]
        rest = capture.trials[0].rest_points
        if any(t.rest_points.shape != rest.shape or np.abs(t.rest_points - rest).max() > 1e-9 for t in capture.trials):
            raise InputError("rest_points differ between trials: track the same points in all trials of a soft object")
        self.worlds = SoftWorlds(mesh, belief.density_kg_m3, rest)
        self.flights = Flights(self.takes, self.worlds, capture.noise_sigma)
        x, y, z = (float(c) for c in self.frame.direction(np.asarray(capture.gravity)))
        self.base = Laws(
            modulus=belief.youngs_modulus_pa,
            poisson_ratio=belief.poisson_ratio,
            friction=max(capture.ground.friction, 1e-3),
            gravity=(x, y, z),
        )
        self._size = float(np.ptp(mesh.nodes, axis=0).mean() / 2)
        self.fit_takes = [i for i, t in enumerate(self.takes) if t.role == "fit"]
        self._check()
        coarse_mesh = coarser(mesh, item.vertices, item.faces, factor=COARSER)
        self._coarse = Flights(self.takes, SoftWorlds(coarse_mesh, belief.density_kg_m3, rest), capture.noise_sigma)
        windows = [w for w in map(self._window, self.fit_takes) if w is not None]
        self.numerics_rms_m, grain = self._measure_grain(windows)
        self.problem = ContactProblem(self.flights, windows, self.base, grain=grain, size=self._size)
        self._rough = ContactProblem(self._coarse, windows, self.base, grain=grain.times(1.5), size=self._size)

    def run(self, names: Sequence[str]) -> None:
        """Search all candidates of ``names``."""
        base, problem = self.base, self.problem
        middle = np.mean([np.nanmean(t.points[: t.flying], axis=(0, 1)) for t in self.takes], axis=0)
        known = candidates(base, self._size, middle)
        neutral = Search(problem, None)
        rough = Search(self._rough, None)
        grounds = rough.try_all([rough.mean, np.array([0.0, SOFT_GROUND])])
        end = min((rough.descend(g, ROUNDS, self._stop) for g in grounds), key=lambda f: f.cost)
        self._common = end.free
        self.believed, refitted = neutral.try_all([neutral.mean, end.free])
        refitted = neutral.descend(min(self.believed, refitted, key=lambda f: f.cost), 2, self._stop)
        self.plain = Found(search=neutral, fit=refitted)
        self._report(10, "nominal model")
        self.flight_chi2 = np.array([self.flights.fit(i, base).chi2 for i in self.fit_takes])
        self._flight_count = sum(self.flights.fit(i, base).count for i in self.fit_takes)
        airborne: list[tuple[Candidate, Airborne]] = []
        for candidate in (c for name in IN_FLIGHT if name in names for c in known[name]):
            self._stop()
            airborne.append((candidate, fit_airborne(self.flights, self.fit_takes, base, candidate)))
        self._report(25, "flights")
        tried = [c for n in names if n not in IN_FLIGHT for c in known[n]]
        self.found = self._contact_effects(problem, self._rough, tried)
        self.found += [self._landed(candidate, air) for candidate, air in airborne]
        self.found += self._pairs(tried)
        self._report(92, "held-out motion")

    def _landed(self, candidate: Candidate, air: Airborne) -> Found:
        """An effect of the flights with what follows from it in contact: searched there only where it shows."""
        refitted, search = self.plain.fit, Search(self.problem, candidate, air)
        start = np.concatenate([air.free, refitted.free[-2:]])
        if float(self.flight_chi2.sum() - air.chi2.sum()) > SEEN_IN_FLIGHT and not self._late(0.8):
            fit = search.descend(search.try_all([start])[0], 2, self._stop)
        else:
            jacobians = refitted.jacobians
            if jacobians is not None:
                jacobians = [np.concatenate([np.zeros((len(j), len(air.free))), j], axis=1) for j in jacobians]
            fit = search.judge(start, refitted.motions, jacobians)
        return Found(search=search, fit=fit, airborne=air)

    def _contact_effects(self, problem: ContactProblem, rough: ContactProblem, tried: list[Candidate]) -> list[Found]:
        """Search all of ``tried`` on the rough lattice, from all their starts; then the best on the fine one."""
        begun: list[tuple[Candidate, Search, list[ContactFit]]] = []
        for candidate in tried:
            self._stop()
            search = Search(rough, candidate)
            starts = [np.concatenate([s, np.zeros(2)]) for s in candidate.starts]
            ends = sorted(search.try_all(starts), key=lambda f: f.cost)
            if abs(self._common[1]) > OTHER_GROUND:
                moved = [np.concatenate([e.free[:-2], self._common]) for e in ends[:DESCENTS]]
                ends = sorted(ends + search.try_all(moved), key=lambda f: f.cost)
            begun.append((candidate, search, ends))
        # Should time run out, the promising ones have had theirs.
        begun.sort(key=lambda entry: entry[2][0].cost)
        found: list[tuple[float, Candidate, ContactFit]] = []
        least = math.inf
        for rank, (candidate, search, ends) in enumerate(begun):
            followed = ends[: DESCENTS if rank < FULL_SEARCHES else 1]
            if not self._late(0.45):
                rounds = [HOPELESS_ROUNDS if e.cost > least + HOPELESS else ROUNDS for e in followed]
                followed = [search.descend(e, n, self._stop) for e, n in zip(followed, rounds, strict=True)]
            least = min(least, *(f.cost for f in followed))
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
            if rank == 0:
                # The leader is refined whatever the time: what is reported and predicted rests on it.
                fit = search.descend(fit, LAST_ROUNDS, self._leave)
            elif rank < FULL_SEARCHES and not self._late(0.6):
                fit = search.descend(fit, FINE_ROUNDS, self._stop)
            else:
                fit = dataclasses.replace(fit, jacobians=end.jacobians)
            self._report(50 + 30 * (rank + 1) // len(found), candidate.name)
            out.append(Found(search=search, fit=fit))
        return out

    def _pairs(self, tried: list[Candidate]) -> list[Found]:
        """An effect that the flights show, with one that acts in contact, where neither alone explains all."""
        flying = [f for f in self.found if f.airborne is not None and self._gain(f) > SEEN_IN_FLIGHT * 3]
        if not flying or self._late(0.6):
            return []
        best = max(flying, key=self.evidence)
        if self.contact_misfit(best) < UNEXPLAINED:
            return []
        assert best.search.candidate is not None and best.airborne is not None
        values = best.search.candidate.values(best.airborne.free)
        base = best.search.candidate.laws(self.base, best.airborne.free)
        windows, size = self.problem.windows, self._size
        problem = ContactProblem(self.flights, windows, base, grain=self.problem.grain, size=size)
        rough = ContactProblem(self._coarse, windows, base, grain=self._rough.grain, size=size)
        before = ((best.search.candidate.name, values, best.airborne),)
        return [dataclasses.replace(f, before=before) for f in self._contact_effects(problem, rough, tried)]

    # How well a fit explains

    def flight_part(self, found: Found) -> Array:
        """(takes,) chi2 of the flights."""
        if found.airborne is not None:
            return found.airborne.chi2_at(found.fit.free[: found.search.own])
        if found.before:
            return found.before[0][2].chi2.copy()
        return self.flight_chi2.copy()

    def _gain(self, found: Found) -> float:
        return float(self.flight_chi2.sum() - self.flight_part(found).sum())

    def evidence(self, found: Found) -> float:
        """With the flights' part, which ``Search`` has only for effects that act there."""
        if found.fit.cost >= LOST:
            return -LOST
        value = found.search.log_evidence(found.fit)
        if found.airborne is None:
            value -= 0.5 * float(self.flight_part(found).sum())
        for _, _, air in found.before:
            value -= FREEDOM * len(air.free)
        return value

    def contact_misfit(self, found: Found) -> float:
        """Root mean square of the whitened residual after the first contact."""
        chi2, count = found.search.chi2(found.fit)
        return math.sqrt(chi2 / max(count, 1))

    def flight_misfit(self, found: Found) -> float:
        """The same of the flights."""
        return math.sqrt(float(self.flight_part(found).sum()) / max(self._flight_count, 1))

    # What is compared

    def _window(self, index: int) -> Window | None:
        take, start = self.takes[index], self.flights.start(index, self.base)
        if start is None:
            return None
        chosen = (take.times > start.time) & (take.times <= start.time + HORIZON)
        if not (take.seen[chosen].any()):
            return None
        return Window(
            take=index, times=take.times[chosen], points=take.points[chosen], seen=take.seen[chosen], contact=start.time
        )

    def _measure_grain(self, windows: list[Window]) -> tuple[float, Grain]:
        """Distance in m between two lattices' motions, and the grain that they tell of."""
        if not windows:
            return 0.0, Grain(drift=0.02, ringing=5e-4)
        args = [w.take for w in windows], [self.base] * len(windows), [w.times for w in windows]
        fine, coarse = self.flights.motion(*args), self._coarse.motion(*args)
        apart = np.concatenate([((a - b) ** 2).sum(axis=2).ravel() for a, b in zip(fine, coarse, strict=True)])
        apart = apart[np.isfinite(apart)]
        rms = math.sqrt(float(apart.mean())) if len(apart) else 0.0
        return rms, grain_between(fine, coarse, [w.times - w.contact for w in windows], self._size)

    def _check(self) -> None:
        if not self.fit_takes:
            raise InputError('no trial has role "fit": mark the complete takes as such')
        for take in self.takes:
            if (take.seen[: take.flying].sum(axis=1) >= 3).sum() < 3:
                raise InputError(
                    f"trial {take.name!r}: fewer than 3 frames with 3 points each before the first contact; "
                    "start the recording earlier"
                )

    # Time

    def _late(self, share: float) -> bool:
        return time.monotonic() - self._begin > share * self._budget

    def _stop(self) -> bool:
        self._leave()
        return self._late(0.85)

    def _leave(self) -> bool:
        if self._cancelled():
            raise Cancelled("cancelled while effects were fitted")
        return False

    def _report(self, done: int, message: str) -> None:
        self._progress.report(done, message)
