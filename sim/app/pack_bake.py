# SPDX-License-Identifier: MIT
"""Bakes that travel: a bake folder packed to a fraction of its size, and unpacked to point caches that play."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..atomic import replacing_tree, write_json
from ..cache.bake_check import require_intact, unchanged_bake
from ..cache.bake_folder import METRICS_FILE, Bake, BakeManifest, load_bake, save_manifest
from ..cache.packed_cache import PackedCache, pack_cache
from ..cache.pc2 import Pc2Reader, Pc2Writer
from ..checksums import Checksum, file_sum, span_for
from ..errors import Cancelled, InputError
from ..events import IsCancelled, never
from ..files import is_file
from ..folder_lock import lock_beside
from ..scene.folder import inside
from ..validation import parse, read_json, to_json

FORMAT = "physgen-packed-bake/1"
PACKED_FILE = "packed.json"
SUFFIX = ".packed"


@contextmanager
def _new(out: Path) -> Iterator[Path]:
    """Yield the folder that becomes ``out``, which is held meanwhile. Raises InputError where something is there."""
    with lock_beside(out):
        # Not before: another run may have written it meanwhile.
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise InputError(f"{out}: is there already; name a new folder")
        with replacing_tree(out) as partial:
            yield partial


def pack_bake(bake: Bake, *, out: Path, cancelled: IsCancelled = never) -> int:
    """Write the complete ``bake`` packed into the new folder ``out``; return its bytes.

    Every point is within 0.1 % of its object's size of where it was, and those of frame 1 are exact. Raises InputError
    for a bake that is not complete, damaged, or has splats, Cancelled; nothing is left then.
    """
    manifest = bake.manifest
    if manifest.state != "complete":
        raise InputError(f"{bake.root}: is {manifest.state}, and only a complete bake is packed; bake on")
    if any(item.splats for item in manifest.objects):
        raise InputError(f"{bake.root}: has splats, which are not packed; copy the folder as it is")
    require_intact(bake)
    with _new(out) as partial, unchanged_bake(bake):
        sums: dict[str, str] = {}
        for name in manifest.files:
            if cancelled():
                raise Cancelled("packing cancelled; nothing was written")
            pack_cache(Pc2Reader(bake.root / name), partial / f"{name}{SUFFIX}", manifest.frames)
            sums[f"{name}{SUFFIX}"] = file_sum(partial / f"{name}{SUFFIX}")
        for name in _others(bake.root, manifest):
            shutil.copyfile(bake.root / name, partial / name)
            sums[name] = file_sum(partial / name)
        content: dict[str, Any] = to_json(dataclasses.replace(manifest, checksums=()))
        write_json(partial / PACKED_FILE, {"format": FORMAT, "manifest": content, "sums": sums})
        return sum(path.stat().st_size for path in partial.iterdir())


def _others(root: Path, manifest: BakeManifest) -> list[str]:
    return [name for name in (METRICS_FILE, *manifest.torn_skin_file) if is_file(root / name)]


def unpack_bake(folder: Path, *, out: Path, cancelled: IsCancelled = never) -> Bake:
    """Return the bake packed in ``folder``, unpacked into the new folder ``out``, with checksums of its own.

    Raises InputError for a folder that is no packed bake, or damaged, Cancelled; nothing is left then.
    """
    path = folder / PACKED_FILE
    data = read_json(path, folder=folder)
    if not isinstance(data, dict) or data.get("format") != FORMAT or not isinstance(data.get("sums"), dict):
        raise InputError(f"{path}: is no packed bake ({FORMAT}); pack the bake again")
    manifest = parse(BakeManifest, data.get("manifest"), str(path))
    wanted = [*(f"{name}{SUFFIX}" for name in manifest.files), *manifest.torn_skin_file]
    others = [name for name in (METRICS_FILE, *manifest.torn_skin_file) if name in data["sums"]]
    for name in {*wanted, *others}:
        try:
            good = file_sum(inside(folder, name)) == data["sums"].get(name)
        except FileNotFoundError:
            good = False
        if not good:
            raise InputError(f"{folder / name}: is missing, or not what was packed; copy the folder again")
    with _new(out) as partial:
        checksums: list[Checksum] = []
        for name, count in manifest.files.items():
            packed = PackedCache(inside(folder, f"{name}{SUFFIX}"))
            if packed.vertex_count != count or packed.sample_count != manifest.frames:
                raise InputError(f"{packed.path}: has {packed.vertex_count} vertices, not {count}; pack the bake again")
            target = inside(partial, name)
            with Pc2Writer(
                target, vertex_count=count, start_frame=manifest.frame_start, span=span_for(manifest.frames)
            ) as writer:
                for sample in packed.samples():
                    if cancelled():
                        raise Cancelled("unpacking cancelled; nothing was written")
                    writer.append(sample)
                checksums.append(writer.checksum(name, ended=True))
        for name in others:
            shutil.copyfile(inside(folder, name), inside(partial, name))
            checksums.append(Checksum(file=name, sums=file_sum(partial / name)))
        save_manifest(partial, dataclasses.replace(manifest, checksums=tuple(checksums)))
    return load_bake(out)
