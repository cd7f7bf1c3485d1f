# SPDX-License-Identifier: GPL-3.0-or-later
"""``--farm dask``, ``slurm``, ``tcp://…``, ``tls://…``: run a plan with Dask.distributed (docs/farm.md).

Dask gets one task at a time, once all that it needs is done: retries, skips and stops are decided here, as for
``--farm local``.
"""

from __future__ import annotations

import dataclasses
import pydoc
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, Queue
from typing import Any

from ...sim.atomic import write_bytes
from ...sim.errors import Cancelled, InputError
from ...sim.events import Event, IsCancelled, OnEvent
from .dask_cluster import LOOK_S, dask_client, worker_addresses
from .dask_tasks import read_token, run_on_worker, stop_run
from .local_runner import cpu_count
from .planning.plan import STAGES, Outcome, Plan, is_worth_retrying
from .runners import FarmOptions, ended_event, started_event
from .task_execution import STOP_GRACE_S

VERSION_NAME = "physgen.sim.version.VERSION"


def slots_per_worker(plan: Plan) -> dict[str, int]:
    """Return the slots by name that a worker needs to run any task."""
    slots: dict[str, int] = {}
    for task in plan.tasks:
        for name, count in task.slots.items():
            slots[name] = max(count, slots.get(name, 0))
    return slots


def _resources(dask_worker: Any) -> dict[str, float]:
    return dict(dask_worker.state.total_resources)


def check_slots(plan: Plan, client: Any) -> None:
    """Raise InputError when no worker has the slots of a task of ``plan``: it would wait forever."""
    present: Mapping[str, Mapping[str, float]] = client.run(_resources)
    for task in plan.tasks:
        if not any(all(has.get(name, 0) >= count for name, count in task.slots.items()) for has in present.values()):
            wanted = ", ".join(f"{name}={count}" for name, count in task.slots.items())
            raise InputError(
                f"{task.id}: needs {wanted}, and no worker has that; start workers with --slot {wanted} "
                f"(dask worker: --resources '{wanted}'), or leave it out of the job"
            )


@contextmanager
def token_file(folder: Path) -> Iterator[Path]:
    """Yield a file with a random token, by which workers prove that they see the same folder."""
    path = folder / "token"
    write_bytes(path, secrets.token_hex(16).encode())
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)


class WorkerCheck:
    """The workers, and which of them are suitable for the plan."""

    def __init__(self, client: Any, plan: Plan, token: Path) -> None:
        self._client = client
        self._plan = plan
        self._token = token
        self._asked: set[str] = set()
        self.refused: set[str] = set()

    def refuse_strangers(self) -> None:
        """Check the scheduler and all workers. Raises InputError when one is unsuitable."""
        # The scheduler unpickles what it passes on.
        complaints = self._wrong_versions({"scheduler": self._client.run_on_scheduler(pydoc.locate, VERSION_NAME)})
        complaints += self.ask_new()
        if complaints:
            raise InputError("; ".join(complaints))

    def ask_new(self) -> list[str]:
        """Check new workers; return complaints as sentences. Unsuitable ones get no tasks."""
        new = [address for address in worker_addresses(self._client) if address not in self._asked]
        if not new:
            return []
        self._asked.update(new)
        # ``locate`` is in the standard library: a worker without PhysGen can still answer.
        versions = self._client.run(pydoc.locate, VERSION_NAME, workers=new, on_error="return")
        complaints = self._wrong_versions({f"worker {address}": version for address, version in versions.items()})
        self.refused.update(address for address, version in versions.items() if version != self._plan.version)
        fit = [address for address in new if address not in self.refused]
        expected = self._token.read_text(encoding="utf-8")
        tokens = self._client.run(read_token, str(self._token), workers=fit, on_error="return") if fit else {}
        for address, text in tokens.items():
            if text != expected:
                complaints.append(
                    f"worker {address} does not see {self._plan.root}; mount the same folder at the same path there"
                )
                self.refused.add(address)
        return complaints

    def _wrong_versions(self, found: Mapping[str, object]) -> list[str]:
        """Return complaints about versions other than the plan's; a value that is no string means no PhysGen."""
        return [
            f"{who} has {f'PhysGen {version}' if isinstance(version, str) else 'no importable PhysGen'}, "
            f"this is PhysGen {self._plan.version}; install the same version there"
            for who, version in found.items()
            if version != self._plan.version
        ]

    def fit(self) -> list[str] | None:
        """Return the addresses that may get tasks; None if all may."""
        if not self.refused:
            return None
        return [address for address in worker_addresses(self._client) if address not in self.refused]


LONELY_S = 30.0
"""A notice is printed after this time without any worker."""


