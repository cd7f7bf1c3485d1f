# SPDX-License-Identifier: MIT
"""Predicted points of a body under a fit: simulation from a trial's first frames, its spread, model averages."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from ..capture_geometry import mean_known
from .multiple_shooting import Fit
from .observed_poses import QUATERNION, SPIN, ObservedBody, fit_rotation, perturbed
from .quaternions import as_matrix
from .rigid_candidates import BELIEFS
from .rigid_simulator import SLOTS
from .segment_paths import Model
from .segmented_trial import SegmentedTrial
from .shooting_problem import Problem
from .state_tracking import fit_states

Array = NDArray[np.float64]
Points = dict[str, tuple[NDArray[np.int64], Array]]

NOISE_DRAWS = 6
"""Noise samples of the initial states."""

SHOWN = 0.16
"""Time in s of the first frames of complete trials where no predict trial defines it."""


def believed_fit(nominal: Fit) -> Fit:
    """Return the nominal model with its given parameters and fitted states."""
    model, z = Model(candidates=()), np.zeros(BELIEFS.size)
    states = fit_states(nominal.problem, model, z, nominal.states, 3)
    return dataclasses.replace(nominal, model=model, z=z, states=states)


def extrapolate(fit: Fit, z: Array, state: Array, times: Array) -> Array:
    """Return the record (M, 17) at ``times``, recorded s since ``state``."""
    scene = fit.problem.scene
    setting = fit.model.setting(scene, z)
    return fit.problem.simulator.run(state[None], scene.numbers([setting]), [times * setting.rate])[0, : len(times)]


def world_points(trial: SegmentedTrial, record: Array) -> Array:
    """Return world points (M, K, 3) of ``record``."""
    return np.asarray(
        record[:, None, :3] + np.einsum("mij,kj->mki", as_matrix(record[:, QUATERNION]), trial.observations.places)
    )


def predict_points(fit: Fit) -> Points:
    """Return by predict trial: columns and points (P, K, 3) at its ``predict_times``."""
    found: Points = {}
    for trial, states in zip(fit.problem.trials, fit.states, strict=True):
        wanted = trial.observations.trial.predict_times
        if wanted is None:
            continue
        begin = trial.observations.times[trial.nodes[-1]]
        record = extrapolate(fit, fit.z, states[-1], wanted - begin)
        found[trial.observations.trial.name] = trial.observations.columns, world_points(trial, record)
    return found


def shown_frames(fit: Fit, trial: SegmentedTrial) -> int:
    """Return how many first frames of ``trial`` to use: as many as in predict trials, or ``SHOWN`` seconds."""
    spans = [
        t.observations.times[-1] - t.observations.times[0]
        for t in fit.problem.trials
        if t.observations.trial.predict_times is not None
    ]
    times = trial.observations.times - trial.observations.times[0]
    count = int(np.searchsorted(times, float(np.median(spans)) if spans else SHOWN, side="right"))
    return int(np.clip(count, min(4, trial.end), trial.end))


def _shortened(fit: Fit) -> tuple[Problem, list[Array]]:
    """Return ``fit``'s problem truncated to the first frames of every trial, and the states there."""
    short, states = [], []
    for trial, whole in zip(fit.problem.trials, fit.states, strict=True):
        end = shown_frames(fit, trial)
        nodes = [n for n in trial.nodes if n < end - 2] or [0]
        end = min([end, *trial.nodes[len(nodes) : len(nodes) + 1]])
        cut = end - nodes[-1]
        weights = [*trial.weights[: len(nodes) - 1], trial.weights[len(nodes) - 1][:cut]]
        short.append(
            dataclasses.replace(
                trial,
                nodes=nodes,
                end=end,
                states=whole[: len(nodes)],
                covers=trial.covers[: len(nodes) - 1],
                weights=weights,
            )
        )
        states.append(whole[: len(nodes)])
    return dataclasses.replace(fit.problem, trials=short), states


def first_states(fit: Fit, z: Array) -> list[tuple[int, Array]]:
    """Return (frame, state (13,)) of all trials, estimated from their first frames only. z: (P,) or (trials, P)."""
    short, states = _shortened(fit)
    found = fit_states(short, fit.model, z, states, 3)
    return [(t.nodes[-1], s[-1]) for t, s in zip(short.trials, found, strict=True)]


def pooled_rms(squares: list[Array]) -> float:
    """Return the RMS of all trials' squared distances in m; 0 without any."""
    return float(np.sqrt(np.mean(np.concatenate(squares)))) if sum(map(len, squares)) else 0.0


