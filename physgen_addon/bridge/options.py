# SPDX-License-Identifier: GPL-3.0-or-later
"""What a user chooses about rendering. Needs no bpy, so that a form can be filled in before Blender is loaded.

Each field carries what the command line says of it: ``batch/render_arguments.py`` makes its flag of that, and
``props/rendering.py`` its tooltip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from ...sim.errors import InputError
from .formats import COMPRESSIONS, FRAME_KINDS, FrameFormat

ENGINES = ("cycles", "eevee")
DEVICES = ("cpu", "auto", "optix", "cuda", "hip", "oneapi", "metal")


def option(default: Any, text: str, *, metavar: str | None = None, choices: tuple[str, ...] | None = None) -> Any:
    """A field of ``RenderOptions`` with what ``--help`` says of it."""
    return field(default=default, metadata={"help": text, "metavar": metavar, "choices": choices})


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """How frames are rendered.

    engine: render engine; ``cycles`` traces rays, ``eevee`` draws with the graphics card.
    device: where Cycles renders; ``auto`` takes a graphics card if there is one. What is not there falls back to the
        CPU. It changes nothing in the picture but noise.
    samples: rays and light samples a pixel, 1 to 4096.
    scale: width of the frames over the photo's, above 0 to 4.
    light_scale: resolution in which light is computed over the frames', above 0 to 1; outlines and colours are not
        affected. None takes half, and less for large frames, down to a quarter.
    crop: render only where objects and shadows can be seen; off renders whole frames, which look the same.
    denoise: use OpenImageDenoise where Blender has it; Cycles only.
    seed: of the sampling pattern, the same for all frames, so that what stands still does not flicker.
    threads: CPU threads, 0 for all; it changes nothing in the picture.
    format, bits, compression: of the frames' files, as ``formats.FrameFormat`` has them.
    camera: a file of the camera's path (docs/camera.md); None leaves it where the photo was taken. In its place,
        one smooth move over all baked frames, from the photo's camera to the one that these say:
    orbit, rise: degrees around the objects, to the right and upwards. dolly: change of the distance over it.

    What makes things belong to the photo (docs/rendering.md); each can be switched off:

    motion_blur: how long the shutter is open before each frame, over the frame interval, 0 (off) to 1.
    grain: give what lacks the photo's noise as much of it as is missing.
    match_sharpness: make the outlines of what has moved as soft as the photo's own.
    f_number: aperture of a lens on a sensor 36 mm wide, 0.5 to 64; blurs what leaves the plane of focus. None: off.
    focus_distance: metres along the view to the plane of focus, above 0; None: each object is in focus where it rests.
    reflections: mirror the objects in a ground whose ``reflectivity`` is above 0.
    sun_angle: apparent diameter of the sun in radians, 0 (hard shadows) to pi; None takes the scene's.
    """

    engine: str = option("cycles", "render engine", choices=ENGINES)
    device: str = option("cpu", "where Cycles renders; falls back to cpu", choices=DEVICES)
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
    camera: str | None = option(None, "path of the camera: a physgen-camera/1 file", metavar="FILE")
    orbit: float = option(0.0, "the camera goes around the objects to the right, over the clip", metavar="DEGREES")
    rise: float = option(0.0, "the camera rises around the objects, over the clip", metavar="DEGREES")
    dolly: float = option(0.0, "the camera's distance changes by this share, over the clip; -0.1 nears", metavar="F")
    motion_blur: float = option(0.5, "time the shutter is open, of a frame; 0 for none", metavar="F")
    grain: bool = option(True, "give what lacks the photo's grain the missing part")
    match_sharpness: bool = option(True, "outlines of what moves as soft as the photo's")
    f_number: float | None = option(None, "blur what leaves the plane of focus: aperture at 36 mm width", metavar="N")
    focus_distance: float | None = option(None, "plane of focus (default: where things rest)", metavar="M")
    reflections: bool = option(True, "mirror objects in a ground that is reflective")
    sun_angle: float | None = option(
        None, "the sun's diameter, 0 for hard shadows (default: as in the scene)", metavar="RAD"
    )

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise InputError(f"engine is {self.engine!r}: choose one of {', '.join(ENGINES)}")
        if self.device not in DEVICES:
            raise InputError(f"device is {self.device!r}: choose one of {', '.join(DEVICES)}")
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
        for name, value, most in (("orbit", self.orbit, 30.0), ("rise", self.rise, 30.0), ("dolly", self.dolly, 0.3)):
            if not -most <= value <= most:
                raise InputError(f"{name} is {value}: give {-most:g} to {most:g}")
            if self.camera is not None and value:
                raise InputError(f"camera {self.camera!r} and {name}: give a camera file, or a simple move")
        if not 0 <= self.motion_blur <= 1:
            raise InputError(f"motion_blur is {self.motion_blur}: give 0 (off) to 1, the whole frame interval")
        if self.f_number is not None and not 0.5 <= self.f_number <= 64:
            raise InputError(f"f_number is {self.f_number}: give 0.5 to 64, or leave it out")
        if self.focus_distance is not None and not 0 < self.focus_distance < math.inf:
            raise InputError(f"focus_distance is {self.focus_distance}: give metres above 0, or leave it out")
        if self.sun_angle is not None and not 0 <= self.sun_angle <= math.pi:
            raise InputError(f"sun_angle is {self.sun_angle}: give 0 to pi radians, or leave it out")
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
