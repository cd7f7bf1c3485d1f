# SPDX-License-Identifier: GPL-3.0-or-later
"""A parameter sweep: one scene, several stiffnesses, one number each.

python examples/parameter_sweep.py --out work
"""

import argparse
import dataclasses
from pathlib import Path

import physgen
import trimesh


def main(out: Path, *, moduli: tuple[float, ...] = (2e4, 1e5, 5e5), frames: int = 12) -> dict[float, float]:
    """Return, by Young's modulus in Pa, the largest flattening of a dropped ball: 1 - height / diameter."""
    out.mkdir(parents=True, exist_ok=True)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    ball.apply_translation((0.0, 0.0, 0.06))
    ball.export(out / "ball.obj")
    scene = physgen.scene_from_meshes({"ball": out / "ball.obj"}, out=out / "scene", velocities=[(0.0, 0.0, -2.0)])
    flattening = {}
    for modulus in moduli:
        item = scene.objects[0]
        softer = dataclasses.replace(item, material=dataclasses.replace(item.material, youngs_modulus=modulus))
        variant = scene.with_model(dataclasses.replace(scene.model, objects=(softer,)))
        options = physgen.BakeOptions(frames=frames, fps=96.0, quality="preview")
        bake = physgen.bake(variant, out=out / f"bake_{modulus:.0e}", options=options)
        heights = [
            float(bake.vertices("ball", n)[:, 2].max() - bake.vertices("ball", n)[:, 2].min())
            for n in range(bake.first_frame, bake.last_frame + 1)
        ]
        flattening[modulus] = 1 - min(heights) / 0.1
        print(f"{modulus:9.0e} Pa  {100 * flattening[modulus]:5.1f} %")
    return flattening


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("work"))
    main(parser.parse_args().out)
