# SPDX-License-Identifier: MIT
"""Segmentation by SAM or SAM 2 and depth by Depth Anything or Depth Pro, through ``transformers``, from a local folder.

The folder is one that ``save_pretrained`` wrote: config.json and .safetensors weights. Nothing is downloaded, nothing
is unpickled, and no code from the folder runs. Pictures are prepared here as the models' own processors do it, which
need further packages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...gaussians.guidance.pretrained_models import (
    import_library,
    library_errors,
    load_model,
    package_version,
    read_json,
)
from .protocols import Depth, Pixels, checked_depth

INSTALL = "pip install 'physgen[models]'"
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
HALF = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
"""Mean and standard deviation of the colours that a network was trained with, 0 to 1."""

CLASSES = {
    "sam": ("SamModel", ("sam",)),
    "sam2": ("Sam2Model", ("sam2", "sam2_video")),
    "depth-anything": ("DepthAnythingForDepthEstimation", ("depth_anything",)),
    "depth-pro": ("DepthProForDepthEstimation", ("depth_pro",)),
}
"""Kind → class of transformers, and the ``model_type`` of its configurations."""
DEPTH_SIDE, DEPTH_STEP = 518, 14
"""Depth Anything's shorter side, and what both sides are multiples of."""
LEAST = 0.002
"""Share of the box below which a mask is taken for nonsense."""


@dataclass(frozen=True, eq=False)
class _Network:
    """model: on the CPU, in evaluation mode. torch: the library. where: names it in messages."""

    model: Any
    torch: Any
    where: str

    def planes(self, picture: NDArray[np.float32], colours: tuple[tuple[float, ...], ...]) -> Any:
        """Return ``picture`` (h, w, 3), 0 to 1, normalised as a tensor (1, 3, h, w)."""
        mean, deviation = (np.array(part, dtype=np.float32) for part in colours)
        return self.torch.from_numpy(np.ascontiguousarray(((picture - mean) / deviation).transpose(2, 0, 1)[None]))

    def run(self, **given: Any) -> Any:
        """Return the model's answer. Raises InputError."""
        with library_errors(self.where), self.torch.inference_mode():
            return self.model(**given)


