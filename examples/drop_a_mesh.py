# SPDX-License-Identifier: GPL-3.0-or-later
"""A mesh is dropped on the ground, and the bake is read back: height of its lowest vertex over time.

python examples/drop_a_mesh.py [MESH.obj] --out work
"""

import argparse
from pathlib import Path

import physgen
import trimesh


def main(mesh: Path | None, out: Path, *, frames: int = 36, quality: str = "preview") -> list[float]:
    """Return the height in metres of the lowest vertex in every frame."""
    if mesh is None:
        ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
        ball.apply_translation((0.0, 0.0, 0.4))
        out.mkdir(parents=True, exist_ok=True)
        mesh = out / "ball.obj"
        ball.export(mesh)
    scene = physgen.scene_from_meshes({"thing": mesh}, out=out / "scene", presets=["rubber"])
    bake = physgen.bake(scene, out=out / "bake", options=physgen.BakeOptions(frames=frames, quality=quality))
    heights = [float(bake.vertices("thing", n)[:, 2].min()) for n in range(bake.first_frame, bake.last_frame + 1)]
    for number, height in enumerate(heights):
        print(f"{number / bake.manifest.rate:5.2f} s {height:6.3f} m {'·' * round(100 * max(height, 0))}")
    return heights


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path, nargs="?")
    parser.add_argument("--out", type=Path, default=Path("work"))
    given = parser.parse_args()
    main(given.mesh, given.out)
