# SPDX-License-Identifier: GPL-3.0-or-later
"""One frame: small renders composited over the photo (docs/rendering.md), with depth, object ids and flow."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import bpy
import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim.atomic import scratch_prefix
from ...sim.cache.pc2 import Pc2Reader
from ...sim.composite import compositing, floor_reflection
from ...sim.composite.backdrop import Backdrop
from ...sim.scene.folder import Scene
from ...sim.scene.model import Camera, SceneModel
from .. import compat
from ..playback.point_caches import OpenedBake
from ..scene_io.photo_view import render_size, with_sun_angle
from . import lighting, motion_blur, photo_particles, render_engines
from .clean_plate import CameraMotion, CleanPlate, PlateView, make_relief
from .image_finish import ImageFinish
from .lighting import GroundShadow, reflections
from .motion_blur import Moment
from .photo_grains import FADING_S, GROWN_S, PhotoGrains, add_torn_skin
from .render_options import RenderOptions
from .render_regions import Box, ground_depth, object_box
from .render_scene import BlenderScene, aim, build, everything, remove

FAR_M = 1e10
"""Depth without object or ground, as in Blender."""
STEPS = ("physgen_step_next", "physgen_step_previous")
"""Vertex vectors, and passes, of the motion to the next frame and to the previous one, in metres."""
NUMBER = "physgen_number"
"""Pass with the object's number for EEVEE, which has no object index pass."""
CENTRE_FILTER_PX = 0.01
"""Width of the pixel filter, Cycles' minimum: rays go through the pixels' centres."""

Vectors = NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class DataLayers:
    """Values at each pixel's centre.

    depth: (H, W) metres along the optical axis to the nearest object or the ground, else ``FAR_M``.
    object_id: (H, W) 0 without object, 1 for the first object of the scene and so on.
    flow: (H, W, 4) pixels, x right and y down, to the position of the same point in the next frame, and in the previous
    one.
    """

    depth: NDArray[np.float32]
    object_id: NDArray[np.float32]
    flow: NDArray[np.float32]


class DataScene:
    """A fourth Blender scene beside those of ``built``, with the objects and camera of the first."""

    def __init__(self, built: BlenderScene) -> None:
        """Created before the objects' materials are copied, so that copies output motion vectors, too."""
        self._followers: list[bpy.types.Mesh] = []
        self.scene = built.colour_scene.copy()
        self.scene.name = "PhysGen data"
        built.own.append(self.scene)
        layer = self.scene.view_layers[0]
        self._traced = built.options.engine == "cycles"
        if self._traced:
            self.scene.cycles.samples = 1
            # A BOX filter has one width only.
            self.scene.cycles.pixel_filter_type, self.scene.cycles.filter_width = "GAUSSIAN", CENTRE_FILTER_PX
            render_engines.set_denoising(self.scene, False)
        else:
            # The colours' own settings sample the middle of each of their subpixels.
            self.scene.render.resolution_x, self.scene.render.resolution_y = built.size
        layer.use_pass_z = layer.use_pass_object_index = True
        for name in (*STEPS, NUMBER):
            layer.aovs.add().name = name
        for number, target in enumerate(built.objects, start=1):
            self.follow(target.item, number)
            for name in STEPS:
                _show_attribute(target.item.data.materials[0], name)
            _show_number(target.item.data.materials[0])

    def follow(self, item: bpy.types.Object, number: int) -> None:
        """Make ``item`` (part of) the object ``number``; its vertices' steps are the next of ``render``'s."""
        item.pass_index = number
        for name in STEPS:
            item.data.attributes.new(name, "FLOAT_VECTOR", "POINT")
        self._followers.append(item.data)

    def render(
        self,
        frame: int,
        box: Box | None,
        folder: Path,
        *,
        scene: SceneModel,
        cameras: tuple[Camera, Camera, Camera],
        steps: Sequence[tuple[Vectors, Vectors]],
    ) -> DataLayers:
        """Return the data layers of ``frame``.

        box: pixels that objects can cover, None for none. folder: for the temporary file. cameras: of this frame, the
        next and the previous one. steps: (V, 3) for each followed mesh, motion of its vertices to the next frame, and
        to the previous one, in world metres. Raises RenderError if Blender fails.
        """
        size = (self.scene.render.resolution_x, self.scene.render.resolution_y)
        depth = ground_depth(dataclasses.replace(scene, camera=cameras[0]), size)
        depth = np.minimum(depth, FAR_M).astype(np.float32)
        object_id = np.zeros_like(depth)
        moved = np.zeros((2, *depth.shape, 3), np.float32)
        if box is not None:
            for mesh, pair in zip(self._followers, steps, strict=True):
                _set_vectors(mesh, pair)
            channels = render_engines.render_passes(self.scene, frame, box, folder)
            number = np.rint(channels[compat.OBJECT_INDEX] if self._traced else channels[f"{NUMBER}.R"])
            seen = number > 0
            # Parts below the ground are visible in the image, so they are included here too.
            depth[box.slices] = np.where(seen, channels["Depth.Z"], depth[box.slices])
            object_id[box.slices] = number
            for index, name in enumerate(STEPS):
                moved[index][box.slices] = np.where(seen[..., None], render_engines.stack(channels, name), 0.0)
        flow = [optical_flow(depth, step, cameras[0], camera) for step, camera in zip(moved, cameras[1:], strict=True)]
        return DataLayers(depth=depth, object_id=object_id, flow=np.concatenate(flow, axis=-1))


