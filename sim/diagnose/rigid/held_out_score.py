# SPDX-License-Identifier: MIT
"""Held-out scores: how well a fit predicts what it has not seen."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..capture_geometry import mean_known
from .multiple_shooting import Fit, solve
from .observed_poses import QUATERNION, another_side_up
from .rigid_prediction import extrapolate, first_states, noise_spread, own_noise, pooled_rms, shown_frames, world_points
from .segmented_trial import SegmentedTrial

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutScore:
    """Held-out scores. log_score: (fit trials,) nats. rms_m: RMS error predicted from the first frames.

    trials: each one's error over ``prediction_spread``; () without it. chi: their RMS; NaN without them. elsewhere: of
    each, whether the body comes to lie on another face than it is predicted to.
    """

    log_score: Array
    rms_m: float
    chi: float = math.nan
    trials: tuple[float, ...] = ()
    elsewhere: tuple[bool, ...] = ()


def leave_one_out(fit: Fit) -> Array:
    """Return numbers (trials, P) fitted without each trial, from the information that it contributed."""
    size = fit.model.size
    whole = np.eye(size) + fit.schur.sum(axis=0)
    found = []
    for schur, pull in zip(fit.schur, fit.pull, strict=True):
        # At the optimum the gradients sum to zero, so without this trial its own negative remains.
        step = np.linalg.solve(whole - schur + 1e-9 * np.eye(size), -pull)
        found.append(fit.z + np.clip(step, -2.0, 2.0))
    return np.array(found)


def middle_frame(trial: SegmentedTrial) -> int:
    """Return the frame at half of the time of ``trial`` that is fitted, at least the third and not the last."""
    times = trial.observations.times[: trial.end]
    return int(np.clip(np.searchsorted(times, 0.5 * (times[0] + times[-1])), 3, max(len(times) - 1, 3)))


def _from_first_half(fit: Fit, index: int) -> Array:
    """Return numbers (P,) fitted without the second half of trial ``index``, the only complete one."""
    trials, states = list(fit.problem.trials), list(fit.states)
    trial = trials[index]
    end = min(middle_frame(trial), trial.end)
    kept = max(1, sum(n < end - 2 for n in trial.nodes))
    end = min([end, *trial.nodes[kept : kept + 1]])
    weights = list(trial.weights[:kept])
    weights[-1] = weights[-1][: end - trial.nodes[kept - 1]]
    trials[index] = dataclasses.replace(
        trial,
        nodes=trial.nodes[:kept],
        end=end,
        states=states[index][:kept],
        covers=trial.covers[:kept],
        weights=weights,
    )
    states[index] = states[index][:kept]
    half = dataclasses.replace(fit.problem, trials=trials)
    return solve(half, fit.model, fit.z, states, rounds=6).z


def score_held_out(fit: Fit, spread: Array | None = None) -> HeldOutScore:
    """Return the held-out scores of ``fit``. spread: (trials,) m, ``prediction_spread`` of the nominal model."""
    problem = fit.problem
    numbers = leave_one_out(fit)
    alone = [i for i, t in enumerate(problem.trials) if t.observations.trial.role == "fit"]
    if len(alone) == 1:
        numbers[alone[0]] = _from_first_half(fit, alone[0])
    scores = []
    for i, trial in enumerate(problem.trials):
        if trial.observations.trial.role == "fit":
            step = numbers[i] - fit.z
            cost = fit.evaluation.linear[i].cost - 2 * float(fit.pull[i] @ step) + float(step @ fit.schur[i] @ step)
            scores.append(-0.5 * cost)
    starts = first_states(fit, numbers)
    squares: list[Array] = []
    chis: list[float] = []
    elsewhere: list[bool] = []
    for i, trial in enumerate(problem.trials):
        if trial.observations.trial.role != "fit" or len(trial.observations.times) < 5:
            continue
        times = trial.observations.times
        begin, state = starts[i]
        record = extrapolate(fit, numbers[i], state, times[begin:] - times[begin])
        points = world_points(trial, record)
        off = (trial.observations.seen if trial.observations.camera is None else _tracked_points(fit, i))[
            begin:
        ] - points
        first = middle_frame(trial) if len(alone) == 1 else shown_frames(fit, trial)
        off = off[max(0, first - begin) :]
        squares.append(np.sum(off**2, axis=-1).ravel())
        if spread is not None and np.isfinite(spread[i]) and np.isfinite(squares[-1]).any():
            chis.append(math.sqrt(float(mean_known(squares[-1]))) / float(spread[i]))
            elsewhere.append(_lies_elsewhere(fit, i, begin, record))
    rms = float(np.sqrt(mean_known(np.concatenate(squares)))) if squares else float("nan")
    chi = float(np.sqrt(np.mean(np.square(chis)))) if chis else math.nan
    return HeldOutScore(log_score=np.array(scores), rms_m=rms, chi=chi, trials=tuple(chis), elsewhere=tuple(elsewhere))


def _lies_elsewhere(fit: Fit, index: int, begin: int, record: Array) -> bool:
    """Return whether the body of trial ``index``, last seen, has another side up than in the prediction ``record`` from
    the frame ``begin`` on. Never of a sphere, which has no sides."""
    scene = fit.problem.scene
    if scene.body.round:
        return False
    last = max((s for s in fit.evaluation.segments if s.trial == index), key=lambda s: int(s.frames[-1]))
    predicted = record[int(last.frames[-1]) - begin, QUATERNION]
    return another_side_up(last.record[-1, QUATERNION], predicted, np.asarray(scene.capture.ground.unit_normal))


def noise_floor(fit: Fit) -> float:
    """Return the RMS distance in m that noise leaves in predictions: from the first frames and the 3D points.

    Pixels are compared with the fitted path, which has almost no noise.
    """
    own = [own_noise(t.observations) for t in fit.problem.trials if t.observations.trial.role == "fit"]
    return float(np.sqrt(np.mean(own) + pooled_rms(noise_spread(fit)) ** 2))


def _tracked_points(fit: Fit, index: int) -> Array:
    """Return points (T, K, 3) of a trial along the fitted segments; NaN outside them."""
    trial = fit.problem.trials[index]
    found = np.full((len(trial.observations.times), len(trial.observations.places), 3), np.nan)
    for segment in fit.evaluation.segments:
        if segment.trial == index:
            found[segment.frames] = world_points(trial, segment.record)
    return found
