# SPDX-License-Identifier: GPL-3.0-or-later
"""One frame: three small renders and the photo become a picture (docs/rendering.md)."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim.composite import layers, rest, transfer
from ...sim.errors import InputError
from ...sim.scene.folder import SceneFolder
from . import passes, rest_light
from .caches import Bake
from .camera import render_size
from .objects import COLOUR_LAYER
from .options import RenderOptions
from .regions import Box, feather, ground_depth, object_box, shadow_region
from .scene import BlenderScene, build, remove

Samples = list[NDArray[np.float32]]


class Renderer:
    """Renders samples of one bake into the photo. Opening it measures the light at rest; close it after use."""

    def __init__(self, scene: SceneFolder, bake: Bake, options: RenderOptions) -> None:
        """Raises InputError for images, meshes or light that cannot be used, RenderError when Blender fails."""
        self._folder, self._scene, self._bake = scene, scene.scene, bake
        self._built: BlenderScene | None = None
        self._temporary = tempfile.TemporaryDirectory(prefix="physgen-render-")
        self._scratch = Path(self._temporary.name)
        self._size = render_size(self._scene.camera, options.scale)
        try:
            self._rest = self._samples(0)
            self._load_images()
            self._built = build(scene, bake, options)
            rest_light.measure(self._built, self._scratch)
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

    def frame(self, sample: int) -> NDArray[np.uint8]:
        """The picture (H, W, 3), 8-bit sRGB, of ``sample`` of the bake."""
        ground = layers.ground_layer(
            photo=self._photo,
            background=self._background,
            shadow=self._rest_shadow if sample == 0 else self._shadow(sample),
            rest_shadow=self._rest_shadow,
            at_rest=self._at_rest(self._samples(sample)),
            masks=self._masks,
        )
        return transfer.linear_to_bytes(layers.compose(self._objects(sample), ground))

    def _load_images(self) -> None:
        photo, background = (self._image(name) for name in (self._scene.photo, self._scene.background))
        self._photo, self._background = photo, background
        masks = [self._mask(item.mask) for item in self._scene.objects]
        self._masks = np.logical_or.reduce(masks)
        self._shares = rest.influence(
            [mask | self._mask(item.shadow) for mask, item in zip(masks, self._scene.objects, strict=True)]
        )
        self._rims = [
            rest.Rim(mask, self._masks, self._pixels(start)) for mask, start in zip(masks, self._rest, strict=True)
        ]

    def _image(self, name: str) -> transfer.Linear:
        pixels = transfer.read_rgb(self._folder.file(name))
        height, width = pixels.shape[:2]
        camera = self._scene.camera
        if (width, height) != (camera.width, camera.height):
            raise InputError(
                f"{self._folder.file(name)}: is {width}×{height}, the camera's image is "
                f"{camera.width}×{camera.height}; reconstruct the scene again"
            )
        return transfer.resized(transfer.bytes_to_linear(pixels), *self._size)

    def _mask(self, name: str | None) -> NDArray[np.bool_]:
        if name is None:
            return np.zeros(self._size[::-1], dtype=bool)
        mask = transfer.read_mask(self._folder.file(name))
        camera = self._scene.camera
        if mask.shape != (camera.height, camera.width):
            raise InputError(
                f"{self._folder.file(name)}: is {mask.shape[1]}×{mask.shape[0]}, the camera's image is "
                f"{camera.width}×{camera.height}; reconstruct the scene again"
            )
        return np.asarray(transfer.resized(mask.astype(np.float32), *self._size) > 0.5)

    def _samples(self, sample: int) -> Samples:
        return [cache.sample(sample) for cache in self._bake.caches]

    def _pixels(self, positions: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where world ``positions`` (V, 3) are on the frame (V, 2)."""
        camera = self._scene.camera
        scale = np.array([self._size[0] / camera.width, self._size[1] / camera.height])
        return camera.project(positions)[:, :2] * scale

    def _at_rest(self, now: Samples) -> NDArray[np.float32]:
        normal = np.asarray(self._scene.ground.normal)
        weights = []
        for item, start, positions in zip(self._scene.objects, self._rest, now, strict=True):
            contact = rest.contact_vertices(start, normal)
            weights.append(rest.rest_weight(rest.contact_displacement(start, positions, contact, item.size_m)))
        at_rest = rest.rest_map(self._shares, weights)
        for rim, positions in zip(self._rims, now, strict=True):
            rim.apply(at_rest, self._pixels(positions))
        return at_rest

    def _objects(self, sample: int) -> layers.ObjectLayer:
        assert self._built is not None
        layer = layers.empty_layer(*self._size)
        number, positions = self._bake.first_frame + sample, self._samples(sample)
        box = object_box(self._scene.camera, positions, self._size)
        light_box = object_box(self._scene.camera, positions, self._built.light_size)
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
        region = shadow_region(self._scene, self._samples(sample), size)
        if region is not None:
            box = region.box
            number = self._bake.first_frame + sample
            lit = passes.stack(passes.render(self._built.shadow_scene, number, box, self._scratch), "Combined")
            empty = self._open_ground[box.slices]
            # Objects only take light from the ground here; more than all of it is noise.
            quotient = np.clip(lit / np.maximum(empty, 1e-6), 0.0, 1.0)
            # Towards the horizon pixels see ever more ground, and above it none at all.
            near = np.clip(3.0 - 2.0 * self._ground_depth[box.slices] / region.far, 0.0, 1.0)
            ratio[box.slices] = 1.0 + (quotient - 1.0) * (feather(box, size) * near)[..., None]
        return np.asarray(cv2.resize(ratio, self._size, interpolation=cv2.INTER_LINEAR))
