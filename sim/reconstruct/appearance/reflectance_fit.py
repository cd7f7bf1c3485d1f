# SPDX-License-Identifier: MIT
"""Fit roughness and metallic to the highlights of a photo, where these can be trusted.

Over the pixels of one colour the photo is explained by matt shading alone, its errors included, and by matt shading
plus a highlight of the sun. The light that a dielectric reflects has the colour of the light, so these pixels lie in a
plane through both colours (Shafer, Using Color to Separate Reflection Components, 1985). They are projected on two
axes: the body colour, where shading may err smoothly with the normal, and the residual towards white, where only the
highlight remains. Linear terms are eliminated exactly (variable projection, Golub and Pereyra 1973).

A highlight is accepted when it explains much, is as bright as is physically possible, no sun from elsewhere explains
as much (bright print does), and the roughness is well determined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.spatial import cKDTree

from .object_shading import DIELECTRIC_F0, LocalLighting, sky_lobe, sun_lobe, sun_points

RADIUS = 0.2
"""Radius of one colour in log chromaticity, and ``BRIGHTNESS`` times log brightness."""
BRIGHTNESS = 0.5
OFF_PLANE = 0.06
"""Tolerance off the plane, over a pixel's brightness and in addition to noise."""
COLOUR_NOISE = 0.012
DARKEST = 0.55
"""Least brightness of a pixel over its predicted shading: darker ones are of another colour."""
SAMPLE = 2500
WHITE = np.ones(3) / np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class OneColour:
    """albedo: (3,) of the colour. members: (P,) its pixels."""

    albedo: NDArray[np.float64]
    members: NDArray[np.bool_]


def most_common_colour(brightness: NDArray[np.float64], shading: NDArray[np.float64]) -> OneColour:
    """Return the most common colour of ``brightness`` (P, 3) under ``shading`` (P, 3), and its pixels, highlights
    included."""
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
        # Grey: highlights have the same colour, everything else is off.
        rest = brightness - (brightness @ unit)[:, None] * unit
        alike = np.linalg.norm(rest, axis=1) < _slack(brightness)
        return np.asarray(alike & _bright_enough(brightness, shading, colour))
    close = np.abs(brightness @ off) < _slack(brightness)
    return np.asarray(close & (whiter > -_slack(brightness)) & _bright_enough(brightness, shading, colour))


def _slack(brightness: NDArray[np.float64]) -> NDArray[np.float64]:
    return COLOUR_NOISE + OFF_PLANE * np.linalg.norm(brightness, axis=1)


def _bright_enough(
    brightness: NDArray[np.float64], shading: NDArray[np.float64], colour: NDArray[np.float64]
) -> NDArray[np.bool_]:
    unit = colour / np.linalg.norm(colour)
    return np.asarray(brightness @ unit > DARKEST * (shading * colour) @ unit)


Points = NDArray[np.float64]

STRENGTHS = (0.3, 3.0)
"""Range of a highlight's strength over that of an index of 1.5 under a white ground that is just white in the photo."""
METAL_RATIO = (0.4, 2.5)
"""Range of the ratio of sun to sky in a metal's reflection, relative to the light estimate."""
LEAST_TINT = 0.12
"""Sine between the colour and white below which there is no second axis."""
SHADING_ERROR, NOISE = 0.06, 0.006
"""Error of matt shading, relative; and of pixels, in brightness."""
WHITE_LEVEL = 0.97


@dataclass(frozen=True)
class HighlightFit:
    """gain: share (0 to 1) of the matt residual that the highlight explains; strength: its factor; bounded: whether
    that is at an end of ``STRENGTHS``."""

    gain: float
    strength: float
    bounded: bool


@dataclass(frozen=True, eq=False)
class _Axis:
    """One colour axis, a unit vector (3,): weighted orthonormal matt shading (P, K), the weighted values (P,), their
    matt residual (P,), and the weights (P,)."""

    unit: NDArray[np.float64]
    matt: Points
    values: NDArray[np.float64]
    rest: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def white(self) -> float:
        """Return white light along the axis."""
        return float(self.unit.sum())


