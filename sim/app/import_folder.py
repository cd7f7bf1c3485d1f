# SPDX-License-Identifier: MIT
"""Files of other programs: a folder of PhysGen or PhysGen3D or a splat file → a scene folder; masks → objects."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..atomic import replacing
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..importers import DEFAULT_UP_AXIS
from ..importers.masks import read_masks
from ..importers.physgen import MASKS, SETTINGS, import_physgen
from ..importers.physgen3d import TRANSFORM_FILE
from ..importers.physgen3d_scene import import_physgen3d
from ..importers.splat_scene import import_splats
from ..reconstruct import ObjectRequest
from ..reconstruct.photo import load_photo
from ..scene.folder import Scene


def mask_requests(
    path: Path, photo: Path, folder: Path, *, max_size: int, only: Sequence[str] = ()
) -> tuple[ObjectRequest, ...]:
    """Return an object request for each mask in ``path`` (``sim.importers.masks``) of ``photo``; writes the masks to
    ``folder``, where a correction finds them again.

    max_size: longest side in pixels of the written masks, the resolution of the reconstruction. only: names to import;
    () for all. Raises InputError for files that cannot be read or hold no mask.
    """
    picture = load_photo(photo, max_size)
    found = read_masks(path, picture.width, picture.height, photo.name, only)
    if not found:
        raise InputError(f"{path}: contains no mask; give --box around each object instead")
    requests = []
    for item in found:
        target = folder / f"{item.name}.png"
        with replacing(target) as partial:
            Image.fromarray(item.mask.astype(np.uint8) * 255).save(partial)
        requests.append(ObjectRequest(mask=target, name=item.name, kind=item.kind))
    return tuple(requests)


def import_folder(
    root: Path,
    *,
    out: Path,
    size_m: float | None = None,
    settings: Path | None = None,
    up: str | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Scene:
    """Return the scene folder ``out`` made of ``root``: a folder of PhysGen3D or PhysGen, or a splat file.

    size_m: largest extent of the first object in metres. settings: YAML file of PhysGen3D's simulation. up: up axis of
    a splat file, one of ``SPLAT_UP_AXES``. Raises InputError for anything else and for arguments that do
    not apply, and what the importers raise.
    """
    if root.is_file():
        if settings is not None:
            raise InputError(f"--settings {settings}: {root} is a splat file, which has none; omit the flag")
        return import_splats(root, out=out, size_m=size_m, up=up or DEFAULT_UP_AXIS, on_event=on_event)
    if up is not None:
        raise InputError(f"--up {up}: {root} is not a splat file; omit the flag")
    if (root / TRANSFORM_FILE).is_file():
        return import_physgen3d(root, out=out, size_m=size_m, settings=settings, on_event=on_event)
    if (root / SETTINGS).is_file() and (root / MASKS).is_file():
        if settings is not None:
            raise InputError(f"--settings {settings}: PhysGen's settings are {root / SETTINGS}; omit the flag")
        return import_physgen(root, out=out, size_m=size_m, on_event=on_event, cancelled=cancelled)
    raise InputError(
        f"{root}: contains neither {TRANSFORM_FILE} of PhysGen3D's perception nor {SETTINGS} and {MASKS} of PhysGen; "
        "choose such a folder, or a PLY file of splats"
    )
