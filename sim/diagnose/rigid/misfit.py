# SPDX-License-Identifier: MIT
"""Whether a fit leaves more than noise and grain would: smooth remainders in its flights, defects at its contacts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .candidates import Setting
from .shooting import Fit, Problem, Segment, Take

Array = NDArray[np.float64]

BEND_EVERY = 0.05
"""Seconds to one more power of the smooth remainder."""

LEAST_FRAMES = 6


@dataclass(frozen=True, kw_only=True)
class Misfit:
    """Sums of squares over what they are expected to be: of flights (smooth remainders) and of contacts (defects)."""

    flight: float
    flight_count: int
    contact: float
    contact_count: int

    @property
    def ratio(self) -> float:
        """Root mean square over expectation, all together."""
        count = self.flight_count + self.contact_count
        return float(np.sqrt((self.flight + self.contact) / count)) if count else 1.0


def misfit(fit: Fit) -> Misfit:
    """Of ``fit``."""
    problem = fit.problem
    flight = contact = 0.0
    flights = contacts = 0
    setting = fit.model.setting(problem.scene, fit.z)
    for segment in fit.evaluation.segments:
        take = problem.takes[segment.take]
        free = np.flatnonzero(segment.record[:, 15] <= 0)
        if len(free) >= LEAST_FRAMES:
            gain, count = _remainder(problem, take, segment, free, setting)
            flight, flights = flight + gain, flights + count
        if segment.defect is not None:
            cover = take.covers[segment.index]
            contact += float(segment.defect @ np.linalg.solve(cover, segment.defect))
            contacts += 12
    return Misfit(flight=flight, flight_count=flights, contact=contact, contact_count=contacts)


def _remainder(
    problem: Problem, take: Take, segment: Segment, free: NDArray[np.int64], setting: Setting
) -> tuple[float, int]:
    """chi² that a smooth change of the poses takes away, and its degrees of freedom."""
    frames = segment.frames[free]
    pose = problem.seen_poses(segment.record[None, free], [setting])[0]
    _, slope, info = take.sight.information(pose[:, :3], pose[:, 3:7], frames)
    t = take.sight.times[frames]
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
