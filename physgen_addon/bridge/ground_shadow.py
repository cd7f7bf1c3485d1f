# SPDX-License-Identifier: GPL-3.0-or-later
"""Light on the ground with the objects over light without: their shadows, rendered no wider and no finer than is seen.

Near the objects, and where the sun's shadow falls, in the resolution of light. What they take from the sky reaches much
farther and is smooth there, so around that it is rendered coarsely.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim.composite.transfer import Linear
from ...sim.scene.model import Camera, Scene
from . import passes
from .camera import aim_camera
from .options import RenderOptions
from .regions import NEAR_REACH, Box, feather, ground_depth, shadow_region
from .scene import BlenderScene
from .stroke import Moment

COARSE = 4
"""How many pixels of the resolution of light one is that shows the sky's far shadow."""

LEAST_COARSE_PX = 64
"""Fewer pixels than these on its longer side the coarse part never has, however small the frame is."""

Size = tuple[int, int]


class GroundShadow:
    """Renders the shadows of one Blender scene."""

    def __init__(self, scene: Scene, built: BlenderScene, options: RenderOptions, scratch: Path) -> None:
        """``scratch`` takes temporary files."""
        self._scene, self._built, self._options, self._scratch = scene, built, options, scratch
        self._fine = built.light_size
        width, height = self._fine
        scale = min(1.0, max(1.0 / COARSE, LEAST_COARSE_PX / max(width, height)))
        self._coarse = max(1, round(width * scale)), max(1, round(height * scale))
        self._empty: dict[Size, Linear] = {}

    def ratio(self, moment: Moment, camera: Camera, size: Size) -> Linear:
        """What ``camera`` sees of it at ``moment``, (H, W, 3) of ``size``; 1 where no object reaches."""
        scene = replace(self._scene, camera=camera)
        if not self._options.crop:
            ratio = self._of(scene, moment, self._fine, Box(0, 0, *self._fine), np.ones((*self._fine[::-1], 3)))
            return _enlarged(ratio, size)
        far = shadow_region(scene, moment.swept, self._coarse)
        ratio = np.ones((*self._coarse[::-1], 3), np.float32)
        if far is not None:
            ratio = self._of(scene, moment, self._coarse, far.box, ratio)
        ratio = _enlarged(ratio, self._fine)
        near = shadow_region(scene, moment.swept, self._fine, sky_reach=NEAR_REACH)
        if near is not None:
            ratio = self._of(scene, moment, self._fine, near.box, ratio)
        return _enlarged(ratio, size)

    def _of(self, scene: Scene, moment: Moment, size: Size, box: Box, around: NDArray[np.floating]) -> Linear:
        """The ratio (h, w, 3) in ``box`` of an image of ``size``, and ``around`` (h, w, 3) it."""
        with self._at(scene.camera, size):
            samples = moment.samples(self._options.samples, at_most=1)
            passes.open_shutter(self._built.shadow_scene, moment.shutter, samples)
            lit = self._built.ground_light(moment.number, box, self._scratch)
            empty = self._without_objects(scene.camera, size, box)
        # Objects only take light from the ground here; more than all of it is noise.
        quotient = np.clip(lit / np.maximum(empty, 1e-6), 0.0, 1.0)
        weight = feather(box, size)
        region = shadow_region(scene, moment.swept, size)
        if region is not None:
            # Towards the horizon pixels see ever more ground, and above it none at all.
            depth = ground_depth(scene, size)[box.slices]
            weight = weight * np.clip(3.0 - 2.0 * depth / region.far, 0.0, 1.0)
        ratio = np.asarray(around, np.float32).copy()
        ratio[box.slices] += (quotient - ratio[box.slices]) * weight[..., None]
        return ratio

    def _without_objects(self, camera: Camera, size: Size, box: Box) -> Linear:
        """Light on the empty ground (h, w, 3) in ``box``. Of the photo's own camera all of it is kept."""
        if camera != self._scene.camera:
            return self._render_empty(box)
        if size not in self._empty:
            self._empty[size] = self._render_empty(Box(0, 0, *size))
        return self._empty[size][box.slices]

    def _render_empty(self, box: Box) -> Linear:
        hidden = list(self._built.collection.objects)
        for item in hidden:
            item.hide_render = True
        try:
            return self._built.ground_light(self._built.first_frame, box, self._scratch)
        finally:
            for item in hidden:
                item.hide_render = False

    @contextmanager
    def _at(self, camera: Camera, size: Size) -> Iterator[None]:
        """Let the scene have ``size`` pixels meanwhile."""
        scene = self._built.shadow_scene
        scene.render.resolution_x, scene.render.resolution_y = size
        aim_camera(scene, camera)
        try:
            yield
        finally:
            scene.render.resolution_x, scene.render.resolution_y = self._fine
            aim_camera(scene, camera)


def _enlarged(ratio: Linear, size: Size) -> Linear:
    """``ratio`` (h, w, 3) at ``size`` (width, height)."""
    return np.asarray(cv2.resize(ratio, size, interpolation=cv2.INTER_LINEAR))
