# SPDX-License-Identifier: GPL-3.0-or-later
"""Light in a frame: reference lighting L₀ of the objects at rest, shadows on the ground, and reflections in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import bpy
import cv2
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree
from numpy.typing import NDArray

from ...sim.composite import floor_reflection
from ...sim.composite.compositing import ObjectLayer
from ...sim.composite.pull_push import spread_values
from ...sim.composite.reference_light import SurfaceGraph
from ...sim.errors import RenderError
from ...sim.scene.model import Camera, SceneModel
from ...sim.srgb import Linear
from ..scene_io.photo_view import add_camera, aim_camera
from . import render_engines
from .motion_blur import Moment
from .render_options import RenderOptions
from .render_regions import NEAR_REACH, Box, feather, ground_depth, object_box, shadow_region
from .render_scene import BlenderScene, RenderObject, get_rest_light, set_rest_light
from .scene_light import environment_lamps

RAY_BUDGET = 400_000
"""Rays of one object, divided among its vertices and the lamps."""
MAX_DIRECTIONS = 8
"""Maximum per lamp."""


def surfaces(
    objects: Sequence[RenderObject],
) -> tuple[NDArray[np.float64], NDArray[np.int64], BVHTree]:
    """Return all vertices at rest (V, 3) in world metres, each object's offset among them, and a BVH of all faces."""
    vertices = np.concatenate([target.mesh.vertices for target in objects])
    offsets = np.cumsum([0, *(len(target.mesh.vertices) for target in objects)])
    faces = np.concatenate([t.mesh.faces + o for t, o in zip(objects, offsets[:-1], strict=True)])
    return vertices, offsets, BVHTree.FromPolygons(vertices.tolist(), faces.tolist(), all_triangles=True)


def cast_rays(built: BlenderScene, target: RenderObject) -> NDArray[np.float64]:
    """Return the radiance (V, 3) of a white diffuse surface at the vertices of ``target``, under the light scene's
    lamps.
    """
    tree = surfaces(built.objects)[2]
    lamps = [item for item in built.light_scene.objects if item.type == "LIGHT"]
    points = target.mesh.vertices
    flat = np.empty(3 * len(points), dtype=np.float32)
    target.item.data.vertex_normals.foreach_get("vector", flat)
    normals = flat.reshape(-1, 3).astype(np.float64)
    size = float(np.ptp(points, axis=0).max())
    starts = points + 1e-3 * size * normals
    count = int(np.clip(RAY_BUDGET / max(len(points) * len(lamps), 1), 1, MAX_DIRECTIONS))
    radiance = np.zeros((len(points), 3))
    for lamp in lamps:
        colour = np.array(lamp.data.color[:]) * lamp.data.energy / math.pi
        for direction in _directions(lamp, count):
            cosine = normals @ direction
            towards = Vector(direction.tolist())
            for index in np.nonzero(cosine > 0)[0]:
                if tree.ray_cast(Vector(starts[index].tolist()), towards)[0] is None:
                    radiance[index] += colour * (cosine[index] / count)
    return radiance


def _directions(lamp: bpy.types.Object, count: int) -> NDArray[np.float64]:
    """Return unit vectors (count, 3) to points evenly spread over the disc of ``lamp`` (Vogel's spiral)."""
    turn = np.array(lamp.rotation_euler.to_matrix())
    index = np.arange(count)
    radius = np.sqrt((index + 0.5) / count) if count > 1 else np.zeros(1)
    around = index * math.pi * (3.0 - math.sqrt(5.0))
    radius = radius * math.tan(lamp.data.angle / 2)
    local = np.stack([radius * np.cos(around), radius * np.sin(around), np.ones(count)], axis=1)
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    return np.asarray(local @ turn.T)


AMBIENT = 0.1
"""Ambient term k over the radiance of open white ground. It stands for the interreflections that direct light lacks,
and avoids division by zero in crevices: (L + k) / (L₀ + k) is 1 at rest for every k.
"""

