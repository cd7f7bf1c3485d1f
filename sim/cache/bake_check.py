# SPDX-License-Identifier: MIT
"""Whether a bake's files are what was written: all of them, or what a render or a resume is about to read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from ..checksums import (
    DAMAGED,
    MISSING,
    OK,
    UNKNOWN,
    Checksum,
    FileState,
    damaged_files,
    damaged_samples,
    file_sum,
    ranges_text,
)
from ..errors import InputError
from ..files import open_file, same_file
from ..scene.folder import inside
from .bake_folder import METRICS_FILE, Bake, BakeManifest, load_manifest
from .pc2 import HEADER_BYTES, MAX_CACHE_BYTES, header


@dataclass(frozen=True, kw_only=True)
class Damage:
    """Damage of one file of a bake. samples: those that are damaged, from 0; header: only what precedes them is."""

    file: str
    state: str
    samples: tuple[int, ...] = ()
    header: bool = False

    def text(self, first_frame: int) -> str:
        """Return which frames are damaged, in words; ``first_frame`` is the number of sample 0."""
        if self.samples:
            return f"frames {ranges_text(i + first_frame for i in self.samples)} are not what was baked"
        return "its header is not what was baked" if self.header else "is not what was baked"


def damage_of(root: Path, manifest: BakeManifest, samples: Iterable[int] | None = None) -> list[Damage]:
    """Return the damage of the bake ``root``, as far as its checksums tell; none for bakes without.

    samples: check only what these need; None: everything. Raises InputError for names that lead out of the folder.
    """
    wanted = None if samples is None else list(samples)
    found = [_damage(root, manifest, entry, wanted) for entry in manifest.checksums]
    return [damage for damage in found if damage is not None]


def require_intact(bake: Bake, samples: Iterable[int] | None = None) -> None:
    """Raise InputError, naming file and frames, where ``samples`` (None: all) of ``bake`` are known to be damaged."""
    found = damage_of(bake.root, bake.manifest, samples)
    if found:
        more = f", and {len(found) - 1} more files (physgen check)" if len(found) > 1 else ""
        raise InputError(
            f"{bake.root / found[0].file}: {found[0].text(bake.first_frame)}{more}; bake again: only that part is made "
            "anew"
        )


@contextmanager
def unchanged_bake(bake: Bake) -> Iterator[Callable[[], None]]:
    """Yield a check that ``bake`` is still the one in its folder, and do it at the end, too: it raises InputError once
    another command has begun to replace or free it. One that is still being written may go on."""
    replaced = f"{bake.root}: was baked anew or freed by another command meanwhile; run this one again"
    with ExitStack() as held:
        files = []
        # One that is missing is its reader's to report.
        with suppress(FileNotFoundError):
            for name in list(bake.manifest.files)[:1]:
                files.append(held.enter_context(same_file(inside(bake.root, name), MAX_CACHE_BYTES)))

        def require() -> None:
            # Whoever replaces a bake removes all of its files first, then writes another manifest.
            if not all(is_same() for is_same in files) or _inputs_now(bake) != bake.manifest.inputs_hash:
                raise InputError(replaced)

        require()
        yield require
        require()


def _inputs_now(bake: Bake) -> str | None:
    try:
        return load_manifest(bake.root).inputs_hash
    except InputError:
        return None


def check_bake(bake: Bake) -> list[FileState]:
    """Return the state of each file of ``bake``: of its caches, splats and metrics."""
    manifest = bake.manifest
    damaged = {damage.file: damage for damage in damage_of(bake.root, manifest)}
    known = {entry.file for entry in manifest.checksums}
    names = [*manifest.files, *(item.splats_folder for item in manifest.objects if item.splats_folder is not None)]
    if manifest.state == "complete":
        names.append(METRICS_FILE)
    states = []
    for name in names:
        if name in damaged:
            damage = damaged[name]
            states.append(FileState(file=name, state=damage.state, text=damage.text(bake.first_frame)))
        elif name in known:
            states.append(FileState(file=name, state=OK))
        else:
            there = inside(bake.root, name).exists()
            states.append(FileState(file=name, state=UNKNOWN if there else MISSING))
    return states


def _damage(root: Path, manifest: BakeManifest, entry: Checksum, wanted: list[int] | None) -> Damage | None:
    path = inside(root, entry.file)
    caches = manifest.files
    try:
        if entry.file in caches and entry.span:
            if not _has_header(path, manifest, caches[entry.file], entry):
                broken = tuple(damaged_samples(path, entry, 12 * caches[entry.file], HEADER_BYTES, wanted))
                return Damage(file=entry.file, state=DAMAGED, samples=broken, header=True)
            bad = damaged_samples(path, entry, 12 * caches[entry.file], HEADER_BYTES, wanted)
        elif entry.span:
            bad = damaged_files(lambda i: path / f"{manifest.frame_start + i:04d}.ply", entry, wanted)
        elif wanted is not None or file_sum(path) == entry.sums:
            return None
        else:
            return Damage(file=entry.file, state=DAMAGED)
    except FileNotFoundError:
        return Damage(file=entry.file, state=MISSING, samples=tuple(range(entry.samples)))
    except InputError:
        return Damage(file=entry.file, state=DAMAGED, samples=tuple(range(entry.samples)))
    return Damage(file=entry.file, state=DAMAGED, samples=tuple(bad)) if bad else None


def _has_header(path: Path, manifest: BakeManifest, points: int, entry: Checksum) -> bool:
    """Whether the header is the one that was written; while a bake runs, samples are appended all the time."""
    with open_file(path, MAX_CACHE_BYTES) as file:
        head = file.read(HEADER_BYTES)
    samples = int.from_bytes(head[28:32], "little", signed=True)
    if manifest.state == "complete" and samples != manifest.frames:
        return False
    return samples >= entry.samples and head == header(points, manifest.frame_start, samples)
