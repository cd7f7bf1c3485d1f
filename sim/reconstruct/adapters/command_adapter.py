# SPDX-License-Identifier: MIT
"""A user's program as a stage: files in and out, no shell, a time limit, no processes left behind."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...atomic import scratch_prefix
from ...errors import Cancelled, InputError
from ...events import IsCancelled
from ...files import MAX_PICTURE_BYTES, open_file
from ...memory import how_it_was_killed, memory_kills
from ...npz import read_npy, read_npz
from ...processes import note_child
from ...scene.meshes import MAX_MESH_BYTES
from .adapter_registry import program_python
from .command_file import CommandFile
from .protocols import Depth, Mask, Pixels, checked_depth, checked_masks, checked_mesh, checked_pixels

MARGIN = 0.1
"""Empty border on each side, as a share of the square's side."""


def object_crop(pixels: Pixels, mask: Mask) -> NDArray[np.uint8]:
    """(S, S, 4) uint8: ``pixels`` (H, W, 3) cut to the ``mask`` (H, W), alpha 255 in it, black and 0 around it.

    Raises InputError for an empty mask.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        raise InputError("mask: is empty; there is no object to make a mesh of")
    top, left = int(rows[0]), int(columns[0])
    height, width = int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left
    side = max(1, round(max(height, width) / (1 - 2 * MARGIN)))
    crop = np.zeros((side, side, 4), dtype=np.uint8)
    y, x = (side - height) // 2, (side - width) // 2
    inside = mask[top : top + height, left : left + width]
    part = crop[y : y + height, x : x + width]
    part[inside, :3] = pixels[top : top + height, left : left + width][inside]
    part[inside, 3] = 255
    return crop


POLL_S = 0.05
MOST_LINE_BYTES = 2**16
TAIL_LINES = 12
TAIL_CHARACTERS = 2000
_STRIPPED = ("PYTHON", "LD_", "DYLD_")
"""Prefixes of variables that would make the user's interpreter load this one's libraries; ``environment`` can set
them."""


def run_command(
    arguments: Sequence[str],
    folder: Path,
    environment: Sequence[tuple[str, str]],
    time_limit_s: float,
    output: Path,
    most_bytes: int,
    cancelled: IsCancelled,
    where: str,
) -> None:
    """Run ``arguments`` in ``folder`` until it has written ``output``, a file of at most ``most_bytes``, or a folder.

    The process and its children are killed at the time limit, when ``cancelled()`` is true, when ``output`` grows too
    large, and when it has ended. Raises InputError, with ``where`` and the last lines of output, unless it exits with 0
    and leaves ``output``; raises Cancelled.
    """
    kept = {name: text for name, text in os.environ.items() if not name.upper().startswith(_STRIPPED)}
    kills = memory_kills()
    try:
        process = subprocess.Popen(
            list(arguments),
            cwd=folder,
            env={**kept, **dict(environment)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=os.name != "nt",
            creationflags=0x08000200 if os.name == "nt" else 0,  # no window, a process group of its own
        )
        note_child(process)
    except (OSError, ValueError) as error:
        raise InputError(f"{where}: {arguments[0]} cannot be started ({error}); correct its command") from None
    tail: deque[str] = deque(maxlen=TAIL_LINES)
    assert process.stdout is not None
    reader = threading.Thread(target=_keep_tail, args=(process.stdout, tail), daemon=True)
    reader.start()
    try:
        reason = _wait(process, time_limit_s, output, most_bytes, cancelled)
    finally:
        _kill(process)
        # A process that escaped into its own session may hold the pipe open for ever: do not wait for it.
        reader.join(timeout=1)
    words = "\n".join(tail)[-TAIL_CHARACTERS:].strip() or "no output"
    if reason is not None:
        raise InputError(f"{where}: {reason}; it was killed. Last output: {words}")
    if process.returncode != 0:
        killed = f" ({how_it_was_killed(kills)})" if process.returncode == -getattr(signal, "SIGKILL", 0) else ""
        raise InputError(f"{where}: ended with code {process.returncode}{killed}. Last output: {words}")
    if not output.is_file() and not output.is_dir():
        raise InputError(f"{where}: wrote no {output.name}; it must write to {{output}}. Last output: {words}")
    if output.is_file() and output.stat().st_size > most_bytes:
        raise InputError(f"{where}: {_too_large(output, most_bytes)}")


def _wait(
    process: subprocess.Popen[bytes], limit_s: float, output: Path, most_bytes: int, cancelled: IsCancelled
) -> str | None:
    """The reason it had to be stopped; None if it ended by itself."""
    end = time.monotonic() + limit_s
    while process.poll() is None:
        if cancelled():
            raise Cancelled("cancelled while a user's program ran; it was killed")
        if time.monotonic() > end:
            return f"did not end within {limit_s:g} s (time_limit_s)"
        with contextlib.suppress(OSError):
            if output.is_file() and output.stat().st_size > most_bytes:
                return _too_large(output, most_bytes)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(POLL_S)
    return None


def _too_large(output: Path, most_bytes: int) -> str:
    return f"wrote {output.stat().st_size} bytes to {output.name}, more than the {most_bytes} that fit this picture"


def _keep_tail(stream: IO[bytes], tail: deque[str]) -> None:
    with contextlib.suppress(OSError, ValueError):
        while line := stream.readline(MOST_LINE_BYTES):
            text = line.decode("utf-8", "replace").rstrip()
            if text:
                tail.append(text[-TAIL_CHARACTERS:])


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill ``process`` and its children, also those that outlive it."""
    if os.name == "nt":
        if process.poll() is None:
            system = Path(os.environ.get("SYSTEMROOT", r"C:\Windows")) / "System32" / "taskkill.exe"
            with contextlib.suppress(OSError):
                subprocess.run([str(system), "/T", "/F", "/PID", str(process.pid)], capture_output=True, check=False)
    else:
        # The process group has its id, and exists as long as one of its members does.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(OSError):
        process.kill()
    process.wait()


