# SPDX-License-Identifier: GPL-3.0-or-later
"""What a user chooses about rendering. Needs no bpy, so that a form can be filled in before Blender is loaded.

Each field carries what the command line says of it; ``batch/render_arguments.py`` makes the flags of it, and an option
is added here alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ...sim.errors import InputError
from .formats import COMPRESSIONS, FRAME_KINDS, FrameFormat

ENGINES = ("cycles",)


def option(default: Any, text: str, *, metavar: str | None = None, choices: tuple[str, ...] | None = None) -> Any:
    """A field of ``RenderOptions`` with what ``--help`` says of it."""
    return field(default=default, metadata={"help": text, "metavar": metavar, "choices": choices})


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How frames are rendered.

    engine: render engine; ``cycles``.
    samples: rays and light samples a pixel, 1 to 4096.
    scale: width of the frames over the photo's, above 0 to 4.
    light_scale: resolution in which light is computed over the frames', above 0 to 1; outlines and colours are not
        affected. None takes half, and less for large frames, down to a quarter.
    crop: render only where objects and shadows can be seen; off renders whole frames, which look the same.
    denoise: use OpenImageDenoise where Blender has it.
    seed: of the sampling pattern, the same for all frames, so that what stands still does not flicker.
    threads: CPU threads, 0 for all; it changes nothing in the picture.
    format, bits, compression: of the frames' files, as ``formats.FrameFormat`` has them.
    """

    engine: str = option("cycles", "render engine", choices=ENGINES)
    samples: int = option(16, "rays and light samples a pixel", metavar="N")
    scale: float = option(1.0, "of the photo's resolution", metavar="F")
    light_scale: float | None = option(None, "resolution of light over the frames' (default: by size)", metavar="F")
    crop: bool = option(True, "render only where something can be seen")
    denoise: bool = option(True, "denoise light where Blender can")
    seed: int = 0
    threads: int = option(0, "CPU threads, 0 for all", metavar="N")
    format: str = option("png", "of the frames; exr-layers has all layers in parts", choices=tuple(FRAME_KINDS))
    bits: int | None = option(None, "a channel: PNG 8 or 16, EXR 16 or 32 (default: 8 and 16)", metavar="N")
    compression: str = option("zip", "of EXR frames", choices=COMPRESSIONS)

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise InputError(f"engine is {self.engine!r}: choose one of {', '.join(ENGINES)}")
        if not 1 <= self.samples <= 4096:
            raise InputError(f"samples is {self.samples}: give 1 to 4096")
        if not 0 < self.scale <= 4:
            raise InputError(f"scale is {self.scale}: give a number above 0 and up to 4")
        if self.light_scale is not None and not 0 < self.light_scale <= 1:
            raise InputError(f"light_scale is {self.light_scale}: give a number above 0 and up to 1")
        if not 0 <= self.threads <= 1024:
            raise InputError(f"threads is {self.threads}: give 0 (all) to 1024")
        if not 0 <= self.seed < 2**31:
            raise InputError(f"seed is {self.seed}: give 0 to 2147483647")
        _ = self.frame_format

    @property
    def frame_format(self) -> FrameFormat:
        """How frames are written. Raises InputError for what does not go together."""
        return FrameFormat(kind=self.format, bits=self.bits, compression=self.compression)

    def light_scale_for(self, longest_side: int) -> float:
        """Resolution of light over that of frames whose longest side has so many pixels."""
        if self.light_scale is not None:
            return self.light_scale
        return min(0.5, max(0.25, 400 / longest_side))
