# SPDX-License-Identifier: MIT
"""Masks of other programs as objects to reconstruct: written as pictures, where a correction finds them again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..atomic import replacing
from ..errors import InputError
from ..importers.masks import read_masks
from ..reconstruct import ObjectRequest
from ..reconstruct.photo import load_photo


def requests_of_masks(
    path: Path, photo: Path, folder: Path, *, max_size: int, only: Sequence[str] = ()
) -> tuple[ObjectRequest, ...]:
    """An object for each mask in ``path`` (``sim.importers.masks``) of ``photo``, its mask written into ``folder``.

    max_size: longest side in pixels of the masks that are written, as the reconstruction will work. only: names of
    those that are wanted; () for all. Raises InputError for what cannot be read, or holds no mask.
    """
    picture = load_photo(photo, max_size)
    found = read_masks(path, picture.width, picture.height, photo.name, only)
    if not found:
        raise InputError(f"{path}: holds no mask; give --box around each object instead")
    requests = []
    for item in found:
        target = folder / f"{item.name}.png"
        with replacing(target) as partial:
            Image.fromarray(item.mask.astype(np.uint8) * 255).save(partial)
        requests.append(ObjectRequest(mask=target, name=item.name, kind=item.kind))
    return tuple(requests)
