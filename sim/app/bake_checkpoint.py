# SPDX-License-Identifier: MIT
"""Checkpoints, from which a stopped bake resumes: state of the engine, number of complete frames, their metrics."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..cache.bake_check import require_intact
from ..cache.bake_folder import CHECKPOINT_FILE, Bake, BakeManifest, load_manifest
from ..cache.pc2 import Pc2Reader
from ..errors import InputError
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
        checkpoint = _load(out / CHECKPOINT_FILE, manifest)
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


def _load(path: Path, manifest: BakeManifest) -> Checkpoint | None:
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
