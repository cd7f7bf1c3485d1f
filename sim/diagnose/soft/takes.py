# SPDX-License-Identifier: MIT
"""The takes of a soft body in the ground's frame, their flights, and the worlds that begin where a flight ends."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..capture import Capture, Trial
from ..rotation import nearest_pose
from .flight import Flight, FlightFit, Inertia, State, first_guess, fit_flight, fly
from .laws import Laws
from .worlds import Job, SoftWorlds, sane

Array = NDArray[np.float64]

CLEAR = 1e-3
"""Height in metres above the ground from which a body counts as flying: tracked noise is below it."""

SEARCH = 1e-3
"""Steps in s in which the first contact is looked for."""


class GroundFrame:
    """World to ground: the origin in the plane, +z its normal."""

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
        """World points (..., 3) in the ground's frame."""
        return np.asarray((points - self.origin) @ self.turn.T)

    def back(self, points: Array) -> Array:
        """Points (..., 3) of the ground's frame in the world."""
        return np.asarray(points @ self.turn + self.origin)

    def direction(self, v: Array) -> Array:
        """World vectors (..., 3) in the ground's frame."""
        return np.asarray(v @ self.turn.T)


@dataclass(frozen=True, kw_only=True)
class Take:
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
        """(T, K)."""
        return np.asarray(np.isfinite(self.points).all(axis=2))

    @property
    def asked(self) -> Array:
        """The frames' times and those to be predicted."""
        return self.times if self.predict_times is None else np.concatenate([self.times, self.predict_times])


def take_of(trial: Trial, frame: GroundFrame, nodes: Array) -> Take:
    """``trial``, with its flight found: leading frames whose rigid pose leaves all of ``nodes`` (N, 3) in the air."""
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
    return Take(
        name=trial.name,
        role=trial.role,
        times=trial.times,
        points=points,
        rest=trial.rest_points,
        flying=max(flying, min(3, len(points))),
        predict_times=trial.predict_times,
    )


class Flights:
    """Flight fits of all takes under any laws, each done once. sigma: noise of a coordinate in m."""

    def __init__(self, takes: list[Take], worlds: SoftWorlds, sigma: float) -> None:
        self.takes, self._worlds, self.sigma = takes, worlds, sigma
        self._fits: dict[tuple[object, ...], FlightFit] = {}
        self._flights: dict[int, Flight] = {}
        self._starts: dict[tuple[object, ...], State | None] = {}
        self._last: dict[int, tuple[State, Inertia]] = {}

    def flight(self, index: int) -> Flight:
        """The flying frames of take ``index``."""
        if index not in self._flights:
            take, n = self.takes[index], self.takes[index].flying
            self._flights[index] = Flight.of(take.times[:n], take.rest, take.points[:n], self.sigma)
        return self._flights[index]

    def fit(self, index: int, laws: Laws) -> FlightFit:
        """Of take ``index``; state at its first frame, in true time counted from there."""
        key = (index, *laws.flight)
        if key not in self._fits:
            take, inertia = self.takes[index], self._worlds.inertia_of(laws)
            n = take.flying
            known = self._last.get(index)
            if known is None:
                state = first_guess(take.times[:n], take.rest, take.points[:n], inertia, np.asarray(laws.gravity))
            else:
                state = self.as_seen(known[0], known[1], inertia)
            found = fit_flight(state, inertia, laws, self.flight(index))
            self._last.setdefault(index, (found.state, inertia))
            self._fits[key] = found
        return self._fits[key]

    def inertia(self, laws: Laws) -> Inertia:
        """Of the body under ``laws``."""
        return self._worlds.inertia_of(laws)

    @staticmethod
    def as_seen(state: State, inertia: Inertia, other: Inertia) -> State:
        """The same motion of the body's matter, told of the centre of mass of ``other``."""
        away = other.centre - inertia.centre
        return dataclasses.replace(
            state,
            place=state.place + state.turn @ away,
            velocity=state.velocity + np.cross(state.spin, state.turn @ away),
        )

    def true_times(self, index: int, laws: Laws, times: Array) -> Array:
        """Recorded to true times of take ``index``, equal at its first frame."""
        first = self.takes[index].times[0]
        return np.asarray(first + laws.rate * (times - first))

    def start(self, index: int, laws: Laws) -> State | None:
        """The rigid state just before the body first touches, in true time; None where it never does."""
        key = (index, *laws.flight)
        if key not in self._starts:
            take, inertia = self.takes[index], self._worlds.inertia_of(laws)
            first = self.fit(index, laws).state
            ends = self.true_times(index, laws, take.asked[[max(0, take.flying - 3), -1]])
            grid = np.arange(max(ends[0], first.time), ends[1] + SEARCH, SEARCH)
            place, velocity, turn, spin = (a[0] for a in fly([first], [inertia], [laws], grid[None]))
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

    def in_air(self, index: int, laws: Laws, times: Array) -> Array:
        """Tracked points (T, K, 3) at recorded ``times`` if nothing were in the way."""
        inertia = self._worlds.inertia_of(laws)
        first = self.fit(index, laws).state
        place, _, turn, _ = (a[0] for a in fly([first], [inertia], [laws], self.true_times(index, laws, times)[None]))
        rest = self.takes[index].rest - inertia.centre
        return np.asarray(np.einsum("tij,kj->tki", turn, rest) + place[:, None])

    def job(self, index: int, laws: Laws, times: Array) -> Job | None:
        """The world of take ``index`` from its first contact to recorded ``times``, those after it; None without."""
        start = self.start(index, laws)
        if start is None:
            return None
        true = self.true_times(index, laws, times)
        true = true[true > start.time + 1e-9]
        return Job(start=start, laws=laws, times=true) if len(true) else None

    def motion(self, indices: list[int], laws: list[Laws], times: list[Array]) -> list[Array]:
        """Tracked points (T, K, 3) of takes ``indices`` at recorded ``times``: flight, and what comes after it."""
        jobs = [self.job(i, a, t) for i, a, t in zip(indices, laws, times, strict=True)]
        found, _ = self._worlds.run([j for j in jobs if j is not None])
        after = iter(found)
        out = []
        for i, a, t, job in zip(indices, laws, times, jobs, strict=True):
            tail = next(after) if job is not None else np.zeros((0, len(self.takes[i].rest), 3))
            ahead = len(t) - len(tail)
            head = self.in_air(i, a, t[:ahead]) if ahead else tail[:0]
            out.append(np.concatenate([head, tail]))
        return out

    def lasting_motion(self, indices: list[int], laws: list[Laws], times: list[Array]) -> list[Array]:
        """As ``motion``; where a world comes to nothing, the body goes on as a rigid one that the ground stops."""
        found = self.motion(indices, laws, times)
        return [
            p if sane(p) else self._stopped(i, a, t) for p, i, a, t in zip(found, indices, laws, times, strict=True)
        ]

    def _stopped(self, index: int, laws: Laws, times: Array) -> Array:
        """Points (T, K, 3) of a flight under ``laws`` that is lifted wherever the body would be in the ground."""
        points = self.in_air(index, laws, times)
        depth = np.maximum(0.0, -points[:, :, 2].min(axis=1))
        points[:, :, 2] += depth[:, None]
        start = self.start(index, laws)
        if start is not None:
            # What touches rests: nothing carries it on along the ground.
            touched = int(np.searchsorted(self.true_times(index, laws, times), start.time))
            points[touched:] = points[min(touched, len(points) - 1)]
        return points
