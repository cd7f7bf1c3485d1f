# SPDX-License-Identifier: MIT
"""Frames of a video file, one at a time, each with its time. OpenCV decodes (FFmpeg inside)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError

Grey = NDArray[np.uint8]

MAX_SIDE = 16384
"""Pixels; a file that claims more is damaged or made to fill the memory."""


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """What the container says. fps: 0 if it says nothing; frames: 0 if it says nothing, and not to be relied on."""

    width: int
    height: int
    fps: float
    frames: int


@dataclass(frozen=True, kw_only=True)
class Frame:
    """index: in the file, from 0. time: s, by the container, NaN if it has none. grey: (H, W) 8 bits; colour: BGR."""

    index: int
    time: float
    grey: Grey
    colour: NDArray[np.uint8]


class Video:
    """An open video. A context manager; ``frames`` reads it once from its beginning."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path}: there is no such video; check the path")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty; copy the video again")
        self._path = path
        self._source = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._source.isOpened():
            raise InputError(f"{path}: is not a video that can be read; convert it to MP4 (H.264) or AVI (MJPEG)")
        get = self._source.get
        width, height = int(get(cv2.CAP_PROP_FRAME_WIDTH)), int(get(cv2.CAP_PROP_FRAME_HEIGHT))
        if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
            self._source.release()
            raise InputError(f"{path}: has frames of {width}x{height} pixels; give a video up to {MAX_SIDE} a side")
        fps, count = float(get(cv2.CAP_PROP_FPS)), float(get(cv2.CAP_PROP_FRAME_COUNT))
        self.info = VideoInfo(
            width=width,
            height=height,
            fps=fps if np.isfinite(fps) and 0 < fps <= 1e5 else 0.0,
            frames=int(count) if np.isfinite(count) and 0 < count < 1e9 else 0,
        )

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.release()

    def frames(self, start: int, end: int | None) -> Iterator[Frame]:
        """Frames ``start`` to ``end`` (included; None: to the last that can be decoded). One is held at a time.

        Frames before ``start`` are decoded and dropped: seeking by frame number is off in many files.
        """
        index = 0
        while end is None or index <= end:
            if not self._source.grab():
                return
            time = float(self._source.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0
            if index >= start:
                found, colour = self._source.retrieve()
                if not found or colour is None or colour.size == 0:
                    return
                if colour.ndim == 2:
                    colour = cv2.cvtColor(colour, cv2.COLOR_GRAY2BGR)
                if colour.shape[:2] != (self.info.height, self.info.width):
                    raise InputError(
                        f"{self._path}: frame {index} is {colour.shape[1]}x{colour.shape[0]} pixels and earlier ones "
                        f"{self.info.width}x{self.info.height}; give a video of one size"
                    )
                grey = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
                yield Frame(index=index, time=time, grey=np.asarray(grey, np.uint8), colour=np.asarray(colour))
            index += 1


def frame_times(
    path: Path, stamps: list[float], info: VideoInfo, fps_override: float | None
) -> tuple[NDArray[np.float64], str | None]:
    """Seconds since the first frame of ``stamps`` (T,), and a warning or None.

    The container's own times where they rise from frame to frame, so that a variable frame rate is kept; else evenly
    by its frame rate. Raises InputError where neither is there.
    """
    count = len(stamps)
    if fps_override is not None:
        return np.arange(count) / fps_override, None
    times = np.asarray(stamps, dtype=np.float64)
    steps = np.diff(times)
    if np.isfinite(times).all() and (steps > 1e-6).all():
        return times - times[0], None
    if info.fps <= 0:
        raise InputError(
            f"{path}: says neither when its frames were taken nor how many there are a second: give --fps-override"
        )
    return (
        np.arange(count) / info.fps,
        f"{path.name}: the times of its frames do not rise; taken as even, {info.fps:g} frames a second",
    )
