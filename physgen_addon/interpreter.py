# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that runs simulations: never Blender's own process, because Taichi and bpy do not share one.

It needs the third-party packages only; PhysGen's code is the extension's own (``sim/app/launch.py``). It is the one
named in the preferences or in PHYSGEN_PYTHON, else Blender's with the wheels that the extension was installed with,
else the environment that ``install_command`` makes in the home folder.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from ..sim.app.process import NO_WINDOW, child_environment, own_command
from ..sim.app.requirements import MODULE, NEWEST, OLDEST, REQUIREMENTS
from ..sim.errors import InputError

VARIABLE = "PHYSGEN_PYTHON"
TERMINAL = "the Command Prompt" if os.name == "nt" else "a terminal"
"""Where commands are typed: Windows' other one, PowerShell, knows no ``&&``."""
_TIMEOUT_S = 60.0
_MOST_BYTES = 2**20
"""Of an answer; what says more is no Python."""


class NoPython(InputError):
    """No interpreter that simulates. reason: what is wrong; command: what to type to mend it, in one line."""

    def __init__(self, reason: str, command: str) -> None:
        super().__init__(f"{reason}. In {TERMINAL}: {command}")
        self.reason, self.command = reason, command


def find_python(preferred: str = "") -> Path:
    """The interpreter that simulates: named in the preferences or in PHYSGEN_PYTHON, Blender's, or ~/physgen-python.

    Takes seconds the first time, because it is started and asked; call it in a job. Raises NoPython if it cannot.
    One that somebody named is never quietly replaced by another.
    """
    for where, name in (("in the preferences", preferred), (f"in {VARIABLE}", os.environ.get(VARIABLE, ""))):
        if name.strip():
            python = _located(name.strip(), where)
            try:
                _checked(str(python), wheels_for(python))
            except _Unfit as error:
                reason = f"{python}, named {where}, cannot simulate: {error}"
                raise NoPython(reason, install_command(python if error.lacks else None, error.installs)) from None
            return python
    return _unnamed()


def _unnamed() -> Path:
    """Blender's own Python or the one in the home folder; NoPython with what is wrong with the one that comes last."""
    python = Path(sys.executable)
    try:
        _checked(str(python), wheels_for(python))
        return python
    except _Unfit as error:
        reason = why_not(sys.version_info[:2], wheel_folder(), str(error))
    if not _home_python().is_file():
        raise NoPython(reason, install_command())
    try:
        _checked(str(_home_python()), "")
        return _home_python()
    except _Unfit as error:
        reason = f"{_home_python()} cannot simulate: {error}"
        raise NoPython(reason, install_command(_home_python() if error.lacks else None, error.lacks)) from None


def named_python() -> Path | None:
    """The interpreter that PHYSGEN_PYTHON names, else the one in the home folder; not asked whether it simulates.

    Raises NoPython where the named one cannot be started; None where nothing is named and nothing is there.
    """
    name = os.environ.get(VARIABLE, "").strip()
    if name:
        return _located(name, f"in {VARIABLE}")
    return _home_python() if _home_python().is_file() else None


def python_version(python: Path) -> str:
    """Such as ``3.13.1``, of an interpreter that ``find_python`` gave."""
    return _checked(str(python), wheels_for(python))


def forget() -> None:
    """Ask anew the next time, because somebody has installed something."""
    _checked.cache_clear()


def cli_command(python: Path, *arguments: str) -> Sequence[str]:
    """``physgen ARGUMENTS --json`` as a command of that interpreter, running this extension's own code."""
    return own_command("batch.cli", *arguments, "--json", python=str(python), packages=wheels_for(python))


def wheel_folder() -> str:
    """Where Blender has unpacked the extension's wheels, found without importing any; empty where there are none."""
    found = importlib.util.find_spec("taichi")
    return str(Path(found.origin).parents[1]) if found is not None and found.origin else ""


def install_command(python: Path | None = None, installs: bool = False) -> str:
    """One line for a terminal that makes a Python that simulates.

    python: it gets what it lacks, or, where pip may not install into it, a virtual environment is made with it in the
    home folder; None for one made with the newest Python that will do.
    """
    wanted = " ".join(_quoted(requirement) for requirement in REQUIREMENTS.values())
    if python is not None and installs:
        return f"{_quoted(python)} -m pip install {wanted}"
    newest = f"py -{_dotted(NEWEST)}" if os.name == "nt" else f"python{_dotted(NEWEST)}"
    start = newest if python is None else _quoted(python)
    return f"{start} -m venv {_quoted(home_folder())} && {_quoted(_home_python())} -m pip install {wanted}"


def _quoted(word: str | Path) -> str:
    """``word`` as the terminal takes it for one: a shell would also look for $ and ` between double quotes."""
    return f'"{word}"' if os.name == "nt" else shlex.quote(str(word))


