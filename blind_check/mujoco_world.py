# SPDX-License-Identifier: MIT
"""Rigid bodies in MuJoCo: worlds, shapes, initial states."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from ..sim.errors import InputError

Array = NDArray[np.float64]
Push = Callable[[float, Array, Array, Array, Array], Array]
"""(time s, position m, velocity m/s, spin rad/s, rotation (3, 3)) → force per mass in m/s² on the centre."""

GroundMotion = Callable[[float], tuple[Array, Array]]
"""time s → displacement m and velocity m/s of the ground."""

STEP_S = 1e-4
CONTACT_RATE = 1600.0
"""Undamped angular frequency of the contact, rad/s, for a duration of 2 ms."""

STRIKE_M_S = 0.08
"""Normal speed from which a contact counts as an impact."""

TURN_M_S2 = 0.5
"""Acceleration of the surface about the centre from which the ground turns a body: not one that rests or rolls."""

GRAVITY = 9.81
_GRIP = 100.0
"""MuJoCo impratio, so that sticking contacts do not creep."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """A rigid body. shape: ``sphere``, ``cube`` or ``box``. half: half extents in m (a sphere's radius, three times).

    density: kg/m³.
    """

    shape: str
    half: tuple[float, float, float]
    density: float

    @property
    def volume(self) -> float:
        """Return the volume in m³."""
        product = math.prod(self.half)
        return 4 / 3 * math.pi * product if self.shape == "sphere" else 8 * product

    @property
    def mass(self) -> float:
        """Return the mass in kg."""
        return self.density * self.volume

    @property
    def cross_section(self) -> float:
        """Return the mean cross-section in m²: a quarter of the surface of a convex body (Cauchy)."""
        a, b, c = self.half
        return math.pi * a * a if self.shape == "sphere" else 2 * (a * b + b * c + c * a)

    @property
    def size(self) -> float:
        """Return the mean half extent in m."""
        return float(np.mean(self.half))


@dataclass(frozen=True, kw_only=True)
class RigidWorld:
    """All parameters of a world with one body.

    pellet: (extra mass over the body's, position in the body in m). inertia: moments of the body over
        those of uniform density. rolling: m, arm of the rolling resistance.
    adhesion: (pull per mass in m/s², reach in m): pull on a separating body, decreasing to zero at that distance.
    bump: (x, y, radius, height) in m of an unmodelled spherical cap on the ground.
    push: see ``Push``. ground_motion: see ``GroundMotion``.
    """

    body: Body
    friction: float
    restitution: float
    gravity: tuple[float, float, float] = (0.0, 0.0, -GRAVITY)
    pellet: tuple[float, tuple[float, float, float]] | None = None
    inertia: float = 1.0
    rolling: float = 0.0
    adhesion: tuple[float, float] | None = None
    bump: tuple[float, float, float, float] | None = None
    push: Push | None = None
    ground_motion: GroundMotion | None = None


@dataclass(frozen=True, kw_only=True)
class State:
    """Rigid state: position m, quaternion (w, x, y, z), velocity m/s, spin rad/s; world axes, geometric centre."""

    position: Array
    quaternion: Array
    velocity: Array
    spin: Array


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Motion at T times: position (T, 3), rotation (T, 3, 3).

    Over the interval around each frame: touched (T,) whether it touched the ground, struck (T,) whether at more than
    ``STRIKE_M_S``, slid (T,) whether the contact slid, pulled (T,) whether adhesion acted, turned (T,) whether the
    ground changed its spin by more than ``TURN_M_S2``; push (T, 3) m/s².
    """

    position: Array
    rotation: Array
    touched: NDArray[np.bool_]
    struck: NDArray[np.bool_]
    slid: NDArray[np.bool_]
    pulled: NDArray[np.bool_]
    turned: NDArray[np.bool_]
    push: Array

    def points(self, rest: Array) -> Array:
        """Return the positions (T, K, 3) of the body's points ``rest`` (K, 3)."""
        return np.einsum("tij,kj->tki", self.rotation, rest) + self.position[:, None]


def load_mujoco() -> Any:
    """Return the module ``mujoco``. Raises InputError, with the remedy, where it is not installed."""
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        raise InputError(
            f"blind-check needs MuJoCo, which cannot be loaded ({error}): run `pip install 'physgen[blind]'`"
        ) from None


def bounce_of_damping(zeta: float) -> float:
    """Return the restitution of a spring-damper of damping ratio ``zeta`` whose force may not pull.

    The force -2 zeta w v - w² x ends at the time t1 with tan(wd t1) = 2 zeta wd w / (w² - 2 zeta² w²) on the branch
    below pi; the speed there over the speed at the beginning (Schwager and Pöschel, Granular Matter 9, 2007).
    """
    root = math.sqrt(1 - zeta * zeta)
    end = math.pi - math.atan2(2 * zeta * root, 1 - 2 * zeta * zeta)
    # In units of 1/w: v(t) = exp(-zeta t) (cos(wd t) - zeta/wd sin(wd t)), downwards positive.
    return -math.exp(-zeta * end / root) * (math.cos(end) - zeta / root * math.sin(end))


@lru_cache(maxsize=256)
def damping_of_bounce(restitution: float) -> float:
    """Return the damping ratio below 1 with that restitution, which is clamped to [0.15, 0.98]."""
    wanted = min(max(restitution, 0.15), 0.98)
    return float(brentq(lambda z: bounce_of_damping(z) - wanted, 1e-4, 0.999))


def _model(mujoco: Any, world: RigidWorld) -> Any:
    body = world.body
    size = repr(body.half[0]) if body.shape == "sphere" else " ".join(map(repr, body.half))
    kind = "sphere" if body.shape == "sphere" else "box"
    rate = CONTACT_RATE
    law = (
        f'solref="{-rate * rate!r} {-2 * damping_of_bounce(world.restitution) * rate!r}" '
        f'solimp="0.9999 0.9999 0.001" friction="{world.friction!r} 0 0" condim="3"'
    )
    joints = "".join(f'<joint type="slide" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 0 1"))
    bump = ""
    if world.bump is not None:
        x, y, radius, height = world.bump
        ball = (radius * radius + height * height) / (2 * height)
        bump = f'<geom type="sphere" size="{ball!r}" pos="{x!r} {y!r} {height - ball!r}" {law}/>'
    ground = f'<geom type="plane" size="0 0 1" {law}/>'
    if world.ground_motion is not None:
        # Planes cannot move in MuJoCo; a wide slab, heavy enough to keep its prescribed motion, can.
        ground = f'<body name="ground">{joints}<geom type="box" size="20 20 1" pos="0 0 -1" mass="1e9" {law}/></body>'
    inertial = ""
    density = f'density="{body.density!r}"'
    if world.pellet is not None or world.inertia != 1.0:
        pellet = (0.0, (0.0, 0.0, 0.0)) if world.pellet is None else world.pellet
        inertial, density = _loaded_inertia(body, *pellet, world.inertia), 'mass="0"'
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP_S}" integrator="RK4" cone="elliptic" impratio="{_GRIP}" '
        f'gravity="{" ".join(map(repr, world.gravity))}"/><worldbody>{ground}{bump}'
        f'<body name="body"><freejoint/>{inertial}<geom type="{kind}" size="{size}" {density} {law}/></body>'
        "</worldbody></mujoco>"
    )


def _loaded_inertia(body: Body, fraction: float, at: tuple[float, float, float], factor: float) -> str:
    """Return the ``inertial`` element of ``body``, its moments times ``factor``, and a pellet at ``at``.

    fraction: the pellet's mass over the body's.
    """
    half, mass = np.array(body.half), body.mass
    share = 0.4 if body.shape == "sphere" else None
    if share is not None:
        tensor = np.eye(3) * share * mass * half[0] ** 2
    else:
        tensor = (
            np.diag([half[1] ** 2 + half[2] ** 2, half[0] ** 2 + half[2] ** 2, half[0] ** 2 + half[1] ** 2]) * mass / 3
        )
    tensor = factor * tensor
    place = np.array(at)
    centre = place * fraction / (1 + fraction)
    for part, where in ((mass, -centre), (mass * fraction, place - centre)):
        tensor = tensor + part * (where @ where * np.eye(3) - np.outer(where, where))
    six = [tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 1], tensor[0, 2], tensor[1, 2]]
    return (
        f'<inertial mass="{mass * (1 + fraction)!r}" pos="{" ".join(repr(float(c)) for c in centre)}" '
        f'fullinertia="{" ".join(repr(float(x)) for x in six)}"/>'
    )


