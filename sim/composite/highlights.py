# SPDX-License-Identifier: MIT
"""Highlights of a photographed thing: taken out of its texture where it turns, and left where the light is.

A dielectric reflects its own colour from below its surface, and the light's colour at it (Shafer, Using Color to
Separate Reflection Components, 1985). The channel that its own colour has least of tells the second: the others change
with the colour of what lights it, and clip. What is white and follows the normal, as seen by the camera, is a
highlight; white paint does not follow it, and has none of the body's colour left.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..smoothstep import smoothstep
from ..srgb import bytes_to_linear, linear_to_bytes
from .pull_push import fill_gaps

CELLS = 32
"""Cells along a side of the map over the normals that face the camera."""
SAMPLE = 2500
ONE_COLOUR = 0.35
"""Radius in log chromaticity of one colour with its highlights."""
LEAST = (300, 0.4)
"""Pixels of one colour required, and their share of the visible ones."""
PURE = 0.5
"""Share of the pixels of one colour, those farthest from white, that tell the body's own at first."""
CLEAR, LIT = 0.05, 0.75
"""White share of a pixel's light up to which it has no highlight, and quantile of the light of such pixels from which
they tell the colour that is below the highlights: what is lit less is lit by what stands around."""
LEAST_TINT = 0.2
"""Sine between the body's colour and white below which the two cannot be told apart."""
ALIKE = (0.3, 0.45)
"""Sine between a pixel less its white and the body's colour up to which it is of it, and from which it is not."""
BODY = (0.2, 0.45)
"""Light in the body's colour, over its median, below which white is paint, and from which it is a highlight."""
DARKEST = 0.008
"""Linear brightness below which 8 bits do not resolve a colour."""
BASE = 0.25
"""Quantile of the white light that lies on all sides, and stays in the texture."""
BURNT = (0.75, 0.95)
"""Brightness of a texel's strongest channel from which it may have clipped, and from which it has: then it is what the
body's colour and the second channel say."""
SECOND = 0.1
"""Share of the body's strongest channel that its second one must have to tell it: a pure red has next to none."""
BLANK = (0.5, 0.75)
"""Share of a texel's light that its highlight takes from which little is known of what is below, and from which
nothing: then it is what lies around."""
HEADROOM = 2.0
"""Largest value of a texture without highlights: where a channel had clipped, the light was brighter than white."""
SPREAD = 0.3
"""Least deviation of the normals, as sines: on one flat side nothing tells a highlight from paint."""
EXPLAINED = 0.4
"""Least share of the variance of the white light that the normal explains."""
MOST_WHITE = 0.25
"""Share of the light from which white is no highlight but a body's own: a pale one on a coloured floor is lit by two
colours, the floor's from below, and both follow the normal. Plush toys are at 0.3 to 0.5, an orange, clay and plastic
at 0.13 to 0.2."""
SMOOTH, FEW = 1.2, 0.05
"""Deviation in cells over which the map is smoothed, and pixels in a cell below which it falls to 0."""
LEAST_LEVEL = 0.03
"""Least brightness of a highlight, linear."""
LEFT = 0.1
"""Least share of a texel's weakest channel that is not a highlight."""
CLIPPED = 0.98
"""Linear brightness from which a pixel's colour is not known."""
ROWS = 256
"""Rows of a texture that are worked on at a time."""


