# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python interpreter that runs simulations: never Blender's process, because Taichi and bpy cannot share one.

It needs the third-party packages only; PhysGen's code is that of the extension (``sim/app/launch.py``). It is the one
set in the preferences or PHYSGEN_PYTHON, else Blender's own with the extension's wheels, else the environment that
``install_command`` creates in the home folder.
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
from typing import IO, NamedTuple

from ..sim.app.bake_worker import SERVE
from ..sim.app.requirements import MODULE, NEWEST, OLDEST, RENDERER, REQUIREMENTS
from ..sim.app.stage_process import NO_WINDOW, child_environment, own_command
from ..sim.errors import InputError

VARIABLE = "PHYSGEN_PYTHON"
TERMINAL = "the Command Prompt" if os.name == "nt" else "a terminal"
"""Name of the terminal for commands: PowerShell, Windows' other one, has no ``&&``."""
RENDERING = {"scipy": "scipy", "trimesh": "trimesh", "PIL": "Pillow", "cv2": "OpenCV", "OpenImageIO": "OpenImageIO"}
"""Modules that rendering into a photo imports, and their package names."""
_USUAL_PLACES = ("/usr/local/bin", "/opt/homebrew/bin", "/usr/bin")
_FRAMEWORK = "/Library/Frameworks/Python.framework/Versions/{}/bin"
"""Where Pythons are that are not on the search path of programs started from a desktop."""
_MANAGED = (".local/bin", ".pyenv/versions/*/bin", ".local/share/uv/python/*/bin")
"""In the home folder, by pip and pipx, pyenv and uv: on the search path of a shell at most."""
_BASE_PROBE = "import ensurepip, sys, venv; print('%d.%d' % sys.version_info[:2]); print(sys.executable)"
_TIMEOUT_S = 60.0
_MOST_BYTES = 2**20
"""Maximum output of a probed program; one that prints more is not Python."""


class NoPython(InputError):
    """No interpreter can simulate, or render into a photo.

    reason: the cause; command: a shell command that fixes it, in one line.
    """

    def __init__(self, reason: str, command: str) -> None:
        super().__init__(f"{reason}. In {TERMINAL}: {command}")
        self.reason, self.command = reason, command


def find_python(preferred: str = "") -> Path:
    """Return the interpreter that simulates: from the preferences, PHYSGEN_PYTHON, Blender's own, or ~/physgen-python.

    The first call takes seconds because the interpreter is probed; call it in a job. Raises NoPython. A configured
    interpreter is never silently replaced by another.
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
    """Return Blender's own Python or the one in the home folder; raise NoPython with the last one's problem."""
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
    """Return the interpreter set in PHYSGEN_PYTHON, else the one in the home folder, without probing its packages.

    Raises NoPython if the configured one cannot be started; None if there is neither.
    """
    name = os.environ.get(VARIABLE, "").strip()
    if name:
        return _located(name, f"in {VARIABLE}")
    return _home_python() if _home_python().is_file() else None


def is_set_up(preferred: str = "") -> bool:
    """Return whether there is an interpreter for ``find_python`` to try, without starting any: for panels."""
    named = preferred.strip() or os.environ.get(VARIABLE, "").strip()
    return bool(named or wheel_folder()) or _home_python().is_file()


def python_version(python: Path) -> str:
    """Return the version, such as ``3.13.1``, of an interpreter from ``find_python``."""
    return _checked(str(python), wheels_for(python)).version


def renders(python: Path) -> bool:
    """Return whether an interpreter from ``find_python`` can render into a photo: it has bpy."""
    return _checked(str(python), wheels_for(python)).renders


def require_renderer(python: Path) -> None:
    """Raise NoPython if ``python``, from ``find_python``, cannot render into a photo."""
    if not renders(python):
        command = f"{_quoted(python)} -m pip install {_quoted(RENDERER)}"
        raise NoPython(f"{python} simulates, but cannot render into a photo: it lacks bpy", command)


def missing_modules() -> list[str]:
    """Return the packages that this Blender's own Python lacks for rendering into a photo."""
    return [title for module, title in RENDERING.items() if importlib.util.find_spec(module) is None]


class PhotoCheck:
    """Whether a photo can be reconstructed and rendered here, found out beside the user's work.

    ``trouble`` is why not, empty until that is known.
    """

    def __init__(self) -> None:
        self.trouble = ""

    def begin(self, preferred: str) -> None:
        """Look for the interpreter as ``find_python`` does, in a thread, because probing one takes seconds."""
        threading.Thread(target=self.look, args=(preferred,), daemon=True).start()

    def look(self, preferred: str) -> None:
        """Set ``trouble``."""
        try:
            python = find_python(preferred)
            if missing_modules():
                require_renderer(python)
        except NoPython as error:
            self.trouble = error.reason
        else:
            self.trouble = ""


photo_check = PhotoCheck()
"""Of this session: begun when a photo is opened and when the interpreter is checked, shown in the Photo panel."""


def forget() -> None:
    """Clear the cache, because packages were installed."""
    _checked.cache_clear()
    photo_check.trouble = ""


def cli_command(python: Path, *arguments: str) -> Sequence[str]:
    """Return the command for ``physgen ARGUMENTS --json`` in that interpreter, running this extension's code."""
    return own_command("batch.cli", *arguments, "--json", python=str(python), packages=wheels_for(python))


def bake_command(python: Path) -> Sequence[str]:
    """Return the command of the process that takes bakes one after the other, in that interpreter."""
    return own_command("sim.app.bake_worker", SERVE, python=str(python), packages=wheels_for(python))


