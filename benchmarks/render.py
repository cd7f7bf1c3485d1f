# SPDX-License-Identifier: GPL-3.0-or-later
"""CPU seconds per frame by stage, and how much rendering only the changed region saves.

    python -m physgen.benchmarks.render [--engine cycles] [--frames N] [--json]

A 20k-vertex sphere moves over a 640×480 photo, 32 samples, denoised. The same frames are rendered cropped, whole, and
whole with another seed, in this process; CPU seconds are those of all its threads. The difference between cropped and
whole frames is compared with that between two seeds, which is noise.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from physgen.benchmarks.common import benchmark_parser, blender_output_to_stderr, write_bake
from physgen.physgen_addon.playback.point_caches import open_bake
from physgen.physgen_addon.render import lighting, render_engines
from physgen.physgen_addon.render.render_options import ENGINES, RenderOptions
from physgen.physgen_addon.render.renderer import Renderer
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.errors import PhysGenError
from physgen.sim.scene.folder import Scene, save_scene
from physgen.sim.scene.model import Camera, Light, SceneModel, SceneObject
from physgen.sim.srgb import linear_to_bytes
from PIL import Image

WIDTH, HEIGHT = 640, 480
RADIUS = 0.05
PITCH, BACK, UP = math.radians(35.0), 0.45, 0.32


def sphere() -> trimesh.Trimesh:
    """Return a sphere of 20,002 vertices on the ground."""
    mesh = trimesh.creation.uv_sphere(radius=RADIUS, count=[101, 100])
    mesh.merge_vertices()
    mesh.vertices += [0.0, 0.0, RADIUS]
    return mesh


def make_scene(root: Path) -> Scene:
    """Return a scene of the sphere on a noise texture; the photo shows only the floor, as frame 1 is not compared."""
    s, c = math.sin(PITCH), math.cos(PITCH)
    look = ((1.0, 0.0, 0.0, 0.0), (0.0, -s, c, -BACK), (0.0, -c, -s, UP), (0.0, 0.0, 0.0, 1.0))
    camera = Camera(width=WIDTH, height=HEIGHT, fx=700.0, fy=700.0, cx=WIDTH / 2, cy=HEIGHT / 2, world_from_camera=look)
    coarse = np.random.default_rng(1).integers(60, 190, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
    floor = Image.fromarray(coarse).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    for name in ("photo.png", "background.png"):
        floor.save(root / name)
    sphere().export(root / "ball.ply")
    light = Light(sun_direction=(0.48, 0.36, 0.8), sun_strength=1.5, sun_angle=0.1)
    item = SceneObject(name="ball", mesh="ball.ply", size_m=2 * RADIUS)
    return save_scene(root, SceneModel(camera=camera, objects=(item,), light=light))


def make_bake(folder: Path, frames: int) -> Path:
    """Write a bake in which the sphere rolls from left to right and hops; return its folder."""
    rest, shares = sphere().vertices, np.arange(frames + 1) / frames
    moves = [np.array([0.12 * share, 0.02, 0.06 * abs(math.sin(5.0 * share))]) for share in shares]
    write_bake(folder, {"ball": [rest + move for move in moves]})
    return folder


@contextlib.contextmanager
def timed(spent: dict[str, float]) -> Iterator[None]:
    """Add the CPU seconds of each rendered Blender scene, and of the reference lighting, to ``spent``."""
    render, measure = render_engines.render_passes, lighting.measure_reference_light

    def by_name(name: Callable[..., str], call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*arguments: Any) -> Any:
            began = time.process_time()
            try:
                return call(*arguments)
            finally:
                key = name(*arguments)
                spent[key] = spent.get(key, 0.0) + time.process_time() - began

        return wrapped

    render_engines.render_passes = by_name(lambda scene, *_: scene.name.split(".")[0].removeprefix("PhysGen "), render)
    lighting.measure_reference_light = by_name(lambda *_: "reference lighting", measure)
    try:
        yield
    finally:
        render_engines.render_passes, lighting.measure_reference_light = render, measure


def run(
    folder: Scene, bake: Path, frames: int, options: RenderOptions
) -> tuple[list[NDArray[np.uint8]], float, float, dict[str, float]]:
    """Return the frames from 2 on; CPU seconds to prepare; CPU seconds per frame; and of its stages."""
    opening: dict[str, float] = {}
    spent: dict[str, float] = {}
    began = time.process_time()
    with timed(opening):
        renderer = Renderer(folder, open_bake(load_bake(bake), folder), options)
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
    """Return the 99.9th percentile over pixels, of 255, and the mean."""
    apart = np.abs(np.stack(a).astype(int) - np.stack(b).astype(int)).max(axis=-1)
    return int(np.percentile(apart, 99.9, method="higher")), float(apart.mean())


def measure(engine: str, frames: int, samples: int, scale: float) -> dict[str, Any]:
    """Return all figures."""
    cropped = RenderOptions(engine=engine, samples=samples, scale=scale)
    whole = dataclasses.replace(cropped, crop=False)
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as name:
        root = Path(name)
        folder, bake = make_scene(root), make_bake(root / "bake", frames)
        # Without Blender's own start-up.
        run(folder, bake, 1, dataclasses.replace(cropped, samples=1))
        a, ready, cropped_s, stages = run(folder, bake, frames, cropped)
        b, _, whole_s, whole_stages = run(folder, bake, frames, whole)
        c, _, _, _ = run(folder, bake, frames, dataclasses.replace(whole, seed=1))
    apart, mean = difference(a, b)
    noise, noise_mean = difference(b, c)
    return {
        "engine": engine,
        "vertices": len(sphere().vertices),
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0, or the exit code of the error."""
    parser = benchmark_parser("render", __doc__, frames=1, samples=1, scale=0.125)
    parser.add_argument("--engine", default="cycles", choices=ENGINES, help="render engine (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=4, help="frames to render (default: %(default)s)")
    parser.add_argument("--samples", type=int, default=32, help="samples per pixel (default: %(default)s)")
    parser.add_argument("--scale", type=float, default=1.0, help="of 640×480 (default: %(default)s)")
    options = parser.parse_args(arguments)
    try:
        with blender_output_to_stderr():
            result = measure(options.engine, options.frames, options.samples, options.scale)
    except PhysGenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    if options.json:
        print(json.dumps(result))
        return 0
    stages = result.pop("stages")
    print(f"{'CPU seconds per frame':<24}{'cropped':>9}{'whole':>9}")
    for stage, seconds in [*stages.items(), ("all", [result["cropped_cpu_s"], result["full_cpu_s"]])]:
        print(f"{stage:<24}" + "".join(f"{value:>9.3f}" for value in seconds))
    print("\n" + "\n".join(f"{key}: {value}" for key, value in result.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
