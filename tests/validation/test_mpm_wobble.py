# SPDX-License-Identifier: MIT
"""How long solids swing: their decay against the damping that their material has. Lengths of bodies in cells."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from physgen.sim.constitutive import ElasticMaterial, NeoHookeanMaterial
from physgen.sim.mpm.solver_options import SolverOptions
from physgen.sim.mpm.world import World
from physgen.sim.scene.units import Similarity
from scipy.optimize import curve_fit

NO_GRAVITY = (0.0, 0.0, 0.0)


def jelly_decay(block, cells: int, *, damping_time: float) -> tuple[float, float]:
    """Decay rate in 1/s and angular frequency of the first sideways mode of a jelly cube of 10 cm, held at its foot.

    The cube is kicked in the shape of a shear beam's first mode and watched for six periods, 16 times in each.
    """
    side = 0.1
    cell = side / cells
    jelly = NeoHookeanMaterial(density=1000.0, youngs_modulus=1e4, poisson_ratio=0.4, damping_time=damping_time)
    body = block(jelly, (cells, cells, cells), cell=cell, bottom=(0.3 * cell, 0.3 * cell, 0.2 * cell))
    height = body.positions[:, 2] - body.positions[:, 2].min()
    body = dataclasses.replace(body, pins=height < 0.1 * cell)
    similarity = Similarity(scale=2.0 / 64 / cell, origin=(-32 * cell, -32 * cell, -8 * cell))
    world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=SolverOptions(grid=64))
    wave = math.pi / (2 * side)
    omega = wave * math.sqrt(jelly.shear_modulus / jelly.density)
    mode = np.sin(wave * height)
    velocities, gradients = np.zeros((body.count, 3)), np.zeros((body.count, 3, 3))
    velocities[:, 0] = 0.02 * omega * side * mode
    gradients[:, 0, 2] = 0.02 * omega * side * wave * np.cos(wave * height)
    world.set_motion(0, velocities=velocities, velocity_gradients=gradients)
    times, swing = np.linspace(0.0, 6 * 2 * math.pi / omega, 97), [0.0]
    for time in times[1:]:
        world.advance(time - world.time)
        swing.append(float((world.positions(0) - body.positions)[:, 0] @ mode / (mode @ mode)))

    def model(t, a, b, rate, turn, mean):
        return np.exp(-rate * t) * (a * np.cos(turn * t) + b * np.sin(turn * t)) + mean

    start = (0.0, max(swing), 0.5, 0.7 * omega, 0.0)
    (_, _, rate, turn, _), _ = curve_fit(model, times, swing, start, maxfev=5000)
    return float(rate), abs(float(turn))


MISSED = "23 and 17 % too fast: third derivatives and forces at the surface are still damped"


@pytest.mark.long
@pytest.mark.parametrize(
    "cells",
    [
        pytest.param(6, marks=pytest.mark.xfail(strict=True, reason=MISSED)),
        pytest.param(8, marks=pytest.mark.xfail(strict=True, reason=MISSED)),
        pytest.param(12, marks=pytest.mark.slow),
    ],
)
def test_jelly_wobbles_as_long_as_its_damping_says(block, cells):
    """Kelvin–Voigt: a mode of angular frequency w decays at the rate t w² / 2; within 15 %, at the cells that
    the three qualities give their smallest object. t is that of a jelly which wobbles for 1.4 s."""
    time = 2.6e-3
    rate, omega = jelly_decay(block, cells, damping_time=time)
    assert rate == pytest.approx(time * omega**2 / 2, rel=0.15)


def test_a_coarse_bar_keeps_swinging(block, similarity, options, cell):
    """A free bar of eight cells, nu = 0, without damping: at most a fifth of what plain APIC takes from its first
    longitudinal mode, 0.024 (k dx)^4 of the amplitude per substep (exact for even particles)."""
    elastic = ElasticMaterial(density=1000.0, youngs_modulus=1e5, poisson_ratio=0.0)
    body = block(elastic, (4, 4, 8), bottom=(0.3 * cell, 0.3 * cell, 0.2 * cell))
    world = World(bodies=[body], gravity=NO_GRAVITY, similarity=similarity, options=options)
    length = 8 * cell
    wave = math.pi / length
    height = body.positions[:, 2] - 0.2 * cell
    mode = np.cos(wave * height)
    omega, speed = 10.0 * wave, 0.01 * length * 10.0 * wave
    velocities, gradients = np.zeros((body.count, 3)), np.zeros((body.count, 3, 3))
    velocities[:, 2] = speed * mode
    gradients[:, 2, 2] = -speed * wave * np.sin(wave * height)
    world.set_motion(0, velocities=velocities, velocity_gradients=gradients)
    times, amplitudes = [], []
    for _ in range(48):
        world.advance(2 * math.pi / omega / 16)
        q = mode @ (world.positions(0) - body.positions)[:, 2]
        times.append(world.time)
        amplitudes.append(0.5 * math.log((mode @ world.velocities(0)[:, 2]) ** 2 + (omega * q) ** 2))
    rate = -float(np.polyfit(times, amplitudes, 1)[0])
    plain = 0.024 * (wave * cell) ** 4 * world.substeps / world.time
    assert rate < 0.2 * plain
