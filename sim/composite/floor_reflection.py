# SPDX-License-Identifier: MIT
"""Reflections in a glossy floor: mirrored camera, Fresnel reflectance, roughness blur, compositing.

A plane mirrors what a camera below it would see, flipped left to right. Objects, colours and lighting are those of the
frame itself, so nothing else has to be known or traced.
"""

from __future__ import annotations

import dataclasses
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..scene.model import Camera, Ground, Matrix4
from ..srgb import Linear
from .blur import gaussian_blur, varying_blur


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mirrored:
    """The objects' reflection in the floor, full image size.

    colour: (H, W, 3), reflected light. alpha: (H, W), share of the floor's own light that it replaces.
    """

    colour: Linear
    alpha: NDArray[np.float32]


def mirrored_camera(camera: Camera, ground: Ground) -> Camera:
    """Return ``camera`` mirrored at ``ground``. Its image, flipped left to right, is the floor's reflection."""
    normal, point = ground.unit_normal, np.asarray(ground.point, dtype=np.float64)
    reflect = np.eye(4)
    reflect[:3, :3] -= 2.0 * np.outer(normal, normal)
    reflect[:3, 3] = 2.0 * (point @ normal) * normal
    # A reflection changes handedness; flipping the image's x axis restores it.
    pose = reflect @ np.asarray(camera.world_from_camera) @ np.diag([-1.0, 1.0, 1.0, 1.0])
    matrix = cast(Matrix4, tuple(tuple(float(v) for v in row) for row in pose))
    return dataclasses.replace(camera, cx=camera.width - camera.cx, world_from_camera=matrix)


def fresnel(camera: Camera, ground: Ground, size: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the floor's reflectance (H, W), 0 where no floor is visible, and the cosine of the view angle (H, W).

    Schlick, "An inexpensive BRDF model for physically-based rendering", Computer Graphics Forum 13 (1994), equation
    15: R₀ + (1 − R₀)(1 − cos θ)⁵.
    """
    width, height = size
    x = (np.arange(width) + 0.5) * camera.width / width
    y = (np.arange(height) + 0.5) * camera.height / height
    rays = camera.rays(np.stack(np.meshgrid(x, y), axis=-1))
    cosine = -(rays @ ground.unit_normal) / np.linalg.norm(rays, axis=-1)
    share = ground.reflectivity + (1.0 - ground.reflectivity) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5
    return np.where(cosine > 0, share, 0.0).astype(np.float32), np.clip(cosine, 0.0, 1.0).astype(np.float32)


def blur_sigma(camera: Camera, ground: Ground, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the blur (N,) in photo pixels, along the view, of ``points`` (N, 3) reflected in a rough floor.

    Microfacet slopes have variance α²/2 each way, α the roughness squared (Walter et al., "Microfacet models for
    refraction through rough surfaces", EGSR 2007, for Beckmann's distribution); a ray turns by twice the slope, over
    the share h / (H + h) of its path, with heights h of the point and H of the camera.
    """
    heights = np.maximum(ground.heights(points), 0.0)
    eye = max(float(ground.heights(camera.position)), 1e-6)
    slope = ground.reflection_roughness**2 / np.sqrt(2.0)
    return np.asarray(camera.fy * 2.0 * slope * heights / (eye + heights))


def mirrored_layer(
    colour: Linear, alpha: NDArray[np.float32], sigma: NDArray[np.float32], share: NDArray[np.float32], cosine: float
) -> Mirrored:
    """Return the reflection from its sharp image, premultiplied ``colour`` (H, W, 3) and ``alpha`` (H, W).

    sigma: (H, W), blur along the view in pixels; across, it is shorter by ``cosine``. share: (H, W), of ``fresnel``.
    """

    def smear(image: NDArray[np.float32], by: float) -> NDArray[np.float32]:
        return gaussian_blur(image, max(by * cosine, 1e-2), by)

    both = varying_blur(np.concatenate([colour, alpha[..., None]], axis=-1), sigma, smear) * share[..., None]
    return Mirrored(colour=both[..., :3], alpha=both[..., 3])


def with_reflection(ground: Linear, now: Mirrored, rest: Mirrored, at_rest: NDArray[np.float32]) -> Linear:
    """Return ``ground`` (H, W, 3) with the reflection ``now``; the photo already contains the one at rest.

    at_rest: (H, W), weight w of the photo, 1 where nothing has moved; there only the change from ``rest`` is added.
    """
    change = now.colour - now.alpha[..., None] * ground
    known = rest.colour - rest.alpha[..., None] * ground
    return np.maximum(ground + (change - at_rest[..., None] * known), 0.0).astype(np.float32)
