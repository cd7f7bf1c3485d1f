# SPDX-License-Identifier: GPL-3.0-or-later
"""Record beside a bake of a Blender scene, by which the scene finds it again: after undo, after a crash.

``bakes/NAME.json`` beside ``bakes/NAME/``, ``physgen-blender-bake/1``: `fingerprints` of the scenes that this bake
matches, `frame_start` (Blender's frame of sample 0), `looks[]`: how each object is shown (`name` in the bake) and from
which frame on; `files`, the .blend files that showed it when they were saved, relative to the bake folder. Written
without bpy, in the job's thread.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...sim.atomic import write_json
from ...sim.cache.bake_check import damage_of
from ...sim.cache.bake_folder import MANIFEST_FILE, BakeManifest, load_manifest
from ...sim.cache.pc2 import Pc2Reader
from ...sim.errors import InputError
from ...sim.validation import parse, read_json, to_json

FORMAT = "physgen-blender-bake/1"
BAKES = "bakes"
PROBES, NEIGHBOURS = 16, 9
LONE = 0.01
"""Spacing in m of a particle without neighbours."""
MESH, GRAINS, SURFACE = "mesh", "grains", "surface"
LAST_FRAME = 1_048_574
"""Blender's maximum frame number."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """Display of an object.

    name: of the object in the bake.
    shape: ``mesh`` (its own mesh, deformed), ``grains`` (its particles), ``surface`` (a surface around them).
    from_frame: Blender's frame from which the particles replace the mesh.
    spacing: typical distance of neighbouring particles at rest, m; 0 if unknown.
    """

    name: str
    shape: str = MESH
    from_frame: int = 0
    spacing: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in (MESH, GRAINS, SURFACE):
            raise InputError(f"{self.name}: shape is {self.shape!r}: choose {MESH}, {GRAINS} or {SURFACE}")
        if abs(self.from_frame) > LAST_FRAME or not 0.0 <= self.spacing < 1e9:
            raise InputError(f"{self.name}: frame {self.from_frame}, spacing {self.spacing}: bake again")


@dataclass(frozen=True, kw_only=True)
class BakeRecord:
    """Link of a bake to a Blender scene; ``folder`` is the absolute path of the bake, and is not stored."""

    folder: str = ""
    fingerprints: tuple[str, ...] = ()
    frame_start: int = 1
    looks: tuple[Look, ...] = ()
    files: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if abs(self.frame_start) > LAST_FRAME:
            raise InputError(f"frame_start is {self.frame_start}: bake again")

    @property
    def path(self) -> Path:
        """The bake folder."""
        return Path(self.folder)

    def look(self, name: str) -> Look:
        """Return how the object ``name`` of the bake is shown."""
        return next((look for look in self.looks if look.name == name), Look(name=name))


def record_file(folder: Path) -> Path:
    """Return the file of the record of the bake ``folder``."""
    return folder.with_name(f"{folder.name}.json")


def write_record(record: BakeRecord) -> None:
    """Write the record and add the fingerprints already stored. Raises InputError if it cannot be written."""
    before = read_record(record.path)
    known = before.fingerprints if before is not None else ()
    kept = tuple(item for item in known if item not in record.fingerprints)
    files = before.files if before is not None else ()
    _write(dataclasses.replace(record, fingerprints=(*kept[-19:], *record.fingerprints), files=files))


def _write(record: BakeRecord) -> None:
    data = to_json(record)
    del data["folder"]
    write_json(record_file(record.path), {"format": FORMAT, **data})


def note_file(record: BakeRecord, blend: Path, shown: bool) -> None:
    """Record whether the file ``blend`` shows the bake. Raises InputError if it cannot be written."""
    try:
        name = os.path.relpath(blend, record.path).replace("\\", "/")
    except ValueError:
        # Another drive on Windows.
        name = str(blend)
    others = tuple(item for item in record.files if item != name)
    files = (*others[-99:], name) if shown else others
    if files != record.files:
        _write(dataclasses.replace(record, files=files))


def other_files(record: BakeRecord, blend: Path | None) -> list[Path]:
    """Return existing files other than ``blend`` that showed the bake when they were saved."""
    found = [Path(os.path.normpath(record.path / name)) for name in record.files]
    return [path for path in found if path != blend and path.is_file()]


def read_record(folder: Path) -> BakeRecord | None:
    """Return the record of the bake ``folder``; None if it is absent or unreadable."""
    try:
        data = read_json(record_file(folder))
        if not isinstance(data, dict) or data.pop("format", None) != FORMAT:
            return None
        return dataclasses.replace(parse(BakeRecord, data, str(folder)), folder=str(folder))
    except InputError:
        return None


def with_spacings(record: BakeRecord) -> BakeRecord:
    """Return ``record`` with the spacing of all shown particles that have a first sample.

    Takes a tenth of a second for 100 000 particles, so it runs in the job's thread.
    """
    manifest = manifest_of(record.path)
    looks = []
    for look in record.looks:
        baked = next((item for item in manifest.objects if item.name == look.name), None) if manifest else None
        if look.shape != MESH and not look.spacing and baked is not None and baked.points_file is not None:
            cache = Pc2Reader(record.path / baked.points_file)
            if cache.sample_count:
                look = dataclasses.replace(look, spacing=spacing(cache.sample(0)))
        looks.append(look)
    return dataclasses.replace(record, looks=tuple(looks))


def spacing(points: NDArray[np.floating]) -> float:
    """Return the typical distance (m) of neighbours among ``points`` (N, 3), as on a cubic lattice of their density.

    Estimated from the radius that holds the nearest neighbours of some of them, so holes and thin walls do not matter.
    """
    count = len(points)
    near = min(NEIGHBOURS, count) - 1
    if near < 1:
        return LONE
    found = []
    for index in np.linspace(0, count - 1, min(PROBES, count)).astype(int):
        away = points - points[index]
        reach = float(np.sqrt(np.partition(np.einsum("ij,ij->i", away, away), near)[near]))
        found.append(reach * (4.0 / 3.0 * np.pi / (near + 1)) ** (1.0 / 3.0))
    return float(np.median(found)) or LONE


def records(cache: Path) -> list[BakeRecord]:
    """Return the records of all bakes in the scene cache ``cache`` that have at least a manifest."""
    found = []
    for path in sorted((cache / BAKES).glob("*.json")):
        record = read_record(path.with_suffix(""))
        if record is not None and manifest_of(record.path) is not None:
            found.append(record)
    return found


def manifest_of(folder: Path) -> BakeManifest | None:
    """Return the manifest of the bake ``folder``; None if it is absent or unreadable."""
    try:
        return load_manifest(folder)
    except InputError:
        return None


def playable(folder: Path) -> int:
    """Return the number of samples that every cache of the bake ``folder`` holds; 0 without a bake.

    Read from the headers of the caches, so also valid if the worker was killed.
    """
    try:
        files = load_manifest(folder).files
        return min((_sound(folder / name, count).sample_count for name, count in files.items()), default=0)
    except InputError:
        return 0


def damage(folder: Path, manifest: BakeManifest, *, wait: bool = True) -> str:
    """Return what is wrong with the caches of a bake (Blender reports that on the console only); empty if nothing.

    A complete bake is compared with its checksums, once for each state of its files: by a thread that is not waited for
    unless ``wait``, so that a panel never is; a later call then says what it found.
    """
    try:
        found = [_sound(folder / name, count).sample_count for name, count in manifest.files.items()]
    except InputError as error:
        return str(error)
    if manifest.state == "complete" and min(found, default=0) < manifest.frames:
        return f"{folder}: {min(found, default=0)} of {manifest.frames} frames are there; bake again"
    return _unlike(folder, manifest, wait=wait) if manifest.state == "complete" and manifest.checksums else ""


_compared: dict[Path, tuple[object, str | None]] = {}
"""Bake folder → state of its files, and what the comparison with their checksums found; None: it is under way."""
MOST_COMPARED = 64


def _unlike(folder: Path, manifest: BakeManifest, *, wait: bool) -> str:
    """Return which file of the bake ``folder`` is not what was written; empty if none, or not known yet."""

    def compare() -> None:
        try:
            found = damage_of(folder, manifest)
            words = f"{folder / found[0].file}: {found[0].text(manifest.frame_start)}" if found else ""
        except InputError as error:
            words = str(error)
        _compared[folder] = (state, words)

    try:
        stats = [(folder / name).stat() for name in manifest.files]
        state: object = (manifest.checksums, [(s.st_size, s.st_mtime_ns, s.st_ino) for s in stats])
    except OSError as error:
        return f"{folder}: {error.strerror or error}"
    known, words = _compared.get(folder, (None, None))
    if known == state and (words is not None or not wait):
        return words or ""
    if len(_compared) >= MOST_COMPARED:
        _compared.clear()
    _compared[folder] = (state, None)
    if wait:
        compare()
        return _compared[folder][1] or ""
    threading.Thread(target=compare, name="physgen-checksums", daemon=True).start()
    return ""


def _sound(path: Path, count: int) -> Pc2Reader:
    cache = Pc2Reader(path)
    if cache.vertex_count != count:
        raise InputError(f"{path}: has {cache.vertex_count} vertices instead of {count}; bake again")
    return cache


def matching(cache: Path, fingerprint: str) -> BakeRecord | None:
    """Return the longest bake in ``cache`` with that fingerprint."""
    found = [item for item in records(cache) if fingerprint and fingerprint in item.fingerprints]
    return max(found, key=lambda record: playable(record.path), default=None)


@dataclass(frozen=True, kw_only=True)
class BakeOnDisk:
    """A bake of a scene cache as listed in the panel.

    frames_done of frames can be played; size in bytes with all its files; written: seconds since 1970, of its manifest;
    files: .blend files that showed it when they were saved and still exist.
    """

    folder: str
    frames_done: int
    frames: int
    size: int
    written: float
    files: tuple[str, ...] = ()


def bakes_on_disk(cache: Path) -> list[BakeOnDisk]:
    """Return what lies in the scene cache ``cache``, newest first."""
    found = []
    for record in records(cache):
        manifest = manifest_of(record.path)
        with contextlib.suppress(OSError):
            written = (record.path / MANIFEST_FILE).stat().st_mtime
            if manifest is not None:
                bake = BakeOnDisk(
                    folder=record.folder,
                    frames_done=playable(record.path),
                    frames=manifest.frames,
                    size=_bytes_in(record.path),
                    written=written,
                    files=tuple(str(path) for path in other_files(record, None)),
                )
                found.append(bake)
    return sorted(found, key=lambda bake: -bake.written)


def disk_bytes(cache: Path) -> int:
    """Return the size of all bakes in the scene cache ``cache``."""
    return _bytes_in(cache / BAKES)


def _bytes_in(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.stat().st_size if path.is_file() else 0
        except OSError:
            continue
    return total