def optical_flow(
    depth: NDArray[np.floating], step: NDArray[np.floating], camera: Camera, other: Camera
) -> NDArray[np.float32]:
    """Return pixels (H, W, 2), x right and y down, from each pixel's centre to its point's position in ``other``.

    depth: (H, W) metres along the optical axis of ``camera``. step: (H, W, 3) motion of the point, world metres. The
    flow is 0 where the point comes to lie behind ``other``.
    """
    height, width = depth.shape
    scale = np.array([width / camera.width, height / camera.height])
    y, x = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([x, y], axis=-1)
    points = camera.position + camera.rays(pixels / scale) * depth[..., None] + step
    seen = other.project(points)
    flow = np.where(seen[..., 2:] > 0, seen[..., :2] * scale - pixels, 0.0)
    # Exactly zero without motion, free of round-trip rounding.
    still = (step == 0).all(axis=-1) & (camera == other)
    return np.where(still[..., None], 0.0, flow).astype(np.float32)


def _show_attribute(material: bpy.types.Material, name: str) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    attribute, output = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeOutputAOV")
    attribute.attribute_name, output.aov_name = name, name
    links.new(attribute.outputs["Vector"], output.inputs["Color"])


def _show_number(material: bpy.types.Material) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    info, output = nodes.new("ShaderNodeObjectInfo"), nodes.new("ShaderNodeOutputAOV")
    output.aov_name = NUMBER
    links.new(info.outputs["Object Index"], output.inputs["Color"])


def _set_vectors(mesh: bpy.types.Mesh, pair: tuple[Vectors, Vectors]) -> None:
    for name, values in zip(STEPS, pair, strict=True):
        # Grains are new vertices in each frame.
        attribute = mesh.attributes.get(name) or mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", np.ascontiguousarray(values, dtype=np.float32).ravel())
    mesh.update_tag()


