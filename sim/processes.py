# SPDX-License-Identifier: MIT
"""Processes: the identity of one (number, start and machine), and those that this one has started.

A ``Mark`` is written into names of temporary files and into locks, so that a reused number does not match another
process. Whether its process still runs is known for this machine only; processes of another one never count as dead.
Started ones are noted for an exit that cannot wait for them.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import signal
import socket
import subprocess
import sys
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MARK = r"\d{1,10}-[0-9a-f]{1,32}-[0-9a-f]{8}"
"""Pattern of a mark's text."""
_MARK = re.compile(r"(\d{1,10})-([0-9a-f]{1,32})-([0-9a-f]{8})")
UNKNOWN_START = "0"


@dataclass(frozen=True)
class Mark:
    """A process. started: when, as 1 to 32 hex digits that differ after a reboot, ``0`` if unknown; machine: 8 hex
    digits."""

    pid: int
    started: str
    machine: str

    def __str__(self) -> str:
        return f"{self.pid}-{self.started}-{self.machine}"

    @property
    def is_here(self) -> bool:
        """Return whether it is, or was, a process of this machine."""
        return self.machine == _machine()

    @property
    def is_dead(self) -> bool:
        """Return whether it is certain that the process has ended; False for one of another machine."""
        if not self.is_here:
            return False
        now = _started(self.pid)
        if now is None:
            return True
        return UNKNOWN_START not in (now, self.started) and now != self.started


def own_mark() -> Mark:
    """Return the mark of this process."""
    return _own_mark(os.getpid())


def is_running(pid: int) -> bool:
    """Return whether a process with this number runs on this machine, whichever it is."""
    return _started(pid) is not None


@functools.lru_cache(maxsize=2)
def _own_mark(pid: int) -> Mark:
    return Mark(pid, _started(pid) or UNKNOWN_START, _machine())


def parse_mark(text: str) -> Mark | None:
    """Return the mark that ``text`` is, if it is one."""
    found = _MARK.fullmatch(text)
    return Mark(int(found[1]), found[2], found[3]) if found else None


@functools.cache
def _machine() -> str:
    # Containers may share a name and a disk, but not the numbers of their processes; machines of a cluster may all have
    # the name that they were installed with.
    try:
        numbers = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        numbers = ""
    own = next((found for path in MACHINE_IDS if (found := _word(path))), "")
    return hashlib.sha256(f"{socket.gethostname()} {numbers} {own}".encode()).hexdigest()[:8]


MACHINE_IDS = (Path("/etc/machine-id"), Path("/var/lib/dbus/machine-id"))
"""Files with a number of this installation of Linux."""


def _word(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return file.read(64).decode("ascii", "replace").strip()
    except OSError:
        return ""


def _started(pid: int) -> str | None:
    """Return when the process ``pid`` of this machine started; None if there is none."""
    if pid <= 0 or pid >= 2**31:
        return None
    if os.name == "nt":
        return _started_on_windows(pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except OSError:
        # It is another user's.
        pass
    if sys.platform == "linux":
        return _started_on_linux(pid)
    return _started_on_macos(pid) if sys.platform == "darwin" else UNKNOWN_START


def _started_on_linux(pid: int) -> str | None:
    try:
        content = Path(f"/proc/{pid}/stat").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return None
    except OSError:
        return UNKNOWN_START
    # The name in parentheses may hold anything.
    fields = content.rpartition(b")")[2].split()
    if len(fields) < 20 or fields[0] in (b"Z", b"X"):
        # A zombie has ended; only its parent has not asked how.
        return None
    return f"{_boot()}{int(fields[19]):x}"


@functools.cache
def _boot() -> str:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().replace("-", "").strip()[:12]
    except OSError:
        return ""


def _started_on_macos(pid: int) -> str | None:
    import ctypes

    # proc_bsdinfo: 136 bytes, its start in seconds and microseconds at the end.
    try:
        answer = ctypes.create_string_buffer(136)
        size = ctypes.CDLL("/usr/lib/libproc.dylib").proc_pidinfo(pid, 3, ctypes.c_uint64(0), answer, 136)
    except (OSError, AttributeError):
        return UNKNOWN_START
    if size != 136:
        return UNKNOWN_START
    seconds, micros = (int.from_bytes(answer.raw[at : at + 8], "little") for at in (120, 128))
    return f"{seconds:x}{micros:05x}"


def _started_on_windows(pid: int) -> str | None:
    import ctypes

    kernel: Any = ctypes.windll.kernel32  # type: ignore[attr-defined]
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = ctypes.c_void_p(kernel.OpenProcess(0x1000, False, pid))
    if not handle:
        # 5: it runs, and is another user's.
        return UNKNOWN_START if kernel.GetLastError() == 5 else None
    try:
        code = ctypes.c_ulong()
        if kernel.GetExitCodeProcess(handle, ctypes.byref(code)) and code.value != 259:
            return None
        times = [ctypes.c_uint64() for _ in range(4)]
        good = kernel.GetProcessTimes(handle, *(ctypes.byref(time) for time in times))
        return f"{times[0].value:x}" if good else UNKNOWN_START
    finally:
        kernel.CloseHandle(handle)


_children: weakref.WeakSet[subprocess.Popen[bytes]] = weakref.WeakSet()


def note_child(process: subprocess.Popen[bytes]) -> None:
    """Remember ``process``, the leader of its own session, until it has ended."""
    _children.add(process)


def kill_children() -> None:
    """Kill all that run, with the processes that they started."""
    for process in list(_children):
        if process.returncode is None:
            with contextlib.suppress(OSError):
                if os.name == "nt":
                    process.kill()
                else:
                    os.killpg(process.pid, signal.SIGKILL)