@dataclass(frozen=True, eq=False)
class Observed:
    """Pixels for fitting highlights; constructed by ``of``."""

    axes: tuple[_Axis, ...]
    colour: NDArray[np.float64]
    clipped: NDArray[np.bool_]
    missing: NDArray[np.float64]
    cost: float
    unknowns: int

    @property
    def count(self) -> int:
        """Return the number of observations."""
        return sum(int((axis.weight > 0).sum()) for axis in self.axes)

    @classmethod
    def of(
        cls,
        brightness: Points,
        clipped: NDArray[np.bool_],
        ambient: Points,
        sun: NDArray[np.float64],
        normals: Points,
        colour: Points,
    ) -> Observed:
        """Return the observations of ``brightness`` (P, 3) of pixels of albedo about ``colour`` (3,); the rest as in
        ``FitPixels``."""
        unit = colour / np.linalg.norm(colour)
        aside = WHITE - (WHITE @ unit) * unit
        tint = float(np.linalg.norm(aside))
        shading = ambient.mean(axis=1) + sun
        use = ~clipped
        level = float(np.linalg.norm(colour)) * shading
        weight = use / np.hypot(SHADING_ERROR * level, NOISE)
        columns = [ambient.mean(axis=1), sun, *(shading * normals[:, i] for i in range(3))]
        axes = [_axis(brightness, unit, columns, weight)]
        if tint > LEAST_TINT:
            aside = aside / tint
            # Where matt light is weak, its error is small as well.
            sure = use / np.hypot(0.35 * SHADING_ERROR * level, NOISE)
            coloured = [ambient @ (aside * unit), shading * float(unit @ aside) + ambient.mean(axis=1), sun]
            axes.append(_axis(brightness, aside, coloured, sure))
        missing = np.zeros(len(brightness))
        missing[clipped] = np.maximum(WHITE_LEVEL - (ambient @ (colour / 3.0) + sun * colour.mean())[clipped], 0.0)
        cost = sum(float((axis.rest**2).sum()) for axis in axes)
        cost += float(((missing[clipped] / (SHADING_ERROR * WHITE_LEVEL)) ** 2).sum())
        return cls(tuple(axes), colour, clipped, missing, max(cost, 1e-12), sum(axis.matt.shape[1] for axis in axes))

    def fit(self, highlight: NDArray[np.float64], sharp: NDArray[np.float64]) -> HighlightFit:
        """Return the best strength of ``highlight`` (P,), of which ``sharp`` (P,) is the sun's part, and its gain."""
        if not (sharp > 1e-4).any():
            return HighlightFit(0.0, 0.0, True)
        along, square, shapes = 0.0, 1e-12, []
        for axis in self.axes:
            shape = highlight * axis.white * axis.weight
            shape = shape - axis.matt @ (axis.matt.T @ shape)
            shapes.append(shape)
            along += float(shape @ axis.rest)
            square += float(shape @ shape)
        wanted = along / square
        strength = float(np.clip(wanted, *STRENGTHS))
        cost = sum(
            float(((axis.rest - strength * shape) ** 2).sum()) for axis, shape in zip(self.axes, shapes, strict=True)
        )
        short = np.maximum(self.missing - strength * highlight, 0.0)[self.clipped]
        cost += float(((short / (SHADING_ERROR * WHITE_LEVEL)) ** 2).sum())
        return HighlightFit(1.0 - cost / self.cost, strength, wanted != strength)

    def varnished(
        self, highlight: NDArray[np.float64], strength: float, ambient: Points, sun: NDArray[np.float64]
    ) -> HighlightFit:
        """Return the gain of ``highlight`` if the shading under it has no errors: as strict as ``metal``.

        ambient: (P, 3), sun: (P,) matt shading, their ratio free within ``METAL_RATIO``.
        """
        rest = np.concatenate([axis.values - strength * highlight * axis.white * axis.weight for axis in self.axes])
        level, ratio, bounded, cost = self._two_parts(rest, ambient, sun)
        there = level * float(self.colour.mean()) * (ambient.mean(axis=1) + ratio * sun) + strength * highlight
        return HighlightFit(1.0 - (cost + self._short(there)) / self.cost, level, bounded)

    def metal(self, sky: Points, sun: NDArray[np.float64]) -> HighlightFit:
        """Return the gain of a metal over matt shading: reflections ``sky`` (P, 3) and ``sun`` (P,) of a white mirror
        in the material's colour, their ratio free within ``METAL_RATIO``.

        strength: of both, over the colour.
        """
        level, ratio, bounded, cost = self._two_parts(np.concatenate([axis.values for axis in self.axes]), sky, sun)
        there = level * float(self.colour.mean()) * (sky.mean(axis=1) + ratio * sun)
        return HighlightFit(1.0 - (cost + self._short(there)) / self.cost, level, bounded)

    def _two_parts(
        self, values: NDArray[np.float64], ambient: Points, sun: NDArray[np.float64]
    ) -> tuple[float, float, bool, float]:
        """Level of ``ambient`` in the material's colour, of ``sun`` relative to it, whether that is bounded, the
        cost."""
        first, second = (
            np.concatenate([part @ (self.colour * axis.unit) * axis.weight for axis in self.axes])
            for part in (ambient, np.repeat(sun[:, None], 3, axis=1))
        )
        found = np.linalg.lstsq(np.column_stack([first, second]), values, rcond=None)[0]
        wanted = float(found[1]) / max(float(found[0]), 1e-6)
        ratio = float(np.clip(wanted, *METAL_RATIO))
        both = first + ratio * second
        level = max(float(both @ values), 0.0) / max(float(both @ both), 1e-12)
        return level, ratio, ratio != wanted, float(((values - level * both) ** 2).sum())

    def _short(self, there: NDArray[np.float64]) -> float:
        """Cost of saturated pixels that should be darker by the brightness ``there`` (P,)."""
        short = np.maximum(WHITE_LEVEL - there, 0.0)[self.clipped]
        return float(((short / (SHADING_ERROR * WHITE_LEVEL)) ** 2).sum())


