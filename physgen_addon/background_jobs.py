# SPDX-License-Identifier: GPL-3.0-or-later
"""Background jobs: a plain ``Job`` (start, step, cancel), and operators that run one modally or blocking.

The work runs in child processes (``sim/app/stage_process.py``). A thread of this process only waits for them and
forwards their events; only the main thread touches bpy.
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
from ..sim.events import Event, IsCancelled, OnEvent, stage_words
from .compat import OperatorMixin
from .context import TAB, redraw, scene_with
from .interpreter import NoPython
from .text import duration, popup, without_options

Work = Callable[[OnEvent, IsCancelled], Event]
"""The work of a job: called in a thread, without bpy; forwards events and returns the final event, or raises."""

_LOG = logging.getLogger(__name__)

STEP_S = 0.1
"""Interval at which a modal job polls for events."""


class Job:
    """One piece of work, in Blender's interface, a script or a test.

    title: its name in the interface. stage, message, done and total (in the stage's units), fraction (0 to 1, None if
    unknown), eta_s: progress as of the last ``step``. notices: messages to the user. details: what the work reported by
    ``{"event": "detail", …}``. operator, scene: the operator that runs it, and the ``session_uid`` of its scene.
    longest_tick_s: longest time it has blocked the main thread. undone: whether the user has undone anything since it
    began.
    """

    def __init__(self, title: str, work: Work, *, operator: str = "", scene: int = 0) -> None:
        self.title = title
        self.operator, self.scene = operator, scene
        self.done: int | None = None
        self.total: int | None = None
        self.details: dict[str, Any] = {}
        self.longest_tick_s = 0.0
        self.undone = False
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
        """Start the thread and return at once."""
        self._thread.start()

    @property
    def is_cancelled(self) -> bool:
        """Return whether cancelling was requested."""
        return self._stop.is_set()

    @property
    def has_ended(self) -> bool:
        """Return whether its thread has ended."""
        return not self._thread.is_alive()

    def cancel(self) -> None:
        """Request the work to stop; ``step`` returns True once it has. An unresponsive child process is killed."""
        self._stop.set()
        self.message = "stopping"

    def abandon(self) -> None:
        """Cancel, and wait only until the child process was signalled; the result is not used."""
        self.cancel()
        self._thread.join(5 * STEP_S)

    def step(self) -> bool:
        """Process new events; return whether the work has ended. Never blocks."""
        ended = not self._thread.is_alive()
        while True:
            try:
                self._take(self._events.get_nowait())
            except Empty:
                return ended

    def wait(self) -> Event:
        """Block until the work ends; return ``result``."""
        while not self.step():
            self._thread.join(STEP_S)
        return self.result()

    def result(self) -> Event:
        """Return the final event of finished work. Raises what the work raised."""
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
            # An internal error must not leave the interface with a job that never ends.
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
"""The running job, at most one; a list so that it can be cleared. Not stored in any file."""
_stopping: list[Job] = []
"""Cancelled jobs that have not ended: the interface does not wait for their workers to clean up."""


def running() -> Job | None:
    """Return the job that is running in the interface, or None."""
    return _running[0] if _running else None


def stopping() -> list[Job]:
    """Return cancelled jobs whose workers are still cleaning up and may hold folders."""
    _stopping[:] = [job for job in _stopping if not job.has_ended]
    return list(_stopping)


def note_undo() -> None:
    """Note that the user has undone something while a job runs."""
    for job in _running:
        job.undone = True


def wait_for(others: list[Job], on_event: OnEvent, cancelled: IsCancelled) -> None:
    """In a job's thread, wait until ``others`` have ended. Raises Cancelled when cancelled."""
    while any(not job.has_ended for job in others):
        on_event({"event": "progress", "message": "waiting for the previous run to clean up"})
        if cancelled():
            raise Cancelled("cancelled while waiting for the previous run")
        time.sleep(STEP_S)


def no_job_runs(operator: type[bpy.types.Operator]) -> bool:
    """Return whether a job may start; otherwise set the poll message of ``operator``."""
    job = running()
    if job is not None:
        operator.poll_message_set(f"{job.title} is running; wait for it or cancel it")
    return job is None


