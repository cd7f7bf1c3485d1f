# SPDX-License-Identifier: MIT
"""What a live preview is asked for, a JSON object a line. Whatever else comes in is an InputError, never a crash."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import BinaryIO

from ..errors import InputError
from ..scene.json_fields import parse

MAX_LINE = 1 << 20
"""Bytes of a request; a longer line is thrown away unread."""


@dataclass(frozen=True, kw_only=True)
class PreviewRequest:
    """A coarse run of a scene.

    id: the asker's number for it, 0 or more; every event of the run carries it.
    scene: absolute folder of the scene.
    overrides: changes to it as ``sim.scene.overrides`` reads them, such as ``cube.velocity=1,0,0``.
    frames: samples, 2 to 1000; the first is the scene at rest.
    fps: frames a second, 1 to 1000.
    particles: of all soft bodies together, 500 to 20000.
    """

    id: int
    scene: str
    overrides: tuple[str, ...] = ()
    frames: int = 48
    fps: float = 24.0
    particles: int = 2000

    def __post_init__(self) -> None:
        if self.id < 0:
            raise InputError(f"id is {self.id}: give 0 or more")
        if not 2 <= self.frames <= 1000:
            raise InputError(f"frames is {self.frames}: give 2 to 1000")
        if not (math.isfinite(self.fps) and 1 <= self.fps <= 1000):
            raise InputError(f"fps is {self.fps}: give frames a second from 1 to 1000")
        if not 500 <= self.particles <= 20_000:
            raise InputError(f"particles is {self.particles}: give 500 to 20000")


def parse_request(line: bytes) -> PreviewRequest:
    """The request on ``line``. Raises InputError that says what is wrong with it."""
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        raise InputError("request: not a line of JSON") from None
    if not isinstance(data, dict):
        raise InputError("request: expected a JSON object")
    return parse(PreviewRequest, data, "request")


def request_id(line: bytes) -> int | None:
    """The id on ``line`` as far as it can be made out, so that the asker learns which request was wrong."""
    try:
        found = json.loads(line)["id"]
    except (ValueError, RecursionError, KeyError, TypeError):
        return None
    return found if isinstance(found, int) and not isinstance(found, bool) else None


def read_line(stream: BinaryIO) -> bytes | None:
    """The next line of ``stream`` without its end; None when the stream has ended.

    Raises InputError for a line longer than ``MAX_LINE``, after having skipped it.
    """
    line = stream.readline(MAX_LINE + 1)
    if not line:
        return None
    if len(line) > MAX_LINE and not line.endswith(b"\n"):
        while True:
            rest = stream.readline(MAX_LINE)
            if not rest or rest.endswith(b"\n"):
                break
        raise InputError(f"request: longer than {MAX_LINE} bytes")
    return line.rstrip(b"\r\n")
