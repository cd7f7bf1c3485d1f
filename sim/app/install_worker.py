# SPDX-License-Identifier: MIT
"""Make the virtual environment that simulates, and renders where Blender's own Python cannot; for Blender's *Install*.

    PYTHON launch.py sim.app.install_worker FOLDER [--wheels DIR] [--render]

As a module it runs in the Python that the environment is based on, needs the standard library only, prints progress
and its end as lines of JSON, and stops on SIGTERM. Run again, it completes what is there.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from ..memory import memory_kills
from .launch import STOP_SIGNALS
from .requirements import RENDERER, REQUIREMENTS
from .stage_process import how_it_ended

MODULE = "sim.app.install_worker"
"""From the tree's root, for ``own_command``."""

SIMULATING_MB, RENDERING_MB = (180, 560), (410, 1020)
"""Size of the packages that simulate, and of bpy, to download and on disk (Linux, November 2026)."""

_COLLECTING = re.compile(r"(?:Collecting|Requirement already satisfied:|Processing) (\S+)")


def environment_python(folder: Path) -> Path:
    """Return the interpreter of the virtual environment ``folder``."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def pip_command(python: Path, requirements: Sequence[str], wheels: Path | None) -> list[str]:
    """Return the command that installs ``requirements`` for ``python``.

    wheels: a folder that is the only source, so that nothing is downloaded; None for pip's own index. Only wheels are
    taken: a source archive would run its own code to build.
    """
    # -I: neither variables of the environment nor a user's packages decide what is installed.
    command = [str(python), "-I", "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    command += ["--only-binary", ":all:", "--progress-bar", "off"]
    if wheels is not None:
        command += ["--no-index", "--find-links", str(wheels)]
    return [*command, *requirements]


class Installation:
    """One run; ``stop`` ends it at any time, and another run completes it."""

    def __init__(self, folder: Path, requirements: Sequence[str], wheels: Path | None) -> None:
        self.folder, self.requirements, self.wheels = folder, list(requirements), wheels
        self._process: subprocess.Popen[str] | None = None

    def run(self) -> Path:
        """Make or complete the environment; return its interpreter. Raises OSError or RuntimeError with the reason."""
        python = environment_python(self.folder)
        if self.folder.exists() and not (self.folder / "pyvenv.cfg").is_file() and any(self.folder.iterdir()):
            raise RuntimeError(f"{self.folder} holds something else: move it away, or install by hand")
        if not python.is_file():
            _say(event="progress", message="making the environment", done=0, total=len(self.requirements) + 2)
            self._run([sys.executable, "-I", "-m", "venv", str(self.folder)])
        self._run(pip_command(python, self.requirements, self.wheels))
        return python

    def stop(self) -> None:
        """End the program that runs."""
        if self._process is not None:
            with contextlib.suppress(OSError):
                self._process.terminate()

    def _run(self, command: Sequence[str]) -> None:
        """Run one program and report what it is doing; RuntimeError with its last words when it fails."""
        kills = memory_kills()
        self._process = process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
        )
        assert process.stdout is not None
        done, total, last = 1, len(self.requirements) + 2, ""
        asked = {re.split("[<>=]", name)[0].lower() for name in self.requirements}
        for line in process.stdout:
            words = line.strip()
            if words.startswith("ERROR"):
                last = last or words
            found = _COLLECTING.match(words)
            if found and re.split("[<>=]", found[1])[0].lower() in asked:
                done = min(done + 1, total - 1)
            if words.startswith("Installing"):
                done, words = total - 1, "unpacking"
            if found or words == "unpacking" or words.startswith("Downloading"):
                _say(event="progress", message=words[:80], done=done, total=total)
        if process.wait() != 0:
            raise RuntimeError(
                last.removeprefix("ERROR: ") or how_it_ended(process.returncode, kills, what=Path(command[0]).name)
            )


def _say(**event: object) -> None:
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry of the module."""
    parser = argparse.ArgumentParser(prog=MODULE)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--wheels", type=Path)
    parser.add_argument("--render", action="store_true", help="with bpy")
    parser.add_argument("--requirement", action="append", help="in place of what simulates; repeatable")
    options = parser.parse_args(arguments)
    requirements = options.requirement or [*REQUIREMENTS.values(), *([RENDERER] if options.render else [])]
    installation = Installation(options.folder, requirements, options.wheels)

    def stopped(*_: object) -> None:
        installation.stop()
        sys.exit(130)

    for number in STOP_SIGNALS:
        signal.signal(number, stopped)
    try:
        python = installation.run()
    except (OSError, RuntimeError) as error:
        _say(
            event="error",
            kind="InputError",
            message=f"{error}; nothing else was changed, and Install goes on from here",
        )
        return 2
    _say(event="done", python=str(python))
    return 0


if __name__ == "__main__":
    sys.exit(main())
