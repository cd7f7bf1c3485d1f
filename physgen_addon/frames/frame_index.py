# SPDX-License-Identifier: GPL-3.0-or-later
"""``frames.json``: which frame was made from which inputs; frame ranges, and folders as one sequence. Needs no bpy."""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...sim.atomic import write_json
from ...sim.checksums import DAMAGED, MISSING, OK, UNKNOWN, FileState
from ...sim.errors import InputError
from ...sim.scene.folder import file_hash
from ...sim.scene.scene_output import folder_kind
from ...sim.validation import read_json


def parse_frame_range(
    text: str | None, first: int, last: int, *, there: str = "baked; bake more or ask for fewer"
) -> list[int]:
    """Return the frame numbers of ``1-48``, ``1,5,9``, ``1-48x2`` or combinations; None is ``first`` to ``last``.

    there: description of the available frames and a remedy, for the message.
    Raises InputError for anything else, and for unavailable frames.
    """
    if text is None:
        return list(range(first, last + 1))
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+)(?:x(\d+))?)?\s*", part)
        if match is None or match[3] == "0":
            raise InputError(f"frames {text!r}: write 1-48, 1,5,9 or 1-48x2")
        start = int(match[1])
        stop = int(match[2]) if match[2] else start
        if stop < start:
            raise InputError(f"frames {text!r}: {start} comes after {stop}")
        if start < first or stop > last:
            raise InputError(f"frames {text!r}: frames {first} to {last} are {there}")
        numbers.update(range(start, stop + 1, int(match[3] or 1)))
    return sorted(numbers)


INDEX_FILE = "frames.json"
FORMAT = "physgen-frames/1"
MOST_RATE = 1e6
"""Frames per second; more were never recorded."""
FRAME_NAME = re.compile(r"(\d{4,9})\.(?:png|exr)")
"""Nine digits are more frames than any clip has, and fewer than a file system's longest name."""


def frame_name(number: int, suffix: str = ".png") -> str:
    """Return the file name of frame ``number``."""
    return f"{number:04d}{suffix}"


def folder_for(folder: Path, suffix: str) -> Path:
    """Return the folder of frames with ``suffix``: ``folder``, or ``NAME_exr`` beside it where that has others only.

    A folder keeps one format, and who changes the format should not have to choose another folder for it.
    """
    if not folder.is_dir():
        return folder
    there = {path.suffix for path in folder.iterdir() if FRAME_NAME.fullmatch(path.name)}
    return folder.with_name(f"{folder.name}_{suffix[1:]}") if there and suffix not in there else folder


def recorded_fps(folder: Path) -> float | None:
    """Return the frame rate recorded in the index of ``folder``; None without an index or rate."""
    try:
        data: Any = read_json(folder / INDEX_FILE)
    except InputError:
        return None
    fps = data.get("fps") if isinstance(data, dict) and data.get("format") == FORMAT else None
    if isinstance(fps, bool) or not isinstance(fps, int | float):
        return None
    return float(fps) if 0 < fps <= MOST_RATE else None


