# SPDX-License-Identifier: GPL-3.0-or-later
"""Image finish of rendered objects: the photo's sharpness, depth of field and grain. Needs no bpy.

All of it grows with the distance that objects have moved on the image and is exactly zero at rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...sim.composite import blur, film_grain
from ...sim.composite.compositing import ObjectLayer, rolled_off
from ...sim.composite.pull_push import spread_values
from ...sim.scene.equirectangular import LUMINANCE
from ...sim.scene.model import Camera, SceneModel
from ...sim.smoothstep import smoothstep
from ...sim.srgb import Linear
from .clean_plate import CleanPlate
from .motion_blur import Vertices
from .render_options import RenderOptions

MOVED_PX = (0.25, 1.5)
"""Movement on the image, in pixels, over which a point fades from the photo's own pixels; also as an outline's rim."""


LEAST_CHANGE = 0.02
"""Share of a pixel from other sources than the photo that is too small for grain: it is never quite 0 far from objects.
"""
BRIGHTEST, UNBOUNDED = 0.99, 1e3
"""Share of an object's pixels that are darker than what its light may come up to; luminance that is no bound."""
GAP = 0.025
"""Distance of an object's vertices on the image over its width, at most."""
REACH_PX = 64
"""Maximum distance around objects that blur can carry their colours."""


class ImageFinish:
    """The photo's grain and sharpness at the frames' size, estimated once."""

    def __init__(self, scene: SceneModel, plate: CleanPlate, rest: Vertices, options: RenderOptions) -> None:
        """``rest``: vertices (V, 3) of each object in the photo, world metres."""
        self._camera, self._plate, self._rest, self._options = scene.camera, plate, list(rest), options
        height, width = plate.photo.shape[:2]
        self._size = (width, height)
        self._grain: film_grain.Grain | None = None
        if options.grain:
            model = film_grain.estimate_noise(plate.photo)
            self._grain = film_grain.Grain(model, self._size, options.seed)
            self._grainy = [film_grain.noise_share(model, plate.photo, mask) for mask in plate.object_masks]
        self._brightest = [_brightest(plate.photo[mask]) for mask in plate.object_masks]
        self._sigmas = _outline_sigmas(plate) if options.match_sharpness else []

    def objects(self, layer: ObjectLayer, camera: Camera, now: Vertices) -> ObjectLayer:
        """Return ``layer`` as the photo's lens would image it, seen by ``camera`` with vertices ``now`` (V, 3)."""
        moved = self._moved(camera, now)
        window = _around(layer.alpha)
        if window is None or not any(weight.any() for weight in moved):
            return layer
        part = ObjectLayer(texture=layer.texture[window], alpha=layer.alpha[window], light=layer.light[window])
        most = self._map(camera, now, [np.full(len(v), b) for v, b in zip(now, self._brightest, strict=True)])[window]
        # Between its vertices those of another object behind it show through.
        wide = max(3, round(GAP * self._size[0])) | 1
        most = np.asarray(cv2.dilate(np.ascontiguousarray(most), np.ones((wide, wide), np.uint8)), dtype=np.float32)
        part = rolled_off(part, np.where(most < UNBOUNDED, most, np.float32(np.inf)))
        if self._sigmas:
            larger = self._map(camera, now, self._magnification(camera, now))[window]
            sigma = self._map(camera, now, [np.full(len(v), s) for v, s in zip(now, self._sigmas, strict=True)])[window]
            part = blur.soften_squares(part, larger)
            part = blur.soften_outlines(part, sigma, self._map(camera, now, moved)[window])
        if self._options.f_number is not None:
            radius = self._map(camera, now, self._added_blur(camera, now, self._options.f_number))[window]
            part = blur.defocused(part, radius * np.float32(self._size[0] / camera.width))
        texture, alpha, light = layer.texture.copy(), layer.alpha.copy(), layer.light.copy()
        texture[window], alpha[window], light[window] = part.texture, part.alpha, part.light
        return ObjectLayer(texture=texture, alpha=alpha, light=light)

    def finish(
        self, beauty: Linear, layer: ObjectLayer, camera: Camera, now: Vertices, at_rest: NDArray[np.float32]
    ) -> Linear:
        """Return ``beauty`` (H, W, 3) with the photo's grain where it lacks it; ``at_rest`` (H, W) is the plate's
        weight.
        """
        if self._grain is None:
            return beauty
        moved = self._moved(camera, now)
        if not any(weight.any() for weight in moved) and bool((at_rest == 1.0).all()):
            return beauty
        # Where an object stood, the ground comes from the inpainted background as soon as it has moved at all.
        left = np.where(self._plate.masks, self._map(self._camera, self._rest, moved), 1.0 - at_rest)
        if camera != self._camera:
            left = np.ones_like(left)
        grainy = [weight * share for weight, share in zip(moved, self._grainy, strict=True)]
        changed = layer.alpha * self._map(camera, now, grainy) + (1.0 - layer.alpha) * left
        changed = (changed - LEAST_CHANGE) / (1.0 - LEAST_CHANGE)
        return self._grain.add(beauty, np.clip(changed, 0.0, 1.0).astype(np.float32))

    def _moved(self, camera: Camera, now: Vertices) -> list[NDArray[np.float32]]:
        """Return 0 (at rest) to 1 (moved) per vertex (V,) of each object, by its distance on the image from the
        photo.
        """
        weights = []
        for rest, positions in zip(self._rest, now, strict=True):
            distance = np.linalg.norm(self._pixels(camera, positions) - self._pixels(self._camera, rest), axis=1)
            start, end = MOVED_PX
            moved = smoothstep(np.nan_to_num(distance, nan=end, posinf=end), start, end)
            weights.append(moved.astype(np.float32))
        return weights

    def _magnification(self, camera: Camera, now: Vertices) -> list[NDArray[np.float64]]:
        """Return the magnification of each vertex (V,) relative to rest, by which the photo's pixels are enlarged."""
        scale = camera.fx / self._camera.fx
        return [
            np.maximum(scale * self._camera.project(rest)[:, 2] / np.maximum(camera.project(v)[:, 2], 1e-6), 1.0)
            for rest, v in zip(self._rest, now, strict=True)
        ]

    def _added_blur(self, camera: Camera, now: Vertices, f_number: float) -> list[NDArray[np.float64]]:
        """Return the radius in pixels of the photo by which each vertex (V,) is blurred more than at rest."""
        blurs = []
        for rest, positions in zip(self._rest, now, strict=True):
            before, depth = self._camera.project(rest)[:, 2], camera.project(positions)[:, 2]
            focus = before if self._options.focus_distance is None else self._options.focus_distance
            then = blur.blur_radius(self._camera, before, focus, f_number)
            blurs.append(blur.added_radius(blur.blur_radius(camera, depth, focus, f_number), then))
        return blurs

    def _map(self, camera: Camera, vertices: Vertices, values: Sequence[NDArray[np.floating]]) -> NDArray[np.float32]:
        """Return per-vertex ``values`` (V,) of each object interpolated over the image (H, W)."""
        points = np.concatenate(list(vertices))
        return spread_values(
            self._pixels(camera, points), camera.project(points)[:, 2], np.concatenate(values), self._size
        )

    def _pixels(self, camera: Camera, positions: NDArray[np.floating]) -> NDArray[np.float64]:
        scale = np.array([self._size[0] / camera.width, self._size[1] / camera.height])
        return np.asarray(camera.project(positions)[:, :2] * scale)