def _axis(
    brightness: Points, unit: NDArray[np.float64], columns: list[NDArray[np.float64]], weight: NDArray[np.float64]
) -> _Axis:
    matrix = np.column_stack(columns) * weight[:, None]
    left, singular, _ = np.linalg.svd(matrix, full_matrices=False)
    basis = left[:, singular > 1e-6 * max(float(singular[0]), 1e-12)]
    weighted = (brightness @ unit) * weight
    return _Axis(unit, basis, weighted, weighted - basis @ (basis.T @ weighted), weight)


ROUGHNESSES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7, 0.8, 0.9, 1.0)
TILTS_DEG = (0.0, 5.0, 11.0)
"""Tilts of the sun from its estimate, because the normals of a guessed shape are inexact too."""
LEAST_PIXELS, LEAST_SHARE = 350, 0.4
"""Least pixels of one colour, and least share of the visible ones."""
LEAST_GAIN = 0.12
"""Least share of the matt residual that the highlight has to explain."""
LEAST_LEAD = 1.8
"""Least ratio to the gain of a sun from any other direction."""
CORRELATED = 9.0
"""Correlated pixels: neighbours share the shape's and the shading's errors."""
SIGNIFICANCE = 0.001
WIDEST = 0.2
"""Largest span of roughnesses that explain nearly as much."""
NEARLY = 0.9
LEAST_METAL = 0.5
"""Least share of the matt residual that a mirror has to explain, and more than a highlight does."""


