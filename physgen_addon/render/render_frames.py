# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene folder and bake folder → frames: render only frames that are missing and only where they change."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...sim.app.clip_check import Clip, clip_notices
from ...sim.atomic import recover, replacing
from ...sim.cache.bake_check import require_intact, unchanged_bake
from ...sim.cache.bake_folder import Bake
from ...sim.composite.compositing import FrameLayers
from ...sim.errors import Cancelled, InputError, RenderError
from ...sim.events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...sim.folder_lock import folder_lock
from ...sim.scene.folder import Scene, file_hash, require_photo
from ...sim.scene.meshes import load_object_mesh
from ...sim.scene.model import Camera
from ...sim.validation import to_json
from ...sim.version import VERSION
from .. import compat
from ..frames.frame_files import write_frame
from ..frames.frame_index import FrameIndex, parse_frame_range
from ..playback import point_caches
from ..playback.point_caches import OpenedBake
from . import motion_blur, photo_particles, render_engines
from .clean_plate import CameraMotion, make_camera_motion
from .motion_blur import Pose
from .render_options import RenderOptions
from .renderer import DataLayers, Renderer

RENDER_REVISION = 20
"""Increased with every change of rendering that affects frames."""


@dataclass(frozen=True)
class Frame:
    """Frame ``number`` shows ``sample`` of every cache; ``inputs`` is the hash of all its inputs.

    Frames without motion share the sample of the first of them and, if the camera is static too, the hash. A frame with
    motion blur depends on two samples and is unique. ``after`` and ``before`` are the samples of the next frame and the
    previous one where needed (for optical flow); else equal to ``sample``. ``cameras`` are those of this frame, the
    next and the previous one, in pixels of the photo.
    """

    number: int
    sample: int
    inputs: str
    after: int
    before: int
    cameras: tuple[Camera, Camera, Camera]


def plan_frames(
    folder: Scene,
    bake: OpenedBake,
    numbers: Sequence[int],
    *,
    options: RenderOptions,
    shot: CameraMotion,
    blender: str,
) -> list[Frame]:
    """Return the frames ``numbers`` (ascending) with hashes of their inputs; ``blender`` identifies renderer and
    version.
    """
    base = _scene_hash(folder, options, blender)
    flow, first_frame = options.frame_format.layered, bake.first_frame
    last = max(numbers) - first_frame + int(flow) if numbers else -1
    count = min(last, bake.last_frame - first_frame) + 1
    shown = _shown(folder, bake, count, base=base, options=options, shot=shot)
    frames = []
    for number in numbers:
        index = number - first_frame
        sample, inputs = shown[index]
        after = before = sample
        if flow:
            # Before the first frame and after the last there is no data, hence no motion.
            following, preceding = shown[min(index + 1, len(shown) - 1)], shown[max(index - 1, 0)]
            (after, next_inputs), (before, last_inputs) = following, preceding
            inputs = hashlib.sha256(f"{inputs} {next_inputs} {last_inputs}".encode()).hexdigest()
        here, ahead, behind = (shot.camera(i) for i in (index, min(index + 1, len(shown) - 1), max(index - 1, 0)))
        cameras = (here, ahead, behind)
        frames.append(Frame(number=number, sample=sample, inputs=inputs, after=after, before=before, cameras=cameras))
    return frames


def _shown(
    folder: Scene, bake: OpenedBake, count: int, *, base: str, options: RenderOptions, shot: CameraMotion
) -> list[tuple[int, str]]:
    """Return for each of the first ``count`` samples the earliest one that looks the same, or itself, and its hash.

    The hash covers what the sample's own camera sees.
    """
    before = key = rest = motion_blur.pose(bake, 0)
    key_index, key_hash, sharp = 0, _hash(base, rest), True
    rest_hash = key_hash
    still = motion_blur.still_distance(folder.model.camera, rest, options.scale)
    shown = []
    for index in range(count):
        now = motion_blur.pose(bake, index)
        if options.motion_blur > 0 and not now.same(before, still):
            key, key_index, key_hash, sharp = now, index, _hash(base, before, now), False
        elif now.same(rest, still):
            key, key_index, key_hash, sharp = rest, 0, rest_hash, True
        elif not sharp or not now.same(key, still):
            key, key_index, key_hash, sharp = now, index, _hash(base, now), True
        before = now
        shown.append((key_index, _seen_hash(folder, key_hash, shot.inputs(index))))
    return shown


