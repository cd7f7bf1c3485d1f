# SPDX-License-Identifier: MIT
"""How much of a photo a supposed highlight explains beyond matt shading, by least squares.

Each pixel of one colour is looked at along two axes of colour: that of the matter, where shading and highlight add, and
aside from it towards white, where matt light is nothing and the highlight alone remains. Along the first, shading may
err smoothly with the normal; what is linear is solved for exactly (variable projection, Golub and Pereyra 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .one_colour import WHITE

Points = NDArray[np.float64]

STRENGTHS = (0.3, 3.0)
"""Of a highlight over what an index of 1.5 gives under a white ground that is just white in the photo."""
METAL_RATIO = (0.4, 2.5)
"""Of the sun in a metal over the sky in it, beside what the light's estimate says."""
LEAST_TINT = 0.12
"""Sine between the colour and white, below which there is no looking aside."""
SHADING_ERROR, NOISE = 0.06, 0.006
"""Of matt shading, relative; of pixels, in brightness."""
WHITE_LEVEL = 0.97


@dataclass(frozen=True)
class HighlightFit:
    """gain: share (0 to 1) of what matt shading left that the highlight explains; strength: its factor; bounded:
    whether that is at an end of ``STRENGTHS``, where more or less would fit better."""

    gain: float
    strength: float
    bounded: bool


@dataclass(frozen=True, eq=False)
class _Axis:
    """One axis of colour, a unit vector (3,): weighted orthonormal matt shading (P, K), the weighted values (P,), what
    matt shading leaves of them (P,), and the weights (P,)."""

    unit: NDArray[np.float64]
    matt: Points
    values: NDArray[np.float64]
    rest: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def white(self) -> float:
        """White light along the axis."""
        return float(self.unit.sum())


@dataclass(frozen=True, eq=False)
class Observed:
    """Pixels that highlights are fitted to; make it with ``of``."""

    axes: tuple[_Axis, ...]
    colour: NDArray[np.float64]
    clipped: NDArray[np.bool_]
    missing: NDArray[np.float64]
    cost: float
    unknowns: int

    @property
    def count(self) -> int:
        """Numbers that are explained."""
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
        """``brightness`` (P, 3) of pixels whose albedo is about ``colour`` (3,); the rest as in ``FitPixels``."""
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
            # Where matt light is hardly any, its error is small as well.
            sure = use / np.hypot(0.35 * SHADING_ERROR * level, NOISE)
            coloured = [ambient @ (aside * unit), shading * float(unit @ aside) + ambient.mean(axis=1), sun]
            axes.append(_axis(brightness, aside, coloured, sure))
        missing = np.zeros(len(brightness))
        missing[clipped] = np.maximum(WHITE_LEVEL - (ambient @ (colour / 3.0) + sun * colour.mean())[clipped], 0.0)
        cost = sum(float((axis.rest**2).sum()) for axis in axes)
        cost += float(((missing[clipped] / (SHADING_ERROR * WHITE_LEVEL)) ** 2).sum())
        return cls(tuple(axes), colour, clipped, missing, max(cost, 1e-12), sum(axis.matt.shape[1] for axis in axes))

    def fit(self, highlight: NDArray[np.float64], sharp: NDArray[np.float64]) -> HighlightFit:
        """The best strength of ``highlight`` (P,), of which ``sharp`` (P,) is the sun's part, and what it explains."""
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
        """What ``highlight`` explains when the shading under it may not err: as strict as ``metal``.

        ambient: (P, 3), sun: (P,) matt shading, their ratio free within ``METAL_RATIO``.
        """
        rest = np.concatenate([axis.values - strength * highlight * axis.white * axis.weight for axis in self.axes])
        level, ratio, bounded, cost = self._two_parts(rest, ambient, sun)
        there = level * float(self.colour.mean()) * (ambient.mean(axis=1) + ratio * sun) + strength * highlight
        return HighlightFit(1.0 - (cost + self._short(there)) / self.cost, level, bounded)

    def metal(self, sky: Points, sun: NDArray[np.float64]) -> HighlightFit:
        """What a metal explains beyond matt shading: reflections ``sky`` (P, 3) and ``sun`` (P,) of a white mirror in
        the colour of the matter, the ratio of both free within ``METAL_RATIO``. strength: of both, over the colour.
        """
        level, ratio, bounded, cost = self._two_parts(np.concatenate([axis.values for axis in self.axes]), sky, sun)
        there = level * float(self.colour.mean()) * (sky.mean(axis=1) + ratio * sun)
        return HighlightFit(1.0 - (cost + self._short(there)) / self.cost, level, bounded)

    def _two_parts(
        self, values: NDArray[np.float64], ambient: Points, sun: NDArray[np.float64]
    ) -> tuple[float, float, bool, float]:
        """Level of ``ambient`` in the matter's colour, of ``sun`` over it, whether that is bounded, the cost."""
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
        """Cost of white pixels that should be darker by the brightness ``there`` (P,)."""
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
