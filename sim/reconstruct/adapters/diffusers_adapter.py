# SPDX-License-Identifier: MIT
"""Inpainting by a diffusion pipeline of ``diffusers``, from a local folder that ``save_pretrained`` wrote.

Stable Diffusion's inpainting pipeline and that of SDXL. Nothing is downloaded, nothing is unpickled, and no code from
the folder runs: only classes of diffusers and transformers are opened. A seed makes the answer repeatable.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...gaussians.guidance.pretrained_models import import_library, library_errors, read_json
from .onnx_adapter import LEAST_SIDE, blended, filled_hole_by_hole, without_content
from .protocols import Mask, Pixels, checked_pixels

INSTALL = "pip install 'physgen[models]'"
PIPELINES = ("StableDiffusionInpaintPipeline", "StableDiffusionXLInpaintPipeline")
LIBRARIES = ("diffusers", "transformers")
"""Where the parts of a pipeline may come from."""
NOT_LOADED = ("safety_checker", "feature_extractor", "image_encoder")
"""Parts that inpainting does without."""
REMEDY = "give the folder that save_pretrained wrote (model_index.json, unet, vae, …)"
PROMPT, AVOID = "empty background, nothing on it", "object, person, text, shadow"
STEPS, GUIDANCE, SEED = 30, 5.0, 0
"""Steps of the denoising, strength of the words, and what the noise starts from."""


@dataclass(frozen=True, eq=False)
class DiffusersInpainter:
    """``protocols.Inpainter``: each hole in a square crop around it. side: of the pipeline's picture, in pixels."""

    pipeline: Any
    torch: Any
    side: int
    where: str

    def __call__(self, pixels: Pixels, hole: Mask) -> Pixels:
        """As the protocol says. Raises InputError."""
        filled = filled_hole_by_hole(pixels, hole, min(LEAST_SIDE, self.side), self._fill)
        return checked_pixels(filled, pixels, hole, self.where)

    def _fill(self, pixels: Pixels, hole: Mask) -> Pixels:
        """``pixels`` (h, w, 3) with ``hole`` inpainted at the pipeline's own size."""
        height, width = hole.shape
        pixels = without_content(pixels, hole)
        size = (self.side, self.side)
        way = cv2.INTER_AREA if self.side < height else cv2.INTER_CUBIC
        picture = np.asarray(cv2.resize(pixels, size, interpolation=way), dtype=np.float32) / np.float32(255)
        mask = cv2.resize(hole.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0
        filled = blended(picture, self._answer(picture, mask), mask)
        large = cv2.resize(filled, (width, height), interpolation=cv2.INTER_CUBIC)
        return np.asarray(np.clip(large * 255 + 0.5, 0, 255), dtype=np.uint8)

    def _answer(self, picture: NDArray[np.float32], mask: Mask) -> NDArray[np.float32]:
        """The pipeline's picture (h, w, 3), 0 to 1, for ``picture`` and ``mask`` (h, w)."""
        planes = self.torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1)[None]))
        holes = self.torch.from_numpy(mask.astype(np.float32)[None, None])
        with library_errors(self.where), self.torch.inference_mode():
            answer = self.pipeline(
                prompt=PROMPT,
                negative_prompt=AVOID,
                image=planes,
                mask_image=holes,
                height=self.side,
                width=self.side,
                num_inference_steps=STEPS,
                guidance_scale=GUIDANCE,
                strength=1.0,
                generator=self.torch.Generator("cpu").manual_seed(SEED),
                output_type="np",
            ).images
        values = np.asarray(answer, dtype=np.float32)
        if values.shape != (1, *picture.shape) or not np.isfinite(values).all():
            raise InputError(f"{self.where}: answered {values.shape}, expected a finite picture of {picture.shape}")
        return np.asarray(np.clip(values[0], 0.0, 1.0), dtype=np.float32)


def open_diffusers(folder: Path, where: str) -> DiffusersInpainter:
    """Return the inpainting pipeline in ``folder``. Raises InputError."""
    problem = pipeline_problem(folder)
    if problem is not None:
        raise InputError(f"{where}: {problem}")
    torch, diffusers = (import_library(name, where, INSTALL) for name in ("torch", "diffusers"))
    import_library("transformers", where, INSTALL)
    index = read_json(folder / "model_index.json", where, REMEDY)
    half = any((folder / "unet").glob("*.fp16.safetensors"))
    with library_errors(where):
        pipeline = getattr(diffusers, index["_class_name"]).from_pretrained(
            str(folder),
            local_files_only=True,
            use_safetensors=True,
            variant="fp16" if half else None,
            torch_dtype=torch.float32,
            **{name: None for name in NOT_LOADED if name in index},
        )
        pipeline.set_progress_bar_config(disable=True)
        side = int(pipeline.unet.config.sample_size) * int(pipeline.vae_scale_factor)
    return DiffusersInpainter(pipeline, torch, side, where)


def pipeline_problem(folder: Path) -> str | None:
    """Return what is wrong with ``folder`` as an inpainting pipeline, as far as its index tells, or None."""
    if not folder.is_dir():
        return f"there is no folder {folder}: {REMEDY}"
    try:
        index = read_json(folder / "model_index.json", str(folder), REMEDY)
    except InputError as error:
        return str(error)
    if index.get("_class_name") not in PIPELINES:
        found = str(index.get("_class_name"))[:60]
        return f"{folder} holds a {found!r}, expected {' or '.join(PIPELINES)}: {REMEDY}"
    for name, part in index.items():
        if name.startswith("_") or name in NOT_LOADED or not isinstance(part, list):
            continue
        given = part[0] if part else None
        if given is not None and given not in LIBRARIES:
            return f"{folder}: its part {name[:40]} is of {str(given)[:60]!r}, which is not opened: {REMEDY}"
    return None
