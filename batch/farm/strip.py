# SPDX-License-Identifier: GPL-3.0-or-later
"""A few frames of a variant side by side, as one small picture."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from ...physgen_addon.bridge.frame_file import read_picture
from ...sim.atomic import replacing
from ...sim.errors import InputError

MOST_FRAMES = 6
HEIGHT = 132
GAP = 3


def make_strip(frames: Sequence[Path], out: Path) -> bool:
    """Write some of ``frames``, evenly chosen, into the JPEG ``out``, unless the same are in it already.

    Frames that are not there or cannot be read are left out; False when none can.
    """
    there = [path for path in frames if path.is_file()]
    count = min(MOST_FRAMES, len(there))
    chosen = [there[round(i * (len(there) - 1) / max(1, count - 1))] for i in range(count)]
    if not chosen:
        return False
    stamp = _stamp(chosen)
    if _stamp_of(out) == stamp:
        return True
    pictures = [picture for path in chosen if (picture := _small(path)) is not None]
    if not pictures:
        return False
    width = sum(p.width for p in pictures) + GAP * (len(pictures) - 1)
    strip = Image.new("RGB", (width, HEIGHT), (128, 128, 128))
    x = 0
    for picture in pictures:
        strip.paste(picture, (x, 0))
        x += picture.width + GAP
    try:
        with replacing(out) as partial:
            strip.save(partial, "JPEG", quality=84, comment=stamp)
    except (InputError, ValueError):
        return False
    return True


def _small(path: Path) -> Image.Image | None:
    try:
        image = Image.fromarray(read_picture(path))
    except InputError:
        return None
    width = max(1, round(image.width * HEIGHT / image.height))
    return image.resize((min(width, 4 * HEIGHT), HEIGHT), Image.Resampling.LANCZOS)


def _stamp(paths: Sequence[Path]) -> bytes:
    states = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in paths]
    return hashlib.sha256(repr(states).encode()).hexdigest()[:16].encode()


def _stamp_of(path: Path) -> bytes | None:
    try:
        with Image.open(path) as image:
            comment = image.info.get("comment")
            return comment if isinstance(comment, bytes) else None
    except (OSError, ValueError, SyntaxError):
        return None
