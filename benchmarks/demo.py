# SPDX-License-Identifier: GPL-3.0-or-later
"""Wall and CPU seconds of each stage of the demo.

    python -m physgen.benchmarks.demo [--frames N] [--json]

The stages run as they do for a user, in a temporary folder. CPU seconds include child processes, so they are
meaningful on a busy machine too.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from physgen.batch import demo, stages
from physgen.benchmarks.common import benchmark_parser
from physgen.sim.app.add_drops import add_drops
from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.app.set_light import set_light
from physgen.sim.cache.bake_folder import load_bake, load_manifest
from physgen.sim.events import ignore, never
from physgen.sim.scene.folder import Scene, load_scene


def measure(stage: Callable[[], object]) -> dict[str, float]:
    """Return wall and CPU seconds of ``stage``, children included."""
    before, started = os.times(), time.perf_counter()
    stage()
    after = os.times()
    cpu = sum(after[:4]) - sum(before[:4])
    return {"wall_s": round(time.perf_counter() - started, 2), "cpu_s": round(cpu, 2)}


def lit(scene: Scene, job: stages.RunRequest) -> Scene:
    """Return ``scene`` in the light of ``job``."""
    return scene if job.light is None else set_light(scene, request=job.light)


def run(frames: int | None, out: Path, *, quick: bool = False) -> dict[str, Any]:
    """Run the demo's stages one after another in ``out``; return their times by name."""
    config = demo.load_config()
    if frames is not None:
        config = dataclasses.replace(config, frames=frames)
    job = demo.request(config, out)
    if quick:
        render = dataclasses.replace(job.render, samples=1, scale=0.1, motion_blur=0.0)
        job = dataclasses.replace(job, bake=dataclasses.replace(job.bake, quality="preview"), render=render)
    scene, bake, images = out / "scene", out / "bake", out / "frames"
    calls: dict[str, Callable[[], object]] = {
        "reconstruct": lambda: lit(
            reconstruct(job.photo, job.objects, out=scene, options=job.reconstruct, physics=job.physics), job
        ),
        "bake": lambda: stages.run_bake(add_drops(load_scene(scene), job.drops), bake, job.bake, ignore, never),
        "render": lambda: stages.render(
            load_scene(scene), load_bake(bake), out=images, options=job.render, video=job.video
        ),
    }
    times: dict[str, dict[str, float]] = {}
    for name, call in calls.items():
        times[name] = measure(call)
    total = {key: round(sum(t[key] for t in times.values()), 2) for key in ("wall_s", "cpu_s")}
    return {"frames": config.frames, "particles": load_manifest(bake).particles, "stages": times, "total": total}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("demo", __doc__, frames=2)
    parser.add_argument("--frames", type=int, help="instead of the demo's own")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as folder:
        result = run(options.frames, Path(folder), quick=options.quick)
    if options.json:
        print(json.dumps(result))
        return 0
    print(
        f"coffee demo, {result['frames']} frames, {result['particles']} particles\n\n"
        "| stage | wall s | CPU s |\n| --- | --- | --- |"
    )
    for name, times in [*result["stages"].items(), ("all", result["total"])]:
        print(f"| {name} | {times['wall_s']:.1f} | {times['cpu_s']:.1f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
