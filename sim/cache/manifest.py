# SPDX-License-Identifier: MIT
"""``manifest.json`` of a bake folder: what was baked from what, and how far it got."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..atomic import write_json
from ..errors import InputError
from ..scene.folder import inside
from ..scene.json_fields import parse, read_json, to_json
from ..version import VERSION

FORMAT = "physgen-bake/1"
MANIFEST_FILE = "manifest.json"
STATES = ("running", "complete", "cancelled")

CHECKPOINT_FILE = "checkpoints/state.npz"
"""The engine's state to go on from, replaced now and then while a bake runs, gone when it is complete."""

METRICS_FILE = "metrics.json"

WORLD_SPACE, MESH_SPACE = "world", "mesh"
SPACES = (WORLD_SPACE, MESH_SPACE)
"""What samples are in: world metres, or the coordinates of the object's mesh file."""

GRAINS, SURFACE = "grains", "surface"
"""What particles are shown as: each by itself, or the surface that encloses them."""


SPLAT_POINTS = 4
"""Points of a splat in its cache: centre, and the ends of three half axes."""


@dataclass(frozen=True, kw_only=True)
class BakedObject:
    """One object's caches, files relative to the bake folder.

    file: PC2 of the mesh's vertices, of which there are ``vertices``.
    space: of all samples, one of ``SPACES``.
    points_file: PC2 of all particles, of which there are ``points``; None and 0 where they were not asked for or the
        object does not flow.
    points_as: what the particles are shown as, ``grains`` or ``surface``.
    splats_file: PC2 of its ``splats`` Gaussian splats, of each four points: its centre and the ends of its half axes.
    splats_folder: of their PLY files, one a frame. None, None and 0 for an object without splats.
    """

    name: str
    file: str
    vertices: int
    space: str = WORLD_SPACE
    points_file: str | None = None
    points: int = 0
    points_as: str = GRAINS
    splats_file: str | None = None
    splats_folder: str | None = None
    splats: int = 0

    def __post_init__(self) -> None:
        if self.points_as not in (GRAINS, SURFACE):
            raise InputError(f"object {self.name}: points_as is {self.points_as!r}: choose {GRAINS} or {SURFACE}")
        if self.space not in SPACES:
            raise InputError(f"object {self.name}: space is {self.space!r}: choose one of {', '.join(SPACES)}")
        if (self.points_file is None) != (self.points == 0):
            raise InputError(f"object {self.name}: {self.points} points in {self.points_file!r}; bake again")
        if not (self.splats_file is None) == (self.splats_folder is None) == (self.splats == 0):
            raise InputError(f"object {self.name}: {self.splats} splats in {self.splats_file!r}; bake again")

    @property
    def files(self) -> dict[str, int]:
        """Its PC2 files, and how many points a sample of each has."""
        files = {self.file: self.vertices}
        if self.points_file is not None:
            files[self.points_file] = self.points
        if self.splats_file is not None:
            files[self.splats_file] = SPLAT_POINTS * self.splats
        return files

    def splat_frame(self, frame: int) -> str | None:
        """The PLY file of its splats at ``frame``; None for an object without."""
        return None if self.splats_folder is None else f"{self.splats_folder}/{frame:04d}.ply"


@dataclass(frozen=True, kw_only=True)
class BakeManifest:
    """The state of one bake.

    inputs_hash: SHA-256 over everything that the motion depends on (sim/app/bake.py: inputs_hash).
    fps, frame_start, frames: frame ``frame_start + i`` is sample ``i`` at ``i / fps`` seconds.
    frames_done: samples that every cache holds; while a bake runs, at least so many.
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

    @property
    def files(self) -> dict[str, int]:
        """All PC2 files, and how many points a sample of each has."""
        return {name: count for item in self.objects for name, count in item.files.items()}

    def splat_frames(self, samples: int) -> list[str]:
        """All PLY files of splats that belong to the first ``samples`` samples."""
        frames = range(self.frame_start, self.frame_start + samples)
        return [name for item in self.objects for frame in frames if (name := item.splat_frame(frame)) is not None]

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
    found = data.pop("format", None) if isinstance(data, dict) else None
    if found != FORMAT:
        remedy = "update PhysGen, or bake" if str(found).startswith("physgen-bake/") else "bake"
        raise InputError(
            f"{path}: format is {found!r}, this version reads {FORMAT!r}; {remedy} again with this version"
        )
    try:
        manifest = parse(BakeManifest, data, str(path))
    except InputError as error:
        author = data.get("version")
        if author == VERSION:
            raise
        raise InputError(
            f"{error}; PhysGen {author} wrote it, this is {VERSION}: use that one, or bake again"
        ) from None
    for name in (*manifest.files, *manifest.splat_frames(1)):
        inside(folder, name)
    return manifest


def save_manifest(folder: Path, manifest: BakeManifest) -> None:
    """Write the manifest whole or not at all."""
    write_json(folder / MANIFEST_FILE, {"format": FORMAT, **to_json(manifest)})
