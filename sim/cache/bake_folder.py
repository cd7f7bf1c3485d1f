# SPDX-License-Identifier: MIT
"""A bake folder: its manifest (what was baked from what, and how far), disk usage, cleaning up and freeing.

Only files that the manifest lists are ever counted or deleted.
"""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..checksums import Checksum
from ..errors import InputError
from ..folder_lock import folder_lock
from ..processes import is_running
from ..scene.folder import inside
from ..validation import parse, read_json, to_json
from ..version import VERSION
from .pc2 import MAX_VERTICES, Pc2Reader

MANIFEST_FORMAT = "physgen-bake/1"
MANIFEST_FILE = "manifest.json"
STATES = ("running", "complete", "cancelled")

MATTER_SUFFIX = ".matter.npy"
MATTER_FILES = "checkpoints/{name}.{sample:05d}" + MATTER_SUFFIX
"""Particles in a sample in which they are far apart, until the bake is complete; ``name``: of the object."""

CHECKPOINT_FILE = "checkpoints/state.npz"
"""The engine's state to resume from, replaced periodically during a bake, removed when it is complete."""

METRICS_FILE = "metrics.json"
TIMES_FILE = "times.json"
"""Seconds that each frame took: the one file that is another when the same is baked again."""

WORLD_SPACE, MESH_SPACE = "world", "mesh"
SPACES = (WORLD_SPACE, MESH_SPACE)
"""Coordinates of samples: world metres, or those of the object's mesh file."""

GRAINS, SURFACE = "grains", "surface"
"""Display of particles: as grains, or as the surface that encloses them."""


MOST_FRAMES, MOST_START, MOST_RATE = 100_000, 10**7, 1e6
MOST_FILES = 1_000_000
"""Most that a manifest may claim: frames, the number of the first one, frames per second, files in all."""

SPLAT_POINTS = 4
"""Points per splat in its cache: centre, and the ends of three half axes."""


@dataclass(frozen=True, kw_only=True)
class BakedObject:
    """One object's caches, files relative to the bake folder.

    file: PC2 of the mesh's vertices, of which there are ``vertices``.
    space: of all samples, one of ``SPACES``.
    points_file: PC2 of all ``points`` particles; None and 0 if not requested or not granular or fluid.
    points_as: how the particles are shown, ``grains`` or ``surface``.
    splats_file: PC2 of its ``splats`` Gaussian splats, four points each: centre and ends of the half axes.
    splats_folder: of their PLY files, one per frame. None, None and 0 without splats.
    torn_file: PC2 of the skin cut open where the matter parts, ``torn`` vertices, of which the first ``vertices`` are
        the mesh's own; torn_skin: its triangles (``read_torn_skin``); torn_from: the first sample with an open
        crack. None,
        None, 0 and 0 where nothing parts.
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
    torn_file: str | None = None
    torn_skin: str | None = None
    torn: int = 0
    torn_from: int = 0

    def __post_init__(self) -> None:
        counts = (self.vertices, self.points, SPLAT_POINTS * self.splats, self.torn)
        if self.vertices < 1 or min(counts) < 0 or max(counts) > MAX_VERTICES:
            raise InputError(f"object {self.name}: {counts} are no numbers of points of its caches; bake again")
        if self.points_as not in (GRAINS, SURFACE):
            raise InputError(f"object {self.name}: points_as is {self.points_as!r}: choose {GRAINS} or {SURFACE}")
        if self.space not in SPACES:
            raise InputError(f"object {self.name}: space is {self.space!r}: choose one of {', '.join(SPACES)}")
        if (self.points_file is None) != (self.points == 0):
            raise InputError(f"object {self.name}: {self.points} points in {self.points_file!r}; bake again")
        if not (self.splats_file is None) == (self.splats_folder is None) == (self.splats == 0):
            raise InputError(f"object {self.name}: {self.splats} splats in {self.splats_file!r}; bake again")
        if (
            not (self.torn_file is None) == (self.torn_skin is None) == (self.torn == 0)
            or not 0 <= self.torn_from < 2**31
        ):
            raise InputError(f"object {self.name}: {self.torn} vertices in {self.torn_file!r}; bake again")

    def without_tears(self) -> BakedObject:
        """Return it as it is before it is known what tears."""
        return replace(self, torn_file=None, torn_skin=None, torn=0, torn_from=0)

    @property
    def files(self) -> dict[str, int]:
        """Its PC2 files, with the number of points per sample."""
        files = {self.file: self.vertices}
        if self.points_file is not None:
            files[self.points_file] = self.points
        if self.splats_file is not None:
            files[self.splats_file] = SPLAT_POINTS * self.splats
        if self.torn_file is not None:
            files[self.torn_file] = self.torn
        return files

    def splat_frame(self, frame: int) -> str | None:
        """Return the PLY file of its splats at ``frame``; None without splats."""
        return None if self.splats_folder is None else f"{self.splats_folder}/{frame:04d}.ply"


@dataclass(frozen=True, kw_only=True)
class BakeManifest:
    """The state of a bake.

    inputs_hash: SHA-256 of everything that the motion depends on (``inputs_hash`` in sim/app/bake_options.py).
    fps, slow, frame_start, frames: frame ``frame_start + i`` is sample ``i``: ``i / fps`` seconds into the clip, and
        ``i / (fps slow)`` seconds into the motion (``rate``).
    frames_done: samples in every cache; during a bake, at least that many.
    particles: simulated particles of all objects together.
    geometry_hash: SHA-256 of the objects' meshes and transforms (``geometry_hash``, ibid.), which identifies bakes of
        other scenes; empty if unknown.
    checksums: of its files, as far as they are written; none in older bakes.
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
    slow: float = 1.0
    checksums: tuple[Checksum, ...] = ()

    @property
    def rate(self) -> float:
        """Frames per second of the scene's own time: ``fps`` unless the clip is in slow motion."""
        return self.fps * self.slow

    @property
    def files(self) -> dict[str, int]:
        """All PC2 files, with the number of points per sample."""
        return {name: count for item in self.objects for name, count in item.files.items()}

    @property
    def torn_skin_file(self) -> list[str]:
        """Files with the triangles of torn skins."""
        return [item.torn_skin for item in self.objects if item.torn_skin is not None]

    def splat_frames(self, samples: int) -> list[str]:
        """Return all splat PLY files of the first ``samples`` samples."""
        frames = range(self.frame_start, self.frame_start + samples)
        return [name for item in self.objects for frame in frames if (name := item.splat_frame(frame)) is not None]

    def __post_init__(self) -> None:
        if self.state not in STATES:
            raise InputError(f"state is {self.state!r}: choose one of {', '.join(STATES)}")
        if (
            not 0 < self.fps <= MOST_RATE
            or not 0 < self.slow <= MOST_RATE
            or not 1 <= self.frames <= MOST_FRAMES
            or not 0 <= self.frames_done <= self.frames
            or abs(self.frame_start) > MOST_START
        ):
            raise InputError(
                f"{self.frames_done} of {self.frames} frames from {self.frame_start} at {self.fps} fps, slow "
                f"{self.slow}, is not a valid frame range (at most {MOST_FRAMES} frames); bake again"
            )
        files = sum(2 + (self.frames if item.splats_folder else 0) for item in self.objects)
        if files > MOST_FILES:
            raise InputError(f"objects: name {files} files, and a bake has {MOST_FILES} at most; bake again")


