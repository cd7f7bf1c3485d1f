# SPDX-License-Identifier: MIT
"""What a reconstruction tells while it works, and where it stops when asked to."""

from __future__ import annotations

from ..errors import Cancelled
from ..events import IsCancelled, OnEvent


class Steps:
    """Reports progress, passes notices on, and stops between steps when asked to."""

    def __init__(self, total: int, on_event: OnEvent, cancelled: IsCancelled) -> None:
        self._total, self._done, self._on_event, self.cancelled = total, 0, on_event, cancelled
        self.notices: list[str] = []

    def begin(self, name: str) -> None:
        """A step called ``name`` begins. Raises Cancelled when asked to stop."""
        if self.cancelled():
            raise Cancelled(f"reconstruction cancelled before step {name!r}; nothing was written")
        event = {"event": "progress", "stage": "reconstruct", "step": name, "message": name}
        self._on_event({**event, "done": self._done, "total": self._total})
        self._done += 1

    def finish(self) -> None:
        """All steps are done. Raises Cancelled when asked to stop."""
        if self.cancelled():
            raise Cancelled("reconstruction cancelled at its end; nothing was written")
        event = {"event": "progress", "stage": "reconstruct", "step": "done", "message": "done"}
        self._on_event({**event, "done": self._total, "total": self._total})

    def notice(self, message: str) -> None:
        """Something the user should know."""
        self.notices.append(message)
        self._on_event({"event": "notice", "stage": "reconstruct", "message": message})
