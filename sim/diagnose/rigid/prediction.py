# SPDX-License-Identifier: MIT
"""Where the points of a body are under a fit: after what was shown, and from the first frames of a take."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .candidates import BELIEFS
from .shooting import Fit, Model, Problem, Take
from .tracking import settle
from .turning import to_matrix

Array = NDArray[np.float64]
Points = dict[str, tuple[NDArray[np.int64], Array]]

SHOWN = 0.16
"""Seconds from which a complete take is predicted, or as long as it flies."""


def believed_fit(problem: Problem, nominal: Fit) -> Fit:
    """The nominal model exactly as believed, its states fitted."""
    model, z = Model(freedoms=()), np.zeros(BELIEFS.size)
    states = settle(problem, model, z, nominal.states, 3)
    return dataclasses.replace(nominal, model=model, z=z, states=states)


def run_on(problem: Problem, fit: Fit, z: Array, take: Take, state: Array, times: Array) -> Array:
    """Record (M, 17) at ``times``, s since ``state`` in the recording's clock."""
    setting = fit.model.setting(problem.scene, z)
    return problem.launcher.run(state[None], problem.scene.numbers([setting]), [times * setting.rate])[0]


def placed(take: Take, record: Array) -> Array:
    """Points (M, K, 3) of ``record``, world."""
    return np.asarray(record[:, None, :3] + np.einsum("mij,kj->mki", to_matrix(record[:, 3:7]), take.sight.places))


def predict_points(problem: Problem, fit: Fit) -> Points:
    """By predict trial: columns and points (P, K, 3) at its ``predict_times``."""
    found: Points = {}
    for take, states in zip(problem.takes, fit.states, strict=True):
        wanted = take.sight.trial.predict_times
        if wanted is None:
            continue
        begin = take.sight.times[take.nodes[-1]]
        record = run_on(problem, fit, fit.z, take, states[-1], wanted - begin)
        found[take.sight.trial.name] = take.sight.columns, placed(take, record[: len(wanted)])
    return found


def first_flights(problem: Problem, fit: Fit, z: Array) -> list[Array]:
    """First states (13,) of all takes from nothing but their first frames. z: (P,) or (takes, P)."""
    short = []
    for take, states in zip(problem.takes, fit.states, strict=True):
        times = take.sight.times - take.sight.times[0]
        last = take.nodes[1] if len(take.nodes) > 1 else take.end
        touched = [s for s in fit.evaluation.segments if problem.takes[s.take] is take and s.index == 0]
        free = np.flatnonzero(touched[0].record[:, 15] > 0) if touched else np.zeros(0)
        end = int(free[0]) if len(free) and free[0] >= 4 else last
        limit = 2 * SHOWN if take.sight.camera is not None else SHOWN
        if take.sight.poses_alone:
            end = min(end, int(np.searchsorted(times, limit)) + 1)
        end = max(end, min(4, take.end))
        short.append(
            dataclasses.replace(take, nodes=[0], states=states[:1], end=end, covers=[], weights=[np.ones(end)])
        )
    small = dataclasses.replace(problem, takes=short)
    return [s[0] for s in settle(small, fit.model, z, [s[:1] for s in fit.states], 3)]


def simulate_points(problem: Problem, fit: Fit) -> Points:
    """By trial: columns and points (T, K, 3) at its frames, run from its first frames without another look."""
    found: Points = {}
    for take, state in zip(problem.takes, first_flights(problem, fit, fit.z), strict=True):
        times = take.sight.times
        record = run_on(problem, fit, fit.z, take, state, times - times[0])
        found[take.sight.trial.name] = take.sight.columns, placed(take, record[: len(times)])
    return found
