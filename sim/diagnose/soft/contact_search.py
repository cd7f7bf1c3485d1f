# SPDX-License-Identifier: MIT
"""Fit of a candidate to the motion after first contact: whole simulations, Gauss-Newton, Laplace evidence."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..comparison_settings import SHARED
from .flight_fits import FlightEstimate, Flights
from .model_errors import LEVELS, ModelError, Whitened, log_prior_of_level, whiten
from .soft_candidates import Candidate, WorldParameters

Array = NDArray[np.float64]

FRICTION_SPREAD, CONTACT_SPREAD = 0.05, 0.4
"""Spreads of the logarithms of friction and contact stiffness."""

COMMON = 3
"""Free numbers that all candidates share: the logarithms of friction, contact stiffness and Young's modulus relative to
the nominal ones. The modulus may differ by as much as a lattice makes the body too stiff."""

REACH = np.array([0.3, 3.0, 0.2])
"""Their bounds. A clearly different friction or modulus is a cause and must not hide here; the ground stiffness is
unknown."""

LEAST_MODULUS, MOST_MODULUS = 0.002, 0.1
"""Bounds of the spread of the log modulus."""

COMMON_STEP = np.array([0.06, 0.1, 0.02])
LOST = 1e12
"""Cost of a failed simulation."""


@dataclass(frozen=True, kw_only=True)
class Window:
    """Compared part of a trial: recorded times (T,) from first contact on, points (T, K, 3), visibility (T, K)."""

    trial: int
    times: Array
    points: Array
    seen: NDArray[np.bool_]
    contact: float


@dataclass(frozen=True, kw_only=True)
class ContactFit:
    """A candidate's parameters after the search.

    free: own parameters, then the ``COMMON`` ones. laws: the resulting
    world parameters. cost: minus twice the log posterior, up to constants, under the expected model error. residuals:
    per trial, (n,) raw, m. jacobians: per trial, (n, p + 3) of the simulated coordinates, or None if never computed.
    motions: simulated points.
    """

    free: Array
    world: WorldParameters
    cost: float
    residuals: list[Array]
    jacobians: list[Array] | None
    motions: list[Array]


@dataclass(frozen=True, kw_only=True)
class ContactProblem:
    """Windows of all fit trials and the residuals of simulations.

    model_error: expected; modulus_spread: of the log modulus, by which the lattice is too stiff or too soft; size: of
    the body, m.
    """

    flights: Flights
    windows: Sequence[Window]
    base: WorldParameters
    model_error: ModelError
    modulus_spread: float
    size: float

    def coarser(self, flights: Flights) -> ContactProblem:
        """Return the same problem on the coarse lattice of ``flights``."""
        return dataclasses.replace(
            self,
            flights=flights,
            model_error=self.model_error.times(1.5),
            modulus_spread=1.5 * self.modulus_spread,
        )

    def motions(self, world: Sequence[WorldParameters]) -> list[list[Array]]:
        """Return the simulated points of every window under each of ``world``."""
        trials = [w.trial for _ in world for w in self.windows]
        times = [w.times for _ in world for w in self.windows]
        found = self.flights.motion(trials, [a for a in world for _ in self.windows], times)
        n = len(self.windows)
        return [found[i * n : (i + 1) * n] for i in range(len(world))]

    def residual(self, window: Window, motion: Array) -> Array:
        """Return observed minus simulated coordinates (n,), m."""
        return np.asarray((window.points - motion)[window.seen].ravel())

    def covariance(self, window: Window, motion: Array, level: float = 1.0) -> Whitened:
        """Return the covariance of a window's residual at ``level`` times the expected model error."""
        return whiten(
            motion,
            window.times - window.contact,
            window.seen,
            noise=self.flights.sigma,
            model_error=self.model_error.times(level),
            size=self.size,
        )


