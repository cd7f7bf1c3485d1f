# SPDX-License-Identifier: MIT
"""What a model leaves of whole flights of a single point: a slow error of the recording, or a force that is missing?

Both are smooth. A slow error wanders: with its memory of a quarter of the trial, most of it lies in curves that turn
several times. A missing force bends: its acceleration lasts for the whole trial and is integrated twice, so that hardly
anything of it lies in such curves.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from .multiple_shooting import Fit, solve
from .observed_poses import QUATERNION, SLOW_ERROR, TOGETHER, ObservedBody
from .segmented_trial import Segment

Array = NDArray[np.float64]

ROUNDS = 8

LEAST_FRAMES = 6
"""Frames between two nodes from which their residual has a shape."""

DEGREES = 13
"""Degree of the polynomials of time that hold all of a slow error and of a missing force."""

INSTANTS = 200
"""Instants of an acceleration that is integrated."""

SLOW = np.concatenate([[0.0], np.geomspace(0.03, 1.0, 14)])
"""Standard deviations of the slow error that are tried, over its largest."""

MISSING = np.concatenate([[0.0], np.geomspace(3e-3, 10.0, 20)])
"""Standard deviations of the missing acceleration that are tried, m/s²."""


def bending(fit: Fit) -> float:
    """Return the nats that a missing force adds to a slow error as an explanation of the residual of ``fit``.

    Both have the size, common to all trials, that suits best. The states are those of whole trials, fitted to the
    stated noise alone. 0 where more than the centre is tracked: such a recording has no slow error.
    """
    problem = fit.problem
    if not all(t.observations.hides_spin for t in problem.trials):
        return 0.0
    trials = [dataclasses.replace(t, observations=t.observations.bare) for t in problem.trials]
    bare = solve(dataclasses.replace(problem, trials=trials), fit.model, fit.z, fit.states, rounds=ROUNDS)
    scores = np.zeros((len(SLOW), len(MISSING)))
    for segment in bare.evaluation.segments:
        scores += _segment_scores(trials[segment.trial].observations, segment)
    return float(scores.max() - scores[:, 0].max())


def _segment_scores(seen: ObservedBody, segment: Segment) -> Array:
    """Return the log likelihoods by ``SLOW`` and ``MISSING`` of a segment's residual; 0 where it has no shape."""
    known = np.isfinite(seen.seen).all(axis=(1, 2))
    there = known[segment.frames]
    frames = segment.frames[there]
    if len(frames) < LEAST_FRAMES or not seen.white > 0:
        return np.zeros((len(SLOW), len(MISSING)))
    off = seen.residuals(segment.record[there, :3], segment.record[there, QUATERNION], frames)[0][:, 0] * seen.sigma
    reach = float(np.linalg.norm(np.ptp(seen.seen[known, 0], axis=0)))
    return shape_scores(seen.times[frames], off[:, seen.measured], seen.white, reach, float(np.ptp(seen.times)))


def shape_scores(times: Array, off: Array, white: float, reach: float, lasting: float) -> Array:
    """Return the log likelihoods by ``SLOW`` and ``MISSING`` of the residuals ``off`` (F, D) m at ``times`` (F,) s.

    white: noise in m. reach: extent of the trial's path in m, lasting: its duration in s. Offset and speed are free.
    """
    curves = legendre.legvander(2 * (times - times[0]) / np.ptp(times) - 1, min(DEGREES, len(times) - 1))
    free = np.linalg.qr(curves)[0][:, 2:]
    wander = free.T @ _alike(times, lasting / TOGETHER) @ free
    instants = np.linspace(times[0], times[-1], INSTANTS)
    # The displacement that an acceleration at each instant makes at each frame.
    moved = free.T @ (np.maximum(times[:, None] - instants, 0.0) * (instants[1] - instants[0]))
    bend = moved @ _alike(instants, lasting) @ moved.T
    sizes = (SLOW * SLOW_ERROR * reach) ** 2
    spread = white**2 * np.eye(len(bend)) + sizes[:, None, None, None] * wander
    root = np.linalg.cholesky(spread + MISSING[:, None, None] ** 2 * bend)
    own = np.linalg.solve(root, np.broadcast_to(free.T @ off, (*root.shape[:3], off.shape[1])))
    size = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
    return np.asarray(-0.5 * np.sum(own**2, axis=(-1, -2)) - off.shape[1] * size)


def _alike(times: Array, memory: float) -> Array:
    return np.asarray(np.exp(-0.5 * ((times[:, None] - times) / max(memory, 1e-9)) ** 2))
