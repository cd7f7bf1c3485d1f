# SPDX-License-Identifier: MIT
"""Write a scene folder atomically: it appears whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..atomic import recover, replacing_tree
from ..cache.folder_lock import lock_beside
from ..errors import InputError
from ..scene.folder import SCENE_FILE
from ..scene.scene_sums import SUMS_FILE, write_scene_sums
from ..validation import read_json

PHYSICS_FILE = "physics.json"
OWN_ENTRIES = frozenset(
    (
        SCENE_FILE,
        "reconstruct.json",
        PHYSICS_FILE,
        "photo.png",
        "background.png",
        "masks",
        "full",
        "shadows",
        "holes",
        "meshes",
        "splats",
        "albedo",
        "splats",
        "compose.json",
        SUMS_FILE,
        "light",
        "stages",
        "report.html",
    )
)
"""Entries of a scene folder; any other file is foreign, and the folder is then not replaced."""


def _require_own(out: Path) -> None:
    names = {path.name for path in out.iterdir()}
    foreign = sorted(names - OWN_ENTRIES)
    if foreign:
        raise InputError(
            f"{out}: contains files that are not part of a scene folder ({foreign[0]}); choose an empty or new folder"
        )
    if names:
        try:
            data = read_json(out / SCENE_FILE)
        except InputError:
            data = None
        if not isinstance(data, dict) or not str(data.get("format", "")).startswith("physgen-scene/"):
            raise InputError(
                f"{out}: contains files that are not part of a scene folder ({SCENE_FILE}); choose an empty one"
            )


@contextmanager
def replacing_folder(out: Path) -> Iterator[Path]:
    """Yield a fresh temporary folder beside ``out``; on success it becomes ``out``, on failure it is removed.

    ``out`` is held by this thread meanwhile (``lock_beside``), and exchanged at the end (``replacing_tree``). An
    existing ``out`` is only replaced when it is empty or a scene folder, so that a mistyped path cannot destroy files.
    Raises InputError otherwise, or when the location cannot be written.
    """
    out = out.resolve()
    try:
        with lock_beside(out):
            recover(out)
            if out.is_dir():
                _require_own(out)
            elif out.exists() or out.is_symlink():
                raise InputError(f"{out}: is a file; choose a folder")
            with replacing_tree(out) as partial:
                yield partial
                write_scene_sums(partial)
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror or error}); free space or choose another folder"
        ) from error
