# SPDX-License-Identifier: GPL-3.0-or-later
"""Time to attach a bake in Blender, and its playback speed. Needs bpy.

    python -m physgen.benchmarks.playback [--vertices 20000] [--frames 120]

Required: attach within 0.5 s, 24 frames per second.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import physgen
from physgen.benchmarks.common import benchmark_parser, blender_output_to_stderr, print_result, write_bake
from physgen.physgen_addon import bake_state, paths
from physgen.physgen_addon.playback import bake_record
from physgen.physgen_addon.playback.bake_record import BakeRecord, Look
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = benchmark_parser("playback", __doc__, vertices=500, frames=10)
    parser.add_argument("--vertices", type=int, default=20_000, help="of the sphere (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=120, help="frames of the bake (default: %(default)s)")
    options = parser.parse_args(arguments)
    with blender_output_to_stderr(), tempfile.TemporaryDirectory() as folder:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        physgen.register()
        result = _measure(Path(folder), options.vertices, options.frames)
    print_result(result, as_json=options.json)
    return 0


def _measure(folder: Path, vertices: int, frames: int) -> dict[str, Any]:
    """Write a bake of a sphere, attach it, play it; return the figures."""
    rings = round((vertices / 2) ** 0.5)
    bpy.ops.mesh.primitive_uv_sphere_add(segments=2 * rings, ring_count=rings, radius=0.5)
    item, scene = bpy.context.object, bpy.context.scene
    item.name = "ball"
    item.physgen.enabled = True
    item.location = (0.0, 0.0, 2.0)
    bpy.context.view_layer.update()
    simulation = scene.physgen.simulation
    simulation.frame_start, simulation.frame_end = 1, frames
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "file.blend"))
    rest = np.empty(3 * len(item.data.vertices), dtype=np.float32)
    item.data.vertices.foreach_get("co", rest)
    rest = rest.reshape(-1, 3)
    bake = paths.scene_cache(scene) / bake_record.BAKES / "benchmark"
    motion = (rest * (1 + 0.2 * np.sin(0.2 * index)) for index in range(frames))
    write_bake(bake, {"ball": motion}, space="mesh")
    began = time.perf_counter()
    mark = fingerprint(scene)
    told = time.perf_counter() - began
    bake_record.write_record(
        BakeRecord(folder=str(bake), fingerprints=(mark,), frame_start=1, looks=(Look(name="ball"),))
    )
    began = time.perf_counter()
    state = bake_state.refresh(scene)
    attached = time.perf_counter() - began
    began = time.perf_counter()
    for frame in range(1, frames + 1):
        scene.frame_set(frame)
    played = time.perf_counter() - began
    return {
        "blender": bpy.app.version_string,
        "vertices": len(rest),
        "frames": frames,
        "status": state.status,
        "fingerprint_ms": round(1e3 * told, 1),
        "attach_ms": round(1e3 * attached, 1),
        "fps": round(frames / played),
    }


if __name__ == "__main__":
    sys.exit(main())
