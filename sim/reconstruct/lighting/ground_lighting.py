# SPDX-License-Identifier: MIT
"""Light on the ground plane: cast shadows, and the shares of sun and sky in its brightness.

A shadow on a plane is a parallel projection, so it is rasterised from above in the plane's own coordinates: points of
the objects' surfaces slide down along the light onto a grid. Perspective enters only when the grid is sampled.

The ground has brightness  I = ρ ((1 − q) (1 − k (1 − V)) + q v):  ρ its colour in open light, V and v the shares of
the sky and of the sun that reach it past the objects, q the sun's share of the light on open ground, and k how much of
the occluded sky is really lost, since the objects reflect light too. ρ is smooth but for its texture, so log I is
fitted by a quadratic over the ground plus the log of the bracket, by Gauss-Newton steps with Huber weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

CELLS = 320
"""Cells along the grid's longer side; an object is about fifty of them large."""
SURFACE_POINTS = 16_000
"""Surface points on each object: several per cell, even in a shadow three times as long as the object is high."""
MIN_COSINE = 0.1
"""Cosine of the lowest light: below 6° shadows are longer than the ground that is examined."""


def surface_points(vertices: Points, faces: NDArray[np.integer], count: int = SURFACE_POINTS) -> Points:
    """Return points (count, 3) evenly over the surface of ``vertices`` (V, 3), ``faces`` (T, 3); deterministic."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    random = np.random.default_rng(0)
    if not area.sum() > 0:
        return np.asarray(vertices[random.integers(0, len(vertices), count)])
    chosen = random.choice(len(faces), count, p=area / area.sum())
    u, v = random.random((2, count, 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return np.asarray(a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen])


MARGIN = 4
"""Cells around a shadow to which it cannot spread when it is closed and blurred."""
_CLOSING = np.ones((3, 3), np.uint8)


class ShadowCaster:
    """Shadows of surfaces at points of the ground, the plane z = 0."""

    def __init__(self, surfaces: Sequence[Points], ground: Points) -> None:
        """surfaces: points (M, 3) on each object. ground: points (N, 2) to evaluate."""
        surface = np.concatenate(surfaces)
        self._surface = np.stack([surface[:, 0], surface[:, 1], np.maximum(surface[:, 2], 0.0)])
        self._ground = ground
        low, high = ground.min(axis=0), ground.max(axis=0)
        self._cell = max(float((high - low).max()) / CELLS, 1e-12)
        self._low = low - 2 * self._cell
        self._shape = tuple(int(v) for v in np.ceil((high - low) / self._cell)[::-1] + 5)
        at = ((ground - self._low) / self._cell - 0.5).astype(np.float32)
        # OpenCV remaps at most 32767 points a row.
        self._count, columns = len(at), 1024
        padded = -(-max(self._count, 1) // columns) * columns
        x, y = (np.pad(at[:, i], (0, padded - self._count)).reshape(-1, columns) for i in (0, 1))
        self._x, self._y = x, y

    def thinned(self, index: NDArray[np.int64], step: int) -> ShadowCaster:
        """Return a faster one for the ground points ``index``, with every ``step``-th surface point."""
        return ShadowCaster([self._surface[:, ::step].T], self._ground[index])

    def _add_shadow(self, direction: Points, share: np.float32, to: NDArray[np.float32]) -> None:
        """Add ``share`` times the shadow of light from the unit vector ``direction`` (3,), 1 inside, to the grid
        ``to`` (rows, columns)."""
        rows, columns = self._shape
        x, y, z = self._surface
        slide = direction[:2] / direction[2]
        column = x - z * slide[0]
        column -= self._low[0]
        column /= self._cell
        row = y - z * slide[1]
        row -= self._low[1]
        row /= self._cell
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        row, column = row[inside].astype(np.int32), column[inside].astype(np.int32)
        if not len(row):
            return
        # Only the part of the grid around it; beyond, there is nothing to close or blur.
        top, left = max(0, int(row.min()) - MARGIN), max(0, int(column.min()) - MARGIN)
        part = slice(top, int(row.max()) + 1 + MARGIN), slice(left, int(column.max()) + 1 + MARGIN)
        shadow = np.zeros(to[part].shape, dtype=np.uint8)
        shadow[row - top, column - left] = 1
        closed = cv2.morphologyEx(shadow, cv2.MORPH_CLOSE, _CLOSING)
        # Smooth the stair-steps of the cells.
        to[part] += share * cv2.blur(closed.astype(np.float32), (3, 3))

    def reaching(self, directions: Points, weights: Points) -> NDArray[np.float64]:
        """Return the share (N,) of light from unit vectors ``directions`` (D, 3) that reaches the points past the
        objects.

        weights: (D,) irradiance of each on open ground; light from below 6° is ignored.
        """
        use = (directions[:, 2] >= MIN_COSINE) & (weights > 0)
        if not use.any():
            return np.ones(self._count)
        shares = weights[use] / weights[use].sum()
        blocked = np.zeros(self._shape, dtype=np.float32)
        for direction, share in zip(directions[use], shares, strict=True):
            self._add_shadow(direction, np.float32(share), blocked)
        seen = cv2.remap(blocked, self._x, self._y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return 1.0 - np.clip(seen.reshape(-1)[: self._count].astype(np.float64), 0.0, 1.0)


def sun_disc(direction: Points, angle: float, count: int) -> tuple[Points, Points]:
    """Return unit vectors (count, 3) over a sun of diameter ``angle`` (rad) about ``direction`` (3,), and their
    weights.

    Evenly over a flat disc, as in Cycles (radius tan(angle / 2), intern/cycles/kernel/light/distant.h), in sunflower
    order; a weight is the cosine on the ground.
    """
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(helper, direction)
    first /= np.linalg.norm(first)
    second = np.cross(direction, first)
    number = np.arange(count)
    radius = math.tan(min(angle, 2.8) / 2.0) * np.sqrt((number + 0.5) / count)
    turn = number * math.pi * (3.0 - math.sqrt(5.0))
    found = direction + radius[:, None] * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found, np.maximum(found[:, 2], 0.0)


def overcast_sky(count: int = 160) -> tuple[Points, Points]:
    """Return unit vectors (count, 3) over an overcast sky and their weights (count,) on the ground.

    Three times as bright at the zenith as at the horizon (CIE overcast sky, CIE S 011); cosine-distributed, in
    sunflower order.
    """
    number = np.arange(count)
    height = np.sqrt(1.0 - (number + 0.5) / count)
    turn = number * math.pi * (3.0 - math.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height]), 1.0 + 2.0 * height


Values = NDArray[np.float64]

SKY_LOSS = 0.85
"""Prior of k: objects of middling colour reflect some 15 % of the light they block."""
MAX_SHARE = 6.0 / 7.0
"""Largest share of all lamps together: six times the sky, about what a clear noon gives open ground. A darker shadow
shows its camera's tone curve and the objects' own reflections rather than a stronger lamp."""
HUBER = 1.5


@dataclass(frozen=True)
class GroundLight:
    """Shares of the ground's light.

    shares: q of each lamp, 0 to 1, together at most ``MAX_SHARE``. sky_loss: k. cost: misfit, 0 to 1. residual: (N,) of
    log brightness.
    """

    shares: tuple[float, ...]
    sky_loss: float
    cost: float
    residual: Values


def smooth_terms(ground: Values, extent: float | None = None) -> Values:
    """Return the quadratic terms (N, 6) of the plane's coordinates (N, 2), about their middle and over ``extent``, by
    default theirs."""
    over = float(np.ptp(ground, axis=0).max()) if extent is None else extent
    x, y = ((ground - ground.mean(axis=0)) / max(over, 1e-12)).T
    return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])


def fit_ground_light(
    brightness: Values, terms: Values, sky: Values, lamps: Sequence[Values], scale: float, rounds: int = 4
) -> GroundLight:
    """Fit the shares of sky and lamps in the light of the ground.

    brightness: (N,) natural logarithm; terms: (N, 6) of ``smooth_terms``; sky, lamps: V and the v of each lamp, (N,).
    scale: of the residuals due to texture. rounds: Gauss-Newton steps.
    """
    count, number = len(brightness), len(lamps)
    shares, loss = np.full(number, 0.4 / max(number, 1)), SKY_LOSS
    direct = np.stack([*lamps]) if lamps else np.zeros((0, count))
    hidden = 1.0 - sky
    # A weak prior in units of points, or colour could pass for curvature.
    prior = count * np.diag([0.0, 0.002, 0.002, 0.01, 0.01, 0.01, *np.zeros(number), 0.005])
    smooth = np.zeros(terms.shape[1])
    smooth[0] = float(np.median(brightness))
    residual = np.zeros(count)

    def light() -> tuple[Values, Values]:
        ambient = 1.0 - loss * hidden
        return ambient, np.maximum((1.0 - shares.sum()) * ambient + shares @ direct, 1e-3)

    for _ in range(rounds):
        ambient, bracket = light()
        residual = brightness - terms @ smooth - np.log(bracket)
        weight = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(residual), 1e-9))
        rows = np.column_stack([terms, ((direct - ambient) / bracket).T, -(1.0 - shares.sum()) * hidden / bracket])
        weighted = rows * weight[:, None]
        known = np.array([0.0, *(-smooth[1:]), *np.zeros(number), SKY_LOSS - loss])
        left = rows.T @ weighted + prior + 1e-9 * count * np.eye(rows.shape[1])
        step = np.linalg.solve(left, weighted.T @ residual + prior @ known)
        smooth = smooth + step[: len(smooth)]
        shares = np.clip(shares + np.clip(step[len(smooth) : -1], -0.3, 0.3), 0.0, MAX_SHARE)
        shares = shares * min(1.0, MAX_SHARE / max(float(shares.sum()), 1e-9))
        loss = float(np.clip(loss + np.clip(step[-1], -0.3, 0.3), 0.2, 1.2))
    residual = brightness - terms @ smooth - np.log(light()[1])
    off = (residual / (2.5 * scale)) ** 2
    return GroundLight(
        shares=tuple(float(share) for share in shares),
        sky_loss=loss,
        cost=float(np.mean(off / (1.0 + off))),
        residual=residual,
    )
