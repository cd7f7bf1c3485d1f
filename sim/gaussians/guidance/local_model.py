# SPDX-License-Identifier: MIT
"""Weights of a user's own, in a folder: loaded without a network, without pickle, without anybody's code.

Only what the optional extra ``diffusion`` installs is imported, and only when a folder is opened.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...errors import InputError, PhysGenError

PACKAGES = ("torch", "diffusers", "transformers", "safetensors")
INSTALL = "pip install 'physgen[diffusion]'"
PRECISIONS = ("float32", "float16", "bfloat16")
MOST_JSON_BYTES = 2**20

# Those libraries read these when they are imported. Everything is loaded from paths anyway; this is the second lock.
_OFFLINE = {
    "HF_HUB_OFFLINE": "1",
    "TRANSFORMERS_OFFLINE": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "HF_HUB_DISABLE_PROGRESS_BARS": "1",
}
_WEIGHTS = re.compile(r"(?:diffusion_pytorch_model|model)(?:\.([A-Za-z0-9_]+))?(?:-\d+-of-\d+)?\.safetensors")
_PICKLED = (".bin", ".pt", ".pth", ".ckpt", ".pkl")


def library(name: str, where: str) -> Any:
    """The module ``name`` of the extra, imported with its network switched off for this process. Raises InputError."""
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
        raise InputError(f"{where}: needs {name} ({str(error)[:200]}): {INSTALL}") from error


def missing_packages() -> list[str]:
    """Packages of the extra that are not installed. None is imported."""
    return [name for name in PACKAGES if package_version(name) is None]


def package_version(name: str) -> str | None:
    """Of a package that is installed; None where it is not."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def read_json(path: Path, where: str, remedy: str) -> dict[str, Any]:
    """The object in a small JSON file. Raises InputError that ends with ``remedy``."""
    if not path.is_file():
        raise InputError(f"{where}: has no {path.name}: {remedy}")
    if path.stat().st_size > MOST_JSON_BYTES:
        raise InputError(f"{where}: {path.name} is larger than {MOST_JSON_BYTES >> 20} MiB: {remedy}")
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{where}: {path.name} cannot be read ({str(error)[:200]}): {remedy}") from error
    if not isinstance(value, dict):
        raise InputError(f"{where}: {path.name} holds no JSON object: {remedy}")
    return value


def chosen_device(torch: Any, name: str, where: str) -> Any:
    """The device called ``name`` ("cpu", "cuda", "cuda:1", "mps"), if this machine has it. Raises InputError."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    # AssertionError is what a build without CUDA raises.
    except (RuntimeError, AssertionError, ValueError, TypeError, NotImplementedError) as error:
        why = (str(error).splitlines() or ["no reason given"])[0][:200]
        raise InputError(
            f'{where}: device {name!r} cannot be used ({why}): give "cpu", or install its drivers'
        ) from error
    return device


def load_model(kind: Any, folder: Path, where: str, *, device: Any, dtype: Any) -> Any:
    """A ``kind`` of diffusers or transformers from its own ``folder``, frozen. Raises InputError."""
    variant = _variant(folder, where)
    with told(where):
        model, loading = kind.from_pretrained(
            str(folder), local_files_only=True, use_safetensors=True, variant=variant, output_loading_info=True
        )
        missing = sorted(map(str, loading["missing_keys"]))
        if missing:
            # Those would be left random, and the answers be noise that looks like answers.
            raise InputError(
                f"{where}: the weights in {folder.name} lack {len(missing)} of the model's tensors ({missing[0]}, …): "
                "they belong to another configuration; save the whole pipeline again with save_pretrained"
            )
        model = model.to(device=device, dtype=dtype).eval()
        model.requires_grad_(False)
    return model


def _variant(folder: Path, where: str) -> str | None:
    """What stands between name and ending of the weights in ``folder``, as in model.fp16.safetensors; None: nothing."""
    if not folder.is_dir():
        raise InputError(f"{where}: has no folder {folder.name}: give the whole folder that save_pretrained wrote")
    names = sorted(path.name for path in folder.iterdir() if path.is_file())
    variants = [found.group(1) for name in names if (found := _WEIGHTS.fullmatch(name))]
    if variants:
        return None if None in variants else variants[0]
    pickled = [name for name in names if name.endswith(_PICKLED)]
    if pickled:
        raise InputError(
            f"{where}: {folder.name}/{pickled[0]} is a pickle, which runs what is in it when it is opened, and is not "
            "loaded: save the model with save_pretrained(folder, safe_serialization=True)"
        )
    raise InputError(f"{where}: {folder.name} holds no .safetensors weights: copy them there, nothing is downloaded")


@contextmanager
def told(where: str, remedy: str = "use fewer or smaller pictures, half precision, or the CPU") -> Iterator[None]:
    """What the libraries raise becomes InputError that names ``where``. remedy: for too little memory."""
    try:
        yield
    except PhysGenError:
        raise
    # They raise anything, and out of memory is told apart by words only.
    except Exception as error:
        text = " ".join(str(error).split())[:300]
        lack = ("out of memory", "not enough memory", "can't allocate memory")
        if isinstance(error, MemoryError) or any(words in text.lower() for words in lack):
            raise InputError(f"{where}: there is not enough memory for it ({text}): {remedy}") from error
        raise InputError(
            f"{where}: cannot be used ({type(error).__name__}: {text}): look whether its files are complete and of one "
            "model"
        ) from error
