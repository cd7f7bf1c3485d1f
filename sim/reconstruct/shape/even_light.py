# SPDX-License-Identifier: MIT
"""The photo's light on a body, as far as it follows the body's shape.

Sides that nothing shows get the colours of the visible side without its bright and dark half, and the texture's
shading says how much of what the photo shows is light.

A matt convex surface in distant light is as bright as a quadratic polynomial of its normal (Basri & Jacobs, Lambertian
Reflectance and Linear Subspaces, PAMI 25(2), 2003). It is fitted to the logarithms of the pixels of the most common
chromaticity, robustly, so that marks and paint have no part in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ...robust_deviation import robust_deviation
from ...scene.model import Camera
from ...smoothstep import smoothstep
from ...srgb import bytes_to_linear
from ..mesh_raster import rasterise
from .body_texture import CropTexture
from .inflated_mesh import BodyMesh

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
Picture = NDArray[np.float32]

COARSE = 128
"""Pixels along the longer side of the picture on which light is fitted."""
FACING = 0.12
"""Cosine of the angle to the camera from which a pixel counts: along the outline, colours and normals are doubtful."""
TONES = (0.006, 0.97)
"""Linear brightness between which a pixel counts: neither black nor clipped."""
ONE_COLOUR = 0.3
"""Radius in log chromaticity of one colour, of any brightness."""
LEAST = (150, 0.25)
"""Pixels of one colour required, and their share of the visible ones."""
RIDGE = (0.003, 0.03)
"""Weight of small linear and quadratic coefficients, over the number of pixels."""
ROUNDS = 8
EXPLAINED = (0.05, 0.3)
"""Share of the variance of the logarithms that has to be explained by the normal: none of the light is taken out at
the first, all at the second."""
UNLIKE = (0.25, 0.5)
"""Distance of a normal from all that were fitted, from which its light is less known, and beyond which not at all."""
MOST = 1.5
"""Largest logarithm of the light over its mean."""


TRUST_REACH = (0.25, 0.06)
"""Standard deviations, over the longer side of the picture, of the surroundings in which pixels tell whether they are
lit as fitted: wide ones, and near ones that are held against the wide."""
TRUST_HELD = 0.02
"""Square of the logarithm of light, near, that counts as much as what the wide surroundings tell."""


@dataclass(frozen=True, eq=False)
class LightByNormal:
    """coefficients: (8, 3) of the polynomial of the normal. usual: (3,) its value where the light counts as 1. share:
    of it to believe. fitted: the normals that it was fitted to."""

    coefficients: Points
    usual: Points
    share: float
    fitted: cKDTree

    def on(self, normals: Points) -> Points:
        """Return the logarithm (n, 3) of the light on surfaces with unit ``normals`` (n, 3)."""
        light = np.clip(_basis(normals) @ self.coefficients - self.usual, -MOST, MOST) * self.share
        away = self.fitted.query(normals, distance_upper_bound=UNLIKE[1])[0]
        return np.asarray(light * smoothstep(np.minimum(away, UNLIKE[1]), UNLIKE[1], UNLIKE[0])[:, None])


@dataclass(frozen=True, eq=False)
class BodyLight:
    """The photo's light on a body: by its normal, picture: (h, w, 3) its logarithm at the pixels of the texture, trust:
    (h, w) how far the pixels around bear it out, 0 to 1."""

    by_normal: LightByNormal
    picture: Picture
    trust: Picture


def light_on(camera: Camera, body: BodyMesh, texture: CropTexture, mask: Mask) -> BodyLight | None:
    """Return the light in ``texture`` that follows the normals of ``body``; None where the photo does not tell.

    Its mean logarithm is 0 with the squared cosine of the angle to the camera as weight. mask: (h, w) the object in the
    texture.
    """
    height, width = mask.shape
    scale = min(1.0, COARSE / max(height, width))
    size = (max(4, round(width * scale)), max(4, round(height * scale)))
    at = camera.project(body.vertices)
    at[:, :2] = (at[:, :2] - (texture.left, texture.top)) * (size[0] / width, size[1] / height)
    shown = rasterise(at, body.faces, size)
    if len(shown.rows) < LEAST[0]:
        return None
    a, b, c = (body.vertices[body.faces[shown.faces, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    towards = camera.position - (a + b + c) / 3.0
    cosine = (normal * towards).sum(axis=1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
    linear = cv2.resize(bytes_to_linear(texture.pixels).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    inner = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    inner = ndimage.binary_erosion(inner)
    colour = linear[shown.rows, shown.columns].astype(np.float64)
    good = (cosine > FACING) & inner[shown.rows, shown.columns]
    good &= (colour.min(axis=1) > TONES[0]) & (colour.max(axis=1) < TONES[1])
    logs = np.log(np.maximum(colour, 1e-4))
    common = np.flatnonzero(good)[_most_common(logs[good])]
    if len(common) < max(LEAST[0], LEAST[1] * float((cosine > FACING).sum())):
        return None
    basis = _basis(normal[common])
    found, share = _fitted(basis, logs[common])
    # What faces the camera sets the level: a back is held against that, not against a dark flank or a bright top.
    usual = np.average(basis @ found, axis=0, weights=cosine[common] ** 2)
    by_normal = LightByNormal(found, usual, share, cKDTree(normal[common]))
    light = by_normal.on(normal)
    seen, explained = logs[common].mean(axis=1), light[common].mean(axis=1)
    seen -= float(np.median(seen - explained))
    trust = _trust((shown.rows[common], shown.columns[common]), seen, explained, size)
    grid = shown.spread(light.astype(np.float32), size)
    return BodyLight(by_normal, *(_enlarged(values, width, height) for values in (grid, trust)))


def _enlarged(values: Picture, width: int, height: int) -> Picture:
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _trust(at: tuple[Indices, Indices], seen: Points, light: Points, size: tuple[int, int]) -> Picture:
    """How far (h, w), 0 to 1, the logarithms ``seen`` (n,) at rows and columns ``at`` rise with the ``light`` (n,).

    That is the slope of the one over the other around each pixel, by least squares through the origin.
    """
    both = np.zeros((size[1], size[0], 2), dtype=np.float32)
    both[at] = np.column_stack([seen * light, light * light])
    count = np.zeros(both.shape[:2], dtype=np.float32)
    count[at] = 1.0
    slope = np.ones(both.shape[:2], dtype=np.float32)
    for reach in TRUST_REACH:
        sigma = reach * max(size)
        near = cv2.GaussianBlur(both, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        held = TRUST_HELD * cv2.GaussianBlur(count, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        slope = np.clip((near[..., 0] + held * slope) / np.maximum(near[..., 1] + held, 1e-9), 0.0, 1.0)
    return np.asarray(slope, dtype=np.float32)


def _basis(normal: Points) -> Points:
    """Quadratic polynomials (n, 8) of ``normal`` (n, 3), without the constant."""
    x, y, z = normal.T
    return np.column_stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0])


def _most_common(logs: Points) -> Mask:
    """Which of ``logs`` (n, 3) have the most common chromaticity."""
    if not len(logs):
        return np.zeros(0, dtype=bool)
    chroma = logs - logs.mean(axis=1, keepdims=True)
    tree = cKDTree(chroma)
    tried = chroma[:: max(1, len(chroma) // 500)]
    count = tree.query_ball_point(tried, ONE_COLOUR, return_length=True)
    return np.asarray(np.linalg.norm(chroma - tried[int(np.argmax(count))], axis=1) < ONE_COLOUR)


def _fitted(basis: Points, logs: Points) -> tuple[Points, float]:
    """Coefficients (8, 3) of ``basis`` (n, 8) for ``logs`` (n, 3), robust, and the share of that to believe, 0 to 1."""
    ridge = len(basis) * np.repeat(RIDGE, (3, 5))
    weights = np.ones(len(basis))
    found = np.zeros((basis.shape[1], 3))
    for _ in range(ROUNDS):
        total = weights.sum()
        centre, level = weights @ basis / total, weights @ logs / total
        offset = basis - centre
        matrix = (offset * weights[:, None]).T @ offset + np.diag(ridge)
        found = np.linalg.solve(matrix, (offset * weights[:, None]).T @ (logs - level))
        residual = (logs - level - offset @ found).mean(axis=1)
        spread = max(float(robust_deviation(residual)), 1e-3)
        weights = 1.0 / np.maximum(1.0, np.abs(residual) / (1.5 * spread))
    light = (logs - level).mean(axis=1)
    left = float((weights * residual**2).sum() / max(float((weights * light**2).sum()), 1e-12))
    low, high = EXPLAINED
    return found, float(np.clip((1.0 - left - low) / (high - low), 0.0, 1.0))