def common_laws(
    world: WorldParameters, base: WorldParameters, common: Array, moves: NDArray[np.bool_]
) -> WorldParameters:
    """Return ``world`` with the ``COMMON`` numbers relative to ``base``, but those that the candidate sets."""
    return dataclasses.replace(
        world,
        friction=base.friction * math.exp(common[0]) if moves[0] else world.friction,
        contact=base.contact * math.exp(common[1]),
        factor=base.factor * math.exp(common[2]) if moves[2] else world.factor,
    )


class CandidateSearch:
    """Gauss–Newton search for one candidate (None: nominal model). airborne: its estimate from the flights."""

    def __init__(
        self, problem: ContactProblem, candidate: Candidate | None, in_flight: FlightEstimate | None = None
    ) -> None:
        self.problem, self.candidate, self.in_flight = problem, candidate, in_flight
        own = 0 if candidate is None else len(candidate.mean)
        self.own = own
        common = np.array([FRICTION_SPREAD, CONTACT_SPREAD, problem.modulus_spread])
        self.mean = np.concatenate([[] if candidate is None else candidate.mean, np.zeros(COMMON)])
        self.spread = np.concatenate([[] if candidate is None else candidate.spread, common])
        self.step = np.concatenate([[] if candidate is None else candidate.step, COMMON_STEP])
        self.moves = np.ones(own + COMMON, dtype=bool)
        self.moves[own] = candidate is None or candidate.name != "friction"
        self.moves[own + 2] = candidate is None or candidate.name != "stiffness"

    def world(self, free: Array) -> WorldParameters:
        """Return the world parameters of ``free`` (p + 3,)."""
        base = self.problem.base
        own = base if self.candidate is None else self.candidate.world(base, free[: self.own])
        return common_laws(own, base, free[self.own :], self.moves[self.own :])

    def prior(self, free: Array) -> tuple[float, Array, Array]:
        """Return -2 log of prior times flight likelihood (up to constants), minus half its gradient, curvature."""
        d = free - self.mean
        weight = np.diag(self.spread**-2.0)
        cost, pull = float(d @ weight @ d), -weight @ d
        if self.in_flight is not None:
            n, air = self.own, self.in_flight
            curvature, slope = air.curvatures.sum(axis=0), air.gradients.sum(axis=0)
            away = free[:n] - air.free
            cost += float(air.chi2_at(free[:n]).sum())
            pull[:n] += slope - curvature @ away
            weight[:n, :n] += curvature
        return cost, pull, weight

    def judge(self, free: Array, motions: list[Array], jacobians: list[Array] | None = None) -> ContactFit:
        """Return the fit at ``free`` from the simulations made there."""
        problem = self.problem
        residuals = [problem.residual(w, m) for w, m in zip(problem.windows, motions, strict=True)]
        cost = LOST
        if all(np.isfinite(r).all() and float(np.abs(r).max(initial=0.0)) < 10.0 for r in residuals):
            cost = self.prior(free)[0]
            for w, m, r in zip(problem.windows, motions, residuals, strict=True):
                c = problem.covariance(w, m)
                cost += float(c.inner(r, r)) + c.log_det
        return ContactFit(
            free=free, world=self.world(free), cost=cost, residuals=residuals, jacobians=jacobians, motions=motions
        )

    def try_all(self, points: Sequence[Array]) -> list[ContactFit]:
        """Return the fits at several ``points``, simulated in one launch."""
        found = self.problem.motions([self.world(p) for p in points])
        return [self.judge(p, m) for p, m in zip(points, found, strict=True)]

    def with_jacobians(self, fit: ContactFit, common: Sequence[Array] | None = None) -> ContactFit:
        """Return ``fit`` with finite-difference jacobians. common: (n, 3) by trial of the ``COMMON`` ones, if known."""
        moving = np.flatnonzero(self.moves[: self.own] if common is not None else self.moves)
        varied = [fit.free + self.step * (np.arange(len(fit.free)) == i) for i in moving]
        found = self.problem.motions([self.world(v) for v in varied])
        jacobians = []
        for k, window in enumerate(self.problem.windows):
            jacobian = np.zeros((len(fit.residuals[k]), len(fit.free)))
            if common is not None:
                jacobian[:, self.own :] = common[k] * self.moves[self.own :]
            for i, motions in zip(moving, found, strict=True):
                column = (motions[k] - fit.motions[k])[window.seen].ravel() / self.step[i]
                jacobian[:, i] = np.where(np.isfinite(column), column, 0.0)
            jacobians.append(jacobian)
        return dataclasses.replace(fit, jacobians=jacobians)

    def promised(self, fit: ContactFit) -> float:
        """Return the nats that the linear model about ``fit``, which has jacobians, promises of a descent from it."""
        if fit.cost >= LOST:
            return 0.0
        gradient, curvature = (a[self.moves] for a in self.normal_equations(fit))
        return 0.5 * float(gradient @ np.linalg.solve(curvature[:, self.moves], gradient))

    def descend(self, fit: ContactFit, rounds: int, stop: Callable[[], bool], *, fresh: bool = True) -> ContactFit:
        """Return ``fit`` improved by up to ``rounds`` steps, with jacobians of its last or last but one iterate.

        fresh: jacobians are computed first; else those of ``fit`` are used.
        """
        if fit.cost >= LOST or stop():
            return fit
        if fresh:
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
        """Return gradient and curvature of the log posterior at ``fit``; ``without``: trial left out."""
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
        """Return the log evidence of all windows, parameters and model error integrated out (Laplace).

        Includes the flights where the candidate has an estimate from them, up to constants.
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
                # Never refined: the prior width stands in for the posterior's.
                value += float(np.log(self.spread[self.moves]).sum()) - 0.5 * n
            found.append(value)
        top = max(found)
        return top + math.log(sum(math.exp(v - top) for v in found))

    def chi2(self, fit: ContactFit) -> tuple[float, int]:
        """Return chi² of the whitened residual under the expected model error, and the number of coordinates."""
        if fit.cost >= LOST:
            return LOST, 1
        problem = self.problem
        total = sum(
            float(problem.covariance(w, m).inner(r, r))
            for w, m, r in zip(problem.windows, fit.motions, fit.residuals, strict=True)
        )
        return total, sum(len(r) for r in fit.residuals)

    def held_out(self, fit: ContactFit) -> tuple[Array, list[Array]]:
        """Return the log score and residual (n,) of each trial with the parameters fitted to the others.

        Uses the linear model about ``fit``, including the uncertainty of those parameters.
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
            # Uncertainty of the parameters, by the matrix determinant lemma and the Woodbury identity.
            total = curvature + hidden
            pull = c.inner(j, moved)
            score = self._score(c, moved) + 0.5 * float(pull @ np.linalg.solve(total, pull))
            score -= 0.5 * float(np.linalg.slogdet(total)[1] - np.linalg.slogdet(curvature)[1])
            scores.append(score)
            residuals.append(moved)
        return np.array(scores), residuals

    def covariance(self, fit: ContactFit, moved: Array | None = None) -> Array:
        """Return the covariance (p + 3, p + 3) of the free parameters, for trials that share model errors.

        moved: (p + 3,) by which, with 95 %, the optimum of a body without cells is farther, None if unknown.
        """
        if fit.jacobians is None or fit.cost >= LOST:
            return np.asarray(np.diag(self.spread**2))
        known = np.diag(self.spread**-2.0)
        cover = np.linalg.inv(known + (self.normal_equations(fit)[1] - known) / SHARED)
        if moved is not None:
            cover = cover + np.diag(np.minimum(np.abs(moved) / 1.96, self.spread) ** 2)
        return np.asarray(cover)

    @staticmethod
    def _score(c: Whitened, r: Array) -> float:
        return -0.5 * (float(c.inner(r, r)) + c.log_det + len(r) * math.log(2 * math.pi))

    def _inside(self, free: Array) -> Array:
        out = free.copy()
        if self.candidate is not None:
            out[: self.own] = np.clip(free[: self.own], self.candidate.low, self.candidate.high)
        out[self.own :] = np.clip(free[self.own :], -REACH, REACH)
        return out
