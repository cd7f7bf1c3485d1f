# SPDX-License-Identifier: MIT
"""Results of stages, kept in the scene folder under what went into them: a correction repeats only what it changes.

A stage is asked for by its name and its inputs. What an earlier reconstruction into the same folder has computed from
the same inputs is read back, with the notices that it gave; files that nobody asked for this time are left behind.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..scene.json_fields import to_json

Arrays = Mapping[str, NDArray[Any]]
Notice = Callable[[str], None]

STAGES_FOLDER = "stages"
REVISION = 1
"""Raised with every change of a stage that changes what it gives."""
MAX_BYTES = 2**30
"""Of one stage's arrays; a larger file is none of ours, whatever it says."""
_NOTICES = "notices"


class StageStore:
    """Recalls the results of stages from the folder ``earlier``, and keeps those asked for in ``folder``.

    recalled: names of the stages that were not computed again.
    """

    def __init__(self, folder: Path, earlier: Path, notice: Notice) -> None:
        self._folder, self._earlier, self._notice = folder, earlier, notice
        self.recalled: list[str] = []

    def run(self, stage: str, inputs: Mapping[str, object], make: Callable[[Notice], Arrays]) -> Arrays:
        """What ``make`` gives, from an earlier run with equal ``inputs`` if there was one.

        inputs: arrays, dataclasses, numbers, texts and mappings or sequences of these; all that ``make`` depends on.
        make: is called with where to say what was found; what it says is said again when the result is recalled.
        """
        name = f"{stage}-{inputs_hash(stage, inputs)}.npz"
        found = _read(self._earlier / name)
        said: list[str] = []
        if found is not None:
            arrays, said = found
            self.recalled.append(stage)
            for message in said:
                self._notice(message)
            with replacing(self._folder / name) as partial:
                shutil.copyfile(self._earlier / name, partial)
            return arrays

        def notice(message: str) -> None:
            said.append(message)
            self._notice(message)

        arrays = dict(make(notice))
        with replacing(self._folder / name) as partial:
            np.savez_compressed(partial, allow_pickle=False, **arrays, **{_NOTICES: np.array(json.dumps(said))})
        return arrays


def inputs_hash(stage: str, inputs: Mapping[str, object]) -> str:
    """16 hexadecimal digits that stand for the ``inputs`` of ``stage``."""
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
    """The arrays and notices in ``path``; None when there are none, or the file is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
                return None
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        said = json.loads(str(arrays.pop(_NOTICES)))
    # A damaged archive fails in whatever way the garbage leads to (zlib.error, struct.error, KeyError, …).
    except Exception:
        return None
    if not isinstance(said, list) or not all(isinstance(text, str) for text in said):
        return None
    return arrays, said
