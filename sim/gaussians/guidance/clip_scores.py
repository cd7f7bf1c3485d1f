# SPDX-License-Identifier: MIT
"""CLIP scores (Radford et al. 2021), as in PhyCAGE's tables 1 and 2, from a local CLIP model.

The folder is what transformers' save_pretrained wrote for CLIPModel and its tokenizer; docs/composition.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .pretrained_models import (
    import_library,
    library_errors,
    load_model,
    load_tokenizer,
    read_json,
    token_ids,
    torch_device,
)

CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
"""Of OpenAI's training images, R, G, B; a folder's preprocessor_config.json overrides them."""

_REMEDY = "give the folder that transformers' CLIPModel and its tokenizer wrote with save_pretrained"


class ClipScores:
    """Similarity of images, and of images and text: cosines of CLIP embeddings in percent, -100 to 100."""

    def __init__(self, folder: Path, *, device: str = "cpu") -> None:
        """Raises InputError where the extra is missing, and where ``folder`` holds no CLIP model in safetensors."""
        self.name = f"CLIP model {folder}"
        if not folder.is_dir():
            raise InputError(f"{self.name}: no such folder; provide the model yourself, nothing is downloaded")
        kind = read_json(folder / "config.json", self.name, _REMEDY).get("model_type")
        if kind != "clip":
            raise InputError(f"{self.name}: holds a model of type {str(kind)[:60]!r}, expected 'clip': {_REMEDY}")
        self._torch = import_library("torch", self.name)
        transformers = import_library("transformers", self.name)
        self._device = torch_device(self._torch, device, self.name)
        with library_errors(self.name):
            clip = transformers.CLIPModel
        self._model = load_model(clip, folder, self.name, device=self._device, dtype=self._torch.float32)
        self._tokenizer = load_tokenizer(folder, self.name)
        self._mean, self._spread = _normalisation(folder, self.name)

    def image(self, a: NDArray[Any], b: NDArray[Any]) -> float:
        """Return the CLIP score of two images (H, W, 3), sRGB 0 to 1, of any sizes (PhyCAGE's CLIP_mv, CLIP_ip)."""
        return self._score(self._seen(a), self._seen(b))

    def text(self, picture: NDArray[Any], prompt: str) -> float:
        """Return the CLIP score of an image (H, W, 3), sRGB 0 to 1, and ``prompt``, truncated if long: CLIP_text."""
        with library_errors(self.name), self._torch.no_grad():
            most = self._model.config.text_config.max_position_embeddings
            ids = token_ids(self._tokenizer, prompt, most).to(self._device)
            embedding = self._model.text_projection(self._model.text_model(ids).pooler_output)
        return self._score(self._seen(picture), embedding)

    def _score(self, a: Any, b: Any) -> float:
        return 100 * float(self._torch.nn.functional.cosine_similarity(a, b)[0])

    def _seen(self, picture: NDArray[Any]) -> Any:
        """Return the embedding (1, width) of an image: shorter side scaled to the model's (bicubic), centre crop."""
        array = np.asarray(picture)
        if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape or array.dtype.kind != "f":
            raise InputError(
                f"{self.name}: picture has shape {array.shape} {array.dtype}: give floats (H, W, 3), 0 to 1"
            )
        if not np.isfinite(array).all():
            raise InputError(f"{self.name}: picture has values that are not finite: give sRGB from 0 to 1")
        torch, side = self._torch, self._model.config.vision_config.image_size
        with library_errors(self.name), torch.no_grad():
            planes = np.ascontiguousarray(np.moveaxis(array, 2, 0)[None], dtype=np.float32)
            height, width = planes.shape[2:]
            sides = [max(side, round(length * side / min(height, width))) for length in (height, width)]
            scaled = torch.nn.functional.interpolate(
                torch.tensor(planes, device=self._device), size=sides, mode="bicubic", antialias=True
            ).clamp(0, 1)
            top, left = ((length - side) // 2 for length in sides)
            square = scaled[:, :, top : top + side, left : left + side]
            mean, spread = (square.new_tensor(v).reshape(1, 3, 1, 1) for v in (self._mean, self._spread))
            embedded = self._model.vision_model((square - mean) / spread).pooler_output
            return self._model.visual_projection(embedded)


def _normalisation(folder: Path, where: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return mean and standard deviation of R, G, B by which the model's input is normalised. Raises InputError."""
    if not (folder / "preprocessor_config.json").is_file():
        return CLIP_MEAN, CLIP_STD
    config = read_json(folder / "preprocessor_config.json", where, _REMEDY)
    found = []
    for name, usual in (("image_mean", CLIP_MEAN), ("image_std", CLIP_STD)):
        values = config.get(name, usual)
        good = isinstance(values, list | tuple) and len(values) == 3 and all(type(v) in (int, float) for v in values)
        if not good or (name == "image_std" and min(values) <= 0):
            raise InputError(f"{where}: preprocessor_config.json gives {name} {str(values)[:60]}: give three numbers")
        found.append(tuple(float(v) for v in values))
    return found[0], found[1]
