# SPDX-License-Identifier: GPL-3.0-or-later
"""Stiff elastic matter with explicit and with implicit steps: passes over the particles and CPU seconds.

    python -m physgen.benchmarks.stiff [--quick]

A cube of 0.1 m, 6 cells along a side, E from 1e5 to 1e8 Pa, half a second of three scenes: it rests; it slides; it
falls on an edge, bounces and tumbles. The speed of the centre of mass at the end and its place say whether both did
the same: a tumbling cube differs more and more after its second impact.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

from ..sim.constitutive import ElasticMaterial
from ..sim.mpm.bodies import BodyParticles
from ..sim.mpm.solver_options import Ground, SolverOptions
from ..sim.mpm.world import World
from ..sim.scene.units import ENGINE_BOX_SIZE, Similarity

SIDE, CELLS, GRID = 0.1, 6, 64


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


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one scene and stiffness: checks that it runs")
    quick = parser.parse_args().quick
    scenes = {
        "rests": (0.0, 0.0, (0.0, 0.0, 0.0)),
        "slides": (0.0, 0.0, (1.2, 0.0, 0.0)),
        "tumbles": (0.15, 0.3, (0.3, 0.0, 0.0)),
    }
    for name, (height, angle, velocity) in list(scenes.items())[: 1 if quick else 3]:
        # Once for the compiler.
        for implicit in (False, True):
            run(cube(1e8, height=height, angle=angle, velocity=velocity), 1 / 24, implicit=implicit)
        for youngs_modulus in (1e7,) if quick else (1e5, 1e6, 1e7, 1e8):
            for implicit in (False, True):
                body = cube(youngs_modulus, height=height, angle=angle, velocity=velocity)
                world, cpu = run(body, 1 / 12 if quick else 0.5, implicit=implicit)
                place, speed = world.positions(0).mean(axis=0), world.velocities(0).mean(axis=0)
                print(
                    f"{name:8} E {youngs_modulus:.0e}  {'implicit' if implicit else 'explicit'}: "
                    f"{world.particle_passes:6} passes, {cpu:6.2f} CPU s, centre at x {place[0]:.4f} z {place[2]:.4f}, "
                    f"{np.linalg.norm(speed):.3f} m/s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
