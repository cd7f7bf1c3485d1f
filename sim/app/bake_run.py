# SPDX-License-Identifier: MIT
"""The loop over the frames of a bake: advance, sample, append; keep what a run that is stopped can go on from."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..cache.bake_folder import METRICS_FILE, TIMES_FILE, BakeManifest, remove_matter, save_manifest
from ..cache.pc2 import Pc2Writer
from ..checksums import Checksum, span_for
from ..errors import Cancelled, PhysGenError, SimulationError
from ..events import IsCancelled, StageProgress
from .bake_resume import BakeSums, Checkpoint, Mendable, OtherSamples, State, drop_checkpoint, save_checkpoint
from .bake_samples import ObjectSampler

if TYPE_CHECKING:
    from .simulation import Simulation

CHECKPOINT_SECONDS = 20.0
"""At most about this much computing is lost when a run is killed."""

KEEP_SECONDS = 2.0
"""About this much computing, and a part of a frame besides, is lost when a run is cancelled."""

MANIFEST_SECONDS = 0.5
"""Interval at which ``frames_done`` in the manifest is brought up to date."""

LEAST_PARTS, MOST_PARTS = 4, 1000
PART_WORK = 2e7
"""A frame of stiff material can take minutes. It is advanced in parts of about so many particle substeps, some seconds,
between which its state can be kept; by the estimate, not by the clock, so that the same input gives the same bytes."""


@dataclasses.dataclass
class BakeRun:
    """The state of the loop; everything of it that lasts is on disk.

    frames_done: samples that every cache holds.
    kept: the latest whole state of the engine and its ``frames_done``, for when it is stopped in the middle of a step.
    mended: what is to be mended of a bake that was complete; None for a new one.
    """

    out: Path
    manifest: BakeManifest
    simulation: Simulation
    samplers: list[ObjectSampler]
    metrics: list[dict[str, Any]]
    frames_done: int
    kept: tuple[int, State] | None = None
    kept_at: float = 0.0
    checkpoint_at: float = 0.0
    saved_at: float = 0.0
    frame_started: float = 0.0
    mended: Mendable | None = None
    sums: BakeSums | None = None
    torn_sums: tuple[Checksum, ...] = ()

    def frames(self, progress: StageProgress, cancelled: IsCancelled) -> BakeManifest:
        """Bake from sample ``frames_done`` to the end; return the final manifest."""
        try:
            with contextlib.ExitStack() as stack:
                writers = {name: stack.enter_context(self._writer(name)) for name in self.manifest.files}
                self.sums = BakeSums(self.out, self.manifest, writers, self.frames_done)
                self._loop(writers, progress, cancelled)
            if self.mended is not None:
                self.mended.require_same(self.sums)
            if self.mended is None or self.mended.metrics:
                self._write_metrics()
            if self.mended is None:
                self._tear(progress, cancelled)
            remove_matter(self.out, self.manifest)
            drop_checkpoint(self.out)
        except (Cancelled, SimulationError, OtherSamples):
            raise
        except (OSError, PhysGenError, MemoryError):
            # The disk or the memory is full, or was taken away: what still can be kept is.
            with contextlib.suppress(OSError, PhysGenError, MemoryError):
                self._stop(keep_state=True)
            raise
        if self.metrics and self.metrics[-1].get("outside"):
            progress.notice("material has left the box around the scene; it flies on, and the camera may not see it")
        progress.report(self.manifest.frames)
        self.frames_done = self.manifest.frames
        return self.save("complete")

    def _write_metrics(self) -> None:
        """Times that frames took are kept apart from the frames, so that the same bake has the same bytes."""
        frames = [{key: value for key, value in frame.items() if key != "seconds"} for frame in self.metrics]
        write_json(self.out / METRICS_FILE, {"frames": frames})
        write_json(self.out / TIMES_FILE, {"seconds": [frame.get("seconds") for frame in self.metrics]})

    def _writer(self, name: str) -> Pc2Writer:
        count, start = self.manifest.files[name], self.manifest.frame_start
        over = 0 if self.mended is None else self.manifest.frames
        span = span_for(self.manifest.frames)
        return Pc2Writer(
            self.out / name, vertex_count=count, start_frame=start, keep=self.frames_done, over=over, span=span
        )

    def _loop(self, writers: Mapping[str, Pc2Writer], progress: StageProgress, cancelled: IsCancelled) -> None:
        self.checkpoint_at = time.monotonic()
        self._keep()
        try:
            until = self.manifest.frames if self.mended is None else self.mended.samples
            for index in range(first := self.frames_done, until):
                compiling = index <= max(first, 1)
                progress.report(index, "preparing the simulator" if compiling else "", paced=not compiling)
                self.frame_started = time.monotonic()
                self._advance_to(index, cancelled)
                self._append_samples(index, writers, cancelled)
                self._keep()
        except Cancelled:
            self._stop(keep_state=True)
            done, frames = self.frames_done, self.manifest.frames
            raise Cancelled(f"bake cancelled at frame {done + 1} of {frames}; run it again to continue") from None
        except SimulationError:
            self._stop(keep_state=False)
            raise

    def _advance_to(self, index: int, cancelled: IsCancelled) -> None:
        """Advance to the time of sample ``index`` in a fixed number of parts; Cancelled, at any moment, when asked."""
        world = self.simulation.world
        parts = self._parts()
        for part in range(1, parts + 1):
            if cancelled():
                raise Cancelled("asked to stop")
            target = (index - 1 + part / parts) / self.manifest.rate
            if target > world.time:
                world.advance(target - world.time, cancelled)
            if part < parts and time.monotonic() - self.kept_at > KEEP_SECONDS:
                self._keep()

    def _parts(self) -> int:
        work = self.simulation.prepared.cost.particle_substeps / max(1, self.manifest.frames - 1)
        return int(np.clip(math.ceil(work / PART_WORK), LEAST_PARTS, MOST_PARTS))

    def _append_samples(self, index: int, writers: Mapping[str, Pc2Writer], cancelled: IsCancelled) -> None:
        """Append the present state to every cache as sample ``index``."""
        samples: dict[str, NDArray[np.float64]] = {}
        for sampler in self.samplers:
            if cancelled():
                raise Cancelled("asked to stop")
            found = sampler.samples(index)
            if sampler.tears is not None and self.mended is None:
                sampler.tears.record(self.out, index)
            sampler.write_splats(self.out, self.manifest.frame_start + index, found)
            samples |= found
        for name, sample in samples.items():
            writers[name].append(sample)
        assert self.sums is not None
        self.sums.add_splats(index)
        seconds = round(time.monotonic() - self.frame_started, 3)
        self.metrics.append({**self.simulation.metrics(), "frame": index + 1, "seconds": seconds})
        self.frames_done = index + 1

    def _keep(self) -> None:
        """Remember the engine's state, and write what is due to be written."""
        now = self.kept_at = time.monotonic()
        self.kept = (self.frames_done, self.simulation.world.checkpoint())
        if now - self.checkpoint_at > CHECKPOINT_SECONDS:
            self._checkpoint()
            self.checkpoint_at = now
        elif now - self.saved_at > MANIFEST_SECONDS:
            self.save("running")

    def _checkpoint(self) -> None:
        if self.kept is not None and self.kept[0] > 0:
            frames_done, state = self.kept
            checkpoint = Checkpoint(frames_done=frames_done, metrics=self.metrics[:frames_done], state=state)
            # What it stands for is on the disk before it.
            if self.sums is not None:
                self.sums.to_disk()
            save_checkpoint(self.out, self.manifest.inputs_hash, checkpoint)
        self.save("running")

    def _stop(self, *, keep_state: bool) -> None:
        """Leave the folder as one to go on from, or with ``keep_state`` off, to look at and start anew."""
        try:
            if keep_state:
                self._checkpoint()
            else:
                drop_checkpoint(self.out)
        finally:
            self.save("cancelled")

    def _tear(self, progress: StageProgress, cancelled: IsCancelled) -> None:
        """Write the skins of what has parted, and name them in the manifest."""
        objects, checksums = [], []
        for sampler, baked in zip(self.samplers, self.manifest.objects, strict=True):
            found = sampler.tears.finish(self.out, baked, self.manifest, cancelled) if sampler.tears else None
            if found is not None:
                progress.notice(f"{baked.name} tears from frame {found[0].torn_from + self.manifest.frame_start} on")
                checksums += found[1]
            objects.append(baked if found is None else found[0])
        self.manifest = dataclasses.replace(self.manifest, objects=tuple(objects))
        self.torn_sums = tuple(checksums)

    def save(self, state: str) -> BakeManifest:
        """Write the manifest as of now and return it."""
        self.saved_at = time.monotonic()
        self.manifest = dataclasses.replace(self.manifest, state=state, frames_done=self.frames_done)
        if self.sums is None:
            pass
        elif self.mended is None:
            checksums = self.sums.checksums(ended=state != "running", metrics=state == "complete")
            self.manifest = dataclasses.replace(self.manifest, checksums=(*checksums, *self.torn_sums))
        elif state == "complete":
            self.manifest = dataclasses.replace(self.manifest, checksums=self.mended.checksums(self.out))
        save_manifest(self.out, self.manifest)
        return self.manifest
