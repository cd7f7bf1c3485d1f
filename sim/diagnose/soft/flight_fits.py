# SPDX-License-Identifier: MIT
"""Trials of a soft body in the ground's frame, their flights, and effects fitted to the flights of all trials."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...rigid_alignment import nearest_pose
from ..capture import Capture, Trial
from .free_flight import FlightFit, FlightFrames, Inertia, State, first_guess, fit_flight, simulate_flight
from .soft_candidates import Candidate, WorldParameters
from .soft_simulator import SimulationJob, SoftWorlds, is_plausible

Array = NDArray[np.float64]

CLEAR = 1e-3
"""Height in m above the ground from which a body counts as flying; tracking noise is below it."""

SEARCH = 1e-3
"""Step in s of the search for the first contact."""


class GroundFrame:
    """Transform from the world to the ground frame: origin in the plane, +z its normal."""

    def __init__(self, capture: Capture) -> None:
        z = capture.ground.unit_normal
        if z[2] > 1 - 1e-12:
            self.turn = np.eye(3)
        else:
            x = np.cross(z, [0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0])
            x /= np.linalg.norm(x)
            self.turn = np.stack([x, np.cross(z, x), z])
        self.origin = np.asarray(capture.ground.point, dtype=np.float64)

    def to(self, points: Array) -> Array:
        """Return world points (..., 3) in the ground's frame."""
        return np.asarray((points - self.origin) @ self.turn.T)

    def back(self, points: Array) -> Array:
        """Return points (..., 3) of the ground's frame in the world."""
        return np.asarray(points @ self.turn + self.origin)

    def direction(self, v: Array) -> Array:
        """Return world vectors (..., 3) in the ground's frame."""
        return np.asarray(v @ self.turn.T)


@dataclass(frozen=True, kw_only=True)
class SoftTrial:
    """A trial in the ground's frame; the first ``flying`` frames are before any contact."""

    name: str
    role: str
    times: Array
    points: Array
    rest: Array
    flying: int
    predict_times: Array | None

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Return visibility (T, K)."""
        return np.asarray(np.isfinite(self.points).all(axis=2))

    @property
    def asked(self) -> Array:
        """Return the frames' times and those to be predicted."""
        return self.times if self.predict_times is None else np.concatenate([self.times, self.predict_times])


def soft_trial(trial: Trial, frame: GroundFrame, nodes: Array) -> SoftTrial:
    """Return ``trial`` with its flight: leading frames whose rigid pose keeps all ``nodes`` (N, 3) in the air."""
    assert trial.points is not None
    points = frame.to(trial.points)
    flying = 0
    for seen in points:
        there = np.isfinite(seen).all(axis=1)
        if there.sum() >= 3:
            turn, shift = nearest_pose(trial.rest_points[there], seen[there])
            if float((nodes @ turn[2]).min() + shift[2]) < CLEAR:
                break
        flying += 1
    return SoftTrial(
        name=trial.name,
        role=trial.role,
        times=trial.times,
        points=points,
        rest=trial.rest_points,
        flying=max(flying, min(3, len(points))),
        predict_times=trial.predict_times,
    )