def noise_spread(fit: Fit) -> list[Array]:
    """Return by trial the squared distances in m² by which noise in the first frames moves its prediction.

    Empty for trials that are to be predicted, and where all frames are shown.
    """
    short, states = _shortened(fit)
    states = fit_states(short, fit.model, fit.z, states, 3)
    if all(t.observations.hides_spin for t in short.trials):
        return _refitted_spread(fit, short, states)
    look = short.evaluate(fit.model, fit.z, states, fixed=True)
    rng = np.random.default_rng(0)
    found: list[list[Array]] = [[] for _ in short.trials]
    for squares, trial, part, state in zip(found, short.trials, look.linear, states, strict=True):
        times = trial.observations.times[shown_frames(fit, trial) :]
        if trial.observations.trial.role != "fit" or not len(times):
            continue
        cover = np.linalg.pinv(part.hessian, hermitian=True)[-12:, -12:]
        values, vectors = np.linalg.eigh(0.5 * (cover + cover.T))
        draws = rng.normal(size=(NOISE_DRAWS, 12)) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        clock = times - trial.observations.times[trial.nodes[-1]]
        middle = world_points(trial, extrapolate(fit, fit.z, state[-1], clock))
        for draw in draws:
            other = world_points(trial, extrapolate(fit, fit.z, perturbed(state[-1], draw), clock))
            squares.append(np.sum((other - middle) ** 2, axis=-1).ravel())
    return [np.concatenate(s) if s else np.empty(0) for s in found]


def _refitted_spread(fit: Fit, short: Problem, states: list[Array]) -> list[Array]:
    """Return what ``noise_spread`` does for single points, part of whose noise is slow: a fit to added noise."""
    rng = np.random.default_rng(0)
    ways: list[list[Array | None]] = []
    for number in range(NOISE_DRAWS + 1):
        # The first draw has no noise.
        seen = [t.observations.disturbed(rng) if number else t.observations for t in short.trials]
        own = [dataclasses.replace(t, observations=o) for t, o in zip(short.trials, seen, strict=True)]
        found = fit_states(dataclasses.replace(short, trials=own), fit.model, fit.z, states, 3)
        ways.append([_later(fit, trial, state[-1]) for trial, state in zip(short.trials, found, strict=True)])
    found = []
    for first, *others in zip(*ways, strict=True):
        known = [np.sum((b - first) ** 2, axis=-1).ravel() for b in others if first is not None and b is not None]
        found.append(np.concatenate(known) if known else np.empty(0))
    return found


def _later(fit: Fit, trial: SegmentedTrial, state: Array) -> Array | None:
    """Return the points (M, K, 3) of a fit trial predicted after its first frames; None where nothing follows."""
    times = trial.observations.times[shown_frames(fit, trial) :]
    if trial.observations.trial.role != "fit" or not len(times):
        return None
    return world_points(trial, extrapolate(fit, fit.z, state, times - trial.observations.times[trial.nodes[-1]]))


def simulate_points(fit: Fit) -> Points:
    """Return by trial: columns and points (T, K, 3) at its frames, simulated from its first frames."""
    found: Points = {}
    for i, (trial, (begin, state)) in enumerate(zip(fit.problem.trials, first_states(fit, fit.z), strict=True)):
        times = trial.observations.times
        record = extrapolate(fit, fit.z, state, times[begin:] - times[begin])
        earlier = [s.record[s.frames < begin] for s in fit.evaluation.segments if s.trial == i]
        found[trial.observations.trial.name] = (
            trial.observations.columns,
            world_points(trial, np.concatenate([*earlier, record])),
        )
    return found


def hidden_spins(fit: Fit) -> dict[str, Array]:
    """Return by trial the spin (3,) in rad/s at its first frame with which ``simulate_points`` moves it, where no point
    shows the spin."""
    found = {}
    for i, (trial, states) in enumerate(zip(fit.problem.trials, fit.states, strict=True)):
        if trial.observations.hides_spin:
            first = next((s.record[0] for s in fit.evaluation.segments if s.trial == i), states[0])
            found[trial.observations.trial.name] = np.array(first[SPIN])
    return found


def step_size_error(fit: Fit) -> float:
    """Return the RMS distance in m by which ``fit``'s trials move when the step is halved."""
    problem = fit.problem
    fine = dataclasses.replace(problem.simulator, longest=0.5 * problem.simulator.longest)
    setting = fit.model.setting(problem.scene, fit.z)
    row = problem.scene.numbers([setting])
    half = row.copy()
    half[:, SLOTS["step"]] *= 0.5
    off = []
    for trial, states in zip(problem.trials, fit.states, strict=True):
        clock = [(trial.observations.times - trial.observations.times[0]) * setting.rate]
        coarse = world_points(trial, problem.simulator.run(states[:1], row, clock)[0])
        off.append(np.sum((world_points(trial, fine.run(states[:1], half, clock)[0]) - coarse) ** 2, axis=-1).ravel())
    return float(np.sqrt(np.mean(np.concatenate(off))))


