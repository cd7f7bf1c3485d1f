# SPDX-License-Identifier: MIT
"""Progress, as plain dictionaries: the same in a callback, on a pipe and in a log (docs/file-formats.md).

``{"event": "progress", "stage", "done", "total", "eta_s", "message"}`` while a stage runs,
``{"event": "notice", "stage", "message"}`` for information to the user,
``{"event": "done", …}`` and ``{"event": "error", "kind", "message"}`` at the end of a process.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

Event = dict[str, Any]
OnEvent = Callable[[Event], None]
IsCancelled = Callable[[], bool]


def ignore(event: Event) -> None:
    """Discard ``event``."""


def never() -> bool:
    """Return False: never cancelled."""
    return False


STAGES: Mapping[str, str] = {
    "batch": "Running the job",
    "bake": "Simulating",
    "bake before": "Simulating (before)",
    "bake after": "Simulating (after)",
    "compare": "Comparing",
    "composing": "Fitting the objects",
    "diagnose": "Trying causes",
    "encode": "Writing the video",
    "evaluate": "Measuring",
    "export": "Exporting",
    "fit": "Fitting",
    "models": "Downloading",
    "propose": "Finding objects",
    "questionnaire": "Preparing clips",
    "reconstruct": "Reconstructing",
    "render": "Rendering",
    "track": "Tracking",
}
"""What is being done in each stage, in the words of people; events keep the names."""

STEPS: Mapping[str, str] = {
    "photo": "reading the photo",
    "propose objects": "looking for objects",
    "segment": "cutting out",
    "physics": "choosing materials",
    "camera": "estimating the camera",
    "shadows": "finding shadows",
    "order": "finding what is in front",
    "complete": "completing",
    "mesh": "shaping",
    "gloss": "finding mirror images",
    "background": "filling the background",
    "light": "estimating the light",
    "look of": "estimating the surface of",
    "write": "writing the scene",
    "report": "writing the report",
}
"""What is being done in each step of a reconstruction; the name of an object may follow."""


def stage_words(stage: str) -> str:
    """Return what is being done in ``stage`` as words to show, such as ``Finding objects``; an unknown one as it is."""
    return STAGES.get(stage, stage)


def step_words(step: str) -> str:
    """Return what is being done in ``step`` as words to show, such as ``cutting out cup`` for ``segment cup``."""
    if step in STEPS:
        return STEPS[step]
    verb = next((verb for verb in STEPS if step.startswith(f"{verb} ")), "")
    return f"{STEPS[verb]}{step.removeprefix(verb)}" if verb else step


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
