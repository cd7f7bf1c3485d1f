# SPDX-License-Identifier: GPL-3.0-or-later
"""``--farm local``: run a plan on this machine, several tasks at a time, each in its own processes."""

from __future__ import annotations

import dataclasses
import heapq
import os
import threading
from collections import Counter, defaultdict

from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from .planning.plan import Outcome, Plan, Task, is_worth_retrying
from .runners import FarmOptions, ended_event, started_event
from .task_execution import execute_task

LOOK_S = 0.2
"""Interval in which an idle worker checks whether to stop."""


def cpu_count() -> int:
    """Return the number of CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run_local(plan: Plan, options: FarmOptions, on_event: OnEvent, cancelled: IsCancelled) -> list[Outcome]:
    """Run ``plan`` on this machine; return an outcome for each task, in the plan's order.

    Failed tasks are retried by the rule of ``is_worth_retrying``; dependants of a failure are skipped, everything else
    continues. When cancelled, running tasks are stopped cleanly, and the rest is ``cancelled``.
    Raises InputError when a task needs more of a slot than there is.
    """
    workers = options.workers or max(1, cpu_count() // 2)
    if options.threads == 0:
        options = dataclasses.replace(options, threads=max(1, cpu_count() // workers))
    board = _Board(plan, options)
    telling = threading.Lock()

    def tell(event: Event) -> None:
        with telling:
            on_event(event)

    threads = [
        threading.Thread(target=_work, args=(board, f"local-{number}", tell, cancelled), daemon=True)
        for number in range(1, min(workers, len(plan.tasks)) + 1)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        # Signals reach the main thread only between joins.
        while thread.is_alive():
            thread.join(timeout=LOOK_S)
    return board.outcomes()


def _work(board: _Board, worker: str, on_event: OnEvent, cancelled: IsCancelled) -> None:
    """Run one task after another until none is left."""
    try:
        while (task := board.take(cancelled)) is not None:
            outcome = _attempts(task, board, worker, on_event, lambda: cancelled() or board.broken is not None)
            on_event(ended_event(outcome))
            for skipped in board.settle(task, outcome):
                on_event(ended_event(skipped))
    except BaseException as error:  # a bug: the others stop, and the caller gets it
        board.break_off(error)


def _attempts(task: Task, board: _Board, worker: str, on_event: OnEvent, cancelled: IsCancelled) -> Outcome:
    attempts = 0
    while True:
        on_event(started_event(task, worker, attempts + 1))
        outcome = execute_task(
            task,
            board.plan.root,
            version=board.plan.version,
            worker=worker,
            cancelled=cancelled,
            on_event=on_event,
            threads=board.options.threads,
        )
        attempts += outcome.attempts
        outcome = dataclasses.replace(outcome, attempts=attempts)
        if cancelled() or not is_worth_retrying(outcome, attempts=attempts, retries=board.options.retries):
            return outcome
        message = f"attempt {attempts} failed, trying again: {outcome.message}"
        on_event({"event": "notice", "stage": task.stage, "task": task.id, "message": message})


class _Board:
    """Thread-safe state of the plan: which tasks are ready, running and done."""

    def __init__(self, plan: Plan, options: FarmOptions) -> None:
        self.plan, self.options = plan, options
        self.broken: BaseException | None = None
        self._changed = threading.Condition(threading.RLock())
        self._index = {task.id: number for number, task in enumerate(plan.tasks)}
        self._missing = {task.id: len(set(task.needs)) for task in plan.tasks}
        self._followers: dict[str, list[Task]] = defaultdict(list)
        self._ready: dict[tuple[tuple[str, int], ...], list[int]] = defaultdict(list)
        self._free: Counter[str] = Counter()
        self._outcomes: dict[str, Outcome] = {}
        self._running = 0
        self._closed = ""
        for task in plan.tasks:
            for name, wanted in task.slots.items():
                self._free[name] = options.slots.get(name, 1)
                if wanted > self._free[name]:
                    raise InputError(
                        f"{task.id}: needs {wanted} of the slot {name!r}, there are {self._free[name]}; "
                        f"give --slots {name}={wanted} if the machine has so many"
                    )
            for need in set(task.needs):
                self._followers[need].append(task)
            if not task.needs:
                self._make_ready(task)

    def take(self, cancelled: IsCancelled) -> Task | None:
        """Return the first task that can start, waiting for one; None when no more will."""
        with self._changed:
            while not (self.broken or self._closed or cancelled()):
                if fitting := self._fitting():
                    slots = min(fitting, key=lambda k: self._ready[k][0])
                    task = self.plan.tasks[heapq.heappop(self._ready[slots])]
                    self._free.subtract(dict(slots))
                    self._running += 1
                    return task
                if self._running == 0:
                    break
                self._changed.wait(timeout=LOOK_S)
            self._changed.notify_all()
            return None

    def settle(self, task: Task, outcome: Outcome) -> list[Outcome]:
        """Record how ``task`` ended; return the outcomes of tasks skipped because of it."""
        with self._changed:
            self._outcomes[task.id] = outcome
            self._running -= 1
            self._free.update(dict(task.slots))
            skipped: list[Outcome] = []
            if outcome.state in ("done", "kept"):
                for follower in self._followers[task.id]:
                    self._missing[follower.id] -= 1
                    if self._missing[follower.id] == 0 and follower.id not in self._outcomes:
                        self._make_ready(follower)
            elif outcome.state == "failed":
                skipped = self._skip_followers(task)
                if self.options.fail_fast:
                    self._closed = f"not begun, because {task.id} failed"
            self._changed.notify_all()
            return skipped

    def break_off(self, error: BaseException) -> None:
        """Stop everything because of ``error``."""
        with self._changed:
            self.broken = self.broken or error
            self._changed.notify_all()

    def outcomes(self) -> list[Outcome]:
        """Return all outcomes in the plan's order. Raises the error that broke a worker."""
        if self.broken is not None:
            raise self.broken
        state = "skipped" if self._closed else "cancelled"
        rest = self._closed or "not begun"
        return [self._outcomes.get(t.id, Outcome(task=t.id, state=state, message=rest)) for t in self.plan.tasks]

    def _fitting(self) -> list[tuple[tuple[str, int], ...]]:
        """Return the slot requirements that have a ready task and enough free slots."""
        return [k for k, queue in self._ready.items() if queue and all(self._free[n] >= c for n, c in k)]

    def _make_ready(self, task: Task) -> None:
        heapq.heappush(self._ready[tuple(sorted(task.slots.items()))], self._index[task.id])

    def _skip_followers(self, failed: Task) -> list[Outcome]:
        skipped: list[Outcome] = []
        waiting = list(self._followers[failed.id])
        while waiting:
            task = waiting.pop()
            if task.id not in self._outcomes:
                message = f"needs {failed.id}, which failed"
                self._outcomes[task.id] = Outcome(task=task.id, state="skipped", message=message)
                skipped.append(self._outcomes[task.id])
                waiting += self._followers[task.id]
        return skipped
