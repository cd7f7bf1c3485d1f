# SPDX-License-Identifier: GPL-3.0-or-later
"""The one live preview of this Blender: switched on and off, stepped by a timer, drawn in the viewports.

Whether it is on is a property of the window manager, which no file keeps.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ..views import redraw
from .session import Session

STEP_S = 0.04
JOIN_S = 0.5

_sessions: list[Session] = []
"""At most one."""
_drawings: list[object] = []
longest_step_s = [0.0]
"""The longest time that a step has kept Blender waiting since the preview was switched on, in s."""


def session() -> Session | None:
    """The preview that is on."""
    return _sessions[0] if _sessions else None


def start(scene: bpy.types.Scene, command: Callable[[Path], Sequence[str]]) -> Session:
    """Switch the preview of ``scene`` on; another one is switched off."""
    stop()
    new = Session(scene.session_uid, command)
    _sessions.append(new)
    longest_step_s[0] = 0.0
    new.start()
    if not bpy.app.background:
        # Shaders need a window.
        from .draw import Drawing

        _drawings.append(Drawing(new))
        bpy.app.timers.register(_tick, first_interval=STEP_S, persistent=False)
    return new


def stop() -> None:
    """Switch the preview off; nothing happens when it is."""
    while _drawings:
        _drawings.pop().remove()  # type: ignore[attr-defined]
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
    said = (current.state, current.message)
    if current.step():
        redraw("VIEW_3D", *(("WINDOW", "UI") if (current.state, current.message) != said else ("WINDOW",)))
    longest_step_s[0] = max(longest_step_s[0], time.perf_counter() - before)
    return STEP_S


@persistent
def _on_other_file(*_: object) -> None:
    stop()


CLASSES = ()


def register() -> None:
    """Another file ends the preview."""
    bpy.app.handlers.load_pre.append(_on_other_file)


def unregister() -> None:
    """Switch off whatever is on."""
    bpy.app.handlers.load_pre.remove(_on_other_file)
    old = session()
    stop()
    if old is not None:
        old.join(JOIN_S)
