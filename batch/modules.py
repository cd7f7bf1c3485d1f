# SPDX-License-Identifier: GPL-3.0-or-later
"""Where Blender's Python finds what rendering into a photo imports; a factory start-up knows numpy and little more."""

from __future__ import annotations

import importlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..physgen_addon.interpreter import named_python
from ..sim.app.launch import PACKAGES_VARIABLE
from ..sim.app.process import NO_WINDOW, child_environment
from ..sim.app.requirements import REQUIREMENTS
from ..sim.errors import InputError, RenderError

RENDERING = ("scipy", "trimesh", "PIL", "cv2", "OpenImageIO")
"""Modules that rendering into a photo imports besides numpy, which every Blender has."""

_TREE = Path(__file__).resolve().parents[1]
_WHERE_ARE_YOUR_PACKAGES = "import sysconfig; print(sysconfig.get_python_version(), sysconfig.get_path('platlib'))"


def provide_modules(packages: Path | None) -> str | None:
    """Make ``RENDERING`` importable; where what Blender lacks was found, in words, or None where it lacks nothing.

    packages: folder that somebody named with ``--packages``; PHYSGEN_PACKAGES names one too. What Blender has itself
    comes first. Raises InputError for a folder that is none, RenderError with the remedy when something is lacking.
    """
    _add_named(packages)
    said = None
    for where, folder in _places():
        if not _lacking():
            break
        sys.path.append(str(folder))
        importlib.invalidate_caches()
        said = f"what Blender's Python lacks is taken from {where}: {folder}"
    lacking = _lacking()
    if lacking:
        raise RenderError(_remedy(lacking))
    for name in RENDERING:
        try:
            importlib.import_module(name)
        except ImportError as error:
            found = importlib.util.find_spec(name)
            origin = found.origin if found is not None else name
            raise RenderError(
                f"{origin}: cannot be loaded by Python {_version()} ({error}); install {REQUIREMENTS[name]} for this "
                "Python, and name the folder with --packages"
            ) from error
    return said


def _lacking() -> list[str]:
    return [name for name in RENDERING if importlib.util.find_spec(name) is None]


def _add_named(packages: Path | None) -> None:
    named = os.environ.get(PACKAGES_VARIABLE, "")
    for where, folder in (("--packages", packages), (PACKAGES_VARIABLE, Path(named) if named else None)):
        if folder is None:
            continue
        if not folder.is_dir():
            raise InputError(f"{where} is {str(folder)!r}, which is no folder; name one that pip has filled (--target)")
        if str(folder) not in sys.path:
            sys.path.append(str(folder))


def _places() -> Iterator[tuple[str, Path]]:
    """Folders that may hold the rest, and what they are."""
    # An extension lies in extensions/REPOSITORY/physgen, and Blender unpacks wheels beside the repositories.
    wheels = _TREE.parents[1] / ".local" / "lib" / f"python{_version()}" / "site-packages"
    if wheels.is_dir():
        yield "the extension's wheels", wheels
    python = named_python()
    if python is not None:
        try:
            answer = subprocess.run(
                [str(python), "-c", _WHERE_ARE_YOUR_PACKAGES],
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
    wanted = " ".join(f'"{REQUIREMENTS[name]}"' for name in RENDERING)
    folder = f"physgen-blender-{_version()}"
    return (
        f"this Python {_version()} lacks {', '.join(lacking)}, needed to render into a photo. In a terminal: "
        f'"{sys.executable}" -m pip install --target {folder} "numpy=={np.__version__}" {wanted}; '
        f"then render with --packages {folder}, or with {PACKAGES_VARIABLE}={folder}"
    )
