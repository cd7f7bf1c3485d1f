# SPDX-License-Identifier: MIT
"""Estimate of a run's cost before it starts: substeps, seconds, bytes. No Taichi.

Right within a factor of about three: the substep is that of the start, the speed that of a typical machine.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..memory import require_memory
from .bodies import BodyParticles
from .solver_options import SolverOptions

CPU_RATE = 2.5e6
"""Particle substeps a second and CPU core: 5 million on two cores (``physgen.benchmarks.mpm``)."""

GRAIN_STEP = 1e-3
"""Longest substep in s where everything is grains: a fall of a second is right to 0.1 %, and piles and run-out are
validated with it and with twice as much (``tests/validation``)."""

GPU_RATES = {"cuda": 1e8, "vulkan": 3e7, "metal": 3e7}
"""Particle substeps a second on a graphics card. Chosen, not measured: cards differ by a factor of ten."""

SUBSTEP_SECONDS = 5e-4
"""Launching the kernels of one substep, whatever their size. Chosen; scenes of a few thousand particles feel it."""

START_SECONDS = 5.0
"""Starting the runtime and loading or compiling the kernels."""

PARTICLE_BYTES = 400
"""State of a particle twice (sorting copies it), what belongs to its contacts, and its host copies."""

SAMPLING_BYTES = 2500
"""Of main memory, a particle, while a mesh is filled: 27 test points each, and their nearest particles. Measured: 2300
to 2500 from 30 to 500 thousand particles. Given back before the next mesh is filled and the engine starts, so the
largest of them counts."""

SAMPLED_BYTES = 100
"""Of a particle of a mesh that is filled: place, volume, and what tells where it lies. Chosen."""

BLOCK_BYTES = 64 * 64
"""A grid block of 4 x 4 x 4 nodes with 64 bytes each."""

BLOCK_PARTICLES = 128
"""Particles in a block, averaged over bodies whose skin half fills its blocks and needs empty ones around it."""

BODY_BLOCKS = 27
"""Blocks that the smallest body touches."""

BASE_BYTES = 256 * 2**20
"""Python, numpy and the runtime."""

FILE_COPIES = 3
"""Of a mesh file at once while it is read, before the engine starts; its textures are not decoded."""

STARTING_BYTES = 160 * 2**20
"""Of ``BASE_BYTES``, while the meshes are read: measured with one file of 48 MiB."""

MAX_HOURS = 48.0
"""A run that would take longer is refused."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Cost of a run.

    substeps: of the whole run; particle_substeps: that times the particles.
    seconds: of computing; bytes: of memory, on the graphics card where that computes.
    """

    substeps: int
    particle_substeps: float
    seconds: float
    bytes: int


def estimate(
    particles: int,
    bodies: int,
    stable_step: float,
    duration: float,
    arch: str,
    *,
    file_bytes: int = 0,
    largest: int | None = None,
) -> Estimate:
    """The cost of simulating ``duration`` seconds of ``particles`` in ``bodies`` with substeps of ``stable_step`` s.

    arch: as in ``SolverOptions``; file_bytes: of the largest mesh file; largest: particles of the largest body,
    None: all.
    """
    if not (math.isfinite(stable_step) and stable_step > 0):
        raise InputError(
            f"the longest stable time step is {stable_step!r} s: lower the velocity, Young's modulus or viscosity"
        )
    substeps = math.ceil(duration / stable_step)
    work = float(substeps) * particles
    rate = GPU_RATES.get(arch, CPU_RATE * _cores())
    blocks = math.ceil(particles / BLOCK_PARTICLES) + BODY_BLOCKS * bodies
    held = particles * PARTICLE_BYTES + blocks * BLOCK_BYTES
    filling = sampling_bytes(particles, particles if largest is None else largest)
    reading = FILE_COPIES * file_bytes + STARTING_BYTES - BASE_BYTES
    return Estimate(
        substeps=substeps,
        particle_substeps=work,
        seconds=START_SECONDS + substeps * SUBSTEP_SECONDS + work / rate,
        bytes=BASE_BYTES + (held if arch in GPU_RATES else max(held, filling, reading)),
    )


def sampling_bytes(particles: float, largest: float) -> int:
    """Return the bytes of main memory that filling meshes with ``particles`` takes, ``largest`` of them in one mesh."""
    return int(largest * SAMPLING_BYTES + max(0.0, particles - largest) * SAMPLED_BYTES)


def stable_step(bodies: Sequence[BodyParticles], cell: float, options: SolverOptions) -> float:
    """Longest substep in s that ``bodies`` allow at the start, on a grid of cells of ``cell`` m (docs/physics.md).

    Counts the fastest wave of all materials and the fastest of the velocities that bodies start with or are given.
    """
    wave = speed = 0.0
    for body in bodies:
        if not body.rigid:
            wave = max(wave, *(body.bounding_speed(material, 1.0 / cell) for material in body.materials_over_time))
        keys = 0.0 if body.velocity_keys is None else float(np.linalg.norm(body.velocity_keys.values, axis=1).max())
        speed = max(speed, keys, float(np.linalg.norm(body.initial_velocities, axis=1).max()))
    step = min([options.max_step, *(body.spring_step for body in bodies)])
    if wave > 0:
        step = min(step, options.cfl_elastic / wave)
    if speed > 0:
        step = min(step, options.cfl_velocity * cell / speed)
    return step


def longest_step(bodies: Sequence[BodyParticles], options: SolverOptions) -> float:
    """Longest substep in s of a bake of ``bodies``: ``options.max_step``, or ``GRAIN_STEP`` where all of them are of
    sand throughout. Collisions of rigid and elastic bodies want the shorter one."""
    if all(not body.rigid and all(m.law == "sand" for m in body.materials_over_time) for body in bodies):
        return max(options.max_step, GRAIN_STEP)
    return options.max_step


def refuse_excess(cost: Estimate, particles: int, available: int | None) -> None:
    """Raise InputError when ``cost`` is more than ``MAX_HOURS`` or the ``available`` bytes; None: not known."""
    hours = cost.seconds / 3600
    if hours > MAX_HOURS:
        raise InputError(
            f"this would take about {hours:.3g} hours of computing ({cost.substeps:.2g} time steps of {particles} "
            f"particles), more than {MAX_HOURS:g}: lower the velocity or Young's modulus, raise the density, bake "
            "fewer frames, or choose a coarser quality"
        )
    require_memory(
        cost.bytes,
        available,
        what=f"{particles} particles",
        remedy="choose a coarser quality, make more objects colliders",
    )


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1
