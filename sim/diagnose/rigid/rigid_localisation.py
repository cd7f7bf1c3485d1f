# SPDX-License-Identifier: MIT
"""Localisation of the missing force in rigid trials: measured, or as a candidate explains it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture
from ..fits import DIRECTIONS, Discrepancy, PhaseInterval
from .multiple_shooting import Fit
from .observed_poses import CONTACT, QUATERNION, SPIN, TOUCHED, VELOCITY, project
from .quaternions import as_matrix
from .rigid_candidates import BELIEFS
from .rigid_prediction import world_points
from .segment_paths import Model
from .segmented_trial import Segment, SegmentedTrial
from .shooting_problem import Problem
from .world_settings import WorldSettings

Array = NDArray[np.float64]

PARTS = 8
"""Samples of a run per frame."""

SHORTEST = 0.03
"""Half of the shortest time in s over which a force in flight is measured."""
STANDS_OUT = 4.0
"""Standard deviations from which a force counts as seen; 1 in 900 of three components by chance."""

REST_SPEED = 0.02
"""Speed in m/s of the fastest point below which a body is at rest."""


def localise_discrepancies(capture: Capture, bodies: list[tuple[Fit, Fit | None]]) -> dict[str, Discrepancy]:
    """Return the discrepancy by trial. bodies: nominal fit and explaining fit (None: raw measurement) of each."""
    found: dict[str, Discrepancy] = {}
    for trial in capture.trials:
        size = (len(trial.times), len(trial.rest_points))
        points = np.zeros(size)
        residual = np.full(trial.observed.shape, np.nan)
        force = np.zeros((len(trial.times), 3))
        phases: list[str] = ["rest"] * len(trial.times)
        velocity = np.zeros((len(trial.times), 3))
        for nominal, fit in bodies:
            for i, fitted in enumerate(nominal.problem.trials):
                if fitted.observations.trial is not trial:
                    continue
                lack, body_phases, speed = _lack(nominal, fit, i)
                points[:, fitted.observations.columns] = np.linalg.norm(lack, axis=1)[:, None]
                strongest = np.linalg.norm(lack, axis=1) > np.linalg.norm(force, axis=1)
                force = np.where(strongest[:, None], lack, force)
                phases, velocity = body_phases, speed
                modelled = _nominal_points(nominal, i)
                if capture.camera is not None and trial.pixels is not None:
                    modelled = project(capture.camera, modelled)
                residual[:, fitted.observations.columns] = fitted.observations.seen - modelled
        found[trial.name] = Discrepancy(
            frame_score=points.max(axis=1) if points.shape[1] else np.zeros(size[0]),
            point_score=points,
            residual=residual,
            intervals=_intervals(trial.times, phases),
            directions=_directions(force, velocity, np.asarray(capture.gravity), capture.ground.unit_normal, phases),
        )
    return found


def _nominal_points(nominal: Fit, index: int) -> Array:
    problem = nominal.problem
    trial = problem.trials[index]
    state = nominal.states[index][0]
    times = trial.observations.times
    setting = nominal.model.setting(problem.scene, nominal.z)
    record = problem.simulator.run(state[None], problem.scene.numbers([setting]), [times - times[0]])[0]
    return world_points(trial, record[: len(times)])


def _fine(fit: Fit, index: int) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return recorded times (M,), records (M, 17) and nearest frames (M,) of a trial, sampled between frames."""
    problem = fit.problem
    trial, setting = problem.trials[index], fit.model.setting(problem.scene, fit.z)
    times = trial.observations.times
    rows, clocks = [], []
    spans = [*trial.spans[:-1], (trial.nodes[-1], len(times))]
    for a, b in spans:
        last = b if b < len(times) else b - 1
        edges = times[a : last + 1]
        fine = np.unique(
            np.concatenate([np.linspace(s, e, PARTS, endpoint=False) for s, e in pairwise(edges)] + [edges[-1:]])
        )
        clocks.append(fine)
    starts = fit.states[index]
    table = np.repeat(problem.scene.numbers([setting]), len(spans), axis=0)
    out = problem.simulator.run(starts, table, [(c - c[0]) * setting.rate for c in clocks])
    for record, clock in zip(out, clocks, strict=True):
        rows.append(record[: len(clock)])
    clock = np.concatenate(clocks)
    middle = 0.5 * (times[1:] + times[:-1])
    return clock, np.concatenate(rows), np.searchsorted(middle, clock)


