# SPDX-License-Identifier: MIT
"""Time to render Gaussian splats and their gradients: a sphere of splats with a checkered surface.

    python -m physgen.benchmarks.splats --splats 5000 20000 100000 --sizes 128 256 512 --json

Medians of the repeats: CPU seconds of all threads, because the machine may be busy, and wall seconds, for GPUs.
"thin" splats are those at the end of a fit (nearly opaque, on the surface), "dense" those at its start (three times as
large, opacity 0.1, many layers).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from physgen.benchmarks.common import benchmark_parser

LOOKS = {"thin": (1.0, 0.9), "dense": (3.0, 0.1)}
"""Size relative to the spacing, opacity."""

DISTANCE, RADIUS = 0.35, 0.1


def ball(count: int, look: str) -> Any:
    """Return ``count`` flat splats spread evenly over a sphere."""
    from physgen.sim.gaussians.splats import Splats

    size, opacity = LOOKS[look]
    steps = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * steps / count), np.pi * (1 + 5**0.5) * steps
    outward = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], axis=-1)
    spread = RADIUS * size * 0.5 * np.sqrt(4 * np.pi / count)
    field = np.floor(polar / np.pi * 8) + np.floor(around % (2 * np.pi) / (2 * np.pi) * 16)
    return Splats(
        centres=RADIUS * outward,
        scales=np.tile([spread, spread, 0.1 * spread], (count, 1)),
        # The rotation that takes the splat's z to the surface's normal.
        rotations=np.stack([1 + outward[:, 2], -outward[:, 1], outward[:, 0], np.zeros(count)], axis=-1),
        opacities=np.full(count, opacity),
        colours=np.where((field % 2 == 0)[:, None], [0.1, 0.3, 0.8], [0.9, 0.2, 0.1]),
    )


def view(size: int) -> Any:
    """Return a camera of ``size`` pixels squared that the sphere nearly fills."""
    from physgen.sim.scene.model import Camera

    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    pose[:3, 3] = [0, -DISTANCE, 0]
    focal = 1.4 * size
    return Camera(width=size, height=size, fx=focal, fy=focal, cx=size / 2, cy=size / 2, world_from_camera=pose)


def run(count: int, size: int, look: str, repeats: int, arch: str, threads: int) -> dict[str, object]:
    """Return the seconds of one configuration, after a run that compiles the kernels."""
    from physgen.sim.gaussians.raster.rasteriser import Rasteriser
    from physgen.sim.mpm.solver_options import SolverOptions

    rasteriser = Rasteriser(solver=SolverOptions(arch=arch, threads=threads))
    splats, camera = ball(count, look), view(size)
    rasteriser.gradients(rasteriser.render(splats, camera).colour)
    times = []
    for _ in range(repeats):
        start = time.process_time(), time.perf_counter()
        seen = rasteriser.render(splats, camera)
        middle = time.process_time(), time.perf_counter()
        rasteriser.gradients(seen.colour)
        end = time.process_time(), time.perf_counter()
        times.append([middle[0] - start[0], end[0] - middle[0], middle[1] - start[1], end[1] - middle[1]])
    medians = [round(float(value), 4) for value in np.median(times, axis=0)]
    names = ("render_cpu_s", "gradients_cpu_s", "render_s", "gradients_s")
    return {"splats": count, "size": size, "look": look, **dict(zip(names, medians, strict=True))}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("splats", __doc__, splats=[500], sizes=[64], repeats=1)
    parser.add_argument(
        "--splats",
        type=int,
        nargs="+",
        default=[5000, 20000, 100000],
        help="numbers of splats (default: 5000 20000 100000)",
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[256], help="image sizes in pixels (default: 256)")
    parser.add_argument("--repeats", type=int, default=5, help="repetitions (default: %(default)s)")
    parser.add_argument("--arch", default="cpu", help="cpu or cuda (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads, 0 for all (default: %(default)s)")
    options = parser.parse_args(arguments)
    if min(options.splats + options.sizes + [options.repeats]) < 1:
        parser.error("give at least one splat, pixel and repeat")
    results = [
        run(count, size, look, options.repeats, options.arch, options.threads)
        for count in options.splats
        for size in options.sizes
        for look in LOOKS
    ]
    if options.json:
        print(json.dumps({"results": results}))
    else:
        print(" ".join(f"{name:>16}" for name in results[0]))
        for result in results:
            print(" ".join(f"{value!s:>16}" for value in result.values()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
