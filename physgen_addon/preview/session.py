# SPDX-License-Identifier: GPL-3.0-or-later
"""A running preview: watch the scene, ask the worker, play what it answers. Driven by ``step``, which never waits."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import bpy

from ...sim.errors import InputError, PhysGenError
from ...sim.events import Event
from ..bridge.export import export_scene
from ..bridge.export_units import clock, metres_per_unit
from ..chosen import scene_with
from . import watch
from .client import Client
from .clip import Clip

PARTICLES = 2000
MOST_FRAMES = 48
SHAPES_S = 0.3
"""How often shapes are compared: that reads every vertex."""

ENOUGH = 3
"""Frames of a new run that must be there before it takes the place of the one that plays."""


class Session:
    """The live preview of one scene.

    command: gives the command line of a worker whose runs go into a folder; called in a thread.
    scene_uid: its ``session_uid``, looked up at every step, because undo and another file replace the scene.
    state: ``starting``, ``compiling``, ``running``, ``playing`` or ``error``; message: what a person should know;
    clip: what is shown.
    """

    def __init__(self, scene_uid: int, command: Callable[[Path], Sequence[str]]) -> None:
        self.scene_uid = scene_uid
        self.state, self.message = "starting", ""
        self.notices: list[str] = []
        self.clip: Clip | None = None
        self.frame = 0
        self.unit = 1.0
        self.answer_s: float | None = None
        self._coming: Clip | None = None
        self._root = Path(tempfile.mkdtemp(prefix="physgen-preview-"))
        self._client = Client(lambda: command(self._root / "runs"), self._remove_files)
        self._ended = False
        self._ready = self._ran = False
        self._number, self._asked_at = 0, 0.0
        self._numbers: tuple[str, ...] | None = None
        self._shapes, self._shapes_at, self._exports = "", -SHAPES_S, 0
        self._length = (0, 0.0)

    def start(self) -> None:
        """Start the worker; returns at once."""
        self._client.start()

    def stop(self) -> None:
        """Let the worker end; what was written goes with it. Returns at once."""
        self._client.stop()
        self.clip = self._coming = None
        if self._client.join(0.0):
            # It was gone before the last export.
            self._remove_files()

    def join(self, timeout: float) -> bool:
        """Wait for the worker's end after ``stop``; whether it has ended within ``timeout`` s."""
        return self._client.join(timeout)

    def _remove_files(self) -> None:
        shutil.rmtree(self._root, ignore_errors=True)

    def step(self, now: float | None = None) -> bool:
        """Look for changes of the scene and news of the worker; whether the viewport must be drawn anew.

        now: seconds of a steady clock; None asks it.
        """
        now = time.monotonic() if now is None else now
        before = (self.clip, self.frame, self.state, self.message)
        scene = self.scene()
        if scene is None:
            self._fail("the scene is gone; switch the preview off")
        elif not self._ended:
            self._follow(scene, now)
        for event in self._client.events():
            try:
                self._take(event, now)
            except InputError as error:
                self._fail(str(error))
        if self.clip is not None:
            self.frame = self.clip.frame_at(now)
        return (self.clip, self.frame, self.state, self.message) != before

    def scene(self) -> bpy.types.Scene | None:
        """The scene, also renamed; None when it is gone."""
        return scene_with(self.scene_uid)

    def _follow(self, scene: bpy.types.Scene, now: float) -> None:
        """Ask for a run when a number or a shape is no more what it was at the last request."""
        try:
            changed = False
            if now - self._shapes_at >= SHAPES_S:
                self._shapes_at = now
                shapes = watch.shapes(scene)
                if shapes != self._shapes:
                    # Noted first, so that a scene that cannot be exported is not tried again until it changes.
                    self._shapes, changed = shapes, True
                    self._numbers = None
                    self._exports += 1
                    export_scene(scene, self._root / f"scene-{self._exports}")
                    shutil.rmtree(self._root / f"scene-{self._exports - 2}", ignore_errors=True)
                    self._numbers = ()
            if self._numbers is None:
                return
            times = clock(scene)
            length = (max(2, min(len(times.frames), MOST_FRAMES)), times.fps)
            numbers = watch.numbers(scene)
            if changed or (numbers, length) != (self._numbers, self._length):
                self._numbers, self._length = numbers, length
                self._request(scene, now)
        except PhysGenError as error:
            self._fail(str(error))

    def _request(self, scene: bpy.types.Scene, now: float) -> None:
        self._number += 1
        self._asked_at = now
        self.unit = metres_per_unit(scene)
        frames, fps = self._length
        self._client.send(
            {
                "id": self._number,
                "scene": str(self._root / f"scene-{self._exports}"),
                "overrides": list(self._numbers or ()),
                "frames": frames,
                "fps": fps,
                "particles": PARTICLES,
            }
        )
        if self._ready:
            self.state, self.message = "compiling" if not self._ran else "running", ""

    def _take(self, event: Event, now: float) -> None:
        kind = event["event"]
        if kind == "ready":
            self._ready = True
            if self._number:
                self.state = "compiling"
        elif kind == "ended":
            self._ended = True
            if event["message"]:
                self._fail(event["message"])
        elif event.get("id") != self._number:
            return
        elif kind == "started":
            self.notices = [str(text) for text in event["notices"]]
            frames, fps = self._length
            self._coming = Clip(Path(event["folder"]), event, frames=frames, fps=fps)
        elif kind == "frame" and self._coming is not None:
            self._coming.read(int(event["done"]))
            if self._coming.done >= min(ENOUGH, self._coming.frames) and self.clip is not self._coming:
                self.clip, self._ran = self._coming, True
                self.answer_s = now - self._asked_at
            if self.clip is self._coming:
                self.state, self.message = "running", f"{self._coming.done} of {self._coming.frames} frames"
        elif kind == "done":
            self.state, self.message = "playing", ""
        elif kind == "error":
            self._fail(str(event.get("message")))

    def _fail(self, message: str) -> None:
        self.state, self.message = "error", message
        self.clip = self._coming = None
