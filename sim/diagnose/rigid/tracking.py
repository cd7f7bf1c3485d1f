# SPDX-License-Identifier: MIT
"""First states and nodes of a take: the nominal model follows what was observed, from contact to contact."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .candidates import Scene
from .grain import covariance, frame_weights, grain_of
from .observation import Sight, frame_pose
from .resting import resting_state
from .shooting import Model, Problem, Segment, Take, reduce_take
from .turning import moved, to_matrix
from .worlds import Launcher

Array = NDArray[np.float64]

SEEN_FIRST = 0.05
"""Seconds from the start over which a first velocity is taken."""

FLIGHT_WINDOW, PIXEL_WINDOW, CONTACT_WINDOW = 0.16, 0.3, 0.06
"""Seconds of a take to which one state is fitted."""

NODE_EVERY = 0.10
"""Seconds between nodes in a long contact."""

LONGEST_IMPACT = 0.05

MOST_NODES = 24

SETTLED = 1e-4
"""Of the objective: smaller steps are not worth another."""

LOST = 40.0
"""Standard deviations of the noise, root mean square, beyond which the body is not where the model goes."""

GUESS_HEIGHT = 0.01
"""m, what a height from one frame's pixels errs by."""

NOMINAL = Model(freedoms=())


def first_state(scene: Scene, sight: Sight, first: int = 0) -> tuple[Array, Array]:
    """(state (13,), standard deviations (12,) of what it may be off), from the frames next to frame ``first``."""
    late = sight.times - sight.times[first]
    frames = np.flatnonzero((late >= 0) & (late <= SEEN_FIRST))
    if len(frames) < 4:
        frames = np.arange(first, min(first + 4, len(sight.times)))
    poses: list[tuple[float, Array, Array]] = []
    guess = None
    for frame in frames:
        found = frame_pose(sight, int(frame), guess)
        if found is not None and np.isfinite(found[0]).all():
            guess = found
            poses.append((float(sight.times[frame]), *found))
    state = np.zeros(13)
    state[3] = 1.0
    alone = sight.poses_alone
    prior = np.repeat([1.0, 1.0, 20.0, 60.0] if alone else [1.0, 1e-3, 20.0, 0.3], 3)
    if not poses:
        state[:3] = scene.middle
        return state, prior
    t = np.array([p[0] for p in poses]) - sight.times[first]
    x = np.array([p[1] for p in poses])
    if len(poses) >= 2:
        fall = x - 0.5 * np.asarray(scene.capture.gravity) * t[:, None] ** 2
        line = np.polyfit(t, fall, 1)
        state[:3], state[7:10] = line[1], line[0]
    else:
        state[:3] = x[0]
    turns = [Rotation.from_matrix(p[2]) for p in poses]
    if alone and len(poses) >= 2:
        spins = [(b * a.inv()).as_rotvec() / (t[i + 1] - t[i]) for i, (a, b) in enumerate(pairwise(turns))]
        spin = np.median(spins, axis=0)
        # Turned back to the start, all frames say where it was turned then.
        back = [Rotation.from_rotvec(-spin * (ti)) * r for ti, r in zip(t, turns, strict=True)]
        start = Rotation.concatenate(back).mean()
        state[10:13] = spin
    else:
        start = turns[0]
    state[3:7] = np.roll(start.as_quat(), 1)
    return state, prior


