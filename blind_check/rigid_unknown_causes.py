# SPDX-License-Identifier: MIT
"""Causes outside the vocabulary: forces on a rigid body and errors of its recording."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from .case import Lens
from .mujoco_world import Array, Push, RigidWorld
from .rigid_causes import TOSSES, Cause, Maker, either_sign, pushing


def _level(rng: np.random.Generator) -> Array:
    azimuth = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(azimuth), np.sin(azimuth), 0.0])


def periodic(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """A horizontal oscillating force; strength: amplitude in m/s²."""
    direction, rate = _level(rng), float(rng.uniform(8, 25))
    return Cause(
        mechanism="periodic",
        low=0.1,
        high=8.0,
        styles=TOSSES,
        change=pushing(lambda s: lambda t, p, v, w, turn: s * math.sin(rate * t) * direction),
        parameters=lambda s: {"amplitude": (s * direction).tolist(), "omega": rate},
    )


def kick(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """An impulse of 20 ms; strength: change of velocity in m/s."""
    direction, start, length = _level(rng), float(rng.uniform(0.3, 0.5)), 0.02

    def push_of(s: float) -> Push:
        return lambda t, p, v, w, turn: direction * (s / length if start <= t < start + length else 0.0)

    return Cause(
        mechanism="kick",
        low=0.02,
        high=0.8,
        styles=("drop", "toss"),
        active="window",
        window=(start, start + length),
        change=pushing(push_of),
        parameters=lambda s: {"velocity_change": (s * direction).tolist(), "time": start, "duration": length},
    )


def vortex(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """A force around a vertical line, strongest 0.25 m from it; strength: its largest in m/s²."""
    centre, core = np.array([*rng.uniform(-0.3, 0.3, 2), 0.0]), 0.25

    def push_of(s: float) -> Push:
        def push(t: float, p: Array, v: Array, w: Array, turn: Array) -> Array:
            x, y = (p[0] - centre[0]) / core, (p[1] - centre[1]) / core
            size = s * math.exp(0.5 * (1 - x * x - y * y))
            return np.array([-y * size, x * size, 0.0])

        return push

    return Cause(
        mechanism="vortex",
        low=0.1,
        high=8.0,
        styles=TOSSES,
        change=pushing(push_of),
        parameters=lambda s: {"centre": centre.tolist(), "core": core, "strength": s},
    )


def repeller(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """A smooth repulsive potential in the air, 0.2 m wide; strength: its largest force in m/s²."""
    centre, width = np.array([*rng.uniform(-0.25, 0.25, 2), rng.uniform(0.4, 0.9)]), 0.2
    sign = either_sign(rng)

    def push_of(s: float) -> Push:
        def push(t: float, p: Array, v: Array, w: Array, turn: Array) -> Array:
            d = (p - centre) / width
            return np.asarray(sign * s * math.exp(0.5 * (1 - d @ d)) * d)

        return push

    return Cause(
        mechanism="repeller" if sign > 0 else "attractor",
        low=0.2,
        high=12.0,
        styles=TOSSES,
        change=pushing(push_of),
        parameters=lambda s: {"centre": centre.tolist(), "width": width, "strength": sign * s},
    )


def thrust(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """A body-fixed thrust; strength: in m/s²."""
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    return Cause(
        mechanism="body_thrust",
        low=0.1,
        high=10.0,
        styles=("toss",),
        active="always",
        change=pushing(lambda s: lambda t, p, v, w, turn: np.asarray(s * (turn @ direction))),
        parameters=lambda s: {"direction": direction.tolist(), "strength": s},
    )


def belt(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Ground that oscillates horizontally; strength: its speed in m/s."""
    direction, rate = _level(rng), float(rng.uniform(6, 14))

    def ground(s: float, t: float) -> tuple[Array, Array]:
        return s / rate * math.sin(rate * t) * direction, s * math.cos(rate * t) * direction

    return Cause(
        mechanism="moving_ground",
        low=0.03,
        high=1.0,
        styles=("slide", "slide", "drop"),
        active="touched",
        change=lambda s, w: dataclasses.replace(w, ground_motion=lambda t: ground(s, t)),
        parameters=lambda s: {"velocity": (s * direction).tolist(), "omega": rate},
    )


def shaker(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Ground that oscillates vertically; strength: its speed in m/s."""
    rate, phase = float(rng.uniform(25, 50)), float(rng.uniform(0, 2 * np.pi))
    up = np.array([0.0, 0.0, 1.0])

    def ground(s: float, t: float) -> tuple[Array, Array]:
        return s / rate * (math.sin(rate * t + phase)) * up, s * math.cos(rate * t + phase) * up

    return Cause(
        mechanism="shaking_ground",
        low=0.02,
        high=0.5,
        styles=("drop",),
        active="struck",
        change=lambda s, w: dataclasses.replace(w, ground_motion=lambda t: ground(s, t)),
        parameters=lambda s: {"speed": s, "omega": rate, "phase": phase},
    )


def unsteady_clock(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Frame times that oscillate about the true ones; strength: amplitude in s."""
    rate = float(rng.uniform(8, 16))
    return Cause(
        mechanism="unsteady_clock",
        low=0.002,
        high=0.6 / rate,
        styles=TOSSES,
        active="always",
        clock=lambda s, t: np.asarray(t + s * (np.cos(rate * t) - 1)),
        parameters=lambda s: {"amplitude_s": s, "omega": rate},
    )


def dropped_frames(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Frames lost unnoticed at one time; strength: seconds lost."""
    when = float(rng.uniform(0.3, 0.5))
    return Cause(
        mechanism="dropped_frames",
        low=0.004,
        high=0.08,
        styles=TOSSES,
        active="window",
        window=(when, when + 0.01),
        clock=lambda s, t: np.asarray(t + s * (t > when)),
        parameters=lambda s: {"seconds": s, "time": when},
    )


def lens_distortion(world: RigidWorld, rng: np.random.Generator) -> Cause:
    """Radial lens distortion; strength: k1."""
    sign = either_sign(rng)
    return Cause(
        mechanism="lens_distortion",
        low=0.03,
        high=1.2,
        styles=TOSSES,
        active="always",
        lens=lambda s: Lens(k1=sign * s),
        parameters=lambda s: {"k1": sign * s},
    )


UNKNOWN_CAUSES: Mapping[str, Maker] = {
    "periodic": periodic,
    "kick": kick,
    "vortex": vortex,
    "repeller": repeller,
    "thrust": thrust,
    "belt": belt,
    "shaker": shaker,
    "unsteady_clock": unsteady_clock,
    "dropped_frames": dropped_frames,
    "lens_distortion": lens_distortion,
}
