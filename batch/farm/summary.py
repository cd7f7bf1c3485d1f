# SPDX-License-Identifier: GPL-3.0-or-later
"""How a job stands, as plain data: ``summary.json``, and what ``summary.html`` shows (docs/farm.md)."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .task import STAGES, Outcome, Plan, Task

FORMAT = "physgen-summary/1"
STATES = ("done", "kept", "running", "waiting", "failed", "skipped", "cancelled")
GOOD = ("done", "kept")


@dataclass(frozen=True, kw_only=True)
class VariantSummary:
    """A variant. id: ``scene/variant``. strip, results: files relative to the folder of results, if they are there."""

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
    """All tasks of a stage. cpu_seconds: of what this run did. slowest: seconds of the longest of them."""

    stage: str
    tasks: int
    finished: int
    cpu_seconds: float
    seconds: float
    slowest: float


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A job as it stands.

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
        """The content of ``summary.json``."""
        return {
            "format": FORMAT,
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
    """Where the picture of ``scene/variant`` is, relative to the folder of results."""
    return f"summary/{variant}.jpg"


def variant_of(task: Task) -> str | None:
    """``scene/variant`` of a task; None for what belongs to the scene as a whole."""
    head = task.id.rpartition("/")[0]
    return head if "/" in head else None


def frames_of(tasks: Sequence[Task], root: Path) -> list[Path]:
    """All frames that the ``tasks`` of a variant render, in order."""
    return [root / name for task in tasks if task.stage == "render" for name in task.produces]


def summarize(
    plan: Plan, outcomes: Mapping[str, Outcome], *, started: str, seconds: float, state: str = "running"
) -> Summary:
    """The summary of ``plan`` with what is known of its tasks; what is not known of is waiting."""
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
        stages=tuple(_stage(name, [o for t, o in known if t.stage == name]) for name in STAGES),
        variants=tuple(_variant(plan, name, items) for name, items in of_variant.items()),
        tasks=known,
    )


def _stage(name: str, outcomes: Sequence[Outcome]) -> StageSummary:
    run = [outcome for outcome in outcomes if outcome.attempts > 0]
    return StageSummary(
        stage=name,
        tasks=len(outcomes),
        finished=sum(outcome.state in GOOD for outcome in outcomes),
        cpu_seconds=round(sum(outcome.cpu_seconds for outcome in run), 3),
        seconds=round(sum(outcome.seconds for outcome in run), 3),
        slowest=round(max((outcome.seconds for outcome in run), default=0.0), 3),
    )


def _variant(plan: Plan, name: str, items: Sequence[tuple[Task, Outcome]]) -> VariantSummary:
    out = plan.root / plan.out
    states = [outcome.state for _, outcome in items]
    worst = next((s for s in ("failed", "skipped", "cancelled", "running", "waiting") if s in states), "done")
    results = [
        (plan.root / file).relative_to(out).as_posix()
        for task, outcome in items
        if task.stage == "encode" and outcome.state in GOOD
        for file in task.produces
    ]
    strip = strip_name(name)
    return VariantSummary(
        id=name,
        meaning=plan.meanings.get(name, ""),
        state="running" if worst == "waiting" and "done" in states else worst,
        tasks=len(items),
        finished=sum(state in GOOD for state in states),
        cpu_seconds=round(sum(outcome.cpu_seconds for _, outcome in items), 3),
        strip=strip if (out / strip).is_file() else None,
        results=tuple(results),
    )
