# SPDX-License-Identifier: GPL-3.0-or-later
"""PSNR of the first frame against the photo: reconstruct, no motion, render frame 1.

    python -m physgen.benchmarks.first_frame PHOTO --box x0,y0,x1,y1 [--box …] [--json]

For comparison: PhysGen3D's first frames of its two example photos reach 19.5 and 22.4 dB over the whole image.
``--quick`` uses a reduced photo from scikit-image.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from physgen.batch.demo import shipped_photo
from physgen.benchmarks.common import benchmark_parser, blender_output_to_stderr, print_result, write_bake
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.errors import PhysGenError
from physgen.sim.reconstruct import ObjectRequest
from physgen.sim.scene.folder import Scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.srgb import read_mask, read_rgb
from PIL import Image

Box = tuple[float, float, float, float]


def rest_bake(scene: Scene, folder: Path) -> Path:
    """Write a bake of one frame in which nothing moves; return its folder."""
    write_bake(folder, {item.name: [load_object_mesh(scene, item).vertices] for item in scene.model.objects})
    return folder


def measure(photo: Path, boxes: Sequence[Box], samples: int) -> dict[str, object]:
    """Return the PSNR of frame 1 against the photo at working size, and seconds."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as name:
        root = Path(name)
        scene = reconstruct(photo, [ObjectRequest(box=box) for box in boxes], out=root / "scene")
        reconstructed = time.monotonic()
        bake = rest_bake(scene, root / "bake")
        frame = read_rgb(
            render_frames(scene, load_bake(bake), out=root / "frames", options=RenderOptions(samples=samples))[0]
        )
        original = read_rgb(scene.file(scene.model.photo))
        masks = {o.name: read_mask(scene.file(o.mask)) for o in scene.model.objects if o.mask is not None}
    inside = {name: round(psnr(frame, original, mask), 2) for name, mask in masks.items()}
    return {
        "photo": photo.name,
        "psnr_mask_db": min(inside.values()),
        "psnr_all_db": round(psnr(frame, original), 2),
        "psnr_object_db": inside,
        "reconstruct_s": round(reconstructed - started, 1),
        "render_s": round(time.monotonic() - reconstructed, 1),
    }


def _box(text: str) -> Box:
    a, b, c, d = (float(part) for part in text.split(","))
    return a, b, c, d


def small_photo(folder: Path) -> tuple[Path, Box]:
    """Write scikit-image's coffee photo at a fifth of its size; return it and the cup's box."""
    path = folder / "coffee.png"
    with Image.open(shipped_photo("coffee")) as photo:
        photo.resize((photo.width // 5, photo.height // 5)).save(path)
    return path, (14.0, 2.0, 98.0, 78.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns 0, or the exit code of the error."""
    parser = benchmark_parser("first_frame", __doc__, samples=1)
    parser.add_argument("photo", type=Path, nargs="?", help="photo (not needed with --quick)")
    parser.add_argument("--box", type=_box, nargs="+", action="extend", default=[], metavar="x0,y0,x1,y1")
    parser.add_argument("--samples", type=int, default=RenderOptions().samples, help="per pixel (default: %(default)s)")
    options = parser.parse_args(arguments)
    if not options.quick and not (options.photo and options.box):
        parser.error("give PHOTO and at least one --box")
    try:
        with blender_output_to_stderr(), tempfile.TemporaryDirectory(prefix="physgen-benchmark-") as folder:
            photo, boxes = options.photo, options.box
            if photo is None:
                photo, box = small_photo(Path(folder))
                boxes = [box]
            result = measure(photo, boxes, options.samples)
    except PhysGenError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    with contextlib.suppress(BrokenPipeError):
        print_result(result, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
