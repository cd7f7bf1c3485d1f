# SPDX-License-Identifier: MIT
"""Scene folder → bake folder: sample particles, simulate, skin, write the caches; resume where a run stopped."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..cache.bake_check import damage_of
from ..cache.bake_folder import (
    CHECKPOINT_FILE,
    MANIFEST_FILE,
    Bake,
    BakeManifest,
    load_manifest,
    remove_leftovers,
    remove_listed,
)
from ..cache.pc2 import Pc2Reader
from ..errors import OUT_OF_MEMORY, Cancelled, InputError
from ..events import IsCancelled, OnEvent, StageProgress, ignore, never
from ..folder_lock import folder_lock
from ..scene.folder import Scene, inside
from ..scene.meshes import ObjectMesh, load_object_mesh
from ..scene.scene_output import changed_files
from ..version import VERSION
from .bake_estimate import disk_bytes, require_disk_space
from .bake_options import BakeOptions, inputs_hash
from .bake_resume import OtherSamples, find_mendable, resume
from .bake_run import BakeRun
from .bake_samples import ObjectSampler, baked_objects, load_object_splats
from .scene_to_world import PreparedWorld, prepare_world

if TYPE_CHECKING:
    from ..gaussians.splats import Splats
    from .simulation import Simulation

__all__ = ["CHECKPOINT_FILE", "BakeOptions", "bake", "is_up_to_date"]


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


@dataclasses.dataclass(frozen=True)
class _Inputs:
    """What is read of a scene folder. meshes, splats: one an object. hash: of all; geometry_hash: of the meshes."""

    meshes: list[ObjectMesh]
    splats: list[Splats | None]
    prepared: PreparedWorld
    hash: str
    geometry_hash: str


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

    inputs = _read_inputs(folder, options, progress, go_on)
    prepared = inputs.prepared
    objects = baked_objects(folder, inputs.meshes, inputs.splats, prepared, options)
    require_disk_space(out, disk_bytes(objects, prepared.particle_count, options.frames))
    go_on()
    simulation = build_world(prepared, options.arch, progress)
    go_on()
    manifest = BakeManifest(
        inputs_hash=inputs.hash,
        fps=options.fps,
        slow=options.slow,
        frame_start=1,
        frames=options.frames,
        frames_done=0,
        state="running",
        engine=simulation.engine_name,
        version=VERSION,
        particles=simulation.particle_count,
        geometry_hash=inputs.geometry_hash,
        objects=objects,
    )
    samplers = [
        ObjectSampler(slot, baked, mesh, seen, np.asarray(item.world_from_mesh), simulation)
        for slot, (baked, mesh, seen, item) in enumerate(
            zip(objects, inputs.meshes, inputs.splats, folder.model.objects, strict=True)
        )
    ]
    run = _started(out, manifest, simulation, samplers, progress, may_mend=may_mend)
    try:
        return run.frames(progress, cancelled)
    except OtherSamples as other:
        progress.notice(f"{other}: baking everything again")
    return _bake_locked(folder, out, options, progress, cancelled, may_mend=False)


def _read_inputs(folder: Scene, options: BakeOptions, progress: StageProgress, go_on: Callable[[], None]) -> _Inputs:
    """Return what a bake needs of the scene in ``folder``; go_on: raises Cancelled when the user cancels.

    Raises InputError for an unusable scene, and for one that was changed while it was read.
    """
    for name in changed_files(folder, [item.mesh for item in folder.model.objects]):
        progress.notice(f"{folder.root / name}: is not what was written when the scene was made: damaged, or edited")
    inputs = inputs_hash(folder, options)
    progress.report(0, "filling objects with particles")
    meshes = [load_object_mesh(folder, item) for item in folder.model.objects]
    splats = [load_object_splats(folder, *pair) for pair in zip(folder.model.objects, meshes, strict=True)]
    geometry = folder.geometry_hash()
    go_on()
    prepared = prepare_world(folder, meshes, options)
    if inputs_hash(folder, options) != inputs:
        raise InputError(f"{folder.root}: was changed by another command while it was read; run this one again")
    return _Inputs(meshes, splats, prepared, inputs, geometry)


def _started(
    out: Path,
    manifest: BakeManifest,
    simulation: Simulation,
    samplers: list[ObjectSampler],
    progress: StageProgress,
    *,
    may_mend: bool,
) -> BakeRun:
    """Return the run that is to write ``manifest``'s bake: from its last checkpoint, over what is damaged of a complete
    bake (``may_mend``), or from the first frame on; what a bake of other inputs left is removed then."""
    remove_leftovers(out)
    first, metrics, refused = resume(out, manifest, simulation.world)
    if refused is not None:
        progress.notice(refused)
    mended = None if first or not may_mend else find_mendable(out, manifest)
    if first:
        progress.notice(f"continuing at frame {first + 1} of {manifest.frames}")
        manifest = dataclasses.replace(manifest, checksums=load_manifest(out).checksums)
    elif mended is not None:
        progress.notice(f"{mended.text}: frames 1 to {mended.samples} are computed again, the others stay")
        manifest = mended.manifest
    else:
        remove_listed(out)
    run = BakeRun(
        out=out,
        manifest=manifest,
        simulation=simulation,
        samplers=samplers,
        metrics=metrics,
        frames_done=first,
        mended=mended,
    )
    run.save("running")
    return run
