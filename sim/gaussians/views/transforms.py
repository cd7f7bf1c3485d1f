# SPDX-License-Identifier: MIT
"""A folder of pictures with their cameras → views; docs/file-formats.md, Views folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...errors import InputError
from ...scene.folder import inside
from .backdrop import plain_backdrop_mask
from .frames import Frame, read_frames
from .outside import check_together, objects_in, read_labels
from .pictures import Budget, read_colours, read_share
from .view import Picture, View, before_white

TRANSFORMS = "transforms.json"
ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".bmp")


def read_views(source: Path, *, objects: Sequence[str] = ()) -> tuple[View, ...]:
    """The views of the folder ``source``, or of another file in the place of its transforms.json.

    A mask is what the frame or ``masks/NAME.png`` says, else the picture's opacity, else all that is labelled, else
    what stands before a plain backdrop. objects: names of the folders under ``masks``, the background object first.

    Raises InputError when cameras are missing or distorted, a file is missing, damaged, outside the folder or of
    another size, masks and labels contradict each other, or all is too large.
    """
    path = source / TRANSFORMS if source.is_dir() else source
    folder = path.parent
    if not path.is_file():
        raise InputError(_without_cameras(source))
    frames = read_frames(path)
    names = _names(frames)
    order = objects_in(folder, objects)
    budget = Budget()
    return tuple(_read(folder, frame, name, order, budget) for frame, name in zip(frames, names, strict=True))


def _without_cameras(source: Path) -> str:
    pictures = [p for p in source.iterdir() if p.suffix.lower() in ENDINGS] if source.is_dir() else []
    if not pictures:
        return f"{source}: there is no such file; give a folder with {TRANSFORMS} and its pictures"
    return (
        f"{source}: has {len(pictures)} pictures and no {TRANSFORMS}, so nobody knows where their cameras are: write "
        "one, for example with COLMAP and instant-ngp's colmap2nerf.py, or give a picture of SyncDreamer or Zero123++"
    )


def _names(frames: Sequence[Frame]) -> list[str]:
    """A name for each frame: that of its file, with that of its folders where two would be the same."""
    parts = [[part for part in frame.file.split("/") if part not in ("", ".")] for frame in frames]
    short = [Path(part[-1]).stem if part else "" for part in parts]
    if len(set(short)) == len(short):
        return short
    full = ["_".join([*part[:-1], stem]) for part, stem in zip(parts, short, strict=True)]
    if len(set(full)) < len(full):
        twice = next(name for name in full if full.count(name) > 1)
        where = frames[full.index(twice)].where
        raise InputError(f"{where}: has the picture {twice[:60]!r}, which another frame has too: leave one out")
    return full


def _read(folder: Path, frame: Frame, name: str, objects: Sequence[str], budget: Budget) -> View:
    colours, alpha = read_colours(_picture(folder, frame), budget)
    size = (colours.shape[0], colours.shape[1])
    camera = frame.camera(size[1], size[0])
    labels = read_labels(folder, name, objects, size, budget)
    mask_file = frame.mask_file or f"masks/{name}.png"
    if frame.mask_file or (folder / mask_file).is_file():
        mask: Picture | None = read_share(inside(folder, mask_file), size, budget)
    elif alpha is not None:
        mask = alpha
    elif labels is not None:
        mask = (labels > 0).astype(colours.dtype)
    else:
        mask = plain_backdrop_mask(colours)
    if mask is not None and labels is not None:
        check_together(name, mask, labels)
    pixels = colours if mask is None else before_white(colours, mask)
    return View(name=name, camera=camera, pixels=pixels, mask=mask, labels=labels)


def _picture(folder: Path, frame: Frame) -> Path:
    """The frame's file; NeRF's own data sets leave its ending out."""
    try:
        path = inside(folder, frame.file)
        found = path.is_file()
    except (InputError, OSError, ValueError) as error:
        raise InputError(f"{frame.where}: {error}") from None
    if found:
        return path
    for ending in ENDINGS:
        other = inside(folder, frame.file + ending)
        if other.is_file():
            return other
    raise InputError(f"{frame.where}: there is no picture {path}: restore it, or leave the frame out")
