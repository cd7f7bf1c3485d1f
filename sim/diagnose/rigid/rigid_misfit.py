# SPDX-License-Identifier: MIT
"""Misfit of a fit: how far smooth remainders in flight and defects at contacts exceed what noise leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .multiple_shooting import Fit
from .observed_poses import QUATERNION, TOUCHED
from .segmented_trial import Segment, SegmentedTrial
from .shooting_problem import Problem
from .world_settings import WorldSettings

BEND_EVERY = 0.05
"""Time in s per polynomial degree of the smooth remainder."""
LEAST_FRAMES = 6
MOST_OF_A_TRIAL = 3.0
"""A trial's misfit counts at most as this many times the median trial's: one in which the body was lost, or tumbled
chaotically, does not decide for all."""


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """Normalised sums of squares: smooth remainders in flight, and defects at contacts."""

    flight: float
    flight_count: int
    contact: float
    contact_count: int

    @property
    def ratio(self) -> float:
        """Return the overall RMS ratio to expectation."""
        count = self.flight_count + self.contact_count
        return float(np.sqrt((self.flight + self.contact) / count)) if count else 1.0


def misfit(fit: Fit) -> Misfit:
    """Return the misfit of ``fit``."""
    problem = fit.problem
    sums = np.zeros((len(problem.trials), 4))
    setting = fit.model.setting(problem.scene, fit.z)
    for segment in fit.evaluation.segments:
        trial, own = problem.trials[segment.trial], sums[segment.trial]
        free = np.flatnonzero(segment.record[:, TOUCHED] <= 0)
        if len(free) >= LEAST_FRAMES:
            own[:2] += _remainder(problem, trial, segment, free, setting)
        if segment.defect is not None:
            cover = trial.covers[segment.index]
            own[2:] += float(segment.defect @ np.linalg.solve(cover, segment.defect)), 12
    count = sums[:, 1] + sums[:, 3]
    square = (sums[:, 0] + sums[:, 2]) / np.maximum(count, 1)
    if (count > 0).sum() >= 3:
        most = MOST_OF_A_TRIAL**2 * float(np.median(square[count > 0]))
        sums[:, [0, 2]] *= np.minimum(1.0, most / np.maximum(square, 1e-12))[:, None]
    flight, flights, contact, contacts = (float(x) for x in sums.sum(axis=0))
    return Misfit(flight=flight, flight_count=int(flights), contact=contact, contact_count=int(contacts))


def _remainder(
    problem: Problem, trial: SegmentedTrial, segment: Segment, free: NDArray[np.int64], setting: WorldSettings
) -> tuple[float, int]:
    """Return the chi² explained by a smooth change of the poses, and its degrees of freedom."""
    frames = segment.frames[free]
    pose = problem.seen_poses(segment.record[None, free], [setting])[0]
    _, slope, info = trial.observations.information(pose[:, :3], pose[:, QUATERNION], frames)
    t = trial.observations.times[frames]
    span = max(t[-1] - t[0], 1e-9)
    degree = int(np.clip(2 + span / BEND_EVERY, 2, 9))
    degree = min(degree, len(frames) - 2)
    basis = np.polynomial.legendre.legvander(2 * (t - t[0]) / span - 1, degree)
    matrix = np.einsum("fa,fij,fb->aibj", basis, info, basis).reshape((degree + 1) * 6, -1)
    pull = np.einsum("fa,fi->ai", basis, slope).ravel()
    values, vectors = np.linalg.eigh(matrix)
    good = values > 1e-9 * values[-1]
    gain = float(np.sum((vectors.T @ pull)[good] ** 2 / values[good]))
    rank = int(good.sum())
    return gain, max(rank - 2 * min(6, int(np.linalg.matrix_rank(info.sum(axis=0)))), 1)
