# SPDX-License-Identifier: MIT
"""The processes that this one has started, for an exit that cannot wait for them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import weakref

_started: weakref.WeakSet[subprocess.Popen[bytes]] = weakref.WeakSet()


def note_child(process: subprocess.Popen[bytes]) -> None:
    """Remember ``process``, the leader of its own session, until it has ended."""
    _started.add(process)


def kill_children() -> None:
    """Kill all that run, with the processes that they started."""
    for process in list(_started):
        if process.returncode is None:
            with contextlib.suppress(OSError):
                if os.name == "nt":
                    process.kill()
                else:
                    os.killpg(process.pid, signal.SIGKILL)