BAKE_BUDGET = 2_000_000
"""Light samples of one object's bake, divided among its corners of faces."""
BAKE_SHARE = 16
"""Largest number of them at a corner, over a frame's samples a pixel: a draft's frames are noisier than its bake."""
SMOOTHING_STEPS = 2
CALIBRATION_ROUNDS = 2
MAX_CORRECTION = 4.0


def measure_reference_light(built: BlenderScene, folder: Path) -> None:
    """Measure the reference lighting L₀ + k of all objects in the rest pose and store it. ``folder`` takes temporary
    files.

    Raises RenderError if Blender fails.
    """
    ambient = AMBIENT * built.open_irradiance / math.pi
    built.light_scene.frame_set(built.first_frame)
    for target in built.objects:
        set_rest_light(target, np.ones_like(target.mesh.vertices), 0.0)
    graphs = [SurfaceGraph(target.mesh.vertices, target.mesh.faces) for target in built.objects]
    for target, graph in zip(built.objects, graphs, strict=True):
        baked = cast_rays(built, target) if built.options.engine == "eevee" else _bake(built, target)
        baked = graph.smoothed(baked, SMOOTHING_STEPS)
        set_rest_light(target, np.clip(baked, 0.0, None) + ambient, ambient)
    seen = _visible(built)
    for _ in range(CALIBRATION_ROUNDS):
        _calibrate(built, seen, ambient, folder)
    for target, graph, visible in zip(built.objects, graphs, seen, strict=True):
        if not _in_photo(built, target):
            # Its texture has its own colours, without a photo's light: they are what open white ground would make them.
            set_rest_light(target, np.full_like(target.mesh.vertices, ambient / AMBIENT + ambient), ambient)
            continue
        # The texture of what the photo hides has the colours of what it shows, and of its light what its shading says.
        even = graph.continued(get_rest_light(target) / target.shading, visible)
        set_rest_light(target, np.maximum(even * target.shading, ambient), ambient)


def _in_photo(built: BlenderScene, target: RenderObject) -> bool:
    """Return whether the photo's frame holds any vertex of ``target`` at rest, or it has a mask in it."""
    camera = built.folder.model.camera
    x, y, depth = camera.project(target.mesh.vertices).T
    inside = (x > 0) & (x < camera.width) & (y > 0) & (y < camera.height) & (depth > 0)
    return target.source.mask is not None or bool(inside.any())


def _bake(built: BlenderScene, target: RenderObject) -> NDArray[np.float64]:
    """Return the radiance (V, 3) of a white diffuse surface at the vertices."""
    scene, item = built.light_scene, target.item
    layer = scene.view_layers[0]
    for other in built.objects:
        other.item.select_set(other is target, view_layer=layer)
    layer.objects.active = item
    most = min(BAKE_SHARE * built.options.samples, 256)
    scene.cycles.samples = int(np.clip(BAKE_BUDGET / max(len(item.data.loops), 1), 4, most))
    render_engines.set_denoising(scene, False)
    context = {"scene": scene, "view_layer": layer, "active_object": item, "object": item, "selected_objects": [item]}
    try:
        with bpy.context.temp_override(**context):
            bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, target="VERTEX_COLORS")
    except RuntimeError as error:
        raise RenderError(f"object {target.source.name!r}: its light at rest could not be baked: {error}") from error
    finally:
        scene.cycles.samples = built.options.samples
        render_engines.set_denoising(scene, built.options.denoise)
    values = get_rest_light(target)
    if not np.isfinite(values).all():
        raise RenderError(f"object {target.source.name!r}: its light at rest is not finite")
    return values


def _visible(built: BlenderScene) -> list[NDArray[np.bool_]]:
    """Return which vertices of each object the camera sees at rest."""
    vertices, offsets, tree = surfaces(built.objects)
    eye = built.folder.model.camera.position
    origin = Vector(eye.tolist())
    towards = vertices - eye
    distance = np.linalg.norm(towards, axis=1)
    tolerance = 2e-3 * float(np.ptp(vertices, axis=0).max())
    seen = np.zeros(len(vertices), dtype=bool)
    for index, (direction, far) in enumerate(zip((towards / distance[:, None]).tolist(), distance, strict=True)):
        hit = tree.ray_cast(origin, Vector(direction), far - tolerance)
        seen[index] = hit[0] is None
    return np.split(seen, offsets[1:-1].tolist())


