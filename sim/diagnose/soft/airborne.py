# SPDX-License-Identifier: MIT
"""Effects that act in free flight, fitted to the flights of all takes at once; the states are eliminated on the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .candidates import Candidate
from .laws import Laws
from .takes import Flights

Array = NDArray[np.float64]

ITERATIONS = 6

QUIET = 4.0
"""Excess of the nominal flights' chi2 over its mean, in standard deviations, up to which one start is enough."""


@dataclass(frozen=True, kw_only=True)
class Airborne:
    """free: (p,) best numbers. chi2: (takes,) at them.

    gradients (takes, p) and curvatures (takes, p, p): slope of -chi2 / 2 there, and its second derivative's negative.
    """

    free: Array
    chi2: Array
    gradients: Array
    curvatures: Array

    def chi2_at(self, free: Array) -> Array:
        """(takes,) to second order."""
        d = free - self.free
        return np.asarray(self.chi2 - 2 * self.gradients @ d + np.einsum("i,kij,j->k", d, self.curvatures, d))


def fit_airborne(flights: Flights, takes: list[int], base: Laws, candidate: Candidate) -> Airborne:
    """Gauss–Newton from every start of ``candidate``, the prior counted in; the best end of them all."""
    best: tuple[float, Airborne] | None = None
    nominal = [flights.fit(index, base) for index in takes]
    count = sum(fit.count for fit in nominal)
    quiet = sum(fit.chi2 for fit in nominal) < count + QUIET * np.sqrt(2.0 * count)
    for start in candidate.starts[:1] if quiet else candidate.starts:
        found = _descend(flights, takes, base, candidate, start)
        z = (found.free - candidate.mean) / candidate.spread
        value = float(found.chi2.sum() + z @ z)
        if np.isfinite(value) and (best is None or value < best[0]):
            best = value, found
    assert best is not None
    return best[1]


def _descend(flights: Flights, takes: list[int], base: Laws, candidate: Candidate, free: Array) -> Airborne:
    weight = np.diag(candidate.spread**-2.0)
    here = _look(flights, takes, base, candidate, free)
    damping = 1e-3
    for _ in range(ITERATIONS):
        curvature = here.curvatures.sum(axis=0) + weight
        gradient = here.gradients.sum(axis=0) - weight @ (here.free - candidate.mean)
        step = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient)
        free = np.clip(
            here.free + np.clip(step, -1.5 * candidate.spread, 1.5 * candidate.spread), candidate.low, candidate.high
        )
        there = _look(flights, takes, base, candidate, free)
        if _cost(there, candidate) > _cost(here, candidate) or not np.isfinite(there.chi2).all():
            damping = max(10 * damping, 0.3)
            continue
        gain = _cost(here, candidate) - _cost(there, candidate)
        here, damping = there, 0.1 * damping
        if gain < 0.05:
            break
    return here


def _cost(found: Airborne, candidate: Candidate) -> float:
    z = (found.free - candidate.mean) / candidate.spread
    return float(found.chi2.sum() + z @ z)


def _look(flights: Flights, takes: list[int], base: Laws, candidate: Candidate, free: Array) -> Airborne:
    """Fits of the states at ``free``, and how the residuals that they leave change with ``free``."""
    laws = candidate.laws(base, free)
    varied = [candidate.laws(base, free + d) for d in np.diag(candidate.step)]
    chi2, gradients, curvatures = [], [], []
    for index in takes:
        fit = flights.fit(index, laws)
        inertia = [flights.inertia(a) for a in (laws, *varied)]
        # Another centre of mass of the same motion is another place and velocity of it.
        states = [flights.as_seen(fit.state, inertia[0], other) for other in inertia]
        found = flights.flight(index).residuals(states, inertia, [laws, *varied])
        jacobian = -(found[1:] - found[0]).T / candidate.step
        jacobian -= fit.projector @ (fit.projector.T @ jacobian)
        chi2.append(fit.chi2)
        gradients.append(jacobian.T @ found[0])
        curvatures.append(jacobian.T @ jacobian)
    return Airborne(free=free, chi2=np.array(chi2), gradients=np.array(gradients), curvatures=np.array(curvatures))
