# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders what a glossy floor mirrors: the same two small renders as for the objects, from below the floor."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import numpy as np

from ...sim.composite import mirror
from ...sim.composite.layers import ObjectLayer
from ...sim.composite.spread import spread
from ...sim.scene.model import Camera, Scene
from .camera import add_camera
from .options import RenderOptions
from .scene import BlenderScene
from .stroke import Moment

Objects = Callable[[Camera, Moment], ObjectLayer]
"""Renders the objects of a moment as a camera sees them that Blender's scenes have already."""


class Reflections:
    """What the ground of one scene mirrors."""

    def __init__(self, scene: Scene, built: BlenderScene, objects: Objects) -> None:
        """``objects`` renders with the cameras that ``built`` has."""
        assert scene.ground is not None
        self._ground, self._built, self._objects = scene.ground, built, objects

    def layer(self, camera: Camera, moment: Moment) -> mirror.Mirrored:
        """What the floor shows ``camera`` of the objects in ``moment``."""
        below = mirror.mirrored_camera(camera, self._ground)
        seen = self._from(below, moment)
        width, height = self._built.size
        share, cosine = mirror.fresnel(camera, self._ground, (width, height))
        points = np.concatenate([np.asarray(v, dtype=np.float64) for v in moment.swept])
        scale = np.array([width / below.width, height / below.height, 1.0])
        projected = below.project(points) * scale
        sigma = spread(
            projected[:, :2],
            projected[:, 2],
            mirror.blur_sigma(camera, self._ground, points) * scale[1],
            (width, height),
        )
        colour, alpha = seen.texture * seen.light, seen.alpha
        covered = np.fliplr(alpha) > 0
        slant = float(cosine[covered].mean()) if covered.any() else 1.0
        flipped = [np.ascontiguousarray(np.fliplr(image)) for image in (colour, alpha, sigma)]
        return mirror.mirrored_layer(flipped[0], flipped[1], flipped[2], share, slant)

    def _from(self, camera: Camera, moment: Moment) -> ObjectLayer:
        """The objects as ``camera`` sees them; Blender's cameras are put back afterwards."""
        scenes = (self._built.colour_scene, self._built.light_scene)
        kept = [scene.camera for scene in scenes]
        added = []
        try:
            for scene, size in zip(scenes, (self._built.drawn_size, self._built.light_size), strict=True):
                added.append(add_camera(scene, camera, size))
            return self._objects(camera, moment)
        finally:
            for scene, item in zip(scenes, kept, strict=True):
                scene.camera = item
            bpy.data.batch_remove([item.data for item in added] + added)


def reflections(scene: Scene, built: BlenderScene, options: RenderOptions, objects: Objects) -> Reflections | None:
    """``Reflections``, or None where the ground of ``scene`` is matte or they are switched off."""
    if not options.reflections or scene.ground is None or scene.ground.reflectivity == 0:
        return None
    return Reflections(scene, built, objects)
