# SPDX-License-Identifier: MIT
"""Fitting a candidate to what happens after first contact: differences of whole simulations, Gauss–Newton, Laplace.

Free numbers of a fit: the candidate's own, then what every candidate may adjust a little: the friction and how stiff
the model's ground is, both as logarithms with a prior about what is believed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .airborne import Airborne
from .candidates import Candidate
from .grain import LEVELS, Grain, Whitened, log_prior_of_level, whiten
from .laws import Laws
from .takes import Flights

Array = NDArray[np.float64]

FRICTION_SPREAD, CONTACT_SPREAD = 0.05, 0.4
FRICTION_REACH, CONTACT_REACH = 0.3, 1.8
"""Farthest that they may go, as logarithms. Another friction is another cause, which must not hide in it; how stiff the
ground is in a recording's world nobody believes anything about."""

COMMON_STEP = np.array([0.06, 0.1])
LOST = 1e12
"""Objective of a simulation that came to nothing."""


@dataclass(frozen=True, kw_only=True)
class Window:
    """What is compared of a take: recorded times (T,) from the first contact on, points (T, K, 3) and what is seen."""

    take: int
    times: Array
    points: Array
    seen: NDArray[np.bool_]
    contact: float


@dataclass(frozen=True, kw_only=True)
class ContactFit:
    """A candidate's numbers after the search.

    free: own numbers, then log friction and log contact over the believed. laws: with all of them. cost: minus twice
    the log posterior, but for constants, under the expected grain. residuals: per take, (n,) raw, m. jacobians: per
    take, (n, p + 2) of the simulated coordinates, or None where the search never took them. motions: simulated points.
    """

    free: Array
    laws: Laws
    cost: float
    residuals: list[Array]
    jacobians: list[Array] | None
    motions: list[Array]


class ContactProblem:
    """The windows of all fit takes, and how well laws explain them. grain: the expected one; size: the body's, m."""

    def __init__(self, flights: Flights, windows: Sequence[Window], base: Laws, *, grain: Grain, size: float) -> None:
        self.flights, self.windows, self.base = flights, list(windows), base
        self.grain, self.size = grain, size
        self.simulated = 0

    def motions(self, laws: Sequence[Laws]) -> list[list[Array]]:
        """Simulated points of every window under each of ``laws``."""
        takes = [w.take for _ in laws for w in self.windows]
        times = [w.times for _ in laws for w in self.windows]
        found = self.flights.motion(takes, [a for a in laws for _ in self.windows], times)
        self.simulated += len(found)
        n = len(self.windows)
        return [found[i * n : (i + 1) * n] for i in range(len(laws))]

    def residual(self, window: Window, motion: Array) -> Array:
        """(n,) observed minus simulated, m."""
        return np.asarray((window.points - motion)[window.seen].ravel())

    def covariance(self, window: Window, motion: Array, level: float = 1.0) -> Whitened:
        """Of a window's residual, at ``level`` times the expected grain."""
        return whiten(
            motion,
            window.times - window.contact,
            window.seen,
            noise=self.flights.sigma,
            grain=self.grain.times(level),
            size=self.size,
        )


def common_laws(laws: Laws, base: Laws, common: Array, *, friction: bool) -> Laws:
    """``laws`` with log friction (unless the candidate sets it) and log contact about those of ``base``."""
    rubbing = base.friction * math.exp(common[0]) if friction else laws.friction
    return dataclasses.replace(laws, friction=rubbing, contact=base.contact * math.exp(common[1]))


