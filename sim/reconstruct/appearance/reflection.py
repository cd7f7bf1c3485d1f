# SPDX-License-Identifier: MIT
"""How bright reflections are: GGX microfacets (Walter et al., Microfacet Models for Refraction, EGSR 2007).

Cook and Torrance's product D F G / (4 n·l n·v) with α = roughness² (Burley, Physically Based Shading at Disney, 2012),
Smith's height-correlated G (Heitz, JCGT 2014) and Schlick's F (1994). The surroundings are blurred by the lobe, and the
rest of the integral is Karis' fit to it (Physically Based Shading on Mobile, 2014). Brightness is measured as in
``surroundings``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...scene.equirectangular import directions
from .around import summed_around
from .shading import looked_up
from .surroundings import Surroundings, sun_points

Points = NDArray[np.float64]

DIELECTRIC_F0 = 0.04
LEAST_ROUGHNESS = 0.03


def sun_lobe(
    scene: Surroundings, normals: Points, views: Points, roughness: float, f0: float, disc: Points | None = None
) -> NDArray[np.float64]:
    """Reflected sun (N,) at unit ``normals`` (N, 3) towards unit ``views`` (N, 3), nothing in the way.

    f0: reflectance straight on. disc: unit vectors (D, 3) over the sun in place of the scene's.
    """
    alpha = max(roughness, LEAST_ROUGHNESS) ** 2
    if disc is None:
        disc = sun_points(scene)
    facing = np.maximum((normals * views).sum(axis=1), 1e-3)
    result = np.zeros(len(normals))
    for light in disc:
        lit = np.maximum(normals @ light, 0.0)
        half = views + light
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        straight = np.clip((normals * half).sum(axis=1), 0.0, 1.0)
        # 1 - cos² loses the digits that a sharp lobe needs, so the sine comes from the cross product.
        sine2 = (np.cross(normals, half) ** 2).sum(axis=1)
        spread = alpha**2 / (np.pi * (sine2 + alpha**2 * straight**2) ** 2 + 1e-30)
        smith = lit * np.sqrt(facing**2 * (1 - alpha**2) + alpha**2) + facing * np.sqrt(
            lit**2 * (1 - alpha**2) + alpha**2
        )
        fresnel = f0 + (1.0 - f0) * (1.0 - np.clip((views * half).sum(axis=1), 0.0, 1.0)) ** 5
        # D F G / (4 n·l n·v) times n·l, with G / (4 n·l n·v) = 1 / (2 smith); π for brightness from irradiance over π.
        result += np.where(lit > 0, spread * fresnel * 0.5 / np.maximum(smith, 1e-9) * lit, 0.0)
    return result * (np.pi * scene.sun_radiance / len(disc))


def sky_lobe(
    scene: Surroundings, normals: Points, views: Points, roughness: float, f0: NDArray[np.float64] | float
) -> Points:
    """Reflected sky and ground (N, 3), nothing in the way; ``f0``: one number or RGB (3,)."""
    height, width = scene.sky.shape[:2]
    towards, _ = directions(height, width)
    around = np.where(towards[..., 2:] > 0, scene.sky, scene.ground_radiance)
    alpha = max(roughness, 0.12) ** 2

    def lobe(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
        # Around the mirror direction, looked at straight on: h halfway between it and the light.
        straight2 = (1.0 + cosine) / 2.0
        return np.maximum(cosine, 0.0) * alpha**2 / (straight2 * (alpha**2 - 1.0) + 1.0) ** 2

    both = summed_around(np.concatenate([around, np.ones((height, width, 1))], axis=2), lobe)
    blurred = both[..., :3] / both[..., 3:]
    facing = np.clip((normals * views).sum(axis=1), 1e-3, 1.0)
    mirrored = 2.0 * (normals * views).sum(axis=1, keepdims=True) * normals - views
    scale, bias = _karis(roughness, facing)
    return looked_up(blurred, mirrored) * (np.asarray(f0) * scale[:, None] + bias[:, None])


def _karis(roughness: float, facing: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y, z, w = (a * roughness + b for a, b in ((-1.0, 1.0), (-0.0275, 0.0425), (-0.572, 1.04), (0.022, -0.04)))
    bent = np.minimum(x * x, np.exp2(-9.28 * facing)) * x + y
    return -1.04 * bent + z, 1.04 * bent + w
