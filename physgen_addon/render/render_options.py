# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of rendering, file formats of frames and videos, and both as command-line flags. Needs no bpy."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

from ...sim.errors import InputError
from ...sim.validation import range_of

FRAME_KINDS = {"png": (8, 16), "exr": (16, 32), "exr-layers": (16, 32)}
"""Type of frame → bits a colour channel, default first. 16 bits are integers in PNG, half floats in EXR."""

COMPRESSIONS = ("zip", "dwaa", "none")

VIDEO_CODECS = {".mp4": ("MPEG4", "H264"), ".webm": ("WEBM", "WEBM")}
"""Suffix → container and codec as Blender names them; its WEBM is VP9."""

SHEET_SUFFIXES = (".png", ".webp")
"""Suffixes of an animated contact sheet."""


@dataclass(frozen=True, kw_only=True)
class FrameFormat:
    """File format of frames.

    kind: ``png`` (the finished image, sRGB), ``exr`` (the same in linear light) or ``exr-layers`` (that and its layers,
    a part each, with depth, object ids and optical flow).
    bits: per colour channel: 8 or 16 of PNG, 16 or 32 of EXR; None for 8 and 16. Depth, ids and flow have 32.
    compression: of EXR: ``zip``, ``dwaa`` (lossy, smaller) or ``none``.
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
        """Bits a colour channel."""
        return self.bits or FRAME_KINDS[self.kind][0]

    @property
    def suffix(self) -> str:
        """Suffix of the frames' file names."""
        return ".png" if self.kind == "png" else ".exr"

    @property
    def layered(self) -> bool:
        """Whether depth, object ids and flow are written."""
        return self.kind == "exr-layers"


def require_video_name(path: Path) -> None:
    """Raise InputError if ``path`` has no suffix of a video format, or is a folder."""
    if path.suffix.lower() not in VIDEO_CODECS or path.is_dir():
        raise InputError(f"video {path}: give a file name that ends in {' or '.join(VIDEO_CODECS)}")


def exact_rate(fps: float) -> Fraction:
    """Return the frame rate as a fraction; 23.976, 29.97 and 59.94 are 24000, 30000 and 60000 / 1001."""
    television = Fraction(round(fps) * 1000, 1001)
    return television if abs(fps - television) < 1e-3 else Fraction(fps).limit_denominator(1001)


ENGINES = ("cycles", "eevee")
DEVICES = ("cpu", "auto", "optix", "cuda", "hip", "oneapi", "metal")


