# SPDX-License-Identifier: MIT
"""CLIP scores (Radford et al. 2021), as PhyCAGE's tables 1 and 2 give them, from a CLIP model of a user's own.

The folder is what transformers' save_pretrained wrote of CLIPModel and its tokenizer; docs/guidance.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .local_model import chosen_device, library, load_model, read_json, told
from .prompts import load_tokenizer, token_ids

MEAN = (0.48145466, 0.4578275, 0.40821073)
SPREAD = (0.26862954, 0.26130258, 0.27577711)
"""Of the pictures that OpenAI's models were trained on; a folder's preprocessor_config.json may say others."""

_WHOLE = "give the folder that transformers' CLIPModel and its tokenizer wrote with save_pretrained"


class ClipScores:
    """How alike pictures are, and how well a text fits one: cosines of CLIP's embeddings in percent, -100 to 100."""

    def __init__(self, folder: Path, *, device: str = "cpu") -> None:
        """Raises InputError where the extra is missing, and where ``folder`` holds no CLIP model in safetensors."""
        self.name = f"CLIP model {folder}"
        if not folder.is_dir():
            raise InputError(
                f"{self.name}: there is no such folder; the model is yours to bring, nothing is downloaded"
            )
        kind = read_json(folder / "config.json", self.name, _WHOLE).get("model_type")
        if kind != "clip":
            raise InputError(f"{self.name}: holds a model of type {str(kind)[:60]!r}, expected 'clip': {_WHOLE}")
        self._torch = library("torch", self.name)
        transformers = library("transformers", self.name)
        self._device = chosen_device(self._torch, device, self.name)
        with told(self.name):
            clip = transformers.CLIPModel
        self._model = load_model(clip, folder, self.name, device=self._device, dtype=self._torch.float32)
        self._tokenizer = load_tokenizer(folder, self.name)
        self._mean, self._spread = _normalisation(folder, self.name)

    def image(self, a: NDArray[Any], b: NDArray[Any]) -> float:
        """CLIP score of two pictures (H, W, 3), sRGB 0 to 1, of any sizes: CLIP_mv and CLIP_ip of the paper."""
        return self._score(self._seen(a), self._seen(b))

    def text(self, picture: NDArray[Any], prompt: str) -> float:
        """CLIP score of a picture (H, W, 3), sRGB 0 to 1, and ``prompt``: CLIP_text. Long prompts are cut."""
        with told(self.name), self._torch.no_grad():
            most = self._model.config.text_config.max_position_embeddings
            ids = token_ids(self._tokenizer, prompt, most).to(self._device)
            said = self._model.text_projection(self._model.text_model(ids).pooler_output)
        return self._score(self._seen(picture), said)

    def _score(self, a: Any, b: Any) -> float:
        return 100 * float(self._torch.nn.functional.cosine_similarity(a, b)[0])

    def _seen(self, picture: NDArray[Any]) -> Any:
        """(1, width) embedding. The shorter side is scaled to the model's (bicubic), the middle square cut out."""
        array = np.asarray(picture)
        if array.ndim != 3 or array.shape[2] != 3 or 0 in array.shape or array.dtype.kind != "f":
            raise InputError(
                f"{self.name}: picture has shape {array.shape} {array.dtype}: give floats (H, W, 3), 0 to 1"
            )
        if not np.isfinite(array).all():
            raise InputError(f"{self.name}: picture has numbers that are not finite: give sRGB from 0 to 1")
        torch, side = self._torch, self._model.config.vision_config.image_size
        with told(self.name), torch.no_grad():
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
    """Mean and standard deviation of R, G and B that the model expects its pictures to be brought to."""
    if not (folder / "preprocessor_config.json").is_file():
        return MEAN, SPREAD
    config = read_json(folder / "preprocessor_config.json", where, _WHOLE)
    found = []
    for name, usual in (("image_mean", MEAN), ("image_std", SPREAD)):
        values = config.get(name, usual)
        good = isinstance(values, list | tuple) and len(values) == 3 and all(type(v) in (int, float) for v in values)
        if not good or (name == "image_std" and min(values) <= 0):
            raise InputError(f"{where}: preprocessor_config.json gives {name} {str(values)[:60]}: give three numbers")
        found.append(tuple(float(v) for v in values))
    return found[0], found[1]
