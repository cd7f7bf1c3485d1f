# SPDX-License-Identifier: MIT
"""Prediction without a known cause: the mean over what the nominal model's own numbers may plausibly be.

A tumbling body soon goes one way or another with small changes of them; what is expected of it errs less than any one
of the ways that it may go.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .observation import rigid_turn
from .prediction import Points, first_states, placed, shown_frames
from .shooting import Fit, Take
from .worlds import SLOTS

Array = NDArray[np.float64]

FRICTIONS = (0.92, 0.96, 1.0, 1.04)
"""Shares of the believed coefficient."""

BOUNCES = (0.0, 0.04, 0.08, 0.12)
"""Added to the believed restitution."""

INERTIAS = (1.0, 1.1, 1.2, 1.3)
"""Times that of uniform density: a body made of plates or with a skin has more, up to five thirds in a cube."""


def expected_points(fit: Fit) -> Points:
    """By predict trial: columns and points (P, K, 3) at its ``predict_times``, of the nominal model ``fit``."""
    found: Points = {}
    for take, states in zip(fit.problem.takes, fit.states, strict=True):
        wanted = take.sight.trial.predict_times
        if wanted is not None:
            begin = take.sight.times[take.nodes[-1]]
            found[take.sight.trial.name] = take.sight.columns, _expected(fit, take, states[-1], wanted - begin)
    return found


def expected_rms(fit: Fit) -> float:
    """Root mean square distance in m to the 3D points of the fit takes, predicted from their first frames."""
    squares: list[Array] = []
    for take, (begin, state) in zip(fit.problem.takes, first_states(fit, fit.z), strict=True):
        late = shown_frames(fit, take)
        if take.sight.trial.role != "fit" or take.sight.camera is not None or late >= len(take.sight.times):
            continue
        clock = take.sight.times[late:] - take.sight.times[begin]
        squares.append(np.sum((take.sight.seen[late:] - _expected(fit, take, state, clock)) ** 2, axis=-1).ravel())
    return float(np.sqrt(np.nanmean(np.concatenate(squares)))) if squares else float("inf")


def _expected(fit: Fit, take: Take, state: Array, clock: Array) -> Array:
    """Points (M, K, 3): the rigid body nearest to the mean of all worlds, at ``clock`` (M,) s after ``state``."""
    scene = fit.problem.scene
    base = fit.model.setting(scene, fit.z)
    settings = [
        dataclasses.replace(base, friction=base.friction * f, restitution=min(base.restitution + e, 1.0))
        for f in FRICTIONS
        for e in BOUNCES
    ]
    rows = np.repeat(scene.numbers(settings), len(INERTIAS), axis=0)
    scale = np.tile(INERTIAS, len(settings))[:, None]
    rows[:, SLOTS["inertia"]] *= scale
    rows[:, SLOTS["mobility"]] /= scale
    records = fit.problem.launcher.run(np.repeat(state[None], len(rows), axis=0), rows, [clock] * len(rows))
    mean = np.mean([placed(take, record[: len(clock)]) for record in records], axis=0)
    places = take.sight.places - take.sight.places.mean(axis=0)
    middle = mean.mean(axis=1)
    turns = np.array([rigid_turn(places, frame - m) for frame, m in zip(mean, middle, strict=True)])
    return np.asarray(middle[:, None] + np.einsum("mij,kj->mki", turns, places))
