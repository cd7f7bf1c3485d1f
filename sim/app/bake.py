# SPDX-License-Identifier: MIT
"""Scene folder → bake folder: sample particles, simulate, skin, write the caches; resume where a run stopped."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import time
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ..atomic import replacing, write_json
from ..cache.lock import folder_lock
from ..cache.manifest import MANIFEST_FILE, BakedObject, BakeManifest, load_manifest, save_manifest
from ..cache.pc2 import Pc2Reader, Pc2Writer
from ..errors import Cancelled, InputError, SimulationError
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..scene.folder import SceneFolder, load_scene
from ..scene.meshes import ObjectMesh, load_object_mesh
from ..skinning.binding import Binding, bind, deform
from ..version import VERSION
from .bake_inputs import BakeOptions, geometry_hash, inputs_hash

__all__ = ["BakeOptions", "bake", "is_up_to_date"]

CHECKPOINT_FILE = "checkpoints/state.npz"
CHECKPOINT_SECONDS = 20.0
"""At most about this much computing is lost when a run is killed."""

ADVANCE_PARTS = 4
"""A frame of stiff matter can take many seconds; cancelling is looked for this many times in it. A fixed number, not
a time, so that the same input gives the same bytes."""

METRICS_FILE = "metrics.json"


def is_up_to_date(scene_root: Path, out: Path, options: BakeOptions) -> bool:
    """Whether ``out`` holds the complete bake of the scene as it is now."""
    return _complete(load_scene(scene_root), out, options) is not None


def _complete(folder: SceneFolder, out: Path, options: BakeOptions) -> BakeManifest | None:
    try:
        manifest = load_manifest(out)
        if manifest.state != "complete" or manifest.inputs_hash != inputs_hash(folder, options):
            return None
        for item in manifest.objects:
            cache = Pc2Reader(out / item.file)
            if cache.sample_count < manifest.frames or cache.vertex_count != item.vertices:
                return None
    except InputError:
        return None
    return manifest


def bake(
    scene_root: Path,
    out: Path,
    options: BakeOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> BakeManifest:
    """Simulate the scene at ``scene_root`` into the bake folder ``out``.

    Nothing happens when ``out`` already holds it; a run that was stopped goes on from its last checkpoint.

    Raises InputError for a scene, option or folder that cannot be used, SimulationError when the run diverged (the
    frames that were good are kept), Cancelled when asked to stop.
    """
    options = options or BakeOptions()
    progress = StageProgress(on_event, "bake", options.frames)
    folder = load_scene(scene_root)
    done = _complete(folder, out, options)
    if done is not None:
        progress.notice(f"up to date: {out}")
        return done
    _refuse_foreign_folder(out)
    with folder_lock(out):
        return _bake_locked(folder, out, options, progress, cancelled)


def _refuse_foreign_folder(out: Path) -> None:
    """A folder with other people's files is never written into, so that nothing of theirs can be overwritten."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder for the bake")
    if out.is_dir() and not (out / MANIFEST_FILE).is_file() and any(not p.name.startswith(".") for p in out.iterdir()):
        raise InputError(f"{out}: holds other files and no bake; choose an empty or new folder")


def _bake_locked(
    folder: SceneFolder, out: Path, options: BakeOptions, progress: StageProgress, cancelled: IsCancelled
) -> BakeManifest:
    # Imported here, because opening Blender or rendering a frame must never pay for Taichi.
    from .simulation import build_world

    meshes = [load_object_mesh(folder, item) for item in folder.scene.objects]
    _require_disk_space(out, meshes, options.frames)
    progress.report(0, "sampling particles")
    simulation = build_world(folder, meshes, options, progress)
    manifest = BakeManifest(
        inputs_hash=inputs_hash(folder, options),
        fps=options.fps,
        frame_start=1,
        frames=options.frames,
        frames_done=0,
        state="running",
        engine=simulation.engine_name,
        version=VERSION,
        particles=simulation.particle_count,
        geometry_hash=geometry_hash(folder),
        objects=tuple(
            BakedObject(name=item.name, file=f"{item.name}.pc2", vertices=len(mesh.vertices))
            for item, mesh in zip(folder.scene.objects, meshes, strict=True)
        ),
    )
    first, metrics = _resume(out, manifest, simulation.world)
    if first:
        progress.notice(f"continuing at frame {first + 1} of {options.frames}")
    else:
        _remove_previous(out)
        (out / "checkpoints").mkdir(parents=True, exist_ok=True)
    bindings = [
        None if rest is None else bind(mesh.vertices, rest)
        for mesh, rest in zip(meshes, simulation.rest_positions, strict=True)
    ]
    manifest = dataclasses.replace(manifest, frames_done=first)
    save_manifest(out, manifest)
    run = _Run(out=out, manifest=manifest, simulation=simulation, meshes=meshes, bindings=bindings, metrics=metrics)
    return run.frames(first, progress, cancelled)


