# SPDX-License-Identifier: MIT
"""All checks of the engine on a graphics card, by one command: same motion, speed, host reads, memory, worlds, splats.

    sh benchmarks/gpu.sh                 # where a card is
    sh benchmarks/gpu.sh --quick         # seconds, on the CPU where there is none; its figures mean nothing

Motion: bodies of every matter on the card and on the CPU, mean places within TOLERANCE, and the quick tests of
tests/validation with PHYSGEN_TEST_ARCH set. Speed: benchmarks.mpm beside AIMS. Host reads: how often the host reads
from the device per substep within a frame, where each read waits for the card; wanted 0. Memory: bytes a particle
that the process grows by, on the card as nvidia-smi counts, on the CPU in resident memory. Exit code 1 where motion
differs or a test fails.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from physgen.benchmarks import mpm, splats, worlds
from physgen.benchmarks.common import benchmark_parser
from physgen.sim.memory import return_freed_memory

AIMS = {20_000: 200.0, 100_000: 600.0, 1_000_000: 1800.0, 8_000_000: 2500.0}
"""Million particle substeps a second that are wanted on an H200; the best others reach 110, 308, 519 and 691."""

TOLERANCE = 0.02
"""Cells by which the mean place of a body may differ between card and CPU after MOTION_S: sums are in another order."""

MOTION_S = 0.1
CELL = 2.0 / 64
ROOT = Path(__file__).resolve().parents[1]
QUICK_TESTS = ("tests/validation/test_mpm_contact.py", "-k", "ice")


def mixed_world(arch: str, threads: int = 0) -> Any:
    """A world of jelly, sand, water and a rigid block, dropped side by side and onto each other."""
    import trimesh
    from physgen.sim.constitutive import ElasticMaterial, FluidMaterial, RigidMaterial, SandMaterial
    from physgen.sim.mpm.bodies import BodyParticles
    from physgen.sim.mpm.colliders import Surface
    from physgen.sim.mpm.solver_options import Ground, SolverOptions
    from physgen.sim.mpm.world import World
    from physgen.sim.scene.units import Similarity

    spacing, side = CELL / 2, 6 * CELL
    axis = (np.arange(12) + 0.5) * spacing - side / 2
    block = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    kinds = {
        "jelly": (ElasticMaterial(density=1000.0, youngs_modulus=1e5, poisson_ratio=0.3), (0.0, 0.0)),
        "sand": (SandMaterial(density=1600.0, youngs_modulus=1e6, poisson_ratio=0.3, friction_angle=0.6), (0.25, 0.0)),
        "water": (FluidMaterial(density=1000.0, bulk_modulus=1e5, viscosity=0.1), (-0.25, 0.0)),
        "wood": (RigidMaterial(density=500.0), (0.05, 0.0)),
    }
    bodies = []
    for name, (material, (x, y)) in kinds.items():
        middle = np.array([x, y, side / 2 + (1.3 * side if name == "wood" else 0.02)])
        mesh = trimesh.creation.box((side, side, side))
        bodies.append(
            BodyParticles(
                name=name,
                positions=block + middle,
                volumes=np.full(len(block), spacing**3),
                contact_radii=np.full(len(block), spacing / 2),
                material=material,
                surface=Surface(vertices=np.asarray(mesh.vertices) + middle, faces=np.asarray(mesh.faces)),
                velocity=(0.0, 0.0, -1.0),
            )
        )
    return World(
        bodies=bodies,
        ground=Ground(friction=0.4),
        similarity=Similarity(scale=1.0, origin=(-1.0, -1.0, -1.0)),
        options=SolverOptions(grid=64, arch=arch, threads=threads),
    )


def places(arch: str, duration: float) -> tuple[str, np.ndarray]:
    """The architecture in use, and the centre of each body (B, 3) of the mixed world after ``duration`` s, in cells."""
    world = mixed_world(arch)
    world.advance(duration)
    centres = [
        world.pose(b.name).center if b.rigid else world.positions(i).mean(axis=0) for i, b in enumerate(world.bodies)
    ]
    return world.arch, np.array(centres) / CELL


def motion(arch: str, duration: float) -> dict[str, Any]:
    """Largest difference between ``arch`` and the CPU in cells."""
    used, there = places(arch, duration)
    here = places("cpu", duration)[1]
    apart = float(np.abs(there - here).max())
    return {"arch": used, "difference_cells": apart, "good": bool(apart <= TOLERANCE)}


@contextlib.contextmanager
def counted_reads() -> Iterator[list[int]]:
    """Count what the host reads from arrays on the device: single elements and whole arrays."""
    import taichi as ti

    count = [0]
    scalar, kinds = ti.lang._ndarray.ScalarNdarray, (ti.lang._ndarray.ScalarNdarray, ti.VectorNdarray, ti.MatrixNdarray)
    kept: list[tuple[type, str, Any]] = [(scalar, "__getitem__", scalar.__getitem__)]
    kept += [(kind, "to_numpy", kind.to_numpy) for kind in kinds]

    def counting(call: Any) -> Any:
        def read(*arguments: Any, **options: Any) -> Any:
            count[0] += 1
            return call(*arguments, **options)

        return read

    for owner, name, call in kept:
        setattr(owner, name, counting(call))
    try:
        yield count
    finally:
        for owner, name, call in kept:
            setattr(owner, name, call)


def host_reads(arch: str, frame: float) -> dict[str, Any]:
    """Reads of the host within one frame of ``frame`` s, and per substep."""
    world = mixed_world(arch)
    world.advance(1e-3)
    before = world.substeps
    with counted_reads() as count:
        world.advance(frame)
    substeps = world.substeps - before
    return {"reads": count[0], "substeps": substeps, "per_substep": round(count[0] / substeps, 3), "wanted": 0}


def used_bytes(arch: str) -> int:
    """Bytes that this process holds: on the card as nvidia-smi has it, otherwise resident."""
    if arch == "cuda" and shutil.which("nvidia-smi"):
        query = ["nvidia-smi", "--query-compute-apps=pid,used_memory", "--format=csv,noheader,nounits"]
        for line in subprocess.run(query, capture_output=True, text=True, check=True).stdout.splitlines():
            pid, mebibytes = (part.strip() for part in line.split(","))
            if int(pid) == os.getpid():
                return int(mebibytes) << 20
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def memory(arch: str, particles: int) -> dict[str, Any]:
    """Growth of the process a particle by a world of ``particles``, after one of a hundredth that loads the code."""
    _advanced(max(400, particles // 100), arch)
    # What importing left behind would be given back meanwhile, and hide as much of the world.
    gc.collect()
    return_freed_memory()
    before = used_bytes(arch)
    world = _advanced(particles, arch)
    grown = used_bytes(arch) - before
    count = sum(body.count for body in world.bodies)
    return {
        "particles": count,
        "grown_bytes": round(grown / count, 1),
        "array_bytes": round(world.device_bytes / count, 1),
    }


def _advanced(particles: int, arch: str) -> Any:
    """The world of benchmarks.mpm of so many particles, after ten substeps."""
    world = mpm.world_of(particles, arch=arch, threads=0, cache_folder=None)
    world.advance(1e-3)
    return world


def tests(arch: str, quick: bool) -> dict[str, Any]:
    """The validation of the engine on ``arch``: how pytest ended."""
    chosen = QUICK_TESTS if quick else ("-n", "auto", "tests/validation", "-m", "not long and not slow")
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", *chosen],
        cwd=ROOT,
        env={**os.environ, "PHYSGEN_TEST_ARCH": arch},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = done.stdout.strip().splitlines() or ["no output"]
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    return {
        "good": done.returncode == 0,
        "last": lines[-1],
        "failed": failed,
        "wall_s": round(time.perf_counter() - start, 1),
    }


def speed(arch: str, particles: int, quick: bool) -> dict[str, Any]:
    """One run of benchmarks.mpm in a process of its own, beside its aim."""
    steps = ["--steps", "10", "--repeats", "1"] if quick else []
    command = [
        sys.executable,
        "-m",
        "physgen.benchmarks.mpm",
        "--arch",
        arch,
        "--particles",
        str(particles),
        "--json",
        *steps,
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"particles": particles, "error": done.stderr.strip()[-500:]}
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return {**found, "aim_mpps": AIMS.get(particles)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser(
        "gpu", __doc__, arch="cpu", particles=[2000], memory=4000, frame=0.01, splats=500, size=64
    )
    parser.add_argument("--arch", default="cuda", help="cuda, vulkan or cpu (default: %(default)s)")
    parser.add_argument(
        "--particles", type=int, nargs="+", default=list(AIMS), help="for the speed (default: %(default)s)"
    )
    parser.add_argument("--memory", type=int, default=1_000_000, help="particles for the memory (default: %(default)s)")
    parser.add_argument("--frame", type=float, default=1 / 24, help="seconds, for host reads (default: 1/24)")
    parser.add_argument("--splats", type=int, default=100_000, help="(default: %(default)s)")
    parser.add_argument("--size", type=int, default=512, help="pixels of the splats' picture (default: %(default)s)")
    options = parser.parse_args(arguments)
    moved = motion(options.arch, 0.01 if options.quick else MOTION_S)
    if moved["arch"] != options.arch and not options.quick:
        print(f"{options.arch} is not available here: nothing was checked; --quick runs on the CPU", file=sys.stderr)
        return 1
    small = options.quick or moved["arch"] == "cpu"
    found = {
        "arch": moved["arch"],
        "note": "on the CPU: nothing here was measured on a card" if moved["arch"] == "cpu" else "",
        "motion": moved,
        "tests": tests(options.arch, options.quick),
        "speed": [speed(options.arch, n, options.quick) for n in options.particles],
        "host_reads": host_reads(options.arch, options.frame),
        "memory": memory(options.arch, options.memory),
        "worlds": worlds.run(2 if small else 32, 500 if small else 2744, 0.01 if small else 0.1, 0, options.arch),
        "splats": [
            splats.run(options.splats, options.size, look, 1 if small else 5, options.arch, 0) for look in splats.LOOKS
        ],
    }
    if options.json:
        print(json.dumps(found))
    else:
        for name, value in found.items():
            for row in value if isinstance(value, list) else [value]:
                print(f"{name:11} {row}")
    return 0 if moved["good"] and found["tests"]["good"] else 1


if __name__ == "__main__":
    sys.exit(main())
