# SPDX-License-Identifier: GPL-3.0-or-later
"""What a frame costs, by stage; and what rendering only where something changes saves.

    python benchmarks/render.py [--engine cycles] [--frames N] [--json]

A 20k-vertex ball moves over a 640×480 photo, 32 samples, denoised. The same frames are rendered cropped, whole, and
whole with another seed, one after another in this process; CPU seconds are those of all its threads. The difference
between cropped and whole is set against the one between two seeds, which is noise.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from physgen.physgen_addon.bridge import passes, rest_light
from physgen.physgen_addon.bridge.caches import open_bake
from physgen.physgen_addon.bridge.options import ENGINES, RenderOptions
from physgen.physgen_addon.bridge.renderer import Renderer
from physgen.sim.cache.manifest import BakedObject, BakeManifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.composite.transfer import linear_to_bytes
from physgen.sim.errors import PhysGenError
from physgen.sim.scene.folder import SceneFolder, save_scene
from physgen.sim.scene.model import Camera, Light, Scene, SceneObject
from physgen.sim.version import VERSION
from PIL import Image

WIDTH, HEIGHT, SAMPLES = 640, 480, 32
RADIUS = 0.05
PITCH, BACK, UP = math.radians(35.0), 0.45, 0.32


def ball() -> trimesh.Trimesh:
    """20,002 vertices that rest on the ground."""
    mesh = trimesh.creation.uv_sphere(radius=RADIUS, count=[101, 100])
    mesh.merge_vertices()
    mesh.vertices += [0.0, 0.0, RADIUS]
    return mesh


def a_scene(root: Path) -> SceneFolder:
    """The ball before a floor of noise; as no one compares the first frame, the photo shows the floor alone."""
    s, c = math.sin(PITCH), math.cos(PITCH)
    look = ((1.0, 0.0, 0.0, 0.0), (0.0, -s, c, -BACK), (0.0, -c, -s, UP), (0.0, 0.0, 0.0, 1.0))
    camera = Camera(width=WIDTH, height=HEIGHT, fx=700.0, fy=700.0, cx=WIDTH / 2, cy=HEIGHT / 2, world_from_camera=look)
    coarse = np.random.default_rng(1).integers(60, 190, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
    floor = Image.fromarray(coarse).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    for name in ("photo.png", "background.png"):
        floor.save(root / name)
    ball().export(root / "ball.ply")
    light = Light(sun_direction=(0.48, 0.36, 0.8), sun_strength=1.5, sun_angle=0.1)
    item = SceneObject(name="ball", mesh="ball.ply", size_m=2 * RADIUS)
    return save_scene(root, Scene(camera=camera, objects=(item,), light=light))


def a_bake(folder: Path, frames: int) -> Path:
    """The ball rolls from the left to the right and hops."""
    folder.mkdir()
    rest = ball().vertices
    with Pc2Writer(folder / "ball.pc2", vertex_count=len(rest)) as writer:
        for index in range(frames + 1):
            share = index / frames
            writer.append(rest + np.array([0.12 * share, 0.02, 0.06 * abs(math.sin(5.0 * share))]))
    baked = BakedObject(name="ball", file="ball.pc2", vertices=len(rest))
    manifest = BakeManifest(
        inputs_hash="benchmark",
        fps=24.0,
        frame_start=1,
        frames=frames + 1,
        frames_done=frames + 1,
        state="complete",
        engine="none",
        version=VERSION,
        particles=0,
        objects=(baked,),
    )
    save_manifest(folder, manifest)
    return folder


@contextlib.contextmanager
def timed(spent: dict[str, float]) -> Iterator[None]:
    """Adds to ``spent`` the CPU seconds of each Blender scene that is rendered, and of the light at rest."""
    render, measure = passes.render, rest_light.measure

    def by_name(name: Callable[..., str], call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any) -> Any:
            began = time.process_time()
            try:
                return call(*arguments)
            finally:
                key = name(*arguments)
                spent[key] = spent.get(key, 0.0) + time.process_time() - began

        return wrapped

    passes.render = by_name(lambda scene, *_: scene.name.split(".")[0].removeprefix("PhysGen "), render)
    rest_light.measure = by_name(lambda *_: "light at rest", measure)
    try:
        yield
    finally:
        passes.render, rest_light.measure = render, measure


def run(
    folder: SceneFolder, bake: Path, frames: int, options: RenderOptions
) -> tuple[list[NDArray[np.uint8]], float, float, dict[str, float]]:
    """The frames 2…; CPU seconds to get ready; CPU seconds of a frame; and of its stages."""
    opening: dict[str, float] = {}
    spent: dict[str, float] = {}
    began = time.process_time()
    with timed(opening):
        renderer = Renderer(folder, open_bake(bake, folder.scene), options)
    try:
        ready = time.process_time()
        with timed(spent):
            pictures = [linear_to_bytes(renderer.frame(sample).beauty) for sample in range(1, frames + 1)]
        ended = time.process_time()
    finally:
        renderer.close()
    a_frame = (ended - ready) / frames
    stages = {name: seconds / frames for name, seconds in spent.items()}
    stages["everything else"] = a_frame - sum(stages.values())
    return pictures, ready - began, a_frame, stages


def difference(a: list[NDArray[np.uint8]], b: list[NDArray[np.uint8]]) -> tuple[int, float]:
    """The largest of 255 over 99.9 % of the pixels, and the mean."""
    apart = np.abs(np.stack(a).astype(int) - np.stack(b).astype(int)).max(axis=-1)
    return int(np.percentile(apart, 99.9, method="higher")), float(apart.mean())


def measure(engine: str, frames: int) -> dict[str, Any]:
    """All figures, side by side."""
    cropped = RenderOptions(engine=engine, samples=SAMPLES)
    whole = dataclasses.replace(cropped, crop=False)
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as name:
        root = Path(name)
        folder, bake = a_scene(root), a_bake(root / "bake", frames)
        # Blender's own start belongs to neither.
        run(folder, bake, 1, dataclasses.replace(cropped, samples=1))
        a, ready, cropped_s, stages = run(folder, bake, frames, cropped)
        b, _, whole_s, whole_stages = run(folder, bake, frames, whole)
        c, _, _, _ = run(folder, bake, frames, dataclasses.replace(whole, seed=1))
    apart, mean = difference(a, b)
    noise, noise_mean = difference(b, c)
    return {
        "engine": engine,
        "vertices": len(ball().vertices),
        "frames": frames,
        "ready_cpu_s": round(ready, 2),
        "cropped_cpu_s": round(cropped_s, 3),
        "full_cpu_s": round(whole_s, 3),
        "share": round(cropped_s / whole_s, 3),
        "max_difference": apart,
        "mean_difference": round(mean, 4),
        "max_noise": noise,
        "mean_noise": round(noise_mean, 4),
        "stages": {name: [round(s, 3), round(whole_stages.get(name, 0.0), 3)] for name, s in stages.items()},
    }


def main() -> int:
    """Entry; 0, or the exit code of what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", default="cycles", choices=ENGINES)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args()
    # Blender's own messages go to standard error.
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        result = measure(options.engine, options.frames)
    except PhysGenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    finally:
        os.dup2(kept, 1)
        os.close(kept)
    if options.json:
        print(json.dumps(result))
        return 0
    stages = result.pop("stages")
    print(f"{'CPU seconds a frame':<24}{'cropped':>9}{'whole':>9}")
    for stage, seconds in [*stages.items(), ("all", [result["cropped_cpu_s"], result["full_cpu_s"]])]:
        print(f"{stage:<24}" + "".join(f"{value:>9.3f}" for value in seconds))
    print("\n" + "\n".join(f"{key}: {value}" for key, value in result.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
