# SPDX-License-Identifier: MIT
"""An ONNX file through onnxruntime, on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...errors import InputError

MAX_MODEL_BYTES = 8 * 2**30


def open_session(path: Path, where: str) -> Any:
    """Return an ``onnxruntime.InferenceSession`` of the file ``path``. Raises InputError that names ``where``."""
    if not path.is_file():
        raise InputError(f"{where}: there is no such file; bring your own model, nothing is downloaded")
    if path.stat().st_size > MAX_MODEL_BYTES:
        raise InputError(f"{where}: {path.stat().st_size >> 30} GiB is larger than any supported model")
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError(f"{where}: needs onnxruntime ({error}); install physgen[models]") from None
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    # onnxruntime's exceptions have no common base class.
    except Exception as error:
        raise InputError(f"{where}: is not a model that onnxruntime can read ({str(error)[:300]})") from error
