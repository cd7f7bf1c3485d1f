# SPDX-License-Identifier: MIT
"""Names for adapters: from a user's TOML file, and from installed packages.

The file, named by the environment variable ``PHYSGEN_ADAPTERS``, has a table for each stage with names and what they
stand for, relative paths being relative to it:

    [inpainter]
    lama = "lama:models/lama.onnx"

A package registers ``STAGE.NAME`` in the group ``physgen.adapters``, a function as ``protocols`` says.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
from dataclasses import dataclass
from pathlib import Path

from ...errors import InputError
from .command_file import read_toml
from .protocols import STAGES

VARIABLE = "PHYSGEN_ADAPTERS"
GROUP = "physgen.adapters"
PATHS = ("command", "lama", "picture")
"""Kinds of adapters that name a file."""
KINDS = (*PATHS, "python")


@dataclass(frozen=True, kw_only=True)
class NamedAdapter:
    """stage, name: what it is for and is called; spec: ``KIND:TARGET``, or None with an entry point; source: whose."""

    stage: str
    name: str
    spec: str | None
    entry_point: importlib.metadata.EntryPoint | None
    source: str


def split_spec(spec: str) -> tuple[str, str] | None:
    """Kind and target of ``KIND:TARGET``; None for a bare name."""
    kind, colon, target = spec.partition(":")
    return (kind, target) if colon and kind in KINDS else None


def adapters_file() -> Path | None:
    """The user's file of names, if the environment names one."""
    value = os.environ.get(VARIABLE, "").strip()
    return Path(value).expanduser() if value else None


def named_adapters(path: Path | None = None) -> list[NamedAdapter]:
    """All names, those of the user's file first; path: of it, else ``adapters_file()``. Raises InputError."""
    path = path or adapters_file()
    found = [] if path is None else _from_file(path)
    for point in importlib.metadata.entry_points(group=GROUP):
        stage, dot, name = point.name.partition(".")
        if dot and stage in STAGES:
            package = point.dist.name if point.dist is not None else "an installed package"
            found.append(NamedAdapter(stage=stage, name=name, spec=None, entry_point=point, source=package))
    return found


def spec_files(stage: str, spec: str, names: Path | None = None) -> list[Path]:
    """Files that decide what ``spec`` does, as far as they are known: for whoever asks whether anything has changed.

    names: the user's file, else ``adapters_file()``. Raises InputError where that cannot be read.
    """
    parts, found = split_spec(spec), []
    if parts is None:
        table = names or adapters_file()
        found = [] if table is None else [table]
        named = [a.spec for a in named_adapters(names) if (a.stage, a.name) == (stage, spec) and a.spec is not None]
        parts = split_spec(named[0]) if named else None
    if parts is not None:
        kind, target = parts
        path = target if kind in PATHS else target.rpartition(":")[0]
        if kind in PATHS or path.endswith(".py"):
            found.append(Path(path).expanduser().absolute())
    return [path for path in found if path.is_file()]


def adapter_content(stage: str, spec: str | None) -> tuple[str, ...]:
    """What stands for all that ``spec`` does: its text and the hashes of its files; () for none."""
    if spec is None:
        return ()
    try:
        return (
            spec,
            *(hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() for path in spec_files(stage, spec)),
        )
    except OSError as error:
        raise InputError(f"{stage} {spec}: cannot be read ({error.strerror or error}); check its files") from None


def _from_file(path: Path) -> list[NamedAdapter]:
    found = []
    for stage, names in read_toml(path).items():
        if stage not in STAGES or not isinstance(names, dict):
            raise InputError(f"{path}: {stage}: expected the tables {', '.join(f'[{s}]' for s in STAGES)}")
        for name, spec in names.items():
            parts = split_spec(spec) if isinstance(spec, str) else None
            if parts is None or ":" in name:
                raise InputError(
                    f"{path}: {stage}.{name}: expected a text, one of {', '.join(f'{k}:…' for k in KINDS)}"
                )
            found.append(
                NamedAdapter(
                    stage=stage, name=name, spec=_absolute(*parts, path.parent), entry_point=None, source=str(path)
                )
            )
    return found


def _absolute(kind: str, target: str, folder: Path) -> str:
    if kind in PATHS:
        return f"{kind}:{folder / Path(target).expanduser()}"
    module, colon, name = target.rpartition(":")
    return f"{kind}:{folder / Path(module).expanduser()}{colon}{name}" if module.endswith(".py") else f"{kind}:{target}"
