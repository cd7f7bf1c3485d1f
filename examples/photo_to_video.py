# SPDX-License-Identifier: GPL-3.0-or-later
"""A photo becomes a video: two boxes, a velocity, four calls.

python examples/photo_to_video.py PHOTO --box 215,960,475,1190 --out work
"""

import argparse
from pathlib import Path

import physgen


def main(
    photo: Path,
    boxes: list[tuple[float, ...]],
    out: Path,
    *,
    frames: int = 48,
    samples: int = 64,
    max_size: int = 1920,
    scale: float = 1.0,
) -> Path:
    """Return the video: the objects in ``boxes`` (x0, y0, x1, y1 in pixels) hop off the ground."""
    objects = [physgen.ObjectRequest(box=box, velocity=(0.0, 0.0, 1.5)) for box in boxes]
    reading = physgen.ReconstructOptions(max_size=max_size)
    scene = physgen.reconstruct(photo, objects, out=out / "scene", options=reading)
    for item in scene.objects:
        print(f"{item.name}: {item.size_m:.3f} m, {item.material.density:.0f} kg/m³")

    quality = "standard" if frames > 8 else "preview"
    bake = physgen.bake(scene, out=out / "bake", options=physgen.BakeOptions(frames=frames, quality=quality))
    video = out / "video.mp4"
    options = physgen.RenderOptions(samples=samples, scale=scale)
    physgen.render(scene, bake, out=out / "frames", options=options, video=video)
    return video


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photo", type=Path)
    parser.add_argument("--box", action="append", required=True, help="x0,y0,x1,y1 in pixels, one per object")
    parser.add_argument("--out", type=Path, default=Path("work"))
    given = parser.parse_args()
    print(main(given.photo, [tuple(float(x) for x in box.split(",")) for box in given.box], given.out))