def _seen_hash(folder: Scene, inputs: str, view: Any) -> str:
    """Return the hash of ``inputs`` and the camera's ``view``; ``inputs`` itself for the photo's own camera, None."""
    if view is None:
        return inputs
    depth = folder.model.depth
    content = [inputs, view, None if depth is None else _file_hash(folder, depth)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _scene_hash(folder: Scene, options: RenderOptions, blender: str) -> str:
    """Return the hash of all inputs but motion; quantities that only affect motion (material, velocity, effects) are
    excluded.
    """
    scene, ground = folder.model, folder.model.ground
    settings = to_json(options)
    # Each frame's own hash contains its camera. The device does not change the image, and
    # a run that falls back to the CPU must be able to resume.
    for name in ("threads", "device", "camera", "orbit", "rise", "dolly"):
        del settings[name]
    files = [scene.photo, scene.background, scene.light.environment]
    objects = []
    for item in scene.objects:
        files += [item.mesh, item.mask, item.shadow, item.shading]
        objects.append([item.name, to_json(item.world_from_mesh), item.size_m])
    content = {
        "revision": [RENDER_REVISION, VERSION, blender],
        "camera": to_json(scene.camera),
        "ground": ground and [ground.point, ground.normal, ground.reflectivity, ground.reflection_roughness],
        "light": to_json(scene.light),
        "objects": objects,
        "files": [[name, _file_hash(folder, name)] for name in files if name is not None],
        "options": settings,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _file_hash(folder: Scene, name: str) -> str:
    path: Path = folder.file(name)
    return file_hash(path)


def _hash(base: str, *poses: Pose) -> str:
    digest = hashlib.sha256(f"{base} {[pose.flowing for pose in poses]}".encode())
    for pose in poses:
        for sample in pose.every:
            digest.update(np.ascontiguousarray(sample, dtype="<f4").tobytes())
    return digest.hexdigest()


class OpenRenderer:
    """Renders the frames of a plan. Close it after use."""

    def __init__(
        self,
        scene: Scene,
        bake: point_caches.OpenedBake,
        options: RenderOptions,
        shot: CameraMotion,
        notice: Callable[[str], None],
    ) -> None:
        """``notice`` reports which device renders. Raises InputError and RenderError as ``Renderer`` does."""
        self._inputs, self._notice = (scene, bake, shot), notice
        if options.engine == "eevee":
            notice(f"EEVEE draws on {render_engines.require_graphics()}")
        else:
            compat.enable_cycles()
            options = dataclasses.replace(options, device=render_engines.choose_device(options.device, notice))
        self._options = options
        try:
            self._renderer = self._open()
        except RenderError as error:
            self._fall_back(error)

    def layers(self, frame: Frame) -> tuple[FrameLayers, DataLayers | None]:
        """Return the layers of ``frame``, and its data if the options request them. Raises RenderError."""
        try:
            return self._layers(frame)
        except RenderError as error:
            self.close()
            self._fall_back(error)
            return self._layers(frame)

    def close(self) -> None:
        """Remove what was built in Blender."""
        self._renderer.close()

    def _open(self) -> Renderer:
        scene, bake, shot = self._inputs
        return Renderer(scene, bake, self._options, shot)

    def _fall_back(self, error: RenderError) -> None:
        """Open a renderer on the CPU after one failed with ``error`` on a graphics card; otherwise raise ``error``."""
        if self._options.engine != "cycles" or self._options.device == "cpu":
            raise error
        self._notice(f"{self._options.device} failed ({error}); renders on the CPU from here on")
        self._options = dataclasses.replace(self._options, device="cpu")
        self._renderer = self._open()

    def _layers(self, frame: Frame) -> tuple[FrameLayers, DataLayers | None]:
        renderer, data = self._renderer, None
        made = renderer.frame(frame.sample, frame.cameras[0])
        if self._options.frame_format.layered:
            data = renderer.data(frame.sample, after=frame.after, before=frame.before, cameras=frame.cameras)
        return made, data


def render_frames(
    scene: Scene,
    bake: Bake,
    *,
    out: Path,
    options: RenderOptions | None = None,
    frames: str | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> list[Path]:
    """Render ``frames`` (a range such as ``1-48x2``, None for all baked ones) to ``out``; return their paths in order.

    Existing frames with unchanged inputs are kept, and equal frames are rendered once.

    Raises InputError for an unusable scene, bake, range or folder, RenderError if Blender fails, Cancelled when
    cancelled; complete frames are kept then.
    """
    require_photo(scene)
    with unchanged_bake(bake) as require_bake:
        job = _plan_job(scene, bake, options or RenderOptions(), frames, require_bake)
        suffix = job.options.frame_format.suffix
        FrameIndex(out, suffix=suffix)
        with folder_lock(out):
            recover(out)
            frame_index = FrameIndex(out, suffix=suffix, fps=job.bake.manifest.fps)
            progress = StageProgress(on_event, "render", len(job.planned))
            for notice in job.notices:
                progress.notice(notice)
            _make(job, frame_index, progress, cancelled)
        return [frame_index.path(frame.number) for frame in job.planned]


@dataclass(frozen=True)
class _Job:
    """The frames ``planned`` of an opened bake in a scene, and what has to be said before they are rendered.

    ``scene_hash`` is that of the scene as the plan was made, ``require_bake`` raises where the bake has changed since.
    """

    scene: Scene
    bake: OpenedBake
    options: RenderOptions
    shot: CameraMotion
    blender: str
    planned: list[Frame]
    notices: list[str]
    scene_hash: str
    require_bake: Callable[[], None]

    def require_same(self, *, scene_too: bool) -> None:
        """Raise InputError if another command has changed the bake, or with ``scene_too`` the scene, since the plan."""
        self.require_bake()
        if scene_too and _scene_hash(self.scene, self.options, self.blender) != self.scene_hash:
            raise InputError(f"{self.scene.root}: was changed by another command meanwhile; run this one again")


def _plan_job(
    scene: Scene, bake: Bake, options: RenderOptions, frames: str | None, require_bake: Callable[[], None]
) -> _Job:
    """Return the job of rendering ``frames``. Raises InputError where bake and scene do not fit."""
    opened = point_caches.open_bake(bake, scene)
    point_caches.require_world(opened)
    point_caches.require_scene(opened, scene)
    for source, cache in zip(scene.model.objects, opened.caches, strict=True):
        point_caches.require_fit(cache, len(load_object_mesh(scene, source).vertices), source.name)
    remedy = opened.unfinished or f"bake more in {bake.root}, or ask for fewer"
    numbers = parse_frame_range(frames, opened.first_frame, opened.last_frame, there=f"baked; {remedy}")
    # Motion blur and flow look at the neighbours, and what stands still is looked for from the first frame on.
    require_intact(bake, range(max(numbers, default=0) - bake.first_frame + 2))
    wanted = options.engine == "cycles" and options.denoise
    denoised = wanted and compat.denoiser_available()
    blender = f"Blender {bpy.app.version[0]}.{bpy.app.version[1]} {'denoised' if denoised else 'noisy'}"
    opened = photo_particles.find_tears(opened, scene)
    rest = [cache.sample(0) for cache in opened.caches]
    count, fps = max(opened.manifest.frames, opened.last_frame - opened.first_frame + 1), opened.manifest.fps
    shot = make_camera_motion(scene, rest, options, first_frame=opened.first_frame, count=count, fps=fps)
    notices = []
    if frames is None and opened.unfinished:
        notices.append(f"frames {opened.first_frame} to {opened.last_frame} are rendered; {opened.unfinished}")
    if wanted and not denoised:
        notices.append(
            "OpenImageDenoise is missing in this Blender or cannot be loaded now: frames are not denoised; raise the "
            "samples, or free memory and run again, which renders them anew"
        )
    return _Job(
        scene=scene,
        bake=opened,
        options=options,
        shot=shot,
        blender=blender,
        # Before the frames' own hashes, so that a scene that changes in between is noticed.
        scene_hash=_scene_hash(scene, options, blender),
        planned=plan_frames(scene, opened, numbers, options=options, shot=shot, blender=blender),
        notices=[*notices, *shot.notices, *_clip_notices(scene, opened, numbers, shot)],
        require_bake=require_bake,
    )


def _clip_notices(scene: Scene, bake: point_caches.OpenedBake, numbers: Sequence[int], shot: CameraMotion) -> list[str]:
    """Return what the whole clip will not show; nothing for a part of it, of which another process is asked."""
    samples = range(bake.last_frame - bake.first_frame + 1)
    if numbers[0] != bake.first_frame or numbers[-1] != bake.last_frame:
        return []
    poses = ([cache.sample(sample) for cache in bake.caches] for sample in samples)
    clip = Clip(first=bake.first_frame, fps=bake.manifest.fps, slow=bake.manifest.slow)
    return clip_notices([item.name for item in scene.objects], poses, (shot.camera(n) for n in samples), clip)


def _make(job: _Job, frame_index: FrameIndex, progress: StageProgress, cancelled: IsCancelled) -> None:
    planned = job.planned
    missing = [frame for frame in planned if not frame_index.is_complete(frame.number, frame.inputs)]
    if len(missing) < len(planned):
        progress.notice(f"{len(planned) - len(missing)} of {len(planned)} frames are up to date")
    names = [item.name for item in job.scene.model.objects]
    renderer: OpenRenderer | None = None
    try:
        for done, frame in enumerate(missing, start=len(planned) - len(missing)):
            if cancelled():
                raise Cancelled(f"rendering cancelled after {done} of {len(planned)} frames; run it again to continue")
            progress.report(done, "preparing" if renderer is None else "")
            path, twin = frame_index.path(frame.number), frame_index.find(frame.inputs)
            if twin is not None:
                with replacing(path) as partial:
                    shutil.copyfile(twin, partial)
            else:
                is_first = renderer is None
                renderer = renderer or OpenRenderer(job.scene, job.bake, job.options, job.shot, progress.notice)
                layers, data = renderer.layers(frame)
                # What Blender has read is what the frame is recorded to be of; the scene, all of it with the first one.
                job.require_same(scene_too=is_first)
                frame_index.begin()
                write_frame(path, layers, data, job.options.frame_format, fps=job.bake.manifest.fps, names=names)
            frame_index.record(frame.number, frame.inputs)
        progress.report(len(planned))
    finally:
        if renderer is not None:
            renderer.close()
