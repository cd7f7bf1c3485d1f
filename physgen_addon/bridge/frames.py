# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene folder and bake folder → PNG frames: only what is missing, only where something can be seen."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import bpy
import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim.app.events import IsCancelled, OnEvent, StageProgress, ignore, never
from ...sim.atomic import replacing
from ...sim.cache.lock import folder_lock
from ...sim.composite import layers, rest, transfer
from ...sim.errors import Cancelled, InputError
from ...sim.scene.folder import SceneFolder
from ...sim.scene.meshes import load_object_mesh
from . import caches, compat, passes, rest_light
from .camera import render_size
from .ledger import Ledger
from .objects import COLOUR_LAYER
from .options import RenderOptions
from .plan import Frame, parse_range, plan_frames
from .regions import Box, feather, object_box, shadow_box
from .scene import BlenderScene, build, remove

Samples = list[NDArray[np.float32]]


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
    opened = caches.open_bake(bake, scene.scene)
    for source, cache in zip(scene.scene.objects, opened.caches, strict=True):
        caches.require_fit(cache, len(load_object_mesh(scene, source).vertices), source.name)
    numbers = parse_range(frames, opened.first_frame, opened.last_frame)
    denoised = options.denoise and compat.denoiser_available()
    blender = f"Blender {bpy.app.version[0]}.{bpy.app.version[1]} {'denoised' if denoised else 'noisy'}"
    planned = plan_frames(
        scene, opened.caches, numbers, first_frame=opened.first_frame, options=options, blender=blender
    )
    Ledger(out)
    with folder_lock(out):
        ledger = Ledger(out)
        progress = StageProgress(on_event, "render", len(planned))
        if options.denoise and not denoised:
            progress.notice("this Blender has no OpenImageDenoise; raise the samples if frames are grainy")
        _make(scene, opened, planned, ledger, options, progress, cancelled)
    return [ledger.path(frame.number) for frame in planned]


def _make(
    scene: SceneFolder,
    bake: caches.Bake,
    planned: list[Frame],
    ledger: Ledger,
    options: RenderOptions,
    progress: StageProgress,
    cancelled: IsCancelled,
) -> None:
    missing = [frame for frame in planned if not ledger.is_complete(frame.number, frame.inputs)]
    if len(missing) < len(planned):
        progress.notice(f"{len(planned) - len(missing)} of {len(planned)} frames are up to date")
    renderer: Renderer | None = None
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
                renderer = renderer or Renderer(scene, bake, options)
                transfer.write_rgb(path, renderer.frame(frame.sample))
            ledger.record(frame.number, frame.inputs)
        progress.report(len(planned))
    finally:
        if renderer is not None:
            renderer.close()


