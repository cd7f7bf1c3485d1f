# SPDX-License-Identifier: GPL-3.0-or-later
"""Forms in which frames and videos are kept. Needs neither bpy nor an image library."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from ...sim.errors import InputError

FRAME_KINDS = {"png": (8, 16), "exr": (16, 32), "exr-layers": (16, 32)}
"""Kind of frame → bits a channel of colour, the usual number first. 16 bits are whole numbers in PNG, half in EXR."""

COMPRESSIONS = ("zip", "dwaa", "none")

VIDEO_CODECS = {".mp4": ("MPEG4", "H264"), ".webm": ("WEBM", "WEBM")}
"""Suffix → container and codec as Blender names them; its WEBM is VP9."""

SHEET_SUFFIXES = (".png", ".webp")
"""Of an animated contact sheet."""


@dataclass(frozen=True, kw_only=True)
class FrameFormat:
    """How frames are written.

    kind: ``png`` (the finished picture, sRGB), ``exr`` (the same in linear light) or ``exr-layers`` (that and what it
        was made of, a part each, with depth, object ids and optical flow).
    bits: a channel of colour: 8 or 16 of PNG, 16 or 32 of EXR; None for 8 and 16. Depth, ids and flow have 32.
    compression: of EXR: ``zip``, ``dwaa`` (smaller, colours a little changed, for the eye alone) or ``none``.
    """

    kind: str = "png"
    bits: int | None = None
    compression: str = "zip"

    def __post_init__(self) -> None:
        if self.kind not in FRAME_KINDS:
            raise InputError(f"format is {self.kind!r}: choose one of {', '.join(FRAME_KINDS)}")
        if self.bits is not None and self.bits not in FRAME_KINDS[self.kind]:
            known = " or ".join(map(str, FRAME_KINDS[self.kind]))
            raise InputError(f"bits is {self.bits}: give {known} for {self.kind} frames")
        if self.compression not in COMPRESSIONS:
            raise InputError(f"compression is {self.compression!r}: choose one of {', '.join(COMPRESSIONS)}")

    @property
    def depth(self) -> int:
        """Bits a channel of colour."""
        return self.bits or FRAME_KINDS[self.kind][0]

    @property
    def suffix(self) -> str:
        """Of the frames' names."""
        return ".png" if self.kind == "png" else ".exr"

    @property
    def layered(self) -> bool:
        """Whether depth, object ids and flow are wanted."""
        return self.kind == "exr-layers"


def require_video_name(path: Path) -> None:
    """Raise InputError for a video whose name ends in no suffix that can be encoded, or is a folder's."""
    if path.suffix.lower() not in VIDEO_CODECS or path.is_dir():
        raise InputError(f"video {path}: give a file name that ends in {' or '.join(VIDEO_CODECS)}")


def exact_rate(fps: float) -> Fraction:
    """Frames a second as a fraction; television's 23.976, 29.97 and 59.94 are 24000, 30000 and 60000 / 1001."""
    television = Fraction(round(fps) * 1000, 1001)
    return television if abs(fps - television) < 1e-3 else Fraction(fps).limit_denominator(1001)
