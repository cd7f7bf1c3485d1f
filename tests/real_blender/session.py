# SPDX-License-Identifier: GPL-3.0-or-later
"""Inside Blender: steps as generators that Blender's timers drive, so that windows draw and modal operators run."""

from __future__ import annotations

import importlib
import json
import sys
import time
import traceback
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np

Step = Generator[float, None, dict | None]
"""Yields seconds to wait; may return what it measured."""


def task() -> dict[str, str]:
    """What run.py asks for: ``out``, ``python``, ``addon``, ``photo``, ``scene``, ``wheels``, ``only``."""
    return json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8"))


def extension(module: str) -> Any:
    """Return a module of the installed extension."""
    return importlib.import_module(f"{task()['addon']}.{module}")


def running() -> Any:
    """Return the job that is running, or None."""
    return extension("physgen_addon.background_jobs").running()


def ended(what: str, seconds: float = 900) -> Generator[float, None, float]:
    """Wait until no job runs."""
    return (yield from until(lambda: running() is None, seconds, what))


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


def box(half: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (8, 3) in m and triangles (12, 3) of a cube around the origin."""
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([part for a, b, c, d in sides for part in ((a, b, c), (a, c, d))])


def a_capture(form: Any, folder: Path) -> None:
    """Save a recording of a box in flight, as points in space, in ``folder``; form: ``sim.diagnose.capture_folder``."""
    corners, _ = box(0.05)
    times = np.arange(12) / 50.0
    places = np.stack([times, 0 * times, 0.5 + times - 4.9 * times**2], axis=1)
    save_trials(form, folder, {"throw": (times, corners[None] + places[:, None])}, marks=corners, density=500.0)


def save_trials(
    form: Any,
    folder: Path,
    trials: Mapping[str, tuple[np.ndarray, np.ndarray]],
    *,
    marks: np.ndarray,
    density: float,
) -> None:
    """Save recordings of a box of 10 cm in ``folder``; form: ``sim.diagnose.capture_folder``.

    trials: times (T,) in s and points (T, K, 3) in m by name. marks: (K, 3) places of the points on the box, m.
    density: what it is believed to be, kg/m³.
    """
    corners, faces = box(0.05)
    belief = form.ObjectBelief(
        name="box", mesh="box.obj", density_kg_m3=density, stiffness="hard", youngs_modulus_pa=None
    )
    capture = form.Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=form.Ground(),
        objects=(form.CaptureObject(belief=belief, vertices=corners, faces=faces),),
        noise_sigma=0.001,
        camera=None,
        trials=tuple(
            form.Trial(
                name=name,
                role="fit",
                times=times,
                points=points,
                pixels=None,
                object_index=np.zeros(len(marks), dtype=np.int64),
                rest_points=marks,
            )
            for name, (times, points) in trials.items()
        ),
    )
    form.save_capture(capture, folder)


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