def wheel_folder() -> str:
    """Return the folder of the extension's unpacked wheels, found without importing any; empty if there are none."""
    found = importlib.util.find_spec("taichi")
    return str(Path(found.origin).parents[1]) if found is not None and found.origin else ""


def install_command(python: Path | None = None, installs: bool = False) -> str:
    """Return a shell command, one line, that creates a Python environment for simulation.

    python: interpreter that gets the missing packages, or, if pip may not install into it, the base of a virtual
    environment in the home folder; None for one based on the newest suitable Python.
    """
    wanted = " ".join(_quoted(requirement) for requirement in (*REQUIREMENTS.values(), RENDERER))
    if python is not None and installs:
        return f"{_quoted(python)} -m pip install {wanted}"
    newest = f"py -{_dotted(NEWEST)}" if os.name == "nt" else f"python{_dotted(NEWEST)}"
    start = newest if python is None else _quoted(python)
    return f"{start} -m venv {_quoted(home_folder())} && {_quoted(_home_python())} -m pip install {wanted}"


def _quoted(word: str | Path) -> str:
    """Return ``word`` quoted for the terminal; inside double quotes a shell would still expand $ and `."""
    return f'"{word}"' if os.name == "nt" else shlex.quote(str(word))


def find_base() -> Path:
    """Return a Python from which an environment that simulates can be made; each candidate is started to find out.

    In this order: those on the search path and where installers put them, Blender's own. Raises NoPython.
    """
    kept = [str(place) for pattern in _MANAGED for place in sorted(Path.home().glob(pattern))]
    places = [*os.environ.get("PATH", "").split(os.pathsep), *_USUAL_PLACES, *kept]
    for version in (f"3.{minor}" for minor in range(NEWEST[1], OLDEST[1] - 1, -1)):
        launcher = [["py", f"-{version}"]] if os.name == "nt" else []
        named = shutil.which(f"python{version}", path=os.pathsep.join([*places, _FRAMEWORK.format(version)]))
        for command in [*launcher, *([[named]] if named else []), [sys.executable]]:
            with contextlib.suppress(_Unfit):
                found = _asked([*command, "-I", "-c", _BASE_PROBE])[1].strip().splitlines()
                if len(found) == 2 and found[0] == version:
                    return Path(found[1])
    reason = f"no Python {_dotted(OLDEST)} to {_dotted(NEWEST)} with venv was found: install one (python.org, or your"
    raise NoPython(f"{reason} system's packages)", install_command())


def home_folder() -> Path:
    """Return the folder in which ``install_command`` creates an environment; the last place searched."""
    return Path.home() / "physgen-python"


def _home_python() -> Path:
    return home_folder() / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def why_not(version: tuple[int, int], wheels: str, trouble: str) -> str:
    """Return why Blender's own Python of that version, with those wheels, cannot simulate, and the remedy."""
    remedy = "press Install, or choose another Python in PhysGen's preferences"
    if not OLDEST <= version <= NEWEST:
        wanted, own = f"{_dotted(OLDEST)} to {_dotted(NEWEST)}", _dotted(version)
        return f"simulations need Python {wanted}, and Blender's own is {own}: {remedy}"
    if not wheels:
        return f"this PhysGen came without its simulation packages: {remedy}"
    return f"Blender's own Python cannot simulate ({trouble}): {remedy}"


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(str(number) for number in version)


def _located(name: str, where: str) -> Path:
    """Return the program that ``name`` means: a file, a command, or the folder of an environment."""
    path = Path(name).expanduser()
    inside = [path / "bin" / "python", path / "Scripts" / "python.exe", path / "python.exe"]
    for candidate in inside if path.is_dir() else [path]:
        found = shutil.which(candidate)
        if found is not None:
            # Not resolved: the environment of a symlink is where the link lies.
            return Path(found).absolute()
    raise NoPython(f"{name}, named {where}, is no Python that can be started", install_command())


def wheels_for(python: Path) -> str:
    """Return the wheel folder if ``python`` is Blender's own; wheels fit no other."""
    return wheel_folder() if python == Path(sys.executable) else ""


class _Unfit(Exception):
    """An interpreter that cannot simulate. lacks: missing packages only; installs: pip may install into it."""

    def __init__(self, reason: str, *, lacks: bool = False, installs: bool = False) -> None:
        super().__init__(reason)
        self.lacks, self.installs = lacks, installs


class _Interpreter(NamedTuple):
    """One that can simulate: its version, such as ``3.13.1``, and whether it has bpy."""

    version: str
    renders: bool


@functools.lru_cache(maxsize=8)
def _checked(python: str, packages: str) -> _Interpreter:
    """Return the interpreter if it can simulate (cached); raises _Unfit."""
    code, output, complaints = _asked(own_command(MODULE, python=python, packages=packages))
    lines = output.strip().splitlines()
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
    return _Interpreter(version, answer.get("renders") is True)


def _asked(command: Sequence[str]) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of ``command``; _Unfit if it cannot be started or does not end.

    Neither endless output nor child processes that outlive the program block this call.
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
    output = [b"", b""]

    def read(index: int, stream: IO[bytes]) -> None:
        output[index] = stream.read(_MOST_BYTES)
        if len(output[index]) == _MOST_BYTES:
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
    if any(len(text) == _MOST_BYTES for text in output):
        raise _Unfit("it is not Python: its output does not end")
    out, complaints = (text.decode("utf-8", "replace") for text in output)
    return code, out, complaints


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a process with all its children."""
    with contextlib.suppress(OSError):
        if os.name == "nt":
            process.kill()
        else:
            os.killpg(process.pid, signal.SIGKILL)