def _calibrate(built: BlenderScene, seen: list[NDArray[np.bool_]], ambient: float, folder: Path) -> None:
    """Multiply L₀ + k, where visible, by the rest frame's deviation from 1."""
    camera = built.folder.model.camera
    box = object_box(camera, [target.mesh.vertices for target in built.objects], built.light_size)
    if box is None:
        return
    channels = render_engines.render_passes(built.light_scene, built.first_frame, box, folder)
    light, alpha = render_engines.stack(channels, "Combined"), channels["Combined.A"]
    width, height = built.light_size
    for target, visible in zip(built.objects, seen, strict=True):
        pixels = camera.project(target.mesh.vertices[visible])
        x = (pixels[:, 0] * width / camera.width - 0.5 - box.x0).astype(np.float32)
        y = (pixels[:, 1] * height / camera.height - 0.5 - box.y0).astype(np.float32)
        at = [np.atleast_2d(_sample(image, x, y)) for image in (light, alpha)]
        coverage = at[1].reshape(-1, 1)
        ratio = np.where(coverage > 0.5, at[0].reshape(-1, 3) / np.maximum(coverage, 0.5), 1.0)
        values = get_rest_light(target)
        values[visible] *= np.clip(ratio, 1 / MAX_CORRECTION, MAX_CORRECTION)
        set_rest_light(target, np.maximum(values, ambient), ambient)


