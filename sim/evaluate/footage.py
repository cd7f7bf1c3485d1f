# SPDX-License-Identifier: MIT
"""Videos and folders of pictures as streams of frames, of bounded size, and at another frame rate."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..diagnose.track.video_file import MAX_SIDE, Video, VideoInfo
from ..errors import InputError
from ..files import shown
from ..srgb import read_rgb
from ..validation import require_range

Frame = NDArray[np.uint8]
"""(H, W, 3), 8 bits, blue, green, red, as OpenCV has it."""

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
USUAL_FPS = 24.0
"""Assumed frame rate of a folder of pictures."""
MOST_FRAMES = 20_000
STAMPED = 600
"""Frames whose times are looked at first; of a video that is even so far, the rest is not."""
UNEVEN = 1.0
"""Frames by which a time may be off an even rate: times are rounded, and cameras jitter."""
SAME_RATE = 0.002
"""Rates that differ by less than this share are taken for the same: 29.97 and 30."""

_NUMBER = re.compile(r"(\d+)(?!.*\d)")


@dataclass(frozen=True, kw_only=True)
class Footage:
    """A video file or a folder of pictures in the order of their numbers.

    path: where it is. width, height: of a frame in pixels. fps: frames per second. pictures: of a folder, else empty.
    shown: of a file of uneven frame rate, the number of the file's frame that a player shows at each time, rising;
    else empty. notices: what was assumed.
    """

    path: Path
    width: int
    height: int
    fps: float
    pictures: tuple[Path, ...] = ()
    shown: tuple[int, ...] = ()
    notices: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the file or folder."""
        return self.path.name

    def frames(self, most: int = MOST_FRAMES) -> Iterator[Frame]:
        """Yield the frames (H, W, 3) from the first, ``most`` at most, one in memory at a time.

        Raises InputError for a frame of another size, or one that cannot be read.
        """
        for index, frame in enumerate(self._pictures(most) if self.pictures else self._file(most)):
            if frame.shape[:2] != (self.height, self.width):
                which = self.pictures[index].name if self.pictures else f"frame {index + 1}"
                raise InputError(
                    f"{shown(self.path)}: {which} has {frame.shape[1]}x{frame.shape[0]} pixels and earlier frames "
                    f"{self.width}x{self.height}; give a video of one size"
                )
            yield frame

    def count(self, most: int = MOST_FRAMES) -> int:
        """Return how many frames can be read, ``most`` at most: containers are not to be believed."""
        if self.pictures:
            return min(len(self.pictures), most)
        if self.shown:
            return min(len(self.shown), most)
        return sum(1 for _ in self._file(most))

    def _file(self, most: int) -> Iterator[Frame]:
        with Video(self.path) as video:
            if not self.shown:
                for frame in video.frames(0, most - 1):
                    yield frame.colour
                return
            wanted = self.shown[:most]
            times = np.bincount(wanted)
            for frame in video.frames(0, wanted[-1]):
                for _ in range(times[frame.index]):
                    yield frame.colour

    def _pictures(self, most: int) -> Iterator[Frame]:
        for path in self.pictures[:most]:
            yield np.ascontiguousarray(read_rgb(path)[..., ::-1])


def open_footage(path: Path, fps: float | None = None) -> Footage:
    """Return the video file or folder of pictures ``path``, looked at but not read.

    fps: frames per second of a folder of pictures, whose files do not say, or instead of what a video file says;
    0.01 to 1000. Raises InputError for what is no video, an empty folder, or a rate out of range.
    """
    require_range("fps", fps, 0.01, 1000.0, "frames per second")
    if path.is_dir():
        return _folder(path, fps)
    with Video(path) as video:
        info = video.info
        # What opens need not decode.
        first = next(video.frames(0, 0), None)
        if first is None:
            raise InputError(f"{shown(path)}: no frame of it can be read; convert it to MP4 (H.264)")
        times = [first.time, *video.times(STAMPED)] if fps is None else []
        if _uneven(times) and len(times) > STAMPED:
            times += video.times(MOST_FRAMES - len(times))
    if fps is None and _uneven(times):
        return _at_even_times(path, info, np.array(times))
    if fps is None and info.fps <= 0:
        raise InputError(f"{shown(path)}: does not say its frame rate; give --fps")
    return Footage(path=path, width=info.width, height=info.height, fps=fps or info.fps)


