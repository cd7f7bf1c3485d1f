# SPDX-License-Identifier: GPL-3.0-or-later
"""The live preview's worker process, and the frames that it returns."""

from __future__ import annotations

import contextlib
import json
import subprocess
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sim.app.stage_process import how_it_ended, parse_event, read_errors, start_process
from ...sim.cache.pc2 import Pc2Reader
from ...sim.errors import InputError, PhysGenError
from ...sim.events import Event
from ...sim.memory import memory_kills
from ...sim.npz import read_npy
from ...sim.scene.folder import inside

LAST_FRAME_S = 0.4
"""Duration of the last frame before the loop restarts, s."""


@dataclass(eq=False)
class Proxy:
    """Proxy of an object: faces (T, 3) int32; samples, one (V, 3) float32 in world metres for each frame so far."""

    name: str
    faces: NDArray[np.int32]
    samples: list[NDArray[np.float32]] = field(default_factory=list)


class Clip:
    """A growing run. frames: of the whole run; done: available so far."""

    def __init__(self, folder: Path, started: dict[str, Any], *, frames: int, fps: float) -> None:
        self.folder, self.frames, self.fps, self.done = folder, frames, fps, 0
        self.proxies = [Proxy(str(item["name"]), _faces(folder, item)) for item in started["objects"]]
        self._time = 0.0
        self._last: float | None = None

    def read(self, done: int) -> None:
        """Read the frames up to ``done``, which the worker has written. Raises InputError for a missing one."""
        for proxy in self.proxies:
            cache = Pc2Reader(self.folder / f"{proxy.name}.pc2")
            for index in range(len(proxy.samples), done):
                proxy.samples.append(cache.sample(index))
        self.done = max(self.done, done)

    def frame_at(self, now: float) -> int:
        """Return the frame to show at ``now``, in s of any monotonic clock: looping, never ahead of the worker."""
        elapsed = 0.0 if self._last is None else min(now - self._last, 0.25)
        self._last = now
        self._time += elapsed
        if self.done < self.frames:
            self._time = min(self._time, max(self.done - 1, 0) / self.fps)
        elif self._time > (self.frames - 1) / self.fps + LAST_FRAME_S:
            self._time = 0.0
        # Slightly more, so that a time of exactly a frame is that frame.
        return min(int(self._time * self.fps + 1e-6), max(self.done - 1, 0))


MAX_FACES_BYTES = 64 * 2**20


def _faces(folder: Path, item: dict[str, Any]) -> NDArray[np.int32]:
    faces = read_npy(inside(folder, f"{item['name']}.faces.npy"), MAX_FACES_BYTES)
    if (
        faces.ndim != 2
        or faces.shape[1] != 3
        or (len(faces) and not 0 <= faces.min() <= faces.max() < item["vertices"])
    ):
        raise InputError(f"{folder}: faces of {item['name']} are damaged; switch the preview off and on")
    return np.ascontiguousarray(faces, dtype=np.int32)


TINT = (0.22, 0.62, 1.0)
OPACITY = 0.72
AMBIENT = 0.35
LIGHT = np.array((0.35, -0.45, 0.82), dtype=np.float32)
"""Unit vector towards the light, in world axes."""


def shade_vertices(points: NDArray[np.float32], faces: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return RGBA (V, 4) of vertices (V, 3) of triangles (T, 3) in plain sRGB."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    corners = faces.T.ravel()
    sums = np.stack(
        [np.bincount(corners, weights=np.tile(normals[:, i], 3), minlength=len(points)) for i in range(3)], axis=1
    )
    lengths = np.maximum(np.linalg.norm(sums, axis=1), 1e-30)
    light = AMBIENT + (1 - AMBIENT) * (0.5 + 0.5 * (sums @ LIGHT) / lengths)
    result = np.empty((len(points), 4), dtype=np.float32)
    result[:, :3] = light[:, None] * np.asarray(TINT)
    result[:, 3] = OPACITY
    return result


STOP_GRACE_S = 5.0
"""Time that the worker may take to end after its input is closed."""


class Client:
    """Starts and stops the worker, sends requests, receives events.

    command: called in a thread, returns the worker's command line; may take seconds, may raise PhysGenError. at_end:
    called in that thread when the worker has ended.
    """

    def __init__(self, command: Callable[[], Sequence[str]], at_end: Callable[[], None]) -> None:
        self._command, self._at_end = command, at_end
        self._events: SimpleQueue[Event] = SimpleQueue()
        self._requests: SimpleQueue[bytes | None] = SimpleQueue()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="physgen preview", daemon=True)

    def start(self) -> None:
        """Start; returns at once."""
        self._thread.start()

    def send(self, request: Event) -> None:
        """Request a run; requests are queued until the worker is ready."""
        self._requests.put(json.dumps(request).encode() + b"\n")

    def events(self) -> list[Event]:
        """Return events since the last call; ``{"event": "ended", "message"}`` when the worker has ended."""
        found = []
        while True:
            try:
                found.append(self._events.get_nowait())
            except Empty:
                return found

    def stop(self) -> None:
        """End the worker, by force if necessary; returns at once."""
        self._stopped.set()
        self._requests.put(None)

    def join(self, timeout: float) -> bool:
        """Wait for the worker's end, for at most ``timeout`` s; return whether it has ended."""
        if self._thread.ident is None:
            return True
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            command = list(self._command())
            if self._stopped.is_set():
                return
            self._serve(command)
        except (PhysGenError, OSError) as error:
            self._events.put({"event": "ended", "message": str(error)})
        finally:
            self._at_end()

    def _serve(self, command: list[str]) -> None:
        kills = memory_kills()
        process = start_process(command, stdin=subprocess.PIPE)
        tail: deque[str] = deque(maxlen=10)
        threads = [
            threading.Thread(target=self._write, args=(process,), daemon=True),
            threading.Thread(target=read_errors, args=(process, tail), daemon=True),
        ]
        for thread in threads:
            thread.start()
        assert process.stdout is not None
        for line in process.stdout:
            event = parse_event(line)
            if event is not None:
                self._events.put(event)
        code = process.wait()
        self._requests.put(None)
        for thread in threads:
            thread.join(1.0)
        words = (
            "" if self._stopped.is_set() else "\n".join(tail).strip() or how_it_ended(code, kills, what="the worker")
        )
        self._events.put({"event": "ended", "message": words})

    def _write(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        with contextlib.suppress(OSError, ValueError):
            while (line := self._requests.get()) is not None:
                process.stdin.write(line)
                process.stdin.flush()
        with contextlib.suppress(OSError):
            process.stdin.close()
        try:
            process.wait(STOP_GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
