# SPDX-License-Identifier: GPL-3.0-or-later
"""A model of MuJoCo becomes a scene: two bodies fall, one of them of two parts with densities of their own.

    python examples/mujoco_to_scene.py [MODEL.xml] --out work

Prints where each body is at the end. URDF files are read as well (docs/reconstruction.md#mjcf-and-urdf).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import physgen
from physgen.sim.app.import_folder import import_folder

MODEL = """<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1" friction="0.5"/>
    <body name="hammer" pos="0 0 0.5" euler="0 0 30">
      <freejoint/>
      <geom type="capsule" fromto="-0.15 0 0 0.1 0 0" size="0.015" density="600"/>
      <geom type="box" size="0.03 0.06 0.03" pos="0.13 0 0" density="2700"/>
    </body>
    <body name="can" pos="0.4 0 0.3">
      <freejoint/>
      <geom type="cylinder" size="0.033 0.06" mass="0.35"/>
    </body>
  </worldbody>
</mujoco>
"""


def main(model: Path | None, out: Path, *, frames: int = 24) -> dict[str, float]:
    """Return the height in metres of the middle of every body in the last frame."""
    out.mkdir(parents=True, exist_ok=True)
    if model is None:
        model = out / "model.xml"
        model.write_text(MODEL)
    scene = import_folder(model, out=out / "scene", on_event=lambda event: print(event.get("message", "")))
    bake = physgen.bake(scene, out=out / "bake", options=physgen.BakeOptions(frames=frames, quality="preview"))
    moving = [item.name for item in scene.objects if item.role == "dynamic"]
    heights = {name: float(bake.vertices(name, bake.last_frame)[:, 2].mean()) for name in moving}
    for name, height in heights.items():
        print(f"{name}: {height:.3f} m high")
    return heights


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?")
    parser.add_argument("--out", type=Path, default=Path("work"))
    given = parser.parse_args()
    main(given.model, given.out)