def _uneven(times: list[float]) -> bool:
    """Return whether ``times`` (N,) in seconds rise and are off even ones by more than ``UNEVEN`` frames."""
    steps = np.diff(times)
    if len(steps) < 2 or not np.isfinite(steps).all() or (steps <= 1e-6).any():
        return False
    even = np.linspace(times[0], times[-1], len(times))
    return bool(np.abs(np.array(times) - even).max() > UNEVEN * steps.mean())


def _at_even_times(path: Path, info: VideoInfo, times: NDArray[np.float64]) -> Footage:
    """Return the video of uneven frame rate at its usual one: at each even time the frame that a player shows."""
    step = float(np.median(np.diff(times)))
    count = min(MOST_FRAMES, 1 + int((times[-1] - times[0]) / step + 0.5))
    # A quarter of a step: stamps are rounded.
    shown_then = np.searchsorted(times - times[0], np.arange(count) * step + step / 4, side="right") - 1
    left_out = len(times) - len(np.unique(shown_then))
    notice = (
        f"{path.name}: its frame rate is uneven; it is taken at {1 / step:.4g} frames per second as a player shows it, "
        f"{count - len(np.unique(shown_then))} frames repeated and {left_out} left out"
    )
    return Footage(
        path=path,
        width=info.width,
        height=info.height,
        fps=1 / step,
        shown=tuple(shown_then.tolist()),
        notices=(notice,),
    )


def _folder(path: Path, fps: float | None) -> Footage:
    found = sorted((p for p in path.iterdir() if p.suffix.lower() in PICTURES), key=_order)
    found = [p for p in found if not p.name.startswith(".")]
    if not found:
        raise InputError(f"{shown(path)}: holds no pictures ({', '.join(PICTURES)}); name a video or its frames")
    if len(found) > MOST_FRAMES:
        raise InputError(f"{shown(path)}: holds {len(found)} pictures; give {MOST_FRAMES} at most")
    first = read_rgb(found[0])
    height, width = first.shape[:2]
    if max(width, height) > MAX_SIDE:
        raise InputError(f"{shown(found[0])}: is {width}x{height} pixels; give pictures up to {MAX_SIDE} a side")
    said = () if fps else (f"{path.name}: pictures do not say their frame rate; taken as {USUAL_FPS:g} (--fps)",)
    notices = (*said, *_gaps(path, found))
    return Footage(path=path, width=width, height=height, fps=fps or USUAL_FPS, pictures=tuple(found), notices=notices)


def _order(path: Path) -> tuple[int, str]:
    """Return the last number in the name, then the name: 9.png comes before 10.png."""
    found = _NUMBER.search(path.stem[:200])
    return (int(found[1]) if found else 0, path.name)


def _gaps(folder: Path, found: list[Path]) -> tuple[str, ...]:
    """Return a notice where numbers are missing between the first picture and the last."""
    numbers = [_order(path)[0] for path in found if _NUMBER.search(path.stem[:200])]
    if len(numbers) < len(found) or len(set(numbers)) < len(numbers):
        return ()
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    what = "1 frame is" if missing == 1 else f"{missing} frames are"
    return (f"{folder.name}: {what} missing between {found[0].name} and {found[-1].name}",) * bool(missing)


def at_rate(footage: Footage, fps: float, most: int) -> Iterator[Frame]:
    """Yield the frames of ``footage`` at ``fps``, ``most`` at most: blends of the two nearest, as Physics-IQ has them.

    Of the n frames that the time takes m = ⌊n fps / its rate⌋ are made; frame j lies at j (n - 1)/(m - 1), so that the
    first and the last are the video's own. The same rate gives the frames themselves.
    """
    if abs(footage.fps - fps) <= SAME_RATE * fps:
        yield from footage.frames(most)
        return
    source = max(1, footage.count(min(MOST_FRAMES, math.ceil(most / fps * footage.fps))))
    made = min(most, int(source / footage.fps * fps + 1e-6))
    frames = footage.frames(source)
    held, at = next(frames), 0
    following = next(frames, held)
    for j in range(made):
        place = j * (source - 1) / max(made - 1, 1)
        while at < int(place):
            held, following, at = following, next(frames, following), at + 1
        share = place - at
        blend = (1 - share) * held.astype(np.float32) + share * following.astype(np.float32)
        yield blend.astype(np.uint8)


def reduced(frame: Frame, side: int) -> Frame:
    """Return ``frame`` with no side longer than ``side`` pixels, averaged over areas; itself where it is not longer."""
    height, width = frame.shape[:2]
    longest = max(height, width)
    if longest <= side:
        return frame
    size = max(1, round(width * side / longest)), max(1, round(height * side / longest))
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
