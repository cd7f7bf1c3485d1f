# SPDX-License-Identifier: GPL-3.0-or-later
"""A command that is asked to stop while its modules are still imported ends with the same code as later.

Importing NumPy and the rest takes a second, on a busy machine many. Nothing is written before ``cli.main`` takes
the signals over (``terminal.stop_signals``), so ending at once loses nothing. Imported first, and light; what has
to be set before NumPy is imported is set here, too.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import PurePath

from ..sim.app.launch import ONE_BLAS_THREAD

CANCELLED = 130
"""Exit code of ``Cancelled`` in sim/errors.py."""


def _is_own_process() -> bool:
    """Return whether this process is the ``physgen`` command, not a program that uses its modules."""
    started = getattr(sys.modules.get("__main__"), "__spec__", None)
    module = "" if started is None else started.name
    return module.endswith((".batch.cli", "physgen.__main__")) or PurePath(sys.argv[0]).stem == "physgen"


def heed() -> None:
    """End this process at once, with the code for cancelled, when it gets SIGINT or SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(CANCELLED))


if _is_own_process():
    heed()
    os.environ.setdefault(*ONE_BLAS_THREAD)
