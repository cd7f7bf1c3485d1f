# SPDX-License-Identifier: GPL-3.0-or-later
"""Long work beside Blender: a plain ``Job`` (start, step, cancel), and operators that run one live or blocking.

The work happens in child processes (``sim/app/process.py``). A thread of this process only waits for them and passes
their events on; nothing but the main thread touches bpy.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import ClassVar

import bpy

from ..sim.errors import Cancelled, PhysGenError
from ..sim.events import Event, IsCancelled, OnEvent

Work = Callable[[OnEvent, IsCancelled], Event]
"""What a job does: called in a thread, without bpy; passes events on and returns the final one or raises."""

STEP_S = 0.1
"""How often a live job looks for news."""


class Job:
    """One piece of work, anywhere: in Blender's interface, in a script, in a test.

    title: what a person calls it. stage, message, fraction (0 to 1, or None while it cannot be told), eta_s: how it
    stands, as of the last ``step``. notices: what a person should know.
    """

    def __init__(self, title: str, work: Work) -> None:
        self.title = title
        self.stage, self.message = "", "starting"
        self.fraction: float | None = None
        self.eta_s: float | None = None
        self.notices: list[str] = []
        self.started = time.monotonic()
        self._work = work
        self._events: SimpleQueue[Event] = SimpleQueue()
        self._stop = threading.Event()
        self._final: Event | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"physgen {title}", daemon=True)

    def start(self) -> None:
        """Begin; returns at once."""
        self._thread.start()

    def cancel(self) -> None:
        """Ask the work to stop; ``step`` says when it has. Its child process is killed if it does not obey."""
        self._stop.set()
        self.message = "cancelling"

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
        except BaseException as error:
            self._error = error

    def _take(self, event: Event) -> None:
        if event.get("event") == "notice":
            self.notices.append(str(event.get("message")))
        if event.get("event") != "progress":
            return
        total, done = event.get("total"), event.get("done")
        self.stage = str(event.get("stage") or "")
        if not self._stop.is_set():
            self.message = str(event.get("message") or "")
        self.eta_s = event.get("eta_s")
        if isinstance(total, int | float) and isinstance(done, int | float) and total > 0:
            self.fraction = min(max(done / total, 0.0), 1.0)


_running: list[Job] = []
"""At most one; a list, so that it can be emptied. It ends with Blender and is no part of any file."""


def running() -> Job | None:
    """The job that is under way in the interface."""
    return _running[0] if _running else None


class JobOperator:
    """Mixin for operators that run a job: live with a modal timer (INVOKE_DEFAULT), blocking from scripts.

    A subclass gives ``request`` (check the input, build the work, call nothing) and ``finished`` (show the result).
    Nothing of bpy's data is kept while it runs, because undo or another file may free it; the scene is found again
    by its name.
    """

    job_title: ClassVar[str] = "Job"

    def request(self, context: bpy.types.Context) -> Work:
        """The work; InputError when something is missing."""
        raise NotImplementedError

    def finished(self, scene: bpy.types.Scene, final: Event) -> str:
        """Show the result in ``scene``; the sentence to report. May raise PhysGenError."""
        raise NotImplementedError

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
            job = Job(self.job_title, self.request(context))
            job.start()
            job.wait()
        except PhysGenError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self._end(job, context.scene)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Live: Blender stays usable."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            work = self.request(context)
        except PhysGenError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._job = Job(self.job_title, work)
        self._scene_name = context.scene.name
        self._timer = context.window_manager.event_timer_add(STEP_S, window=context.window)
        context.window_manager.modal_handler_add(self)
        _running.append(self._job)
        self._job.start()
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Look for news at every tick; every other event is somebody else's."""
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        ended = self._job.step()
        redraw(context)
        if not ended:
            return {"PASS_THROUGH"}
        self._release(context)
        scene = bpy.data.scenes.get(self._scene_name)
        if scene is None:
            self.report({"WARNING"}, f"{self.job_title} has ended, but scene {self._scene_name!r} is gone")
            return {"CANCELLED"}
        return self._end(self._job, scene)

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator itself: another file is loaded, or it quits."""
        self._job.abandon()
        self._release(context)

    def _release(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        if self._job in _running:
            _running.remove(self._job)

    def _end(self, job: Job, scene: bpy.types.Scene) -> set[str]:
        try:
            sentence = self.finished(scene, job.result())
        except Cancelled as error:
            self.report({"WARNING"}, str(error))
            return {"CANCELLED"}
        except PhysGenError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        for notice in job.notices[-3:]:
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


def draw_job(layout: bpy.types.UILayout) -> None:
    """Progress and Cancel of the running job; nothing when there is none."""
    job = running()
    if job is None:
        return
    column = layout.column(align=True)
    row = column.row(align=True)
    row.scale_y = 1.4
    row.progress(factor=job.fraction or 0.0, text=progress_text(job))
    row.operator(PHYSGEN_OT_cancel_job.bl_idname, text="", icon="X")
    if job.message:
        column.label(text=job.message)


def progress_text(job: Job) -> str:
    """Such as ``Diagnose: fits 40 %, 12 s left``; seconds so far while the share is not known."""
    text = f"{job.title}: {job.stage}" if job.stage else job.title
    if job.fraction is None:
        return f"{text}, {time.monotonic() - job.started:.0f} s"
    text += f" {100 * job.fraction:.0f} %"
    return text if job.eta_s is None else f"{text}, {job.eta_s:.0f} s left"


def redraw(context: bpy.types.Context) -> None:
    """Redraw the sidebars, so that progress is seen."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()


CLASSES = (PHYSGEN_OT_cancel_job,)


def unregister() -> None:
    """Stop whatever runs, because the extension is disabled."""
    for job in _running:
        job.abandon()
    _running.clear()
