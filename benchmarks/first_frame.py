# SPDX-License-Identifier: GPL-3.0-or-later
"""How well the first frame repeats the photo: reconstruct, no motion, render frame 1 by the ordinary path.

    python benchmarks/first_frame.py PHOTO --box x0,y0,x1,y1 [--box …] [--json]

PhysGen3D's own first frames of its two example photos reach 19.5 and 22.4 dB over the whole image.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from physgen.physgen_addon.bridge.frames import render_frames
from physgen.physgen_addon.bridge.options import RenderOptions
from physgen.sim.app.reconstruct import reconstruct_scene
from physgen.sim.cache.manifest import BakedObject, BakeManifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.composite.metrics import psnr
from physgen.sim.composite.transfer import read_mask, read_rgb
from physgen.sim.errors import PhysGenError
from physgen.sim.reconstruct import ObjectRequest
from physgen.sim.scene.folder import SceneFolder
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.version import VERSION


def rest_bake(scene: SceneFolder, folder: Path) -> Path:
    """A bake of one frame in which nothing moves."""
    folder.mkdir(parents=True)
    baked = []
    for item in scene.scene.objects:
        vertices = load_object_mesh(scene, item).vertices
        with Pc2Writer(folder / f"{item.name}.pc2", vertex_count=len(vertices)) as writer:
            writer.append(vertices)
        baked.append(BakedObject(name=item.name, file=f"{item.name}.pc2", vertices=len(vertices)))
    manifest = BakeManifest(
        inputs_hash="rest",
        fps=24.0,
        frame_start=1,
        frames=1,
        frames_done=1,
        state="complete",
        engine="rest",
        version=VERSION,
        particles=0,
        objects=tuple(baked),
    )
    save_manifest(folder, manifest)
    return folder


def measure(photo: Path, boxes: Sequence[tuple[float, float, float, float]], samples: int) -> dict[str, object]:
    """PSNR of frame 1 against the photo at working size."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as name:
        root = Path(name)
        scene = reconstruct_scene(photo, [ObjectRequest(box=box) for box in boxes], root / "scene")
        reconstructed = time.monotonic()
        bake = rest_bake(scene, root / "bake")
        frame = read_rgb(render_frames(scene, bake, root / "frames", RenderOptions(samples=samples))[0])
        original = read_rgb(scene.file(scene.scene.photo))
        masks = {o.name: read_mask(scene.file(o.mask)) for o in scene.scene.objects if o.mask is not None}
    inside = {name: round(psnr(frame, original, mask), 2) for name, mask in masks.items()}
    return {
        "photo": photo.name,
        "psnr_mask_db": min(inside.values()),
        "psnr_all_db": round(psnr(frame, original), 2),
        "psnr_object_db": inside,
        "reconstruct_s": round(reconstructed - started, 1),
        "render_s": round(time.monotonic() - reconstructed, 1),
    }


def _box(text: str) -> tuple[float, float, float, float]:
    a, b, c, d = (float(part) for part in text.split(","))
    return a, b, c, d


def main() -> int:
    """Entry; 0, or the exit code of what went wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--box", type=_box, nargs="+", action="extend", required=True, metavar="x0,y0,x1,y1")
    parser.add_argument("--samples", type=int, default=RenderOptions().samples)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    options = parser.parse_args()
    # Blender's own messages go to standard error.
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        result = measure(options.photo, options.box, options.samples)
    except PhysGenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    finally:
        os.dup2(kept, 1)
        os.close(kept)
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(result) if options.json else "\n".join(f"{key}: {value}" for key, value in result.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