class Renderer:
    """Renders samples of one bake into the photo. Opening it measures the reference lighting; close it after use."""

    def __init__(
        self, scene: Scene, bake: OpenedBake, options: RenderOptions, shot: CameraMotion | None = None
    ) -> None:
        """``shot``: camera motion; None keeps the photo's camera.

        Raises InputError for unusable images, meshes or light, RenderError if Blender fails.
        """
        scene = with_sun_angle(scene, options.sun_angle)
        self._folder, self._scene, self._bake, self._options = scene, scene.model, bake, options
        self._shot = shot
        self._relief: Backdrop | None = None
        self._built: BlenderScene | None = None
        self._data_scene: DataScene | None = None
        self._grains: list[PhotoGrains] = []
        self._steps: list[Pc2Reader | PhotoGrains] = []
        self._soft_px: float | None = None
        self._temporary = tempfile.TemporaryDirectory(prefix=scratch_prefix("render"))
        self._scratch = Path(self._temporary.name)
        self._size = render_size(self._scene.camera, options.scale)
        try:
            self._still = motion_blur.still_distance(self._scene.camera, motion_blur.pose(bake, 0), options.scale)
            rest = self._moment(0)
            self._plate = CleanPlate(scene, self._size, rest.now)
            self._look = ImageFinish(self._scene, self._plate, rest.now, options)
            self._built = build(scene, bake, options)
            lighting.measure_reference_light(self._built, self._scratch)
            if options.frame_format.layered:
                self._data_scene = DataScene(self._built)
            self._reach = self._add_particles(self._built)
            self._plate.show_behind(self._objects(self._scene.camera, rest))
            self._shadows = GroundShadow(self._scene, self._built, options, self._scratch)
            bare = self._shadows.ratio(rest, self._scene.camera, self._size)
            self._shade = self._plate.shadow_exponents(bare)
            self._shows_shadow = self._plate.shows_shadow(bare)
            self._rest_shadow = self._tinted(bare)
            self._reflections = reflections(self._scene, self._built, options, self._objects)
            self._rest_reflection = (
                None if self._reflections is None else self._reflections.layer(self._scene.camera, rest)
            )
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the Blender scenes and temporary files."""
        if self._built is not None:
            remove(self._built)
            self._built = None
        self._temporary.cleanup()

    def frame(self, sample: int, camera: Camera | None = None) -> compositing.FrameLayers:
        """Return ``sample`` of the bake as an image (linear light), with its layers.

        camera: of this frame, one of the camera motion's; None is the photo's own.
        """
        assert self._built is not None
        view, moment = self._view(camera), self._moment(sample)
        aim(self._built, view.camera)
        for grains in self._grains:
            grains.show(sample, max(sample - 1, 0) if moment.shutter > 0 else sample, view.camera.position)
        seen = self._plate.seen(view, moment.now)
        rest_shadow = view.warp(self._rest_shadow)
        shadow = rest_shadow
        if sample > 0:
            shadow = self._tinted(self._shadows.ratio(moment, view.camera, self._size))
        if not self._shows_shadow:
            shadow, rest_shadow = compositing.appearing(shadow, seen.contacts), np.ones_like(shadow)
        ground = compositing.ground_layer(
            photo=seen.photo,
            background=seen.background,
            shadow=shadow,
            rest_shadow=rest_shadow,
            at_rest=seen.at_rest,
            masks=seen.masks,
        )
        if self._reflections is not None:
            # The photo's own mirror images are part of its ground, so they move with it.
            rest = self._rest_reflection
            assert rest is not None
            rest = replace(rest, **{item.name: view.warp(getattr(rest, item.name)) for item in fields(rest)})
            now = rest if sample == 0 else self._reflections.layer(view.camera, moment)
            ground = floor_reflection.with_reflection(ground, now, rest, seen.at_rest)
        objects = self._look.objects(self._objects(view.camera, moment), view.camera, moment.now)
        beauty = self._look.finish(compositing.compose(objects, ground), objects, view.camera, moment.now, seen.at_rest)
        return compositing.FrameLayers(ground=ground, shadow=shadow, objects=objects, beauty=beauty)

    def _tinted(self, ratio: NDArray[np.float32]) -> NDArray[np.float32]:
        light = self._scene.light
        strength = light.sun_strength if light.sun_direction is not None else 0.0
        return compositing.tinted_shadow(ratio, self._shade, 1.0 / (1.0 + strength))

    def _view(self, camera: Camera | None) -> PlateView:
        """Return the view of ``camera``, one of the camera motion's; background geometry is built at the first move."""
        still = self._scene.camera
        if camera is None or camera == still or self._shot is None:
            return PlateView(still, self._size)
        if self._relief is None:
            self._relief = make_relief(self._shot, self._folder, self._plate, self._size)
        return PlateView(camera, self._size, self._relief)

    def _add_particles(self, built: BlenderScene) -> float:
        """Add what granular and fluid objects show when their skin tears; return the maximum visible distance around
        particles' centres, m.
        """
        before, reach = everything(), 0.0
        carried = STEPS if self._data_scene is not None else ()
        objects = zip(built.objects, self._bake.flows, self._bake.caches, strict=True)
        first = self._bake.first_frame
        for number, (target, flow, cache) in enumerate(objects, start=1):
            if flow is None or flow.from_sample is None:
                continue
            if flow.surface:
                item, far = photo_particles.add_surface(target, flow, first, carried=carried)
                self._steps.append(flow.cache)
            else:
                shown = PhotoGrains(
                    target,
                    flow,
                    first,
                    camera=self._scene.camera,
                    scale=self._options.scale,
                    ground=self._scene.ground_plane,
                    growing=GROWN_S * self._bake.manifest.fps,
                )
                self._grains.append(shown)
                self._steps.append(shown)
                item, far = shown.item, shown.reach
            coherent = target.source.material.law == "snow"
            begins, ends = (0.0, 0.0) if flow.surface else tuple(each * self._bake.manifest.fps for each in FADING_S)
            gone, torn = flow.surface or not coherent, first + flow.from_sample
            photo_particles.open_skin(target, cache, torn, gone=gone, fading=(begins, ends))
            reach = max(reach, far)
            if self._data_scene is not None:
                self._data_scene.follow(item, number)
        for number, (target, tear) in enumerate(zip(built.objects, self._bake.tears, strict=False), start=1):
            if tear is None or any(flow is not None for flow in self._bake.flows[number - 1 : number]):
                continue
            item = add_torn_skin(target, tear, first)
            self._steps.append(tear.cache)
            if self._data_scene is not None:
                self._data_scene.follow(item, number)
        built.own += list(everything() - before)
        return reach

    def data(
        self, sample: int, *, after: int, before: int, cameras: tuple[Camera, Camera, Camera] | None = None
    ) -> DataLayers:
        """Return depth, object ids and flow of ``sample``, which ``after`` follows and ``before`` precedes.

        cameras: of this frame, the next and the previous one; None is the photo's own. Only available if the options
        request layered frames.
        """
        assert self._data_scene is not None
        assert self._built is not None
        cameras = cameras or (self._scene.camera,) * 3
        steps: list[tuple[Vectors, Vectors]] = []
        for shown in (*self._bake.caches, *self._steps):
            if isinstance(shown, PhotoGrains):
                shown.show(sample, sample, cameras[0].position)
                shown.let_see(grains=True, hull=False)
                steps.append(shown.steps(after, before))
            else:
                now = shown.sample(sample)
                steps.append((shown.sample(after) - now, shown.sample(before) - now))
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
        before, now = (motion_blur.pose(self._bake, index) for index in (max(sample - 1, 0), sample))
        return motion_blur.moment(
            self._bake.first_frame + sample,
            before,
            now,
            shutter=self._options.motion_blur,
            still=self._still,
            camera=self._scene.camera,
            scale=self._options.scale,
        )

    def _objects(self, camera: Camera, moment: Moment) -> compositing.ObjectLayer:
        """Return the objects as seen by the camera that is set in Blender's scenes."""
        assert self._built is not None
        layer = compositing.empty_layer(*self._size)
        box, light_box = (self._object_box(camera, moment, size) for size in (self._size, self._built.light_size))
        if box is None or light_box is None:
            return layer
        for each in self._grains:
            each.let_see(grains=True, hull=False)
        self._open_shutter(self._built.colour_scene, moment, most_samples=2)
        lack, gloss = np.zeros((2, *layer.alpha.shape), np.float32)
        layer.texture[box.slices], layer.alpha[box.slices], second = self._built.colours(
            moment.number, box, self._scratch
        )
        lack[box.slices], gloss[box.slices] = np.moveaxis(second, -1, 0)
        if self._soft_px is None:
            # The first call is of the rest pose by the photo's camera.
            self._soft_px = compositing.soft_reach(layer.alpha, lack)
        layer = compositing.matted(layer, lack, self._soft_px)
        for each in self._grains:
            each.let_see(grains=False, hull=True)
        self._open_shutter(self._built.light_scene, moment, most_samples=1)
        lit = render_engines.render_passes(self._built.light_scene, moment.number, light_box, self._scratch)
        light = np.ones((*self._built.light_size[::-1], 3), np.float32)
        ratio = compositing.light_ratio(render_engines.stack(lit, "Combined"), lit["Combined.A"])
        if any(grains.visible for grains in self._grains):
            ratio = compositing.continued_light(ratio, lit["Combined.A"])
        light[light_box.slices] = ratio
        layer.light[:] = cv2.resize(light, self._size, interpolation=cv2.INTER_LINEAR)
        return compositing.with_highlights(layer, gloss)

    def _object_box(self, camera: Camera, moment: Moment, size: tuple[int, int]) -> Box | None:
        if not self._options.crop:
            return Box(0, 0, *size)
        return object_box(camera, moment.swept, size, self._reach)

    def _open_shutter(self, scene: bpy.types.Scene, moment: Moment, *, most_samples: int) -> None:
        """Set the motion blur of ``scene``; with up to ``most_samples`` times the samples if it is long."""
        render_engines.open_shutter(scene, moment.shutter, moment.samples(self._options.samples, at_most=most_samples))