class Search:
    """Gauss–Newton on one candidate; None is the nominal model. airborne: what the flights say of its numbers."""

    def __init__(self, problem: ContactProblem, candidate: Candidate | None, airborne: Airborne | None = None) -> None:
        self.problem, self.candidate, self.airborne = problem, candidate, airborne
        own = 0 if candidate is None else len(candidate.mean)
        self.own = own
        common = np.array([FRICTION_SPREAD, CONTACT_SPREAD])
        self.mean = np.concatenate([[] if candidate is None else candidate.mean, np.zeros(2)])
        self.spread = np.concatenate([[] if candidate is None else candidate.spread, common])
        self.step = np.concatenate([[] if candidate is None else candidate.step, COMMON_STEP])
        self.moves = np.ones(own + 2, dtype=bool)
        self.moves[own] = candidate is None or candidate.name != "friction"

    def laws(self, free: Array) -> Laws:
        """With all of ``free`` (p + 2,)."""
        base = self.problem.base
        own = base if self.candidate is None else self.candidate.laws(base, free[: self.own])
        return common_laws(own, base, free[self.own :], friction=bool(self.moves[self.own]))

    def prior(self, free: Array) -> tuple[float, Array, Array]:
        """Minus twice the log prior and flights' likelihood, less constants; its negative half gradient, curvature."""
        d = free - self.mean
        weight = np.diag(self.spread**-2.0)
        cost, pull = float(d @ weight @ d), -weight @ d
        if self.airborne is not None:
            n, air = self.own, self.airborne
            curvature, slope = air.curvatures.sum(axis=0), air.gradients.sum(axis=0)
            away = free[:n] - air.free
            cost += float(air.chi2_at(free[:n]).sum())
            pull[:n] += slope - curvature @ away
            weight[:n, :n] += curvature
        return cost, pull, weight

    def judge(self, free: Array, motions: list[Array], jacobians: list[Array] | None = None) -> ContactFit:
        """The fit at ``free`` with the simulations already made there."""
        problem = self.problem
        residuals = [problem.residual(w, m) for w, m in zip(problem.windows, motions, strict=True)]
        cost = LOST
        if all(np.isfinite(r).all() and float(np.abs(r).max(initial=0.0)) < 10.0 for r in residuals):
            cost = self.prior(free)[0]
            for w, m, r in zip(problem.windows, motions, residuals, strict=True):
                c = problem.covariance(w, m)
                cost += float(c.inner(r, r)) + c.log_det
        return ContactFit(
            free=free, laws=self.laws(free), cost=cost, residuals=residuals, jacobians=jacobians, motions=motions
        )

    def try_all(self, points: Sequence[Array]) -> list[ContactFit]:
        """Fits at several ``points``, in one launch."""
        found = self.problem.motions([self.laws(p) for p in points])
        return [self.judge(p, m) for p, m in zip(points, found, strict=True)]

    def with_jacobians(self, fit: ContactFit) -> ContactFit:
        """``fit`` with differences about it."""
        moving = np.flatnonzero(self.moves)
        varied = [fit.free + self.step * (np.arange(len(fit.free)) == i) for i in moving]
        found = self.problem.motions([self.laws(v) for v in varied])
        jacobians = []
        for k, window in enumerate(self.problem.windows):
            jacobian = np.zeros((len(fit.residuals[k]), len(fit.free)))
            for i, motions in zip(moving, found, strict=True):
                column = (motions[k] - fit.motions[k])[window.seen].ravel() / self.step[i]
                jacobian[:, i] = np.where(np.isfinite(column), column, 0.0)
            jacobians.append(jacobian)
        return dataclasses.replace(fit, jacobians=jacobians)

    def descend(self, fit: ContactFit, rounds: int, stop: Callable[[], bool]) -> ContactFit:
        """Improve ``fit`` by up to ``rounds`` steps; the end has jacobians of its last or last but one place."""
        if fit.cost >= LOST or stop():
            return fit
        fit = self.with_jacobians(fit)
        for _ in range(rounds):
            if stop():
                break
            gradient, curvature = self.normal_equations(fit)
            step = np.where(self.moves, np.linalg.solve(curvature, gradient), 0.0)
            step *= min(1.0, 1.2 / max(1e-12, float(np.abs(step / self.spread).max())))
            ends = self.try_all([self._inside(fit.free + s * step) for s in (1.0, 0.35)])
            best = min(ends, key=lambda e: e.cost)
            if best.cost > fit.cost - 0.3:
                break
            gain, old = fit.cost - best.cost, fit
            small = float(np.abs((best.free - old.free) / self.spread).max()) < 0.05
            fit = dataclasses.replace(best, jacobians=old.jacobians)
            if small or gain < 2.0:
                break
            fit = self.with_jacobians(fit)
        return fit

    def normal_equations(
        self, fit: ContactFit, *, without: int | None = None, level: float = 1.0
    ) -> tuple[Array, Array]:
        """Gradient and curvature of the log posterior at ``fit``; ``without`` leaves a take out."""
        assert fit.jacobians is not None
        _, gradient, curvature = self.prior(fit.free)
        problem = self.problem
        for k, (w, m, r, j) in enumerate(zip(problem.windows, fit.motions, fit.residuals, fit.jacobians, strict=True)):
            if k != without:
                c = problem.covariance(w, m, level)
                gradient = gradient + c.inner(j, r)
                curvature = curvature + c.inner(j, j)
        return gradient, curvature

    def log_evidence(self, fit: ContactFit) -> float:
        """ln of the probability of all windows, the candidate's numbers and the grain integrated out (Laplace).

        With the flights' part where the candidate has one, and without their constants.
        """
        if fit.cost >= LOST:
            return -LOST
        problem, n = self.problem, int(self.moves.sum())
        prior = -0.5 * self.prior(fit.free)[0] - float(np.log(self.spread[self.moves]).sum())
        if self.candidate is not None:
            prior -= math.log(self.candidate.choices)
        found = []
        for level in LEVELS:
            value = prior + log_prior_of_level(level)
            for w, m, r in zip(problem.windows, fit.motions, fit.residuals, strict=True):
                c = problem.covariance(w, m, level)
                value -= 0.5 * (float(c.inner(r, r)) + c.log_det + len(r) * math.log(2 * math.pi))
            if fit.jacobians is not None:
                _, curvature = self.normal_equations(fit, level=level)
                inner = curvature[np.ix_(self.moves, self.moves)]
                value -= 0.5 * float(np.linalg.slogdet(inner)[1])
            else:
                # Never refined: the prior's own width stands for what is left of it.
                value += float(np.log(self.spread[self.moves]).sum()) - 0.5 * n
            found.append(value)
        top = max(found)
        return top + math.log(sum(math.exp(v - top) for v in found))

    def chi2(self, fit: ContactFit) -> tuple[float, int]:
        """Sum of squares of the whitened residual under the expected grain, and of how many coordinates."""
        if fit.cost >= LOST:
            return LOST, 1
        problem = self.problem
        total = sum(
            float(problem.covariance(w, m).inner(r, r))
            for w, m, r in zip(problem.windows, fit.motions, fit.residuals, strict=True)
        )
        return total, sum(len(r) for r in fit.residuals)

    def held_out(self, fit: ContactFit) -> tuple[Array, list[Array]]:
        """Log score of each take, and its residual (n,), when the numbers are those that the other takes give.

        By the linear model about ``fit``; the spread of the numbers so found is counted in.
        """
        problem, scores, residuals = self.problem, [], []
        for k, (w, m, r) in enumerate(zip(problem.windows, fit.motions, fit.residuals, strict=True)):
            if fit.jacobians is None or fit.cost >= LOST:
                scores.append(-LOST if fit.cost >= LOST else self._score(problem.covariance(w, m), r))
                residuals.append(r)
                continue
            gradient, curvature = self.normal_equations(fit, without=k)
            change = np.where(self.moves, np.linalg.solve(curvature, gradient), 0.0)
            change *= min(1.0, 1.0 / max(1e-12, float(np.abs(change / self.spread).max())))
            j = fit.jacobians[k]
            moved = r - j @ change
            c = problem.covariance(w, m)
            hidden = c.inner(j, j)
            # The numbers' own spread, by the matrix determinant lemma and Woodbury's identity.
            total = curvature + hidden
            pull = c.inner(j, moved)
            score = self._score(c, moved) + 0.5 * float(pull @ np.linalg.solve(total, pull))
            score -= 0.5 * float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(curvature)[1])
            scores.append(score)
            residuals.append(moved)
        return np.array(scores), residuals

    def covariance(self, fit: ContactFit) -> Array:
        """(p + 2, p + 2) of the free numbers."""
        if fit.jacobians is None or fit.cost >= LOST:
            return np.asarray(np.diag(self.spread**2))
        return np.asarray(np.linalg.inv(self.normal_equations(fit)[1]))

    @staticmethod
    def _score(c: Whitened, r: Array) -> float:
        return -0.5 * (float(c.inner(r, r)) + c.log_det + len(r) * math.log(2 * math.pi))

    def _inside(self, free: Array) -> Array:
        out = free.copy()
        if self.candidate is not None:
            out[: self.own] = np.clip(free[: self.own], self.candidate.low, self.candidate.high)
        reach = np.array([FRICTION_REACH, CONTACT_REACH])
        out[self.own :] = np.clip(free[self.own :], -reach, reach)
        return out
