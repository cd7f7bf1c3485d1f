# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames → MP4 (H.264) or WebM (VP9) with Blender's own FFmpeg, colours unchanged.

Blender converts with the BT.709 matrix to limited range (16 to 235), and tags both in the file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import bpy
import cv2
import numpy as np
from PIL import Image

from ...sim.atomic import replacing, scratch_prefix
from ...sim.errors import Cancelled, InputError, RenderError
from ...sim.events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...sim.files import name_for_ffmpeg
from .. import compat
from ..render.render_options import VIDEO_CODECS, exact_rate, require_video_name
from .frame_files import read_picture


def encode_video(
    frames: Sequence[Path],
    video: Path,
    *,
    fps: float,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> None:
    """Write ``frames`` (PNG or EXR), in order and of one size, as ``video`` at ``fps`` frames a second.

    The suffix of ``video``, .mp4 or .webm, selects the format. The file is written atomically. Odd widths and heights,
    impossible with subsampled colour, gain a repeated last column or row.
    Raises InputError for unusable frames or names, RenderError if encoding fails, Cancelled when cancelled.
    """
    if not frames:
        raise InputError(f"{video}: there are no frames to encode; render some first")
    require_video_name(video)
    if not bpy.app.build_options.codec_ffmpeg:
        raise RenderError(f"Blender {bpy.app.version_string} was built without FFmpeg; encode the frames otherwise")
    progress = StageProgress(on_event, "encode", len(frames))
    progress.report(0)
    with tempfile.TemporaryDirectory(prefix=scratch_prefix("video")) as folder:
        staged = _staged(frames, Path(folder), cancelled)
        with replacing(video) as partial:
            _encode(staged, _plainly_named(partial.resolve(), Path(folder)), fps, progress)
            # Blender does not report a full disk.
            found = _count(partial)
            if found != len(frames):
                message = f"only {found} of {len(frames)} frames are in the file; free space, then encode again"
                raise RenderError(f"{video}: {message}")


def _plainly_named(video: Path, folder: Path) -> Path:
    """Return a link to ``video`` in ``folder``: Blender puts frame numbers in place of ``#`` in the name that it
    writes to, and values in place of ``{…}``. Where there are no links, ``video`` itself."""
    link = folder / f"video{video.suffix}"
    try:
        link.symlink_to(video)
    except OSError:
        return video
    return link


def _count(video: Path) -> int:
    """Return the number of frames readable from ``video``, 0 if it is no video."""
    capture = cv2.VideoCapture(name_for_ffmpeg(video), cv2.CAP_FFMPEG)
    try:
        count = 0
        while capture.grab():
            count += 1
        return count
    finally:
        capture.release()


def _staged(frames: Sequence[Path], folder: Path, cancelled: IsCancelled) -> list[Path]:
    """Write the frames, consecutively numbered and of even size, to one folder."""
    staged, size = [], None
    for index, path in enumerate(frames, start=1):
        if cancelled():
            raise Cancelled("encoding cancelled; no video was written")
        pixels = read_picture(path)
        size = size or pixels.shape
        if pixels.shape != size:
            raise InputError(f"{path}: is {pixels.shape[1]}×{pixels.shape[0]}, others are {size[1]}×{size[0]}")
        height, width = pixels.shape[:2]
        even = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        staged.append(folder / f"{index:06d}.png")
        Image.fromarray(even).save(staged[-1], compress_level=1)
    return staged


_TRACK_UID, _TAG_TRACK_UID = b"\x73\xc5\x88", b"\x63\xc5\x88"
"""Matroska's elements of a track's number and of what refers to it, with their length of 8 bytes (RFC 9559)."""
_HEADER_BYTES = 4096


def _name_tracks_evenly(video: Path) -> None:
    """Give the one track of a WebM file the number 1: FFmpeg draws one at random, and equal frames would give different
    files.
    """
    content = video.read_bytes()
    at = content.find(_TRACK_UID, 0, _HEADER_BYTES)
    if at < 0:
        return
    drawn = content[at + 3 : at + 11]
    for mark in (_TRACK_UID, _TAG_TRACK_UID):
        content = content.replace(mark + drawn, mark + (1).to_bytes(8, "big"))
    video.write_bytes(content)


def _encode(frames: list[Path], video: Path, fps: float, progress: StageProgress) -> None:
    def written(current: bpy.types.Scene, _: object) -> None:
        progress.report(current.frame_current)

    scene = bpy.data.scenes.new("PhysGen video")
    try:
        with Image.open(frames[0]) as image:
            width, height = image.size
        render = scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
        rate = exact_rate(fps)
        # Blender accepts integer rates up to 32767, over a base that need not be an integer.
        whole = rate.numerator if rate.numerator <= 32767 else round(fps)
        render.fps, render.fps_base = whole, whole / rate
        render.use_sequencer, render.use_compositing, render.use_border = True, False, False
        render.use_file_extension = False
        scene.frame_start, scene.frame_end = 1, len(frames)
        # The pixels are final; any view transform or look would change them.
        scene.view_settings.view_transform = "Standard"
        scene.view_settings.look = "None"
        scene.sequencer_colorspace_settings.name = "sRGB"
        strip = compat.strips(scene).new_image(
            name="frames", filepath=str(frames[0]), channel=1, frame_start=1, fit_method="ORIGINAL"
        )
        for path in frames[1:]:
            strip.elements.append(path.name)
        compat.set_video(render.image_settings)
        render.image_settings.color_mode = "RGB"
        ffmpeg = render.ffmpeg
        ffmpeg.format, ffmpeg.codec = VIDEO_CODECS[video.suffix.lower()]
        ffmpeg.constant_rate_factor, ffmpeg.ffmpeg_preset = "HIGH", "GOOD"
        ffmpeg.gopsize, ffmpeg.audio_codec = 12, "NONE"
        # Date, scene and the like would go into the file, and equal frames would give different videos.
        for name in dir(render):
            if name.startswith("use_stamp"):
                setattr(render, name, False)
        render.filepath = str(video)
        try:
            bpy.app.handlers.render_write.append(written)
            with compat.active_scene(scene):
                bpy.ops.render.render(animation=True, scene=scene.name)
        except RuntimeError as error:
            raise RenderError(f"{video}: Blender could not encode it: {error}") from error
        finally:
            bpy.app.handlers.render_write.remove(written)
        if not video.is_file() or video.stat().st_size == 0:
            raise RenderError(f"{video}: Blender wrote no video; its log has the reason")
        if video.suffix.lower() == ".webm":
            _name_tracks_evenly(video)
    finally:
        # Blender 4.5 crashes now and then as it removes a scene whose sequencer has just rendered: a process without
        # windows, which ends with its work, keeps it.
        if not bpy.app.background:
            bpy.data.scenes.remove(scene)
