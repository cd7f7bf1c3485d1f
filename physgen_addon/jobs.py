# SPDX-License-Identifier: GPL-3.0-or-later
"""Long work beside Blender: a plain ``Job`` (start, step, cancel), and operators that run one live or blocking.

The work happens in child processes (``sim/app/process.py``). A thread of this process only waits for them and passes
their events on; nothing but the main thread touches bpy.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, ClassVar

import bpy

from ..sim.errors import Cancelled, PhysGenError, SimulationError
from ..sim.events import Event, IsCancelled, OnEvent
from .chosen import scene_with
from .views import redraw

Work = Callable[[OnEvent, IsCancelled], Event]
"""What a job does: called in a thread, without bpy; passes events on and returns the final one or raises."""

_LOG = logging.getLogger(__name__)

STEP_S = 0.1
"""How often a live job looks for news."""


class Job:
    """One piece of work, anywhere: in Blender's interface, in a script, in a test.

    title: what a person calls it. stage, message, done and total (of the stage's units), fraction (0 to 1, or None
    while it cannot be told), eta_s: how it stands, as of the last ``step``. notices: what a person should know.
    details: what the work has told of itself by ``{"event": "detail", …}``. operator, scene: who runs it, and for the
    scene of which ``session_uid``. longest_tick_s: how long it has held the main thread at most.
    """

    def __init__(self, title: str, work: Work, *, operator: str = "", scene: int = 0) -> None:
        self.title = title
        self.operator, self.scene = operator, scene
        self.done: int | None = None
        self.total: int | None = None
        self.details: dict[str, Any] = {}
        self.longest_tick_s = 0.0
        self.stage, self.message = "", "starting"
        self.fraction: float | None = None
        self.eta_s: float | None = None
        self.notices: list[str] = []
        self.started = time.monotonic()
        self._work = work
        self._events: SimpleQueue[Event] = SimpleQueue()
        self._stop = threading.Event()
        self._final: Event | None = None
        self._error: PhysGenError | None = None
        self._thread = threading.Thread(target=self._run, name=f"physgen {title}", daemon=True)

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    @property
    def is_cancelled(self) -> bool:
        """Whether it was asked to stop."""
        return self._stop.is_set()

    @property
    def has_ended(self) -> bool:
        """Whether its thread has ended."""
        return not self._thread.is_alive()

    def cancel(self) -> None:
        """Ask the work to stop; ``step`` says when it has. Its child process is killed if it does not obey."""
        self._stop.set()
        self.message = "stopping"

    def abandon(self) -> None:
        """Cancel, and wait just long enough that the child process has been told; nobody will ask for the result."""
        self.cancel()
        self._thread.join(5 * STEP_S)

    def step(self) -> bool:
        """Take in the news; whether the work has ended. Never waits."""
        ended = not self._thread.is_alive()
        while True:
            try:
                self._take(self._events.get_nowait())
            except Empty:
                return ended

    def wait(self) -> Event:
        """Block until the end; ``result``."""
        while not self.step():
            self._thread.join(STEP_S)
        return self.result()

    def result(self) -> Event:
        """The final event of work that has ended. Raises what the work raised."""
        if self._error is not None:
            raise self._error
        assert self._final is not None
        return self._final

    def _run(self) -> None:
        try:
            self._final = self._work(self._events.put, self._stop.is_set)
        except PhysGenError as error:
            self._error = error
        except BaseException as error:
            # A fault of ours must not leave the interface with a job that never ends.
            _LOG.exception("%s", self.title)
            self._error = SimulationError(f"{self.title} has failed ({type(error).__name__}: {error}); see the console")

    def _take(self, event: Event) -> None:
        if event.get("event") == "notice":
            self.notices.append(str(event.get("message")))
        if event.get("event") == "detail":
            self.details.update(event)
        if event.get("event") != "progress":
            return
        total, done = event.get("total"), event.get("done")
        self.stage = str(event.get("stage") or "")
        if not self._stop.is_set():
            self.message = str(event.get("message") or "")
        self.eta_s = event.get("eta_s")
        if isinstance(total, int | float) and isinstance(done, int | float) and total > 0:
            self.done, self.total = int(done), int(total)
            self.fraction = min(max(done / total, 0.0), 1.0)


_running: list[Job] = []
"""At most one; a list, so that it can be emptied. It ends with Blender and is no part of any file."""
_stopping: list[Job] = []
"""Cancelled and not yet ended: the interface does not wait until a worker has put things in order."""


def running() -> Job | None:
    """The job that is under way in the interface."""
    return _running[0] if _running else None


def stopping() -> list[Job]:
    """Jobs that were cancelled and whose workers still put things in order; for whoever needs their folders."""
    _stopping[:] = [job for job in _stopping if not job.has_ended]
    return list(_stopping)


def wait_for(others: list[Job], on_event: OnEvent, cancelled: IsCancelled) -> None:
    """Wait, in a job's thread, until ``others`` have ended. Raises Cancelled when asked to stop."""
    while any(not job.has_ended for job in others):
        on_event({"event": "progress", "message": "waiting for the run before to put things in order"})
        if cancelled():
            raise Cancelled("cancelled while waiting for the run before")
        time.sleep(STEP_S)


