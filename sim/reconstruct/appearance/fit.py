# SPDX-License-Identifier: MIT
"""Roughness and metallic from the highlights that a photo shows, where it shows any that can be trusted.

Over the pixels of one colour the photo is explained by matt shading, its own errors included, and by matt shading with
a highlight of the sun. A highlight counts when it explains much, when it is as bright as one can be, when no sun from
elsewhere explains as much (bright print does, and then nothing is claimed), and when the roughness is told apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .highlight import HighlightFit, Observed
from .one_colour import most_common_colour
from .reflection import DIELECTRIC_F0, sky_lobe, sun_lobe
from .surroundings import Surroundings, sun_points

Points = NDArray[np.float64]

ROUGHNESSES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7, 0.8, 0.9, 1.0)
TILTS_DEG = (0.0, 5.0, 11.0)
"""How far the sun may lie from where it was found, for the normals of a guessed shape are not exact either."""
LEAST_PIXELS, LEAST_SHARE = 350, 0.4
"""Pixels of one colour, and of all that are seen."""
LEAST_GAIN = 0.12
"""Of what matt shading leaves unexplained, the part that the highlight has to explain."""
LEAST_LEAD = 1.8
"""Times as much as a sun from any other direction would."""
CORRELATED = 9.0
"""Pixels that err together: neighbours share the shape's and the shading's errors."""
SIGNIFICANCE = 0.001
WIDEST = 0.2
"""Span of roughnesses that explain nearly as much, above which none is claimed."""
NEARLY = 0.9
LEAST_METAL = 0.5
"""Of what matt shading leaves unexplained, the part that a mirror has to explain, and more than a highlight does."""


@dataclass(frozen=True, eq=False)
class FitPixels:
    """P pixels of one object. brightness: (P, 3) linear, in the unit of ``surroundings``; clipped: (P,) white in the
    photo. normals, views: (P, 3) unit, views towards the camera. ambient: (P, 3), sun: (P,), reached: (P,), openness:
    (P,) as in ``Shading``.
    """

    brightness: Points
    clipped: NDArray[np.bool_]
    normals: Points
    views: Points
    ambient: Points
    sun: NDArray[np.float64]
    reached: NDArray[np.float64]
    openness: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Reflectance:
    """roughness: 0 to 1; metal: whether it reflects as a metal; strength: of the highlight over that of an index of
    1.5; disc: unit vectors (D, 3) over the sun that it belongs to; colour: albedo (3,); gain: share (0 to 1) explained.
    """

    roughness: float
    metal: bool
    strength: float
    disc: Points
    colour: Points
    gain: float


def fit_reflectance(scene: Surroundings, pixels: FitPixels) -> Reflectance | str:
    """What the highlights on ``pixels`` tell, or why they tell nothing."""
    if scene.sun is None:
        return "no sun that could make a highlight"
    if len(pixels.brightness) < LEAST_PIXELS:
        return "too few pixels"
    colour = most_common_colour(pixels.brightness, pixels.ambient + pixels.sun[:, None])
    chosen = colour.members | (pixels.clipped & (pixels.reached > 0.3))
    if chosen.sum() < max(LEAST_PIXELS, LEAST_SHARE * len(chosen)):
        return "too little of one colour"
    seen = _part(pixels, chosen)
    observed = Observed.of(seen.brightness, seen.clipped, seen.ambient, seen.sun, seen.normals, colour.albedo)
    disc = sun_points(scene)
    ambient = [
        sky_lobe(scene, seen.normals, seen.views, r, DIELECTRIC_F0).mean(axis=1) * seen.openness for r in ROUGHNESSES
    ]

    def fitted(turned: Points, index: int) -> HighlightFit:
        lobe = sun_lobe(scene, seen.normals, seen.views, ROUGHNESSES[index], DIELECTRIC_F0, turned) * seen.reached
        return observed.fit(lobe + ambient[index], lobe)

    def as_metal(turned: Points, index: int) -> HighlightFit:
        lobe = sun_lobe(scene, seen.normals, seen.views, ROUGHNESSES[index], 1.0, turned) * seen.reached
        return observed.metal(mirrors[index], lobe)

    coarse, some = disc[:: max(1, len(disc) // 3)], range(1, len(ROUGHNESSES), 2)
    tilt = max(_tilts(scene.sun), key=lambda t: max(fitted(coarse @ t.T, i).gain for i in some))
    turned = disc @ tilt.T
    fits = [fitted(turned, i) for i in range(len(ROUGHNESSES))]
    at = max(range(len(fits)), key=lambda i: fits[i].gain)
    best = fits[at]
    mirrors = [sky_lobe(scene, seen.normals, seen.views, r, 1.0) * seen.openness[:, None] for r in ROUGHNESSES]
    tilts = (tilt, np.eye(3))
    metals = max(
        ([as_metal(disc @ t.T, i) for i in range(len(ROUGHNESSES))] for t in tilts),
        key=lambda row: max(fit.gain for fit in row),
    )
    metal = max(fit.gain for fit in metals)
    if metal > max(LEAST_METAL, best.gain):
        roughness = _told([fit.gain for fit in metals])
        if isinstance(roughness, str):
            return roughness
        return Reflectance(roughness, True, 1.0, disc, colour.albedo, metal)
    if best.gain < LEAST_GAIN:
        return f"no highlight stands out ({max(best.gain, 0.0):.0%} explained)"
    free = max((observed.count - observed.unknowns) / CORRELATED, 2.0)
    ratio = best.gain / 3.0 / max((1.0 - best.gain) / free, 1e-9)
    if stats.f.sf(ratio, 3, free) > SIGNIFICANCE:
        return "the highlight could be chance"
    if best.bounded:
        return f"the bright part is no highlight of this sun (strength {best.strength:.2g})"
    lobe = sun_lobe(scene, seen.normals, seen.views, ROUGHNESSES[at], DIELECTRIC_F0, turned) * seen.reached
    varnish = observed.varnished(lobe + ambient[at], best.strength, seen.ambient, seen.sun)
    if varnish.gain < metal:
        return "it may be a metal or varnish"
    rivals = [fitted(coarse @ t.T, i).gain for t in _elsewhere(scene.sun) for i in range(1, len(ROUGHNESSES), 3)]
    if best.gain < LEAST_LEAD * max(rivals, default=0.0):
        return "a sun from elsewhere would explain as much"
    roughness = _told([fit.gain for fit in fits])
    if isinstance(roughness, str):
        return roughness
    return Reflectance(roughness, False, best.strength, turned, colour.albedo, best.gain)


def _told(gains: list[float]) -> float | str:
    """The roughness that ``gains`` of all ``ROUGHNESSES`` tell, or that they tell none."""
    best = max(gains)
    near = [r for r, gain in zip(ROUGHNESSES, gains, strict=True) if gain >= NEARLY * best]
    if max(near) - min(near) > WIDEST:
        return f"roughness {min(near):.2g} to {max(near):.2g} fits alike"
    weights = np.array([max(gain - NEARLY * best, 0.0) for gain in gains])
    return float((weights * ROUGHNESSES).sum() / weights.sum())


def _part(pixels: FitPixels, chosen: NDArray[np.bool_]) -> FitPixels:
    return FitPixels(*(getattr(pixels, name)[chosen] for name in FitPixels.__dataclass_fields__))


def _tilts(sun: Points) -> list[Points]:
    """Rotations (3, 3) that take the sun a little away, all around."""
    helper = np.eye(3)[int(np.argmin(np.abs(sun)))]
    first = np.cross(helper, sun)
    first /= np.linalg.norm(first)
    second = np.cross(sun, first)
    result = [np.eye(3)]
    for ring, degrees in enumerate(TILTS_DEG[1:], start=1):
        for k in range(6 * ring):
            turn = 2 * np.pi * k / (6 * ring)
            result.append(_rotation(np.cos(turn) * first + np.sin(turn) * second, np.radians(degrees)))
    return result


def _elsewhere(sun: Points) -> list[Points]:
    """Rotations (3, 3) that take the sun around the vertical, 40° and more away where it is not overhead."""
    turns = [_rotation(np.array([0.0, 0.0, 1.0]), np.radians(a)) for a in range(45, 360, 45)]
    level = np.cross(sun, (0.0, 0.0, 1.0))
    length = np.linalg.norm(level)
    if length < 0.5:
        level, length = np.array([1.0, 0.0, 0.0]), 1.0
    steeper = [_rotation(level / length, np.radians(a)) for a in (-35, 35)]
    lifted = [t @ s for s in steeper for t in (np.eye(3), *turns)]
    return [t for t in (*turns, *lifted) if (t @ sun) @ sun < 0.85 and (t @ sun)[2] > 0.1]


def _rotation(axis: Points, angle: float) -> Points:
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * skew @ skew)
