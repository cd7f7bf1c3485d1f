# SPDX-License-Identifier: GPL-3.0-or-later
"""A crate and a block of jelly are dropped, and the scene with its motion is written as USD Physics.

    python examples/scene_to_usd.py work

Opened again with pxr, it lists bodies, masses and where they are at the end: pip install 'physgen[usd]'.
"""

from __future__ import annotations

import sys
from pathlib import Path

import physgen
import trimesh
from pxr import Usd, UsdGeom, UsdPhysics


def main(work: Path, *, frames: int = 24) -> Usd.Stage:
    """Return the stage that was written."""
    work.mkdir(parents=True, exist_ok=True)
    for name, size, place in (("crate", (0.2, 0.2, 0.1), (0, 0, 0.4)), ("jelly", (0.1, 0.1, 0.1), (0.4, 0, 0.2))):
        box = trimesh.creation.box(size)
        box.apply_translation(place)
        # Finer, so that it can bend.
        box.subdivide().subdivide().subdivide().export(work / f"{name}.obj")
    meshes = {"crate": work / "crate.obj", "jelly": work / "jelly.obj"}
    scene = physgen.scene_from_meshes(meshes, out=work / "scene", presets=["wood", "soft"])
    bake = physgen.bake(scene, out=work / "bake", options=physgen.BakeOptions(frames=frames, quality="preview"))
    for note in physgen.export_usd(scene, work / "drop.usdc", bake=bake):
        print(f"note: {note}")
    stage = Usd.Stage.Open(str(work / "drop.usdc"))
    boxes = UsdGeom.BBoxCache(stage.GetEndTimeCode(), [UsdGeom.Tokens.default_])
    for prim in stage.Traverse():
        if prim.HasAPI(UsdPhysics.MassAPI):
            kind = "rigid" if prim.HasAPI(UsdPhysics.RigidBodyAPI) else "deformable"
            height = boxes.ComputeWorldBound(prim).ComputeCentroid()[2]
            print(f"{prim.GetPath()}: {UsdPhysics.MassAPI(prim).GetMassAttr().Get():.3f} kg, {kind}, at {height:.3f} m")
    return stage


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "work"))
