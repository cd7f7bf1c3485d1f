# SPDX-License-Identifier: GPL-3.0-or-later
"""L₀: the light that each surface point has at rest, which the photo's colours already contain.

Measured twice. A bake at the vertices covers all sides; for EEVEE, whose lights are lamps alone and which need not have
Cycles beside it, rays towards the lamps do the same. Then the rest frame is rendered once, and where the camera
sees a vertex its value is multiplied by what the frame shows instead of 1: the same renderer, sampling, denoiser and
interpolation then cancel, and rest is rest to a fraction of a percent.
"""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import cv2
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray
from scipy import sparse

from ...sim.errors import RenderError
from . import cycles, passes
from .objects import RenderObject, get_rest_light, set_rest_light
from .ray_light import cast, surfaces
from .regions import object_box
from .scene import BlenderScene

AMBIENT = 0.1
"""The ambient term k over the radiance of open white ground. It stands for the light between surfaces that direct
light alone lacks, and keeps crevices from being divided by nothing: (L + k) / (L₀ + k) is 1 at rest for every k."""

BAKE_BUDGET = 2_000_000
"""Light samples of one object's bake, shared by its vertices."""
SMOOTHING_STEPS = 2
CALIBRATION_ROUNDS = 2
MAX_CORRECTION = 4.0


def measure(built: BlenderScene, folder: Path) -> None:
    """Measure L₀ + k of all objects in the rest pose and set it. ``folder`` takes temporary files.

    Raises RenderError when Blender fails.
    """
    ambient = AMBIENT * built.open_irradiance / math.pi
    built.light_scene.frame_set(built.first_frame)
    for target in built.objects:
        set_rest_light(target, np.ones_like(target.mesh.vertices), 0.0)
    for target in built.objects:
        baked = cast(built, target) if built.options.engine == "eevee" else _bake(built, target)
        baked = _smoothed(baked, target)
        set_rest_light(target, np.clip(baked, 0.0, None) + ambient, ambient)
    seen = _visible(built)
    for _ in range(CALIBRATION_ROUNDS):
        _calibrate(built, seen, ambient, folder)


def _bake(built: BlenderScene, target: RenderObject) -> NDArray[np.float64]:
    """Radiance (V, 3) of a white diffuse surface at the vertices."""
    scene, item = built.light_scene, target.item
    layer = scene.view_layers[0]
    for other in built.objects:
        other.item.select_set(other is target, view_layer=layer)
    layer.objects.active = item
    scene.cycles.samples = int(np.clip(BAKE_BUDGET / max(len(item.data.loops), 1), 4, 256))
    cycles.set_denoising(scene, False)
    context = {"scene": scene, "view_layer": layer, "active_object": item, "object": item, "selected_objects": [item]}
    try:
        with bpy.context.temp_override(**context):
            bpy.ops.object.bake(type="DIFFUSE", pass_filter={"DIRECT"}, target="VERTEX_COLORS")
    except RuntimeError as error:
        raise RenderError(f"object {target.source.name!r}: its light at rest could not be baked: {error}") from error
    finally:
        scene.cycles.samples = built.options.samples
        cycles.set_denoising(scene, built.options.denoise)
    values = get_rest_light(target)
    if not np.isfinite(values).all():
        raise RenderError(f"object {target.source.name!r}: its light at rest is not finite")
    return values


def _smoothed(values: NDArray[np.float64], target: RenderObject) -> NDArray[np.float64]:
    """``values`` (V, 3) averaged with the neighbours along the surface, against the bake's noise."""
    faces = target.mesh.faces
    count = len(values)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count)).tocsr()
    graph = ((edges + edges.T) > 0).astype(np.float64) + sparse.identity(count)
    share = 1.0 / np.asarray(graph.sum(axis=1))
    for _ in range(SMOOTHING_STEPS):
        values = (graph @ values) * share
    return np.asarray(values)


def _visible(built: BlenderScene) -> list[NDArray[np.bool_]]:
    """Which vertices of each object the camera sees at rest."""
    vertices, offsets, tree = surfaces(built.objects)
    eye = built.folder.scene.camera.position
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
    """Multiply L₀ + k where the camera sees it by what the rest frame shows instead of 1."""
    camera = built.folder.scene.camera
    box = object_box(camera, [target.mesh.vertices for target in built.objects], built.light_size)
    if box is None:
        return
    channels = passes.render(built.light_scene, built.first_frame, box, folder)
    light, alpha = passes.stack(channels, "Combined"), channels["Combined.A"]
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
    """``image`` at pixel indices (N,), bilinear. OpenCV allows at most 32767 of them a row."""
    count = len(x)
    columns = 1024
    padded = -(-max(count, 1) // columns) * columns
    grid = [np.pad(v, (0, padded - count)).reshape(-1, columns) for v in (x, y)]
    sampled = cv2.remap(image, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled).reshape(padded, -1)[:count]