def contact_spread(fit: Fit) -> list[Array]:
    """Return by trial the squared distances in m² by which the contact uncertainty moves its prediction.

    At every node the state gets a defect drawn from its covariance, which then travels on through later contacts. Empty
    for trials that are to be predicted, and where nothing touches after the first frames.
    """
    problem, rng = fit.problem, np.random.default_rng(0)
    row = problem.scene.numbers([fit.model.setting(problem.scene, fit.z)])
    rate = fit.model.setting(problem.scene, fit.z).rate
    found: list[list[Array]] = [[] for _ in problem.trials]
    for squares, trial, (begin, state) in zip(found, problem.trials, first_states(fit, fit.z), strict=True):
        times = trial.observations.times
        later = [(n, c) for n, c in zip(trial.nodes[1:], trial.covers, strict=False) if n > begin]
        if trial.observations.trial.role != "fit" or not later:
            continue
        # World 0 has no defects.
        states, at = np.repeat(state[None], NOISE_DRAWS + 1, axis=0), begin
        rows = np.repeat(row, len(states), axis=0)
        for number, (node, cover) in enumerate(later):
            states = problem.simulator.run(states, rows, [(times[node : node + 1] - times[at]) * rate] * len(states))
            states = states[:, 0, :13].copy()
            draws = rng.multivariate_normal(np.zeros(12), cover, size=NOISE_DRAWS, method="cholesky")
            states[1:] = perturbed(states[1:], draws)
            at, end = node, later[number + 1][0] if number + 1 < len(later) else len(times)
            clock = (times[at:end] - times[at]) * rate
            out = [world_points(trial, r) for r in problem.simulator.run(states, rows, [clock] * len(states))]
            squares += [np.sum((points - out[0]) ** 2, axis=-1).ravel() for points in out[1:]]
        shown = NOISE_DRAWS * (later[0][0] - shown_frames(fit, trial)) * len(trial.observations.places)
        squares.append(np.zeros(max(shown, 0)))
    return [np.concatenate(s) if s else np.empty(0) for s in found]


def own_noise(seen: ObservedBody) -> float:
    """Return the mean squared noise in m² of a tracked point; 0 for pixels, which are compared with the fitted path."""
    axes = float(seen.measured.sum()) if seen.hides_spin else 3.0
    return 0.0 if seen.camera is not None else axes * (seen.white**2 + seen.slow**2)


def prediction_spread(fit: Fit) -> Array:
    """Return (trials,) m what noise and contact uncertainty make of each trial's prediction; NaN if none follows."""
    found = np.full(len(fit.problem.trials), np.nan)
    for i, (trial, noise, contact) in enumerate(
        zip(fit.problem.trials, noise_spread(fit), contact_spread(fit), strict=True)
    ):
        if len(noise):
            own = own_noise(trial.observations)
            found[i] = np.sqrt(own + noise.mean() + (contact.mean() if len(contact) else 0.0))
    return found


FRICTIONS = (0.92, 0.96, 1.0, 1.04)
"""Factors on the nominal coefficient."""

BOUNCES = (0.0, 0.04, 0.08, 0.12)
"""Offsets of the nominal restitution."""

INERTIAS = (1.0, 1.1, 1.2, 1.3)
"""Factors on the inertia of uniform density: shells have more, up to five thirds for a cube."""


def marginal_points(fit: Fit) -> Points:
    """Return by predict trial: columns and points (P, K, 3), averaged over plausible contact parameters of ``fit``."""
    found: Points = {}
    for trial, states in zip(fit.problem.trials, fit.states, strict=True):
        wanted = trial.observations.trial.predict_times
        if wanted is not None:
            begin = trial.observations.times[trial.nodes[-1]]
            found[trial.observations.trial.name] = (
                trial.observations.columns,
                _expected(fit, trial, states[-1], wanted - begin),
            )
    return found


def marginal_rms(fit: Fit) -> float:
    """Return the RMS distance in m of ``marginal_points`` predictions to the 3D points of the fit trials."""
    squares: list[Array] = []
    for trial, (begin, state) in zip(fit.problem.trials, first_states(fit, fit.z), strict=True):
        late = shown_frames(fit, trial)
        if (
            trial.observations.trial.role != "fit"
            or trial.observations.camera is not None
            or late >= len(trial.observations.times)
        ):
            continue
        clock = trial.observations.times[late:] - trial.observations.times[begin]
        squares.append(
            np.sum((trial.observations.seen[late:] - _expected(fit, trial, state, clock)) ** 2, axis=-1).ravel()
        )
    return float(np.sqrt(mean_known(np.concatenate(squares)))) if squares else float("inf")


def _expected(fit: Fit, trial: SegmentedTrial, state: Array, clock: Array) -> Array:
    """Return points (M, K, 3) of the rigid body closest to the mean of all worlds, ``clock`` (M,) s after ``state``."""
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
    records = fit.problem.simulator.run(np.repeat(state[None], len(rows), axis=0), rows, [clock] * len(rows))
    mean = np.mean([world_points(trial, record[: len(clock)]) for record in records], axis=0)
    places = trial.observations.places - trial.observations.places.mean(axis=0)
    middle = mean.mean(axis=1)
    turns = np.array([fit_rotation(places, frame - m) for frame, m in zip(mean, middle, strict=True)])
    return np.asarray(middle[:, None] + np.einsum("mij,kj->mki", turns, places))