class JobOperator(OperatorMixin):
    """Mixin of operators that run a job: modal with a timer (INVOKE_DEFAULT), blocking from scripts.

    Subclasses define ``request`` (validate the input and build the work) and ``finished`` (show the result), and may
    define ``progressed`` and ``stopped``. No bpy data is held while it runs, because undo or loading a file may free
    it; the scene is looked up by its ``session_uid``, which survives undo and renaming.
    """

    bl_idname: str
    job_title: ClassVar[str] = "Job"
    keeps_redo: ClassVar[bool] = False
    """Whether its end is no step of undo if the user has undone something meanwhile: a step would end what can be
    redone. Only for results that are found again without one."""
    _drawn: tuple[Any, ...] = ()
    """What of the job was drawn last."""

    def request(self, context: bpy.types.Context) -> Work:
        """Return the work. Raises InputError for missing input."""
        raise NotImplementedError

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the result in ``scene``; return the message to report. May raise PhysGenError."""
        raise NotImplementedError

    def progressed(self, scene: bpy.types.Scene, job: Job) -> None:
        """Called in the main thread at each poll; must return within milliseconds. A PhysGenError becomes a notice."""

    def stopped(self, scene: bpy.types.Scene, error: PhysGenError) -> None:
        """Called after the job was cancelled or failed."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Allow one job at a time."""
        return no_job_runs(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Run blocking, for scripts and background mode."""
        try:
            self.begin(context)
        except PhysGenError as error:
            self.report({"ERROR"}, popup(str(error)))
            return {"CANCELLED"}
        try:
            while (result := self.tick()) is None:
                time.sleep(STEP_S)
        finally:
            if self._job in _running:
                # Ctrl-C
                _running.remove(self._job)
                self._job.abandon()
        return result

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Run modally, so that Blender stays usable."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            self.begin(context)
        except PhysGenError as error:
            self.report({"ERROR"}, popup(str(error)))
            return {"CANCELLED"}
        self._timer = context.window_manager.event_timer_add(STEP_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Poll the job at each timer tick; pass all other events through."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        result = self.tick()
        shown = (progress_text(self._job), self._job.message, self._job.done)
        # Without a graphics card each drawing takes what the job could compute with.
        if shown != self._drawn or result is not None:
            self._drawn = shown
            # Sidebars show the progress, some of them in image editors.
            redraw("VIEW_3D", "UI")
            redraw("IMAGE_EDITOR", "UI")
            redraw("DOPESHEET_EDITOR", "WINDOW")
        if result is None:
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self._timer)
        return result

    def tick(self) -> set[str] | None:
        """Poll the job once: return None while it runs, else the operator's result."""
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
            self.report({"WARNING"}, f"{self.job_title} has ended and its scene is gone; results are kept")
            return {"CANCELLED"}
        if not ended:
            # The worker has a few seconds to clean up; the operator need not stay for that.
            _stopping.append(job)
            self._fail(scene, Cancelled(f"{self.job_title} was stopped; results so far are kept"))
            return {"CANCELLED"}
        return self._end(scene)

    def cancel(self, context: bpy.types.Context) -> None:
        """Called by Blender when another file is loaded or Blender quits."""
        self._job.abandon()
        context.window_manager.event_timer_remove(self._timer)
        if self._job in _running:
            _running.remove(self._job)
        if not self._job.has_ended:
            _stopping.append(self._job)

    def begin(self, context: bpy.types.Context) -> Job:
        """Start the job; call ``tick`` until it returns a result. Raises InputError for missing input."""
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
            # A partial result that cannot be shown yet may be shown when complete; reported once.
            if str(error) not in self._noted:
                self._noted.add(str(error))
                self.report({"WARNING"}, str(error))

    def _fail(self, scene: bpy.types.Scene, error: PhysGenError) -> None:
        # A command is nothing for a popup: it is in the preferences, and buttons are in the panel.
        words = str(error)
        if not isinstance(error, NoPython):
            words = without_options(words)
        elif not bpy.app.background:
            words = f"{error.reason} (see Scene in the tab {TAB})"
        is_stop = isinstance(error, Cancelled)
        self.report({"WARNING" if is_stop else "ERROR"}, words if is_stop else popup(words))
        self.stopped(scene, error)

    def _end(self, scene: bpy.types.Scene) -> set[str]:
        try:
            sentence = self.finished(scene, self._job.result())
        except PhysGenError as error:
            self._fail(scene, error)
            return {"CANCELLED"}
        for notice in self._job.notices[-3:]:
            self.report({"INFO"}, without_options(notice))
        self.report({"INFO"}, sentence)
        return {"CANCELLED"} if self._job.undone and self.keeps_redo else {"FINISHED"}


class PHYSGEN_OT_cancel_job(bpy.types.Operator):
    """Stop the running job; completed results are kept"""

    bl_idname = "physgen.cancel_job"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled while a job runs."""
        return running() is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Request cancelling; the job's own operator reports when it has stopped."""
        job = running()
        if job is not None:
            job.cancel()
        return {"FINISHED"}


def start_chosen(
    operator: bpy.types.Operator, context: bpy.types.Context, job_operator: Callable[..., Any], given: dict[str, Any]
) -> set[str]:
    """Call ``job_operator`` (one of ``bpy.ops``) with the file that ``operator`` got from a file browser.

    An operator that a file browser runs cannot continue modally, so a job needs an operator of its own.
    """
    mode = "EXEC_DEFAULT" if context.window is None else "INVOKE_DEFAULT"
    try:
        job_operator(mode, **given)
    except RuntimeError as error:
        # The error that the other operator has reported, broken into lines.
        operator.report({"ERROR"}, str(error).removeprefix("Error: ").strip())
        return {"CANCELLED"}
    return {"FINISHED"}


def progress_text(job: Job) -> str:
    """Return progress as text, such as ``Render: writing the video 40 %, 12 s left``; elapsed time if what is left is
    unknown, so that a long step is seen to go on.
    """
    # "Reconstruction: reconstructing" says nothing that "Reconstruction" does not.
    words = stage_words(job.stage)
    is_told = any(told.lower()[:5] == job.title.lower()[:5] for told in (job.stage, words)) or not job.stage
    text = job.title if is_told else f"{job.title}: {words[:1].lower()}{words[1:]}"
    if job.fraction is not None:
        text += f" {100 * job.fraction:.0f} %"
        if job.eta_s is not None:
            return f"{text}, {duration(job.eta_s)} left"
    return f"{text}, {duration(time.monotonic() - job.started)}"


def unregister_jobs() -> None:
    """Stop running jobs when the extension is disabled."""
    for job in _running:
        job.abandon()
    _running.clear()
