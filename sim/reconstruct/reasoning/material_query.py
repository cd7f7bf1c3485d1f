# SPDX-License-Identifier: MIT
"""Query a vision-language model about the objects in a photo (PhysGen3D, supplement A.3)."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...events import IsCancelled, never
from .answer_parser import Answers, read_answer
from .chat_client import ChatRequest, complete_chat

_OWN_NAME = re.compile(r"object_\d+\Z")

MAX_HINT = 60
"""Largest length of a name in the question."""

_QUESTIONS = """\
The photo shows {count} marked with a coloured outline and a number. Judge the physics of each one, and of the surface \
on which they stand. Rough figures are fine; always give your best guess.

Write one line for each numbered object, in order, with six entries separated by commas:
number, name, density, stiffness, size, filling

- number: the one written on the photo.
- name: what it is, in one word; join words with an underscore.
- density: kg/m³, a plain number. Mass over volume of the whole object with what is inside; but where you answer no \
for filling, of the matter of its wall.
- stiffness: soft, medium or hard. soft: plush, foam, cloth, anything that a finger squeezes easily. medium: rubber, \
fruit, soft plastic. hard: wood, metal, glass, ceramics, hard plastic. This stands for Young's modulus.
- size: its longest extent in metres in reality, a plain number.
- filling: yes if there is matter throughout its inside, no if it is a thin shell around air.

Then write one last line with a single number from 0 to 1: how rough the supporting surface is, 0 for polished like \
ice, 1 for coarse like sandpaper.

