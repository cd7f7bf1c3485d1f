# SPDX-License-Identifier: MIT
"""Model weights in a local folder, loaded without network access, pickle or remote code; CLIP text encoders.

Only what the optional extra ``diffusion`` installs is imported, and only when a folder is opened. Text is encoded to
hidden states of CLIP, as Stable Diffusion and SDXL use them."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError, PhysGenError
from ...files import read_bytes
from ...validation import json_value

PACKAGES = ("torch", "diffusers", "transformers", "safetensors")
INSTALL = "pip install 'physgen[diffusion]'"
PRECISIONS = ("float32", "float16", "bfloat16")
MAX_JSON_BYTES = 2**20

# Read by those libraries on import. Everything is loaded from paths anyway; this is a second safeguard.
_OFFLINE = {
    "HF_HUB_OFFLINE": "1",
    "TRANSFORMERS_OFFLINE": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
}
_WEIGHTS = re.compile(r"(?:diffusion_pytorch_model|model)(?:\.([A-Za-z0-9_]+))?(?:-\d+-of-\d+)?\.safetensors")
_PICKLED = (".bin", ".pt", ".pth", ".ckpt", ".pkl")


def import_library(name: str, where: str, install: str = INSTALL) -> Any:
    """Return the module ``name`` of the extra, imported with its network access disabled for this process.

    install: the remedy. Raises InputError when it is not installed or cannot be imported.
    """
    os.environ.update(_OFFLINE)
    try:
        module = importlib.import_module(name)
        if name in ("diffusers", "transformers"):
            logging = importlib.import_module(f"{name}.utils.logging")
            logging.disable_progress_bar()
            logging.set_verbosity_error()
        return module
    # A broken installation fails with OSError (shared libraries) or RuntimeError as well.
    except (ImportError, OSError, RuntimeError) as error:
        raise InputError(f"{where}: needs {name} ({str(error)[:200]}): {install}") from error


def missing_packages() -> list[str]:
    """Return the packages of the extra that are not installed, without importing any."""
    return [name for name in PACKAGES if package_version(name) is None]


def package_version(name: str) -> str | None:
    """Return the version of an installed package, or None."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def read_json(path: Path, where: str, remedy: str) -> dict[str, Any]:
    """Return the object in a JSON file of at most 1 MiB. Raises InputError that ends with ``remedy``."""
    try:
        value = json_value(read_bytes(path, MAX_JSON_BYTES), path.name)
    except FileNotFoundError:
        raise InputError(f"{where}: has no {path.name}: {remedy}") from None
    except InputError as error:
        raise InputError(f"{where}: {path.name} cannot be read ({error}): {remedy}") from None
    if not isinstance(value, dict):
        raise InputError(f"{where}: {path.name} is not a JSON object: {remedy}")
    return value


def torch_device(torch: Any, name: str, where: str) -> Any:
    """Return the device ``name`` ("cpu", "cuda", "cuda:1", "mps"). Raises InputError where this machine lacks it."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    # AssertionError is what a build without CUDA raises.
    except (RuntimeError, AssertionError, ValueError, TypeError, NotImplementedError) as error:
        why = (str(error).splitlines() or ["no reason given"])[0][:200]
        raise InputError(
            f'{where}: device {name!r} cannot be used ({why}): use "cpu", or install its drivers'
        ) from error
    return device


def load_model(kind: Any, folder: Path, where: str, *, device: Any, dtype: Any) -> Any:
    """Return the model of class ``kind`` (diffusers or transformers) in ``folder``, in evaluation mode and frozen.

    Raises InputError on missing, pickled or incomplete weights.
    """
    variant = _variant(folder, where)
    with library_errors(where):
        model, loading = kind.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, variant=variant, output_loading_info=True
        )
        missing = sorted(map(str, loading["missing_keys"]))
        if missing:
            # Those would stay random, and the model would silently return noise.
            raise InputError(
                f"{where}: the weights in {folder.name} lack {len(missing)} of the model's tensors ({missing[0]}, …): "
                "they belong to another configuration; save the whole pipeline again with save_pretrained"
            )
        model = model.to(device=device, dtype=dtype).eval()
        model.requires_grad_(False)
    return model


def _variant(folder: Path, where: str) -> str | None:
    """Return the variant in the weights' file names, as in model.fp16.safetensors, or None."""
    if not folder.is_dir():
        raise InputError(f"{where}: has no folder {folder.name}: give the whole folder that save_pretrained wrote")
    names = sorted(path.name for path in folder.iterdir() if path.is_file())
    variants = [found.group(1) for name in names if (found := _WEIGHTS.fullmatch(name))]
    if variants:
        return None if None in variants else variants[0]
    pickled = [name for name in names if name.endswith(_PICKLED)]
    if pickled:
        raise InputError(
            f"{where}: {folder.name}/{pickled[0]} is a pickle, which can run code when opened, and is not loaded: save "
            "the model with save_pretrained(folder, safe_serialization=True)"
        )
    raise InputError(f"{where}: {folder.name} has no .safetensors weights: copy them there, nothing is downloaded")


