# SPDX-License-Identifier: GPL-3.0-or-later
"""Whether this machine can draw: EEVEE needs a graphics context, and Blender ends the process where it gets none."""

from __future__ import annotations

import functools
import subprocess
import sys
import tempfile

import bpy

from ...sim.app.process import NO_WINDOW, child_environment
from ...sim.errors import RenderError

PROBE_SECONDS = 300
"""Without a graphics card the first picture after an update of Blender or Mesa compiles for a minute."""

_MARK = "physgen-graphics:"
_PROBE = f"""
import bpy, tempfile, pathlib
scene = bpy.data.scenes.new("probe")
scene.render.engine = "BLENDER_EEVEE" if bpy.app.version >= (5, 0) else "BLENDER_EEVEE_NEXT"
scene.render.resolution_x = scene.render.resolution_y = 4
scene.eevee.taa_render_samples = 1
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
scene.camera = camera
with tempfile.TemporaryDirectory() as folder:
    scene.render.filepath = str(pathlib.Path(folder) / "probe.png")
    bpy.ops.render.render(write_still=True, scene=scene.name)
    drawn = pathlib.Path(scene.render.filepath).is_file()
import gpu, os, sys
if drawn:
    sys.stdout.write("\\n{_MARK}" + gpu.platform.renderer_get() + "\\n")
    sys.stdout.flush()
os._exit(0)
"""


@functools.cache
def require_graphics() -> str:
    """The graphics card's name, or that of the program that stands in for one.

    Blender crashes where there is neither, so a process of its own draws a tiny picture, once in each process that
    renders: what was true last week need not be after an update. Raises RenderError with what to do about it.
    """
    if bpy.app.binary_path:
        start = [bpy.app.binary_path, "--background", "--factory-startup", "--python-exit-code", "1", "--python-expr"]
    else:
        start = [sys.executable, "-c"]
    # Blender leaves its crash report in the temporary folder.
    with tempfile.TemporaryDirectory(prefix="physgen-") as folder:
        try:
            result = subprocess.run(
                [*start, _PROBE],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=PROBE_SECONDS,
                env={**child_environment(), "TMPDIR": folder, "TEMP": folder},
                cwd=folder,
                check=False,
                creationflags=NO_WINDOW,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise RenderError(f"whether Blender can draw is unknown ({error}); use --engine cycles") from error
    said = result.stdout.decode(errors="replace").splitlines()
    names = [line.removeprefix(_MARK) for line in said if line.startswith(_MARK)]
    if not names:
        raise RenderError(
            "EEVEE needs a graphics card or Mesa's EGL, and Blender found neither: install libegl1 and "
            "libgl1-mesa-dri (Debian's names), or use --engine cycles"
        )
    return names[0].strip()
