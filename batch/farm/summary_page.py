# SPDX-License-Identifier: GPL-3.0-or-later
"""The state of a job: ``summary.json`` as plain data, ``summary.html`` as one page without scripts or remote files."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ...sim.html import render
from .planning.plan import STAGES, Outcome, Plan, Task

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


REFRESH_S = 10
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
        refresh_s=REFRESH_S,
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