@dataclass(frozen=True, eq=False)
class Highlights:
    """The highlights of a thing of one colour, mostly.

    colour: (3,) unit length, of its body. usual: median of the light in that colour, linear. base: white light that
    lies on all sides. lobe: (CELLS, CELLS) linear brightness beyond it that is reflected by the normals whose parts to
    the right and up, as the camera sees it, run from −1 to 1 along columns and rows.
    """

    colour: NDArray[np.float32]
    usual: float
    base: float
    lobe: NDArray[np.float32]

    def taken_out(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return ``picture`` (h, w, 3) sRGB, a texture of the thing, without highlights, linear light over
        ``HEADROOM``."""
        result, blank = np.empty_like(picture), np.empty(picture.shape[:2], dtype=np.float32)
        second = int(np.argsort(self.colour)[1])
        for first in range(0, len(picture), ROWS):
            light = bytes_to_linear(picture[first : first + ROWS])
            body, white, alike = _apart(light, self.colour)
            share = alike * smoothstep(body / np.float32(self.usual), *BODY)
            taken = np.minimum(np.maximum(white - self.base, 0.0) * share, (1.0 - LEFT) * light.min(axis=2))
            rest = light - taken[..., None]
            burnt = (share * smoothstep(light.max(axis=2), *BURNT))[..., None]
            if self.colour[second] > SECOND * float(self.colour.max()):
                whole = np.maximum(rest[..., second, None] / self.colour[second] * self.colour, rest)
                rest += burnt * (whole - rest)
            blank[first : first + ROWS] = smoothstep(taken / np.maximum(light.mean(axis=2), np.float32(1e-4)), *BLANK)
            result[first : first + ROWS] = linear_to_bytes(rest / HEADROOM)
        if not blank.any():
            return result
        # Texels beside it are as bright as it is, or have clipped.
        blank = np.asarray(cv2.dilate(blank, np.ones((5, 5), np.uint8)))
        known = (blank == 0.0).astype(np.float32)
        light = bytes_to_linear(result)
        filled = np.dstack([fill_gaps(np.ascontiguousarray(light[..., c]), known) for c in range(3)])
        return linear_to_bytes(light + blank[..., None] * (filled - light))


def find_highlights(light: NDArray[np.float32], normals: NDArray[np.floating]) -> Highlights | None:
    """Return the highlights among the pixels ``light`` (P, 3), linear, that the photo shows of a thing; None where none
    can be told from paint.

    normals: (P, 3) unit vectors of its surface there, right, up and towards the camera.
    """
    colour = _body_colour(light)
    if colour is None:
        return None
    body, white, alike = _apart(light, colour)
    usual = float(np.median(body))
    usable = (alike > 0.5) & (body > BODY[1] * usual) & (light.mean(axis=1) > DARKEST)
    if usable.sum() < max(LEAST[0], LEAST[1] * len(light)):
        return None
    facing, white = normals[usable], white[usable]
    if float(np.sqrt(facing[:, :2].var(axis=0).sum())) < SPREAD:
        return None
    if float(white.mean()) > MOST_WHITE * float(light[usable].mean()):
        return None
    base = float(np.quantile(white, BASE))
    white = np.maximum(white - base, 0.0)
    lobe, explained = _by_normal(facing, white)
    if explained < EXPLAINED or float(lobe.max()) < LEAST_LEVEL:
        return None
    return Highlights(colour, usual, base, lobe)


def _body_colour(light: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """The most common colour (3,), of unit length, of pixels ``light`` (P, 3), without its highlights."""
    bright = light[(light.mean(axis=1) > DARKEST) & (light.max(axis=1) < CLIPPED)]
    if len(bright) < LEAST[0]:
        return None
    logs = np.log(np.maximum(bright, 1e-3))
    chroma = logs - logs.mean(axis=1, keepdims=True)
    some = chroma[:: max(1, len(chroma) // SAMPLE)]
    near = cKDTree(some).query_ball_point(some, ONE_COLOUR, return_length=True)
    members = np.linalg.norm(chroma - some[int(np.argmax(near))], axis=1) < ONE_COLOUR
    unit = bright[members] / np.linalg.norm(bright[members], axis=1, keepdims=True)
    tint = _tint(unit)
    colour = _middle(unit[tint >= np.quantile(tint, 1.0 - PURE)])
    if _tint(colour) < LEAST_TINT:
        return None
    body, white, _ = _apart(bright[members], colour)
    clear = white < CLEAR * bright[members].mean(axis=1)
    if clear.sum() < LEAST[0]:
        return None
    colour = _middle(unit[clear & (body >= np.quantile(body[clear], LIT))])
    return colour if _tint(colour) > LEAST_TINT else None


def _middle(unit: NDArray[np.float32]) -> NDArray[np.float32]:
    """The median (3,) of colours (P, 3) of unit length."""
    colour = np.median(unit, axis=0)
    return colour / np.linalg.norm(colour)


def _tint(unit: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sine (...) between colours (..., 3) of unit length and white."""
    return np.sqrt(np.maximum(1.0 - unit.sum(axis=-1) ** 2 / 3.0, 0.0))


def _apart(
    light: NDArray[np.float32], colour: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Light that is not white at pixels ``light`` (..., 3) of a body of ``colour`` (3,), white light, and how far, 0 to
    1, the first is of the body's colour; (...) each."""
    least = int(np.argmin(colour))
    ratio = float(2.0 * colour[least] / (colour.sum() - colour[least]))
    others = (light.sum(axis=-1) - light[..., least]) / 2.0
    white = np.clip((light[..., least] - ratio * others) / (1.0 - ratio), 0.0, light.min(axis=-1))
    rest = light - white[..., None]
    body = np.linalg.norm(rest, axis=-1)
    along = rest @ colour / np.maximum(body, 1e-6)
    alike = smoothstep(np.sqrt(np.maximum(1.0 - along**2, 0.0)), *ALIKE[::-1])
    return body.astype(np.float32), white.astype(np.float32), alike.astype(np.float32)


def _by_normal(normals: NDArray[np.floating], white: NDArray[np.floating]) -> tuple[NDArray[np.float32], float]:
    """``white`` (P,) over ``normals`` (P, 3) as a map (CELLS, CELLS), and the share of its variance in that."""
    place = np.clip((normals[:, :2] + 1.0) / 2.0 * CELLS, 0, CELLS - 1).astype(np.int64)
    cell = place[:, 1] * CELLS + place[:, 0]
    count = np.bincount(cell, minlength=CELLS**2).astype(np.float64)
    total = np.bincount(cell, white, CELLS**2)
    # Where few pixels share a normal, their neighbours tell more than they do.
    weight, summed = (cv2.GaussianBlur(v.reshape(CELLS, CELLS), (0, 0), SMOOTH) for v in (count, total))
    lobe = summed / (weight + FEW)
    rest = white - lobe.ravel()[cell]
    explained = 1.0 - float((rest**2).mean()) / max(float(white.var()), 1e-12)
    return lobe.astype(np.float32), explained
