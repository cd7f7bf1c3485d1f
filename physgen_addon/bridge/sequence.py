# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of one or several folders as one sequence, in the order of their numbers. Needs no bpy."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...sim.errors import InputError
from .frame_range import parse_range
from .ledger import FRAME_NAME, recorded_fps

MOST_NAMED = 5
"""Missing frames that a message lists."""


@dataclass(frozen=True)
class FrameSequence:
    """Frames ``numbers`` (ascending) at ``paths``; ``fps`` as their folders know it, None where they do not."""

    numbers: tuple[int, ...]
    paths: tuple[Path, ...]
    fps: float | None

    @property
    def own_fps(self) -> float | None:
        """Frames a second at which things move at their own speed; None where ``fps`` is."""
        return None if self.fps is None else own_fps(self.numbers, self.fps)


def own_fps(numbers: Sequence[int], fps: float) -> float:
    """Frames a second of the frames ``numbers`` of a clip of ``fps``: with every other one missing, half as many."""
    steps = {after - before for before, after in itertools.pairwise(numbers)}
    return fps / steps.pop() if len(steps) == 1 else fps


def gather(folders: Sequence[Path], *, frames: str | None = None, allow_gaps: bool = False) -> FrameSequence:
    """The frames of ``folders`` (chunks of one clip) whose numbers are in the range ``frames``, None for all.

    Raises InputError for a folder without frames, a number that is there twice, a number that is missing unless
    ``allow_gaps``, and folders of different frame rates.
    """
    found: dict[int, Path] = {}
    for folder in folders:
        here = _numbered(folder)
        for number, path in sorted(here.items()):
            if number in found:
                raise InputError(f"frame {number} is there twice, {found[number]} and {path}; name folders of one clip")
            found[number] = path
    first, last = min(found), max(found)
    wanted = parse_range(frames, first, last, there="rendered; render the others")
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