@dataclass(frozen=True, eq=False)
class SamSegmenter(_Network):
    """``protocols.Segmenter`` by SAM (Kirillov et al. 2023) or SAM 2 (Ravi et al. 2024): one mask for each box.

    side: of the square picture that it takes, in pixels. keeps_aspect: whether it is padded (SAM) or stretched (SAM 2).
    """

    side: int
    keeps_aspect: bool

    def __call__(self, pixels: Pixels, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """As the protocol says. Raises InputError."""
        height, width = pixels.shape[:2]
        scale = np.array([self.side / width, self.side / height])
        if self.keeps_aspect:
            scale[:] = self.side / max(height, width)
        inner = (max(1, round(width * scale[0])), max(1, round(height * scale[1])))
        small = cv2.resize(pixels, inner, interpolation=cv2.INTER_AREA if scale.max() < 1 else cv2.INTER_LINEAR)
        mean = np.array(IMAGENET[0], dtype=np.float32)
        square = np.broadcast_to(mean, (self.side, self.side, 3)).copy()  # 0 once it is normalised
        square[: inner[1], : inner[0]] = small.astype(np.float32) / 255.0
        places = (np.asarray(boxes, dtype=np.float64).reshape(-1, 2, 2) * scale).reshape(1, -1, 4)
        answer = self.run(
            pixel_values=self.planes(square, IMAGENET),
            input_boxes=self.torch.from_numpy(places.astype(np.float32)),
            multimask_output=False,
        )
        logits = np.asarray(answer.pred_masks.float().numpy())
        if logits.ndim != 5 or logits.shape[:3] != (1, len(boxes), 1) or not np.isfinite(logits).all():
            raise InputError(f"{self.where}: answered {logits.shape} that are no masks of {len(boxes)} boxes")
        return np.stack(
            [self._mask(part[0], inner, (height, width), box) for part, box in zip(logits[0], boxes, strict=True)]
        )

    def _mask(
        self, logits: NDArray[np.float32], inner: tuple[int, int], shape: tuple[int, int], box: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        whole = cv2.resize(logits, (self.side, self.side), interpolation=cv2.INTER_LINEAR)[: inner[1], : inner[0]]
        mask = cv2.resize(whole, shape[::-1], interpolation=cv2.INTER_LINEAR) > 0
        x0, y0, x1, y1 = box
        if mask.sum() < max(1.0, LEAST * (x1 - x0) * (y1 - y0)):
            shown = ",".join(f"{v:g}" for v in box)
            raise InputError(f"{self.where}: found nothing in the box {shown}; draw it closer, or paint a mask")
        return np.asarray(mask)


@dataclass(frozen=True, eq=False)
class DepthAnything(_Network):
    """``protocols.DepthEstimator`` by Depth Anything (Yang et al. 2024): inverse depth; metric versions give metres."""

    def __call__(self, pixels: Pixels) -> Depth:
        """As the protocol says. Raises InputError."""
        height, width = pixels.shape[:2]
        scale = DEPTH_SIDE / min(height, width)
        size = tuple(max(DEPTH_STEP, round(v * scale / DEPTH_STEP) * DEPTH_STEP) for v in (width, height))
        small = cv2.resize(pixels.astype(np.float32) / 255.0, size, interpolation=cv2.INTER_CUBIC if scale > 1 else 3)
        answer = self.run(pixel_values=self.planes(np.asarray(small, dtype=np.float32), IMAGENET))
        values = np.squeeze(answer.predicted_depth.float().numpy())
        if values.ndim != 2:
            raise InputError(f"{self.where}: answered {values.shape}, expected a depth map")
        is_metric = getattr(self.model.config, "depth_estimation_type", "relative") == "metric"
        large = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
        return checked_depth(large, (height, width), "metric" if is_metric else "inverse", self.where)


@dataclass(frozen=True, eq=False)
class DepthPro(_Network):
    """``protocols.DepthEstimator`` by Depth Pro (Bochkovskii et al. 2024): metres, and the focal length.

    side: of the square picture that it takes, in pixels.
    """

    side: int

    def __call__(self, pixels: Pixels) -> Depth:
        """As the protocol says. Raises InputError."""
        height, width = pixels.shape[:2]
        picture = pixels.astype(np.float32) / 255.0
        square = cv2.resize(picture, (self.side, self.side), interpolation=cv2.INTER_AREA if width > self.side else 1)
        answer = self.run(pixel_values=self.planes(np.asarray(square, dtype=np.float32), HALF))
        # For a focal length as long as the picture is wide: its inverse depth has to be scaled by the true one.
        canonical = np.squeeze(answer.predicted_depth.float().numpy())
        angle = None if answer.field_of_view is None else float(answer.field_of_view.reshape(-1)[0])
        if canonical.ndim != 2 or angle is None or not 1.0 < angle < 170.0:
            shown = "none" if angle is None else f"{angle:.3g}°"
            raise InputError(
                f"{self.where}: answered {canonical.shape} with a field of view of {shown}, no depth of a photo"
            )
        focal = 0.5 * width / math.tan(math.radians(0.5 * angle))
        inverse = cv2.resize(canonical, (width, height), interpolation=cv2.INTER_LINEAR) * (width / focal)
        found = {"depth": 1.0 / np.clip(inverse, 1e-4, 1e4), "focal_px": focal}
        return checked_depth(found, (height, width), "metric", self.where)


def open_transformers(kind: str, folder: Path, where: str) -> SamSegmenter | DepthAnything | DepthPro:
    """Return the adapter ``kind`` of ``CLASSES`` with the weights in ``folder``. Raises InputError."""
    problem = folder_problem(kind, folder)
    if problem is not None:
        raise InputError(f"{where}: {problem}")
    torch, transformers = (import_library(name, where, INSTALL) for name in ("torch", "transformers"))
    with library_errors(where):
        found = getattr(transformers, CLASSES[kind][0], None)
    if found is None:
        raise InputError(f"{where}: transformers {transformers.__version__} has no {CLASSES[kind][0]}: {INSTALL}")
    model = load_model(found, folder, where, device=torch.device("cpu"), dtype=torch.float32)
    with library_errors(where):
        if kind in ("sam", "sam2"):
            side = int(model.config.prompt_encoder_config.image_size)
            return SamSegmenter(model, torch, where, side, kind == "sam")
        if kind == "depth-anything":
            return DepthAnything(model, torch, where)
        sides = model.config.scaled_images_ratios, model.config.patch_size
        return DepthPro(model, torch, where, round(sides[1] / min(sides[0])))


def folder_problem(kind: str, folder: Path) -> str | None:
    """Return what is wrong with ``folder`` as weights of ``kind``, as far as its configuration tells, or None."""
    remedy = "give the folder that save_pretrained wrote (config.json, model.safetensors)"
    if not folder.is_dir():
        return f"there is no folder {folder}: {remedy}"
    try:
        config = read_json(folder / "config.json", str(folder), remedy)
    except InputError as error:
        return str(error)
    found = config.get("model_type")
    if found not in CLASSES[kind][1]:
        expected = " or ".join(CLASSES[kind][1])
        return f"{folder} holds weights of the type {str(found)[:40]!r}, expected {expected}: {remedy}"
    return None


def missing_packages() -> list[str]:
    """Return the packages that are not installed, without importing any."""
    return [name for name in ("torch", "transformers", "safetensors") if package_version(name) is None]