def _sample(image: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return ``image`` at pixel coordinates (N,), bilinear. OpenCV allows at most 32767 of them a row."""
    count = len(x)
    columns = 1024
    padded = -(-max(count, 1) // columns) * columns
    grid = [np.pad(v, (0, padded - count)).reshape(-1, columns) for v in (x, y)]
    sampled = cv2.remap(image, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, dtype=np.float32).reshape(padded, -1)[:count]


COARSE = 4
"""Side of a pixel of the sky's far shadow, in pixels of the light resolution."""

LEAST_COARSE_PX = 64
"""Minimum size of the coarse part on its longer side, however small the frame is."""

Size = tuple[int, int]


class GroundShadow:
    """Renders the shadows of one Blender scene."""

    def __init__(self, scene: SceneModel, built: BlenderScene, options: RenderOptions, scratch: Path) -> None:
        """``scratch`` takes temporary files."""
        self._scene, self._built, self._options, self._scratch = scene, built, options, scratch
        self._fine = built.light_size
        width, height = self._fine
        scale = min(1.0, max(1.0 / COARSE, LEAST_COARSE_PX / max(width, height)))
        self._coarse = max(1, round(width * scale)), max(1, round(height * scale))
        self._empty: dict[Size, Linear] = {}
        # Their shadows are as crisp as the sun's, so they are rendered as finely.
        self._lamps = environment_lamps(built.folder)

    def ratio(self, moment: Moment, camera: Camera, size: Size) -> Linear:
        """Return the shadow ratio seen by ``camera`` at ``moment``, (H, W, 3) of ``size``; 1 out of reach of all
        objects.
        """
        scene = replace(self._scene, camera=camera)
        if not self._options.crop:
            ratio = self._of(scene, moment, self._fine, Box(0, 0, *self._fine), np.ones((*self._fine[::-1], 3)))
            return _enlarged(ratio, size)
        far = shadow_region(scene, moment.swept, self._coarse, lamps=self._lamps)
        ratio = np.ones((*self._coarse[::-1], 3), np.float32)
        if far is not None:
            ratio = self._of(scene, moment, self._coarse, far.box, ratio)
        ratio = _enlarged(ratio, self._fine)
        near = shadow_region(scene, moment.swept, self._fine, sky_reach=NEAR_REACH, lamps=self._lamps)
        if near is not None:
            ratio = self._of(scene, moment, self._fine, near.box, ratio)
        return _enlarged(ratio, size)

    def _of(self, scene: SceneModel, moment: Moment, size: Size, box: Box, around: NDArray[np.floating]) -> Linear:
        """Return the ratio (h, w, 3) in ``box`` of an image of ``size``, and ``around`` (h, w, 3) it."""
        with self._at(scene.camera, size):
            samples = moment.samples(self._options.samples, at_most=1)
            render_engines.open_shutter(self._built.shadow_scene, moment.shutter, samples)
            lit = self._built.ground_light(moment.number, box, self._scratch)
            empty = self._without_objects(scene.camera, size, box)
        # Objects only remove light from the ground here; a ratio above 1 is noise.
        quotient = np.clip(lit / np.maximum(empty, 1e-6), 0.0, 1.0)
        weight = feather(box, size)
        region = shadow_region(scene, moment.swept, size, lamps=self._lamps)
        if region is not None:
            # Towards the horizon pixels cover ever more ground, and above it none at all.
            depth = ground_depth(scene, size)[box.slices]
            weight = weight * np.clip(3.0 - 2.0 * depth / region.far, 0.0, 1.0)
        ratio = np.asarray(around, np.float32).copy()
        ratio[box.slices] += (quotient - ratio[box.slices]) * weight[..., None]
        return ratio

    def _without_objects(self, camera: Camera, size: Size, box: Box) -> Linear:
        """Return the light on the empty ground (h, w, 3) in ``box``; cached for the photo's own camera."""
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
        """Set the scene's resolution to ``size`` within the context."""
        scene = self._built.shadow_scene
        scene.render.resolution_x, scene.render.resolution_y = size
        aim_camera(scene, camera)
        try:
            yield
        finally:
            scene.render.resolution_x, scene.render.resolution_y = self._fine
            aim_camera(scene, camera)


def _enlarged(ratio: Linear, size: Size) -> Linear:
    """Return ``ratio`` (h, w, 3) at ``size`` (width, height)."""
    return np.asarray(cv2.resize(ratio, size, interpolation=cv2.INTER_LINEAR))


Objects = Callable[[Camera, Moment], ObjectLayer]
"""Renders the objects of a moment as seen by the camera that is set in Blender's scenes."""


class Reflections:
    """Mirror images of the objects in one scene's ground."""

    def __init__(self, scene: SceneModel, built: BlenderScene, objects: Objects) -> None:
        """``objects`` renders with the cameras of ``built``."""
        assert scene.ground is not None
        self._ground, self._built, self._objects = scene.ground, built, objects

    def layer(self, camera: Camera, moment: Moment) -> floor_reflection.Mirrored:
        """Return the reflection of the objects at ``moment`` seen by ``camera``."""
        below = floor_reflection.mirrored_camera(camera, self._ground)
        seen = self._from(below, moment)
        width, height = self._built.size
        share, cosine = floor_reflection.fresnel(camera, self._ground, (width, height))
        points = np.concatenate([np.asarray(v, dtype=np.float64) for v in moment.swept])
        scale = np.array([width / below.width, height / below.height, 1.0])
        projected = below.project(points) * scale
        sigma = spread_values(
            projected[:, :2],
            projected[:, 2],
            floor_reflection.blur_sigma(camera, self._ground, points) * scale[1],
            (width, height),
        )
        colour, alpha = seen.texture * seen.light, seen.alpha
        covered = np.fliplr(alpha) > 0
        slant = float(cosine[covered].mean()) if covered.any() else 1.0
        flipped = [np.ascontiguousarray(np.fliplr(image)) for image in (colour, alpha, sigma)]
        return floor_reflection.mirrored_layer(flipped[0], flipped[1], flipped[2], share, slant)

    def _from(self, camera: Camera, moment: Moment) -> ObjectLayer:
        """Return the objects as seen by ``camera``; Blender's cameras are restored afterwards."""
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


def reflections(scene: SceneModel, built: BlenderScene, options: RenderOptions, objects: Objects) -> Reflections | None:
    """Return ``Reflections``, or None if the ground of ``scene`` is matte or they are disabled."""
    if not options.reflections or scene.ground is None or scene.ground.reflectivity == 0:
        return None
    return Reflections(scene, built, objects)