def option(
    default: Any,
    text: str,
    *,
    metavar: str | None = None,
    choices: tuple[str, ...] | None = None,
    limits: tuple[float, float] = (-math.inf, math.inf),
    unit: str = "a number",
) -> Any:
    """Return a field of ``RenderOptions`` with its ``--help`` text, range and unit."""
    return field(
        default=default, metadata={"help": text, "metavar": metavar, "choices": choices, "range": limits, "unit": unit}
    )


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Options of rendering.

    engine: render engine; ``cycles`` traces rays, ``eevee`` rasterises on the graphics card.
    device: where Cycles renders; ``auto`` selects a graphics card if there is one; unavailable devices fall back to the
    CPU. It affects nothing but noise.
    samples: rays and light samples per pixel, 1 to 4096.
    scale: width of the frames over the photo's, above 0 to 4.
    light_scale: resolution of light over the frames', above 0 to 1; outlines and colours are not affected. None: half,
    and less for large frames, down to a quarter.
    crop: render only where objects and shadows can be visible; whole frames look the same.
    denoise: use OpenImageDenoise if Blender has it; Cycles only.
    seed: of the sampling pattern, the same for all frames, so that static parts do not flicker.
    threads: CPU threads, 0 for all; does not affect the image.
    format, bits, compression: of the frames' files, see ``FrameFormat``.
    camera: file of a camera path (docs/rendering.md); None keeps the photo's camera. Alternatively, a smooth move over
    all baked frames, away from the photo's camera:
    orbit, rise: degrees around the objects, to the right and upwards. dolly: relative change of the distance.

    Matching the photo (docs/rendering.md):

    motion_blur: shutter time before each frame, over the frame interval, 0 (off) to 1.
    grain: add the photo's grain where it is missing.
    match_sharpness: match outlines of moved objects to the photo's sharpness.
    f_number: aperture of a lens on a sensor 36 mm wide, 0.5 to 64, for depth of field. None: off.
    focus_distance: metres along the optical axis to the plane of focus, above 0; None: each object is in focus at rest.
    reflections: mirror the objects in a ground whose ``reflectivity`` is above 0.
    sun_angle: apparent diameter of the sun in radians, 0 (hard shadows) to pi; None: the scene's.
    """

    engine: str = option("cycles", "render engine", choices=ENGINES)
    device: str = option("cpu", "Cycles device; falls back to cpu", choices=DEVICES)
    samples: int = option(16, "samples per pixel", metavar="N", limits=(1, 4096))
    scale: float = option(1.0, "scale of the photo's resolution", metavar="F", limits=(0.0, 4.0))
    light_scale: float | None = option(
        None, "resolution of light layers relative to the frames (default: by size)", metavar="F"
    )
    crop: bool = option(True, "render only regions that can change")
    denoise: bool = option(True, "denoise light if Blender can")
    seed: int = 0
    threads: int = option(0, "CPU threads, 0 for all", metavar="N")
    format: str = option(
        "png", "file format of frames; exr-layers is multi-part with all layers", choices=tuple(FRAME_KINDS)
    )
    bits: int | None = option(None, "bits per channel: PNG 8 or 16, EXR 16 or 32 (default: 8 and 16)", metavar="N")
    compression: str = option("zip", "compression of EXR frames", choices=COMPRESSIONS)
    camera: str | None = option(None, "camera path: a physgen-camera/1 file", metavar="FILE")
    orbit: float = option(0.0, "camera orbit around the objects to the right, over the clip", metavar="DEGREES")
    rise: float = option(0.0, "camera rise around the objects, over the clip", metavar="DEGREES")
    dolly: float = option(0.0, "relative change of the camera's distance over the clip; -0.1 approaches", metavar="F")
    motion_blur: float = option(0.5, "shutter time over the frame interval; 0 for none", metavar="F", limits=(0.0, 1.0))
    grain: bool = option(True, "add the photo's grain where it is missing")
    match_sharpness: bool = option(True, "match outlines of moved objects to the photo's sharpness")
    f_number: float | None = option(
        None, "depth of field: aperture at 36 mm sensor width", metavar="N", limits=(0.5, 64.0)
    )
    focus_distance: float | None = option(
        None,
        "distance of the plane of focus (default: objects at rest)",
        metavar="M",
        limits=(0.0, math.inf),
        unit="metres",
    )
    reflections: bool = option(True, "mirror objects in a reflective ground")
    sun_angle: float | None = option(
        None, "the sun's diameter, 0 for hard shadows (default: as in the scene)", metavar="RAD"
    )

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise InputError(f"engine is {self.engine!r}: choose one of {', '.join(ENGINES)}")
        if self.device not in DEVICES:
            raise InputError(f"device is {self.device!r}: choose one of {', '.join(DEVICES)}")
        for name in ("samples", "motion_blur", "f_number"):
            low, high = range_of(RenderOptions, name)
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"{name} is {value}: give {low:g} to {high:g}")
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
        if self.focus_distance is not None and not 0 < self.focus_distance < math.inf:
            raise InputError(f"focus_distance is {self.focus_distance}: give metres above 0, or leave it out")
        if self.sun_angle is not None and not 0 <= self.sun_angle <= math.pi:
            raise InputError(f"sun_angle is {self.sun_angle}: give 0 to pi radians, or leave it out")
        _ = self.frame_format

    @property
    def frame_format(self) -> FrameFormat:
        """File format of frames. Raises InputError for invalid combinations."""
        return FrameFormat(kind=self.format, bits=self.bits, compression=self.compression)

    def light_scale_for(self, longest_side: int) -> float:
        """Return the relative resolution of light for frames with that longest side in pixels."""
        if self.light_scale is not None:
            return self.light_scale
        return min(0.5, max(0.25, 400 / longest_side))


def flagged_fields() -> Iterator[tuple[dataclasses.Field[Any], str, type]]:
    """Yield every option that has a flag, with that flag and its type (of ``float | None``, float)."""
    hints = typing.get_type_hints(RenderOptions)
    for item in dataclasses.fields(RenderOptions):
        kind = hints[item.name]
        if isinstance(kind, types.UnionType):
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        if "help" in item.metadata:
            yield item, f"--{item.name.replace('_', '-')}", kind


def render_arguments(options: RenderOptions) -> list[str]:
    """Return the flags for ``options``, without defaults."""
    arguments = []
    for item, flag, kind in flagged_fields():
        value = getattr(options, item.name)
        if value == item.default:
            continue
        if kind is bool:
            arguments.append(flag if value else f"--no-{flag[2:]}")
        else:
            # One word, so that a negative number is not parsed as a flag.
            arguments.append(f"{flag}={value!r}" if kind is not str else f"{flag}={value}")
    return arguments
