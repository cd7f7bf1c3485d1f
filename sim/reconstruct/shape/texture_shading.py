# SPDX-License-Identifier: MIT
"""The photo's light on a body's texture: how much brighter each texel is than evenly lit, as logarithms.

Where the photo shows the surface, its light follows the normal (`even_light.py`), as far as the pixels around bear that
out. Behind the rim it falls off as far as it was left in the colours there, so that nothing begins at 90 degrees to the
camera.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..creases import split_creases
from ..mesh_raster import rasterise
from .even_light import BodyLight, Picture
from .inflated_mesh import BodyMesh
from .surface_values import Points, SurfaceValues, sampled

MOST_TINT = 0.12
"""Largest logarithm of a channel's light over the mean of all: dark pixels hardly tell the colour of theirs."""


def corner_light(light: BodyLight, body: BodyMesh) -> Points:
    """Return the logarithms (T, 3, 3) of the light at the corners of the faces of ``body``, apart at creases."""
    smooth = split_creases(body.vertices, body.faces)
    return untinted(light.by_normal.on(smooth.normals))[smooth.faces]


def untinted(light: Points) -> Points:
    """Return the logarithms ``light`` (n, 3), their colour at most ``MOST_TINT`` from grey."""
    grey = light.mean(axis=1, keepdims=True)
    return np.asarray(grey + np.clip(light - grey, -MOST_TINT, MOST_TINT))


def shading_of_photo(light: BodyLight, place: Points, faces: NDArray[np.int64], corners: Points) -> Picture:
    """Return the shading (h, w, 3), logarithms, of the photo around the object, which faces show pixel by pixel.

    place: (N, 2) texels of the vertices of ``faces`` (T, 3), corners: (T, 3, 3) the light at their corners.
    """
    height, width = light.trust.shape
    at = np.column_stack([place, np.ones(len(place))])
    shown = rasterise(at, faces, (width, height))
    found = np.einsum("pk,pkc->pc", shown.corners, corners[shown.faces])
    found *= light.trust[shown.rows, shown.columns, None]
    return shown.spread(found.astype(np.float32), (width, height))


def shading_of_charts(
    light: BodyLight, texels: SurfaceValues, seen: Points, of_normal: Points, origin: tuple[float, float]
) -> Points:
    """Return the shading (P, 3), logarithms, of ``texels`` of charts.

    seen: (P, 1) share of the photo in their colours. of_normal: (P, 3) the light on their normals. origin: of the
    texture in the photo, px, centre of its first pixel.
    """
    own, like = (sampled(light.trust[..., None], at - origin) for at in (texels.pixel, texels.counterpart))
    hidden = (1.0 - texels.unlit) * like * untinted(sampled(light.picture, texels.counterpart - origin))
    return np.asarray(hidden + seen * (own * of_normal - hidden))
