# SPDX-License-Identifier: MIT
"""Progress and cancelling of a reconstruction, and a cache of its stages' results.

A stage is requested by its name and its inputs. A result that an earlier reconstruction into the same folder has
computed from the same inputs is read back together with its notices; results that are not requested this time are left
behind.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..errors import Cancelled, InputError
from ..events import IsCancelled, OnEvent, step_words
from ..npz import read_npz
from ..validation import json_value, to_json


class Steps:
    """Report progress, forward notices, and stop between steps when cancelled."""

    def __init__(self, total: int, on_event: OnEvent, cancelled: IsCancelled, *, stage: str = "reconstruct") -> None:
        self._total, self._done, self._on_event, self.cancelled = total, 0, on_event, cancelled
        self._stage = stage
        self.notices: list[str] = []

    def begin(self, name: str) -> None:
        """Begin the step ``name``. Raises Cancelled when cancelled."""
        if self.cancelled():
            raise Cancelled(f"reconstruction cancelled before {step_words(name)}; nothing was written")
        event = {"event": "progress", "stage": self._stage, "step": name, "message": step_words(name)}
        self._on_event({**event, "done": self._done, "total": self._total})
        self._done += 1

    def finish(self) -> None:
        """Report that all steps are done. Raises Cancelled when cancelled."""
        if self.cancelled():
            raise Cancelled("reconstruction cancelled at its end; nothing was written")
        event = {"event": "progress", "stage": self._stage, "step": "done", "message": "done"}
        self._on_event({**event, "done": self._total, "total": self._total})

    def notice(self, message: str) -> None:
        """Report a message to the user."""
        self.notices.append(message)
        self._on_event({"event": "notice", "stage": self._stage, "message": message})


Arrays = Mapping[str, NDArray[Any]]
Notice = Callable[[str], None]

STAGES_FOLDER = "stages"
REVISION = 72
"""Increase with every change that alters a stage's results."""
MAX_BYTES = 2**30
"""Limit of one stage's arrays; a larger file is not a cache file."""
_NOTICES = "notices"


class StageCache:
    """Cache of stage results: read from the folder ``earlier``, stored in ``folder``.

    recalled: names of the stages that were not recomputed.
    """

    def __init__(self, folder: Path, earlier: Path, notice: Notice) -> None:
        self._folder, self._earlier, self._notice = folder, earlier, notice
        self.recalled: list[str] = []

    def run(self, stage: str, inputs: Mapping[str, object], make: Callable[[Notice], Arrays]) -> Arrays:
        """Return the result of ``make``, cached from an earlier run with equal ``inputs`` if there was one.

        inputs: arrays, dataclasses, numbers, strings and mappings or sequences of these; everything that ``make``
            depends on.
        make: is called with the notice callback; its notices are repeated when the result is cached.
        """
        name = f"{stage}-{inputs_hash(stage, inputs)}.npz"
        found = _read(self._earlier / name)
        messages: list[str] = []
        if found is not None:
            arrays, messages = found
            self.recalled.append(stage)
            for message in messages:
                self._notice(message)
            with replacing(self._folder / name) as partial:
                shutil.copyfile(self._earlier / name, partial)
            return arrays

        def notice(message: str) -> None:
            messages.append(message)
            self._notice(message)

        arrays = dict(make(notice))
        with replacing(self._folder / name) as partial:
            np.savez_compressed(partial, allow_pickle=False, **arrays, **{_NOTICES: np.array(json.dumps(messages))})
        return arrays


def inputs_hash(stage: str, inputs: Mapping[str, object]) -> str:
    """Return a hash of ``stage`` and its ``inputs``, 16 hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=8)
    _feed(digest, [REVISION, stage, inputs])
    return digest.hexdigest()


def _feed(digest: Any, value: object) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape};".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Mapping):
        digest.update(f"mapping {len(value)};".encode())
        for key in sorted(value):
            digest.update(f"{key}=".encode())
            _feed(digest, value[key])
    elif isinstance(value, list | tuple):
        digest.update(f"sequence {len(value)};".encode())
        for item in value:
            _feed(digest, item)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        _feed(digest, to_json(value))
    elif value is None or isinstance(value, bool | int | float | str):
        digest.update(f"{value!r};".encode())
    else:
        raise TypeError(f"inputs of a stage cannot hold a {type(value).__name__}")


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], list[str]] | None:
    """The arrays and notices in ``path``; None if there is no file, or it is damaged."""
    try:
        arrays = read_npz(path, MAX_BYTES, own=True)
        messages = json_value(str(arrays.pop(_NOTICES)), str(path))
    except (InputError, KeyError):
        return None
    if not isinstance(messages, list) or not all(isinstance(text, str) for text in messages):
        return None
    return arrays, messages
