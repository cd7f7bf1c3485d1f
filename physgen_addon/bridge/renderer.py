# SPDX-License-Identifier: GPL-3.0-or-later
"""One frame: three small renders and the photo become a picture (docs/rendering.md)."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim.composite import layers
from ...sim.scene.folder import SceneFolder
from . import passes, photo_particles, rest_light
from .caches import Bake
from .camera import render_size
from .data_passes import STEPS, DataLayers, DataScene
from .objects import COLOUR_LAYER
from .options import RenderOptions
from .plate import Plate
from .regions import Box, feather, ground_depth, object_box, shadow_region
from .scene import BlenderScene, build, everything, remove
from .view import View

Samples = list[NDArray[np.float32]]


class Renderer:
    """Renders samples of one bake into the photo. Opening it measures the light at rest; close it after use."""

    def __init__(self, scene: SceneFolder, bake: Bake, options: RenderOptions) -> None:
        """Raises InputError for images, meshes or light that cannot be used, RenderError when Blender fails."""
        self._folder, self._scene, self._bake, self._options = scene, scene.scene, bake, options
        self._built: BlenderScene | None = None
        self._data_scene: DataScene | None = None
        self._temporary = tempfile.TemporaryDirectory(prefix="physgen-render-")
        self._scratch = Path(self._temporary.name)
        self._size = render_size(self._scene.camera, options.scale)
        try:
            self._plate = Plate(scene, self._size, self._samples(0))
            self._built = build(scene, bake, options)
            rest_light.measure(self._built, self._scratch)
            if options.frame_format.layered:
                self._data_scene = DataScene(self._built)
            self._reach = self._add_particles(self._built)
            self._ground_depth = ground_depth(self._scene, self._built.light_size)
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

    def frame(self, sample: int) -> layers.FrameLayers:
        """``sample`` of the bake as a picture (linear light), with what it was made of."""
        view = View(self._scene.camera)
        shadow = self._rest_shadow if sample == 0 else self._shadow(sample)
        ground = layers.ground_layer(
            photo=view.warp(self._plate.photo),
            background=view.warp(self._plate.background),
            shadow=shadow,
            rest_shadow=view.warp(self._rest_shadow),
            at_rest=view.warp(self._plate.at_rest(self._samples(sample))),
            masks=view.warp(self._plate.masks),
        )
        objects = self._objects(sample)
        beauty = layers.compose(objects, ground)
        return layers.FrameLayers(ground=ground, shadow=shadow, objects=objects, beauty=beauty)

    def _add_particles(self, built: BlenderScene) -> float:
        """Add the particles of what flows; how far beyond their centres something of them is seen, m."""
        before, reach = everything(), 0.0
        carried = STEPS if self._data_scene is not None else ()
        objects = zip(built.objects, self._bake.flows, self._bake.caches, strict=True)
        for number, (target, flow, cache) in enumerate(objects, start=1):
            if flow is not None and flow.from_sample is not None:
                item, far = photo_particles.add(target, flow, cache, self._bake.first_frame, carried=carried)
                reach = max(reach, far)
                if self._data_scene is not None:
                    self._data_scene.follow(item, number)
        built.own += list(everything() - before)
        return reach

    def data(self, sample: int, *, after: int, before: int) -> DataLayers:
        """Depth, object ids and flow of ``sample``, which ``after`` follows and ``before`` precedes.

        Only of a renderer whose options ask for layered frames.
        """
        assert self._data_scene is not None
        shown = [flow.cache for flow in self._bake.flows if flow is not None and flow.from_sample is not None]
        steps = []
        for cache in (*self._bake.caches, *shown):
            now = cache.sample(sample)
            steps.append((cache.sample(after) - now, cache.sample(before) - now))
        camera = self._scene.camera
        return self._data_scene.render(
            self._bake.first_frame + sample,
            self._object_box(self._shown(sample), self._size),
            self._scratch,
            scene=self._scene,
            cameras=(camera, camera, camera),
            steps=steps,
        )

    def _samples(self, sample: int) -> Samples:
        return [cache.sample(sample) for cache in self._bake.caches]

    def _shown(self, sample: int) -> Samples:
        """Where the objects are, with their particles as far as these are shown: (V + N, 3) each."""
        shown = []
        for vertices, flow in zip(self._samples(sample), self._bake.flows, strict=True):
            if flow is not None and flow.shown_at(sample):
                vertices = np.concatenate([vertices, flow.cache.sample(sample)])
            shown.append(vertices)
        return shown

    def _objects(self, sample: int) -> layers.ObjectLayer:
        assert self._built is not None
        layer = layers.empty_layer(*self._size)
        number, positions = self._bake.first_frame + sample, self._shown(sample)
        box, light_box = (self._object_box(positions, size) for size in (self._size, self._built.light_size))
        if box is None or light_box is None:
            return layer
        colours = passes.render(self._built.colour_scene, number, box, self._scratch)
        layer.texture[box.slices] = passes.stack(colours, COLOUR_LAYER)
        layer.alpha[box.slices] = colours["Combined.A"]
        lit = passes.render(self._built.light_scene, number, light_box, self._scratch)
        light = np.ones((*self._built.light_size[::-1], 3), np.float32)
        light[light_box.slices] = layers.light_ratio(passes.stack(lit, "Combined"), lit["Combined.A"])
        layer.light[:] = cv2.resize(light, self._size, interpolation=cv2.INTER_LINEAR)
        return layer

    def _object_box(self, positions: Samples, size: tuple[int, int]) -> Box | None:
        if not self._options.crop:
            return Box(0, 0, *size)
        return object_box(self._scene.camera, positions, size, self._reach)

    def _empty_ground(self) -> NDArray[np.float32]:
        """Light on the ground without objects (h, w, 3), in the resolution of light."""
        assert self._built is not None
        for target in self._built.objects:
            target.item.hide_render = True
        box = Box(0, 0, *self._built.light_size)
        channels = passes.render(self._built.shadow_scene, self._bake.first_frame, box, self._scratch)
        for target in self._built.objects:
            target.item.hide_render = False
        return passes.stack(channels, "Combined")

    def _shadow(self, sample: int) -> NDArray[np.float32]:
        """Light on the ground over light on the empty ground (H, W, 3), 1 where no object reaches."""
        assert self._built is not None
        size = self._built.light_size
        ratio = np.ones((size[1], size[0], 3), np.float32)
        region = shadow_region(self._scene, self._shown(sample), size)
        if region is not None:
            box = region.box if self._options.crop else Box(0, 0, *size)
            number = self._bake.first_frame + sample
            lit = passes.stack(passes.render(self._built.shadow_scene, number, box, self._scratch), "Combined")
            empty = self._open_ground[box.slices]
            # Objects only take light from the ground here; more than all of it is noise.
            quotient = np.clip(lit / np.maximum(empty, 1e-6), 0.0, 1.0)
            # Towards the horizon pixels see ever more ground, and above it none at all.
            near = np.clip(3.0 - 2.0 * self._ground_depth[box.slices] / region.far, 0.0, 1.0)
            ratio[box.slices] = 1.0 + (quotient - 1.0) * (feather(box, size) * near)[..., None]
        return np.asarray(cv2.resize(ratio, self._size, interpolation=cv2.INTER_LINEAR))
