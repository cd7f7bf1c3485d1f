# SPDX-License-Identifier: MIT
"""Where the points of a body are under a fit: after what was shown, and from the first frames of a take."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .candidates import BELIEFS
from .shooting import Fit, Model, Problem, Take
from .tracking import settle
from .turning import moved, to_matrix
from .worlds import SLOTS

Array = NDArray[np.float64]
Points = dict[str, tuple[NDArray[np.int64], Array]]

NOISE_DRAWS = 6
"""First states tried for what noise in them amounts to."""

SHOWN = 0.16
"""Seconds from which a complete take is predicted where no predict trial says how much there is to see."""


def believed_fit(nominal: Fit) -> Fit:
    """The nominal model exactly as believed, its states fitted."""
    model, z = Model(freedoms=()), np.zeros(BELIEFS.size)
    states = settle(nominal.problem, model, z, nominal.states, 3)
    return dataclasses.replace(nominal, model=model, z=z, states=states)


def run_on(fit: Fit, z: Array, state: Array, times: Array) -> Array:
    """Record (M, 17) at ``times``, s since ``state`` in the recording's clock."""
    scene = fit.problem.scene
    setting = fit.model.setting(scene, z)
    return fit.problem.launcher.run(state[None], scene.numbers([setting]), [times * setting.rate])[0, : len(times)]


def placed(take: Take, record: Array) -> Array:
    """Points (M, K, 3) of ``record``, world."""
    return np.asarray(record[:, None, :3] + np.einsum("mij,kj->mki", to_matrix(record[:, 3:7]), take.sight.places))


def predict_points(fit: Fit) -> Points:
    """By predict trial: columns and points (P, K, 3) at its ``predict_times``."""
    found: Points = {}
    for take, states in zip(fit.problem.takes, fit.states, strict=True):
        wanted = take.sight.trial.predict_times
        if wanted is None:
            continue
        begin = take.sight.times[take.nodes[-1]]
        record = run_on(fit, fit.z, states[-1], wanted - begin)
        found[take.sight.trial.name] = take.sight.columns, placed(take, record)
    return found


def shown_frames(fit: Fit, take: Take) -> int:
    """As many first frames of ``take`` as the predict trials show, or ``SHOWN`` seconds."""
    spans = [t.sight.times[-1] - t.sight.times[0] for t in fit.problem.takes if t.sight.trial.predict_times is not None]
    times = take.sight.times - take.sight.times[0]
    count = int(np.searchsorted(times, float(np.median(spans)) if spans else SHOWN, side="right"))
    return int(np.clip(count, min(4, take.end), take.end))


def _shortened(fit: Fit) -> tuple[Problem, list[Array]]:
    """``fit``'s problem cut to the first frames of every take, with the states there."""
    short, states = [], []
    for take, whole in zip(fit.problem.takes, fit.states, strict=True):
        end = shown_frames(fit, take)
        nodes = [n for n in take.nodes if n < end - 2] or [0]
        end = min([end, *take.nodes[len(nodes) : len(nodes) + 1]])
        cut = end - nodes[-1]
        weights = [*take.weights[: len(nodes) - 1], take.weights[len(nodes) - 1][:cut]]
        short.append(
            dataclasses.replace(
                take,
                nodes=nodes,
                end=end,
                states=whole[: len(nodes)],
                covers=take.covers[: len(nodes) - 1],
                weights=weights,
            )
        )
        states.append(whole[: len(nodes)])
    return dataclasses.replace(fit.problem, takes=short), states


def first_states(fit: Fit, z: Array) -> list[tuple[int, Array]]:
    """(frame, state (13,) there) of all takes, known from no more than their first frames. z: (P,) or (takes, P)."""
    short, states = _shortened(fit)
    found = settle(short, fit.model, z, states, 3)
    return [(t.nodes[-1], s[-1]) for t, s in zip(short.takes, found, strict=True)]


def noise_spread(fit: Fit) -> float:
    """Root mean square distance in m by which noise in the first frames alone moves what follows, in the fit takes."""
    short, states = _shortened(fit)
    states = settle(short, fit.model, fit.z, states, 3)
    look = short.evaluate(fit.model, fit.z, states, fixed=True)
    rng, squares = np.random.default_rng(0), []
    for take, part, state in zip(short.takes, look.linear, states, strict=True):
        times = take.sight.times[shown_frames(fit, take) :]
        if take.sight.trial.role != "fit" or not len(times):
            continue
        cover = np.linalg.pinv(part.hessian, hermitian=True)[-12:, -12:]
        values, vectors = np.linalg.eigh(0.5 * (cover + cover.T))
        draws = rng.normal(size=(NOISE_DRAWS, 12)) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        clock = times - take.sight.times[take.nodes[-1]]
        middle = placed(take, run_on(fit, fit.z, state[-1], clock))
        for draw in draws:
            other = placed(take, run_on(fit, fit.z, moved(state[-1], draw), clock))
            squares.append(np.sum((other - middle) ** 2, axis=-1).ravel())
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if squares else 0.0


def simulate_points(fit: Fit) -> Points:
    """By trial: columns and points (T, K, 3) at its frames, run from its first frames without another look."""
    found: Points = {}
    for i, (take, (begin, state)) in enumerate(zip(fit.problem.takes, first_states(fit, fit.z), strict=True)):
        times = take.sight.times
        record = run_on(fit, fit.z, state, times[begin:] - times[begin])
        earlier = [s.record[s.frames < begin] for s in fit.evaluation.segments if s.take == i]
        found[take.sight.trial.name] = take.sight.columns, placed(take, np.concatenate([*earlier, record]))
    return found


def numerics(fit: Fit) -> float:
    """Root mean square distance in m by which ``fit``'s takes move when every step is half as long."""
    problem = fit.problem
    fine = dataclasses.replace(problem.launcher, longest=0.5 * problem.launcher.longest)
    setting = fit.model.setting(problem.scene, fit.z)
    row = problem.scene.numbers([setting])
    half = row.copy()
    half[:, SLOTS["step"]] *= 0.5
    off = []
    for take, states in zip(problem.takes, fit.states, strict=True):
        clock = [(take.sight.times - take.sight.times[0]) * setting.rate]
        coarse = placed(take, problem.launcher.run(states[:1], row, clock)[0])
        off.append(np.sum((placed(take, fine.run(states[:1], half, clock)[0]) - coarse) ** 2, axis=-1).ravel())
    return float(np.sqrt(np.mean(np.concatenate(off))))
