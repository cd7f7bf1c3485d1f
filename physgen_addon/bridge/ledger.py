# SPDX-License-Identifier: GPL-3.0-or-later
"""``frames.json``: which frame was made from what, so that nothing is rendered twice. Needs no bpy."""

from __future__ import annotations

import hashlib
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


def frame_name(number: int) -> str:
    """File name of frame ``number``."""
    return f"{number:04d}.png"


class Ledger:
    """The frames of one folder. A frame counts only while its file is, byte for byte, the one that was written."""

    def __init__(self, folder: Path) -> None:
        """Open the ledger of ``folder``, or begin one.

        Raises InputError when the folder holds frames of some other origin, so that they are never overwritten.
        """
        self.folder = folder
        self._entries: dict[str, dict[str, str]] = {}
        self._video: dict[str, str] = {}
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: is a file; name a folder for the frames")
        path = folder / LEDGER_FILE
        if path.is_file():
            self._entries, self._video = _entries(path)
        elif folder.is_dir() and any(re.fullmatch(r"\d{4,}\.png", p.name) for p in folder.iterdir()):
            raise InputError(f"{folder}: holds frames but no {LEDGER_FILE}; choose an empty or new folder")

    def path(self, number: int) -> Path:
        """Where frame ``number`` is or will be."""
        return self.folder / frame_name(number)

    def is_complete(self, number: int, inputs: str) -> bool:
        """Whether frame ``number`` is there, whole, and made from ``inputs``."""
        entry = self._entries.get(frame_name(number))
        return entry is not None and entry["inputs"] == inputs and self._intact(frame_name(number))

    def find(self, inputs: str) -> Path | None:
        """A whole frame made from ``inputs``, whatever its number."""
        for name, entry in self._entries.items():
            if entry["inputs"] == inputs and self._intact(name):
                return self.folder / name
        return None

    def record(self, number: int, inputs: str) -> None:
        """Note that frame ``number``, now on disk, was made from ``inputs``."""
        self._entries[frame_name(number)] = {"inputs": inputs, "file": file_hash(self.path(number))}
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
        write_json(self.folder / LEDGER_FILE, {"format": FORMAT, "frames": frames, "video": self._video})

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
        if re.fullmatch(r"\d{4,}\.png", name) and isinstance(entry, dict) and {"inputs", "file"} <= entry.keys()
    }
    return entries, video