def run_dask(plan: Plan, options: FarmOptions, on_event: OnEvent, cancelled: IsCancelled) -> list[Outcome]:
    """Run ``plan``; return an outcome for each of its tasks, in order.

    Raises InputError, before anything is started, without Dask, scheduler or worker, when a worker has another version
    or does not see the plan's folder, or when no worker has a task's slots; and later, when the scheduler is lost.
    """
    scratch = plan.root / (plan.tasks[0].farm_folder if plan.tasks else ".farm") / "dask"
    if options.farm == "dask":
        workers = options.workers or max(1, cpu_count() // 2)
        threads = options.threads or max(1, cpu_count() // workers)
        options = dataclasses.replace(options, workers=workers, threads=threads)
    a_worker = slots_per_worker(plan)
    in_all = {name: options.slots.get(name, 1) for name in a_worker}
    with dask_client(options, a_worker, in_all, scratch, cancelled) as client, token_file(scratch) as token:
        run_name = f"physgen-{secrets.token_hex(8)}"
        crew = WorkerCheck(client, plan, token)
        crew.refuse_strangers()
        check_slots(plan, client)
        heard: Queue[tuple[str, Any]] = Queue()
        client.subscribe_topic(run_name, lambda event: heard.put(("event", event[1])))
        return _Run(plan, options, on_event, cancelled, client, crew, heard, run_name).outcomes()


class _Run:
    """The state of a running plan: which tasks wait, run and have ended."""

    def __init__(
        self,
        plan: Plan,
        options: FarmOptions,
        on_event: OnEvent,
        cancelled: IsCancelled,
        client: Any,
        crew: WorkerCheck,
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
        """Run the plan; return the outcomes in its order."""
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
            if kind == "event":
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
            run_on_worker,
            task,
            str(self._plan.root),
            self._plan.version,
            self._name,
            self._options.threads,
            key=f"{self._name}/{name}#{self._submissions[name]}",
            resources=dict(task.slots) or None,
            workers=self._crew.fit(),
            # Later stages first, so that videos finish early.
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
        """Handle a task that has ended in Dask."""
        if future.status == "finished":
            outcome: Outcome = future.result()
            if outcome.state == "failed" and outcome.attempts == 0 and self._met_stranger(name):
                self._starts[name] = max(0, self._starts[name] - 1)
                self._submit(name)
                return
            # Earlier attempts have reported their start, unless their machine died.
            attempts = max(0, self._starts[name] - 1) + outcome.attempts
            if outcome.state == "cancelled" and self._starts[name] == 0:
                outcome = self._not_begun(name)
        elif future.status == "cancelled":
            # Only the loss of the scheduler cancels our futures.
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
        """Return the outcome of a task whose worker died, or that could not be started."""
        error = future.exception()
        if type(error).__name__ == "KilledWorker":
            if self._starts[name] == 0:
                # It was queued at a worker that another task killed.
                return Outcome(task=name, state="failed", exit_code=1, message="its worker died before it began")
            return Outcome(
                task=name, state="failed", exit_code=1, message=f"its worker died {self._starts[name]} times"
            )
        if self._met_stranger(name):
            return Outcome(task=name, state="failed", exit_code=1, message="its worker was unsuitable")
        return Outcome(
            task=name,
            state="failed",
            exit_code=InputError.exit_code,
            message=f"the worker cannot run it ({type(error).__name__}: {error})",
        )

    def _met_stranger(self, name: str) -> bool:
        """Return whether unsuitable workers have joined since the task was submitted; they get no more tasks."""
        for message in self._crew.ask_new():
            self._on_event({"event": "notice", "message": message})
        return len(self._crew.refused) > self._refused_then[name]

    def _end(self, outcome: Outcome) -> None:
        """Report a task that has ended for good, and submit or skip its dependants."""
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
        """Start nothing more: queued tasks end at once. begun_too: also ask running tasks to stop."""
        self._stopping = True
        self._client.run(stop_run, self._name, begun_too, on_error="ignore")

    def _give_up(self, message: str) -> None:
        for name, future in list(self._running.items()):
            del self._running[name]
            future.cancel()
            self._end(Outcome(task=name, state="cancelled", exit_code=Cancelled.exit_code, message=message))

    def _look_after_workers(self, lonely_since: float | None) -> float | None:
        """Detect the loss of the scheduler or of all workers; return since when there are none."""
        if self._client.status != "running":
            self._lost_scheduler()
        fit = self._crew.fit()
        if worker_addresses(self._client) if fit is None else fit:
            return None
        if lonely_since is not None and time.monotonic() - lonely_since > LONELY_S:
            self._on_event({"event": "notice", "message": "no worker is left; waiting for one to join"})
            return time.monotonic() + 1e9
        return lonely_since or time.monotonic()

    def _lost_scheduler(self) -> None:
        raise InputError(
            f"{self._options.farm}: the scheduler was lost; restart it and run this again, finished tasks are kept"
        )
