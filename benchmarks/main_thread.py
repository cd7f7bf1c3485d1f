# SPDX-License-Identifier: GPL-3.0-or-later
"""Time that a bake blocks Blender's main thread. Needs bpy.

    python -m physgen.benchmarks.main_thread [--quality fine] [--law sand] [--frames 3]

A real bake, polled every tenth of a second as by the modal timer of Blender's interface. Also reports the start, in
which the scene is exported for the worker.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import bpy
import physgen
from physgen.benchmarks.common import benchmark_parser, blender_output_to_stderr, print_result
from physgen.physgen_addon import background_jobs, bake_state, handlers
from physgen.physgen_addon.operators.bake_ops import Bake

T = TypeVar("T")


class _Timed(Bake):
    """A bake that prints its messages."""

    def report(self, kind: set[str], text: str) -> None:
        """Print it."""
        sys.stderr.write(f"{', '.join(kind)}: {text}\n")


@dataclass
class _Times:
    """Durations of calls: wall time, and thread CPU time, which other programs do not lengthen."""

    wall: list[float] = field(default_factory=list)
    computing: list[float] = field(default_factory=list)

    def take(self, call: Callable[[], T]) -> T:
        """Call, and measure it."""
        began, computed = time.perf_counter(), time.thread_time()
        result = call()
        self.wall.append(time.perf_counter() - began)
        self.computing.append(time.thread_time() - computed)
        return result

    def __str__(self) -> str:
        if not self.wall:
            return "none"
        return (
            f"{len(self.wall)} calls, longest {1e3 * max(self.wall):.1f} ms wall and "
            f"{1e3 * max(self.computing):.1f} ms CPU, mean {1e3 * sum(self.wall) / len(self.wall):.2f} ms"
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code, 1 if the bake did not finish."""
    parser = benchmark_parser(
        "main_thread", __doc__, quality="preview", law="fixed_corotated", frames=2, subdivisions=3
    )
    parser.add_argument("--quality", default="fine", help="fine has over 100 000 particles (default: %(default)s)")
    parser.add_argument("--law", default="sand", help="sand and fluid are shown as particles (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=3, help="frames to bake (default: %(default)s)")
    text = "of the sphere: 5 is 2562 vertices, 7 is 40 962 (default: %(default)s)"
    parser.add_argument("--subdivisions", type=int, default=5, help=text)
    options = parser.parse_args(arguments)
    with blender_output_to_stderr(), tempfile.TemporaryDirectory() as folder:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        physgen.register()
        result = _measure(Path(folder), options)
    print_result(result, as_json=options.json)
    return 0 if result["frames_done"] == options.frames else 1


def _measure(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Bake a sphere; return durations as text and the state."""
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=options.subdivisions, radius=0.2, location=(0, 0, 0.25))
    bpy.context.view_layer.update()
    item, scene = bpy.context.object, bpy.context.scene
    item.physgen.enabled, item.physgen.material.law = True, options.law
    simulation = scene.physgen.simulation
    simulation.quality, simulation.frame_start, simulation.frame_end = options.quality, 1, options.frames
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "file.blend"))
    bake, looks, timer = _Timed(), _Times(), _Times()
    start = _Times()
    job = start.take(lambda: bake.begin(bpy.context))
    result = None
    while result is None:
        result = looks.take(bake.tick)
        if len(looks.wall) % 5 == 0:
            timer.take(handlers.look)
        time.sleep(background_jobs.STEP_S)
    state = bake_state.state(scene)
    particles = sum(len(other.data.vertices) for other in scene.objects if other != item)
    return {
        "result": ", ".join(result),
        "status": state.status,
        "frames_done": state.frames_done,
        "vertices": len(item.data.vertices),
        "particles": particles,
        "start (export)": str(start),
        "modal timer": str(looks),
        "background timer": str(timer),
        "longest tick, ms": round(1e3 * job.longest_tick_s, 1),
    }


if __name__ == "__main__":
    sys.exit(main())
