# SPDX-License-Identifier: MIT
"""Rigid state of a soft body before first contact, with its uncertainty, from those frames alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...rigid_alignment import nearest_pose
from .soft_candidates import WorldParameters

Array = NDArray[np.float64]

GAUSS_NEWTON = 8
LONGEST_STEP, LONGEST_TURN = 4e-2, 5e-3
"""Steps in s of position and rotation: errors far below 1 µm and 1 µrad for hand-thrown objects."""

STEPS = np.array([1e-5, 1e-5, 1e-5, 1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2])
"""Finite-difference steps of position, velocity, rotation and spin."""


@dataclass(frozen=True, kw_only=True)
class Inertia:
    """Inertia: mass in kg; centre (3,) m in the rest frame; tensor (3, 3) kg m² about it, rest axes."""

    mass: float
    centre: Array
    tensor: Array

    @property
    def round(self) -> bool:
        """Return whether it spins steadily about any axis."""
        return bool(np.ptp(np.linalg.eigvalsh(self.tensor)) < 1e-4 * np.trace(self.tensor))

    @staticmethod
    def of(nodes: Array, masses: Array) -> Inertia:
        """Return the inertia of ``masses`` (N,) at ``nodes`` (N, 3)."""
        centre = masses @ nodes / masses.sum()
        r = nodes - centre
        tensor = np.eye(3) * float(masses @ (r * r).sum(axis=1)) - r.T @ (masses[:, None] * r)
        return Inertia(mass=float(masses.sum()), centre=centre, tensor=tensor)


@dataclass(frozen=True, kw_only=True)
class State:
    """Rigid state at ``time`` s: position of the centre of mass, velocity, rotation (3, 3) from rest, spin in rad/s."""

    time: float
    place: Array
    velocity: Array
    turn: Array
    spin: Array

    def moved(self, change: Array) -> State:
        """Return the state plus ``change`` (12,): position, velocity, rotation vector in world axes, spin."""
        return State(
            time=self.time,
            place=self.place + change[:3],
            velocity=self.velocity + change[3:6],
            turn=Rotation.from_rotvec(change[6:9]).as_matrix() @ self.turn,
            spin=self.spin + change[9:],
        )

    def points(self, inertia: Inertia, rest: Array) -> Array:
        """Return the positions of ``rest`` (K, 3)."""
        return np.asarray((rest - inertia.centre) @ self.turn.T + self.place)

    def velocities(self, inertia: Inertia, rest: Array) -> Array:
        """Return the velocities of ``rest`` (K, 3)."""
        return np.asarray(self.velocity + np.cross(self.spin, (rest - inertia.centre) @ self.turn.T))


def simulate_flight(
    states: list[State], inertia: list[Inertia], world: list[WorldParameters], times: Array
) -> tuple[Array, ...]:
    """Simulate states (B) under ``world`` (B) to rising true ``times`` (B, T), not before the states'.

    Return positions (B, T, 3), velocities (B, T, 3), rotations (B, T, 3, 3), spins (B, T, 3). No torque acts in flight,
    so rotations come first (angular momentum conserved, midpoint rule), then positions (fourth-order Runge–Kutta).
    """
    begin = np.array([s.time for s in states])
    turns, spins = _turning(states, inertia, begin, times)
    place, velocity = np.stack([s.place for s in states]), np.stack([s.velocity for s in states])
    if not any(a.drag or a.lift or a.tether_stiffness for a in world):
        gravity, t = np.array([a.gravity for a in world])[:, None], (times - begin[:, None])[:, :, None]
        places = place[:, None] + t * velocity[:, None] + 0.5 * t * t * gravity
        return places, velocity[:, None] + t * gravity, turns, spins
    return *_places(place, velocity, spins, _Field(world), begin, times), turns, spins


def _places(
    place: Array, velocity: Array, spins: Array, field: _Field, begin: Array, times: Array
) -> tuple[Array, Array]:
    """Return positions and velocities (B, T, 3) by Runge–Kutta on an even grid and cubic interpolation."""
    end = times[:, -1]
    count = max(1, int(np.ceil(float((end - begin).max()) / LONGEST_STEP)))
    h = ((end - begin) / count)[:, None]
    nodes = [(place, velocity)]
    for i in range(count):
        spin = spins[:, min(spins.shape[1] - 1, (2 * i + 1) * spins.shape[1] // (2 * count))]
        k1 = field(place, velocity, spin)
        k2 = field(place + 0.5 * h * velocity, velocity + 0.5 * h * k1, spin)
        k3 = field(place + 0.5 * h * velocity + 0.25 * h * h * k1, velocity + 0.5 * h * k2, spin)
        k4 = field(place + h * velocity + 0.5 * h * h * k2, velocity + h * k3, spin)
        place = place + h * velocity + h * h / 6 * (k1 + k2 + k3)
        velocity = velocity + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        nodes.append((place, velocity))
    p, v = (np.stack([n[i] for n in nodes], axis=1) for i in (0, 1))
    at = (times - begin[:, None]) / np.maximum(h, 1e-300)
    low = np.clip(at.astype(np.int64), 0, count - 1)
    u, rows, w = (at - low)[:, :, None], np.arange(len(at))[:, None], h[:, :, None]
    p0, p1, v0, v1 = p[rows, low], p[rows, low + 1], v[rows, low] * w, v[rows, low + 1] * w
    shift = p1 - p0
    places = p0 + u * (v0 + u * ((3 * shift - 2 * v0 - v1) + u * (v0 + v1 - 2 * shift)))
    slopes = v0 + u * (2 * (3 * shift - 2 * v0 - v1) + u * 3 * (v0 + v1 - 2 * shift))
    return places, slopes / np.maximum(w, 1e-300)


def _turning(states: list[State], inertia: list[Inertia], begin: Array, times: Array) -> tuple[Array, Array]:
    """Return rotations (B, T, 3, 3) and spins (B, T, 3)."""
    turn, spin = np.stack([s.turn for s in states]), np.stack([s.spin for s in states])
    t = times - begin[:, None]
    if all(i.round for i in inertia):
        return _rotation(t[:, :, None] * spin[:, None]) @ turn[:, None], np.repeat(spin[:, None], t.shape[1], axis=1)
    tensor = np.stack([i.tensor for i in inertia])
    inverse = np.linalg.inv(tensor)
    momentum = (turn @ tensor @ np.swapaxes(turn, 1, 2) @ spin[:, :, None])[:, :, 0]

    def spin_at(turn: Array) -> Array:
        return np.asarray((turn @ (inverse @ (np.swapaxes(turn, 1, 2) @ momentum[:, :, None])))[:, :, 0])

    turns, spins = np.empty((*t.shape, 3, 3)), np.empty((*t.shape, 3))
    now = np.zeros(len(states))
    for i in range(t.shape[1]):
        span = t[:, i] - now
        count = max(1, int(np.ceil(float(span.max()) / LONGEST_TURN)))
        h = (span / count)[:, None]
        for _ in range(count):
            middle = _rotation(0.5 * h * spin_at(turn)) @ turn
            turn = _rotation(h * spin_at(middle)) @ turn
        now = t[:, i]
        turns[:, i], spins[:, i] = turn, spin_at(turn)
    return turns, spins


def _rotation(vector: Array) -> Array:
    """Return matrices (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    cross = np.zeros((*vector.shape, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -vector[..., 2], vector[..., 1], -vector[..., 0]
    cross = cross - np.swapaxes(cross, -1, -2)
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half * half * (cross @ cross))


class _Field:
    """Acceleration field (B, 3) of bodies with given positions, velocities and spins, each under its own laws."""

    def __init__(self, world: list[WorldParameters]) -> None:
        self.gravity = np.array([a.gravity for a in world])
        self.drag = np.array([[a.drag] for a in world])
        self.wind = np.array([a.wind for a in world])
        self.lift = np.array([[a.lift] for a in world])
        self.stiffness = np.array([[a.tether_stiffness] for a in world])
        self.length = np.array([[a.tether_length] for a in world])
        self.anchor = np.array([a.tether_anchor for a in world])
        self.string = np.array([[a.tether_string] for a in world])

    def __call__(self, place: Array, velocity: Array, spin: Array) -> Array:
        past = velocity - self.wind
        a = self.gravity - self.drag * np.linalg.norm(past, axis=1, keepdims=True) * past
        if self.lift.any():
            a = a + self.lift * np.cross(spin, past)
        if self.stiffness.any():
            away = self.anchor - place
            length = np.linalg.norm(away, axis=1, keepdims=True)
            pull = self.stiffness * (length - self.length)
            pull = np.where(self.string, np.maximum(pull, 0.0), pull)
            a = a + pull * away / np.maximum(length, 1e-9)
        return np.asarray(a)


def first_guess(times: Array, rest: Array, points: Array, inertia: Inertia, gravity: Array) -> State:
    """Return a rough rigid state at the first of ``times`` (T,) from ``points`` (T, K, 3), NaN where not seen."""
    turns, places, used = [], [], []
    for time, frame in zip(times, points, strict=True):
        seen = np.isfinite(frame).all(axis=1)
        if seen.sum() >= 3:
            turn, shift = nearest_pose(rest[seen], frame[seen])
            turns.append(turn)
            places.append(turn @ inertia.centre + shift)
            used.append(time)
    t = np.array(used) - times[0]
    if len(t) < 2:
        return State(time=times[0], place=places[0], velocity=np.zeros(3), turn=turns[0], spin=np.zeros(3))
    fall = np.array(places) - 0.5 * t[:, None] ** 2 * gravity
    line = np.polyfit(t, fall, 1)
    steps = np.array(
        [
            Rotation.from_matrix(b @ a.T).as_rotvec() / (tb - ta)
            for a, b, ta, tb in zip(turns[:-1], turns[1:], t[:-1], t[1:], strict=True)
        ]
    )
    spin = np.median(steps, axis=0)
    return State(time=times[0], place=line[1], velocity=line[0], turn=turns[0], spin=spin)


@dataclass(frozen=True, kw_only=True)
class FlightFrames:
    """Flying frames of a trial, each compressed by QR to twelve numbers and a constant.

    times: (T,) recorded. bases: (T, 4, 4), R factor of the seen points' (rest, 1). seen: (T, 4, 3) Q^T times observed
    coordinates. rest_chi2: residual that no affine motion explains, over sigma². count: number of coordinates seen.
    """

    times: Array
    bases: Array
    seen: Array
    rest_chi2: float
    count: int
    sigma: float

    @staticmethod
    def of(times: Array, rest: Array, points: Array, sigma: float) -> FlightFrames:
        """Return the compressed frames of ``rest`` (K, 3) and ``points`` (T, K, 3), NaN where not seen."""
        used, bases, seen, left, count = [], [], [], 0.0, 0
        for time, frame in zip(times, points, strict=True):
            there = np.isfinite(frame).all(axis=1)
            if not there.any():
                continue
            q, r = np.linalg.qr(np.concatenate([rest[there], np.ones((there.sum(), 1))], axis=1))
            along = q.T @ frame[there]
            left += float(((frame[there] - q @ along) ** 2).sum()) / sigma**2
            count += 3 * int(there.sum())
            base, reduced = np.zeros((4, 4)), np.zeros((4, 3))
            base[: len(r)], reduced[: len(r)] = r, along
            used.append(time)
            bases.append(base)
            seen.append(reduced)
        return FlightFrames(
            times=np.array(used),
            bases=np.array(bases),
            seen=np.array(seen),
            rest_chi2=left,
            count=count,
            sigma=sigma,
        )

    def residuals(self, states: list[State], inertia: list[Inertia], world: list[WorldParameters]) -> Array:
        """Return residuals (B, 12 T), observed minus simulated over sigma."""
        rates = np.array([[a.rate] for a in world])
        true = self.times[0] + rates * (self.times - self.times[0])
        places, _, turns, _ = simulate_flight(states, inertia, world, true)
        origin = places - np.einsum("btij,bj->bti", turns, np.stack([i.centre for i in inertia]))
        affine = np.concatenate([np.swapaxes(turns, 2, 3), origin[:, :, None]], axis=2)
        return np.asarray((self.seen - self.bases @ affine).reshape(len(states), -1) / self.sigma)


@dataclass(frozen=True, kw_only=True)
class FlightFit:
    """Fitted state at the first frame; covariance (12, 12) in the coordinates of ``State.moved``; residual (n,) over
    sigma, and the sum of squares that no state changes.

    projector: (n, 12) orthonormal basis of the residuals that the state absorbs.
    """

    state: State
    covariance: Array
    residual: Array
    projector: Array
    rest_chi2: float
    count: int

    @property
    def chi2(self) -> float:
        """Return the sum of squares over sigma² of ``count`` coordinates."""
        return float(self.residual @ self.residual) + self.rest_chi2


def fit_flight(state: State, inertia: Inertia, world: WorldParameters, flight: FlightFrames) -> FlightFit:
    """Return the rigid state fitted to ``flight`` by Gauss–Newton from ``state``."""
    chi2 = np.inf
    jacobian = residual = np.zeros((0, 12))
    for _ in range(GAUSS_NEWTON):
        trial = [state, *(state.moved(d) for d in np.diag(STEPS))]
        found = flight.residuals(trial, [inertia] * 13, [world] * 13)
        residual, jacobian = found[0], (-(found[1:] - found[0]) / STEPS[:, None]).T
        now = float(residual @ residual)
        if chi2 - now < 1e-2:
            break
        chi2 = now
        state = state.moved(np.linalg.lstsq(jacobian, residual, rcond=1e-12)[0])
    normal = jacobian.T @ jacobian
    return FlightFit(
        state=state,
        covariance=np.linalg.pinv(normal, hermitian=True),
        residual=residual,
        projector=np.linalg.qr(jacobian)[0],
        rest_chi2=flight.rest_chi2,
        count=flight.count,
    )
