# SPDX-License-Identifier: MIT
"""What adapters there are, and whether each could be used: looked at, not run."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import shutil
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from .command_file import read_command_file
from .names import NamedAdapter, adapters_file, named_adapters
from .python_function import exists


@dataclass(frozen=True, kw_only=True)
class FoundAdapter:
    """stage, name: what it is for and called; usable: as far as can be seen; text: what it is, or what is wrong."""

    stage: str
    name: str
    usable: bool
    text: str


def found_adapters() -> list[FoundAdapter]:
    """All adapters that have a name. A file of names that cannot be read is one that cannot be used."""
    try:
        named = named_adapters()
    except InputError as error:
        return [FoundAdapter(stage="adapters", name=str(adapters_file()), usable=False, text=str(error))]
    return [_look(adapter) for adapter in named]


def onnxruntime_version() -> str | None:
    """Of the onnxruntime that is installed; None where it is not. It is not imported."""
    for name in ("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml"):
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return "of no known version" if importlib.util.find_spec("onnxruntime") else None


def _look(adapter: NamedAdapter) -> FoundAdapter:
    if adapter.entry_point is not None:
        problem, what = exists(f"{adapter.entry_point.module}:x"), f"{adapter.entry_point.value} of {adapter.source}"
    else:
        assert adapter.spec is not None
        kind, _, target = adapter.spec.partition(":")
        problem, what = _problem(adapter.stage, kind, target), adapter.spec
    text = what if problem is None else f"{what}: {problem}"
    return FoundAdapter(stage=adapter.stage, name=adapter.name, usable=problem is None, text=text)


def _problem(stage: str, kind: str, target: str) -> str | None:
    if kind == "python":
        return exists(target)
    path = Path(target)
    if kind == "command":
        try:
            program = read_command_file(path, stage).command[0]
        except InputError as error:
            return str(error)
        if program.startswith("{"):
            return None
        return None if shutil.which(program) else f"there is no program {program}"
    if stage != "inpainter":
        return f"fills holes, it is no {stage}"
    if not path.is_file():
        return "there is no such file"
    if kind == "lama" and onnxruntime_version() is None:
        return "needs onnxruntime; install physgen[onnx]"
    return None