@dataclass(frozen=True)
class Bake:
    """A bake folder: its path and its manifest, as loaded. Made by ``bake`` and ``load_bake``.

    root: the folder, which holds one PC2 point cache per object. manifest: what was baked, from what, how far.

    >>> import physgen
    >>> baked = physgen.load_bake("bake")  # doctest: +SKIP
    >>> baked.manifest.fps, baked.first_frame, baked.last_frame  # doctest: +SKIP
    (24.0, 1, 48)
    """

    root: Path
    manifest: BakeManifest

    def __repr__(self) -> str:
        return f"Bake(root={str(self.root)!r}, frames {self.first_frame} to {self.last_frame})"

    @property
    def first_frame(self) -> int:
        """Number of the first frame: the scene at rest."""
        return self.manifest.frame_start

    @property
    def last_frame(self) -> int:
        """Number of the last frame that is complete in every cache."""
        return self.manifest.frame_start + self.manifest.frames_done - 1

    def vertices(self, name: str, frame: int) -> NDArray[np.float32]:
        """Return the vertices (V, 3) of the object ``name`` at ``frame``, in the order of its mesh file.

        In world metres, or in the mesh's own coordinates where the manifest's ``space`` says so. Raises InputError
        for an unknown object, a frame outside the bake, or a damaged cache.
        """
        item = next((item for item in self.manifest.objects if item.name == name), None)
        if item is None:
            known = ", ".join(item.name for item in self.manifest.objects)
            raise InputError(f"{self.root}: holds no object {name!r}; choose one of {known}")
        return Pc2Reader(inside(self.root, item.file)).sample(frame - self.manifest.frame_start)


def load_bake(root: str | Path) -> Bake:
    """Return the bake in the folder ``root``, complete or not.

    >>> import physgen
    >>> baked = physgen.load_bake("bake")  # doctest: +SKIP

    Raises InputError where there is none.
    """
    return Bake(root=Path(root), manifest=load_manifest(Path(root)))


