# SPDX-License-Identifier: MIT
"""What another program has written, a folder or a file of splats → a scene folder."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..importers.physgen import MASKS, SETTINGS
from ..importers.physgen3d import TRANSFORM_FILE
from ..scene.folder import SceneFolder
from .import_physgen import import_physgen
from .import_physgen3d import import_physgen3d
from .import_splats import DEFAULT_UP, import_splats


def import_folder(
    root: Path,
    out: Path,
    *,
    size_m: float | None = None,
    settings: Path | None = None,
    up: str | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Turn ``root`` into the scene folder ``out``: PhysGen3D's if it has a ``transform.json``, else PhysGen's; or a
    file of splats.

    size_m: largest extent of the first object in metres. settings: YAML file of PhysGen3D's simulation. up: axis of a
    file of splats, one of ``import_splats.UPS``.
    Raises InputError for what is none of them or does not go with them, and what their importers raise.
    """
    if root.is_file():
        if settings is not None:
            raise InputError(f"--settings {settings}: {root} is a file of splats, which has none; leave the flag out")
        return import_splats(root, out, size_m=size_m, up=up or DEFAULT_UP, on_event=on_event)
    if up is not None:
        raise InputError(f"--up {up}: {root} is no file of splats; leave the flag out")
    if (root / TRANSFORM_FILE).is_file():
        return import_physgen3d(root, out, size_m=size_m, settings=settings, on_event=on_event)
    if (root / SETTINGS).is_file() and (root / MASKS).is_file():
        if settings is not None:
            raise InputError(f"--settings {settings}: PhysGen's settings are {root / SETTINGS}; leave the flag out")
        return import_physgen(root, out, size_m=size_m, on_event=on_event, cancelled=cancelled)
    raise InputError(
        f"{root}: holds neither {TRANSFORM_FILE}, as PhysGen3D's perception writes it, nor {SETTINGS} and {MASKS}, as "
        "PhysGen has them; choose such a folder, or a PLY file of splats"
    )
