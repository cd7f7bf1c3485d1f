"""Inside another Blender that lacks the extension: the same frame of the saved file, rendered, is the same picture."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
import screens
import session

TASK = session.task()
OUT = Path(TASK["out"])
MOST = 1.5 / 255
"""Largest difference of a pixel; rounding to 8 bits and nothing else."""

assert TASK["addon"] not in bpy.context.preferences.addons
assert not hasattr(bpy.types.Scene, "physgen")
scene = bpy.context.scene
first = scene.frame_current
scene.render.filepath = str(OUT / "without.png")
bpy.ops.render.render(write_still=True)
with_it, without = screens.read(OUT / "with.png"), screens.read(OUT / "without.png")
difference = float(np.abs(with_it - without).max())
scene.frame_set(scene.frame_start)
scene.render.filepath = str(OUT / "without_start.png")
bpy.ops.render.render(write_still=True)
motion = float(np.abs(screens.read(OUT / "without_start.png") - without).max())
trouble = "" if difference <= MOST else f"the picture differs by {difference:.4f} without the extension"
if motion <= MOST:
    trouble = "nothing moves without the extension"
step = {"step": "same_frame", "frame": first, "difference": difference, "motion": motion}
(OUT / "reopen.json").write_text(json.dumps({"steps": [step], "trouble": trouble}) + "\n", encoding="utf-8")