def simulate_rigid(world: RigidWorld, state: State, times: Array, *, step: float = STEP_S) -> Motion:
    """Return the motion from ``state`` at ``times[0]``. times: (T,) s, rising, true time. step: longest one, s.

    Raises InputError without MuJoCo.
    """
    mujoco = load_mujoco()
    model = _model(mujoco, world)
    data = mujoco.MjData(model)
    recorder = _Recorder(world, model, data, mujoco, len(times), step)
    recorder.place(state, float(times[0]))
    for frame in range(len(times)):
        if frame:
            recorder.advance(frame, float(times[frame] - times[frame - 1]))
        recorder.keep(frame)
    return recorder.motion()


class _Recorder:
    """Steps a model from frame to frame and records contacts in between."""

    def __init__(self, world: RigidWorld, model: Any, data: Any, mujoco: Any, frames: int, step: float) -> None:
        self._step = step
        self._world, self._model, self._data, self._mujoco = world, model, data, mujoco
        self._body = model.body("body").id
        self._mass = float(model.body_mass[self._body])
        self._inertia, self._size = float(model.body_inertia[self._body].max()), world.body.size
        self._first = 3 if world.ground_motion is not None else 0  # degrees of freedom of the ground come first
        smooth = world.push is not None and world.adhesion is None and world.ground_motion is None
        smooth = smooth and world.rolling == 0
        free = world.push is None and world.adhesion is None and world.ground_motion is None and world.rolling == 0
        self._load = np.zeros(6)
        # Smooth forces may be held for half a millisecond; contact-dependent ones are evaluated at each step.
        self._stride = 5 if smooth else (10 if free else 1)
        self._position, self._rotation = np.zeros((frames, 3)), np.zeros((frames, 3, 3))
        self._flags = np.zeros((5, frames), dtype=bool)
        self._push = np.zeros((frames, 3))

    def place(self, state: State, time: float) -> None:
        turn = Rotation.from_quat(np.roll(state.quaternion, -1))
        q, v = self._data.qpos[self._first :], self._data.qvel[self._first :]
        q[:3], q[3:7] = state.position, state.quaternion / np.linalg.norm(state.quaternion)
        v[:3], v[3:6] = state.velocity, turn.inv().apply(state.spin)  # MuJoCo's spin is in body axes
        self._data.time = time
        self._mujoco.mj_forward(self._model, self._data)

    def advance(self, frame: int, duration: float) -> None:
        steps = max(1, math.ceil(duration / self._step - 1e-9))
        self._model.opt.timestep = duration / steps
        done = 0
        while done < steps:
            # A contact lasts twenty steps and may chatter: sample often enough not to miss it.
            now = min(2 if self._data.ncon > 0 else self._stride, self._stride, steps - done)
            self._force()
            self._mujoco.mj_step(self._model, self._data, nstep=now)
            done += now
            self._note(frame if 2 * done > steps else frame - 1)

    def _force(self) -> None:
        world, data, first = self._world, self._data, self._first
        if world.ground_motion is not None:
            data.qpos[:3], data.qvel[:3] = world.ground_motion(data.time)
        if world.rolling > 0:
            data.xfrc_applied[self._body, 3:] = self._resistance()
        if world.push is None and world.adhesion is None:
            return
        q, v = data.qpos[first:], data.qvel[first:]
        force = np.zeros(3)
        if world.push is not None:
            turn = data.xmat[self._body].reshape(3, 3)
            force = force + world.push(data.time, q[:3].copy(), v[:3].copy(), turn @ v[3:6], turn)
        if world.adhesion is not None:
            force = force + np.array([0.0, 0.0, self._pull(q, v)])
        data.xfrc_applied[self._body, :3] = force * self._mass

    def _resistance(self) -> Array:
        """Return the torque against the horizontal spin: arm times normal force."""
        data = self._data
        spin = data.xmat[self._body].reshape(3, 3) @ data.qvel[self._first :][3:6]
        size, press = math.hypot(spin[0], spin[1]), 0.0
        for i in range(data.ncon):
            self._mujoco.mj_contactForce(self._model, data, i, self._load)
            press += float(self._load[0])
        return np.array([spin[0], spin[1], 0.0]) * (-self._world.rolling * press / max(size, 1e-3))

    def _pull(self, q: Array, v: Array) -> float:
        assert self._world.adhesion is not None
        strength, reach = self._world.adhesion
        body = self._world.body
        turn = self._data.xmat[self._body].reshape(3, 3)
        low = body.half[0] if body.shape == "sphere" else float(np.abs(turn[2]) @ np.array(body.half))
        gap = max(float(q[2]) - low, 0.0)
        return -strength * max(1 - gap / reach, 0.0) if v[2] > 0 else 0.0

    def _note(self, frame: int) -> None:
        data, first = self._data, self._first
        v = data.qvel[first:]
        if data.ncon > 0:
            turn = data.xmat[self._body].reshape(3, 3)
            x, y, z = data.contact.pos.sum(axis=0) / data.ncon - data.qpos[first:][:3]
            a, b, c = turn @ v[3:6]
            slip = (v[0] + b * z - c * y, v[1] + c * x - a * z, v[2] + a * y - b * x)
            self._flags[0, frame] = True
            self._flags[1, frame] |= abs(slip[2]) > STRIKE_M_S
            self._flags[2, frame] |= math.hypot(slip[0], slip[1]) > 0.02
            torque = np.linalg.norm(data.qfrc_constraint[first + 3 : first + 6])
            self._flags[4, frame] |= bool(torque * self._size > TURN_M_S2 * self._inertia)
        if self._world.adhesion is not None:
            # A resting body jitters by micrometres, which is no separation.
            self._flags[3, frame] |= self._pull(data.qpos[first:], v) < 0 and v[2] > 0.01

    def keep(self, frame: int) -> None:
        data = self._data
        self._position[frame] = data.qpos[self._first :][:3]
        quaternion = data.qpos[self._first :][3:7]
        self._rotation[frame] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
        if self._world.push is not None:
            v, turn = data.qvel[self._first :], self._rotation[frame]
            self._push[frame] = self._world.push(data.time, self._position[frame], v[:3].copy(), turn @ v[3:6], turn)

    def motion(self) -> Motion:
        return Motion(
            position=self._position,
            rotation=self._rotation,
            touched=self._flags[0],
            struck=self._flags[1],
            slid=self._flags[2],
            pulled=self._flags[3],
            turned=self._flags[4],
            push=self._push,
        )