def used_frames(sight: Sight) -> int:
    """Frames until the body lies still for good: what follows says nothing."""
    seen, count = sight.seen, len(sight.times)
    tail = max(4, count // 12)
    with np.errstate(all="ignore"):
        last = np.nanmean(seen[-tail:], axis=0)
        off = seen - last
        size = np.sqrt(np.nanmean(np.sum(off**2, axis=-1), axis=1))
    limit = 1.7 * sight.sigma * np.sqrt(seen.shape[-1])
    moving = np.flatnonzero(~(size <= limit))
    end = (int(moving[-1]) + 1 if len(moving) else 0) + max(3, count // 40)
    return int(np.clip(end, min(count, 6), count))


def settle(problem: Problem, model: Model, z: Array, states: list[Array], rounds: int) -> list[Array]:
    """``states`` fitted with the numbers ``z`` held."""
    best = problem.evaluate(model, z, states, fixed=True)
    costs = np.array([part.cost for part in best.linear])
    damping = np.full(len(states), 1e-3)
    for number in range(rounds):
        tried = []
        for s, part, d in zip(states, best.linear, damping, strict=True):
            own = reduce_take(part, 0, float(d))[3]
            tried.append(moved(s, own.reshape(-1, 12)))
        new = problem.evaluate(model, z, tried, fixed=True, slopes=number < rounds - 1)
        better = np.array([part.cost for part in new.linear]) < costs
        states = [t if b else s for s, t, b in zip(states, tried, better, strict=True)]
        best.linear = [n if b else o for o, n, b in zip(best.linear, new.linear, better, strict=True)]
        damping = np.where(better, damping / 5, damping * 10)
        before, costs = costs, np.array([part.cost for part in best.linear])
        if (better & (before - costs < SETTLED * np.maximum(costs, 1.0))).all():
            break
    return states


def track(
    scene: Scene, launcher: Launcher, seen: list[Sight], *, model: Model = NOMINAL, z: Array | None = None
) -> list[Take]:
    """Takes with nodes and first states: nominal model, one stretch after the other."""
    numbers = np.zeros(model.size) if z is None else z
    takes = []
    for sight in seen:
        state, prior = first_state(scene, sight)
        takes.append(Take(sight=sight, nodes=[0], states=state[None], end=used_frames(sight), guess=state, prior=prior))
    _set_down(scene, launcher, takes, model, numbers)
    here = [dataclasses.replace(t, states=t.states.copy(), nodes=[0]) for t in takes]
    active = list(range(len(takes)))
    for _ in range(MOST_NODES):
        if not active:
            break
        ends = [takes[i].end for i in active]
        problem = Problem(scene=scene, launcher=launcher, takes=[here[i] for i in active])
        for _ in range(2):
            for k, i in enumerate(active):
                here[i].end = ends[k]
            look = problem.evaluate(model, numbers, [here[i].states for i in active], slopes=False)
            for segment, i in zip(look.segments, active, strict=True):
                here[i].end = _window(here[i], segment.record)
            fitted = settle(problem, model, numbers, [here[i].states for i in active], 4)
            for i, s in zip(active, fitted, strict=True):
                here[i].states = s
        for k, i in enumerate(active):
            here[i].end = ends[k]
        look = problem.evaluate(model, numbers, [here[i].states for i in active], slopes=False)
        going = []
        for segment, i in zip(look.segments, active, strict=True):
            take, node = takes[i], here[i].nodes[0]
            if len(take.states) < len(take.nodes):
                take.states = np.concatenate([take.states, here[i].states])
            else:
                take.states = here[i].states.copy()
            index = _next_node(take.sight.times[node : take.end], segment.record)
            lost = _lost(take.sight, segment)
            if lost is not None and (index is None or lost < index):
                # The model went somewhere else altogether: begin anew where the body is.
                guess, prior = first_state(scene, take.sight, node + lost)
                take.nodes.append(node + lost)
                here[i] = Take(
                    sight=take.sight, nodes=[node + lost], states=guess[None], end=take.end, guess=guess, prior=prior
                )
                going.append(i)
                continue
            if index is None:
                continue
            guess = segment.record[index, :13].copy()
            blow = 0.2 * segment.record[index, 13] + 0.05
            size = scene.body.bound
            prior = np.repeat([0.01, 0.01 / size, blow, blow / size], 3)
            if not take.sight.poses_alone:
                prior[3:6], prior[9:12] = 1e-3, 0.3
            take.nodes.append(node + index)
            here[i] = Take(
                sight=take.sight, nodes=[node + index], states=guess[None], end=take.end, guess=guess, prior=prior
            )
            going.append(i)
        active = going
    for take in takes:
        take.nodes = take.nodes[: len(take.states)]
    return takes


def _set_down(scene: Scene, launcher: Launcher, takes: list[Take], model: Model, z: Array) -> None:
    """Begin on the ground where that explains the first frames better: pixels leave a start's height open."""
    near = []
    for take in takes:
        if take.sight.camera is None:
            continue
        lying = None if model.setting(scene, z).camera is not None else resting_state(scene, take.sight)
        if lying is None:
            near.append(take)
        else:
            take.states, take.guess, take.prior = lying[0][None], lying[0].copy(), lying[1]
    if not near:
        return
    normal, foot = scene.capture.ground.unit_normal, np.asarray(scene.capture.ground.point)
    options = []
    for take in near:
        down = take.states.copy()
        corners = down[0, :3] + scene.body.corners @ to_matrix(down[0, 3:7]).T
        down[0, :3] -= ((corners - foot) @ normal - scene.body.radius).min() * normal
        down[0, 7:10] -= (down[0, 7:10] @ normal) * normal
        end = min(take.end, int(np.searchsorted(take.sight.times - take.sight.times[0], PIXEL_WINDOW)) + 1)
        options += [dataclasses.replace(take, end=end), dataclasses.replace(take, end=end, states=down)]
    problem = Problem(scene=scene, launcher=launcher, takes=options)
    settled = settle(problem, model, z, [t.states for t in options], 6)
    costs = [part.cost for part in problem.evaluate(model, z, settled, slopes=False).linear]
    for k, take in enumerate(near):
        best = 2 * k + int(costs[2 * k + 1] < costs[2 * k])
        take.states = settled[best]
        take.guess = settled[best][0].copy()


def _window(take: Take, record: Array) -> int:
    """Frame after the last to which the state at the node is fitted."""
    node = take.nodes[0]
    times = take.sight.times[node : take.end] - take.sight.times[node]
    touched = record[:, 15] > 0
    first = int(np.argmax(touched)) if touched.any() else len(times)
    flight = PIXEL_WINDOW if take.sight.camera is not None else FLIGHT_WINDOW
    if not take.sight.poses_alone:
        flight = 1e9
    enough = 10 if take.sight.camera is not None else 4
    if first >= enough:
        return node + min(first, int(np.searchsorted(times, flight)) + 1)
    short = max(int(np.searchsorted(times, (2 if take.sight.camera is not None else 1) * CONTACT_WINDOW)) + 1, 5)
    return min(take.end, node + short)


def _lost(sight: Sight, segment: Segment) -> int | None:
    """Frame of ``segment`` from which its residuals are beyond anything that a missing force explains; None if none."""
    seen = np.maximum(np.isfinite(sight.seen[segment.frames]).all(axis=2).sum(axis=1) * sight.seen.shape[2], 1)
    bad = segment.chi2 / seen > LOST**2
    run = bad[:-2] & bad[1:-1] & bad[2:]
    if not run.any():
        return None
    index = max(int(np.argmax(run)), 3)
    return index if index < len(bad) - 3 else None


def _next_node(times: Array, record: Array) -> int | None:
    """Frame of the segment at which the next one begins; None where it lasts to the end."""
    touched = record[:, 15]
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
        # A contact that lasts: soon after it began, then every now and then.
        wait = LONGEST_IMPACT if first > 1 else NODE_EVERY
        index = int(np.searchsorted(times, begins + wait))
    index = max(index, 3)
    return index if index < len(times) - 3 else None


def weigh(problem: Problem, model: Model, z: Array) -> None:
    """Set what the grain makes of every segment of ``problem``, by how ``model`` runs through it."""
    scene = problem.scene
    grain = grain_of(scene.body)
    weight = float(np.linalg.norm(scene.capture.gravity))
    states = [t.states for t in problem.takes]
    look = problem.evaluate(model, z, states, slopes=False)
    for take in problem.takes:
        take.covers, take.weights = [], []
    for segment in look.segments:
        take = problem.takes[segment.take]
        a, b = take.spans[segment.index]
        record = np.concatenate([segment.record, segment.arrival[None]]) if b < take.end else segment.record
        times = take.sight.times[a : a + len(record)]
        take.covers.append(covariance(grain, scene.body, record, times, weight))
        _, _, info = take.sight.information(segment.record[:, :3], segment.record[:, 3:7], segment.frames)
        count = len(segment.frames)
        take.weights.append(frame_weights(grain, scene.body, segment.record, times[:count], weight, info))


def camera_guess(problem: Problem) -> Array:
    """First numbers (6,) of a moved camera: poses from pixels alone, where the body turns round or lies, touch ground.

    The body's height over the ground then should be none; how it is not says how the camera is turned and shifted.
    """
    scene = problem.scene
    camera, body, ground = scene.capture.camera, scene.body, scene.capture.ground
    assert camera is not None
    place, normal, foot = camera.matrix[:3, 3], ground.unit_normal, np.asarray(ground.point)
    rows, values = [], []
    for take in problem.takes:
        if take.sight.trial.predict_times is not None:
            continue
        heights, poses, guess = [], [], None
        for frame in range(len(take.sight.times)):
            found = frame_pose(take.sight, frame, guess)
            if found is None:
                continue
            guess = found
            low = (found[0] - foot + body.corners @ found[1].T) @ normal - body.radius
            heights.append(float(low.min()))
            poses.append(found[0])
        if len(heights) < 8:
            continue
        # The lowest tenth of a take, in the middle of what its noise leaves, is contact.
        count = max(4, len(heights) // 5)
        for k in np.argsort(heights)[count // 4 : count]:
            lever = poses[k] - place
            rows.append(np.concatenate([0.03 * np.cross(lever, normal), 0.02 * normal]))
            values.append(-heights[k])
    if not rows:
        return np.zeros(6)
    matrix, right = np.array(rows) / GUESS_HEIGHT, np.array(values) / GUESS_HEIGHT
    share = 12.0 / max(12.0, len(rows))  # poses of one take err together
    return np.linalg.solve(np.eye(6) + share * matrix.T @ matrix, share * matrix.T @ right)