class FrameIndex:
    """Index of the frames of one folder. A frame is valid only while its file is, byte for byte, the one that was
    written.
    """

    def __init__(self, folder: Path, *, suffix: str = ".png", fps: float | None = None) -> None:
        """Open the index of ``folder``, or begin one, for frames with ``suffix`` shown at ``fps``.

        Raises InputError if the folder holds frames of other origin, so that they are never overwritten, or of the
        other suffix, so that old frames are never taken for new ones.
        """
        self.folder = folder
        self._suffix, self._fps = suffix, recorded_fps(folder) if fps is None else fps
        self._entries: dict[str, dict[str, str]] = {}
        self._video: dict[str, str] = {}
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; name a folder for the frames")
        path = folder / INDEX_FILE
        if path.is_file():
            self._entries, self._video = _entries(path)
        present = [p for p in folder.iterdir() if FRAME_NAME.fullmatch(p.name)] if folder.is_dir() else []
        # Frames among the files of a scene would be foreign there, and it could not be corrected again.
        made = folder_kind(folder)
        if made is not None and not path.is_file():
            raise InputError(f"{folder}: is {made}, not a folder of frames; choose an empty or new folder")
        if present and not path.is_file():
            raise InputError(f"{folder}: holds frames but no {INDEX_FILE}; choose an empty or new folder")
        other = next((p for p in present if p.suffix != suffix), None)
        if other is not None:
            raise InputError(f"{folder}: holds frames as {other.name}; choose another folder for {suffix} files")

    def begin(self) -> None:
        """Write the index where there is none, before the first frame: killed between a frame and its entry, a render
        would leave frames without an index, and the next one would refuse the folder.
        """
        if not (self.folder / INDEX_FILE).is_file():
            self._write()

    @classmethod
    def of(cls, folder: Path) -> FrameIndex:
        """Return the index of the frames that ``folder`` holds, whatever their format. Raises InputError."""
        suffixes = {path.suffix for path in folder.iterdir() if FRAME_NAME.fullmatch(path.name)}
        return cls(folder, suffix=".exr" if suffixes == {".exr"} else ".png")

    def check(self) -> list[FileState]:
        """Return the state of each frame that is recorded, or there."""
        there = {path.name for path in self.folder.iterdir() if FRAME_NAME.fullmatch(path.name)}
        found = []
        for name in sorted(there | self._entries.keys()):
            if name not in there:
                found.append(FileState(file=name, state=MISSING))
            elif name not in self._entries:
                found.append(FileState(file=name, state=UNKNOWN))
            elif self._intact(name):
                found.append(FileState(file=name, state=OK))
            else:
                found.append(FileState(file=name, state=DAMAGED, text="is not what was rendered"))
        return found

    def path(self, number: int) -> Path:
        """Return the path of frame ``number``."""
        return self.folder / frame_name(number, self._suffix)

    def is_complete(self, number: int, inputs: str) -> bool:
        """Return whether frame ``number`` exists, is intact, and was made from ``inputs``."""
        entry = self._entries.get(frame_name(number, self._suffix))
        return entry is not None and entry["inputs"] == inputs and self._intact(frame_name(number, self._suffix))

    def find(self, inputs: str) -> Path | None:
        """Return an intact frame made from ``inputs``, whatever its number, or None."""
        for name, entry in self._entries.items():
            if entry["inputs"] == inputs and self._intact(name):
                return self.folder / name
        return None

    def record(self, number: int, inputs: str) -> None:
        """Record that frame ``number``, now on disk, was made from ``inputs``."""
        self._entries[frame_name(number, self._suffix)] = {"inputs": inputs, "file": file_hash(self.path(number))}
        self._write()

    def has_video(self, video: Path, frames: Sequence[Path], fps: float) -> bool:
        """Return whether ``video`` exists, is intact, and was the last one encoded from the current ``frames``."""
        return (
            self._video.get("inputs") == _video_inputs(video, frames, fps)
            and video.is_file()
            and file_hash(video) == self._video.get("file")
        )

    def record_video(self, video: Path, frames: Sequence[Path], fps: float) -> None:
        """Record that ``video``, now on disk, was encoded from ``frames``."""
        self._video = {"inputs": _video_inputs(video, frames, fps), "file": file_hash(video)}
        self._write()

    def _write(self) -> None:
        frames = dict(sorted(self._entries.items()))
        content = {"format": FORMAT, "fps": self._fps, "frames": frames, "video": self._video}
        write_json(self.folder / INDEX_FILE, content)

    def _intact(self, name: str) -> bool:
        path = self.folder / name
        return path.is_file() and file_hash(path) == self._entries[name]["file"]


def _video_inputs(video: Path, frames: Sequence[Path], fps: float) -> str:
    digest = hashlib.sha256(f"{video.resolve()} {fps!r}".encode())
    for path in frames:
        digest.update(file_hash(path).encode())
    return digest.hexdigest()


