# SPDX-License-Identifier: MIT
"""Scene folder → bake folder: sample particles, simulate, skin, write the caches; resume where a run stopped."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_json
from ..cache.bake_check import damage_of
from ..cache.bake_folder import (
    CHECKPOINT_FILE,
    MANIFEST_FILE,
    METRICS_FILE,
    TIMES_FILE,
    Bake,
    BakeManifest,
    load_manifest,
    remove_leftovers,
    remove_listed,
    remove_matter,
    save_manifest,
)
from ..cache.checksums import Checksum, span_for
from ..cache.folder_lock import folder_lock
from ..cache.pc2 import Pc2Reader, Pc2Writer
from ..errors import OUT_OF_MEMORY, Cancelled, InputError, PhysGenError, SimulationError
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..scene.folder import Scene, inside
from ..scene.meshes import load_object_mesh
from ..scene.scene_output import changed_files
from ..version import VERSION
from .bake_estimate import disk_bytes, require_disk_space
from .bake_options import BakeOptions, inputs_hash
from .bake_resume import (
    BakeSums,
    Checkpoint,
    Mendable,
    OtherSamples,
    State,
    drop_checkpoint,
    find_mendable,
    resume,
    save_checkpoint,
)
from .bake_samples import ObjectSampler, baked_objects, load_object_splats
from .scene_to_world import prepare_world

__all__ = ["CHECKPOINT_FILE", "BakeOptions", "bake", "is_up_to_date"]

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


def is_up_to_date(scene: Scene, out: Path, options: BakeOptions) -> bool:
    """Return whether ``out`` holds the complete bake of ``scene``."""
    return _complete(scene, out, options) is not None


def _complete(scene: Scene, out: Path, options: BakeOptions) -> BakeManifest | None:
    try:
        manifest = load_manifest(out)
        if manifest.state != "complete" or manifest.inputs_hash != inputs_hash(scene, options):
            return None
        for name, count in manifest.files.items():
            cache = Pc2Reader(out / name)
            if cache.sample_count < manifest.frames or cache.vertex_count != count:
                return None
        names = (*manifest.splat_frames(manifest.frames), *manifest.torn_skin_file)
        if not all((out / name).is_file() for name in names):
            return None
        if damage_of(out, manifest):
            return None
    except InputError:
        return None
    return manifest


def bake(
    scene: Scene,
    *,
    out: str | Path,
    options: BakeOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Bake:
    """Simulate ``scene`` and return its bake, the folder ``out``: one point cache per object.

    Does nothing when ``out`` already holds this bake; a run that was stopped resumes from its last checkpoint, and of a
    complete bake with damaged files only the frames up to the last damaged one are computed again.
    on_event receives progress and notices (dicts, ``sim/events.py``); cancelled is polled often and must be cheap.

    >>> import physgen
    >>> scene = physgen.load_scene("scene")  # doctest: +SKIP
    >>> baked = physgen.bake(scene, out="bake", options=physgen.BakeOptions(frames=24))  # doctest: +SKIP
    >>> baked.vertices(scene.objects[0].name, frame=baked.last_frame).shape  # doctest: +SKIP
    (4098, 3)

    Raises InputError for an unusable scene, option or folder, SimulationError when the simulation diverges (complete
    frames are kept), Cancelled when cancelled.
    """
    options, out = options or BakeOptions(), Path(out)
    progress = StageProgress(on_event, "bake", options.frames)
    done = _complete(scene, out, options)
    if done is not None:
        progress.notice(f"up to date: {out}")
        return Bake(root=out, manifest=done)
    with _named_errors(out):
        _refuse_foreign_folder(out)
    with folder_lock(out), _named_errors(out):
        return Bake(root=out, manifest=_bake_locked(scene, out, options, progress, cancelled))


def _refuse_foreign_folder(out: Path) -> None:
    """Raise InputError for a folder with files that are no bake, so that nothing is ever overwritten, and for a bake
    with a link that leads out of it, through which caches and checkpoints would be written.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder for the bake")
    if out.is_dir() and not (out / MANIFEST_FILE).is_file() and any(not p.name.startswith(".") for p in out.iterdir()):
        raise InputError(f"{out}: holds other files and no bake; choose an empty or new folder")
    for path in out.iterdir() if out.is_dir() else ():
        if path.is_symlink():
            inside(out, path.name)


