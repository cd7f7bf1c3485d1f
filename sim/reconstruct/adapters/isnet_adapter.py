# SPDX-License-Identifier: MIT
"""Segmentation by IS-Net (Qin et al., ECCV 2022) or a similar model, from an ONNX file through onnxruntime.

Such files take a picture 1x3x1024x1024, (value - 128) / 256 of sRGB, and return opacities 1x1x1024x1024 from 0 to 1,
of what stands out in it; the first output counts. The picture is the box with a margin, since the network
expects objects with some room.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..models.model_folder import check_installed
from .onnx_session import open_session
from .protocols import Pixels

SIDE = 1024
MARGIN = 0.3
"""Of the box's longer side, added all around: closely cropped, it missed a foot and a book's white spine."""

Box = tuple[int, int, int, int]


@dataclass(frozen=True, eq=False)
class IsnetSegmenter:
    """``protocols.SoftSegmenter`` and, by its opacities alone, ``protocols.Segmenter``."""

    session: Any
    where: str

    def alpha(self, pixels: Pixels, box: Box) -> NDArray[np.float32]:
        """As the protocol says. Raises InputError where the model fails or answers nonsense."""
        height, width = pixels.shape[:2]
        x0, y0, x1, y1 = box
        margin = round(MARGIN * max(x1 - x0, y1 - y0))
        left, top = max(0, x0 - margin), max(0, y0 - margin)
        right, bottom = min(width, x1 + margin), min(height, y1 + margin)
        answer = self._answer(np.ascontiguousarray(pixels[top:bottom, left:right]))
        result = np.zeros((height, width), dtype=np.float32)
        result[y0:y1, x0:x1] = answer[y0 - top : y1 - top, x0 - left : x1 - left]
        return result

    def __call__(self, pixels: Pixels, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """As the protocol says, without the colours' refinement. Raises InputError."""
        masks = []
        for index, (x0, y0, x1, y1) in enumerate(np.asarray(boxes).round().astype(int).tolist()):
            mask = self.alpha(pixels, (x0, y0, x1, y1)) > 0.5
            if not mask.any():
                raise InputError(f"{self.where}: found nothing in box {index + 1}; draw it closer, or paint a mask")
            masks.append(mask)
        return np.stack(masks)

    def _answer(self, crop: Pixels) -> NDArray[np.float32]:
        """The network's opacities (h, w) of ``crop`` (h, w, 3)."""
        height, width = crop.shape[:2]
        way = cv2.INTER_AREA if max(height, width) > SIDE else cv2.INTER_LINEAR
        square = cv2.resize(crop, (SIDE, SIDE), interpolation=way).astype(np.float32)
        planes = np.ascontiguousarray(((square - 128.0) / 256.0).transpose(2, 0, 1)[None])
        try:
            found = np.asarray(self.session.run(None, {self.session.get_inputs()[0].name: planes})[0], dtype=np.float32)
        # onnxruntime raises its own exceptions, depending on the operator.
        except Exception as error:
            raise InputError(f"{self.where}: the model failed ({type(error).__name__}: {str(error)[:300]})") from error
        if found.shape != (1, 1, SIDE, SIDE):
            raise InputError(f"{self.where}: returned {found.shape}, expected opacities of (1, 1, {SIDE}, {SIDE})")
        if not np.isfinite(found).all() or found.min() < -0.01 or found.max() > 1.01:
            raise InputError(f"{self.where}: returned numbers that are no opacities from 0 to 1; install it again")
        way = cv2.INTER_AREA if max(height, width) < SIDE else cv2.INTER_LINEAR
        alpha = cv2.resize(np.clip(found[0, 0], 0.0, 1.0), (width, height), interpolation=way)
        return np.asarray(alpha, dtype=np.float32)


def load_isnet(path: Path, where: str) -> IsnetSegmenter:
    """Return the model in ``path``, checked to be of IS-Net's form, an installed one by its hash. Raises InputError."""
    check_installed(path, where)
    session = open_session(path, where)
    given = [(item.shape, item.type) for item in session.get_inputs()]
    if len(given) != 1 or given[0][1] != "tensor(float)" or not _fits(given[0][0]):
        found = ", ".join(f"{item.name} {item.shape} {item.type}" for item in session.get_inputs())
        raise InputError(f"{where}: takes {found[:300]}; expected a picture 1x3x{SIDE}x{SIDE} of floats")
    return IsnetSegmenter(session, where)


def _fits(shape: list[Any]) -> bool:
    # A size that the export left free is a text or None.
    wanted = (1, 3, SIDE, SIDE)
    return len(shape) == 4 and all(not isinstance(n, int) or n == w for n, w in zip(shape, wanted, strict=True))