class Flights:
    """Cached flight fits of all trials by world parameters. sigma: noise of a coordinate in m."""

    def __init__(self, trials: list[SoftTrial], worlds: SoftWorlds, sigma: float) -> None:
        self.trials, self._worlds, self.sigma = trials, worlds, sigma
        self._fits: dict[tuple[object, ...], FlightFit] = {}
        self._flights: dict[int, FlightFrames] = {}
        self._starts: dict[tuple[object, ...], State | None] = {}
        self._last: dict[int, tuple[State, Inertia]] = {}
        self._lasting: dict[tuple[int, WorldParameters, bytes], Array] = {}

    def flight(self, index: int) -> FlightFrames:
        """Return the flying frames of trial ``index``."""
        if index not in self._flights:
            trial, n = self.trials[index], self.trials[index].flying
            self._flights[index] = FlightFrames.of(trial.times[:n], trial.rest, trial.points[:n], self.sigma)
        return self._flights[index]

    def fit(self, index: int, world: WorldParameters) -> FlightFit:
        """Return the flight fit of trial ``index``: state at its first frame, in true time from there."""
        key = (index, *world.flight)
        if key not in self._fits:
            trial, inertia = self.trials[index], self._worlds.inertia_of(world)
            n = trial.flying
            known = self._last.get(index)
            if known is None:
                state = first_guess(trial.times[:n], trial.rest, trial.points[:n], inertia, np.asarray(world.gravity))
            else:
                state = self.as_seen(known[0], known[1], inertia)
            found = fit_flight(state, inertia, world, self.flight(index))
            self._last.setdefault(index, (found.state, inertia))
            self._fits[key] = found
        return self._fits[key]

    def inertia(self, world: WorldParameters) -> Inertia:
        """Return the inertia of the body under ``world``."""
        return self._worlds.inertia_of(world)

    @staticmethod
    def as_seen(state: State, inertia: Inertia, other: Inertia) -> State:
        """Return the same motion expressed about the centre of mass of ``other``."""
        away = other.centre - inertia.centre
        return dataclasses.replace(
            state,
            place=state.place + state.turn @ away,
            velocity=state.velocity + np.cross(state.spin, state.turn @ away),
        )

    def true_times(self, index: int, world: WorldParameters, times: Array) -> Array:
        """Return true times for recorded ``times`` of trial ``index``, equal at its first frame."""
        first = self.trials[index].times[0]
        return np.asarray(first + world.rate * (times - first))

    def start(self, index: int, world: WorldParameters) -> State | None:
        """Return the rigid state just before first contact, in true time; None without contact."""
        key = (index, *world.flight)
        if key not in self._starts:
            trial, inertia = self.trials[index], self._worlds.inertia_of(world)
            first = self.fit(index, world).state
            ends = self.true_times(index, world, trial.asked[[max(0, trial.flying - 3), -1]])
            grid = np.arange(max(ends[0], first.time), ends[1] + SEARCH, SEARCH)
            place, velocity, turn, spin = (a[0] for a in simulate_flight([first], [inertia], [world], grid[None]))
            rest = self._worlds.mesh.nodes - inertia.centre
            low = (turn[:, 2] @ rest.T).min(axis=1) + place[:, 2]
            touching = np.flatnonzero(low < 0)
            if len(touching) == 0:
                self._starts[key] = None
            else:
                i = max(0, int(touching[0]) - 1)
                self._starts[key] = State(
                    time=float(grid[i]), place=place[i], velocity=velocity[i], turn=turn[i], spin=spin[i]
                )
        return self._starts[key]

    def in_air(self, index: int, world: WorldParameters, times: Array) -> Array:
        """Return tracked points (T, K, 3) at recorded ``times`` in unobstructed flight."""
        inertia = self._worlds.inertia_of(world)
        first = self.fit(index, world).state
        place, _, turn, _ = (
            a[0] for a in simulate_flight([first], [inertia], [world], self.true_times(index, world, times)[None])
        )
        rest = self.trials[index].rest - inertia.centre
        return np.asarray(np.einsum("tij,kj->tki", turn, rest) + place[:, None])

    def job(self, index: int, world: WorldParameters, times: Array) -> SimulationJob | None:
        """Return the simulation of trial ``index`` from first contact to later ``times``; None without any."""
        start = self.start(index, world)
        if start is None:
            return None
        true = self.true_times(index, world, times)
        true = true[true > start.time + 1e-9]
        return SimulationJob(start=start, world=world, times=true) if len(true) else None

    def motion(self, indices: list[int], world: list[WorldParameters], times: list[Array]) -> list[Array]:
        """Return tracked points (T, K, 3) of trials ``indices`` at recorded ``times``, in flight and after contact."""
        jobs = [self.job(i, a, t) for i, a, t in zip(indices, world, times, strict=True)]
        found, _ = self._worlds.run([j for j in jobs if j is not None])
        after = iter(found)
        out = []
        for i, a, t, job in zip(indices, world, times, jobs, strict=True):
            tail = next(after) if job is not None else np.zeros((0, len(self.trials[i].rest), 3))
            ahead = len(t) - len(tail)
            head = self.in_air(i, a, t[:ahead]) if ahead else tail[:0]
            out.append(np.concatenate([head, tail]))
        return out

    def lasting_motion(self, indices: list[int], world: list[WorldParameters], times: list[Array]) -> list[Array]:
        """Return as ``motion``; where a simulation fails, the body continues as a rigid one stopped by the ground."""
        # Believed and found motions are asked for by scores, curves and localisation.
        keys = [(i, a, t.tobytes()) for i, a, t in zip(indices, world, times, strict=True)]
        new = [n for n, key in enumerate(keys) if key not in self._lasting and key not in keys[:n]]
        found = self.motion([indices[n] for n in new], [world[n] for n in new], [times[n] for n in new])
        for n, points in zip(new, found, strict=True):
            stopped = not is_plausible(points)
            self._lasting[keys[n]] = self._stopped(indices[n], world[n], times[n]) if stopped else points
        return [self._lasting[key] for key in keys]

    def _stopped(self, index: int, world: WorldParameters, times: Array) -> Array:
        """Return points (T, K, 3) of a flight under ``world``, lifted wherever the body would penetrate the ground."""
        points = self.in_air(index, world, times)
        depth = np.maximum(0.0, -points[:, :, 2].min(axis=1))
        points[:, :, 2] += depth[:, None]
        start = self.start(index, world)
        if start is not None:
            # After contact it rests: no sliding along the ground.
            touched = int(np.searchsorted(self.true_times(index, world, times), start.time))
            points[touched:] = points[min(touched, len(points) - 1)]
        return points


