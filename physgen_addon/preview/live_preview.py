# SPDX-License-Identifier: GPL-3.0-or-later
"""The live preview of this Blender: a single session, stepped by a timer and drawn in the viewports."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent
from mathutils import Matrix

from ..context import redraw
from ..interpreter import cli_command, find_python
from ..props import preferences
from ..props.body_props import bodies
from .preview_session import Session
from .preview_worker import Clip, shade_vertices

STEP_S = 0.04
JOIN_S = 0.5

_sessions: list[Session] = []
"""The running session, at most one."""
_drawings: list[_Drawing] = []
longest_step_s = [0.0]
"""Longest time in s that a step has blocked Blender since the preview was switched on."""


def session() -> Session | None:
    """Return the running preview, or None."""
    return _sessions[0] if _sessions else None


def start(scene: bpy.types.Scene, command: Callable[[Path], Sequence[str]]) -> Session:
    """Start the preview of ``scene``; stop any other."""
    stop()
    new = Session(scene.session_uid, command)
    _sessions.append(new)
    longest_step_s[0] = 0.0
    new.start()
    if not bpy.app.background:
        # Shaders need a window.
        _drawings.append(_Drawing(new))
        bpy.app.timers.register(_tick, first_interval=STEP_S, persistent=False)
    return new


def stop() -> None:
    """Stop the preview, if running."""
    while _drawings:
        _drawings.pop().remove()
    while _sessions:
        old = _sessions.pop()
        old.stop()
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    redraw("VIEW_3D", "WINDOW", "UI")


def _tick() -> float | None:
    current = session()
    if current is None:
        return None
    before = time.perf_counter()
    shown = (current.state, current.message)
    if current.step():
        redraw("VIEW_3D", *(("WINDOW", "UI") if (current.state, current.message) != shown else ("WINDOW",)))
    longest_step_s[0] = max(longest_step_s[0], time.perf_counter() - before)
    return STEP_S


@persistent
def _on_other_file(*_: object) -> None:
    stop()


def register_live_preview() -> None:
    """Stop the preview when another file is loaded."""
    bpy.app.handlers.load_pre.append(_on_other_file)


def unregister_live_preview() -> None:
    """Stop the preview and wait for the worker."""
    bpy.app.handlers.load_pre.remove(_on_other_file)
    old = session()
    stop()
    if old is not None:
        old.join(JOIN_S)


def worker_command(preferred: str) -> Callable[[Path], Sequence[str]]:
    """Return the worker's command line; finding the interpreter can take seconds, so this runs in the client's
    thread.
    """

    def command(runs: Path) -> Sequence[str]:
        return cli_command(find_python(preferred), "preview", "--out", str(runs))

    return command


class PHYSGEN_OT_toggle_preview(bpy.types.Operator):
    """Simulate the scene coarsely after every change, and play that in the viewport. The bake is not affected"""

    bl_idname = "physgen.toggle_preview"
    bl_label = "Live Preview"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Enabled if it is running, or there is a dynamic object."""
        if session() is not None or any(item.physgen.role == "dynamic" for item in bodies(context.scene)):
            return True
        cls.poll_message_set("Add an object to the simulation first")
        return False

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Toggle; returns at once."""
        if session() is not None:
            stop()
        else:
            start(context.scene, worker_command(preferences.python(context)))
        return {"FINISHED"}


class _Drawing:
    """Draws the proxies of ``session`` in every 3D viewport of its scene until removed. Not stored or undone."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._clip: Clip | None = None
        self._batches: dict[int, list[Any]] = {}
        self._handle: Any = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_VIEW")

    def remove(self) -> None:
        """Stop drawing."""
        if self._handle is not None:
            bpy.types.SpaceView3D.draw_handler_remove(self._handle, "WINDOW")
            self._handle = None
        self._batches = {}

    def _draw(self) -> None:
        session, clip = self._session, self._session.clip
        if clip is None or clip.done == 0 or bpy.context.scene.session_uid != session.scene_uid:
            return
        if clip is not self._clip:
            self._clip, self._batches = clip, {}
        import gpu

        shader = gpu.shader.from_builtin("SMOOTH_COLOR")
        if session.frame not in self._batches:
            self._batches[session.frame] = _batches(clip, session.frame, shader)
        depth, blend = gpu.state.depth_test_get(), gpu.state.blend_get()
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(True)
        gpu.state.face_culling_set("BACK")
        gpu.state.blend_set("ALPHA")
        with gpu.matrix.push_pop():
            gpu.matrix.load_matrix(nearer(gpu.matrix.get_model_view_matrix(), gpu.matrix.get_projection_matrix()))
            gpu.matrix.scale_uniform(1.0 / session.unit)
            for batch in self._batches[session.frame]:
                batch.draw(shader)
        gpu.state.face_culling_set("NONE")
        gpu.state.depth_mask_set(False)
        gpu.state.depth_test_set(depth)
        gpu.state.blend_set(blend)


NEARER = 0.01
"""Share of its distance by which the preview is drawn nearer. Its first frame lies on the objects themselves: without
this both show through each other in patches."""


def nearer(model_view: Matrix, projection: Matrix) -> Matrix:
    """Return ``model_view`` such that all that is drawn comes nearer by the share NEARER, and is seen where it was."""
    if projection[3][3] == 0:
        # Perspective: towards the eye, which is the origin.
        return Matrix.Scale(1 - NEARER, 4) @ model_view
    return Matrix.Translation((0, 0, 2 * NEARER / projection[1][1])) @ model_view


def _batches(clip: Clip, frame: int, shader: Any) -> list[Any]:
    """Return the GPU batches of ``frame``, cached so that a loop costs nothing."""
    from gpu_extras.batch import batch_for_shader

    return [
        batch_for_shader(
            shader,
            "TRIS",
            {"pos": proxy.samples[frame], "color": shade_vertices(proxy.samples[frame], proxy.faces)},
            indices=proxy.faces,
        )
        for proxy in clip.proxies
    ]
