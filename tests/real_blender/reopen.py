# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside another Blender that lacks the extension: the same frame of each saved file is the same picture."""

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


def shown(path: Path) -> np.ndarray:
    """Render the current frame to ``path``; its pixels."""
    bpy.context.scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return screens.read(path)


def compare(name: str) -> dict:
    """Open ``NAME.blend`` and render the frame at which it was saved, and its first frame."""
    bpy.ops.wm.open_mainfile(filepath=str(OUT / f"{name}.blend"))
    assert not hasattr(bpy.types.Scene, "physgen") and TASK["addon"] not in bpy.context.preferences.addons
    scene = bpy.context.scene
    frame, with_it = scene.frame_current, screens.read(OUT / f"{name}_with.png")
    without = shown(OUT / f"{name}_without.png")
    scene.frame_set(scene.frame_start)
    motion = float(np.abs(shown(OUT / f"{name}_start.png") - without).max())
    difference = float(np.abs(with_it - without).max())
    return {"step": f"without: {name}", "frame": frame, "difference": difference, "motion": motion}


steps, trouble = [], ""
for name in ("saved", "imported"):
    steps.append(compare(name))
    if steps[-1]["difference"] > MOST:
        trouble = f"{name}.blend: the picture is another one without the extension"
    elif steps[-1]["motion"] <= MOST:
        trouble = f"{name}.blend: nothing moves without the extension"
(OUT / "reopen.json").write_text(json.dumps({"steps": steps, "trouble": trouble}) + "\n", encoding="utf-8")
