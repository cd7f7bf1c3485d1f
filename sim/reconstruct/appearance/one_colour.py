# SPDX-License-Identifier: MIT
"""The pixels of an object that seem to be of one colour, highlights on it included.

Light that a dielectric reflects has the colour of the light, the rest the colour of the matter, so the pixels of one
colour lie in a plane through both (Shafer, Using Color to Separate Reflection Components, 1985).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

RADIUS = 0.2
"""Of logarithms of chromaticity, and of ``BRIGHTNESS`` times that of brightness, within which a colour is one."""
BRIGHTNESS = 0.5
OFF_PLANE = 0.06
"""How far a pixel may lie off the plane, over its brightness and beside noise."""
NOISE = 0.012
DARKEST = 0.55
"""A pixel's brightness over what the shading says, at least: darker ones are of another colour."""
SAMPLE = 2500
WHITE = np.ones(3) / np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class OneColour:
    """albedo: (3,) of the colour. members: (P,) which pixels."""

    albedo: NDArray[np.float64]
    members: NDArray[np.bool_]


def most_common_colour(brightness: NDArray[np.float64], shading: NDArray[np.float64]) -> OneColour:
    """The colour of most of the pixels of ``brightness`` (P, 3) under ``shading`` (P, 3)."""
    albedo = np.maximum(brightness, 1e-4) / np.maximum(shading, 0.02)
    level = np.log(albedo.mean(axis=1))
    ratio = np.log(np.maximum(brightness, 4e-3) / np.maximum(brightness, 4e-3).mean(axis=1, keepdims=True))
    features = np.column_stack([ratio[:, 0] - ratio[:, 1], ratio[:, 2] - ratio[:, 1], BRIGHTNESS * level])
    chosen = np.random.default_rng(0).permutation(len(features))[:SAMPLE]
    tree = cKDTree(features[chosen])
    near = tree.query_ball_point(features[chosen], RADIUS, return_length=True)
    middle = features[chosen[int(np.argmax(near))]]
    close = np.linalg.norm(features - middle, axis=1) < RADIUS
    colour = np.median(albedo[close], axis=0)
    return OneColour(colour, _in_plane(brightness, shading, colour))


def _in_plane(
    brightness: NDArray[np.float64], shading: NDArray[np.float64], colour: NDArray[np.float64]
) -> NDArray[np.bool_]:
    unit = colour / np.linalg.norm(colour)
    aside = WHITE - (WHITE @ unit) * unit
    if np.linalg.norm(aside) > 0.05:
        off = np.cross(unit, aside / np.linalg.norm(aside))
        basis = np.stack([unit, aside / np.linalg.norm(aside)])
        whiter = brightness @ basis[1]
    else:
        # Grey: highlights have the same colour, all else is off.
        rest = brightness - (brightness @ unit)[:, None] * unit
        alike = np.linalg.norm(rest, axis=1) < _slack(brightness)
        return np.asarray(alike & _bright_enough(brightness, shading, colour))
    close = np.abs(brightness @ off) < _slack(brightness)
    return np.asarray(close & (whiter > -_slack(brightness)) & _bright_enough(brightness, shading, colour))


def _slack(brightness: NDArray[np.float64]) -> NDArray[np.float64]:
    return NOISE + OFF_PLANE * np.linalg.norm(brightness, axis=1)


def _bright_enough(
    brightness: NDArray[np.float64], shading: NDArray[np.float64], colour: NDArray[np.float64]
) -> NDArray[np.bool_]:
    unit = colour / np.linalg.norm(colour)
    return np.asarray(brightness @ unit > DARKEST * (shading * colour) @ unit)