def home_folder() -> Path:
    """Where ``install_command`` makes an environment; looked for there when nothing else simulates."""
    return Path.home() / "physgen-python"


def _home_python() -> Path:
    return home_folder() / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def why_not(version: tuple[int, int], wheels: str, trouble: str) -> str:
    """Why Blender's own Python of that version, with those wheels, does not simulate, and what to do about it."""
    which = f"name a Python {_dotted(OLDEST)} to {_dotted(NEWEST)} that has its packages"
    remedy = f"{which} in PhysGen's preferences, or in {VARIABLE}"
    if not OLDEST <= version <= NEWEST:
        return f"Taichi, which simulates, has no build for Blender's Python {_dotted(version)}: {remedy}"
    if not wheels:
        return f"PhysGen was installed without what simulates: install the zip that has it, or {remedy}"
    return f"Blender's own Python cannot simulate ({trouble}): {remedy}"


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(str(number) for number in version)


def _located(name: str, where: str) -> Path:
    """The program that somebody meant by ``name``: a file, a command, or the folder of an environment."""
    path = Path(name).expanduser()
    inside = [path / "bin" / "python", path / "Scripts" / "python.exe", path / "python.exe"]
    for candidate in inside if path.is_dir() else [path]:
        found = shutil.which(candidate)
        if found is not None:
            # Not resolved: the environment of a link is where the link lies.
            return Path(found).absolute()
    raise NoPython(f"{name}, named {where}, is no Python that can be started", install_command())


def wheels_for(python: Path) -> str:
    """The extension's wheels fit Blender's own Python and no other."""
    return wheel_folder() if python == Path(sys.executable) else ""


class _Unfit(Exception):
    """An interpreter that cannot simulate. lacks: but would if more were installed; installs: which pip may do."""

    def __init__(self, reason: str, *, lacks: bool = False, installs: bool = False) -> None:
        super().__init__(reason)
        self.lacks, self.installs = lacks, installs


@functools.lru_cache(maxsize=8)
def _checked(python: str, packages: str) -> str:
    """The version of an interpreter that can simulate; raises _Unfit. What is good is kept, it is asked before jobs."""
    code, said, complaints = _asked(own_command(MODULE, python=python, packages=packages))
    lines = said.strip().splitlines()
    if code != 0 or not lines:
        words = complaints.strip().splitlines()
        raise _Unfit(words[-1][:300] if words else f"it ended with code {code} when Taichi was loaded")
    try:
        answer = json.loads(lines[-1])
        version, trouble = str(answer["python"]), str(answer["trouble"] or "")
        number = tuple(int(part) for part in version.split(".")[:2])
        missing, installs = [str(item) for item in answer["missing"]], bool(answer["installs"])
    except (ValueError, TypeError, KeyError, RecursionError):
        raise _Unfit(f"it answered {lines[-1][:80]!r}") from None
    if missing and number > NEWEST:
        raise _Unfit(f"Python {version} is too new: {_dotted(OLDEST)} to {_dotted(NEWEST)} are needed")
    if missing:
        names = ", ".join(re.split("[<>=]", requirement)[0] for requirement in missing)
        raise _Unfit(f"it lacks {names}", lacks=True, installs=installs)
    if trouble:
        raise _Unfit(trouble)
    return version


def _asked(command: Sequence[str]) -> tuple[int, str, str]:
    """Exit code, output and complaints of ``command``; _Unfit where it cannot be started or has no end.

    Neither a program that prints for ever nor one that leaves children behind keeps this waiting.
    """
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=child_environment(),
            start_new_session=os.name != "nt",
            creationflags=NO_WINDOW,
        )
    except OSError as error:
        raise _Unfit(str(error.strerror or error)) from None
    said = [b"", b""]

    def read(index: int, stream: IO[bytes]) -> None:
        said[index] = stream.read(_MOST_BYTES)
        if len(said[index]) == _MOST_BYTES:
            _kill(process)

    readers = [
        threading.Thread(target=read, args=(index, stream), daemon=True)
        for index, stream in enumerate((process.stdout, process.stderr))
    ]
    for reader in readers:
        reader.start()
    try:
        code = process.wait(_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise _Unfit(f"it did not answer within {_TIMEOUT_S:g} s") from None
    finally:
        _kill(process)
        process.wait()
    for reader in readers:
        reader.join(1.0)
    if any(len(text) == _MOST_BYTES for text in said):
        raise _Unfit("it is no Python: it prints without end")
    out, complaints = (text.decode("utf-8", "replace") for text in said)
    return code, out, complaints


def _kill(process: subprocess.Popen[bytes]) -> None:
    """With all that it has started."""
    with contextlib.suppress(OSError):
        if os.name == "nt":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)
