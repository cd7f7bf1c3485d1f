# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast a bake is attached and plays: ``python -m physgen.benchmarks.playback``, in a Python that has bpy.

A sphere of 20 000 vertices and 120 frames, as the issue of the extension asks: attach below 0.5 s, 24 frames a second.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import bpy
import numpy as np
import physgen
from physgen.physgen_addon import bake_record, bake_state, paths
from physgen.physgen_addon.bake_record import BakeRecord, Look
from physgen.physgen_addon.bridge.fingerprint import fingerprint
from physgen.sim.cache.manifest import BakedObject, BakeManifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer


def main() -> None:
    """Make the bake, attach it, play it, and say how long that took."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vertices", type=int, default=20_000)
    parser.add_argument("--frames", type=int, default=120)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        physgen.register()
        _measure(Path(folder), options.vertices, options.frames)


def _measure(folder: Path, vertices: int, frames: int) -> None:
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
    bake.mkdir(parents=True)
    with Pc2Writer(bake / "ball.pc2", vertex_count=len(rest)) as writer:
        for index in range(frames):
            writer.append(rest * (1 + 0.2 * np.sin(0.2 * index)))
    baked = BakedObject(name="ball", file="ball.pc2", vertices=len(rest), space="mesh")
    manifest = BakeManifest(
        inputs_hash="0",
        fps=24.0,
        frame_start=1,
        frames=frames,
        frames_done=frames,
        state="complete",
        engine="benchmark",
        version="0",
        particles=1,
        objects=(baked,),
    )
    save_manifest(bake, manifest)
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
    sys.stdout.write(
        f"{len(rest)} vertices, {frames} frames, Blender {bpy.app.version_string}: {state.status}; "
        f"fingerprint {1e3 * told:.1f} ms, found and attached in {1e3 * attached:.1f} ms, "
        f"{frames / played:.0f} frames a second\n"
    )


if __name__ == "__main__":
    main()
