# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension in a real Blender with its windows open: install, work, save, open again without it, look at it.

    python tests/real_blender/run.py [--zip ZIP] [--blender blender] [--python PYTHON] [--photo PHOTO] [--out DIR]

Needs the standard library only, so that it also runs where nothing but Blender is installed. Without a display it
starts Xvfb. docs/blender.md says how to set up a container for it. Everything is written below DIR: ``report.json``,
logs, a folder of pictures for each script, the .blend and the two pictures of the same frame. Exit code 0 when all
steps passed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = "user_default"
TOUR_SIZE = "1280x1000"
"""Of the window of ``tour.py``: a laptop's."""
FAULTS = ("Traceback (most recent call last)", "Error: Python", "ERROR (bpy.rna)", "EXCEPTION_ACCESS_VIOLATION")
"""What no log may hold: operators and panels report, they do not fall over."""


class Failed(Exception):
    """A step that did not pass."""


@contextlib.contextmanager
def display(size: str) -> Iterator[dict[str, str]]:
    """Environment with a display; Xvfb's own where there is none."""
    if os.environ.get("DISPLAY") or sys.platform in ("win32", "darwin"):
        yield {}
        return
    if shutil.which("Xvfb") is None:
        raise Failed("there is no display and no Xvfb; install xvfb")
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", f"{size}x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[writing], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    os.close(writing)
    try:
        number = os.read(reading, 16).decode().strip()
        if not number:
            raise Failed("Xvfb did not start")
        yield {"DISPLAY": f":{number}", "LIBGL_ALWAYS_SOFTWARE": "1"}
    finally:
        server.terminate()
        server.wait()


class Run:
    """One run: where its things are, and what has passed so far."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.out = options, options.out.resolve()
        self.blender = shlex.split(options.blender)
        self.steps: list[dict[str, object]] = []

    def start(self, name: str, *arguments: str, timeout: float, **environment: str) -> str:
        """Run Blender, keep its log; its text. Raises Failed where it fails or its log holds a fault."""
        began = time.monotonic()
        settings = {"BLENDER_USER_RESOURCES": str(self.out / "user"), **environment}
        # Without this folder Blender would take the preferences of whoever uses this machine.
        (Path(settings["BLENDER_USER_RESOURCES"]) / "config").mkdir(parents=True, exist_ok=True)
        surroundings = {k: v for k, v in os.environ.items() if k != "PHYSGEN_PYTHON"}
        log = self.out / f"{name}.log"
        with log.open("w", encoding="utf-8") as stream:
            try:
                done = subprocess.run(
                    [*self.blender, *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=stream,
                    stderr=subprocess.STDOUT,
                    env={**surroundings, **settings},
                    timeout=timeout,
                )
            except subprocess.TimeoutExpired:
                raise Failed(f"{name}: took longer than {timeout:g} s; see {log}") from None
        text = log.read_text(encoding="utf-8", errors="replace")
        faults = [line for line in text.splitlines() if line.startswith(FAULTS)]
        seconds = round(time.monotonic() - began, 1)
        self.steps.append({"step": name, "code": done.returncode, "seconds": seconds, "faults": len(faults)})
        if done.returncode != 0 or faults:
            raise Failed(f"{name}: code {done.returncode}, {len(faults)} faults in {log}")
        return text

    def all(self) -> None:
        """Every step in order."""
        archive = self.options.zip.resolve()
        self.start("validate", "-b", "--command", "extension", "validate", str(archive), timeout=120)
        install = ("extension", "install-file", "-r", REPOSITORY, "--enable", str(archive))
        self.start("install", "-b", "--command", *install, timeout=300)
        task = self.out / "task.json"
        words = {"out": str(self.out), "python": self.options.python, "addon": f"bl_ext.{REPOSITORY}.physgen"}
        words["photo"] = str(self.options.photo.resolve()) if self.options.photo else ""
        words["scene"] = str(self.options.scene.resolve()) if self.options.scene else ""
        words["wheels"] = str(self.options.wheels.resolve()) if self.options.wheels else ""
        words["only"] = self.options.only
        task.write_text(json.dumps(words), encoding="utf-8")
        for name, size in (
            ("tour", TOUR_SIZE),
            ("library", TOUR_SIZE),
            ("odd", TOUR_SIZE),
            ("pictures", TOUR_SIZE),
            ("work", self.options.size),
        ):
            if self.options.script not in ("", name):
                continue
            window = ("--window-geometry", "0", "0", *size.split("x"))
            with display(size) as screen:
                script = ("--python-exit-code", "1", "-P", str(HERE / f"{name}.py"), "--", str(task))
                self.start(name, *window, *script, timeout=self.options.timeout, **screen)
            self.require(f"{name}.json")
        if self.options.only or self.options.script not in ("", "work"):
            return
        # Another user, who has never heard of the extension.
        script = ("--python-exit-code", "1", "-P", str(HERE / "reopen.py"), "--", str(task))
        self.start("reopen", "-b", *script, timeout=300, BLENDER_USER_RESOURCES=str(self.out / "user_without"))
        self.require("reopen.json")

    def require(self, name: str) -> None:
        """Take in what a script inside Blender has written; Failed where it says so or has written nothing."""
        path = self.out / name
        if not path.is_file():
            raise Failed(f"{name}: Blender ended before the script did")
        said = json.loads(path.read_text(encoding="utf-8"))
        self.steps += said["steps"]
        if said["trouble"]:
            raise Failed(f"{name}: {said['trouble']}")


def default_zip() -> Path:
    """What ``make extension`` builds for every Blender."""
    manifest = tomllib.loads((HERE.parents[1] / "blender_manifest.toml").read_text(encoding="utf-8"))
    return HERE.parents[1] / "dist" / f"{manifest['id']}-{manifest['version']}.zip"


def main() -> int:
    """Entry of the script."""
    parser = argparse.ArgumentParser(prog="run.py", description="The extension in a real Blender.")
    parser.add_argument("--blender", default="blender", help="program or command line that starts Blender")
    parser.add_argument("--zip", type=Path, default=default_zip(), help="the extension (default: %(default)s)")
    parser.add_argument("--python", default="", help="interpreter that simulates, for the add-on's preferences")
    parser.add_argument("--photo", type=Path, help="photo to open and find objects in (default: one that is rendered)")
    parser.add_argument("--only", default="", help="steps of the scripts, by commas; nothing is opened again then")
    parser.add_argument("--scene", type=Path, help="scene.json of a photo, for the steps farm and nodes alone")
    parser.add_argument("--wheels", type=Path, help="folder of wheels of all that simulates, to try Install with")
    names = ["", "tour", "library", "odd", "pictures", "work"]
    parser.add_argument("--script", default="", choices=names, help="only this one (default: all)")
    parser.add_argument("--out", type=Path, default=Path("build/blender_app"), help="folder of the results, emptied")
    parser.add_argument("--size", default="1000x3200", help="of Blender's window, tall enough for every panel")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds for the work inside Blender")
    options = parser.parse_args()
    shutil.rmtree(options.out, ignore_errors=True)
    options.out.mkdir(parents=True)
    run, trouble = Run(options), ""
    try:
        run.all()
    except Failed as error:
        trouble = str(error)
    report = {"trouble": trouble, "steps": run.steps}
    (options.out / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    for step in run.steps:
        sys.stdout.write(f"{json.dumps(step)}\n")
    sys.stdout.write(f"{trouble or 'all steps passed'}; pictures below {options.out}\n")
    return 1 if trouble else 0


if __name__ == "__main__":
    sys.exit(main())
