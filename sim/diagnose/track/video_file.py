# SPDX-License-Identifier: MIT
"""A video file: its container's metadata, decoded frames and their times. OpenCV decodes the frames."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files import name_for_ffmpeg, open_file

Grey = NDArray[np.uint8]

MAX_SIDE = 16384
"""Largest side in pixels; a file that claims more is damaged or malicious."""


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """Metadata of the container. fps: 0 if unknown; frames: 0 if unknown, and not reliable.

    codec: its four letters in lower case, such as ``h264`` or ``vp90``; empty if unknown.
    """

    width: int
    height: int
    fps: float
    frames: int
    codec: str = ""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A decoded frame. index: in the file, from 0. time: s, NaN if unknown. grey: (H, W) 8 bits; colour: BGR."""

    index: int
    time: float
    grey: Grey
    colour: NDArray[np.uint8]


MAX_VIDEO_BYTES = 2**40
LOG_ERRORS = 2
"""OpenCV's level of messages that are errors: 4.x has no name for it in Python."""


def _quiet() -> None:
    """Keep OpenCV and FFmpeg from writing to the terminal what is wrong with a file: our message says it."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # In a module of its own since OpenCV 5.
    getattr(cv2.utils, "logging", cv2).setLogLevel(LOG_ERRORS)


def _letters(code: int) -> str:
    """Return the four letters of a codec's ``code``; empty unless all can be printed."""
    letters = "".join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24)).lower().strip()
    return letters if letters.isascii() and letters.isprintable() else ""


class Video:
    """An open video, a context manager; ``frames`` reads it once from its beginning."""

    def __init__(self, path: Path) -> None:
        try:
            with open_file(path, MAX_VIDEO_BYTES, what="video") as file:
                empty = not file.read(1)
        except FileNotFoundError:
            raise InputError(f"{path}: no such video; check the path") from None
        if empty:
            raise InputError(f"{path}: is empty; copy the video again")
        self._path = path
        _quiet()
        self._source = cv2.VideoCapture(name_for_ffmpeg(path), cv2.CAP_FFMPEG)
        if not self._source.isOpened():
            raise InputError(f"{path}: not a readable video; convert it to MP4 (H.264) or AVI (MJPEG)")
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
            codec=_letters(int(get(cv2.CAP_PROP_FOURCC))),
        )

    def __enter__(self) -> Video:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.release()

    def frames(self, start: int, end: int | None) -> Iterator[Frame]:
        """Yield frames ``start`` to ``end`` (inclusive; None: to the last decodable one), one in memory at a time.

        Frames before ``start`` are decoded and dropped: seeking by frame number is unreliable in many files.
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

    def times(self, most: int) -> list[float]:
        """Return the times in s of the next ``most`` frames or of those that are left, NaN if unknown."""
        found: list[float] = []
        while len(found) < most and self._source.grab():
            found.append(float(self._source.get(cv2.CAP_PROP_POS_MSEC)) / 1000.0)
        return found


def frame_times(
    path: Path, stamps: list[float], info: VideoInfo, fps_override: float | None
) -> tuple[NDArray[np.float64], str | None]:
    """Return seconds since the first frame (T,) from ``stamps`` (T,), and a warning or None.

    Uses the container's own times where they rise, so that a variable frame rate is kept, else its frame rate. Raises
    InputError without either.
    """
    count = len(stamps)
    if fps_override is not None:
        return np.arange(count) / fps_override, None
    times = np.asarray(stamps, dtype=np.float64)
    steps = np.diff(times)
    if np.isfinite(times).all() and (steps > 1e-6).all():
        return times - times[0], None
    if info.fps <= 0:
        raise InputError(f"{path}: has neither frame times nor a frame rate: give --fps-override")
    return (
        np.arange(count) / info.fps,
        f"{path.name}: its frame times do not rise; assuming even ones, {info.fps:g} frames per second",
    )
