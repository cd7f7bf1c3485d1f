# SPDX-License-Identifier: MIT
"""What a user may say about tracking."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """How points are chosen, followed and given up. Pixels are those of the video.

    density: points sought on each object at a time, 6 to 500.
    min_contrast: grey levels per pixel, 0.1 to 50; root mean square gradient of a patch along its weakest direction,
        below which it is no corner. Twice what the frame's noise alone gives is required as well.
    min_score: 0.3 to 0.99; zero-mean normalised correlation of a patch with its first sight, warped to the present
        view, below which the point counts as occluded.
    max_round_trip_px: 0.1 to 10; distance by which a point followed to the next frame and back may miss its start.
    rigid_tolerance_px: 0.2 to 50; least distance from the object's fitted pose at which a point counts as an outlier.
        Where the mesh fits the object badly more is allowed, with a warning.
    """

    density: int = 40
    min_contrast: float = 2.0
    min_score: float = 0.7
    max_round_trip_px: float = 1.0
    rigid_tolerance_px: float = 1.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("density", 6, 500),
            ("min_contrast", 0.1, 50.0),
            ("min_score", 0.3, 0.99),
            ("max_round_trip_px", 0.1, 10.0),
            ("rigid_tolerance_px", 0.2, 50.0),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"{name} is {value!r}: give {low:g} to {high:g}")


@dataclass(frozen=True, kw_only=True)
class Take:
    """One video and which part of it counts.

    start_frame, end_frame: frames of the file from 0, both included; None: the last.
    fps_override: frames a second at which the scene was really filmed, 1 to 100000, where the file is played slower or
        has wrong times; None: the file's own times.
    predict_from: s after the start frame from which on the motion is withheld and to be predicted; None: nothing is.
    """

    path: Path
    name: str = ""
    start_frame: int = 0
    end_frame: int | None = None
    fps_override: float | None = None
    predict_from: float | None = None

    def __post_init__(self) -> None:
        where = f"{self.path}"
        if self.start_frame < 0:
            raise InputError(f"{where}: start_frame is {self.start_frame}: frames count from 0")
        if self.end_frame is not None and self.end_frame < self.start_frame + 2:
            raise InputError(
                f"{where}: end_frame is {self.end_frame}: a motion needs 3 frames, so give at least "
                f"{self.start_frame + 2}"
            )
        fps = self.fps_override
        if fps is not None and not (math.isfinite(fps) and 1 <= fps <= 1e5):
            raise InputError(f"{where}: fps_override is {fps!r}: give 1 to 100000 frames a second")
        if self.predict_from is not None and not (math.isfinite(self.predict_from) and self.predict_from > 0):
            raise InputError(f"{where}: predict_from is {self.predict_from!r}: give seconds above 0")

    @property
    def trial_name(self) -> str:
        """``name``, or else the file's name without its suffix."""
        return self.name or self.path.stem
