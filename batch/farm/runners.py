# SPDX-License-Identifier: GPL-3.0-or-later
"""What can carry out a plan, and what else a plan can be written as: one line each.

A runner tells what happens by events: ``{"event": "task", "state": "started", "task", "stage", "worker", "attempt"}``
when a task begins, ``{"event": "task", **fields of its Outcome}`` when it has ended for good, ``notice`` for a retry,
and what the commands themselves say, with ``task``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import cast

from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from .cluster_options import ClusterOptions
from .retry import RETRIES
from .task import Outcome, Plan, Task

MOST_WORKERS = 1024
MOST_RETRIES = 100


@dataclass(frozen=True, kw_only=True)
class FarmOptions:
    """How a plan is carried out.

    farm: ``local``, ``dask`` (on this machine), ``slurm`` (Dask workers as SLURM's jobs), or the address of a Dask
        scheduler, ``tcp://…`` or ``tls://…``.
    workers: tasks at a time, 1 to 1024; 0 leaves it to the runner: half the cores, or what the cluster has.
    threads: CPU threads of each render, 0 (all) to 1024; it changes nothing in the results.
    retries: how often a task is started again after a failure that may pass, 0 to 100.
    fail_fast: whether nothing new is started after the first failure; else all that does not depend on it goes on.
    slots: how much there is at a time of what tasks take up by name, such as ``{"gpu": 1}``; of others there is one.
    out: folder or file that an exporter writes.
    cluster: what there is to say about other machines.
    """

    farm: str = "local"
    workers: int = 0
    threads: int = 0
    retries: int = RETRIES
    fail_fast: bool = False
    slots: Mapping[str, int] = field(default_factory=dict)
    out: Path | None = None
    cluster: ClusterOptions = field(default_factory=ClusterOptions)

    def __post_init__(self) -> None:
        for name, most in (("workers", MOST_WORKERS), ("threads", 1024), ("retries", MOST_RETRIES)):
            if not 0 <= getattr(self, name) <= most:
                raise InputError(f"--{name} is {getattr(self, name)}: give 0 to {most}")


Runner = Callable[[Plan, FarmOptions, OnEvent, IsCancelled], list[Outcome]]
"""Carries out a plan; an outcome for each of its tasks, in their order. Raises InputError when it cannot start."""

Exporter = Callable[[Plan, FarmOptions], list[Path]]
"""Writes a plan for another program, to the options' ``out``; the files that it wrote."""

RUNNERS = {
    "local": "local:run",
    "dask": "dask_farm:run",
    "tcp": "dask_farm:run",
    "tls": "dask_farm:run",
    "slurm": "dask_farm:run",
}
"""Name, or scheme of an address → module of this package and its function."""

EXPORTERS = {"flamenco": "flamenco:export", "slurm": "slurm:export"}


def find_runner(farm: str) -> Runner:
    """The runner for ``--farm``. Raises InputError for one that nobody knows."""
    name, colon, rest = farm.partition("://")
    if name not in RUNNERS or bool(colon) != (name in ("tcp", "tls")) or (colon and not rest):
        raise InputError(
            f"--farm is {farm!r}: choose local, dask, slurm, or the address of a scheduler, tcp://HOST:PORT"
        )
    return cast(Runner, _load(RUNNERS[name]))


def find_exporter(name: str) -> Exporter:
    """The exporter for ``--export``. Raises InputError for one that nobody knows."""
    if name not in EXPORTERS:
        raise InputError(f"--export is {name!r}: choose one of {', '.join(EXPORTERS)}")
    return cast(Exporter, _load(EXPORTERS[name]))


def _load(place: str) -> object:
    module, _, function = place.partition(":")
    return getattr(importlib.import_module(f"{__package__}.{module}"), function)


def started_event(task: Task, worker: str, attempt: int) -> Event:
    """That ``task`` begins."""
    return {
        "event": "task",
        "state": "started",
        "task": task.id,
        "stage": task.stage,
        "worker": worker,
        "attempt": attempt,
    }


def ended_event(outcome: Outcome) -> Event:
    """That a task has ended for good."""
    return {"event": "task", **asdict(outcome)}