def _entries(path: Path) -> tuple[dict[str, dict[str, str]], dict[str, str]]:
    """Return the entries of the frames and of the video; empty if damaged, because both can be recreated."""
    try:
        data: Any = read_json(path)
    except InputError:
        return {}, {}
    video = data.get("video") if isinstance(data, dict) else None
    video = {str(key): str(value) for key, value in video.items()} if isinstance(video, dict) else {}
    frames = data.get("frames") if isinstance(data, dict) and data.get("format") == FORMAT else None
    if not isinstance(frames, dict):
        return {}, video
    entries = {
        name: {"inputs": str(entry["inputs"]), "file": str(entry["file"])}
        for name, entry in frames.items()
        if FRAME_NAME.fullmatch(name) and isinstance(entry, dict) and {"inputs", "file"} <= entry.keys()
    }
    return entries, video


MOST_NAMED = 5
"""Maximum number of missing frames listed in a message."""


@dataclass(frozen=True)
class FrameSequence:
    """Frames ``numbers`` (ascending) at ``paths``; ``fps`` as recorded by their folders, else None."""

    numbers: tuple[int, ...]
    paths: tuple[Path, ...]
    fps: float | None

    @property
    def own_fps(self) -> float | None:
        """Frame rate for real-time playback; None if ``fps`` is None."""
        return None if self.fps is None else own_fps(self.numbers, self.fps)


def own_fps(numbers: Sequence[int], fps: float) -> float:
    """Return the real-time frame rate of the frames ``numbers`` of a clip of ``fps``: half of it for every
    other frame.
    """
    steps = {after - before for before, after in itertools.pairwise(numbers)}
    return fps / steps.pop() if len(steps) == 1 else fps


def gather_frames(folders: Sequence[Path], *, frames: str | None = None, allow_gaps: bool = False) -> FrameSequence:
    """Return the frames of ``folders`` (chunks of one clip) in the range ``frames``, None for all.

    Raises InputError for a folder without frames, a duplicate frame number, a missing number unless ``allow_gaps``, and
    folders of different frame rates.
    """
    found: dict[int, Path] = {}
    for folder in folders:
        here = _numbered(folder)
        for number, path in sorted(here.items()):
            if number in found:
                raise InputError(f"frame {number} is there twice, {found[number]} and {path}; name folders of one clip")
            found[number] = path
    first, last = min(found), max(found)
    wanted = parse_frame_range(frames, first, last, there="rendered; render the others")
    missing = [number for number in wanted if number not in found]
    if missing and not allow_gaps:
        listed = ", ".join(map(str, missing[:MOST_NAMED])) + (", …" if len(missing) > MOST_NAMED else "")
        raise InputError(
            f"frame{'s' if len(missing) > 1 else ''} {listed} of {first} to {last}: not in {_names(folders)}; render "
            "what is missing, choose with --frames (1-48x2), or go on without with --allow-gaps"
        )
    numbers = tuple(number for number in wanted if number in found)
    if not numbers:
        raise InputError(f"frames {frames!r}: none of them is in {_names(folders)}")
    return FrameSequence(numbers, tuple(found[number] for number in numbers), _common_fps(folders))


def _numbered(folder: Path) -> dict[int, Path]:
    try:
        names = sorted(path.name for path in folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: no folder of frames ({error.strerror or error})") from error
    here: dict[int, Path] = {}
    for name in names:
        match = FRAME_NAME.fullmatch(name)
        if match is not None:
            number = int(match[1])
            if number in here:
                raise InputError(f"{folder}: holds both {here[number].name} and {name}; move one of them away")
            here[number] = folder / name
    if not here:
        raise InputError(f"{folder}: holds no frames (0001.png or 0001.exr, …); render some first")
    return here


def _common_fps(folders: Sequence[Path]) -> float | None:
    rates = {folder: rate for folder in folders if (rate := recorded_fps(folder)) is not None}
    if len(set(rates.values())) > 1:
        (a, x), (b, y) = sorted(rates.items(), key=lambda item: item[1])[:: len(rates) - 1]
        raise InputError(f"{a} was baked at {x:g} frames a second, {b} at {y:g}; encode them apart")
    return next(iter(rates.values()), None)


def _names(folders: Sequence[Path]) -> str:
    return ", ".join(map(str, folders))