def rigid_mesh(body: Body) -> tuple[Array, NDArray[np.int64]]:
    """Return the mesh (V, 3) m, (F, 3) of the body in its rest frame."""
    if body.shape == "sphere":
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=body.half[0])
    else:
        mesh = trimesh.creation.box(extents=2 * np.array(body.half))
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def surface_points(body: Body, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return ``count`` random points on the body's surface and their outward normals, (K, 3) each."""
    if body.shape == "sphere":
        normal = rng.normal(size=(count, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return normal * body.half[0], normal
    half = np.array(body.half)
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    axis = rng.choice(3, size=count, p=areas / areas.sum())
    # Off the edges, where points cannot be tracked.
    points = rng.uniform(-0.85, 0.85, (count, 3)) * half
    sign = rng.choice([-1.0, 1.0], size=count)
    normal = np.zeros((count, 3))
    normal[np.arange(count), axis] = sign
    points[np.arange(count), axis] = sign * half[axis]
    return points, normal


def facing(points: Array, normals: Array, eye: Array) -> Array:
    """Return (T, K): cosine between a point's normal and its direction to ``eye``. points, normals: (T, K, 3)."""
    to_eye = eye - points
    return np.asarray((to_eye * normals).sum(axis=2) / np.linalg.norm(to_eye, axis=2))


def draw_state(body: Body, style: str, duration: float, rng: np.random.Generator, *, close: bool) -> State:
    """Return an initial state for a trial of ``duration`` s. close: within a camera's view."""
    position = rng.uniform(-0.2, 0.2, 3)
    if style in ("toss", "spun"):
        return _toss(body, style, duration, position, rng, close)
    if style == "drop":
        position[2] = body.size * 1.8 + rng.uniform(0.1, 0.4)
        velocity = np.array([*rng.uniform(-0.22, 0.22, 2), 0.0])
        return _state(position, Rotation.random(rng=rng), velocity, rng.uniform(-3, 3, 3))
    azimuth = rng.uniform(-np.pi, np.pi)
    speed = rng.uniform(0.5, 1.5)
    velocity = speed * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    position[:2] = -velocity[:2] * rng.uniform(0.1, 0.35)
    if body.shape == "sphere":
        position[2] = body.half[0]
        share = 1.0 if style == "roll" else rng.uniform(0.0, 0.4)
        spin = share * np.cross((0.0, 0.0, 1.0), velocity) / body.half[0]
        return _state(position, Rotation.random(rng=rng), velocity, spin)
    axis = int(rng.integers(3))
    position[2] = body.half[axis]
    turn = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * _standing_on(axis, rng)
    return _state(position, turn, velocity, np.array([0.0, 0.0, rng.uniform(-3, 3)]))


def _standing_on(axis: int, rng: np.random.Generator) -> Rotation:
    """Return a random rotation with the body's ``axis`` vertical."""
    target = np.zeros((1, 3))
    target[0, axis] = rng.choice([-1.0, 1.0])
    return Rotation.align_vectors(np.array([[0.0, 0.0, 1.0]]), target)[0]


def _toss(body: Body, style: str, duration: float, position: Array, rng: np.random.Generator, close: bool) -> State:
    position[2] = body.size * 1.8 + rng.uniform(0.15, 0.7)
    low, high = (0.5, 2.6) if close else (0.6, 1.2)
    # Without a camera most trials are one long flight that ends on the ground; with one they land half-way.
    rise = rng.uniform(low, high) if close else rng.uniform(low, high) * GRAVITY * duration / 2
    rise = min(rise, 6.0)
    azimuth, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 1.3 if close else 2.0)
    flat = speed * np.array([np.cos(azimuth), np.sin(azimuth)])
    if close:
        position[:2] = -flat * rng.uniform(0.2, 0.5)
    spin = rng.normal(size=3)
    spin *= rng.uniform(5, 12) / np.linalg.norm(spin) * (2.0 if style == "spun" else 1.0)
    return _state(position, Rotation.random(rng=rng), np.array([*flat, rise]), spin)


def _state(position: Array, turn: Rotation, velocity: Array, spin: Array) -> State:
    return State(position=position, quaternion=np.roll(turn.as_quat(), 1), velocity=velocity, spin=spin)
