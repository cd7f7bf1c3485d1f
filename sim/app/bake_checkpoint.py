# SPDX-License-Identifier: MIT
"""Checkpoints, from which a stopped bake resumes: state of the engine, number of complete frames, their metrics."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import replacing
from ..cache.bake_folder import CHECKPOINT_FILE, BakeManifest, load_manifest
from ..cache.pc2 import Pc2Reader
from ..errors import InputError

State = Mapping[str, NDArray[np.generic]]


@dataclass(frozen=True)
class Checkpoint:
    """frames_done: samples that belong to it; its ``state`` may be of a time between the last of them and the next.

    metrics: of those frames.
    """

    frames_done: int
    metrics: list[dict[str, Any]]
    state: State


def save_checkpoint(out: Path, inputs_hash: str, checkpoint: Checkpoint) -> None:
    """Write the checkpoint of the bake folder ``out``, whole or not at all. Raises InputError when the disk is full."""
    with replacing(out / CHECKPOINT_FILE) as partial:
        arrays: dict[str, Any] = {f"state.{key}": value for key, value in checkpoint.state.items()}
        np.savez(
            partial,
            inputs_hash=np.array(inputs_hash),
            frames_done=np.array(checkpoint.frames_done),
            metrics=np.array(json.dumps(checkpoint.metrics)),
            **arrays,
        )


def drop_checkpoint(out: Path) -> None:
    """Forget the checkpoint of the bake folder ``out``."""
    (out / CHECKPOINT_FILE).unlink(missing_ok=True)


def resume(out: Path, manifest: BakeManifest, world: Any) -> tuple[int, list[dict[str, Any]]]:
    """Restore the last checkpoint if it belongs to these inputs: frames already done and their metrics, or 0."""
    try:
        if load_manifest(out).inputs_hash != manifest.inputs_hash:
            return 0, []
        checkpoint = _load(out / CHECKPOINT_FILE, manifest)
        if checkpoint is None:
            return 0, []
        for name, count in manifest.files.items():
            cache = Pc2Reader(out / name)
            if cache.sample_count < checkpoint.frames_done or cache.vertex_count != count:
                return 0, []
        if not all((out / name).is_file() for name in manifest.splat_frames(checkpoint.frames_done)):
            return 0, []
        world.restore(checkpoint.state)
    except (InputError, OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
        # A checkpoint that a crash left unreadable costs a fresh start, never the run.
        return 0, []
    return checkpoint.frames_done, checkpoint.metrics


def _load(path: Path, manifest: BakeManifest) -> Checkpoint | None:
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as data:
        if str(data["inputs_hash"]) != manifest.inputs_hash:
            return None
        found = Checkpoint(
            frames_done=int(data["frames_done"]),
            metrics=json.loads(str(data["metrics"])),
            state={key.removeprefix("state."): data[key] for key in data.files if key.startswith("state.")},
        )
    good = 0 < found.frames_done <= manifest.frames and len(found.metrics) == found.frames_done
    return found if good else None
