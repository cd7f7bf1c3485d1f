# SPDX-License-Identifier: GPL-3.0-or-later
"""The scripts of ``batch`` in a real Blender without a window: exit codes, output, signals, other files, same pictures.

    python tests/real_blender/headless.py SCENE BAKE [--blender blender] [--frames-of DIR] [--out DIR]

SCENE and BAKE: a scene folder and a bake of it with at least three frames. --frames-of: frames 1 to 3 that another
Blender has made with ``SAME``, compared where this Python has OpenCV. Needs the standard library only. docs/farm.md
says how Blender gets the modules that rendering imports. Exit code 0 when all is as it should be.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "batch" / "render.py"
SAME = ("--frames", "1-3", "--samples", "16", "--no-denoise")
"""Debian's Blender has no denoiser."""
HOSTILE = """
import bpy
scene = bpy.context.scene
scene.render.engine, scene.render.fps, scene.render.resolution_percentage = "CYCLES", 30, 10
scene.view_settings.exposure, scene.frame_current, scene.unit_settings.scale_length = 3, 57, 0.01
for name in ("PhysGen colours", "ball", "sun", "environment"):
    bpy.data.scenes.new(name), bpy.data.objects.new(name, None), bpy.data.worlds.new(name)
text = bpy.data.texts.new("boom.py")
text.use_module = True
text.write('''
import bpy
@bpy.app.handlers.persistent
def boom(*_):
    for scene in bpy.data.scenes:
        scene.render.resolution_x = 7
for handlers in (bpy.app.handlers.render_pre, bpy.app.handlers.frame_change_pre):
    handlers.append(boom)
''')
bpy.ops.wm.save_as_mainfile(filepath={path!r})
"""
"""A file whose scenes, settings and handlers would spoil a picture."""


class Failed(Exception):
    """Something is not as it should be."""


class Run:
    """One run: what to start, and what was found."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, options.out.resolve()
        self.blender = [*shlex.split(options.blender), "-b"]

    def start(self, *arguments: object, first: tuple[str, ...] = ("--factory-startup",)) -> subprocess.Popen[str]:
        """Blender with ``batch/render.py`` and its arguments."""
        script = ["--python-exit-code", "1", "-P", str(SCRIPT), "--", *map(str, arguments)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL}
        return subprocess.Popen([*self.blender, *first, *script], text=True, **pipes)

    def expect(self, code: int, process: subprocess.Popen[str], what: str) -> tuple[str, str]:
        """Output and complaints of ``process``; Failed unless it ends with ``code``."""
        out, err = process.communicate(timeout=600)
        if process.returncode != code:
            raise Failed(f"{what}: ended with {process.returncode} instead of {code}\n{out[-2000:]}\n{err[-2000:]}")
        sys.stdout.write(f"ok  {what}\n")
        return out, err

    def render(self, name: str) -> tuple[object, ...]:
        """Arguments of a whole run into the folder ``name``."""
        return self.options.scene, "--bake", self.options.bake, "--out", self.out / name, "--json"

    def all(self) -> None:
        """Every check."""
        self.expect(0, self.start("--help"), "help without a scene")
        self.expect(2, self.start("--nonsense"), "wrong usage")
        missing = self.start(self.options.scene, "--bake", self.out / "none", "--out", self.out / "x")
        self.expect(3, missing, "a bake that is not there")
        (self.out / "file").touch()
        self.expect(3, self.start(*self.render("file/x")), "a folder that cannot be written")
        said, _ = self.expect(0, self.start(*self.render("frames"), *SAME), "three frames")
        if json.loads(said.splitlines()[-1])["frames"] != 3 or not all(map(json.loads, said.splitlines())):
            raise Failed(f"three frames: standard output is not events alone: {said}")
        stopped = self.start(*self.render("stopped"), "--samples", 4096, "--scale", 4)
        while stopped.stdout is not None and "preparing" not in (stopped.stdout.readline() or "preparing"):
            pass
        stopped.send_signal(signal.SIGTERM)
        said, _ = self.expect(130, stopped, "stopped within a frame")
        left = [path.name for path in (self.out / "stopped").iterdir()]
        if json.loads(said.splitlines()[-1])["kind"] != "Cancelled" or left:
            raise Failed(f"stopped: left {left}, said {said}")
        self.other_file()
        if self.options.frames_of:
            self.compare()

    def other_file(self) -> None:
        """The same frames from a Blender that was started with a file of its own, which stays as it is."""
        blend, script = self.out / "hostile.blend", self.out / "hostile.py"
        script.write_text(HOSTILE.replace("{path!r}", repr(str(blend))), encoding="utf-8")
        subprocess.run([*self.blender, "--factory-startup", "-P", str(script)], capture_output=True, check=True)
        before = digest(blend)
        started = self.start(*self.render("other"), *SAME, first=("--enable-autoexec", str(blend)))
        self.expect(0, started, "three frames beside another file")
        if digest(blend) != before:
            raise Failed(f"{blend}: was changed")
        for number in (1, 2, 3):
            one, other = (self.out / folder / f"{number:04d}.png" for folder in ("frames", "other"))
            if digest(one) != digest(other):
                raise Failed(f"{other}: is another picture than {one}")

    def compare(self) -> None:
        """With the frames of another Blender."""
        import cv2
        import numpy as np

        for number in (1, 2, 3):
            name = f"{number:04d}.png"
            a, b = (
                cv2.imread(str(folder / name)).astype(int) for folder in (self.out / "frames", self.options.frames_of)
            )
            apart = np.abs(a - b)
            sys.stdout.write(
                f"    frame {number}: at most {apart.max()} of 255, {(apart > 1).mean():.2%} more than 1\n"
            )
            if (apart > 1).mean() > 0.001:
                raise Failed(f"{name}: is another picture than in {self.options.frames_of}")


def digest(path: Path) -> str:
    """SHA-256 of the file ``path``."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> int:
    """Entry of the script."""
    parser = argparse.ArgumentParser(prog="headless.py", description="The scripts of batch/ in a real Blender.")
    parser.add_argument("scene", type=lambda text: Path(text).resolve())
    parser.add_argument("bake", type=lambda text: Path(text).resolve())
    parser.add_argument("--blender", default="blender", help="program or command line that starts Blender")
    parser.add_argument("--frames-of", type=Path, metavar="DIR", help="the same frames by another Blender")
    parser.add_argument("--out", type=Path, default=Path("build/blender_headless"), help="results, emptied")
    options = parser.parse_args()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    try:
        Run(options).all()
    except Failed as error:
        sys.stdout.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
