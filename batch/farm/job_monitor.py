# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of a job while it runs: progress for the terminal, ``summary.json`` as plain data, ``summary.html`` as one
page without scripts or remote files, and film strips of the frames.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from PIL import Image

from ...physgen_addon.frames.frame_files import read_picture
from ...sim.atomic import replacing, write_bytes, write_json
from ...sim.errors import InputError
from ...sim.events import Event, OnEvent, StageProgress
from ...sim.files import MAX_PICTURE_BYTES, PICTURE_FORMATS, open_file
from ...sim.html import render
from .planning.plan import STAGES, Outcome, Plan, Task
from .task_records import log_end, log_path

SUMMARY_FORMAT = "physgen-summary/1"
STATES = ("done", "kept", "running", "waiting", "failed", "skipped", "cancelled")
SUCCEEDED = ("done", "kept")


@dataclass(frozen=True, kw_only=True)
class VariantSummary:
    """A variant. id: ``scene/variant``. strip, results: existing files, relative to the folder of results."""

    id: str
    meaning: str
    state: str
    tasks: int
    finished: int
    cpu_seconds: float
    strip: str | None
    results: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class StageSummary:
    """All tasks of a stage. cpu_seconds: of this run. slowest: seconds of the longest task."""

    stage: str
    tasks: int
    finished: int
    cpu_seconds: float
    seconds: float
    slowest: float


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The state of a job.

    state: ``running``, ``done``, ``failed`` or ``cancelled``. started: UTC, ISO 8601. seconds: since then.
    """

    job: str
    version: str
    state: str
    started: str
    seconds: float
    counts: Mapping[str, int]
    stages: tuple[StageSummary, ...]
    variants: tuple[VariantSummary, ...]
    tasks: tuple[tuple[Task, Outcome], ...]

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``summary.json``."""
        return {
            "format": SUMMARY_FORMAT,
            "job": self.job,
            "version": self.version,
            "state": self.state,
            "started": self.started,
            "seconds": round(self.seconds, 3),
            "counts": dict(self.counts),
            "stages": [dataclasses.asdict(stage) for stage in self.stages],
            "variants": [dataclasses.asdict(variant) for variant in self.variants],
            "tasks": [{**dataclasses.asdict(outcome), "stage": task.stage} for task, outcome in self.tasks],
        }


def strip_name(variant: str) -> str:
    """Return the path of the film strip of ``scene/variant``, relative to the folder of results."""
    return f"summary/{variant}.jpg"


def variant_of(task: Task) -> str | None:
    """Return ``scene/variant`` of a task; None for tasks of the whole scene."""
    head = task.id.rpartition("/")[0]
    return head if "/" in head else None


def frames_of(tasks: Sequence[Task], root: Path) -> list[Path]:
    """Return all frames rendered by the ``tasks`` of a variant, in order."""
    return [root / name for task in tasks if task.stage == "render" for name in task.produces]


def summarize(
    plan: Plan, outcomes: Mapping[str, Outcome], *, started: str, seconds: float, state: str = "running"
) -> Summary:
    """Return the summary of ``plan``; tasks without an outcome are waiting."""
    known = tuple((task, outcomes.get(task.id, Outcome(task=task.id, state="waiting"))) for task in plan.tasks)
    counts = Counter(outcome.state for _, outcome in known)
    of_variant: dict[str, list[tuple[Task, Outcome]]] = {}
    for task, outcome in known:
        name = variant_of(task)
        if name is not None:
            of_variant.setdefault(name, []).append((task, outcome))
    return Summary(
        job=plan.name,
        version=plan.version,
        state=state,
        started=started,
        seconds=seconds,
        counts={name: counts[name] for name in STATES},
        stages=tuple(_summarize_stage(name, [o for t, o in known if t.stage == name]) for name in STAGES),
        variants=tuple(_summarize_variant(plan, name, items) for name, items in of_variant.items()),
        tasks=known,
    )


