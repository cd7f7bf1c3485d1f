# SPDX-License-Identifier: GPL-3.0-or-later
"""``--farm local``: the tasks of a plan on this machine, several at a time, each in processes of its own."""

from __future__ import annotations

import dataclasses
import heapq
import os
import threading
from collections import Counter, defaultdict

from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, OnEvent
from .execute import execute
from .retry import is_worth_retrying
from .runners import FarmOptions, ended_event, started_event
from .task import Outcome, Plan, Task

LOOK_S = 0.2
"""How often an idle worker looks whether it is to stop."""


def cores() -> int:
    """CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def run(plan: Plan, options: FarmOptions, on_event: OnEvent, cancelled: IsCancelled) -> list[Outcome]:
    """Carry out ``plan`` on this machine; an outcome for each task, in the order of the plan.

    What fails is tried again as ``retry`` says; what depends on a failure is skipped, everything else goes on.
    Cancelled, it stops what runs in good order, and what was not begun is ``cancelled``.
    Raises InputError when a task wants more of a slot than there is.
    """
    workers = options.workers or max(1, cores() // 2)
    if options.threads == 0:
        options = dataclasses.replace(options, threads=max(1, cores() // workers))
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
        # Signals reach the main thread between two looks only.
        while thread.is_alive():
            thread.join(timeout=LOOK_S)
    return board.outcomes()


def _work(board: _Board, worker: str, on_event: OnEvent, cancelled: IsCancelled) -> None:
    """Take task after task until there is none left."""
    try:
        while (task := board.take(cancelled)) is not None:
            outcome = _attempts(task, board, worker, on_event, lambda: cancelled() or board.broken is not None)
            on_event(ended_event(outcome))
            for skipped in board.settle(task, outcome):
                on_event(ended_event(skipped))
    except BaseException as error:  # a fault of the program: the others stop, and the caller gets it
        board.break_off(error)


def _attempts(task: Task, board: _Board, worker: str, on_event: OnEvent, cancelled: IsCancelled) -> Outcome:
    attempts = 0
    while True:
        on_event(started_event(task, worker, attempts + 1))
        outcome = execute(
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
    """Which tasks are ready, running and done; all methods may be called from any thread."""

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
                        f"{task.id}: wants {wanted} of the slot {name!r}, there are {self._free[name]}; "
                        f"give --slots {name}={wanted} where the machine has so many"
                    )
            for need in set(task.needs):
                self._followers[need].append(task)
            if not task.needs:
                self._make_ready(task)

    def take(self, cancelled: IsCancelled) -> Task | None:
        """The first task of the plan that can begin, once there is one; None when no more will."""
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
        """Take notice of how ``task`` ended; the outcomes of those that are skipped for it."""
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
        """Let everything stop because of ``error``."""
        with self._changed:
            self.broken = self.broken or error
            self._changed.notify_all()

    def outcomes(self) -> list[Outcome]:
        """How all tasks ended, in the order of the plan. Raises what broke a worker."""
        if self.broken is not None:
            raise self.broken
        state = "skipped" if self._closed else "cancelled"
        rest = self._closed or "not begun"
        return [self._outcomes.get(t.id, Outcome(task=t.id, state=state, message=rest)) for t in self.plan.tasks]

    def _fitting(self) -> list[tuple[tuple[str, int], ...]]:
        """Slots for which there are tasks that are ready and room for one."""
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
