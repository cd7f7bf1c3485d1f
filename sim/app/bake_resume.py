# SPDX-License-Identifier: MIT
"""Resume a bake: checkpoints of a stopped one, checksums while it is written, and repair of a damaged one.

A checkpoint is the state of the engine, the number of complete frames and their metrics. A damaged complete bake is
computed again up to where it is intact; what is intact stays.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..cache.bake_check import damage_of, require_intact
from ..cache.bake_folder import CHECKPOINT_FILE, METRICS_FILE, Bake, BakeManifest, load_manifest
from ..cache.pc2 import Pc2Reader, Pc2Writer
from ..checksums import Checksum, RunningSums, file_sum, span_for
from ..errors import InputError, PhysGenError
from ..files import is_file
from ..npz import read_npz
from ..validation import json_value

State = Mapping[str, NDArray[np.generic]]


@dataclass(frozen=True)
class Checkpoint:
    """frames_done: samples that belong to it; its ``state`` may be of a time between the last of them and the next.

    metrics: of those frames.
    """

    frames_done: int
    metrics: list[dict[str, Any]]
    state: State


MAX_STATE_BYTES = 2**36
"""Of a checkpoint, for reading; a larger one was never written."""


def save_checkpoint(out: Path, inputs_hash: str, checkpoint: Checkpoint) -> None:
    """Write the checkpoint of the bake folder ``out``, whole or not at all, and onto the disk before it counts.

    The samples that it stands for have to be on the disk already. Raises InputError when the disk is full.
    """
    arrays: dict[str, Any] = {f"state.{key}": np.asarray(value) for key, value in checkpoint.state.items()}
    arrays["inputs_hash"] = np.array(inputs_hash)
    arrays["frames_done"] = np.array(checkpoint.frames_done)
    arrays["metrics"] = np.array(json.dumps(checkpoint.metrics))
    with replacing(out / CHECKPOINT_FILE) as partial:
        np.savez(partial, **arrays, digest=np.array(_digest(arrays)))


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the BLAKE2b of ``arrays`` by name, 32 hexadecimal digits."""
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {arrays[name].shape};".encode())
        digest.update(array.tobytes() if array.dtype.kind == "U" else array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def drop_checkpoint(out: Path) -> None:
    """Forget the checkpoint of the bake folder ``out``, and its folder if that is empty then: whether there was one
    depends on the machine's speed.
    """
    (out / CHECKPOINT_FILE).unlink(missing_ok=True)
    with contextlib.suppress(OSError):
        (out / CHECKPOINT_FILE).parent.rmdir()


def resume(out: Path, manifest: BakeManifest, world: Any) -> tuple[int, list[dict[str, Any]], str | None]:
    """Restore the last checkpoint if it belongs to these inputs: frames already done and their metrics, or 0.

    The third is why a checkpoint that there is was not used, for a notice; None where nothing is wrong. A checkpoint,
    or a sample before it, that is damaged in whatever way costs a fresh start, never the run.
    """
    if not is_file(out / CHECKPOINT_FILE):
        return 0, [], None
    try:
        before = load_manifest(out)
        if before.inputs_hash != manifest.inputs_hash:
            return 0, [], None
        checkpoint = _load_checkpoint(out / CHECKPOINT_FILE, manifest)
        if checkpoint is None:
            return 0, [], None
        _require_samples(out, before, manifest, checkpoint.frames_done)
    except (InputError, OSError) as error:
        return 0, [], f"starting again from frame 1: {error}"
    untouched = world.checkpoint()
    try:
        world.restore(checkpoint.state)
    # Arrays of other shapes than this engine's: what NumPy and Taichi raise then is anybody's guess.
    except Exception as error:
        world.restore(untouched)
        return 0, [], f"starting again from frame 1: the checkpoint does not fit this engine ({str(error)[:200]})"
    return checkpoint.frames_done, checkpoint.metrics, None


def _require_samples(out: Path, before: BakeManifest, manifest: BakeManifest, samples: int) -> None:
    """Raise InputError unless the first ``samples`` samples in ``out`` are there, and are what was written."""
    for name, count in manifest.files.items():
        cache = Pc2Reader(out / name)
        if cache.sample_count < samples or cache.vertex_count != count:
            raise InputError(f"{out / name}: has {cache.sample_count} samples of {cache.vertex_count} points")
    for name in manifest.splat_frames(samples):
        if not is_file(out / name):
            raise InputError(f"{out / name}: is missing")
    require_intact(Bake(root=out, manifest=before), range(samples))


def _load_checkpoint(path: Path, manifest: BakeManifest) -> Checkpoint | None:
    """Return the checkpoint at ``path``; None where it is of other inputs. Raises InputError where it is damaged."""
    data = read_npz(path, MAX_STATE_BYTES, own=True)
    try:
        written = str(data.pop("digest")) if "digest" in data else None
        if written is not None and written != _digest(data):
            raise InputError(f"{path}: damaged, its content is not what was written")
        if str(data["inputs_hash"]) != manifest.inputs_hash:
            return None
        found = Checkpoint(
            frames_done=int(data["frames_done"]),
            metrics=json_value(str(data["metrics"]), str(path)),
            state={key.removeprefix("state."): data[key] for key in data if key.startswith("state.")},
        )
        good = 0 < found.frames_done <= manifest.frames and len(found.metrics) == found.frames_done
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged ({type(error).__name__}: {error})") from None
    if not good:
        raise InputError(f"{path}: damaged, it stands for {found.frames_done} of {manifest.frames} frames")
    return found


class OtherSamples(PhysGenError):
    """A bake cannot be mended: what is computed now is not what it holds."""


class BakeSums:
    """Checksums of the files of a bake that is being written: ``kept`` samples are there already."""

    def __init__(self, out: Path, manifest: BakeManifest, writers: Mapping[str, Pc2Writer], kept: int) -> None:
        self._out, self._manifest, self._writers = out, manifest, writers
        folders = [item.splats_folder for item in manifest.objects if item.splats_folder is not None]
        self._splats = {folder: RunningSums(span_for(manifest.frames)) for folder in folders}
        for index in range(kept):
            self.add_splats(index)

    def add_splats(self, index: int) -> None:
        """Take in the splat files of sample ``index``, now on disk."""
        for folder, sums in self._splats.items():
            sums.add(file_sum(self._out / f"{folder}/{self._manifest.frame_start + index:04d}.ply").encode())

    def to_disk(self) -> None:
        """Wait until all samples so far are on the disk."""
        for writer in self._writers.values():
            writer.to_disk()

    def checksums(self, *, ended: bool, metrics: bool) -> tuple[Checksum, ...]:
        """Return the checksums so far; of the last, incomplete range where the samples have ``ended``."""
        found = [writer.checksum(name, ended=ended) for name, writer in self._writers.items()]
        found += [sums.checksum(folder, ended=ended) for folder, sums in self._splats.items()]
        if metrics:
            found.append(Checksum(file=METRICS_FILE, sums=file_sum(self._out / METRICS_FILE)))
        return tuple(found)


@dataclass(frozen=True, kw_only=True)
class Mendable:
    """A complete bake with damage.

    samples: to compute again, from the first one. metrics: whether the metrics are damaged, too. text: what is, in
    words, for a notice.
    """

    manifest: BakeManifest
    samples: int
    metrics: bool
    text: str

    def require_same(self, sums: BakeSums) -> None:
        """Raise OtherSamples unless the samples computed again are those that the bake had, to the bit."""
        known = {entry.file: entry for entry in self.manifest.checksums}
        for entry in sums.checksums(ended=True, metrics=False):
            if not known[entry.file].sums.startswith(entry.sums):
                raise OtherSamples(f"{entry.file}: this machine computes other samples than those of the bake")

    def checksums(self, out: Path) -> tuple[Checksum, ...]:
        """Return the checksums of the bake ``out``, mended."""
        if not self.metrics:
            return self.manifest.checksums
        anew = Checksum(file=METRICS_FILE, sums=file_sum(out / METRICS_FILE))
        return tuple(anew if entry.file == METRICS_FILE else entry for entry in self.manifest.checksums)


def find_mendable(out: Path, manifest: BakeManifest) -> Mendable | None:
    """Return what to mend of the bake ``out``; None where nothing can be kept: it is no complete bake of the same
    inputs, has no checksums, or is damaged up to its end.
    """
    try:
        before = load_manifest(out)
        objects = tuple(item.without_tears() for item in before.objects)
        plain = dataclasses.replace(before, checksums=(), state="running", frames_done=0, objects=objects)
        if before.state != "complete" or not before.checksums or plain != manifest:
            return None
        found = damage_of(out, before)
    except (InputError, OSError):
        return None
    # Torn skins follow from all samples together.
    torn = {item.torn_file for item in before.objects} | set(before.torn_skin_file)
    if not found or any(damage.file in torn for damage in found):
        return None
    metrics = any(damage.file == METRICS_FILE for damage in found)
    span = span_for(before.frames)
    last = before.frames if metrics else max((max(damage.samples, default=-1) + 1 for damage in found), default=0)
    # Whole ranges, so that their sums can be compared.
    samples = min(-(-max(last, 1) // span) * span, before.frames)
    if samples == before.frames and not metrics:
        return None
    words = "; ".join(f"{out / damage.file}: {damage.text(before.frame_start)}" for damage in found[:3])
    return Mendable(manifest=before, samples=samples, metrics=metrics, text=words)
