# SPDX-License-Identifier: MIT
"""A broader base for inflated bodies: low down, the side that the photo does not show is made thicker.

Inflated bodies are round and would stand on a spot, where real things have settled and reach farther back. What faces
away from the camera moves farther from it along its own ray, most at the bottom and where the body is thick, not at all
on the outline, and no farther than the ground: the underside comes to lie on the ground, the back moves away, and the
centre of mass with it. Neither the front nor the outline changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...mpm.geometry.triangles import area_normals
from ...scene.model import Camera
from ..camera.ground_camera import ground_depth
from .inflate import Silhouette
from .support import support_of

Points = NDArray[np.float64]

THICKEST = 1.5
"""Largest thickness that is added, over the body's half thickness."""
STEPS = 30
"""Thicknesses to try."""
COST = 1.0
"""Share of the wanted margin that a body has to gain for twice its volume; less is not worth its looks."""
WHOLE = 0.3
"""Local half thickness, over the largest, from which all of it is added: less to limbs, ears and straps."""
LOWEST, RISE = 0.2, 0.6
"""Height over the body's, above which nothing is added, for hardly any thickness, and how much higher for each half
thickness: a low and thick addition would be a wedge behind the body."""


def footed(
    camera: Camera, silhouette: Silhouette, vertices: Points, faces: NDArray[np.int64]
) -> tuple[Points, NDArray[np.bool_]]:
    """Return ``vertices`` (V, 3) with the unseen side as much thicker as the body needs to stand safely, and which of
    them moved (V,).

    camera: above the ground z = 0. As safely as ``support.SupportMargin.wanted`` says, or as is worth it.
    """
    plain = support_of(vertices, faces)
    best, highest = vertices, plain.share
    if highest < 1.0:
        thicken = _Thickening(camera, silhouette, vertices, faces)
        for extra in THICKEST * np.arange(1, STEPS + 1) / STEPS:
            made = thicken.by(extra)
            stands = support_of(made, faces)
            score = min(stands.share, 1.0) - COST * (stands.volume / plain.volume - 1.0)
            if score > (plain.share if stands.share >= 1.0 else highest):
                best, highest = made, score
            if stands.share >= 1.0:
                break
    return best, (best != vertices).any(axis=1)


class _Thickening:
    """The unseen vertices of one body, and how far each may move away along its ray."""

    def __init__(self, camera: Camera, silhouette: Silhouette, vertices: Points, faces: NDArray[np.int64]) -> None:
        self._vertices = vertices
        projected = camera.project(vertices)
        self._rays = camera.rays(projected[:, :2])
        # Depths, along the optical axis: what each vertex moves for one half thickness, and at most.
        half = silhouette.half_thickness * float(np.median(projected[:, 2])) / camera.fx
        at = projected[:, :2] - (silhouette.left + 0.5, silhouette.top + 0.5)
        square = ndimage.map_coordinates(silhouette.square_height, at[:, ::-1].T, order=1, mode="nearest")
        share = np.sqrt(np.maximum(square, 0.0)) / silhouette.half_thickness
        unseen = np.einsum("ij,ij->i", area_normals(vertices, faces), camera.position - vertices) < 0.0
        self._height = vertices[:, 2] / vertices[:, 2].max()
        self._step = np.where(unseen, half * np.minimum(share / WHOLE, 1.0), 0.0)
        self._step /= np.linalg.norm(self._rays, axis=1)
        self._room = np.maximum(ground_depth(camera, self._rays) - projected[:, 2], 0.0)

    def by(self, extra: float) -> Points:
        """Return the vertices (V, 3) with ``extra`` half thicknesses added, none below the ground."""
        moved = extra * self._step * np.clip(1.0 - self._height / (LOWEST + RISE * extra), 0.0, 1.0)
        made = self._vertices + np.minimum(moved, self._room)[:, None] * self._rays
        made[(moved > 0.0) & (moved >= self._room), 2] = 0.0
        return np.asarray(made)
