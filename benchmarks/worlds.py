# SPDX-License-Identifier: MIT
"""Many small worlds in one launch against one after the other: cubes of jelly dropped on the ground, each stiffer.

    python -m physgen.benchmarks.worlds --worlds 32 --particles 3000 --json

Both runs are in one process and checked to give the same bytes. The ratio of wall times counts; CPU seconds are
reported because the machine may be busy. ``ratio_again`` includes building the worlds, as in fits and sweeps,
``ratio_kept`` does not.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from physgen.benchmarks.common import benchmark_parser, print_result

CELL = 2.0 / 64


def setups(count: int, particles: int) -> list[Any]:
    """Return ``count`` worlds of one cube of about ``particles`` particles."""
    from physgen.sim.constitutive import ElasticMaterial
    from physgen.sim.mpm.bodies import BodyParticles
    from physgen.sim.mpm.solver_options import Ground
    from physgen.sim.mpm.world_setup import WorldSetup

    across = round(particles ** (1 / 3))
    spacing = CELL / 2
    index = np.stack(np.meshgrid(*[np.arange(across)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    positions = (index + 0.5) * spacing - np.array([0.5 * across * spacing] * 2 + [-0.5 * CELL])
    result = []
    for i in range(count):
        body = BodyParticles(
            name="cube",
            positions=positions,
            volumes=np.full(len(positions), spacing**3),
            contact_radii=np.full(len(positions), spacing / 2),
            material=ElasticMaterial(density=1000.0, youngs_modulus=1e5 * (1 + i / count), poisson_ratio=0.3),
            velocity=(0.0, 0.0, -1.0),
        )
        result.append(WorldSetup(bodies=(body,), ground=Ground()))
    return result


def run(worlds: int, particles: int, duration: float, threads: int, arch: str = "cpu") -> dict[str, object]:
    """Measure both ways, after a run that compiles the kernels; return the figures."""
    from physgen.sim.mpm.solver_options import SolverOptions
    from physgen.sim.mpm.world import Worlds
    from physgen.sim.scene.units import Similarity

    options = SolverOptions(grid=64, arch=arch, threads=threads)
    similarity = Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0))
    all_setups = setups(worlds, particles)
    Worlds(all_setups[:2], similarity=similarity, options=options).advance(2e-3)

    def clock() -> tuple[float, float]:
        return time.perf_counter(), time.process_time()

    start = clock()
    alone = [Worlds([setup], similarity=similarity, options=options) for setup in all_setups]
    made_alone = clock()
    for world in alone:
        world.advance(duration)
    done_alone = clock()
    together = Worlds(all_setups, similarity=similarity, options=options)
    made_together = clock()
    together.advance(duration)
    done_together = clock()
    same = all(np.array_equal(alone[i][0].positions(0), together[i].positions(0)) for i in range(worlds))
    substeps = sum(together[i].substeps for i in range(worlds))
    count = all_setups[0].bodies[0].count
    kept = (done_alone[0] - made_alone[0]) / (done_together[0] - made_together[0])
    again = (done_alone[0] - start[0]) / (done_together[0] - done_alone[0])
    return {
        "worlds": worlds,
        "particles_each": count,
        "substeps": substeps,
        "same_bytes": same,
        "alone_s": round(done_alone[0] - made_alone[0], 3),
        "together_s": round(done_together[0] - made_together[0], 3),
        "alone_cpu_s": round(done_alone[1] - made_alone[1], 3),
        "together_cpu_s": round(done_together[1] - made_together[1], 3),
        "alone_mpps": round(substeps * count / 1e6 / (done_alone[0] - made_alone[0]), 3),
        "together_mpps": round(substeps * count / 1e6 / (done_together[0] - made_together[0]), 3),
        "ratio_kept": round(kept, 2),
        "ratio_again": round(again, 2),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code, 1 if the bytes differ."""
    parser = benchmark_parser("worlds", __doc__, worlds=3, particles=216, duration=0.004)
    parser.add_argument("--worlds", type=int, default=32, help="number of worlds (default: %(default)s)")
    parser.add_argument("--particles", type=int, default=3000, help="particles in each (default: %(default)s)")
    parser.add_argument("--duration", type=float, default=0.04, help="seconds simulated (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads, 0 for all (default: %(default)s)")
    parser.add_argument("--arch", default="cpu", help="cpu, cuda or vulkan (default: %(default)s)")
    options = parser.parse_args(arguments)
    if options.worlds < 2 or options.particles < 64:
        parser.error("give at least 2 worlds of 64 particles")
    result = run(options.worlds, options.particles, options.duration, options.threads, options.arch)
    print_result(result, as_json=options.json)
    return 0 if result["same_bytes"] else 1


if __name__ == "__main__":
    sys.exit(main())
