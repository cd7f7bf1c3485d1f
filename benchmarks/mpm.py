# SPDX-License-Identifier: MIT
"""Speed of the particle engine: four elastic cubes dropped on a ground, 256 cells across a box of side 2 m.

    python -m physgen.benchmarks.mpm --particles 100000 --arch cpu --json

Unit: Mpps, million particle substeps per second, steady state, everything included that a bake pays for (sorting, step
control, contact). 8 particles per cell, density 1000 kg/m³, E 5e5 Pa, nu 0.2, 1 m/s downwards, a gap of two cells,
substeps of at most 1e-4 s.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from physgen.benchmarks.common import benchmark_parser, print_result

SIDE = 2.0
GRID = 256
CELL = SIDE / GRID
GROUND = 0.25


def cubes(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return positions (N, 3) in metres, z up, of four cubes of ``count`` random particles together."""
    rng = np.random.default_rng(seed)
    each = count // 4
    side = (each / 8) ** (1 / 3) * CELL
    corners = [(x, y) for x in (0.6, 1.4) for y in (0.6, 1.4)]
    low = [np.array([x - side / 2, y - side / 2, GROUND + 2 * CELL]) for x, y in corners]
    return [corner + rng.random((each, 3)) * side for corner in low]


def world_of(particles: int, *, arch: str, threads: int, cache_folder: Path | None) -> Any:
    """The world of this benchmark, with about so many particles, before its first substep."""
    from physgen.sim.constitutive import ElasticMaterial
    from physgen.sim.mpm.bodies import BodyParticles
    from physgen.sim.mpm.solver_options import Ground, SolverOptions
    from physgen.sim.mpm.world import World
    from physgen.sim.scene.units import Similarity

    options = SolverOptions(grid=GRID, arch=arch, threads=threads, max_step=1e-4, cache_folder=cache_folder)
    material = ElasticMaterial(density=1000.0, youngs_modulus=5e5, poisson_ratio=0.2)
    bodies = [
        BodyParticles(
            name=f"cube {i}",
            positions=points,
            volumes=np.full(len(points), CELL**3 / 8),
            material=material,
            velocity=(0.0, 0.0, -1.0),
        )
        for i, points in enumerate(cubes(particles))
    ]
    return World(
        bodies=bodies,
        ground=Ground(point=(0.0, 0.0, GROUND), friction=0.5),
        similarity=Similarity(scale=1.0),
        options=options,
    )


def run(arguments: argparse.Namespace, cache_folder: Path | None) -> dict[str, object]:
    """Measure in this process; return the figures."""
    start = time.perf_counter()
    world = world_of(arguments.particles, arch=arguments.arch, threads=arguments.threads, cache_folder=cache_folder)
    count = sum(body.count for body in world.bodies)
    world.advance(2e-4)
    compile_s = time.perf_counter() - start
    speeds, cpu, wall = [], 0.0, 0.0
    for _ in range(arguments.repeats):
        substeps, t, c = world.substeps, time.perf_counter(), time.process_time()
        world.advance(arguments.steps * 1e-4)
        t, c = time.perf_counter() - t, time.process_time() - c
        speeds.append((world.substeps - substeps) * count / t / 1e6)
        cpu, wall = cpu + c, wall + t
    return {
        "engine": "physgen",
        "arch": world.arch,
        "particles": count,
        "threads": arguments.threads or os.cpu_count(),
        "substeps": world.substeps,
        "mpps": round(statistics.median(speeds), 3),
        "mpps_best": round(max(speeds), 3),
        "mpps_per_cpu_s": round(world.substeps * count / 1e6 / cpu, 3) if cpu else None,
        "cpu_s": round(cpu, 3),
        "wall_s": round(wall, 3),
        "compile_s": round(compile_s, 3),
        "bytes_per_particle": round(world.device_bytes / count, 1),
        "lowest_gap_cells": round(min(world.ground_gap(i) for i in range(4)) / CELL, 3),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("mpm", __doc__, particles=4000, steps=10, repeats=1)
    parser.add_argument("--particles", type=int, default=100_000, help="total (default: %(default)s)")
    parser.add_argument("--arch", default="cpu", help="cpu, cuda, vulkan or metal (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads, 0 for all (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=60, help="substeps per repetition (default: %(default)s)")
    parser.add_argument(
        "--repeats", type=int, default=7, help="repetitions, of which the median counts (default: %(default)s)"
    )
    parser.add_argument("--cold", action="store_true", help="compile all kernels, in an empty cache folder")
    options = parser.parse_args(arguments)
    if options.particles < 400:
        parser.error("--particles: give at least 400")
    with tempfile.TemporaryDirectory() as folder:
        result = run(options, Path(folder) if options.cold else None)
    print_result(result, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
