# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames → an animated contact sheet: a clip at one glance, as PNG (APNG) or WebP. Needs no bpy.

Its first image is an ordinary contact sheet of stills at equal intervals. After a pause each still plays up to the next
one's time, all at once and in real time; after another pause all start again. So every frame is in the file once, which
keeps it small, and a viewer without animation shows the stills.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ...sim import srgb
from ...sim.atomic import replacing
from ...sim.errors import Cancelled, InputError
from ...sim.events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..render.render_options import SHEET_SUFFIXES
from .frame_files import read_picture

GAP_PX = 4
PAPER = (24, 24, 24)
PAUSE_MS = 900
"""Duration of the stills, and of the last images."""
WEBP_QUALITY = 80

Picture = NDArray[np.uint8]


def write_contact_sheet(
    frames: Sequence[Path],
    numbers: Sequence[int],
    sheet: Path,
    *,
    fps: float,
    columns: int = 3,
    rows: int = 2,
    width: int = 960,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> None:
    """Write ``frames``, of one size, with frame ``numbers``, as ``sheet``: .png (lossless) or .webp (a tenth of the
    size).

    columns, rows: of stills, 1 to 20 each; fewer if there are fewer frames. width: of the sheet in pixels, 64 to 8192;
    frames are never enlarged.
    Raises InputError for values out of range, unusable frames and a file that cannot be written, Cancelled when
    cancelled.
    """
    if sheet.suffix.lower() not in SHEET_SUFFIXES:
        raise InputError(f"{sheet}: give the contact sheet a name that ends in {' or '.join(SHEET_SUFFIXES)}")
    if not (1 <= columns <= 20 and 1 <= rows <= 20):
        raise InputError(f"tiles is {columns}x{rows}: give 1x1 to 20x20")
    if not 64 <= width <= 8192:
        raise InputError(f"width is {width}: give 64 to 8192 pixels")
    if not frames:
        raise InputError(f"{sheet}: there are no frames to show; render some first")
    order = played(len(frames), min(columns * rows, len(frames)))
    columns = min(columns, len(frames))
    progress = StageProgress(on_event, "encode", len(frames))
    tile_width = (width - (columns - 1) * GAP_PX) // columns
    tiles = _Tiles(frames, numbers, tile_width, progress, cancelled)
    times = [round(1000 / fps)] * len(order)
    times[0] = times[-1] = PAUSE_MS
    sheets = (_sheet([tiles[frame] for frame in step], columns) for step in order)
    with replacing(sheet) as partial:
        if sheet.suffix.lower() == ".png":
            first, *others = _changes(sheets)
            first.save(partial, save_all=True, append_images=others, duration=times, loop=0, disposal=0, blend=1)
        else:
            first, *others = (Image.fromarray(picture) for picture in sheets)
            first.save(partial, save_all=True, append_images=others, duration=times, loop=0, quality=WEBP_QUALITY)
    progress.report(len(frames))


def played(frames: int, tiles: int) -> list[list[int]]:
    """Return the frame index that each of ``tiles`` shows, one list per image of the animation.

    Tile k begins at k / tiles of the clip and ends where tile k + 1 begins.
    """
    starts = np.round(np.linspace(0, frames - 1, tiles + 1)).astype(int)
    steps = int(np.diff(starts).max())
    ways = [np.round(np.linspace(a, b, steps + 1)).astype(int) for a, b in itertools.pairwise(starts)]
    return [[int(way[step]) for way in ways] for step in range(steps + 1)]


class _Tiles:
    """Labelled frames at tile size, read on demand."""

    def __init__(
        self,
        frames: Sequence[Path],
        numbers: Sequence[int],
        width: int,
        progress: StageProgress,
        cancelled: IsCancelled,
    ) -> None:
        self._frames, self._numbers, self._width = frames, numbers, width
        self._progress, self._cancelled = progress, cancelled
        self._size: tuple[int, ...] | None = None
        self._known: dict[int, Picture] = {}

    def __getitem__(self, index: int) -> Picture:
        if index not in self._known:
            if self._cancelled():
                raise Cancelled("encoding cancelled; no contact sheet was written")
            self._known[index] = self._read(index)
            self._progress.report(len(self._known) - 1)
        return self._known[index]

    def _read(self, index: int) -> Picture:
        pixels = read_picture(self._frames[index])
        self._size = self._size or pixels.shape
        if pixels.shape != self._size:
            raise InputError(
                f"{self._frames[index]}: is {pixels.shape[1]}×{pixels.shape[0]}, others are "
                f"{self._size[1]}×{self._size[0]}"
            )
        height, width = pixels.shape[:2]
        small = min(self._width, width)
        reduced = srgb.resized(srgb.bytes_to_linear(pixels), small, max(1, round(height * small / width)))
        return _labelled(srgb.linear_to_bytes(reduced), str(self._numbers[index]))


def _labelled(pixels: Picture, text: str) -> Picture:
    image = Image.fromarray(pixels)
    size = max(10, min(20, image.width // 16))
    draw, font = ImageDraw.Draw(image, "RGBA"), ImageFont.load_default(size)
    left, top, right, bottom = draw.textbbox((0, 0), text, font=font)
    margin = size // 3
    x, y = 0, image.height - (bottom - top) - 2 * margin
    draw.rectangle((x, y, x + right - left + 2 * margin, image.height), fill=(0, 0, 0, 150))
    draw.text((x + margin - left, y + margin - top), text, font=font, fill=(255, 255, 255, 255))
    return np.asarray(image)


def _sheet(tiles: Sequence[Picture], columns: int) -> Picture:
    height, width = tiles[0].shape[:2]
    rows = -(-len(tiles) // columns)
    paper = np.empty((rows * (height + GAP_PX) - GAP_PX, columns * (width + GAP_PX) - GAP_PX, 3), np.uint8)
    paper[:] = PAPER
    for index, tile in enumerate(tiles):
        y, x = index // columns * (height + GAP_PX), index % columns * (width + GAP_PX)
        paper[y : y + height, x : x + width] = tile
    return paper


def _changes(sheets: Iterator[Picture]) -> Iterator[Image.Image]:
    """Yield each sheet with holes where it equals the previous one, so that a static background costs nothing."""
    before: Picture | None = None
    for sheet in sheets:
        alpha = np.full(sheet.shape[:2], 255, np.uint8)
        shown = sheet
        if before is not None:
            alpha[(sheet == before).all(axis=-1)] = 0
            shown = np.where(alpha[..., None] > 0, sheet, 0)
        before = sheet
        yield Image.fromarray(np.dstack([shown, alpha]))