ITERATIONS = 6

QUIET = 4.0
"""Excess of the nominal flights' chi² in standard deviations up to which one start suffices."""


@dataclass(frozen=True, kw_only=True)
class FlightEstimate:
    """Estimate from the flights. free: (p,) best parameters. chi2: (trials,) there.

    gradients (trials, p) and curvatures (trials, p, p): gradient and negative Hessian of -chi2 / 2 there.
    """

    free: Array
    chi2: Array
    gradients: Array
    curvatures: Array

    def chi2_at(self, free: Array) -> Array:
        """Return chi² (trials,) to second order."""
        d = free - self.free
        return np.asarray(self.chi2 - 2 * self.gradients @ d + np.einsum("i,kij,j->k", d, self.curvatures, d))


def fit_in_flight(flights: Flights, trials: list[int], base: WorldParameters, candidate: Candidate) -> FlightEstimate:
    """Return the best maximum a posteriori estimate of ``candidate``, by Gauss–Newton from every start."""
    best: tuple[float, FlightEstimate] | None = None
    nominal = [flights.fit(index, base) for index in trials]
    count = sum(fit.count for fit in nominal)
    quiet = sum(fit.chi2 for fit in nominal) < count + QUIET * np.sqrt(2.0 * count)
    for start in candidate.starts[:1] if quiet else candidate.starts:
        found = _descend(flights, trials, base, candidate, start)
        z = (found.free - candidate.mean) / candidate.spread
        value = float(found.chi2.sum() + z @ z)
        if np.isfinite(value) and (best is None or value < best[0]):
            best = value, found
    assert best is not None
    return best[1]


def _descend(
    flights: Flights, trials: list[int], base: WorldParameters, candidate: Candidate, free: Array
) -> FlightEstimate:
    weight = np.diag(candidate.spread**-2.0)
    here = _look(flights, trials, base, candidate, free)
    damping = 1e-3
    for _ in range(ITERATIONS):
        curvature = here.curvatures.sum(axis=0) + weight
        gradient = here.gradients.sum(axis=0) - weight @ (here.free - candidate.mean)
        step = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), gradient)
        free = np.clip(
            here.free + np.clip(step, -1.5 * candidate.spread, 1.5 * candidate.spread), candidate.low, candidate.high
        )
        there = _look(flights, trials, base, candidate, free)
        if _cost(there, candidate) > _cost(here, candidate) or not np.isfinite(there.chi2).all():
            damping = max(10 * damping, 0.3)
            continue
        gain = _cost(here, candidate) - _cost(there, candidate)
        here, damping = there, 0.1 * damping
        if gain < 0.05:
            break
    return here


def _cost(found: FlightEstimate, candidate: Candidate) -> float:
    z = (found.free - candidate.mean) / candidate.spread
    return float(found.chi2.sum() + z @ z)


def _look(
    flights: Flights, trials: list[int], base: WorldParameters, candidate: Candidate, free: Array
) -> FlightEstimate:
    """Return the state fits at ``free`` and the jacobians of their residuals with respect to ``free``."""
    world = candidate.world(base, free)
    varied = [candidate.world(base, free + d) for d in np.diag(candidate.step)]
    chi2, gradients, curvatures = [], [], []
    for index in trials:
        fit = flights.fit(index, world)
        inertia = [flights.inertia(a) for a in (world, *varied)]
        # A different centre of mass changes position and velocity of the same motion.
        states = [flights.as_seen(fit.state, inertia[0], other) for other in inertia]
        found = flights.flight(index).residuals(states, inertia, [world, *varied])
        jacobian = -(found[1:] - found[0]).T / candidate.step
        jacobian -= fit.projector @ (fit.projector.T @ jacobian)
        chi2.append(fit.chi2)
        gradients.append(jacobian.T @ found[0])
        curvatures.append(jacobian.T @ jacobian)
    return FlightEstimate(
        free=free, chi2=np.array(chi2), gradients=np.array(gradients), curvatures=np.array(curvatures)
    )