class Renderer:
    """Renders samples of one bake into the photo. Opening it measures the light at rest; close it after use."""

    def __init__(self, scene: SceneFolder, bake: caches.Bake, options: RenderOptions) -> None:
        self._scene, self._bake = scene, bake
        self._temporary = tempfile.TemporaryDirectory(prefix="physgen-render-")
        self._folder = Path(self._temporary.name)
        self._built: BlenderScene | None = None
        try:
            self._load_images(render_size(scene.scene.camera, options.scale))
            self._built = build(scene, bake, options)
            rest_light.measure(self._built, self._folder)
            self._rest = self._samples(0)
            self._open_ground = self._empty_ground()
            self._rest_shadow = self._shadow(0)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the Blender scenes and temporary files."""
        if self._built is not None:
            remove(self._built)
            self._built = None
        self._temporary.cleanup()

    def frame(self, sample: int) -> NDArray[np.uint8]:
        """The picture (H, W, 3), 8-bit sRGB, of ``sample`` of the bake."""
        now = self._samples(sample)
        scene = self._scene.scene
        normal = np.asarray(scene.ground.normal)
        weights = []
        for item, start, positions in zip(scene.objects, self._rest, now, strict=True):
            contact = rest.contact_vertices(start, normal)
            weights.append(rest.rest_weight(rest.contact_displacement(start, positions, contact, item.size_m)))
        ground = layers.ground_layer(
            photo=self._photo,
            background=self._background,
            shadow=self._rest_shadow if sample == 0 else self._shadow(sample),
            rest_shadow=self._rest_shadow,
            at_rest=rest.rest_map(self._shares, weights),
            masks=self._masks,
        )
        return transfer.linear_to_bytes(layers.compose(self._objects(sample), ground))

    def _load_images(self, size: tuple[int, int]) -> None:
        scene = self._scene.scene
        photo = transfer.read_rgb(self._scene.file(scene.photo))
        background = transfer.read_rgb(self._scene.file(scene.background))
        expected = (scene.camera.height, scene.camera.width)
        for name, pixels in ((scene.photo, photo), (scene.background, background)):
            if pixels.shape[:2] != expected:
                raise InputError(
                    f"{self._scene.file(name)}: is {pixels.shape[1]}×{pixels.shape[0]}, the camera's image is "
                    f"{expected[1]}×{expected[0]}; reconstruct the scene again"
                )
        self._photo = transfer.resized(transfer.bytes_to_linear(photo), *size)
        self._background = transfer.resized(transfer.bytes_to_linear(background), *size)
        masks, places = [], []
        for item in scene.objects:
            mask = self._mask(item.mask, size)
            masks.append(mask)
            places.append(mask | self._mask(item.shadow, size))
        self._masks = np.logical_or.reduce(masks)
        self._shares = rest.influence(places)

    def _mask(self, name: str | None, size: tuple[int, int]) -> NDArray[np.bool_]:
        if name is None:
            return np.zeros(size[::-1], dtype=bool)
        mask = transfer.read_mask(self._scene.file(name))
        return np.asarray(transfer.resized(mask.astype(np.float32), *size) > 0.5)

    def _samples(self, sample: int) -> Samples:
        return [cache.sample(sample) for cache in self._bake.caches]

    def _objects(self, sample: int) -> layers.ObjectLayer:
        assert self._built is not None
        width, height = self._built.size
        layer = layers.empty_layer(width, height)
        box = object_box(self._scene.scene.camera, self._samples(sample), (width, height))
        if box is not None:
            channels = passes.render(self._built.object_scene, self._bake.first_frame + sample, box, self._folder)
            layer.texture[box.slices] = passes.stack(channels, COLOUR_LAYER)
            layer.light[box.slices] = passes.stack(channels, "Combined")
            layer.alpha[box.slices] = channels["Combined.A"]
        return layer

    def _empty_ground(self) -> NDArray[np.float32]:
        """Light on the ground without objects (h, w, 3), at the shadows' resolution."""
        assert self._built is not None
        for target in self._built.objects:
            target.item.hide_render = True
        box = Box(0, 0, *self._built.shadow_size)
        channels = passes.render(self._built.shadow_scene, self._bake.first_frame, box, self._folder)
        for target in self._built.objects:
            target.item.hide_render = False
        return passes.stack(channels, "Combined")

    def _shadow(self, sample: int) -> NDArray[np.float32]:
        """Light on the ground over light on the empty ground (H, W, 3), 1 where no object reaches."""
        assert self._built is not None
        size = self._built.shadow_size
        ratio = np.ones((size[1], size[0], 3), np.float32)
        box = shadow_box(self._scene.scene, self._samples(sample), size)
        if box is not None:
            channels = passes.render(self._built.shadow_scene, self._bake.first_frame + sample, box, self._folder)
            lit, empty = passes.stack(channels, "Combined"), self._open_ground[box.slices]
            quotient = np.where(empty > 1e-6, lit / np.maximum(empty, 1e-6), 1.0)
            # Objects only take light from the ground here; more than all of it is noise.
            ratio[box.slices] = 1.0 + (np.clip(quotient, 0.0, 1.0) - 1.0) * feather(box, size)[..., None]
        return np.asarray(cv2.resize(ratio, self._built.size, interpolation=cv2.INTER_LINEAR))
