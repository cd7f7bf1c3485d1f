# SPDX-License-Identifier: GPL-3.0-or-later
"""Follow a job by its events: progress for the terminal, summary and film strips on disk while it runs."""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from PIL import Image

from ...physgen_addon.frames.frame_files import read_picture
from ...sim.atomic import replacing, write_bytes, write_json
from ...sim.errors import InputError
from ...sim.events import Event, OnEvent, StageProgress
from .planning.plan import Outcome, Plan, Task
from .summary_page import SUCCEEDED, Summary, frames_of, strip_name, summarize, summary_page, variant_of
from .task_execution import log_end, log_path

MOST_FRAMES = 6
HEIGHT = 132
GAP = 3


def make_strip(frames: Sequence[Path], out: Path) -> bool:
    """Write some of ``frames``, evenly spaced, into the JPEG ``out``, unless it is up to date.

    Missing or unreadable frames are skipped; returns False if there are none.
    """
    there = [path for path in frames if path.is_file()]
    count = min(MOST_FRAMES, len(there))
    chosen = [there[round(i * (len(there) - 1) / max(1, count - 1))] for i in range(count)]
    if not chosen:
        return False
    stamp = _fingerprint(chosen)
    if _stored_fingerprint(out) == stamp:
        return True
    pictures = [picture for path in chosen if (picture := _thumbnail(path)) is not None]
    if not pictures:
        return False
    width = sum(p.width for p in pictures) + GAP * (len(pictures) - 1)
    strip = Image.new("RGB", (width, HEIGHT), (128, 128, 128))
    x = 0
    for picture in pictures:
        strip.paste(picture, (x, 0))
        x += picture.width + GAP
    try:
        with replacing(out) as partial:
            strip.save(partial, "JPEG", quality=84, comment=stamp)
    except (InputError, ValueError):
        return False
    return True


def _thumbnail(path: Path) -> Image.Image | None:
    try:
        image = Image.fromarray(read_picture(path))
    except InputError:
        return None
    width = max(1, round(image.width * HEIGHT / image.height))
    return image.resize((min(width, 4 * HEIGHT), HEIGHT), Image.Resampling.LANCZOS)


def _fingerprint(paths: Sequence[Path]) -> bytes:
    states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return hashlib.sha256(repr(states).encode()).hexdigest()[:16].encode()


def _stored_fingerprint(path: Path) -> bytes | None:
    try:
        with Image.open(path) as image:
            comment = image.info.get("comment")
            return comment if isinstance(comment, bytes) else None
    except (OSError, ValueError, SyntaxError):
        return None


SUMMARY_PAGE = "summary.html"
SUMMARY_FILE = "summary.json"
REFRESH_S = 5.0
REFRESH_SHARE = 0.02
"""Largest fraction of the time spent refreshing the summary."""


class Monitor:
    """Receives a runner's events; relays the job's progress, but not that of single commands."""

    def __init__(self, plan: Plan, on_event: OnEvent) -> None:
        self._plan = plan
        self._on_event = on_event
        self._progress = StageProgress(on_event, "batch", len(plan.tasks))
        self._tasks = {task.id: task for task in plan.tasks}
        self._of_variant: dict[str, list[Task]] = {}
        for task in plan.tasks:
            name = variant_of(task)
            if name is not None:
                self._of_variant.setdefault(name, []).append(task)
        self._unfinished = {name: len(tasks) for name, tasks in self._of_variant.items()}
        self._pictures: set[str] = set()
        self._outcomes: dict[str, Outcome] = {}
        self._ended = 0
        self._started = time.monotonic()
        self._began = datetime.now(UTC).isoformat(timespec="seconds")
        self._next = 0.0

    def __call__(self, event: Event) -> None:
        """Handle ``event``."""
        if event["event"] == "task":
            self._take(event)
            said = {key: value for key, value in event.items() if key != "message"}
            if event["state"] == "failed":
                said["message"] = f"{event['task']} failed: {event['message']}"
            self._on_event(said)
            if event["state"] != "started":
                self._ended += 1
                self._progress.report(self._ended, str(event["task"]))
        elif event["event"] == "notice":
            task = event.get("task")
            self._on_event({**event, "stage": task or event.get("stage", "batch")})
        if time.monotonic() >= self._next:
            begun = time.monotonic()
            self._write(self._summary("running"))
            now = time.monotonic()
            self._next = now + max(REFRESH_S, (now - begun) / REFRESH_SHARE)

    def finish(self, outcomes: Sequence[Outcome], *, cancelled: bool) -> Summary:
        """Write the last summary. Raises InputError when it cannot be written."""
        self._outcomes = {outcome.task: outcome for outcome in outcomes}
        good = all(outcome.state in SUCCEEDED for outcome in outcomes)
        for name in self._of_variant:
            self._picture(name)
        summary = self._summary("done" if good else "cancelled" if cancelled else "failed")
        self._write(summary, last=True)
        return summary

    def _take(self, event: Event) -> None:
        task = self._tasks[str(event["task"])]
        if event["state"] == "started":
            self._outcomes[task.id] = Outcome(
                task=task.id, state="running", worker=str(event["worker"]), attempts=int(event["attempt"])
            )
            return
        self._outcomes[task.id] = Outcome(**{f.name: event[f.name] for f in dataclasses.fields(Outcome)})
        name = variant_of(task)
        if name is not None:
            self._unfinished[name] -= 1
            if self._unfinished[name] == 0:
                self._picture(name)

    def _picture(self, variant: str) -> None:
        if variant not in self._pictures:
            self._pictures.add(variant)
            root = self._plan.root
            make_strip(frames_of(self._of_variant[variant], root), root / self._plan.out / strip_name(variant))

    def _summary(self, state: str) -> Summary:
        seconds = time.monotonic() - self._started
        return summarize(self._plan, self._outcomes, started=self._began, seconds=seconds, state=state)

    def _write(self, summary: Summary, *, last: bool = False) -> None:
        out = self._plan.root / self._plan.out
        page = summary_page(summary, self._log_end, self._log_name)
        try:
            write_json(out / SUMMARY_FILE, summary.to_json())
            write_bytes(out / SUMMARY_PAGE, page.encode("utf-8", "replace"))
        except InputError as error:
            if last:
                raise
            # A failed refresh of the summary must not stop the job.
            self._on_event({"event": "notice", "stage": "summary", "message": str(error)})

    def _log_end(self, task: Task) -> str:
        return log_end(log_path(task, self._plan.root))

    def _log_name(self, task: Task) -> str:
        return log_path(task, self._plan.root).relative_to(self._plan.root / self._plan.out).as_posix()
