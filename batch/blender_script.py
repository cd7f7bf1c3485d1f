# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared by ``batch/render.py`` and ``batch/encode.py``: modules for Blender's Python, signals, events, exit codes."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from ..physgen_addon.interpreter import named_python
from ..sim.app.launch import PACKAGES_VARIABLE
from ..sim.app.requirements import REQUIREMENTS
from ..sim.app.stage_process import NO_WINDOW, child_environment
from ..sim.errors import OUT_OF_MEMORY, Cancelled, InputError, PhysGenError, RenderError
from ..sim.events import Event, IsCancelled, OnEvent
from ..sim.memory import ran_out
from .headless import Stop, events_apart_from_chatter, script_arguments, start_empty, temporary_folder
from .terminal import Terminal

RENDER_MODULES = ("scipy", "trimesh", "PIL", "cv2", "OpenImageIO")
"""Modules that rendering into a photo imports, besides numpy, which every Blender has."""

_TREE = Path(__file__).resolve().parents[1]
_WHERE_ARE_YOUR_PACKAGES = "import sysconfig; print(sysconfig.get_python_version(), sysconfig.get_path('platlib'))"


def provide_modules(packages: Path | None) -> str | None:
    """Make ``RENDERING`` importable; return a notice where missing modules were found, or None if none were missing.

    packages: folder given by ``--packages``, searched before that of PHYSGEN_PACKAGES; Blender's own modules come
    first. Raises InputError if it is not a folder, RenderError with the remedy if modules are still missing.
    """
    _add_named(packages)
    notice = None
    for where, folder in _places():
        if not _missing():
            break
        sys.path.append(str(folder))
        importlib.invalidate_caches()
        notice = f"modules missing from Blender's Python are taken from {where}: {folder}"
    lacking = _missing()
    if lacking:
        raise RenderError(_remedy(lacking))
    for name in RENDER_MODULES:
        try:
            importlib.import_module(name)
        except ImportError as error:
            if ran_out(error):
                raise InputError(f"render: {OUT_OF_MEMORY}") from error
            found = importlib.util.find_spec(name)
            origin = found.origin if found is not None else name
            raise RenderError(
                f"{origin}: cannot be loaded by Python {_version()} ({error}); install {REQUIREMENTS[name]} for this "
                "Python, and name the folder with --packages"
            ) from error
    return notice


def _missing() -> list[str]:
    return [name for name in RENDER_MODULES if importlib.util.find_spec(name) is None]


def _add_named(packages: Path | None) -> None:
    named = os.environ.get(PACKAGES_VARIABLE, "")
    for where, folder in (("--packages", packages), (PACKAGES_VARIABLE, Path(named) if named else None)):
        if folder is None:
            continue
        if not folder.is_dir():
            raise InputError(
                f"{where} is {str(folder)!r}, which is not a folder; name one that pip has filled (--target)"
            )
        if str(folder) not in sys.path:
            sys.path.append(str(folder))


def _places() -> Iterator[tuple[str, Path]]:
    """Yield descriptions and folders that may contain missing modules."""
    # An extension is in extensions/REPOSITORY/physgen, and Blender unpacks wheels beside the repositories.
    wheels = _TREE.parents[1] / ".local" / "lib" / f"python{_version()}" / "site-packages"
    if wheels.is_dir():
        yield "the extension's wheels", wheels
    python = named_python()
    if python is not None:
        try:
            answer = subprocess.run(
                [str(python), "-I", "-c", _WHERE_ARE_YOUR_PACKAGES],
                capture_output=True,
                text=True,
                timeout=60,
                env=child_environment(),
                creationflags=NO_WINDOW,
            )
        except (OSError, subprocess.TimeoutExpired):
            return
        version, _, folder = answer.stdout.strip().partition(" ")
        if version == _version():
            yield str(python), Path(folder)


def _version() -> str:
    return f"{sys.version_info[0]}.{sys.version_info[1]}"


def _remedy(lacking: list[str]) -> str:
    wanted = " ".join(f'"{REQUIREMENTS[name]}"' for name in RENDER_MODULES)
    folder = f"physgen-blender-{_version()}"
    return (
        f"this Python {_version()} lacks {', '.join(lacking)}, needed to render into a photo. In a terminal: "
        f'"{sys.executable}" -m pip install --target {folder} "numpy=={np.__version__}" {wanted}; '
        f"then render with --packages {folder}, or with {PACKAGES_VARIABLE}={folder}"
    )


Work = Callable[[argparse.Namespace, OnEvent, IsCancelled], tuple[Event, str]]
"""Does the work of the options; returns its ``done`` event and the same in words. Raises a PhysGenError."""


def add_script_options(parser: argparse.ArgumentParser) -> None:
    """Add packages, parent process and output format."""
    packages = "folder of packages missing from Blender's Python (docs/farm.md)"
    parser.add_argument("--packages", type=Path, metavar="DIR", help=packages)
    parser.add_argument("--parent", type=int, metavar="PID", help="stop cleanly when this parent process ends")
    parser.add_argument("--json", action="store_true", help="progress and result as JSON lines")


def run_script(
    parser: argparse.ArgumentParser,
    work: Work,
    give_up: Callable[[argparse.Namespace], Cancelled],
    arguments: Sequence[str] | None,
    *,
    stage: str,
) -> int:
    """Parse the arguments, prepare Blender, do ``work`` and return the exit code (docs/farm.md).

    parser: with the script's own arguments. give_up: called when Blender does not stop in time; removes incomplete
    files and returns the error to report. arguments: None for those of the process, after ``--`` inside Blender.
    stage: of the events.
    """
    add_script_options(parser)
    options = parser.parse_args(script_arguments(sys.argv) if arguments is None else arguments)
    stop = Stop(options.parent)
    with events_apart_from_chatter() as stream, temporary_folder():
        terminal = Terminal(as_json=options.json, out=stream)
        stop.listen(lambda: _report(give_up(options), terminal))
        try:
            _prepare(options.packages, terminal, stage)
            done, words = work(options, terminal, lambda: stop() or terminal.reader_gone)
        except PhysGenError as error:
            return _report(error, terminal)
        except OSError as error:
            # Most likely the temporary folder: layers, textures and frames pass through it.
            where = error.filename or Path(tempfile.gettempdir()).parent
            message = f"{where}: {error.strerror or error}; free space, then run again"
            return _report(RenderError(message), terminal)
        except Exception as error:
            if not ran_out(error):
                raise
            return _report(InputError(f"{stage}: {OUT_OF_MEMORY}"), terminal)
        terminal(done)
        terminal.line(words)
        return 0


def _prepare(packages: Path | None, terminal: Terminal, stage: str) -> None:
    """Reset Blender and find missing packages. Raises RenderError without Blender, or if packages are missing."""
    try:
        import bpy  # noqa: F401
    except ImportError as error:
        raise RenderError(
            f"Blender as a Python module is not usable ({error}); run `make setup`, or run this file in Blender"
        ) from error
    start_empty()
    found = provide_modules(packages)
    if found is not None:
        terminal({"event": "notice", "stage": stage, "message": found})


def _report(error: PhysGenError, terminal: Terminal) -> int:
    """Print ``error``; return its exit code."""
    terminal.error(type(error).__name__, str(error))
    return error.exit_code
