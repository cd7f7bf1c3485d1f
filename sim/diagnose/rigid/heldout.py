# SPDX-License-Identifier: MIT
"""What a candidate is worth on a take that its parameters were fitted without."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .prediction import first_states, noise_spread, placed, run_on, shown_frames
from .shooting import Fit

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Heldout:
    """log_score: (fit takes,) nats. rms_m: predicted from the first frames."""

    log_score: Array
    rms_m: float


def without_each(fit: Fit) -> Array:
    """Numbers (takes, P) as fitted without each take, from the information that it brought."""
    size = fit.model.size
    whole = np.eye(size) + fit.schur.sum(axis=0)
    found = []
    for schur, pull in zip(fit.schur, fit.pull, strict=True):
        # At the fit all slopes together vanish, so without this take its own is what is left over.
        step = np.linalg.solve(whole - schur + 1e-9 * np.eye(size), -pull)
        found.append(fit.z + np.clip(step, -2.0, 2.0))
    return np.array(found)


def heldout(fit: Fit) -> Heldout:
    """Of ``fit``, take by take."""
    problem = fit.problem
    numbers = without_each(fit)
    scores = []
    for i, take in enumerate(problem.takes):
        if take.sight.trial.role == "fit":
            step = numbers[i] - fit.z
            cost = fit.evaluation.linear[i].cost - 2 * float(fit.pull[i] @ step) + float(step @ fit.schur[i] @ step)
            scores.append(-0.5 * cost)
    starts = first_states(fit, numbers)
    squares: list[Array] = []
    for i, take in enumerate(problem.takes):
        if take.sight.trial.role != "fit" or len(take.sight.times) < 5:
            continue
        times = take.sight.times
        begin, state = starts[i]
        record = run_on(fit, numbers[i], state, times[begin:] - times[begin])
        points = placed(take, record)
        off = (take.sight.seen if take.sight.camera is None else _followed(fit, i))[begin:] - points
        off = off[max(0, shown_frames(fit, take) - begin) :]
        squares.append(np.sum(off**2, axis=-1).ravel())
    rms = float(np.sqrt(np.nanmean(np.concatenate(squares)))) if squares else float("nan")
    return Heldout(log_score=np.array(scores), rms_m=rms)


def noise_floor(fit: Fit) -> float:
    """Distance in m that noise alone leaves where ``fit`` predicts: in its first frames, and in 3D points themselves.

    Pixels are compared with the path that was followed, which has next to no noise of its own.
    """
    takes = [t for t in fit.problem.takes if t.sight.trial.role == "fit"]
    own = [0.0 if t.sight.camera is not None else 3 * t.sight.sigma**2 for t in takes]
    return float(np.sqrt(np.mean(own) + noise_spread(fit) ** 2))


def _followed(fit: Fit, index: int) -> Array:
    """Points (T, K, 3) of a take as ``fit`` follows them, contact by contact; NaN where it was not followed."""
    take = fit.problem.takes[index]
    found = np.full((len(take.sight.times), len(take.sight.places), 3), np.nan)
    for segment in fit.evaluation.segments:
        if segment.take == index:
            found[segment.frames] = placed(take, segment.record)
    return found
