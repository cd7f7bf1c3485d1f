# SPDX-License-Identifier: MIT
"""Initial states and nodes of a trial: the nominal model tracks the observations from contact to contact."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..capture_geometry import mean_known
from .multiple_shooting import eliminate_states
from .observed_poses import PUSHED, QUATERNION, SPIN, TOUCHED, VELOCITY, ObservedBody, frame_pose, perturbed
from .quaternions import as_matrix
from .resting_contact import height, resting_state
from .rigid_simulator import RigidWorlds
from .segment_paths import Model
from .segmented_trial import Segment, SegmentedTrial
from .shooting_problem import Problem
from .world_settings import BodyScene

Array = NDArray[np.float64]


SEEN_FIRST = 0.05
"""Time in s from the start for the first velocity estimate."""

FLIGHT_WINDOW, PIXEL_WINDOW, CONTACT_WINDOW = 0.16, 0.3, 0.06
"""Time in s to which one state is fitted."""

NODE_EVERY = 0.10
"""Time in s between nodes in a long contact."""

LONGEST_IMPACT = 0.05

MOST_NODES = 24

SETTLED = 1e-4
"""Relative decrease of the objective below which iteration stops."""

LOST = 40.0
"""RMS residual in noise standard deviations above which the model has lost the body."""

NEAR_GROUND = 2e-3
"""Height in m, beside three standard deviations of a point, below which a body may roll or slide from the start."""

LYING_SPEED = 0.02
"""Standard deviation in m/s of the speed along the normal of a body that rolls or slides from the start."""

GUESS_HEIGHT = 0.01
"""Standard deviation in m of a height estimated from one frame's pixels."""

STILL_SPIN = 0.3
"""Standard deviation in rad/s of the spin of a body with two tracked points, whose axis they hardly show."""

SPIN_PARAMETER = 0.6
"""Standard deviation of a spin that no point shows: surface speed over speed."""

NOMINAL = Model(candidates=())


def first_state(scene: BodyScene, observations: ObservedBody, first: int = 0) -> tuple[Array, Array]:
    """Return a state (13,) and its standard deviations (12,) from the frames next to frame ``first``."""
    late = observations.times - observations.times[first]
    frames = np.flatnonzero((late >= 0) & (late <= SEEN_FIRST))
    if len(frames) < 4:
        frames = np.arange(first, min(first + 4, len(observations.times)))
    poses: list[tuple[float, Array, Array]] = []
    guess = None
    for frame in frames:
        found = frame_pose(observations, int(frame), guess)
        if found is not None and np.isfinite(found[0]).all():
            guess = found
            poses.append((float(observations.times[frame]), *found))
    state = np.zeros(13)
    state[3] = 1.0
    alone = observations.poses_alone
    prior = np.repeat([1.0, 1.0, 20.0, 60.0] if alone else [1.0, 1e-3, 20.0, STILL_SPIN], 3)
    if not poses:
        state[:3] = scene.middle
        return state, prior
    t = np.array([p[0] for p in poses]) - observations.times[first]
    x = np.array([p[1] for p in poses])
    if len(poses) >= 2:
        fall = x - 0.5 * np.asarray(scene.capture.gravity) * t[:, None] ** 2
        line = np.polyfit(t, fall, 1)
        state[:3], state[VELOCITY] = line[1], line[0]
    else:
        state[:3] = x[0]
    if observations.hides_spin:
        prior[9:12] = max(STILL_SPIN, SPIN_PARAMETER * float(np.linalg.norm(state[VELOCITY])) / scene.body.bound)
    turns = [Rotation.from_matrix(p[2]) for p in poses]
    if alone and len(poses) >= 2:
        spins = [(b * a.inv()).as_rotvec() / (t[i + 1] - t[i]) for i, (a, b) in enumerate(pairwise(turns))]
        spin = np.median(spins, axis=0)
        # Rotated back to the start, all frames give the initial orientation.
        back = [Rotation.from_rotvec(-spin * (ti)) * r for ti, r in zip(t, turns, strict=True)]
        start = Rotation.concatenate(back).mean()
        state[SPIN] = spin
    else:
        start = turns[0]
    state[QUATERNION] = np.roll(start.as_quat(), 1)
    return state, prior