def _lack(nominal: Fit, fit: Fit | None, index: int) -> tuple[Array, list[str], Array]:
    """Return missing force per mass (T, 3), phase of every frame and velocity (T, 3)."""
    used = nominal if fit is None else fit
    trial, scene = used.problem.trials[index], used.problem.scene
    frames = len(trial.observations.times)
    clock, record, nearest = _fine(used, index)
    normal = scene.capture.ground.unit_normal
    gains = np.maximum(np.diff(record[:, CONTACT], axis=0, append=record[-1:, CONTACT]), 0.0)
    gains[np.diff(clock, append=clock[-1]) <= 0] = 0.0
    velocity = _by_frame(record[:, VELOCITY], nearest, frames)
    spin = _by_frame(record[:, SPIN], nearest, frames)
    pushed = _summed(gains[:, 0], nearest, frames)
    touched = _summed(gains[:, 2], nearest, frames)
    slid = _summed(gains[:, 3], nearest, frames)
    spacing = np.gradient(trial.observations.times)
    weight = float(np.linalg.norm(scene.capture.gravity))
    speed = np.linalg.norm(velocity, axis=1) + np.linalg.norm(spin, axis=1) * scene.body.bound
    blow = pushed - weight * touched
    phases = []
    for f in range(frames):
        if touched[f] <= 0:
            phases.append("flight")
        elif speed[f] < REST_SPEED:
            phases.append("rest")
        else:
            phases.append("impact" if blow[f] > 0.05 else "contact")
    lack = np.zeros((frames, 3))

    if fit is None:
        return measured_force(nominal, index), phases, velocity
    base = Model(candidates=()).setting(scene, fit.z[: BELIEFS.size])
    setting = fit.model.setting(scene, fit.z)
    lack += _by_frame(_force_difference(base, setting, record), nearest, frames)
    rate = pushed / spacing
    if setting.friction != base.friction:
        way = velocity - (velocity @ normal)[:, None] * normal
        way /= np.linalg.norm(way, axis=1, keepdims=True) + 1e-9
        moving = (touched > 0) & (speed >= REST_SPEED)
        share = np.where(moving, slid / np.maximum(touched, 1e-9), 0.0)
        lack += ((base.friction - setting.friction) * rate * share)[:, None] * way
    if setting.restitution != base.restitution:
        lack += np.where(blow > 0.01, (setting.restitution - base.restitution) * blow / spacing, 0.0)[:, None] * normal
    if setting.rolling > 0:
        way = velocity / (np.linalg.norm(velocity, axis=1, keepdims=True) + 1e-9)
        lack -= (setting.rolling / scene.body.bound * rate)[:, None] * way
    if setting.pull > 0:
        gap = _gap(used.problem, record)
        # A body at rest is held, too, but its jitter is no separation: where it leaves faster is where that matters.
        away = np.maximum(record[:, VELOCITY] @ normal, 0.0)
        held = (gap < setting.reach) * away / (away + REST_SPEED) * (1 - np.maximum(gap, 0.0) / setting.reach)
        lack -= (_by_frame(held[:, None], nearest, frames) * setting.pull) * normal
    if setting.fraction > 0:
        arm = np.einsum("fij,j->fi", as_matrix(record[:, QUATERNION]), setting.center)
        w = record[:, SPIN]
        lack += _by_frame(np.cross(w, np.cross(w, arm)), nearest, frames)
    if setting.inertia != 1.0:
        turning = _turning_difference(used.problem, setting, clock, record, gains[:, 2] > 0)
        lack += np.stack([_summed(t, nearest, frames) for t in turning.T], axis=1) / spacing[:, None]
    if setting.rate != 1.0:
        lack += (setting.rate**2 - 1) * np.asarray(scene.capture.gravity)
    if setting.camera is not None:
        lack += np.linalg.norm(setting.camera[0] - np.eye(3)) * weight * normal
    return lack, phases, velocity


