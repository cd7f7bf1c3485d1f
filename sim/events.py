# SPDX-License-Identifier: MIT
"""Progress, as plain dictionaries: the same in a callback, on a pipe and in a log (docs/file-formats.md).

``{"event": "progress", "stage", "done", "total", "eta_s", "message"}`` while a stage runs,
``{"event": "notice", "stage", "message"}`` for information to the user,
``{"event": "done", …}`` and ``{"event": "error", "kind", "message"}`` at the end of a process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

Event = dict[str, Any]
OnEvent = Callable[[Event], None]
IsCancelled = Callable[[], bool]


def ignore(event: Event) -> None:
    """Discard ``event``."""


def never() -> bool:
    """Return False: never cancelled."""
    return False


class StageProgress:
    """Progress events of one stage, with the remaining time.

    The remaining time follows the pace of recent units, because the first ones include start-up time.
    """

    def __init__(self, on_event: OnEvent, stage: str, total: int) -> None:
        self._on_event = on_event
        self._stage = stage
        self._total = total
        self._marks: list[tuple[int, float]] = []

    def report(self, done: int, message: str = "", *, paced: bool = True) -> None:
        """Report that ``done`` of the total units are finished. paced: off while compiling, which tells no pace."""
        now = time.monotonic()
        self._marks = [*self._marks[-8:], (done, now)] if paced else [(done, now)]
        first_done, first_time = self._marks[0]
        eta = None
        if done > first_done:
            eta = (self._total - done) * (now - first_time) / (done - first_done)
        event: Event = {"event": "progress", "stage": self._stage, "done": done, "total": self._total, "eta_s": eta}
        if message:
            event["message"] = message
        self._on_event(event)

    def notice(self, message: str) -> None:
        """Emit ``message`` as a notice to the user."""
        self._on_event({"event": "notice", "stage": self._stage, "message": message})
