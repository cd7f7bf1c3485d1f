# SPDX-License-Identifier: MIT
"""Masks and labels that lie beside the pictures of a folder of views: ``labels/NAME.png``, ``masks/``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...scene.folder import inside
from .pictures import Budget, read_numbers, read_share
from .view import OUTSIDE, Labels, Picture

ORDER = ("background", "foreground")
"""Names of folders under ``masks`` that tell by themselves which object is which."""
MAX_LABEL = 16
STRAY_SHARE = 0.2
"""Of the labelled pixels that may lie outside the mask: outlines of two programs differ along their edge."""


def objects_in(folder: Path, given: Sequence[str]) -> tuple[str, ...]:
    """Names of the folders under ``folder/masks``, the background object first; () where there are none.

    given: that order; may be left out where it is clear. Raises InputError where it is not, or does not fit.
    """
    masks = folder / "masks"
    found = sorted(entry.name for entry in masks.iterdir() if entry.is_dir()) if masks.is_dir() else []
    if given:
        if missing := [name for name in given if name not in found]:
            raise InputError(
                f"{masks}: has no folder {missing[0]!r} of an object's masks ({', '.join(found) or 'none'} are there)"
            )
        return tuple(given)
    if not found or found == list(ORDER):
        return tuple(found)
    if len(found) == 1:
        return tuple(found)
    raise InputError(
        f"{masks}: has the objects {', '.join(found)[:120]}: say which is covered and which covers it, for example "
        f"objects={found[0]},{found[1]}"
    )


def read_labels(
    folder: Path, name: str, objects: Sequence[str], size: tuple[int, int], budget: Budget
) -> Labels | None:
    """(H, W) whose each pixel of the view ``name`` is; None where nothing tells. Raises InputError.

    ``labels/NAME.png`` comes first. Of masks that overlap, that of the later object has the pixel: it covers the other.
    """
    path = folder / "labels" / f"{name}.png"
    if path.exists():
        return _from_numbers(read_numbers(inside(folder, f"labels/{name}.png"), size, budget), path)
    files = [f"masks/{entry}/{name}.png" for entry in objects]
    if not any((folder / file).exists() for file in files):
        return None
    labels = np.full(size, OUTSIDE, dtype=np.int8)
    for label, file in enumerate(files, start=1):
        if not (folder / file).exists():
            raise InputError(
                f"{folder / file}: there is no such mask, and one of another object is: add it, black where unseen"
            )
        labels[read_share(inside(folder, file), size, budget) > 0.5] = label
    return labels


def _from_numbers(numbers: NDArray[np.int64], path: Path) -> Labels:
    if numbers.min() < 0 or numbers.max() > MAX_LABEL:
        values = ", ".join(str(v) for v in np.unique(numbers)[:6])
        raise InputError(
            f"{path}: holds {values}: give 0 outside, 1 on the background object, 2 on the foreground object (up to "
            f"{MAX_LABEL})"
        )
    return np.where(numbers == 0, OUTSIDE, numbers).astype(np.int8)


def check_together(name: str, mask: Picture, labels: Labels) -> None:
    """Raise InputError when most of what ``labels`` (H, W) name lies where ``mask`` (H, W) says that nothing is."""
    owned = labels > 0
    stray = int((owned & (mask < 0.5)).sum())
    if stray > STRAY_SHARE * max(1, int(owned.sum())):
        raise InputError(
            f"view {name!r}: {stray} of {int(owned.sum())} labelled pixels lie outside its mask: they are not of the "
            "same picture, or one of them is wrong"
        )
