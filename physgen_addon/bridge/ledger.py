# SPDX-License-Identifier: GPL-3.0-or-later
"""``frames.json``: which frame was made from what, so that nothing is rendered twice. Needs no bpy."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...sim.app.bake_inputs import file_hash
from ...sim.atomic import write_json
from ...sim.errors import InputError
from ...sim.scene.json_fields import read_json

LEDGER_FILE = "frames.json"
FORMAT = "physgen-frames/1"
FRAME_NAME = re.compile(r"(\d{4,})\.(?:png|exr)")


def frame_name(number: int, suffix: str = ".png") -> str:
    """File name of frame ``number``."""
    return f"{number:04d}{suffix}"


def recorded_fps(folder: Path) -> float | None:
    """Frames a second that the ledger of ``folder`` says; None when there is no such ledger, or it does not say."""
    try:
        data: Any = read_json(folder / LEDGER_FILE)
    except InputError:
        return None
    fps = data.get("fps") if isinstance(data, dict) and data.get("format") == FORMAT else None
    if isinstance(fps, bool) or not isinstance(fps, int | float):
        return None
    return float(fps) if 0 < fps < math.inf else None


class Ledger:
    """The frames of one folder. A frame counts only while its file is, byte for byte, the one that was written."""

    def __init__(self, folder: Path, *, suffix: str = ".png", fps: float | None = None) -> None:
        """Open the ledger of ``folder``, or begin one, for frames that end in ``suffix`` and are shown at ``fps``.

        Raises InputError when the folder holds frames of some other origin, so that they are never overwritten, or of
        the other suffix, so that old ones are never taken for new ones.
        """
        self.folder = folder
        self._suffix, self._fps = suffix, recorded_fps(folder) if fps is None else fps
        self._entries: dict[str, dict[str, str]] = {}
        self._video: dict[str, str] = {}
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; name a folder for the frames")
        path = folder / LEDGER_FILE
        if path.is_file():
            self._entries, self._video = _entries(path)
        present = [p for p in folder.iterdir() if FRAME_NAME.fullmatch(p.name)] if folder.is_dir() else []
        if present and not path.is_file():
            raise InputError(f"{folder}: holds frames but no {LEDGER_FILE}; choose an empty or new folder")
        other = next((p for p in present if p.suffix != suffix), None)
        if other is not None:
            raise InputError(f"{folder}: holds frames as {other.name}; choose another folder for {suffix} files")

    def path(self, number: int) -> Path:
        """Where frame ``number`` is or will be."""
        return self.folder / frame_name(number, self._suffix)

    def is_complete(self, number: int, inputs: str) -> bool:
        """Whether frame ``number`` is there, whole, and made from ``inputs``."""
        entry = self._entries.get(frame_name(number, self._suffix))
        return entry is not None and entry["inputs"] == inputs and self._intact(frame_name(number, self._suffix))

    def find(self, inputs: str) -> Path | None:
        """A whole frame made from ``inputs``, whatever its number."""
        for name, entry in self._entries.items():
            if entry["inputs"] == inputs and self._intact(name):
                return self.folder / name
        return None

    def record(self, number: int, inputs: str) -> None:
        """Note that frame ``number``, now on disk, was made from ``inputs``."""
        self._entries[frame_name(number, self._suffix)] = {"inputs": inputs, "file": file_hash(self.path(number))}
        self._write()

    def has_video(self, video: Path, frames: Sequence[Path], fps: float) -> bool:
        """Whether ``video`` is there, whole, and the last one encoded from ``frames`` as they are now."""
        return (
            self._video.get("inputs") == _video_inputs(video, frames, fps)
            and video.is_file()
            and file_hash(video) == self._video.get("file")
        )

    def record_video(self, video: Path, frames: Sequence[Path], fps: float) -> None:
        """Note that ``video``, now on disk, was encoded from ``frames``."""
        self._video = {"inputs": _video_inputs(video, frames, fps), "file": file_hash(video)}
        self._write()

    def _write(self) -> None:
        frames = dict(sorted(self._entries.items()))
        content = {"format": FORMAT, "fps": self._fps, "frames": frames, "video": self._video}
        write_json(self.folder / LEDGER_FILE, content)

    def _intact(self, name: str) -> bool:
        path = self.folder / name
        return path.is_file() and file_hash(path) == self._entries[name]["file"]


def _video_inputs(video: Path, frames: Sequence[Path], fps: float) -> str:
    digest = hashlib.sha256(f"{video.resolve()} {fps!r}".encode())
    for path in frames:
        digest.update(file_hash(path).encode())
    return digest.hexdigest()


def _entries(path: Path) -> tuple[dict[str, dict[str, str]], dict[str, str]]:
    """Entries of the frames and of the video; none when damaged, because both can be made again."""
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
