# SPDX-License-Identifier: MIT
"""Words → what a diffusion model is told: hidden states of CLIP, as Stable Diffusion and SDXL use them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .local_model import library, load_model, told

MOST_TEXTS = 64
"""That are kept, so that a text is not encoded again in every step."""


@dataclass(frozen=True, eq=False)
class Told:
    """hidden: (1, tokens, width) tensor; pooled: (1, width) tensor of the whole text, with SDXL only."""

    hidden: Any
    pooled: Any | None


class TextEncoders:
    """Tokenizers and text encoders of a pipeline: one pair (Stable Diffusion), or two (SDXL)."""

    def __init__(self, folder: Path, where: str, *, two: bool, zero_empty: bool, device: Any, dtype: Any) -> None:
        """zero_empty: the empty text is all zeros, as SDXL was trained. Raises InputError."""
        transformers = library("transformers", where)
        with told(where):
            kinds = [("", transformers.CLIPTextModelWithProjection if two else transformers.CLIPTextModel)]
            if two:
                kinds = [("", transformers.CLIPTextModel), ("_2", transformers.CLIPTextModelWithProjection)]
        self._pairs = []
        for end, kind in kinds:
            encoder = load_model(kind, folder / f"text_encoder{end}", where, device=device, dtype=dtype)
            self._pairs.append((load_tokenizer(folder / f"tokenizer{end}", where), encoder))
        self._torch = library("torch", where)
        self._two, self._zero_empty, self._device = two, zero_empty, device
        self._kept: dict[str, Told] = {}

    def told(self, text: str) -> Told:
        """What the model is told by ``text``; what is longer than its encoder reads is cut."""
        if text not in self._kept:
            if len(self._kept) >= MOST_TEXTS:
                self._kept.clear()
            self._kept[text] = self._encoded(text)
        return self._kept[text]

    def _encoded(self, text: str) -> Told:
        hidden, pooled = [], None
        for tokenizer, encoder in self._pairs:
            ids = token_ids(tokenizer, text, encoder.config.max_position_embeddings).to(self._device)
            answer = encoder(ids, output_hidden_states=self._two)
            # SDXL goes by the layer before the last (Podell et al. 2023); Stable Diffusion by the last one.
            hidden.append(answer.hidden_states[-2] if self._two else answer.last_hidden_state)
            pooled = answer.text_embeds if self._two and hasattr(answer, "text_embeds") else pooled
        joined = self._torch.cat(hidden, dim=-1)
        if not text and self._zero_empty:
            return Told(joined * 0, None if pooled is None else pooled * 0)
        return Told(joined, pooled)


def load_tokenizer(folder: Path, where: str) -> Any:
    """CLIP's tokenizer from ``folder``. Raises InputError."""
    with told(where):
        return library("transformers", where).CLIPTokenizer.from_pretrained(str(folder), local_files_only=True)


def token_ids(tokenizer: Any, text: str, most: int) -> Any:
    """(1, most) tensor of numbers of ``text``'s tokens, filled up or cut."""
    return tokenizer(text, padding="max_length", max_length=most, truncation=True, return_tensors="pt").input_ids
