# SPDX-License-Identifier: GPL-3.0-or-later
"""Cost and run-out of a column of sand beside another engine's: Newton's implicit MPM.

    python -m physgen.benchmarks.peers [--newton PYTHON] [--particles 8192 27648] [--json]

A column of 0.4 × 0.4 × 0.8 m falls on a ground for a second, 8 particles a cell: cells of 50 mm with 8,192 particles,
of 33 mm with 27,648. Both engines get the same particles, density, angle and friction, and one CPU thread each, in
turn; compilation and the first substep are not counted. Newton's grains are rigid and its step is that of its own
granular example (1/60 s); ours are the preset's. Newton is not installed with this project: ``--newton`` names a
Python of an environment in which ``pip install newton`` was run; without it our side runs alone.

``run_out``: half the side of the square around the middle that holds 95 % of the grains, over that at the start.
``height``: of 98 % of the grains, over the column's.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from physgen.benchmarks.common import benchmark_parser

if TYPE_CHECKING:
    from physgen.sim.scene.folder import Scene

SIDES = np.array([0.4, 0.4, 0.8])
GRAVITY, GROUND_FRICTION = 9.81, 0.5
GRID = 64
"""Cells along the engine's box, which sets the cell's size and is no wall."""

STEPS_PER_SECOND = 60
"""Of Newton: what its example of grains takes."""

Points = NDArray[np.float64]


def column(particles: int, seed: int = 0) -> tuple[Points, float]:
    """Return about ``particles`` jittered points (N, 3) in metres, z up from the ground at 0, and the cell's side."""
    across = max(2, round((particles / 2) ** (1 / 3)))
    counts = np.array([across, across, 2 * across])
    spacing = SIDES[0] / across
    places = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    jitter = np.random.default_rng(seed).uniform(-0.25, 0.25, places.shape)
    return (places + jitter) * spacing, 2 * spacing


def shape(points: NDArray[np.floating], start: Points) -> dict[str, float]:
    """Return run-out and height of ``points`` (N, 3) over those of ``start``."""

    def reach(of: NDArray[np.floating]) -> float:
        return float(np.quantile(np.abs(of[:, :2] - np.median(of[:, :2], axis=0)).max(axis=1), 0.95))

    return {
        "run_out": round(reach(points) / reach(start), 3),
        "height": round(float(np.quantile(points[:, 2], 0.98) / np.quantile(start[:, 2], 0.98)), 3),
    }


def ours(
    points: Points, cell: float, seconds: float, max_step: float, cache_folder: Path | None
) -> tuple[dict[str, Any], Points]:
    """Let the column fall in this project's engine; return its figures and the last positions."""
    from physgen.sim.app.scene_bodies import engine_material
    from physgen.sim.mpm.bodies import BodyParticles
    from physgen.sim.mpm.solver_options import SolverOptions
    from physgen.sim.mpm.world import World
    from physgen.sim.scene.material import load_preset
    from physgen.sim.scene.model import Ground
    from physgen.sim.scene.units import ENGINE_BOX_SIZE, Similarity

    world = World(
        bodies=[
            BodyParticles(
                name="column",
                positions=points,
                volumes=np.full(len(points), cell**3 / 8),
                material=engine_material(load_preset("sand")),
            )
        ],
        ground=Ground(friction=GROUND_FRICTION),
        similarity=Similarity(scale=ENGINE_BOX_SIZE / (GRID * cell)),
        options=SolverOptions(grid=GRID, threads=1, max_step=max_step, cache_folder=cache_folder),
    )
    world.advance(1e-6)
    before, substeps = time.process_time(), world.substeps
    world.advance(seconds)
    spent = time.process_time() - before
    return {"engine": "physgen", "cpu_s": round(spent, 2), "steps": world.substeps - substeps}, world.positions(0)


def newtons(points: Points, cell: float, seconds: float, python: str) -> tuple[dict[str, Any], NDArray[np.floating]]:
    """Let the column fall in Newton, run by ``python``; return its figures and the last positions."""
    from physgen.sim.scene.material import load_preset

    sand = load_preset("sand")
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as scratch:
        file = Path(scratch) / "points.npy"
        np.save(file, points)
        task = {
            "points": str(file),
            "cell": cell,
            "seconds": seconds,
            "steps_per_second": STEPS_PER_SECOND,
            "gravity": GRAVITY,
            "density": sand.density,
            "friction": math.tan(sand.friction_angle),
            "ground_friction": GROUND_FRICTION,
        }
        found, moved = asked_newton(task, python, Path(scratch))
    row = {"engine": f"newton {found['version']}", "cpu_s": round(found["cpu_s"], 2)}
    return {**row, "steps": round(seconds * STEPS_PER_SECOND)}, moved