Write nothing else: no heading, no units, no ranges, no thousands separators, no explanation. \
An answer for a photo of two objects looks like this:
1, camera_model, 200, soft, 0.15, yes
2, camera, 2700, hard, 0.20, no
0.2
"""


def prompt(names: Sequence[str | None]) -> str:
    """Return the question about as many objects as there are ``names``, mentioning informative ones.

    None, "" and automatic names (object_1) are not informative. Names are cut to one line of ``MAX_HINT`` characters.
    """
    count = len(names)
    text = _QUESTIONS.format(count="one object" if count == 1 else f"{count} objects, each")
    hints = [f"{number}: {hint}" for number, name in enumerate(names, start=1) if (hint := _hint(name))]
    if hints:
        text += "\nWhat the photographer calls them (use it to know what they are): " + "; ".join(hints) + "\n"
    return text


def _hint(name: str | None) -> str:
    plain = " ".join("".join(c if c.isalnum() or c in "-_'" else " " for c in name or "").split())
    return "" if _OWN_NAME.match(plain) else plain[:MAX_HINT].strip()


LONGEST_SIDE = 1024
"""Longest side of the picture that is sent, in pixels."""

JPEG_QUALITY = 90
COLOURS = ((255, 64, 64), (64, 160, 255), (64, 220, 64), (255, 200, 0), (220, 80, 255), (0, 220, 220))
"""sRGB of the outlines, in turn: distinct from each other, and with a dark seam visible on any photo."""

_FONT = cv2.FONT_HERSHEY_SIMPLEX


def marked_picture(pixels: NDArray[np.uint8], masks: Sequence[NDArray[np.bool_]]) -> NDArray[np.uint8]:
    """Return a copy of ``pixels`` (H, W, 3) sRGB with the outline and number of each of the ``masks`` (H, W).

    Numbers count from 1 in the order of ``masks``. The copy's longer side is at most ``LONGEST_SIDE``. A number is
    placed inside its outline if it hides little of the object, else beside it. Raises InputError if sizes differ.
    """
    for number, mask in enumerate(masks, start=1):
        if mask.shape != pixels.shape[:2]:
            raise InputError(f"mask of object {number} is {mask.shape!r}: give one of the photo's {pixels.shape[:2]!r}")
    scale = min(1.0, LONGEST_SIDE / max(pixels.shape[:2]))
    height, width = (max(1, round(side * scale)) for side in pixels.shape[:2])
    picture = np.array(pixels, dtype=np.uint8)
    if scale < 1.0:
        picture = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    line = max(1, round(max(height, width) / 500))
    small: list[NDArray[np.uint8]] = [
        np.asarray(cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        for mask in masks
    ]
    any_object = np.asarray(np.any(small, axis=0), dtype=np.uint8)
    for index, shape in enumerate(small):
        outlines, _ = cv2.findContours(shape, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, outlines, -1, (0, 0, 0), line + 2, cv2.LINE_AA)
        cv2.drawContours(picture, outlines, -1, COLOURS[index % len(COLOURS)], line, cv2.LINE_AA)
    taken = np.zeros((height, width), dtype=np.uint8)
    for index, shape in enumerate(small):
        _write_number(picture, shape, taken, any_object, index)
    return picture


def jpeg_bytes(picture: NDArray[np.uint8]) -> bytes:
    """Return the sRGB ``picture`` (H, W, 3) as a JPEG file, without metadata."""
    good, data = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not good:
        raise InputError(f"photo of {picture.shape!r}: cannot be written as JPEG")
    return bytes(data.tobytes())


def _write_number(
    picture: NDArray[np.uint8],
    mask: NDArray[np.uint8],
    taken: NDArray[np.uint8],
    any_mask: NDArray[np.uint8],
    index: int,
) -> None:
    """Draw the number of object ``index`` into ``picture`` and mark its area in ``taken``."""
    if not mask.any():
        return
    height, width = mask.shape
    text, size, thickness = str(index + 1), max(height, width) / 1000.0, max(1, round(max(height, width) / 500))
    (wide, high), _ = cv2.getTextSize(text, _FONT, size, thickness)
    half_w, half_h = wide // 2 + 4, high // 2 + 4
    centre = _place(mask, taken, any_mask, half_w, half_h)
    low, top = (centre[0] - half_w, centre[1] - half_h), (centre[0] + half_w, centre[1] + half_h)
    cv2.rectangle(picture, low, top, (255, 255, 255), -1)
    cv2.rectangle(picture, low, top, COLOURS[index % len(COLOURS)], max(1, thickness // 2))
    corner = (centre[0] - wide // 2, centre[1] + high // 2)
    cv2.putText(picture, text, corner, _FONT, size, (0, 0, 0), thickness, cv2.LINE_AA)
    cv2.rectangle(taken, low, top, 1, -1)


def _place(
    mask: NDArray[np.uint8], taken: NDArray[np.uint8], any_mask: NDArray[np.uint8], half_w: int, half_h: int
) -> tuple[int, int]:
    """Centre pixel (x, y) of a number of half size ``half_w``, ``half_h``."""
    height, width = mask.shape
    # A border of zeros: the photo's border bounds the interior.
    inside = cv2.distanceTransform(cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0), cv2.DIST_L2, 5)
    inside = inside[1:-1, 1:-1] * (taken == 0)
    y, x = np.unravel_index(int(np.argmax(inside)), inside.shape)
    if inside[y, x] >= 2.5 * max(half_w, half_h):
        return int(x), int(y)
    left, top, wide, high = cv2.boundingRect(mask)
    ring = [
        (left + wide // 2, top - half_h - 2),
        (left - half_w - 2, top + high // 2),
        (left + wide + half_w + 2, top + high // 2),
        (left + wide // 2, top + high + half_h + 2),
        (left - half_w - 2, top - half_h - 2),
        (left + wide + half_w + 2, top - half_h - 2),
        (left + wide // 2, top + high // 2),
    ]
    spots = [
        (min(max(x, half_w), max(half_w, width - 1 - half_w)), min(max(y, half_h), max(half_h, height - 1 - half_h)))
        for x, y in ring
    ]

    def hidden(spot: tuple[int, int]) -> int:
        window = np.s_[max(0, spot[1] - half_h) : spot[1] + half_h, max(0, spot[0] - half_w) : spot[0] + half_w]
        return int(any_mask[window].sum()) + 100 * int(taken[window].sum())

    return min(spots, key=hidden)


def query_materials(
    pixels: NDArray[np.uint8],
    masks: Sequence[NDArray[np.bool_]],
    names: Sequence[str | None],
    request: ChatRequest,
    notice: Callable[[str], None],
    cancelled: IsCancelled = never,
) -> Answers:
    """Ask ``request.model`` about the objects with the ``masks`` (H, W) in ``pixels`` (H, W, 3) uint8 sRGB.

    Sent are the photo, scaled down to 1024 pixels, with numbered outlines, and a question that mentions the user's
    ``names``. ``notice`` receives the recipient, and everything in the answer that could not be read. Raises InputError
    if no answer arrives, and Cancelled.
    """
    if not masks or len(masks) != len(names):
        raise InputError(f"masks: {len(masks)} for {len(names)} names; give one for each object, at least one")
    picture = marked_picture(pixels, masks)
    jpeg = jpeg_bytes(picture)
    height, width = picture.shape[:2]
    notice(
        f"photo goes to {request.address} (model {request.model}): {width}x{height} pixels, {len(jpeg) >> 10} KiB, "
        f"with {len(masks)} outlines"
    )
    answers = read_answer(complete_chat(request, prompt(names), jpeg, notice, cancelled), len(masks))
    for complaint in answers.unread:
        notice(f"answer of {request.model}: {complaint}")
    if not any(item.readable for item in answers.objects) and answers.roughness is None:
        start = " ".join("".join(c if c.isprintable() else " " for c in answers.raw[:400]).split())[:160]
        notice(f"answer of {request.model}: none of it can be used; it begins {start!r}")
    return answers
