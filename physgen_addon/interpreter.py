# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that runs simulations: never Blender's own process, because Taichi and bpy do not share one."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from ..sim.app.process import child_environment
from ..sim.errors import InputError

VARIABLE = "PHYSGEN_PYTHON"
_CHECK = "import physgen.batch.cli, importlib.util as u, sys; sys.exit(u.find_spec('taichi') is None)"
_TIMEOUT_S = 60.0


def find_python(preferred: str = "") -> Path:
    """The first interpreter that can run ``physgen``: the one named in the preferences, in PHYSGEN_PYTHON, this one's.

    Takes seconds the first time, because it starts each of them; call it in a job. Raises InputError if none can.
    """
    named = [("the preferences", preferred), (VARIABLE, os.environ.get(VARIABLE, "")), ("Blender", sys.executable)]
    tried = []
    for where, name in named:
        if not name:
            continue
        trouble = _trouble(name)
        if trouble is None:
            return Path(name)
        tried.append(f"{name} (from {where}): {trouble}")
        if where != "Blender":
            # Somebody chose it: say what is wrong with it rather than quietly take another.
            break
    raise InputError(
        "no Python that can simulate; install physgen into one and name it in the add-on's preferences. "
        + "; ".join(tried)
    )


def cli_command(python: Path, *arguments: str) -> Sequence[str]:
    """``physgen ARGUMENTS --json`` as a command of that interpreter."""
    return [str(python), "-m", "physgen.batch.cli", *arguments, "--json"]


def _trouble(name: str) -> str | None:
    try:
        return _checked(name)
    except OSError as error:
        return str(error.strerror or error)
    except subprocess.TimeoutExpired:
        return f"did not answer within {_TIMEOUT_S:g} s"


@functools.lru_cache(maxsize=8)
def _checked(name: str) -> str | None:
    """None when it can; what it says otherwise. Kept, because it is asked before every job."""
    done = subprocess.run(
        [name, "-c", _CHECK],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        env=child_environment(),
        timeout=_TIMEOUT_S,
        creationflags=0x08000000 if os.name == "nt" else 0,  # no console window
    )
    if done.returncode == 0:
        return None
    words = done.stderr.decode("utf-8", "replace").strip().splitlines()
    return words[-1] if words else "it has no taichi"
