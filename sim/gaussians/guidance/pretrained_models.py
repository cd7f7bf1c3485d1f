# SPDX-License-Identifier: MIT
"""Model weights in a local folder, loaded without network access, pickle or remote code; CLIP text encoders and scores.

Only what the optional extra ``diffusion`` installs is imported, and only when a folder is opened. Text is encoded to
hidden states of CLIP, as Stable Diffusion and SDXL use them. CLIP scores (Radford et al. 2021) are those of PhyCAGE's
tables 1 and 2; their folder is what transformers' save_pretrained wrote for CLIPModel and its tokenizer
(docs/composition.md).
"""

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

import numpy as np
from numpy.typing import NDArray

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


CLIP_MEAN = (0.48145466, 0.4578275, 0.40821073)
CLIP_STD = (0.26862954, 0.26130258, 0.27577711)
"""Of OpenAI's training images, R, G, B; a folder's preprocessor_config.json overrides them."""

_CLIP_REMEDY = "give the folder that transformers' CLIPModel and its tokenizer wrote with save_pretrained"


class ClipScores:
    """Similarity of images, and of images and text: cosines of CLIP embeddings in percent, -100 to 100."""

    def __init__(self, folder: Path, *, device: str = "cpu") -> None:
        """Raises InputError where the extra is missing, and where ``folder`` holds no CLIP model in safetensors."""
        self.name = f"CLIP model {folder}"
        if not folder.is_dir():
            raise InputError(f"{self.name}: no such folder; provide the model yourself, nothing is downloaded")
        kind = read_json(folder / "config.json", self.name, _CLIP_REMEDY).get("model_type")
        if kind != "clip":
            raise InputError(f"{self.name}: holds a model of type {str(kind)[:60]!r}, expected 'clip': {_CLIP_REMEDY}")
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
    config = read_json(folder / "preprocessor_config.json", where, _CLIP_REMEDY)
    found = []
    for name, usual in (("image_mean", CLIP_MEAN), ("image_std", CLIP_STD)):
        values = config.get(name, usual)
        good = isinstance(values, list | tuple) and len(values) == 3 and all(type(v) in (int, float) for v in values)
        if not good or (name == "image_std" and min(values) <= 0):
            raise InputError(f"{where}: preprocessor_config.json gives {name} {str(values)[:60]}: give three numbers")
        found.append(tuple(float(v) for v in values))
    return found[0], found[1]