@contextmanager
def library_errors(
    where: str, remedy: str = "use fewer or smaller pictures, half precision, or the CPU"
) -> Iterator[None]:
    """Turn exceptions of the libraries into InputError that names ``where``. remedy: for lack of memory."""
    try:
        yield
    except PhysGenError:
        raise
    # They raise anything, and lack of memory is recognised by its message only.
    except Exception as error:
        text = " ".join(str(error).split())[:300]
        lack = ("out of memory", "not enough memory", "can't allocate memory")
        if isinstance(error, MemoryError) or any(words in text.lower() for words in lack):
            raise InputError(f"{where}: not enough memory ({text}): {remedy}") from error
        raise InputError(
            f"{where}: cannot be used ({type(error).__name__}: {text}): check that its files are complete and belong "
            "to one model"
        ) from error


MAX_CACHED_TEXTS = 64
"""Texts whose encoding is cached, so that a text is not encoded again in every step."""


@dataclass(frozen=True, eq=False)
class TextConditioning:
    """An encoded text. hidden: (1, tokens, width) tensor; pooled: (1, width) tensor of the whole text, SDXL only."""

    hidden: Any
    pooled: Any | None


class TextEncoders:
    """Tokenizers and text encoders of a pipeline: one pair (Stable Diffusion), or two (SDXL)."""

    def __init__(self, folder: Path, where: str, *, two: bool, zero_empty: bool, device: Any, dtype: Any) -> None:
        """two: SDXL's pair; zero_empty: encode the empty text as zeros, as SDXL was trained. Raises InputError."""
        transformers = import_library("transformers", where)
        with library_errors(where):
            kinds = [("", transformers.CLIPTextModelWithProjection if two else transformers.CLIPTextModel)]
            if two:
                kinds = [("", transformers.CLIPTextModel), ("_2", transformers.CLIPTextModelWithProjection)]
        self._pairs = []
        for end, kind in kinds:
            encoder = load_model(kind, folder / f"text_encoder{end}", where, device=device, dtype=dtype)
            self._pairs.append((load_tokenizer(folder / f"tokenizer{end}", where), encoder))
        self._torch = import_library("torch", where)
        self._two, self._zero_empty, self._device = two, zero_empty, device
        self._cache: dict[str, TextConditioning] = {}

    def encode(self, text: str) -> TextConditioning:
        """Return the encoding of ``text``, truncated to the encoder's length; cached."""
        if text not in self._cache:
            if len(self._cache) >= MAX_CACHED_TEXTS:
                self._cache.clear()
            self._cache[text] = self._encode(text)
        return self._cache[text]

    def _encode(self, text: str) -> TextConditioning:
        hidden, pooled = [], None
        for tokenizer, encoder in self._pairs:
            ids = token_ids(tokenizer, text, encoder.config.max_position_embeddings).to(self._device)
            answer = encoder(ids, output_hidden_states=self._two)
            # SDXL uses the penultimate layer (Podell et al. 2023), Stable Diffusion the last one.
            hidden.append(answer.hidden_states[-2] if self._two else answer.last_hidden_state)
            pooled = answer.text_embeds if self._two and hasattr(answer, "text_embeds") else pooled
        joined = self._torch.cat(hidden, dim=-1)
        if not text and self._zero_empty:
            return TextConditioning(joined * 0, None if pooled is None else pooled * 0)
        return TextConditioning(joined, pooled)


def load_tokenizer(folder: Path, where: str) -> Any:
    """Return CLIP's tokenizer in ``folder``. Raises InputError."""
    with library_errors(where):
        return import_library("transformers", where).CLIPTokenizer.from_pretrained(str(folder), local_files_only=True)


def token_ids(tokenizer: Any, text: str, most: int) -> Any:
    """Return (1, most) tensor of ``text``'s token ids, padded or truncated."""
    return tokenizer(text, padding="max_length", max_length=most, truncation=True, return_tensors="pt").input_ids
