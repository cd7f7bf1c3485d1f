# SPDX-License-Identifier: GPL-3.0-or-later
"""``--farm dask``, ``slurm``, ``tcp://…``, ``tls://…``: a plan carried out by Dask.distributed (docs/farm-clusters.md).

Dask is told one task at a time, when all that it needs is done: what is retried, skipped and stopped is decided here,
as it is for ``--farm local``.
"""

from __future__ import annotations

import dataclasses
import secrets
import time
from queue import Empty, Queue
from typing import Any

from ...sim.errors import Cancelled, InputError
from ...sim.events import Event, IsCancelled, OnEvent
from .dask_cluster import LOOK_S, connected, worker_addresses
from .dask_crew import Crew, check_slots, slots_of_a_worker, token_file
from .dask_tasks import carry_out, stop
from .execute import STOP_GRACE_S
from .local import cores
from .retry import is_worth_retrying
from .runners import FarmOptions, ended_event, started_event
from .task import STAGES, Outcome, Plan

LONELY_S = 30.0
"""After so long without any worker, that is said."""


def run(plan: Plan, options: FarmOptions, on_event: OnEvent, cancelled: IsCancelled) -> list[Outcome]:
    """Carry out ``plan``; an outcome for each of its tasks, in their order.

    Raises InputError, before anything is started, when there is no Dask, no scheduler or no worker; when a worker has
    another version of the program, does not see the plan's folder, or none has what a task takes up; and later, when
    the scheduler goes away.
    """
    scratch = plan.root / (plan.tasks[0].farm_folder if plan.tasks else ".farm") / "dask"
    if options.farm == "dask":
        workers = options.workers or max(1, cores() // 2)
        threads = options.threads or max(1, cores() // workers)
        options = dataclasses.replace(options, workers=workers, threads=threads)
    a_worker = slots_of_a_worker(plan)
    in_all = {name: options.slots.get(name, 1) for name in a_worker}
    with connected(options, a_worker, in_all, scratch, cancelled) as client, token_file(scratch) as token:
        run_name = f"physgen-{secrets.token_hex(8)}"
        crew = Crew(client, plan, token)
        crew.refuse_strangers()
        check_slots(plan, client)
        heard: Queue[tuple[str, Any]] = Queue()
        client.subscribe_topic(run_name, lambda event: heard.put(("said", event[1])))
        return _Run(plan, options, on_event, cancelled, client, crew, heard, run_name).outcomes()


class _Run:
    """One plan on its way: which tasks wait, run and have ended."""

    def __init__(
        self,
        plan: Plan,
        options: FarmOptions,
        on_event: OnEvent,
        cancelled: IsCancelled,
        client: Any,
        crew: Crew,
        heard: Queue[tuple[str, Any]],
        name: str,
    ) -> None:
        self._options = options
        self._plan = plan
        self._on_event = on_event
        self._cancelled = cancelled
        self._client = client
        self._crew = crew
        self._heard = heard
        self._name = name
        self._tasks = {task.id: task for task in plan.tasks}
        self._missing = {task.id: set(task.needs) for task in plan.tasks}
        self._dependants: dict[str, list[str]] = {task.id: [] for task in plan.tasks}
        for task in plan.tasks:
            for need in task.needs:
                self._dependants[need].append(task.id)
        self._starts = dict.fromkeys(self._tasks, 0)
        self._submissions = dict.fromkeys(self._tasks, 0)
        self._refused_then = dict.fromkeys(self._tasks, 0)
        self._running: dict[str, Any] = {}
        self._ended: dict[str, Outcome] = {}
        self._stopping = False
        self._closed = ""

    def outcomes(self) -> list[Outcome]:
        """Carry it out."""
        for name, missing in self._missing.items():
            if not missing:
                self._submit(name)
        stopped_at: float | None = None
        lonely_since: float | None = None
        looked_at = time.monotonic()
        while self._running:
            if stopped_at is None and self._cancelled():
                stopped_at = time.monotonic()
                self._stop(begun_too=True)
            if stopped_at is not None and time.monotonic() - stopped_at > STOP_GRACE_S + LOOK_S:
                self._give_up("cancelled; it did not stop in time")
            try:
                kind, value = self._heard.get(timeout=LOOK_S)
            except Empty:
                kind, value = "", None
            if kind == "said":
                self._hear(value)
            elif kind == "ended":
                self._take(*value)
            if time.monotonic() - looked_at > LOOK_S:
                looked_at = time.monotonic()
                lonely_since = self._look_after_workers(lonely_since)
        return [self._ended[task.id] for task in self._plan.tasks]

    def _submit(self, name: str) -> None:
        task = self._tasks[name]
        self._submissions[name] += 1
        self._refused_then[name] = len(self._crew.refused)
        future = self._client.submit(
            carry_out,
            task,
            str(self._plan.root),
            self._plan.version,
            self._name,
            self._options.threads,
            key=f"{self._name}/{name}#{self._submissions[name]}",
            resources=dict(task.slots) or None,
            workers=self._crew.fit(),
            # What is nearer to a video first.
            priority=STAGES.index(task.stage),
            pure=False,
        )
        self._running[name] = future
        future.add_done_callback(lambda done: self._heard.put(("ended", (name, done))))

    def _hear(self, event: Event) -> None:
        name = str(event.get("task"))
        if event.get("event") == "started" and name in self._starts:
            self._starts[name] += 1
            self._on_event(started_event(self._tasks[name], str(event.get("place")), self._starts[name]))
        else:
            self._on_event(event)

    def _take(self, name: str, future: Any) -> None:
        """What came of a task that Dask has done with."""
        if future.status == "finished":
            outcome: Outcome = future.result()
            if outcome.state == "failed" and outcome.attempts == 0 and self._met_stranger(name):
                self._starts[name] = max(0, self._starts[name] - 1)
                self._submit(name)
                return
            # Of the attempts before, what it said has come, unless their machine has died.
            attempts = max(0, self._starts[name] - 1) + outcome.attempts
            if outcome.state == "cancelled" and self._starts[name] == 0:
                outcome = self._not_begun(name)
        elif future.status == "cancelled":
            # Ours are cancelled by the loss of the scheduler alone.
            self._lost_scheduler()
        else:
            outcome = self._failure(name, future)
            attempts = self._starts[name]
        outcome = dataclasses.replace(outcome, attempts=attempts)
        if not self._stopping and is_worth_retrying(outcome, attempts=attempts, retries=self._options.retries):
            task = self._tasks[name]
            message = f"attempt {attempts} failed, trying again: {outcome.message}"
            self._on_event({"event": "notice", "task": name, "stage": task.stage, "message": message})
            self._submit(name)
            return
        del self._running[name]
        self._end(outcome)

    def _failure(self, name: str, future: Any) -> Outcome:
        """The outcome of a task whose worker has died, or that could not even be started."""
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            if self._starts[name] == 0:
                # It waited at a worker that another task has brought down.
                return Outcome(task=name, state="failed", exit_code=1, message="its worker died before it began")
            return Outcome(
                task=name, state="failed", exit_code=1, message=f"its worker died {self._starts[name]} times"
            )
        if self._met_stranger(name):
            return Outcome(task=name, state="failed", exit_code=1, message="its worker was not fit")
        return Outcome(
            task=name,
            state="failed",
            exit_code=InputError.exit_code,
            message=f"the worker cannot run it ({type(error).__name__}: {error})",
        )

    def _met_stranger(self, name: str) -> bool:
        """Whether workers that are not fit have come since the task was given out; they are left alone from now on."""
        for message in self._crew.ask_new():
            self._on_event({"event": "notice", "message": message})
        return len(self._crew.refused) > self._refused_then[name]

    def _end(self, outcome: Outcome) -> None:
        """A task has ended for good: tell it, and do what follows from it."""
        ended = [outcome]
        while ended:
            outcome = ended.pop()
            self._ended[outcome.task] = outcome
            self._on_event(ended_event(outcome))
            if outcome.state == "failed" and self._options.fail_fast and not self._stopping:
                self._closed = f"not begun, because {outcome.task} failed"
                self._stop(begun_too=False)
            for name in self._dependants[outcome.task]:
                self._missing[name].discard(outcome.task)
                if name in self._ended:
                    continue
                if outcome.state in ("failed", "skipped") and not self._closed:
                    message = f"needs {outcome.task}, which {'failed' if outcome.state == 'failed' else 'was skipped'}"
                    self._ended[name] = Outcome(task=name, state="skipped", message=message)
                elif outcome.state not in ("done", "kept") or self._stopping:
                    self._ended[name] = self._not_begun(name)
                elif not self._missing[name]:
                    self._submit(name)
                if name in self._ended:
                    ended.append(self._ended[name])

    def _not_begun(self, name: str) -> Outcome:
        state = "skipped" if self._closed and not self._cancelled() else "cancelled"
        return Outcome(task=name, state=state, message=self._closed or "not begun")

    def _stop(self, *, begun_too: bool) -> None:
        """Let nothing begin any more: what waits at a worker ends at once. begun_too: also ask what runs to stop."""
        self._stopping = True
        self._client.run(stop, self._name, begun_too, on_error="ignore")

    def _give_up(self, message: str) -> None:
        for name, future in list(self._running.items()):
            del self._running[name]
            future.cancel()
            self._end(Outcome(task=name, state="cancelled", exit_code=Cancelled.exit_code, message=message))

    def _look_after_workers(self, lonely_since: float | None) -> float | None:
        """Notice the loss of the scheduler or of all workers; since when there are none."""
        if self._client.status != "running":
            self._lost_scheduler()
        fit = self._crew.fit()
        if worker_addresses(self._client) if fit is None else fit:
            return None
        if lonely_since is not None and time.monotonic() - lonely_since > LONELY_S:
            self._on_event({"event": "notice", "message": "no worker is left; waiting for one to come"})
            return time.monotonic() + 1e9
        return lonely_since or time.monotonic()

    def _lost_scheduler(self) -> None:
        raise InputError(
            f"{self._options.farm}: the scheduler has gone away; start it and run this again, what is done is kept"
        )
