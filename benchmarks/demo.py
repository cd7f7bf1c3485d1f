# SPDX-License-Identifier: GPL-3.0-or-later
"""Times each stage of the demo: wall and CPU seconds.

    python benchmarks/demo.py [--frames N] [--json]

The stages run as they do for a user, in a folder that is thrown away. CPU seconds are those of the stage's own
process and its children, so they mean something on a busy machine too.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from physgen.batch import demo, pipeline
from physgen.sim.app.reconstruct import reconstruct_scene, set_physics
from physgen.sim.cache.manifest import load_manifest
from physgen.sim.events import ignore, never
from physgen.sim.scene.folder import load_scene


def measure(stage: Callable[[], object]) -> dict[str, float]:
    """Wall and CPU seconds of ``stage``, children included."""
    before, started = os.times(), time.perf_counter()
    stage()
    after = os.times()
    cpu = sum(after[:4]) - sum(before[:4])
    return {"wall_s": round(time.perf_counter() - started, 2), "cpu_s": round(cpu, 2)}


def run(frames: int | None, out: Path) -> dict[str, object]:
    """Run the demo's stages one after another in ``out``; their times by name."""
    config = demo.load_config()
    if frames is not None:
        config = dataclasses.replace(config, frames=frames)
    job = demo.request(config, out)
    scene, bake, images = out / "scene", out / "bake", out / "frames"
    stages: dict[str, Callable[[], object]] = {
        "reconstruct": lambda: reconstruct_scene(job.photo, job.objects, scene, job.reconstruct),
        "bake": lambda: pipeline.bake_stage(load_scene(scene), bake, job.bake, ignore, never),
        "render": lambda: pipeline.render_stage(scene, bake, images, job.render, ignore, never, video=job.video),
    }
    times: dict[str, dict[str, float]] = {}
    for name, stage in stages.items():
        times[name] = measure(stage)
        if name == "reconstruct":
            set_physics(scene, presets=job.presets, velocities=job.velocities)
    total = {key: round(sum(t[key] for t in times.values()), 2) for key in ("wall_s", "cpu_s")}
    return {"frames": config.frames, "particles": load_manifest(bake).particles, "stages": times, "total": total}


def main() -> int:
    """Entry."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, help="instead of the demo's 48")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as folder:
        result = run(options.frames, Path(folder))
    if options.json:
        print(json.dumps(result))
        return 0
    print(
        f"coffee demo, {result['frames']} frames, {result['particles']} particles\n\n"
        "| stage | wall s | CPU s |\n| --- | --- | --- |"
    )
    for name, times in [*result["stages"].items(), ("all", result["total"])]:  # type: ignore[attr-defined]
        print(f"| {name} | {times['wall_s']:.1f} | {times['cpu_s']:.1f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
