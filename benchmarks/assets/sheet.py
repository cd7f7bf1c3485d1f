# SPDX-License-Identifier: MIT
"""A contact sheet for people: an asset a row, the truth, the start, and what each method made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

SIDE, LABEL = 192, 18
"""Pixels of a picture's side, and of the line of words above it."""

Picture = NDArray[np.floating]
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """One asset. Pictures are (H, W, 3) sRGB, 0 to 1; None leaves a place empty."""

    title: str
    truth: Picture
    start: Picture
    methods: Mapping[str, Picture | None]
    """By the method's name, in the order in which they are shown; every line has the same."""

    captions: Mapping[str, str] = field(default_factory=dict)
    """What stands above a method's picture behind its name, such as its PSNR."""


def contact_sheet(lines: Sequence[Line], path: Path) -> None:
    """Write the rows of ``lines`` as one PNG."""
    Image.fromarray(np.concatenate([_row(line) for line in lines])).save(path)


def _row(line: Line) -> Pixels:
    shown: list[tuple[str, Picture | None]] = [(line.title, line.truth), ("start", line.start)]
    shown += [(f"{name}  {line.captions.get(name, '')}".rstrip(), picture) for name, picture in line.methods.items()]
    return np.concatenate([_labelled(words, picture) for words, picture in shown], axis=1)


def _labelled(words: str, picture: Picture | None) -> Pixels:
    """(LABEL + SIDE, SIDE, 3): ``words`` above ``picture``."""
    tile = np.full((LABEL + SIDE, SIDE, 3), 255, np.uint8)
    cv2.putText(tile, words[:34], (5, LABEL - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (60, 60, 60), 1, cv2.LINE_AA)
    if picture is not None:
        height, width = picture.shape[:2]
        scale = SIDE / max(height, width)
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        size = (round(width * scale), round(height * scale))
        small = cv2.resize(np.asarray(picture, np.float32), size, interpolation=method)
        top, left = LABEL + (SIDE - size[1]) // 2, (SIDE - size[0]) // 2
        tile[top : top + size[1], left : left + size[0]] = np.rint(np.clip(small, 0, 1) * 255)
    tile[:, -1] = tile[-1] = 225
    return tile