class JobOperator:
    """Mixin for operators that run a job: live with a modal timer (INVOKE_DEFAULT), blocking from scripts.

    A subclass gives ``request`` (check the input, build the work, call nothing) and ``finished`` (show the result), and
    may give ``progressed`` and ``stopped``.
    Nothing of bpy's data is kept while it runs, because undo or another file may free it; the scene is found again
    by its ``session_uid``, which undo and renaming keep.
    """

    bl_idname: str
    job_title: ClassVar[str] = "Job"

    def request(self, context: bpy.types.Context) -> Work:
        """The work; InputError when something is missing."""
        raise NotImplementedError

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the result in ``scene``; the sentence to report. May raise PhysGenError."""
        raise NotImplementedError

    def progressed(self, scene: bpy.types.Scene, job: Job) -> None:
        """Called in the main thread at every look; has a few milliseconds. May raise PhysGenError, which is noted."""

    def stopped(self, scene: bpy.types.Scene, error: PhysGenError) -> None:
        """Called when it was cancelled or failed."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """One job at a time."""
        if running() is not None:
            cls.poll_message_set(f"{running().title} is running; wait for it or cancel it")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Blocking, for scripts and background mode."""
        try:
            self.begin(context)
        except PhysGenError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        try:
            while (result := self.tick()) is None:
                time.sleep(STEP_S)
        finally:
            if self._job in _running:
                # Ctrl-C.
                _running.remove(self._job)
                self._job.abandon()
        return result

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Live: Blender stays usable."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            self.begin(context)
        except PhysGenError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(STEP_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Look for news at every tick; every other event is somebody else's."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        result = self.tick()
        # Sidebars show the progress, some of them in image editors.
        redraw("VIEW_3D", "UI")
        redraw("IMAGE_EDITOR", "UI")
        if result is None:
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self._timer)
        return result

    def tick(self) -> set[str] | None:
        """One look at the job, as the modal timer does it: None while it goes on, else the operator's result."""
        began, job = time.perf_counter(), self._job
        if job not in _running:
            # The extension was disabled.
            return {"CANCELLED"}
        ended, scene = job.step(), scene_with(job.scene)
        if scene is not None and not ended:
            self._progress(scene)
        job.longest_tick_s = max(job.longest_tick_s, time.perf_counter() - began)
        if not ended and not job.is_cancelled:
            return None
        if job in _running:
            _running.remove(job)
        if scene is None:
            self.report({"WARNING"}, f"{self.job_title} has ended and its scene is gone; what was done is kept")
            return {"CANCELLED"}
        if not ended:
            # The worker has a few seconds to put things in order; nobody has to watch.
            _stopping.append(job)
            self._fail(scene, Cancelled(f"{self.job_title} was stopped; what is done is kept"))
            return {"CANCELLED"}
        return self._end(scene)

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator itself: another file is loaded, or it quits."""
        self._job.abandon()
        context.window_manager.event_timer_remove(self._timer)
        if self._job in _running:
            _running.remove(self._job)
        if not self._job.has_ended:
            _stopping.append(self._job)

    def begin(self, context: bpy.types.Context) -> Job:
        """Start the job; ``tick`` until it returns something. Raises InputError when something is missing."""
        self._job = Job(
            self.job_title, self.request(context), operator=type(self).bl_idname, scene=context.scene.session_uid
        )
        self._noted: set[str] = set()
        self._job.start()
        _running.append(self._job)
        return self._job

    def _progress(self, scene: bpy.types.Scene) -> None:
        try:
            self.progressed(scene, self._job)
        except PhysGenError as error:
            # What cannot be shown now may be once it is complete; said once.
            if str(error) not in self._noted:
                self._noted.add(str(error))
                self.report({"WARNING"}, str(error))

    def _fail(self, scene: bpy.types.Scene, error: PhysGenError) -> None:
        self.report({"WARNING" if isinstance(error, Cancelled) else "ERROR"}, str(error))
        self.stopped(scene, error)

    def _end(self, scene: bpy.types.Scene) -> set[str]:
        try:
            sentence = self.finished(scene, self._job.result())
        except PhysGenError as error:
            self._fail(scene, error)
            return {"CANCELLED"}
        for notice in self._job.notices[-3:]:
            self.report({"INFO"}, notice)
        self.report({"INFO"}, sentence)
        return {"FINISHED"}


class PHYSGEN_OT_cancel_job(bpy.types.Operator):
    """Stop the running job; what it has finished is kept."""

    bl_idname = "physgen.cancel_job"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is something to cancel."""
        return running() is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask; the job's own operator reports when it has stopped."""
        job = running()
        if job is not None:
            job.cancel()
        return {"FINISHED"}


def start_chosen(
    operator: bpy.types.Operator, context: bpy.types.Context, job_operator: Callable[..., Any], given: dict[str, Any]
) -> set[str]:
    """What ``operator`` does with what a file browser gave it: call ``job_operator`` (one of ``bpy.ops``) with it.

    An operator that a file browser runs cannot go on beside Blender itself, so a job needs one of its own.
    """
    mode = "EXEC_DEFAULT" if context.window is None else "INVOKE_DEFAULT"
    try:
        job_operator(mode, **given)
    except RuntimeError as error:
        # What the other one has reported as an error.
        operator.report({"ERROR"}, str(error).removeprefix("Error: ").strip())
        return {"CANCELLED"}
    return {"FINISHED"}


def progress_text(job: Job) -> str:
    """Such as ``Diagnose: fits 40 %, 12 s left``; seconds so far while the share is not known."""
    text = f"{job.title}: {job.stage}" if job.stage else job.title
    if job.fraction is None:
        return f"{text}, {time.monotonic() - job.started:.0f} s"
    text += f" {100 * job.fraction:.0f} %"
    return text if job.eta_s is None else f"{text}, {job.eta_s:.0f} s left"


CLASSES = (PHYSGEN_OT_cancel_job,)


def unregister() -> None:
    """Stop whatever runs, because the extension is disabled."""
    for job in _running:
        job.abandon()
    _running.clear()