def used_frames(observations: ObservedBody) -> int:
    """Return the number of frames until the body is finally at rest; later ones carry no information."""
    seen, count = observations.seen, len(observations.times)
    tail = max(4, count // 12)
    off = seen - mean_known(seen[-tail:], axis=0)
    size = np.sqrt(mean_known(np.sum(off**2, axis=-1), axis=1))
    limit = 1.7 * observations.sigma * np.sqrt(seen.shape[-1])
    moving = np.flatnonzero(~(size <= limit))
    end = (int(moving[-1]) + 1 if len(moving) else 0) + max(3, count // 40)
    return int(np.clip(end, min(count, 6), count))


def fit_states(problem: Problem, model: Model, z: Array, states: list[Array], rounds: int) -> list[Array]:
    """Return ``states`` fitted with the numbers ``z`` held fixed."""
    best = problem.evaluate(model, z, states, fixed=True)
    costs = np.array([part.cost for part in best.linear])
    damping = np.full(len(states), 1e-3)
    for number in range(rounds):
        tried = []
        for s, part, d in zip(states, best.linear, damping, strict=True):
            own = eliminate_states(part, 0, float(d))[3]
            tried.append(perturbed(s, own.reshape(-1, 12)))
        new = problem.evaluate(model, z, tried, fixed=True, slopes=number < rounds - 1)
        better = np.array([part.cost for part in new.linear]) < costs
        states = [t if b else s for s, t, b in zip(states, tried, better, strict=True)]
        best.linear = [n if b else o for o, n, b in zip(best.linear, new.linear, better, strict=True)]
        damping = np.where(better, damping / 5, damping * 10)
        before, costs = costs, np.array([part.cost for part in best.linear])
        if (better & (before - costs < SETTLED * np.maximum(costs, 1.0))).all():
            break
    return states


def track_states(
    scene: BodyScene,
    simulator: RigidWorlds,
    seen: list[ObservedBody],
    *,
    model: Model = NOMINAL,
    z: Array | None = None,
) -> list[SegmentedTrial]:
    """Return the trials with nodes and initial states, found with the nominal model segment by segment."""
    numbers = np.zeros(model.size) if z is None else z
    trials = []
    for observations in seen:
        state, prior = first_state(scene, observations)
        trials.append(
            SegmentedTrial(
                observations=observations,
                nodes=[0],
                states=state[None],
                end=used_frames(observations),
                guess=state,
                prior=prior,
            )
        )
    _set_down(scene, simulator, trials, model, numbers)
    here = [dataclasses.replace(t, states=t.states.copy(), nodes=[0]) for t in trials]
    active = list(range(len(trials)))
    for _ in range(MOST_NODES):
        if not active:
            break
        ends = [trials[i].end for i in active]
        problem = Problem(scene=scene, simulator=simulator, trials=[here[i] for i in active])
        for _ in range(2):
            for k, i in enumerate(active):
                here[i].end = ends[k]
            look = problem.evaluate(model, numbers, [here[i].states for i in active], slopes=False)
            for segment, i in zip(look.segments, active, strict=True):
                here[i].end = _window(here[i], segment.record)
            fitted = fit_states(problem, model, numbers, [here[i].states for i in active], 4)
            for i, s in zip(active, fitted, strict=True):
                here[i].states = s
        for k, i in enumerate(active):
            here[i].end = ends[k]
        look = problem.evaluate(model, numbers, [here[i].states for i in active], slopes=False)
        going = []
        for segment, i in zip(look.segments, active, strict=True):
            following = _following(scene, trials[i], here[i], segment)
            if following is not None:
                here[i] = following
                going.append(i)
        active = going
    for trial in trials:
        trial.nodes = trial.nodes[: len(trial.states)]
    return trials


def _following(
    scene: BodyScene, trial: SegmentedTrial, here: SegmentedTrial, segment: Segment
) -> SegmentedTrial | None:
    """Give ``trial`` the states of ``here``, its last segment so far, and the node at which the next one begins.

    Returns that one, to be fitted; None where ``segment``, a run of the last, lasts to the end.
    """
    node = here.nodes[0]
    if len(trial.states) < len(trial.nodes):
        trial.states = np.concatenate([trial.states, here.states])
    else:
        trial.states = here.states.copy()
    index = _next_node(trial.observations.times[node : trial.end], segment.record)
    lost = _lost(trial.observations, segment)
    if lost is not None and (index is None or lost < index):
        # The model lost the body: restart where it is.
        index = lost
        guess, prior = first_state(scene, trial.observations, node + lost)
    elif index is None:
        return None
    else:
        guess = segment.record[index, :13].copy()
        blow = 0.2 * segment.record[index, PUSHED] + 0.05
        size = scene.body.bound
        prior = np.repeat([0.01, 0.01 / size, blow, blow / size], 3)
        if not trial.observations.poses_alone:
            prior[3:6] = 1e-3
            prior[9:12] = blow / size if trial.observations.hides_spin else STILL_SPIN
    trial.nodes.append(node + index)
    return SegmentedTrial(
        observations=trial.observations,
        nodes=[node + index],
        states=guess[None],
        end=trial.end,
        guess=guess,
        prior=prior,
    )


def _set_down(scene: BodyScene, simulator: RigidWorlds, trials: list[SegmentedTrial], model: Model, z: Array) -> None:
    """Start on the ground where that explains the first frames better.

    Pixels leave the initial height open. A first state of points assumes free flight, so that a body which rolls or
    slides from the start would seem to rise.
    """
    normal, foot = scene.capture.ground.unit_normal, np.asarray(scene.capture.ground.point)
    near = []
    for trial in trials:
        seen = trial.observations
        if seen.camera is not None:
            lying = None if model.setting(scene, z).camera is not None else resting_state(scene, seen)
            if lying is not None:
                trial.states, trial.guess, trial.prior = lying[0][None], lying[0].copy(), lying[1]
                continue
        elif abs(height(scene, trial.states[0])[0]) > NEAR_GROUND + 3 * seen.sigma:
            continue
        near.append(trial)
    if not near:
        return
    options, fees = [], []
    for trial in near:
        down, prior = trial.states.copy(), trial.prior.copy()
        corners = down[0, :3] + scene.body.corners @ as_matrix(down[0, QUATERNION]).T
        down[0, :3] -= ((corners - foot) @ normal - scene.body.radius).min() * normal
        down[0, VELOCITY] -= (down[0, VELOCITY] @ normal) * normal
        window, guess = PIXEL_WINDOW, trial.guess
        if trial.observations.camera is None:
            window, guess = CONTACT_WINDOW, down[0].copy()
            if abs(normal[2]) > 0.999:
                prior[8] = LYING_SPEED
        frames = int(np.searchsorted(trial.observations.times - trial.observations.times[0], window)) + 1
        end = min(trial.end, max(frames, 5))
        options += [
            dataclasses.replace(trial, end=end),
            dataclasses.replace(trial, end=end, states=down, prior=prior, guess=guess),
        ]
        # Fewer motions are plausible on the ground, as in the evidence.
        fees.append(2 * float(np.log(trial.prior / prior).sum()))
    problem = Problem(scene=scene, simulator=simulator, trials=options)
    settled = fit_states(problem, model, z, [t.states for t in options], 6)
    costs = [part.cost for part in problem.evaluate(model, z, settled, slopes=False).linear]
    for k, (trial, fee) in enumerate(zip(near, fees, strict=True)):
        best = 2 * k + int(costs[2 * k + 1] < costs[2 * k] + fee)
        trial.states = settled[best]
        trial.guess = settled[best][0].copy()
        trial.prior = options[best].prior
        if trial.observations.camera is None:
            trial.guess = options[best].guess


def _window(trial: SegmentedTrial, record: Array) -> int:
    """Return the end (exclusive) of the frames to which the state at the node is fitted."""
    node = trial.nodes[0]
    times = trial.observations.times[node : trial.end] - trial.observations.times[node]
    touched = record[:, TOUCHED] > 0
    first = int(np.argmax(touched)) if touched.any() else len(times)
    flight = PIXEL_WINDOW if trial.observations.camera is not None else FLIGHT_WINDOW
    if not trial.observations.poses_alone:
        flight = 1e9
    enough = 10 if trial.observations.camera is not None else 4
    if first >= enough:
        return node + min(first, int(np.searchsorted(times, flight)) + 1)
    short = max(
        int(np.searchsorted(times, (2 if trial.observations.camera is not None else 1) * CONTACT_WINDOW)) + 1, 5
    )
    return min(trial.end, node + short)


def _lost(observations: ObservedBody, segment: Segment) -> int | None:
    """Return the frame of ``segment`` from which residuals exceed what a missing force explains; None if none."""
    seen = np.maximum(
        np.isfinite(observations.seen[segment.frames]).all(axis=2).sum(axis=1) * observations.seen.shape[2], 1
    )
    bad = segment.chi2 / seen > LOST**2
    run = bad[:-2] & bad[1:-1] & bad[2:]
    if not run.any():
        return None
    index = max(int(np.argmax(run)), 3)
    return index if index < len(bad) - 3 else None


def _next_node(times: Array, record: Array) -> int | None:
    """Return the frame of the segment at which the next one begins; None where it lasts to the end."""
    touched = record[:, TOUCHED]
    if touched[-1] <= 0:
        return None
    gain = np.diff(touched, prepend=0.0) > 0
    first = int(np.argmax(gain))
    free = np.flatnonzero(~gain[first:])
    leaves = first + int(free[0]) if len(free) else len(times)
    begins = times[max(first - 1, 0)]
    if leaves < len(times) and times[leaves] - begins <= LONGEST_IMPACT:
        index = leaves
    else:
        # A lasting contact: soon after its start, then at intervals.
        wait = LONGEST_IMPACT if first > 1 else NODE_EVERY
        index = int(np.searchsorted(times, begins + wait))
    index = max(index, 3)
    return index if index < len(times) - 3 else None


def initial_camera(problem: Problem) -> Array:
    """Return initial numbers (6,) of a moved camera, from poses of frames in which the body touches the ground.

    Their heights above the ground should be zero; how they differ gives the camera's rotation and translation.
    """
    scene = problem.scene
    camera, body, ground = scene.capture.camera, scene.body, scene.capture.ground
    assert camera is not None
    place, normal, foot = camera.matrix[:3, 3], ground.unit_normal, np.asarray(ground.point)
    rows, values = [], []
    for trial in problem.trials:
        if trial.observations.trial.predict_times is not None:
            continue
        heights, poses, guess = [], [], None
        for frame in range(len(trial.observations.times)):
            found = frame_pose(trial.observations, frame, guess)
            if found is None:
                continue
            guess = found
            low = (found[0] - foot + body.corners @ found[1].T) @ normal - body.radius
            heights.append(float(low.min()))
            poses.append(found[0])
        if len(heights) < 8:
            continue
        # The lowest tenth of a trial, averaged over its noise, is contact.
        count = max(4, len(heights) // 5)
        for k in np.argsort(heights)[count // 4 : count]:
            lever = poses[k] - place
            rows.append(np.concatenate([0.03 * np.cross(lever, normal), 0.02 * normal]))
            values.append(-heights[k])
    if not rows:
        return np.zeros(6)
    matrix, right = np.array(rows) / GUESS_HEIGHT, np.array(values) / GUESS_HEIGHT
    share = 12.0 / max(12.0, len(rows))  # poses of one trial share errors
    return np.linalg.solve(np.eye(6) + share * matrix.T @ matrix, share * matrix.T @ right)