def load_manifest(folder: Path) -> BakeManifest:
    """Return the manifest of the bake ``folder``. Raises InputError if it is missing or unreadable."""
    path = folder / MANIFEST_FILE
    if not os.path.lexists(path):
        raise InputError(f"{folder}: no bake there ({MANIFEST_FILE} is missing); run `physgen bake` first")
    data = read_json(path, folder=folder)
    found = data.pop("format", None) if isinstance(data, dict) else None
    if found != MANIFEST_FORMAT:
        remedy = "update PhysGen, or bake" if str(found).startswith("physgen-bake/") else "bake"
        raise InputError(
            f"{path}: format is {found!r}, this version reads {MANIFEST_FORMAT!r}; {remedy} again with this version"
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
    for name in (*manifest.files, *manifest.torn_skin_file, *manifest.splat_frames(1)):
        inside(folder, name)
    return manifest


def save_manifest(folder: Path, manifest: BakeManifest) -> None:
    """Write the manifest atomically."""
    write_json(folder / MANIFEST_FILE, {"format": MANIFEST_FORMAT, **to_json(manifest)})


_PARTIAL = re.compile(r"\.(?:manifest|metrics|times|state)\.partial-[\d]+(?:-[0-9a-f]+){0,2}\.(?:json|npz)")
_LOCK_LEFTOVER = re.compile(r"\.lock-(?:dead-)?(\d+)-[0-9a-f]{8}")
"""Temporary files that earlier versions left behind."""
_PARTIAL_SPLATS = re.compile(r"\.\d{4,}\.partial-\d+(?:-[0-9a-f]+){0,2}\.ply")


def listed_files(manifest: BakeManifest) -> list[str]:
    """Return the names of all files of a bake, whether they exist or not."""
    single = [CHECKPOINT_FILE, METRICS_FILE, TIMES_FILE, MANIFEST_FILE]
    return [*manifest.files, *manifest.torn_skin_file, *manifest.splat_frames(manifest.frames), *single]


def disk_usage(folder: Path) -> int:
    """Return the bytes on disk of the bake in ``folder``, by its manifest. Raises InputError if there is none."""
    total = 0
    for name in listed_files(load_manifest(folder)):
        with contextlib.suppress(OSError):
            total += (folder / name).lstat().st_size
    return total


def free_bake(folder: Path) -> int:
    """Delete the bake in ``folder``, then the folder if it is empty; return the bytes freed.

    Deletes the files listed in the manifest and partial files of killed runs; never follows links. The manifest goes
    last, so that this can be repeated if a file could not be deleted.

    Raises InputError when there is no bake, ``folder`` is a link, a living process writes into it, or a file cannot be
    deleted.
    """
    if folder.is_symlink():
        raise InputError(f"{folder}: is a link; free the folder it points to")
    load_manifest(folder)
    with folder_lock(folder):
        freed = disk_usage(folder)
        try:
            remove_leftovers(folder)
            remove_listed(folder)
            for place in (*_splat_folders(folder), (folder / CHECKPOINT_FILE).parent):
                with contextlib.suppress(OSError):
                    place.rmdir()
            (folder / MANIFEST_FILE).unlink()
        except OSError as error:
            raise InputError(
                f"{error.filename or folder}: cannot be deleted ({error.strerror or error}); close what uses it, or "
                "change its permissions, and free the bake again"
            ) from error
    # Not empty if it has files that no manifest lists.
    with contextlib.suppress(OSError):
        folder.rmdir()
    return freed


def remove_listed(folder: Path) -> None:
    """Delete the files listed in the manifest of ``folder``, except itself, if there is one; the caller holds the lock.

    Raises OSError when a file cannot be deleted.
    """
    try:
        manifest = load_manifest(folder)
    except InputError:
        return
    remove_matter(folder, manifest)
    for name in listed_files(manifest):
        # Never through a link.
        parents = list(PurePosixPath(name).parents)[:-1]
        if name != MANIFEST_FILE and not any((folder / parent).is_symlink() for parent in parents):
            (folder / name).unlink(missing_ok=True)


def remove_matter(folder: Path, manifest: BakeManifest) -> None:
    """Delete what an unfinished bake kept of its particles."""
    place = (folder / CHECKPOINT_FILE).parent
    if place.is_symlink() or not place.is_dir():
        return
    # No pattern: names come from the manifest, and may be patterns themselves, or lead elsewhere.
    starts = tuple(f"{item.name}." for item in manifest.objects)
    for path in list(place.iterdir()):
        if path.name.startswith(starts) and path.name.endswith(MATTER_SUFFIX):
            path.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Delete partial files that killed runs left in the bake ``folder``, whose lock the caller holds."""
    for place in (folder, (folder / CHECKPOINT_FILE).parent):
        if place.is_symlink() or not place.is_dir():
            continue
        for path in place.iterdir():
            lock = _LOCK_LEFTOVER.fullmatch(path.name)
            if _PARTIAL.fullmatch(path.name) or (lock and not is_running(int(lock[1]))):
                path.unlink(missing_ok=True)
    for place in _splat_folders(folder):
        for path in place.glob(".*.ply"):
            if _PARTIAL_SPLATS.fullmatch(path.name):
                path.unlink(missing_ok=True)


def _splat_folders(folder: Path) -> list[Path]:
    """Return the existing folders of splat PLY files in the manifest of ``folder``, without links."""
    try:
        names = [item.splats_folder for item in load_manifest(folder).objects if item.splats_folder is not None]
    except InputError:
        return []
    found = [folder / name for name in names]
    return [place for place in found if place.is_dir() and not place.is_symlink()]
