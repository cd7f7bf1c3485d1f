# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene folder and bake folder → frames: only what is missing, only where something can be seen."""

from __future__ import annotations

import shutil
from pathlib import Path

import bpy

from ...sim.atomic import replacing
from ...sim.cache.lock import folder_lock
from ...sim.errors import Cancelled
from ...sim.events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...sim.scene.folder import SceneFolder, require_photo
from ...sim.scene.meshes import load_object_mesh
from . import caches, compat, photo_particles
from .frame_output import write_frame
from .frame_range import parse_range
from .ledger import Ledger
from .open_renderer import OpenRenderer
from .options import RenderOptions
from .plan import Frame, plan_frames
from .shot import Shot, make_shot


def render_frames(
    scene: SceneFolder,
    bake: Path,
    out: Path,
    options: RenderOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
    *,
    frames: str | None = None,
) -> list[Path]:
    """Render ``frames`` (a range such as ``1-48x2``, None for all that are baked) into ``out``; their paths in order.

    Frames that are there and whose inputs have not changed are left alone, and equal frames are rendered once.

    Raises InputError for a scene, bake, range or folder that cannot be used, RenderError when Blender fails,
    Cancelled when asked to stop; complete frames are kept then.
    """
    options = options or RenderOptions()
    require_photo(scene)
    opened = caches.open_bake(bake, scene.scene)
    caches.require_world(opened)
    caches.require_scene(opened, scene)
    for source, cache in zip(scene.scene.objects, opened.caches, strict=True):
        caches.require_fit(cache, len(load_object_mesh(scene, source).vertices), source.name)
    remedy = opened.unfinished or f"bake more in {bake}, or ask for fewer"
    numbers = parse_range(frames, opened.first_frame, opened.last_frame, there=f"baked; {remedy}")
    traces = options.engine == "cycles"
    denoised = traces and options.denoise and compat.denoiser_available()
    blender = f"Blender {bpy.app.version[0]}.{bpy.app.version[1]} {'denoised' if denoised else 'noisy'}"
    opened = photo_particles.find_tears(opened, scene)
    rest = [cache.sample(0) for cache in opened.caches]
    count, fps = max(opened.manifest.frames, opened.last_frame - opened.first_frame + 1), opened.manifest.fps
    shot = make_shot(scene, rest, options, first_frame=opened.first_frame, count=count, fps=fps)
    planned = plan_frames(scene, opened, numbers, options=options, shot=shot, blender=blender)
    suffix = options.frame_format.suffix
    Ledger(out, suffix=suffix)
    with folder_lock(out):
        ledger = Ledger(out, suffix=suffix, fps=fps)
        progress = StageProgress(on_event, "render", len(planned))
        if frames is None and opened.unfinished:
            progress.notice(f"frames {opened.first_frame} to {opened.last_frame} are rendered; {opened.unfinished}")
        if traces and options.denoise and not denoised:
            progress.notice("this Blender has no OpenImageDenoise; raise the samples if frames are grainy")
        for notice in shot.notices:
            progress.notice(notice)
        _make(scene, opened, planned, ledger, options, shot, progress, cancelled)
    return [ledger.path(frame.number) for frame in planned]


def _make(
    scene: SceneFolder,
    bake: caches.Bake,
    planned: list[Frame],
    ledger: Ledger,
    options: RenderOptions,
    shot: Shot,
    progress: StageProgress,
    cancelled: IsCancelled,
) -> None:
    missing = [frame for frame in planned if not ledger.is_complete(frame.number, frame.inputs)]
    if len(missing) < len(planned):
        progress.notice(f"{len(planned) - len(missing)} of {len(planned)} frames are up to date")
    names = [item.name for item in scene.scene.objects]
    renderer: OpenRenderer | None = None
    try:
        for done, frame in enumerate(missing, start=len(planned) - len(missing)):
            if cancelled():
                raise Cancelled(f"rendering cancelled after {done} of {len(planned)} frames; run it again to continue")
            progress.report(done, "preparing" if renderer is None else "")
            path, twin = ledger.path(frame.number), ledger.find(frame.inputs)
            if twin is not None:
                with replacing(path) as partial:
                    shutil.copyfile(twin, partial)
            else:
                renderer = renderer or OpenRenderer(scene, bake, options, shot, progress.notice)
                layers, data = renderer.layers(frame)
                write_frame(path, layers, data, options.frame_format, fps=bake.manifest.fps, names=names)
            ledger.record(frame.number, frame.inputs)
        progress.report(len(planned))
    finally:
        if renderer is not None:
            renderer.close()
