# SPDX-License-Identifier: MIT
"""A folder of another program → a scene folder, whichever program it is of."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..importers.physgen import MASKS, SETTINGS
from ..importers.physgen3d import TRANSFORM_FILE
from ..scene.folder import SceneFolder
from .import_physgen import import_physgen
from .import_physgen3d import import_physgen3d


def import_folder(
    root: Path,
    out: Path,
    *,
    size_m: float | None = None,
    settings: Path | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Turn ``root`` into the scene folder ``out``: PhysGen3D's if it has a ``transform.json``, else PhysGen's.

    size_m: largest extent of the first object in metres. settings: YAML file of PhysGen3D's simulation.
    Raises InputError for a folder of neither, and what their importers raise.
    """
    if (root / TRANSFORM_FILE).is_file():
        return import_physgen3d(root, out, size_m=size_m, settings=settings, on_event=on_event)
    if (root / SETTINGS).is_file() and (root / MASKS).is_file():
        if settings is not None:
            raise InputError(f"--settings {settings}: PhysGen's settings are {root / SETTINGS}; leave the flag out")
        return import_physgen(root, out, size_m=size_m, on_event=on_event, cancelled=cancelled)
    raise InputError(
        f"{root}: holds neither {TRANSFORM_FILE}, as PhysGen3D's perception writes it, nor {SETTINGS} and {MASKS}, as "
        "PhysGen has them; choose such a folder"
    )