def _summarize_stage(name: str, outcomes: Sequence[Outcome]) -> StageSummary:
    run = [outcome for outcome in outcomes if outcome.attempts > 0]
    return StageSummary(
        stage=name,
        tasks=len(outcomes),
        finished=sum(outcome.state in SUCCEEDED for outcome in outcomes),
        cpu_seconds=round(sum(outcome.cpu_seconds for outcome in run), 3),
        seconds=round(sum(outcome.seconds for outcome in run), 3),
        slowest=round(max((outcome.seconds for outcome in run), default=0.0), 3),
    )


def _summarize_variant(plan: Plan, name: str, items: Sequence[tuple[Task, Outcome]]) -> VariantSummary:
    out = plan.root / plan.out
    states = [outcome.state for _, outcome in items]
    worst = next((s for s in ("failed", "skipped", "cancelled", "running", "waiting") if s in states), "done")
    results = [
        (plan.root / file).relative_to(out).as_posix()
        for task, outcome in items
        if task.stage == "encode" and outcome.state in SUCCEEDED
        for file in task.produces
    ]
    strip = strip_name(name)
    return VariantSummary(
        id=name,
        meaning=plan.meanings.get(name, ""),
        state="running" if worst == "waiting" and "done" in states else worst,
        tasks=len(items),
        finished=sum(state in SUCCEEDED for state in states),
        cpu_seconds=round(sum(outcome.cpu_seconds for _, outcome in items), 3),
        strip=strip if (out / strip).is_file() else None,
        results=tuple(results),
    )


PAGE_REFRESH_S = 10
MOST_ROWS = 3000
"""A longer table only lists unfinished and failed tasks; summary.json has all."""

MOST_FAILURES = 50

LogEnd = Callable[[Task], str]
"""Returns the end of a task's log."""

_TEMPLATE = Path(__file__).with_name("summary_page.html")
_STATE_WORDS = {"running": "running", "done": "all done", "failed": "ended with failures", "cancelled": "stopped"}


def summary_page(summary: Summary, log_end: LogEnd, log_name: Callable[[Task], str]) -> str:
    """Return the page as text. log_end: excerpt of a task's log; log_name: its file, relative to the page."""
    tasks = summary.tasks
    failures = [(task, outcome) for task, outcome in tasks if outcome.state == "failed"]
    unfinished = [(task, outcome) for task, outcome in tasks if outcome.state not in SUCCEEDED]
    cpu_seconds = sum(stage.cpu_seconds for stage in summary.stages)
    facts = [
        _STATE_WORDS[summary.state],
        f"{len(tasks)} task{'' if len(tasks) == 1 else 's'}",
        f"{format_duration(summary.seconds)}, {format_duration(cpu_seconds)} of CPU time",
        f"started {summary.started[:16].replace('T', ' ')} UTC",
        f"PhysGen {summary.version}",
    ]
    return render(
        _TEMPLATE,
        summary=summary,
        facts=facts,
        states=STATES,
        succeeded=SUCCEEDED,
        failures=failures,
        most_failures=MOST_FAILURES,
        shown=tasks if len(tasks) <= MOST_ROWS else unfinished[:MOST_ROWS],
        refresh_s=PAGE_REFRESH_S,
        log_end=log_end,
        log_name=log_name,
        duration=format_duration,
        quote=quote,
    )


def format_duration(seconds: float) -> str:
    """Return a duration in seconds as ``0.4 s``, ``12 s``, ``3:20 min`` or ``5:02 h``."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


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
        with (
            open_file(path, MAX_PICTURE_BYTES, what="picture") as file,
            Image.open(file, formats=PICTURE_FORMATS) as image,
        ):
            comment = image.info.get("comment")
            return comment if isinstance(comment, bytes) else None
    except (OSError, ValueError, SyntaxError, InputError):
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
            payload = {key: value for key, value in event.items() if key != "message"}
            if event["state"] == "failed":
                payload["message"] = f"{event['task']} failed: {event['message']}"
            self._on_event(payload)
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
