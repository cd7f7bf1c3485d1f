# SPDX-License-Identifier: GPL-3.0-or-later
"""A live preview: watch the scene, send changes to the warm worker, play the frames it returns. Never blocks."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...sim.atomic import scratch_prefix
from ...sim.errors import InputError, PhysGenError
from ...sim.events import Event
from ...sim.validation import to_json
from ..context import scene_with
from ..props.body_props import bodies
from ..scene_io.export_animation import channels, clock, export_names, metres_per_unit
from ..scene_io.export_meshes import read_points
from ..scene_io.export_objects import physics
from ..scene_io.export_scene import export_scene
from ..scene_io.export_world import effects, gravity
from ..text import decimal
from .preview_worker import Client, Clip

UNSET = ("friction", "static_friction", "restitution", "contact_mode", "shell_thickness")
"""Properties of an object that are omitted unless set."""

OFF: Mapping[str, Any] = {"asleep": False, "held": False, "velocity_keys": ()}
"""Values of others that are omitted."""


def watched_numbers(scene: bpy.types.Scene) -> tuple[str, ...]:
    """Return all values that can be passed to the worker without a new export, as overrides of the exported scene.

    Raises InputError for an invalid one.
    """
    unit, times, names = metres_per_unit(scene), clock(scene), export_names(scene)
    found = []
    for item in bodies(scene):
        fields: dict[str, Any] = {**dict.fromkeys(UNSET), **OFF, **physics(item, unit, times)}
        fields.pop("role")
        material = fields.pop("material", None)
        if material is not None:
            fields |= {name: value for name, value in to_json(material).items() if name != "preset"}
        found += [f"{names[item.name]}.{name}={json.dumps(to_json(value))}" for name, value in fields.items()]
    world = scene.physgen.world
    if world.use_ground:
        friction = decimal(world.friction)
        static = max(friction, decimal(world.static_friction))
        found += [f"ground.friction={friction}", f"ground.static_friction={static}"]
        found.append(f"ground.restitution={decimal(world.restitution)}")
    if not {path for path, _ in channels(scene)} & {"gravity", "use_gravity"}:
        found.append(f"scene.gravity={json.dumps(gravity(scene, unit))}")
    return tuple(found)


def watched_shapes(scene: bpy.types.Scene) -> str:
    """Return a hash of the other inputs that users edit during a preview: meshes, poses, roles, pins, effects.

    Animated changes do not count; restarting the preview exports everything anew.
    """
    digest = hashlib.sha256()
    world = scene.physgen.world
    known: list[Any] = [metres_per_unit(scene), world.use_ground, tuple(world.ground_point), tuple(world.ground_normal)]
    known += _place(world.ground_object)
    try:
        known.append(to_json(effects(scene, export_names(scene))))
    except InputError as error:
        known.append(str(error))
    for item in bodies(scene):
        body = item.physgen
        known += [item.name, body.role, body.sandy, body.sandy_frame, *_place(item)]
        for pin in body.pins:
            known += _place(pin.box)
        if not item.data.is_editmode:
            known += [len(item.data.vertices), len(item.data.loops)]
            digest.update(read_points(item.data))
        known += [(modifier.name, modifier.show_viewport) for modifier in item.modifiers]
    digest.update(repr(known).encode())
    return digest.hexdigest()


def _place(item: bpy.types.Object | None) -> list[Any]:
    if item is None:
        return [None]
    moving = {path for path, _ in channels(item)}
    own = [name for name in ("location", "rotation_euler", "rotation_quaternion", "scale") if name not in moving]
    return [item.name, item.parent.name if item.parent else "", *(tuple(getattr(item, name)) for name in own)]


PARTICLES = 2000
MOST_FRAMES = 48
SHAPES_S = 0.3
"""Interval of comparing shapes: that reads every vertex."""

ENOUGH = 3
"""Frames of a new run that must be available before it replaces the playing one."""


class Session:
    """The live preview of one scene.

    command: returns the command line of a worker whose runs go into a folder; called in a thread.
    scene_uid: its ``session_uid``, looked up at every step, because undo and another file replace the scene.
    state: ``starting``, ``compiling``, ``running``, ``playing`` or ``error``; message: for the user; clip: what is
    shown.
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
        self._root = Path(tempfile.mkdtemp(prefix=scratch_prefix("preview")))
        self._client = Client(lambda: command(self._root / "runs"), self._remove_files)
        self._ended = False
        self._ready = self._ran = False
        self._number, self._asked_at = 0, 0.0
        self._numbers: tuple[str, ...] | None = None
        self._shapes, self._shapes_at, self._exports = "", -SHAPES_S, 0
        self._length = (0, 0.0, 1.0)

    def start(self) -> None:
        """Start the worker; returns at once."""
        self._client.start()

    def stop(self) -> None:
        """End the worker and delete its files. Returns at once."""
        self._client.stop()
        self.clip = self._coming = None
        if self._client.join(0.0):
            # It was deleted before the last export.
            self._remove_files()

    def join(self, timeout: float) -> bool:
        """Wait for the worker's end after ``stop``; return whether it has ended within ``timeout`` s."""
        return self._client.join(timeout)

    def _remove_files(self) -> None:
        shutil.rmtree(self._root, ignore_errors=True)

    def step(self, now: float | None = None) -> bool:
        """Process changes of the scene and events of the worker; return whether to redraw the viewport.

        now: seconds of a monotonic clock; None reads it.
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
        """Return the scene, even if renamed; None if it is gone."""
        return scene_with(self.scene_uid)

    def _follow(self, scene: bpy.types.Scene, now: float) -> None:
        """Request a run if a value or a shape differs from the last request."""
        try:
            changed = False
            if now - self._shapes_at >= SHAPES_S:
                self._shapes_at = now
                shapes = watched_shapes(scene)
                if shapes != self._shapes:
                    # Stored first, so that a scene that cannot be exported is not retried until it changes.
                    self._shapes, changed = shapes, True
                    self._numbers = None
                    self._exports += 1
                    export_scene(scene, self._root / f"scene-{self._exports}")
                    shutil.rmtree(self._root / f"scene-{self._exports - 2}", ignore_errors=True)
                    self._numbers = ()
            if self._numbers is None:
                return
            times = clock(scene)
            length = (max(2, min(len(times.frames), MOST_FRAMES)), times.fps, times.slow)
            numbers = watched_numbers(scene)
            if changed or (numbers, length) != (self._numbers, self._length):
                self._numbers, self._length = numbers, length
                self._request(scene, now)
        except PhysGenError as error:
            self._fail(str(error))

    def _request(self, scene: bpy.types.Scene, now: float) -> None:
        self._number += 1
        self._asked_at = now
        self.unit = metres_per_unit(scene)
        frames, fps, slow = self._length
        self._client.send(
            {
                "id": self._number,
                "scene": str(self._root / f"scene-{self._exports}"),
                "overrides": list(self._numbers or ()),
                "frames": frames,
                "fps": fps * slow,
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
            frames, fps, _ = self._length
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