HEADER = 2**16
"""Bytes of headers that a file may have besides its numbers."""


@dataclass(frozen=True)
class _Command:
    file: CommandFile
    cancelled: IsCancelled

    @property
    def where(self) -> str:
        return f"adapter command:{self.file.path}"

    @contextmanager
    def run(self, places: dict[str, Any], most_bytes: int) -> Iterator[Path]:
        """Write ``places`` (pictures, JSON) into a temporary folder, run the program, and yield its output."""
        with tempfile.TemporaryDirectory(prefix=scratch_prefix("adapter"), ignore_cleanup_errors=True) as name:
            folder = Path(name)
            files: dict[str, Path | str] = {"here": self.file.path.resolve().parent, "python": sys.executable}
            for key, content in places.items():
                files[key] = _written(folder / key, content)
            if self.file.program is not None:
                files |= {"program": self.file.program, "program_python": program_python(self.file.program)}
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
        """As the protocol says; files beside the mesh (.mtl, .bin, textures) are copied too. Raises InputError."""
        places = {"input": object_crop(pixels, mask), "photo": pixels, "mask": mask.astype(np.uint8) * 255}
        with self.run(places, MAX_MESH_BYTES) as output:
            if output.is_dir():
                output = self._result(output)
            given = {f"{key}.png" for key in places}
            for beside in sorted(output.parent.iterdir()):
                small = beside.is_file() and not beside.is_symlink() and beside.stat().st_size <= MAX_MESH_BYTES
                if small and beside.name not in given:
                    shutil.copyfile(beside, folder / beside.name)
        return checked_mesh(output.name, folder, self.where)

    def _result(self, folder: Path) -> Path:
        """The mesh in ``folder`` that the first pattern finds; the last by name where it finds several."""
        for pattern in self.file.results:
            found = sorted(p for p in folder.glob(pattern) if p.is_file() and not p.is_symlink())
            if found:
                return found[-1]
        there = ", ".join(sorted(p.name for p in folder.rglob("*"))[:8]) or "nothing"
        raise InputError(f"{self.where}: wrote no {' or '.join(self.file.results)}; there is {there}")


def _picture(path: Path, size: tuple[int, int], mode: str, where: str) -> NDArray[np.uint8]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with open_file(path, MAX_PICTURE_BYTES, what="PNG") as file, Image.open(file, formats=("PNG",)) as image:
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
    # Decoders of damaged files raise arbitrary exceptions (SyntaxError, struct.error, …).
    except Exception as error:
        raise InputError(f"{where}: {path.name} is no readable PNG ({type(error).__name__}: {error})") from error


def _arrays(path: Path, most_bytes: int, names: tuple[str, ...], where: str) -> dict[str, NDArray[Any]]:
    """Return the arrays called ``names``, at least the first; the only array of a ``.npy`` or archive counts as the
    first."""
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