def _force_difference(base: WorldSettings, setting: WorldSettings, record: Array) -> Array:
    """Return the force per mass (M, 3) of ``setting`` minus ``base`` at the states of ``record``."""
    x, v, w = record[:, :3], record[:, VELOCITY], record[:, SPIN]
    u = v - setting.wind
    force = -setting.drag * np.linalg.norm(u, axis=1, keepdims=True) * u + setting.lift * np.cross(w, u)
    force = force + (setting.gravity - base.gravity)
    if setting.tether is not None:
        stiffness, length, anchor = setting.tether
        way = anchor - x
        distance = np.linalg.norm(way, axis=1, keepdims=True)
        force = force + stiffness * np.maximum(distance - length, 0.0) * way / np.maximum(distance, 1e-9)
    return np.asarray(force)


def _turning_difference(
    problem: Problem, setting: WorldSettings, clock: Array, record: Array, touching: NDArray[np.bool_]
) -> Array:
    """Return the change of velocity (M, 3) in m/s, up to the next time of ``clock`` (M,), of the lowest point of a
    body that the ground turns with the inertia of ``setting``, minus that with the believed one. Nothing else turns it
    otherwise, so this is zero where it is not ``touching`` (M,).
    """
    turns = as_matrix(record[:, QUATERNION])
    tensor = turns @ problem.scene.body.inertia @ np.swapaxes(turns, 1, 2)
    momentum = np.einsum("mij,mj->mi", tensor, record[:, SPIN])
    gained = np.diff(momentum, axis=0, append=momentum[-1:])
    gained[~touching | (np.diff(clock, append=clock[-1]) <= 0)] = 0.0
    # The believed body gets the same angular momentum, which turns it as many times faster as its inertia is smaller.
    spin = (1 - setting.inertia) * np.linalg.solve(tensor, gained[:, :, None])[:, :, 0]
    return np.cross(spin, _lowest(problem, record))


def _lowest(problem: Problem, record: Array) -> Array:
    """Return the way (M, 3) in m from the reference point to the point of the body nearest to the ground."""
    body, normal = problem.scene.body, problem.scene.capture.ground.unit_normal
    corners = np.einsum("mij,kj->mki", as_matrix(record[:, QUATERNION]), body.corners)
    nearest = np.argmin(corners @ normal, axis=1)
    return np.asarray(corners[np.arange(len(corners)), nearest] - body.radius * normal)


def _gap(problem: Problem, record: Array) -> Array:
    """Return the distance (M,) of the body to the ground."""
    ground = problem.scene.capture.ground
    feet = record[:, :3] + _lowest(problem, record)
    return np.asarray((feet - np.asarray(ground.point)) @ ground.unit_normal)


def measured_force(fit: Fit, index: int) -> Array:
    """Return the measured missing force per mass (T, 3): residual curvature in flight, defects in contact.

    The expected contribution of noise is subtracted.
    """
    problem = fit.problem
    trial = problem.trials[index]
    times = trial.observations.times
    lack = np.zeros((len(times), 3))
    setting = fit.model.setting(problem.scene, fit.z)
    for segment in fit.evaluation.segments:
        if segment.trial != index:
            continue
        free = np.flatnonzero(segment.record[:, TOUCHED] <= 0)
        if len(free) >= 6:
            lack[segment.frames[free]] = _curvature(problem, trial, segment, free, setting)
        if segment.defect is not None:
            deviation = np.sqrt(np.diag(trial.covers[segment.index])[6:9])
            jump = segment.defect[6:9]
            size = float(np.linalg.norm(jump / deviation))
            jump = -jump * max(0.0, 1 - 2.5 / max(size, 1e-9))
            touching = segment.frames[np.diff(segment.record[:, TOUCHED], prepend=0.0) > 0]
            if len(touching):
                span = max(times[touching[-1]] - times[max(touching[0] - 1, 0)], 1e-3)
                lack[touching] += jump / span
    return lack


