# SPDX-License-Identifier: GPL-3.0-or-later
"""What a user chooses about rendering. Needs no bpy, so that a form can be filled in before Blender is loaded."""

from __future__ import annotations

from dataclasses import dataclass

from ...sim.errors import InputError

ENGINES = ("cycles",)


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How frames are rendered.

    engine: render engine; ``cycles``.
    samples: rays and light samples a pixel, 1 to 4096.
    scale: width of the frames over the photo's, above 0 to 4.
    light_scale: resolution in which light is computed over the frames', above 0 to 1; outlines and colours are not
        affected. None takes half, and less for large frames, down to a quarter.
    denoise: use OpenImageDenoise where Blender has it.
    seed: of the sampling pattern, the same for all frames, so that what stands still does not flicker.
    threads: CPU threads, 0 for all; it changes nothing in the picture.
    """

    engine: str = "cycles"
    samples: int = 16
    scale: float = 1.0
    light_scale: float | None = None
    denoise: bool = True
    seed: int = 0
    threads: int = 0

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

    def light_scale_for(self, longest_side: int) -> float:
        """Resolution of light over that of frames whose longest side has so many pixels."""
        if self.light_scale is not None:
            return self.light_scale
        return min(0.5, max(0.25, 400 / longest_side))
