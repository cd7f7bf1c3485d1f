# SPDX-License-Identifier: GPL-3.0-or-later
"""The frames of one coarse run, read as they arrive, and which of them to show when."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sim.cache.pc2 import Pc2Reader
from ...sim.errors import InputError

LAST_FRAME_S = 0.4
"""How long the last frame stays before the run begins again."""


@dataclass(eq=False)
class Proxy:
    """An object's stand-in: faces (T, 3) int32; samples, one (V, 3) float32 in world metres for each frame so far."""

    name: str
    faces: NDArray[np.int32]
    samples: list[NDArray[np.float32]] = field(default_factory=list)


class Clip:
    """A run that grows. frames: of the whole run; done: that can be shown."""

    def __init__(self, folder: Path, started: dict[str, Any], *, frames: int, fps: float) -> None:
        self.folder, self.frames, self.fps, self.done = folder, frames, fps, 0
        self.proxies = [Proxy(str(item["name"]), _faces(folder, item)) for item in started["objects"]]
        self._time = 0.0
        self._last: float | None = None

    def read(self, done: int) -> None:
        """Take in the frames up to ``done``, which the worker has written. Raises InputError for one that is gone."""
        for proxy in self.proxies:
            cache = Pc2Reader(self.folder / f"{proxy.name}.pc2")
            for index in range(len(proxy.samples), done):
                proxy.samples.append(cache.sample(index))
        self.done = max(self.done, done)

    def frame_at(self, now: float) -> int:
        """The frame to show at ``now``, in s of any steady clock: the run over and over, never ahead of the worker."""
        elapsed = 0.0 if self._last is None else min(now - self._last, 0.25)
        self._last = now
        self._time += elapsed
        if self.done < self.frames:
            self._time = min(self._time, max(self.done - 1, 0) / self.fps)
        elif self._time > (self.frames - 1) / self.fps + LAST_FRAME_S:
            self._time = 0.0
        # A hair more, so that a time of exactly a frame is that frame.
        return min(int(self._time * self.fps + 1e-6), max(self.done - 1, 0))


def _faces(folder: Path, item: dict[str, Any]) -> NDArray[np.int32]:
    try:
        faces = np.load(folder / f"{item['name']}.faces.npy", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: {error}; switch the preview off and on") from None
    if (
        faces.ndim != 2
        or faces.shape[1] != 3
        or (len(faces) and not 0 <= faces.min() <= faces.max() < item["vertices"])
    ):
        raise InputError(f"{folder}: faces of {item['name']} are damaged; switch the preview off and on")
    return np.ascontiguousarray(faces, dtype=np.int32)
