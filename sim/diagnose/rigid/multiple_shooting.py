# SPDX-License-Identifier: MIT
"""Multiple shooting: a trial as a chain of short flights and contacts.

A trial has states at nodes: at its start, after every impact, and at intervals in a long contact. From a node the
kernel runs to the next; the path is compared with the observations under their noise, and its end with the next node's
state under the uncertainty of contact models (how well simulators of impacts agree with each other, or with reality).
Bock and Plitt, A multiple shooting algorithm, IFAC 1984; Gauss–Newton steps, with the states eliminated trial by trial
(Schur complement).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded, solveh_banded
from scipy.special import gammaln

from .observed_poses import perturbed
from .rigid_candidates import BELIEFS
from .segment_paths import Model
from .segmented_trial import Evaluation, NormalEquations
from .shooting_problem import CONTACT_DEGREES_OF_FREEDOM, Problem

Array = NDArray[np.float64]

LONGEST_STEP = 2.0
"""Largest step of a number of an effect, in prior standard deviations."""

MOST_FAILURES = 3
"""Consecutive rejected steps after which a fit ends."""

PLAUSIBLE = 3.0
"""Prior standard deviations within which the nominal model's own numbers may move; beyond that it is an effect."""


@dataclass(kw_only=True, eq=False)
class Fit:
    """A fitted model. schur: (trials, P, P) information of each trial on the numbers; pull: (trials, P) its gradient.

    evidence: log probability of the data in nats.
    """

    problem: Problem
    model: Model
    z: Array
    states: list[Array]
    evaluation: Evaluation
    schur: Array
    pull: Array
    evidence: float

    @property
    def cost(self) -> float:
        """Return the objective, including the priors."""
        return self.evaluation.cost


def _banded(matrix: Array) -> Array:
    """Return the lower band (24, n) of ``matrix`` (n, n): states couple only to their neighbours."""
    n = len(matrix)
    rows = np.arange(24)[:, None] + np.arange(n)
    return np.where(rows < n, matrix[np.minimum(rows, n - 1), np.arange(n)], 0.0)


def eliminate_states(linear: NormalEquations, size: int, damping: float) -> tuple[Array, Array, Array, Array]:
    """Return information on the numbers, its gradient, the states' response to them (12 N, P) and own step (12 N,)."""
    n = len(linear.slope) - size
    b, c = linear.hessian[:n, n:], linear.hessian[n:, n:]
    # A banded solve also avoids the threads of a full one, which wait for each other on a busy machine.
    band = _banded(linear.hessian[:n, :n])
    band[0] = band[0] * (1 + damping) + 1e-9
    solved = solveh_banded(band, np.concatenate([b, linear.slope[:n, None]], axis=1), lower=True, check_finite=False)
    answer, own = solved[:, :-1], solved[:, -1]
    return c - b.T @ answer, linear.slope[n:] - b.T @ own, answer, own


def solve(
    problem: Problem,
    model: Model,
    z: Array,
    states: list[Array],
    *,
    rounds: int = 8,
    tolerance: float = 0.2,
    held: Evaluation | None = None,
) -> Fit:
    """Return the fit by damped Gauss–Newton (Levenberg–Marquardt) from ``z`` (P,) and ``states``."""
    size = model.size
    best = problem.evaluate(model, z, states, held=held)
    damping, failed = 1e-3, 0
    for _ in range(rounds):
        parts = [eliminate_states(part, size, damping) for part in best.linear]
        matrix = np.eye(size) + sum(p[0] for p in parts)
        matrix[np.diag_indices(size)] *= 1 + damping
        step = np.linalg.solve(matrix, sum(p[1] for p in parts) - z)
        step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        step[: BELIEFS.size] = (
            np.clip(z[: BELIEFS.size] + step[: BELIEFS.size], -PLAUSIBLE, PLAUSIBLE) - z[: BELIEFS.size]
        )
        tried = [
            perturbed(s, (own - answer @ step).reshape(-1, 12))
            for s, (_, _, answer, own) in zip(states, parts, strict=True)
        ]
        # Jacobians cost tens of worlds: where a step may be rejected, one world decides first.
        new = problem.evaluate(model, z + step, tried, held=held, slopes=held is not None and not failed)
        if np.isfinite(new.cost) and new.cost < best.cost:
            gain = best.cost - new.cost
            if held is None or failed:
                new = problem.evaluate(model, z + step, tried, held=held)
            z, states, best, damping, failed = z + step, tried, new, max(damping / 5, 1e-6), 0
            if gain < tolerance:
                break
        else:
            failed += 1
            damping *= 20
            if failed > MOST_FAILURES:
                break
    parts = [eliminate_states(part, size, 0.0) for part in best.linear]
    schur, pull = np.array([p[0] for p in parts]), np.array([p[1] for p in parts])
    matrix = np.eye(size) + schur.sum(axis=0)
    evidence = -0.5 * best.cost - 0.5 * float(np.linalg.slogdet(0.5 * (matrix + matrix.T))[1])
    evidence += _volumes(problem, best, size)
    return Fit(
        problem=problem, model=model, z=z, states=states, evaluation=best, schur=schur, pull=pull, evidence=evidence
    )


def _volumes(problem: Problem, evaluation: Evaluation, size: int) -> float:
    """Return the log Laplace integral over the states relative to the volumes of priors and defects.

    It hardly differs between candidates with the same nodes, and makes those with other nodes comparable.
    """
    total = 0.0
    nu = CONTACT_DEGREES_OF_FREEDOM
    # Student's distribution relative to the normal one, in 12 dimensions.
    student = gammaln((nu + 12) / 2) - gammaln(nu / 2) - 6 * np.log(nu / 2)
    for trial, part in zip(problem.trials, evaluation.linear, strict=True):
        n = len(part.slope) - size
        band = _banded(part.hessian[:n, :n])
        total -= float(np.sum(np.log(np.abs(cholesky_banded(band, lower=True, check_finite=False)[0]))))
        total -= float(np.sum(np.log(trial.prior)))
        for cover in trial.covers[: len(trial.nodes) - 1]:
            total += float(student) - 0.5 * float(np.sum(np.log(np.diag(cover))))
    return total