def _curvature(
    problem: Problem, trial: SegmentedTrial, segment: Segment, free: NDArray[np.int64], setting: WorldSettings
) -> Array:
    """Return the missing force per mass (F, 3) at the frames ``free`` of flight.

    Each is measured over the shortest time around its frame in which it stands out from the noise, the whole flight if
    it never does: a gust is placed to a few frames, and a small steady force, which no few frames show, is not lost.
    """
    frames = segment.frames[free]
    pose = problem.seen_poses(segment.record[None, free], [setting])[0]
    _, slope, info = trial.observations.information(pose[:, :3], pose[:, QUATERNION], frames)
    t = trial.observations.times[frames]
    found = np.zeros((len(frames), 3))
    for k in range(len(frames)):
        half = SHORTEST
        while True:
            near = np.flatnonzero(np.abs(t - t[k]) <= half)
            half *= 1.5
            if len(near) < min(5, len(frames)):
                continue
            force, size = _force_over(t[near] - t[k], slope[near], info[near])
            if size > STANDS_OUT or len(near) == len(frames):
                break
        found[k] = force * max(0.0, 1 - 2.0 / max(size, 1e-9))
    return found


def _force_over(since: Array, slope: Array, info: Array) -> tuple[Array, float]:
    """Return the force per mass (3,) that bends the path of a body over the times ``since`` (F,) s from where it is
    wanted, and its size in standard deviations. slope: (F, 6), info: (F, 6, 6) of the frames' likelihood."""
    basis = np.stack([np.ones_like(since), since, 0.5 * since**2], axis=1)
    matrix = np.einsum("fa,fij,fb->aibj", basis, info, basis).reshape(18, 18)
    pull = np.einsum("fa,fi->ai", basis, slope).ravel()
    cover = np.linalg.pinv(matrix + 1e-9 * np.trace(matrix) / 18 * np.eye(18))
    force = (cover @ pull)[12:15]
    return force, float(np.sqrt(max(force @ np.linalg.pinv(cover[12:15, 12:15]) @ force, 0.0)))


def _summed(values: Array, nearest: NDArray[np.int64], frames: int) -> Array:
    return np.bincount(nearest, weights=values, minlength=frames)[:frames]


def _by_frame(values: NDArray[np.floating], nearest: NDArray[np.int64], frames: int) -> Array:
    count = np.maximum(np.bincount(nearest, minlength=frames)[:frames], 1)
    return np.stack([_summed(v, nearest, frames) / count for v in values.T], axis=1)


def _intervals(times: Array, phases: list[str]) -> tuple[PhaseInterval, ...]:
    found, begin = [], 0
    for f in range(1, len(phases) + 1):
        if f == len(phases) or phases[f] != phases[begin]:
            end = times[min(f, len(times) - 1)]
            found.append(PhaseInterval(start_s=float(times[begin]), end_s=float(end), phase=phases[begin]))
            begin = f
    return tuple(found)


def _directions(force: Array, velocity: Array, gravity: Array, normal: Array, phases: list[str]) -> dict[str, float]:
    """Return shares of the squared force (F, 3) by direction: assigned to the nearest axis within 45 degrees.

    On level ground its normal is upright, too: what acts there is the ground's in frames of contact, gravity's else.
    """
    size = np.linalg.norm(force, axis=1)
    shares = dict.fromkeys(DIRECTIONS, 0.0)
    total = float(np.sum(size**2))
    if total <= 0:
        return {**shares, "other": 1.0}
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    along_v = np.abs(np.sum(force * velocity / np.maximum(speed, 1e-6), axis=1)) / np.maximum(size, 1e-12)
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-9)
    along_g = np.abs(force @ down) / np.maximum(size, 1e-12)
    along_n = np.abs(force @ normal) / np.maximum(size, 1e-12)
    for f in range(len(force)):
        ground = along_n[f] + (-1e-6 if phases[f] == "flight" else 1e-6)
        best = {"along_velocity": along_v[f], "along_gravity": along_g[f], "normal": ground}
        name = max(best, key=lambda k: best[k])
        shares[name if best[name] > 0.7 else "other"] += float(size[f] ** 2) / total
    return shares