def _brightest(colours: Linear) -> float:
    """Return the luminance of nearly the brightest of the photo's ``colours`` (N, 3) of an object; ``UNBOUNDED`` for
    one that the photo does not show."""
    return float(np.quantile(colours @ LUMINANCE, BRIGHTEST)) if len(colours) else UNBOUNDED


def _outline_sigmas(plate: CleanPlate) -> list[float]:
    """Return the photo's blur along each object's outline, in pixels; without an outline, the mean of all."""
    together = blur.outline_sigma(plate.photo, plate.masks)
    usual = together if together is not None else float(np.sqrt(blur.PIXEL_VARIANCE))
    found = [blur.outline_sigma(plate.photo, mask) for mask in plate.object_masks]
    return [usual if sigma is None else sigma for sigma in found]


def _around(alpha: NDArray[np.float32]) -> tuple[slice, slice] | None:
    """Return the window of ``alpha`` (H, W) that contains all objects and their blur; None without objects."""
    rows, columns = np.nonzero(alpha.any(axis=1))[0], np.nonzero(alpha.any(axis=0))[0]
    if not len(rows):
        return None
    return (
        slice(max(0, rows[0] - REACH_PX), rows[-1] + 1 + REACH_PX),
        slice(max(0, columns[0] - REACH_PX), columns[-1] + 1 + REACH_PX),
    )
