# SPDX-License-Identifier: GPL-3.0-or-later
"""One frame: three small renders and the photo become a picture (docs/rendering.md)."""

from __future__ import annotations

import tempfile
from dataclasses import fields, replace
from pathlib import Path

import bpy
import cv2
import numpy as np

from ...sim.composite import layers, mirror
from ...sim.composite.relief import Relief
from ...sim.scene.folder import SceneFolder
from ...sim.scene.model import Camera
from . import passes, photo_particles, rest_light, stroke
from .caches import Bake
from .camera import render_size
from .data_passes import STEPS, DataLayers, DataScene
from .ground_shadow import GroundShadow
from .look import Look
from .options import RenderOptions
from .plate import Plate
from .reflection import reflections
from .regions import Box, object_box
from .scene import BlenderScene, aim, build, everything, remove
from .shot import Shot, make_relief
from .stroke import Moment
from .sun import with_sun_angle
from .view import View


class Renderer:
    """Renders samples of one bake into the photo. Opening it measures the light at rest; close it after use."""

    def __init__(self, scene: SceneFolder, bake: Bake, options: RenderOptions, shot: Shot | None = None) -> None:
        """``shot``: what the camera does; None leaves it where the photo was taken.

        Raises InputError for images, meshes or light that cannot be used, RenderError when Blender fails.
        """
        scene = with_sun_angle(scene, options.sun_angle)
        self._folder, self._scene, self._bake, self._options = scene, scene.scene, bake, options
        self._shot = shot
        self._relief: Relief | None = None
        self._built: BlenderScene | None = None
        self._data_scene: DataScene | None = None
        self._temporary = tempfile.TemporaryDirectory(prefix="physgen-render-")
        self._scratch = Path(self._temporary.name)
        self._size = render_size(self._scene.camera, options.scale)
        try:
            self._still = stroke.still_distance(self._scene.camera, stroke.pose(bake, 0), options.scale)
            rest = self._moment(0)
            self._plate = Plate(scene, self._size, rest.now)
            self._look = Look(self._scene, self._plate, rest.now, options)
            self._built = build(scene, bake, options)
            rest_light.measure(self._built, self._scratch)
            if options.frame_format.layered:
                self._data_scene = DataScene(self._built)
            self._reach = self._add_particles(self._built)
            self._shadows = GroundShadow(self._scene, self._built, options, self._scratch)
            self._rest_shadow = self._shadows.ratio(rest, self._scene.camera, self._size)
            self._reflections = reflections(self._scene, self._built, options, self._objects)
            self._rest_reflection = self._reflections and self._reflections.layer(self._scene.camera, rest)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the Blender scenes and temporary files."""
        if self._built is not None:
            remove(self._built)
            self._built = None
        self._temporary.cleanup()

    def frame(self, sample: int, camera: Camera | None = None) -> layers.FrameLayers:
        """``sample`` of the bake as a picture (linear light), with what it was made of.

        camera: of this frame, one of the shot's; None is the photo's own.
        """
        assert self._built is not None
        view, moment = self._view(camera), self._moment(sample)
        aim(self._built, view.camera)
        seen = self._plate.seen(view, moment.now)
        rest_shadow = view.warp(self._rest_shadow)
        shadow = rest_shadow if sample == 0 else self._shadows.ratio(moment, view.camera, self._size)
        ground = layers.ground_layer(
            photo=seen.photo,
            background=seen.background,
            shadow=shadow,
            rest_shadow=rest_shadow,
            at_rest=seen.at_rest,
            masks=seen.masks,
        )
        if self._reflections is not None:
            # The photo's own mirror images are part of its ground, so they are moved with it.
            rest = self._rest_reflection
            rest = replace(rest, **{item.name: view.warp(getattr(rest, item.name)) for item in fields(rest)})
            now = rest if sample == 0 else self._reflections.layer(view.camera, moment)
            ground = mirror.with_reflection(ground, now, rest, seen.at_rest)
        objects = self._look.objects(self._objects(view.camera, moment), view.camera, moment.now)
        beauty = self._look.finish(layers.compose(objects, ground), objects, view.camera, moment.now, seen.at_rest)
        return layers.FrameLayers(ground=ground, shadow=shadow, objects=objects, beauty=beauty)

    def _view(self, camera: Camera | None) -> View:
        """What ``camera``, one of the shot's, sees; the background becomes geometry when it first moves."""
        still = self._scene.camera
        if camera is None or camera == still or self._shot is None:
            return View(still, self._size)
        if self._relief is None:
            self._relief = make_relief(self._shot, self._folder, self._plate, self._size)
        return View(camera, self._size, self._relief)

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

    def data(
        self, sample: int, *, after: int, before: int, cameras: tuple[Camera, Camera, Camera] | None = None
    ) -> DataLayers:
        """Depth, object ids and flow of ``sample``, which ``after`` follows and ``before`` precedes.

        cameras: of this frame, the next and the one before; None is the photo's own.
        Only of a renderer whose options ask for layered frames.
        """
        assert self._data_scene is not None
        shown = [flow.cache for flow in self._bake.flows if flow is not None and flow.from_sample is not None]
        steps = []
        for cache in (*self._bake.caches, *shown):
            now = cache.sample(sample)
            steps.append((cache.sample(after) - now, cache.sample(before) - now))
        assert self._built is not None
        cameras = cameras or (self._scene.camera,) * 3
        aim(self._built, cameras[0])
        return self._data_scene.render(
            self._bake.first_frame + sample,
            self._object_box(cameras[0], self._moment(sample), self._size),
            self._scratch,
            scene=self._scene,
            cameras=cameras,
            steps=steps,
        )

    def _moment(self, sample: int) -> Moment:
        before, now = (stroke.pose(self._bake, index) for index in (max(sample - 1, 0), sample))
        return stroke.moment(
            self._bake.first_frame + sample,
            before,
            now,
            shutter=self._options.motion_blur,
            still=self._still,
            camera=self._scene.camera,
            scale=self._options.scale,
        )

    def _objects(self, camera: Camera, moment: Moment) -> layers.ObjectLayer:
        """The objects as ``camera`` sees them, which Blender's scenes have."""
        assert self._built is not None
        layer = layers.empty_layer(*self._size)
        box, light_box = (self._object_box(camera, moment, size) for size in (self._size, self._built.light_size))
        if box is None or light_box is None:
            return layer
        self._open_shutter(self._built.colour_scene, moment, most_samples=2)
        layer.texture[box.slices], layer.alpha[box.slices] = self._built.colours(moment.number, box, self._scratch)
        self._open_shutter(self._built.light_scene, moment, most_samples=1)
        lit = passes.render(self._built.light_scene, moment.number, light_box, self._scratch)
        light = np.ones((*self._built.light_size[::-1], 3), np.float32)
        light[light_box.slices] = layers.light_ratio(passes.stack(lit, "Combined"), lit["Combined.A"])
        layer.light[:] = cv2.resize(light, self._size, interpolation=cv2.INTER_LINEAR)
        return layer

    def _object_box(self, camera: Camera, moment: Moment, size: tuple[int, int]) -> Box | None:
        if not self._options.crop:
            return Box(0, 0, *size)
        return object_box(camera, moment.swept, size, self._reach)

    def _open_shutter(self, scene: bpy.types.Scene, moment: Moment, *, most_samples: int) -> None:
        """Let ``scene`` show the stroke; with up to ``most_samples`` times the samples if it is long."""
        passes.open_shutter(scene, moment.shutter, moment.samples(self._options.samples, at_most=most_samples))