@dataclasses.dataclass
class _Run:
    """The frame loop's state; everything of it that lasts is on disk."""

    out: Path
    manifest: BakeManifest
    simulation: Any
    meshes: list[ObjectMesh]
    bindings: list[Binding | None]
    metrics: list[dict[str, Any]]
    frame_started: float = 0.0

    def frames(self, first: int, progress: StageProgress, cancelled: IsCancelled) -> BakeManifest:
        """Bake from sample ``first`` to the end; the final manifest."""
        try:
            with contextlib.ExitStack() as stack:
                writers = [stack.enter_context(self._writer(item, first)) for item in self.manifest.objects]
                self._loop(first, writers, progress, cancelled)
            write_json(self.out / METRICS_FILE, {"frames": self.metrics})
            (self.out / CHECKPOINT_FILE).unlink(missing_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(
                f"{self.out}: cannot be written ({reason}); free space and run again to continue"
            ) from error
        if self.metrics and self.metrics[-1].get("outside"):
            progress.notice("matter has left the box around the scene; it flies on, and the camera may not see it")
        progress.report(self.manifest.frames)
        return self._save("complete", self.manifest.frames)

    def _writer(self, item: BakedObject, keep: int) -> Pc2Writer:
        return Pc2Writer(
            self.out / item.file, vertex_count=item.vertices, start_frame=self.manifest.frame_start, keep=keep
        )

    def _loop(self, first: int, writers: list[Pc2Writer], progress: StageProgress, cancelled: IsCancelled) -> None:
        last_checkpoint = time.monotonic()
        index = first
        try:
            for index in range(first, self.manifest.frames):
                progress.report(index, "compiling" if index <= max(first, 1) else "")
                self._advance_to(index, cancelled)
                self._append_samples(index, writers)
                if time.monotonic() - last_checkpoint > CHECKPOINT_SECONDS:
                    self._checkpoint(index + 1)
                    last_checkpoint = time.monotonic()
        except (Cancelled, SimulationError) as error:
            self._checkpoint(index, keep_state=isinstance(error, Cancelled))
            self._save("cancelled", index)
            raise

    def _advance_to(self, index: int, cancelled: IsCancelled) -> None:
        """Advance to the time of sample ``index`` in a fixed number of parts; cancelling is looked for between them."""
        self.frame_started = time.monotonic()
        world = self.simulation.world
        for part in range(1, ADVANCE_PARTS + 1):
            if cancelled():
                raise Cancelled(
                    f"bake cancelled at frame {index + 1} of {self.manifest.frames}; run it again to continue"
                )
            target = (index - 1 + part / ADVANCE_PARTS) / self.manifest.fps
            if target > world.time:
                world.advance(target - world.time)

    def _append_samples(self, index: int, writers: list[Pc2Writer]) -> None:
        """Append the present state to every cache as sample ``index``."""
        world = self.simulation.world
        for slot, (mesh, binding, writer) in enumerate(zip(self.meshes, self.bindings, writers, strict=True)):
            body = self.simulation.body_of_object[slot]
            if index == 0:
                # Frame 1 is the scene at rest to the last bit, so that it renders as the photo.
                writer.append(mesh.vertices)
            elif binding is None or body is None:
                moved = self.simulation.collider_vertices(slot)
                writer.append(mesh.vertices if moved is None else moved)
            else:
                writer.append(deform(binding, world.positions(body), world.deformation_gradients(body)))
        self.metrics.append(
            {
                **self.simulation.metrics(),
                "frame": index + 1,
                "seconds": round(time.monotonic() - self.frame_started, 3),
            }
        )

    def _checkpoint(self, frames_done: int, *, keep_state: bool = True) -> None:
        path = self.out / CHECKPOINT_FILE
        if not keep_state or frames_done == 0:
            path.unlink(missing_ok=True)
            return
        with replacing(path) as partial:
            np.savez(
                partial,
                inputs_hash=np.array(self.manifest.inputs_hash),
                frames_done=np.array(frames_done),
                metrics=np.array(json.dumps(self.metrics[:frames_done])),
                **{f"state.{key}": value for key, value in self.simulation.world.checkpoint().items()},
            )
        self._save("running", frames_done)

    def _save(self, state: str, frames_done: int) -> BakeManifest:
        self.manifest = dataclasses.replace(self.manifest, state=state, frames_done=frames_done)
        save_manifest(self.out, self.manifest)
        return self.manifest


def _resume(out: Path, manifest: BakeManifest, world: Any) -> tuple[int, list[dict[str, Any]]]:
    """Restore the last checkpoint if it belongs to these inputs: frames already done and their metrics, or 0."""
    path = out / CHECKPOINT_FILE
    try:
        previous = load_manifest(out)
        if previous.inputs_hash != manifest.inputs_hash or not path.is_file():
            return 0, []
        with np.load(path, allow_pickle=False) as data:
            frames_done = int(data["frames_done"])
            metrics = json.loads(str(data["metrics"]))
            state = {key.removeprefix("state."): data[key] for key in data.files if key.startswith("state.")}
            matches = str(data["inputs_hash"]) == manifest.inputs_hash
        if not matches or not 0 < frames_done <= manifest.frames or len(metrics) != frames_done:
            return 0, []
        for item in manifest.objects:
            if Pc2Reader(out / item.file).sample_count < frames_done:
                return 0, []
        world.restore(state)
    except (InputError, OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error):
        # A checkpoint that a crash left unreadable costs a fresh start, never the run.
        return 0, []
    return frames_done, metrics


def _remove_previous(out: Path) -> None:
    """Delete what the previous manifest lists, and nothing else."""
    try:
        previous = load_manifest(out)
    except InputError:
        return
    for item in previous.objects:
        (out / item.file).unlink(missing_ok=True)
    for name in (CHECKPOINT_FILE, METRICS_FILE):
        (out / name).unlink(missing_ok=True)


def _require_disk_space(out: Path, meshes: list[ObjectMesh], frames: int) -> None:
    needed = sum(len(mesh.vertices) for mesh in meshes) * 12 * frames + 64 * 2**20
    free = shutil.disk_usage(out).free
    if free < needed:
        raise InputError(
            f"{out}: the bake needs about {needed >> 20} MiB and {free >> 20} MiB are free; free space, bake fewer "
            "frames, or choose another disk"
        )
