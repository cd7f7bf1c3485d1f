# SPDX-License-Identifier: GPL-3.0-or-later
"""What is in an extension's zip: the tree without what the manifest leaves out, a manifest of its own, wheels."""

from __future__ import annotations

import json
import os
import tomllib
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

MANIFEST = "blender_manifest.toml"
_SAME_TIME = (1980, 1, 1, 0, 0, 0)
"""The same tree gives the same zip, to the byte."""


def read_manifest(root: Path) -> dict[str, Any]:
    """The manifest of the tree at ``root``."""
    return tomllib.loads((root / MANIFEST).read_text(encoding="utf-8"))


def source_files(root: Path, patterns: Sequence[str]) -> Iterator[str]:
    """Files of the tree that no pattern leaves out, as paths relative to ``root``, sorted, without the manifest.

    patterns: as ``[build] paths_exclude_pattern`` has them: a slash in front means the top folder only, one behind
    means folders only.
    """
    for folder, folders, names in os.walk(root):
        here = Path(folder).relative_to(root)
        folders[:] = sorted(name for name in folders if not _left_out(here / name, True, patterns))
        for name in sorted(names):
            path = here / name
            if path.as_posix() != MANIFEST and not _left_out(path, False, patterns):
                yield path.as_posix()


def _left_out(path: Path, is_folder: bool, patterns: Iterable[str]) -> bool:
    for pattern in patterns:
        if pattern.endswith("/") and not is_folder:
            continue
        bare = pattern.strip("/")
        if fnmatch(path.as_posix() if pattern.startswith("/") else path.name, bare) and not (
            pattern.startswith("/") and len(path.parts) > 1
        ):
            return True
    return False


def manifest_text(manifest: Mapping[str, Any], fields: Mapping[str, Any], wheels: Sequence[str]) -> str:
    """``manifest`` with ``fields`` instead of its own and ``wheels`` (file names), as TOML; without how it is built."""
    values = {**manifest, **fields}
    if wheels:
        values["wheels"] = [f"./wheels/{name}" for name in wheels]
    values.pop("build", None)
    tables = {key: value for key, value in values.items() if isinstance(value, dict)}
    lines = [f"{key} = {_toml(value)}" for key, value in values.items() if key not in tables]
    for key, table in tables.items():
        lines += ["", f"[{key}]", *(f"{name} = {_toml(value)}" for name, value in table.items())]
    return "\n".join(lines) + "\n"


def _toml(value: str | list[str]) -> str:
    """A string or a list of strings; JSON's quoting is TOML's."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    items = [json.dumps(item, ensure_ascii=False) for item in value]
    return "[" + ", ".join(items) + "]" if len(items) < 4 else "[\n" + "".join(f"    {i},\n" for i in items) + "]"


def write_zip(root: Path, path: Path, fields: Mapping[str, Any], wheels: Sequence[Path]) -> None:
    """Write the extension at ``root`` with ``wheels`` to ``path``, whole or not at all."""
    manifest = read_manifest(root)
    names = list(source_files(root, manifest["build"]["paths_exclude_pattern"]))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    with zipfile.ZipFile(partial, "w") as archive:
        text = manifest_text(manifest, fields, [wheel.name for wheel in wheels])
        _add(archive, MANIFEST, text.encode(), zipfile.ZIP_DEFLATED)
        for name in names:
            _add(archive, name, (root / name).read_bytes(), zipfile.ZIP_DEFLATED)
        for wheel in wheels:
            # Wheels are compressed already.
            _add(archive, f"wheels/{wheel.name}", wheel.read_bytes(), zipfile.ZIP_STORED)
    partial.replace(path)


def _add(archive: zipfile.ZipFile, name: str, content: bytes, compression: int) -> None:
    entry = zipfile.ZipInfo(name, _SAME_TIME)
    entry.compress_type = compression
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, content)
