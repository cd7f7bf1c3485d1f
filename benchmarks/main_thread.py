# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a bake holds Blender's main thread: ``python -m physgen.benchmarks.main_thread``, in a Python that has bpy.

A real bake, looked at as the modal timer of Blender's interface looks at it, every tenth of a second. Also printed is
what starting it takes, which is when the scene is written for the worker.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import bpy
import physgen
from physgen.physgen_addon import bake_state, handlers, jobs
from physgen.physgen_addon.operators.bake import Bake

T = TypeVar("T")


class _Timed(Bake):
    """A bake whose messages nobody reads."""

    def report(self, kind: set[str], text: str) -> None:
        """Print it."""
        sys.stdout.write(f"{', '.join(kind)}: {text}\n")


@dataclass
class _Times:
    """Seconds that calls took: by the clock, and of computing, which other programs do not make longer."""

    wall: list[float] = field(default_factory=list)
    computing: list[float] = field(default_factory=list)

    def take(self, call: Callable[[], T]) -> T:
        """Call and measure it."""
        began, computed = time.perf_counter(), time.thread_time()
        result = call()
        self.wall.append(time.perf_counter() - began)
        self.computing.append(time.thread_time() - computed)
        return result

    def __str__(self) -> str:
        if not self.wall:
            return "none"
        return (
            f"{len(self.wall)} calls, longest {1e3 * max(self.wall):.1f} ms by the clock and "
            f"{1e3 * max(self.computing):.1f} ms of computing, mean {1e3 * sum(self.wall) / len(self.wall):.2f} ms"
        )


def main() -> None:
    """Bake, and say how long the longest looks took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quality", default="fine", help="fine has more than 100 000 particles")
    parser.add_argument("--law", default="sand", help="sand and fluid are shown as particles")
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--subdivisions", type=int, default=5, help="of the ball: 5 is 2562 vertices, 7 is 40 962")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        physgen.register()
        _measure(Path(folder), options)


def _measure(folder: Path, options: argparse.Namespace) -> None:
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
        time.sleep(jobs.STEP_S)
    state = bake_state.state(scene)
    sys.stdout.write(
        f"{result}, {state.status}, {state.frames_done} of {state.frames} frames, {len(item.data.vertices)} vertices, "
        f"{sum(len(other.data.vertices) for other in scene.objects if other != item)} particles\n"
        f"start (export): {start}\nmodal timer: {looks}\nbackground timer: {timer}\n"
        f"the job's own measure: {1e3 * job.longest_tick_s:.1f} ms\n"
    )


if __name__ == "__main__":
    main()