@contextlib.contextmanager
def _named_errors(out: Path) -> Iterator[None]:
    """Turn an OSError into an InputError with a remedy."""
    try:
        yield
    except MemoryError:
        raise InputError(f"{out}: {OUT_OF_MEMORY}") from None
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror or error}); free space and run again to continue"
        ) from error


def _bake_locked(
    folder: Scene,
    out: Path,
    options: BakeOptions,
    progress: StageProgress,
    cancelled: IsCancelled,
    *,
    may_mend: bool = True,
) -> BakeManifest:
    # Imported here, because opening Blender or rendering a frame must never pay for Taichi.
    from .simulation import build_world

    def go_on() -> None:
        if cancelled():
            raise Cancelled("bake cancelled before its first frame; run it again to start")

    for name in changed_files(folder, [item.mesh for item in folder.model.objects]):
        progress.notice(f"{folder.root / name}: is not what was written when the scene was made: damaged, or edited")
    inputs = inputs_hash(folder, options)
    progress.report(0, "sampling particles")
    meshes = [load_object_mesh(folder, item) for item in folder.model.objects]
    splats = [load_object_splats(folder, *pair) for pair in zip(folder.model.objects, meshes, strict=True)]
    geometry = folder.geometry_hash()
    go_on()
    prepared = prepare_world(folder, meshes, options)
    if inputs_hash(folder, options) != inputs:
        raise InputError(f"{folder.root}: was changed by another command while it was read; run this one again")
    objects = baked_objects(folder, meshes, splats, prepared, options)
    require_disk_space(out, disk_bytes(objects, prepared.particle_count, options.frames))
    go_on()
    simulation = build_world(prepared, options.arch, progress)
    go_on()
    manifest = BakeManifest(
        inputs_hash=inputs,
        fps=options.fps,
        slow=options.slow,
        frame_start=1,
        frames=options.frames,
        frames_done=0,
        state="running",
        engine=simulation.engine_name,
        version=VERSION,
        particles=simulation.particle_count,
        geometry_hash=geometry,
        objects=objects,
    )
    samplers = [
        ObjectSampler(slot, baked, mesh, seen, np.asarray(item.world_from_mesh), simulation)
        for slot, (baked, mesh, seen, item) in enumerate(
            zip(objects, meshes, splats, folder.model.objects, strict=True)
        )
    ]
    remove_leftovers(out)
    first, metrics, refused = resume(out, manifest, simulation.world)
    if refused is not None:
        progress.notice(refused)
    mended = None if first or not may_mend else find_mendable(out, manifest)
    if first:
        progress.notice(f"continuing at frame {first + 1} of {options.frames}")
        manifest = dataclasses.replace(manifest, checksums=load_manifest(out).checksums)
    elif mended is not None:
        progress.notice(f"{mended.text}: frames 1 to {mended.samples} are computed again, the others stay")
        manifest = mended.manifest
    else:
        remove_listed(out)
    run = _Run(
        out=out,
        manifest=manifest,
        simulation=simulation,
        samplers=samplers,
        metrics=metrics,
        frames_done=first,
        mended=mended,
    )
    run.save("running")
    try:
        return run.frames(progress, cancelled)
    except OtherSamples as other:
        progress.notice(f"{other}: baking everything again")
    return _bake_locked(folder, out, options, progress, cancelled, may_mend=False)


@dataclasses.dataclass
class _Run:
    """The frame loop's state; everything of it that lasts is on disk.

    frames_done: samples that every cache holds.
    kept: the latest whole state of the engine and its ``frames_done``, for when it is stopped in the middle of a step.
    mended: what is to be mended of a bake that was complete; None for a new one.
    """

    out: Path
    manifest: BakeManifest
    simulation: Any
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
                progress.report(index, "compiling" if compiling else "", paced=not compiling)
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
