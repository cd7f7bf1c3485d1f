# SPDX-License-Identifier: MIT
"""How a take begins: tossed, spun, dropped, slid or rolled."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from .rigid_world import GRAVITY, Array, Body, State


def draw_state(body: Body, style: str, duration: float, rng: np.random.Generator, *, close: bool) -> State:
    """A first state for a take of ``duration`` s. close: within a camera's view."""
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
    """A rotation that brings the body's ``axis`` to the vertical, either way up."""
    target = np.zeros((1, 3))
    target[0, axis] = rng.choice([-1.0, 1.0])
    return Rotation.align_vectors(np.array([[0.0, 0.0, 1.0]]), target)[0]


def _toss(body: Body, style: str, duration: float, position: Array, rng: np.random.Generator, close: bool) -> State:
    position[2] = body.size * 1.8 + rng.uniform(0.15, 0.7)
    low, high = (0.5, 2.6) if close else (0.6, 1.2)
    # In the open most takes are one long flight that just ends on the ground; before a camera they land half-way.
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
