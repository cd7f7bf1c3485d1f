# SPDX-License-Identifier: MIT
"""``manifest.json`` of a bake folder: what was baked from what, and how far it got."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..atomic import write_json
from ..errors import InputError
from ..scene.folder import inside
from ..scene.json_fields import parse, read_json, to_json

FORMAT = "physgen-bake/1"
MANIFEST_FILE = "manifest.json"
STATES = ("running", "complete", "cancelled")


@dataclass(frozen=True, kw_only=True)
class BakedObject:
    """One object's cache: ``file`` is the PC2 relative to the bake folder, ``vertices`` its count."""

    name: str
    file: str
    vertices: int


@dataclass(frozen=True, kw_only=True)
class BakeManifest:
    """The state of one bake.

    inputs_hash: SHA-256 over everything that the motion depends on (sim/app/bake.py: inputs_hash).
    fps, frame_start, frames: frame ``frame_start + i`` is sample ``i`` at ``i / fps`` seconds.
    frames_done: samples that every cache holds.
    particles: simulated particles of all objects together.
    geometry_hash: SHA-256 over the objects' meshes and where they stand (sim/app/bake_inputs.py: geometry_hash), by
        which a bake of another scene is told; empty when not known.
    """

    inputs_hash: str
    fps: float
    frame_start: int
    frames: int
    frames_done: int
    state: str
    engine: str
    version: str
    particles: int
    objects: tuple[BakedObject, ...]
    geometry_hash: str = ""

    def __post_init__(self) -> None:
        if self.state not in STATES:
            raise InputError(f"state is {self.state!r}: choose one of {', '.join(STATES)}")
        if self.fps <= 0 or self.frames < 1 or not 0 <= self.frames_done <= self.frames:
            raise InputError(
                f"{self.frames_done} of {self.frames} frames at {self.fps} fps is no frame range; bake again"
            )


def load_manifest(folder: Path) -> BakeManifest:
    """Read the manifest of the bake ``folder``. Raises InputError when there is none or it is not readable."""
    path = folder / MANIFEST_FILE
    if not path.is_file():
        raise InputError(f"{folder}: no bake there ({MANIFEST_FILE} is missing); run `physgen bake` first")
    data = read_json(path)
    if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
        raise InputError(f"{path}: not of format {FORMAT!r}; bake again with this version")
    manifest = parse(BakeManifest, data, str(path))
    for item in manifest.objects:
        inside(folder, item.file)
    return manifest


def save_manifest(folder: Path, manifest: BakeManifest) -> None:
    """Write the manifest whole or not at all."""
    write_json(folder / MANIFEST_FILE, {"format": FORMAT, **to_json(manifest)})