def asked_newton(task: dict[str, Any], python: str, scratch: Path) -> tuple[dict[str, Any], NDArray[np.floating]]:
    """Return what ``newton_run.py``, run by ``python``, prints of ``task``, and the particles (N, 3) at its end.

    Raises RuntimeError with the end of what it said where it fails.
    """
    out = scratch / "out.npy"
    words = json.dumps({**task, "out": str(out)})
    script = Path(__file__).with_name("newton_run.py")
    done = subprocess.run([python, script], input=words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"Newton, run by {python}, ended with {done.returncode}: {done.stderr[-1500:]}")
    return json.loads(done.stdout.strip().splitlines()[-1]), np.load(out, allow_pickle=False)


def usd_scene(root: Path) -> Scene:
    """Write a block of jelly that falls by 50 mm, and a column of sand that stands, beside each other on a ground."""
    import trimesh
    from physgen.sim.scene.folder import save_scene
    from physgen.sim.scene.material import load_preset
    from physgen.sim.scene.model import Camera, Ground, SceneModel, SceneObject

    (root / "meshes").mkdir(parents=True)
    items = []
    for name, sides, place in (("jelly", (0.2, 0.2, 0.2), (-0.4, 0, 0.15)), ("sand", (0.2, 0.2, 0.3), (0.4, 0, 0.15))):
        mesh = trimesh.creation.box(sides)
        mesh.apply_translation(place)
        mesh.export(root / "meshes" / f"{name}.ply")
        material = load_preset(name)
        items.append(SceneObject(name=name, mesh=f"meshes/{name}.ply", size_m=max(sides), material=material))
    away = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -3.0), (0.0, -1.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    camera = Camera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0, world_from_camera=away)
    ground = Ground(friction=GROUND_FRICTION)
    return save_scene(root, SceneModel(camera=camera, objects=tuple(items), ground=ground, photo=None, background=None))


def through_usd(seconds: float, steps_per_second: int, python: str | None) -> list[dict[str, Any]]:
    """Simulate ``usd_scene`` here, and in Newton from its export; return heights of the centres of mass, m."""
    from physgen.sim.app.export_usd import export_usd
    from physgen.sim.app.usd_particles import prepared_particles
    from physgen.sim.mpm.world import World

    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as scratch:
        scene = usd_scene(Path(scratch) / "scene")
        file = Path(scratch) / "scene.usda"
        export_usd(scene, file)
        prepared = prepared_particles(scene)[0]
        assert prepared is not None
        setup = prepared.setup
        world = World(
            bodies=setup.bodies,
            ground=setup.ground,
            contacts=setup.contacts,
            similarity=prepared.similarity,
            options=prepared.solver,
        )
        world.advance(seconds)
        here = {f"/World/{body.name}/matter": world.positions(i) for i, body in enumerate(setup.bodies)}
        begins = {f"/World/{body.name}/matter": body.positions for body in setup.bodies}
        there: dict[str, NDArray[np.floating]] = {}
        if python:
            task = {"usd": str(file), "seconds": seconds, "steps_per_second": steps_per_second}
            found, moved = asked_newton(task, python, Path(scratch))
            there = {path: moved[first:last] for path, (first, last) in found["ranges"].items()}
    return [
        {
            "body": path.split("/")[2],
            "particles": len(points),
            "start_m": round(float(begins[path][:, 2].mean()), 5),
            "physgen_m": round(float(points[:, 2].mean()), 5),
            "newton_m": round(float(there[path][:, 2].mean()), 5) if path in there else None,
        }
        for path, points in here.items()
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    options = _parser().parse_args(arguments)
    rows: list[dict[str, Any]] = []
    if options.usd:
        rows = through_usd(options.seconds, options.usd, options.newton)
        print("\n".join(str(row) for row in rows), file=sys.stderr)
        print(json.dumps({"seconds": options.seconds, "rows": rows}) if options.json else "")
        return 0
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as scratch:
        # Kept away from the user's cache only where nothing is measured.
        cache = Path(scratch) if options.quick else None
        for count in options.particles:
            points, cell = column(count)
            for repeat in range(options.repeats):
                found = [ours(points, cell, options.seconds, step, cache) for step in options.max_step]
                if options.newton:
                    found.append(newtons(points, cell, options.seconds, options.newton))
                for row, moved in found:
                    rows.append({"particles": len(points), "run": repeat, **row, **shape(moved, points)})
                    print(" ".join(f"{k} {v}" for k, v in rows[-1].items()), file=sys.stderr, flush=True)
    if options.json:
        print(json.dumps({"seconds": options.seconds, "rows": rows}))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = benchmark_parser("peers", __doc__, particles=[128], seconds=0.02, repeats=1)
    parser.add_argument("--newton", metavar="PYTHON", help="a Python that has newton; without it our side runs alone")
    parser.add_argument("--particles", type=int, nargs="+", default=[8192, 27648], help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="simulated (default: %(default)s)")
    text = "instead, simulate what `physgen export` writes, in Newton with N steps a second (240 is fine)"
    parser.add_argument("--usd", type=int, metavar="N", help=text)
    steps = "our longest substeps in seconds, a row each; the first is the bake's (default: %(default)s)"
    parser.add_argument("--max-step", type=float, nargs="+", default=[1e-3, 5e-4], help=steps)
    parser.add_argument("--repeats", type=int, default=2, help="pairs of runs (default: %(default)s)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