@dataclass(frozen=True, eq=False)
class FitPixels:
    """P pixels of one object. brightness: (P, 3) linear, in the unit of ``LocalLighting``; clipped: (P,) saturated in
    the photo. normals, views: (P, 3) unit, views towards the camera. ambient: (P, 3), sun: (P,), reached: (P,),
    openness: (P,) as in ``Shading``.
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
    1.5; disc: unit vectors (D, 3) over its sun; colour: albedo (3,); gain: explained share (0 to 1)."""

    roughness: float
    metal: bool
    strength: float
    disc: Points
    colour: Points
    gain: float


def fit_reflectance(scene: LocalLighting, pixels: FitPixels) -> Reflectance | str:
    """Return the reflectance fitted to the highlights on ``pixels``, or the reason why there is none."""
    if scene.sun is None:
        return "no sun to make a highlight"
    if len(pixels.brightness) < LEAST_PIXELS:
        return "too few pixels"
    colour = most_common_colour(pixels.brightness, pixels.ambient + pixels.sun[:, None])
    chosen = colour.members | (pixels.clipped & (pixels.reached > 0.3))
    if chosen.sum() < max(LEAST_PIXELS, LEAST_SHARE * len(chosen)):
        return "too few pixels of one colour"
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
        roughness = _determined([fit.gain for fit in metals])
        if isinstance(roughness, str):
            return roughness
        return Reflectance(roughness, True, 1.0, disc, colour.albedo, metal)
    if best.gain < LEAST_GAIN:
        return f"no highlight stands out ({max(best.gain, 0.0):.0%} explained)"
    free = max((observed.count - observed.unknowns) / CORRELATED, 2.0)
    ratio = best.gain / 3.0 / max((1.0 - best.gain) / free, 1e-9)
    # scipy.stats takes half a second to import, which every command would pay; this is the same function.
    if special.fdtrc(3, free, ratio) > SIGNIFICANCE:
        return "the highlight could be chance"
    if best.bounded:
        return f"the bright part is not a highlight of this sun (strength {best.strength:.2g})"
    lobe = sun_lobe(scene, seen.normals, seen.views, ROUGHNESSES[at], DIELECTRIC_F0, turned) * seen.reached
    varnish = observed.varnished(lobe + ambient[at], best.strength, seen.ambient, seen.sun)
    if varnish.gain < metal:
        return "it may be a metal or varnish"
    rivals = [fitted(coarse @ t.T, i).gain for t in _elsewhere(scene.sun) for i in range(1, len(ROUGHNESSES), 3)]
    if best.gain < LEAST_LEAD * max(rivals, default=0.0):
        return "a sun from elsewhere would explain as much"
    roughness = _determined([fit.gain for fit in fits])
    if isinstance(roughness, str):
        return roughness
    return Reflectance(roughness, False, best.strength, turned, colour.albedo, best.gain)


def _determined(gains: list[float]) -> float | str:
    """The roughness determined by ``gains`` of all ``ROUGHNESSES``, or the reason why there is none."""
    best = max(gains)
    near = [r for r, gain in zip(ROUGHNESSES, gains, strict=True) if gain >= NEARLY * best]
    if max(near) - min(near) > WIDEST:
        return f"roughness {min(near):.2g} to {max(near):.2g} fits alike"
    weights = np.array([max(gain - NEARLY * best, 0.0) for gain in gains])
    return float((weights * ROUGHNESSES).sum() / weights.sum())


def _part(pixels: FitPixels, chosen: NDArray[np.bool_]) -> FitPixels:
    return FitPixels(*(getattr(pixels, name)[chosen] for name in FitPixels.__dataclass_fields__))


def _tilts(sun: Points) -> list[Points]:
    """Rotations (3, 3) that tilt the sun a little, in all directions."""
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
    """Rotations (3, 3) of the sun about the vertical, by 40° and more unless it is overhead."""
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
