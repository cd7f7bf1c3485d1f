# SPDX-License-Identifier: MIT
"""Where the nominal model lacks a force: per frame and point, as a candidate explains it or as the tracks show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..analysis import DIRECTIONS, Discrepancy, Interval
from .laws import Laws
from .takes import Flights, Take
from .worlds import Job, SoftWorlds, sane

Array = NDArray[np.float64]

TOUCHING = 2e-3
"""Height in metres of the lowest point below which a body counts as touching."""

IMPACT_S = 0.03
"""How long after a first touch it is an impact; what lasts longer is contact."""

STILL = 0.05
"""m/s below which it rests."""


def discrepancy_of(
    flights: Flights, worlds: SoftWorlds, laws: Laws, base: Laws, nominal: dict[str, Array]
) -> dict[str, Discrepancy]:
    """By take: the inner forces, and those from outside, that ``laws`` have and ``base`` lacks, at their own states."""
    out = {}
    for index, take in enumerate(flights.takes):
        frames, count = len(take.times), len(take.rest)
        forces = np.zeros((frames, count, 3))
        air = flights.in_air(index, laws, take.times)
        whole = air.copy()
        low = np.full(frames, np.inf)
        start, history = flights.start(index, laws), None
        true = flights.true_times(index, laws, take.times)
        if start is not None and true[-1] > start.time:
            after = true > start.time + 1e-9
            times = np.append(true[after], true[-1] + 1e-4)
            points, (history,) = worlds.run([Job(start=start, laws=laws, times=times)], keep=True)
        if history is not None and sane(points[0]):
            places = history.places[:-1]
            lacking = history.accelerations[:-1] - worlds.inner_accelerations(places, base)
            lacking += worlds.contact_difference(places, history.places, times, laws, base)
            lacking = worlds.smoothed(lacking)
            forces[after] = np.einsum("kj,tkji->tki", worlds.weights, lacking[:, worlds.holders])
            whole[after] = points[0][:-1]
            low[after] = places[:, :, 2].min(axis=1)
        forces += _outside(take, whole, low, laws, base)[:, None]
        out[take.name] = _discrepancy(take, forces, whole, nominal[take.name], low)
    return out


def raw_discrepancy(take: Take, nominal: Array, flights: Flights, index: int, base: Laws) -> Discrepancy:
    """From the tracks alone: second differences of observed minus nominal, less what noise alone would give."""
    residual = take.points - nominal
    frames = len(take.times)
    forces = np.full(residual.shape, np.nan)
    half = 2 if frames >= 5 else 1
    if frames >= 2 * half + 1:
        step = np.median(np.diff(take.times)) * half
        second = (residual[2 * half :] - 2 * residual[half:-half] + residual[: -2 * half]) / step**2
        forces[half:-half] = second
        noise = np.sqrt(6) * flights.sigma / step**2
        size = np.linalg.norm(second, axis=2, keepdims=True)
        forces[half:-half] *= np.sqrt(np.maximum(0.0, 1 - 3 * noise**2 / np.maximum(size, 1e-12) ** 2))
    turn_low = np.where(take.seen, np.nan_to_num(take.points[:, :, 2], nan=np.inf), np.inf).min(axis=1)
    return _discrepancy(take, np.nan_to_num(forces), nominal, nominal, turn_low)


def _outside(take: Take, whole: Array, low: Array, laws: Laws, base: Laws) -> Array:
    """(T, 3) m/s² on the body as a whole that ``laws`` have and ``base`` lacks."""
    centre = whole.mean(axis=1)
    velocity = np.gradient(centre, take.times, axis=0) if len(take.times) > 2 else np.zeros_like(centre)
    force = np.tile(np.asarray(laws.gravity) - np.asarray(base.gravity), (len(centre), 1))
    past = velocity - np.asarray(laws.wind)
    force -= laws.drag * np.linalg.norm(past, axis=1, keepdims=True) * past
    if laws.tether_stiffness:
        away = np.asarray(laws.tether_anchor) - centre
        length = np.linalg.norm(away, axis=1, keepdims=True)
        pull = laws.tether_stiffness * (length - laws.tether_length)
        force += (np.maximum(pull, 0.0) if laws.tether_string else pull) * away / np.maximum(length, 1e-9)
    if laws.lift:
        force += laws.lift * np.cross(_spin(take, whole), past)
    if laws.adhesion:
        force[low < laws.reach, 2] -= laws.adhesion
    if laws.rate != 1:
        force += (laws.rate**2 - 1) * np.asarray(base.gravity)
    if laws.fraction:
        arm = laws.fraction * float(np.linalg.norm(laws.offset))
        force[:, 2] += arm * (_spin(take, whole) ** 2).sum(axis=1)
    return force


def _spin(take: Take, whole: Array) -> Array:
    """(T, 3) rad/s of the points as a whole."""
    r = whole - whole.mean(axis=1, keepdims=True)
    v = np.gradient(r, take.times, axis=0) if len(take.times) > 2 else np.zeros_like(r)
    momentum = np.cross(r, v).sum(axis=1)
    inertia = np.einsum("tki,tki->t", r, r)[:, None, None] * np.eye(3) - np.einsum("tki,tkj->tij", r, r)
    return np.asarray(np.linalg.solve(inertia, momentum[:, :, None])[:, :, 0])


def _discrepancy(take: Take, forces: Array, motion: Array, nominal: Array, low: Array) -> Discrepancy:
    point = np.linalg.norm(forces, axis=2)
    frame = np.sqrt((point**2).mean(axis=1))
    velocity = np.gradient(motion.mean(axis=1), take.times, axis=0) if len(take.times) > 2 else np.zeros((len(low), 3))
    return Discrepancy(
        frame_score=frame,
        point_score=point,
        residual=take.points - nominal,
        intervals=_intervals(take.times, low < TOUCHING, np.linalg.norm(velocity, axis=1)),
        directions=_directions(forces, velocity),
    )


def _directions(forces: Array, velocity: Array) -> dict[str, float]:
    """How forces (T, K, 3) point: along the ground's normal (gravity's direction too), the velocity, neither."""
    total = float((forces**2).sum())
    if total <= 0:
        return {"normal": 0.0, "along_velocity": 0.0, "along_gravity": 0.0, "other": 1.0}
    upright = float((forces[:, :, 2] ** 2).sum()) / total
    level = velocity * np.array([1.0, 1.0, 0.0])
    way = level / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    along = float((np.einsum("tki,ti->tk", forces, way) ** 2).sum()) / total
    shares = {"normal": upright, "along_velocity": along, "along_gravity": 0.0}
    return {name: shares.get(name, max(0.0, 1 - upright - along)) for name in DIRECTIONS}


def _intervals(times: Array, touching: NDArray[np.bool_], speed: Array) -> tuple[Interval, ...]:
    phases: list[str] = []
    since = -np.inf
    for i, time in enumerate(times):
        if not touching[i]:
            phases.append("flight")
            since = -np.inf
            continue
        since = time if since == -np.inf else since
        phases.append("impact" if time - since < IMPACT_S else "rest" if speed[i] < STILL else "contact")
    out: list[Interval] = []
    begin = 0
    for i in range(1, len(times) + 1):
        if i == len(times) or phases[i] != phases[begin]:
            end = times[min(i, len(times) - 1)]
            out.append(Interval(start_s=float(times[begin]), end_s=float(end), phase=phases[begin]))
            begin = i
    return tuple(out)
