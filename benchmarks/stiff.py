# SPDX-License-Identifier: GPL-3.0-or-later
"""Stiff elastic matter with explicit and with implicit steps: passes over the particles and CPU seconds.

    python -m physgen.benchmarks.stiff [--scenes rests slides] [--moduli 1e7 1e8]

A cube of 0.1 m, 6 cells along a side, E from 1e5 to 1e8 Pa, half a second of three scenes: it rests; it slides; it
falls on an edge, bounces and tumbles. The speed of the centre of mass at the end and its place say whether both did
the same: a tumbling cube differs more and more after its second impact.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Sequence

import numpy as np

from ..sim.constitutive import ElasticMaterial
from ..sim.mpm.bodies import BodyParticles
from ..sim.mpm.solver_options import Ground, SolverOptions
from ..sim.mpm.world import World
from ..sim.scene.units import ENGINE_BOX_SIZE, Similarity
from .common import benchmark_parser

SIDE, CELLS, GRID = 0.1, 6, 64
SCENES = {
    "rests": (0.0, 0.0, (0.0, 0.0, 0.0)),
    "slides": (0.0, 0.0, (1.2, 0.0, 0.0)),
    "tumbles": (0.15, 0.3, (0.3, 0.0, 0.0)),
}
"""Height over the ground in m, angle in radians and velocity in m/s of each scene's cube."""


def cube(youngs_modulus: float, *, height: float, angle: float, velocity: tuple[float, float, float]) -> BodyParticles:
    """The cube, ``height`` metres over the ground, turned about y."""
    spacing = 0.5 * SIDE / CELLS
    index = np.stack(np.meshgrid(*[np.arange(2 * CELLS)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    local = (index + 0.5) * spacing - 0.5 * SIDE
    c, s = math.cos(angle), math.sin(angle)
    local = local @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    return BodyParticles(
        name="cube",
        positions=local + np.array([0.0, 0.0, height - local[:, 2].min() + 0.5 * spacing]),
        volumes=np.full(len(local), spacing**3),
        material=ElasticMaterial(density=1000.0, youngs_modulus=youngs_modulus, poisson_ratio=0.3),
        velocity=velocity,
    )


def run(body: BodyParticles, seconds: float, *, implicit: bool) -> tuple[World, float]:
    """The world after ``seconds``, and the CPU seconds that it took without compiling."""
    scale = ENGINE_BOX_SIZE / GRID * CELLS / SIDE
    options = SolverOptions(grid=GRID, implicit=implicit, threads=1)
    ground = Ground(friction=0.4)
    world = World(bodies=[body], ground=ground, similarity=Similarity(scale=scale), options=options)
    start = time.process_time()
    for _ in range(round(24 * seconds)):
        world.advance(1 / 24)
    return world, time.process_time() - start


def compare(name: str, youngs_modulus: float, seconds: float, *, implicit: bool) -> dict[str, object]:
    """One run of the scene ``name``: passes over the particles, CPU seconds, and where the centre of mass ends."""
    height, angle, velocity = SCENES[name]
    body = cube(youngs_modulus, height=height, angle=angle, velocity=velocity)
    world, cpu = run(body, seconds, implicit=implicit)
    place, speed = world.positions(0).mean(axis=0), world.velocities(0).mean(axis=0)
    return {
        "scene": name,
        "youngs_modulus": youngs_modulus,
        "steps": "implicit" if implicit else "explicit",
        "passes": world.particle_passes,
        "cpu_s": round(cpu, 2),
        "x_m": round(float(place[0]), 4),
        "z_m": round(float(place[2]), 4),
        "speed_m_s": round(float(np.linalg.norm(speed)), 3),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("stiff", __doc__, scenes=["rests"], moduli=[1e7], duration=1 / 12)
    parser.add_argument("--scenes", nargs="+", choices=[*SCENES], default=[*SCENES], help="which (default: all)")
    parser.add_argument("--moduli", nargs="+", type=float, default=[1e5, 1e6, 1e7, 1e8], metavar="E", help="in Pa")
    parser.add_argument("--duration", type=float, default=0.5, help="seconds simulated (default: %(default)s)")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.scenes:
        for implicit in (False, True):
            # Once for the compiler.
            compare(name, 1e8, 1 / 24, implicit=implicit)
        for youngs_modulus in options.moduli:
            for implicit in (False, True):
                rows.append(compare(name, youngs_modulus, options.duration, implicit=implicit))
                if not options.json:
                    print("  ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
    if options.json:
        print(json.dumps({"rows": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
