# SPDX-License-Identifier: GPL-3.0-or-later
"""PNG frames → H.264 MP4 with Blender's own FFmpeg, colours unchanged."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import bpy
import numpy as np
from PIL import Image

from ...sim.atomic import replacing
from ...sim.errors import InputError, RenderError
from ...sim.events import OnEvent, ignore
from . import compat


def encode(frames: Sequence[Path], video: Path, *, fps: float, on_event: OnEvent = ignore) -> None:
    """Write ``frames``, in order and of one size, as ``video`` at ``fps`` frames a second, whole or not at all.

    Odd widths and heights, which H.264 with subsampled colour cannot hold, gain a repeated last column or row.
    Raises InputError for frames or a name that cannot be used, RenderError when encoding fails.
    """
    if not frames:
        raise InputError(f"{video}: there are no frames to encode; render some first")
    if video.suffix.lower() != ".mp4":
        raise InputError(f"{video}: give the video a name that ends in .mp4")
    if not bpy.app.build_options.codec_ffmpeg:
        raise RenderError(f"Blender {bpy.app.version_string} was built without FFmpeg; encode the frames otherwise")
    total = len(frames)
    on_event({"event": "progress", "stage": "encode", "done": 0, "total": total, "eta_s": None})
    with tempfile.TemporaryDirectory(prefix="physgen-video-") as folder:
        staged = _staged(frames, Path(folder))
        with replacing(video) as partial:
            _encode(staged, partial.resolve(), fps)
    on_event({"event": "progress", "stage": "encode", "done": total, "total": total, "eta_s": 0.0})


def _staged(frames: Sequence[Path], folder: Path) -> list[Path]:
    """The frames, consecutively numbered and of even size, in one folder."""
    staged, size = [], None
    for index, path in enumerate(frames, start=1):
        try:
            with Image.open(path) as image:
                pixels = np.asarray(image.convert("RGB"))
        except OSError as error:
            raise InputError(f"{path}: not a readable frame ({error}); render it again") from error
        size = size or pixels.shape
        if pixels.shape != size:
            raise InputError(f"{path}: is {pixels.shape[1]}×{pixels.shape[0]}, others are {size[1]}×{size[0]}")
        height, width = pixels.shape[:2]
        even = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        staged.append(folder / f"{index:06d}.png")
        Image.fromarray(even).save(staged[-1], compress_level=1)
    return staged


def _encode(frames: list[Path], video: Path, fps: float) -> None:
    scene = bpy.data.scenes.new("PhysGen video")
    try:
        with Image.open(frames[0]) as image:
            width, height = image.size
        render = scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
        rate = Fraction(fps).limit_denominator(1001)
        base = max(1, rate.denominator)
        render.fps, render.fps_base = (rate.numerator, float(base)) if rate.numerator <= 32767 else (round(fps), 1.0)
        render.use_sequencer, render.use_compositing, render.use_border = True, False, False
        render.use_file_extension = False
        scene.frame_start, scene.frame_end = 1, len(frames)
        # The pixels are finished; any view transform or look would change them.
        scene.view_settings.view_transform = "Standard"
        scene.view_settings.look = "None"
        scene.sequencer_colorspace_settings.name = "sRGB"
        strip = compat.strips(scene).new_image(
            name="frames", filepath=str(frames[0]), channel=1, frame_start=1, fit_method="ORIGINAL"
        )
        for path in frames[1:]:
            strip.elements.append(path.name)
        compat.set_video(render.image_settings)
        ffmpeg = render.ffmpeg
        ffmpeg.format, ffmpeg.codec = "MPEG4", "H264"
        ffmpeg.constant_rate_factor, ffmpeg.ffmpeg_preset = "HIGH", "GOOD"
        ffmpeg.gopsize, ffmpeg.audio_codec = 12, "NONE"
        render.filepath = str(video)
        try:
            with compat.active_scene(scene):
                bpy.ops.render.render(animation=True, scene=scene.name)
        except RuntimeError as error:
            raise RenderError(f"{video}: Blender could not encode it: {error}") from error
        if not video.is_file() or video.stat().st_size == 0:
            raise RenderError(f"{video}: Blender wrote no video; its log has the reason")
    finally:
        bpy.data.scenes.remove(scene)
