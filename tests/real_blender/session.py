# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: steps as generators that Blender's timers drive, so that windows draw and modal operators run."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Callable, Generator
from pathlib import Path

import bpy

Step = Generator[float, None, dict | None]
"""Yields seconds to wait; may return what it measured."""


def task() -> dict[str, str]:
    """What run.py asks for: ``out``, ``python``, ``addon``, ``photo``, ``only``."""
    return json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8"))


def until(condition: Callable[[], bool], seconds: float, what: str) -> Generator[float, None, float]:
    """Wait until ``condition()``; the longest time in seconds that Blender did not come back to the timer."""
    began = last = time.monotonic()
    longest = 0.0
    while not condition():
        yield 0.02
        now = time.monotonic()
        longest, last = max(longest, now - last), now
        if now - began > seconds:
            raise AssertionError(f"waited {seconds:g} s for {what}")
    return longest


def run(name: str, steps: list[Callable[[], Step]]) -> None:
    """Take the steps one after the other, write ``NAME.json`` and quit Blender."""
    out = Path(task()["out"])
    done: list[dict] = []
    state = {"steps": done, "trouble": "it did not come to its end"}

    def everything() -> Generator[float, None, None]:
        for step in steps:
            began = time.monotonic()
            measured = yield from step()
            done.append({"step": step.__name__, "seconds": round(time.monotonic() - began, 2), **(measured or {})})

    going = everything()

    def tick() -> float | None:
        try:
            return next(going)
        except StopIteration:
            state["trouble"] = ""
        # Whatever happened is the report's; Blender would only print it and leave its window open.
        except BaseException as error:
            traceback.print_exc()
            state["trouble"] = f"{type(error).__name__} in step {len(done) + 1}: {error}"
        (out / f"{name}.json").write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")
        bpy.ops.wm.quit_blender()
        return None

    bpy.context.preferences.view.show_splash = False
    # Pictures are of panels; without a graphics card every smoothed line is the processor's work.
    bpy.context.preferences.system.viewport_aa = "OFF"
    # Persistent: it outlives opening another file.
    bpy.app.timers.register(tick, first_interval=2.0, persistent=True)
