# SPDX-License-Identifier: MIT
"""A user's program as a stage: what it is given as files, what it leaves as files."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...arrays import read_npy, read_npz
from ...errors import InputError
from ...events import IsCancelled
from ...scene.meshes import MAX_MESH_BYTES
from .checked import checked_depth, checked_masks, checked_mesh, checked_pixels
from .command_file import CommandFile
from .crop import object_crop
from .protocols import Depth, Mask, Pixels
from .run_command import run_command

HEADER = 2**16
"""Bytes that a file may have besides its numbers."""


@dataclass(frozen=True)
class _Command:
    file: CommandFile
    cancelled: IsCancelled

    @property
    def where(self) -> str:
        return f"adapter command:{self.file.path}"

    @contextmanager
    def run(self, places: dict[str, Any], most_bytes: int) -> Iterator[Path]:
        """Write ``places`` (pictures, JSON) into a folder of its own, run the program, and give its output."""
        with tempfile.TemporaryDirectory(prefix="physgen-adapter-", ignore_cleanup_errors=True) as name:
            folder = Path(name)
            files: dict[str, Path | str] = {"here": self.file.path.resolve().parent, "python": sys.executable}
            for key, content in places.items():
                files[key] = _written(folder / key, content)
            output = folder / self.file.output
            files["output"] = output
            if not output.suffix:
                output.mkdir()
            run_command(
                self.file.arguments(files),
                self.file.folder or folder,
                self.file.environment,
                self.file.time_limit_s,
                output,
                most_bytes,
                self.cancelled,
                self.where,
            )
            yield output


def _written(path: Path, content: Any) -> Path:
    if isinstance(content, np.ndarray):
        path = path.with_suffix(".png")
        Image.fromarray(content).save(path, compress_level=1)
    else:
        path = path.with_suffix(".json")
        path.write_text(json.dumps(content), encoding="utf-8")
    return path


@dataclass(frozen=True)
class SegmenterCommand(_Command):
    """``protocols.Segmenter`` by a program: {input} PNG, {boxes} JSON, {output} arrays or a folder of PNGs."""

    def __call__(self, pixels: Pixels, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """As the protocol says. Raises InputError."""
        shape, count = pixels.shape[:2], len(boxes)
        most = count * shape[0] * shape[1] * 8 + HEADER
        with self.run({"input": pixels, "boxes": np.asarray(boxes).tolist()}, most) as output:
            if output.is_dir():
                found: Any = [
                    _picture(output / f"{i}.png", (shape[1], shape[0]), "L", self.where) > 127 for i in range(count)
                ]
            else:
                found = _arrays(output, most, ("masks",), self.where)
                found = found["masks"]
            return checked_masks(found, (shape[0], shape[1]), count, self.where)


@dataclass(frozen=True)
class InpainterCommand(_Command):
    """``protocols.Inpainter`` by a program: {input} PNG, {mask} PNG, white in the hole, {output} PNG."""

    def __call__(self, pixels: Pixels, hole: Mask) -> Pixels:
        """As the protocol says. Raises InputError."""
        most = pixels.size * 4 + HEADER
        with self.run({"input": pixels, "mask": hole.astype(np.uint8) * 255}, most) as output:
            filled = _picture(output, (pixels.shape[1], pixels.shape[0]), "RGB", self.where)
        return checked_pixels(filled, pixels, hole, self.where)


@dataclass(frozen=True)
class DepthCommand(_Command):
    """``protocols.DepthEstimator`` by a program: {input} PNG, {output} array, or arrays depth and focal_px."""

    def __call__(self, pixels: Pixels) -> Depth:
        """As the protocol says. Raises InputError."""
        most = pixels.shape[0] * pixels.shape[1] * 64 + HEADER
        with self.run({"input": pixels}, most) as output:
            found = _arrays(output, most, ("depth", "focal_px"), self.where)
        return checked_depth(found, (pixels.shape[0], pixels.shape[1]), self.file.meaning, self.where)


@dataclass(frozen=True)
class MesherCommand(_Command):
    """``protocols.Mesher`` by a program: {input} PNG of the object alone, {photo} and {mask} PNGs, {output} mesh."""

    def __call__(self, pixels: Pixels, mask: Mask, folder: Path) -> Path:
        """As the protocol says; what lies beside the mesh (.mtl, .bin, textures) comes along. Raises InputError."""
        places = {"input": object_crop(pixels, mask), "photo": pixels, "mask": mask.astype(np.uint8) * 255}
        with self.run(places, MAX_MESH_BYTES) as output:
            given = {f"{key}.png" for key in places}
            for beside in sorted(output.parent.iterdir()):
                small = beside.is_file() and not beside.is_symlink() and beside.stat().st_size <= MAX_MESH_BYTES
                if small and beside.name not in given:
                    shutil.copyfile(beside, folder / beside.name)
        return checked_mesh(output.name, folder, self.where)


def _picture(path: Path, size: tuple[int, int], mode: str, where: str) -> NDArray[np.uint8]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=("PNG",)) as image:
                if image.size != size:
                    raise InputError(
                        f"{where}: wrote {path.name} of {image.size[0]}x{image.size[1]} pixels, expected "
                        f"{size[0]}x{size[1]}, the size of its input"
                    )
                if image.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
                    raise InputError(f"{where}: wrote {path.name} of the kind {image.mode}, expected 8 bits a channel")
                return np.array(image.convert(mode), dtype=np.uint8)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{where}: wrote no {path.name}") from None
    # Decoders of damaged files fail in whatever way the garbage leads them to (SyntaxError, struct.error, …).
    except Exception as error:
        raise InputError(f"{where}: {path.name} is no readable PNG ({type(error).__name__}: {error})") from error


def _arrays(path: Path, most_bytes: int, names: tuple[str, ...], where: str) -> dict[str, NDArray[Any]]:
    """The arrays called ``names``, the first of them at least; of ``.npy``, and of an archive of one, that is it."""
    try:
        if path.suffix.lower() == ".npy":
            return {names[0]: read_npy(path, most_bytes)}
        found = read_npz(path, most_bytes)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    if names[0] not in found and len(found) == 1:
        return {names[0]: next(iter(found.values()))}
    if names[0] not in found:
        raise InputError(f"{where}: {path.name} has no array {names[0]!r}; it has {', '.join(found)[:100] or 'none'}")
    return {name: found[name] for name in names if name in found}
