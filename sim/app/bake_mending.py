# SPDX-License-Identifier: MIT
"""Checksums of a bake while it is written, and a damaged bake made whole: what is intact stays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..cache.bake_check import damage_of
from ..cache.bake_folder import METRICS_FILE, BakeManifest, load_manifest
from ..cache.checksums import Checksum, RunningSums, file_sum, span_for
from ..cache.pc2 import Pc2Writer
from ..errors import InputError, PhysGenError


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
    torn = {item.torn_file for item in before.objects} | set(before.torn_skins)
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
