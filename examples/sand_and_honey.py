# SPDX-License-Identifier: GPL-3.0-or-later
"""Columns of granular and fluid material collapse: how far does each run out?

python examples/sand_and_honey.py --out work
"""

import argparse
from pathlib import Path

import physgen
import trimesh

SIDE, HEIGHT = 0.1, 0.2


def main(
    out: Path, *, materials: tuple[str, ...] = ("sand", "snow", "honey", "water"), frames: int = 24
) -> dict[str, float]:
    """Return the run-out by material: the farthest vertex from the axis of its column, in metres."""
    out.mkdir(parents=True, exist_ok=True)
    column = trimesh.creation.box((SIDE, SIDE, HEIGHT)).subdivide().subdivide().subdivide()
    column.apply_translation((0.0, 0.0, HEIGHT / 2 + 0.002))
    column.export(out / "column.obj")
    reach = {}
    for name in materials:
        scene = physgen.scene_from_meshes({"column": out / "column.obj"}, out=out / name / "scene", presets=[name])
        options = physgen.BakeOptions(frames=frames, quality="preview")
        bake = physgen.bake(scene, out=out / name / "bake", options=options)
        vertices = bake.vertices("column", bake.last_frame)
        reach[name] = float((vertices[:, :2] ** 2).sum(axis=1).max() ** 0.5)
        print(f"{name:8s} {reach[name]:.3f} m")
    return reach


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("work"))
    main(parser.parse_args().out)
