# SPDX-License-Identifier: MIT
"""How bright the ground is where sun and sky reach it, and how much of its light is the sun's.

In the photo the ground has brightness  I = ρ ((1 − q) (1 − k (1 − V)) + q v):  ρ its colour in open light, V and v the
shares of the sky and of the sun that reach it past the objects, q the sun's share of the light on open ground, and k
how much of the lost sky is really lost, for the objects' own light fills in. ρ is smooth but for its texture, so the
logarithm of I is fitted by a quadratic over the ground plus that of the bracket, by Gauss-Newton steps with Huber's
weights: texture is noise to it, and what is no ground at all counts little. The ground's colour, shaded or lit, drops
out, and what takes light all around a contact, as any soft sky does, is not taken for sun.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

SKY_LOSS = 0.85
"""k before the photo is asked: objects of middling colour give back some 15 % of what they hide."""
MAX_SHARE = 0.952
"""Of the sun: 20 times the sky."""
HUBER = 1.5


@dataclass(frozen=True)
class GroundLight:
    """How the ground's light is shared out.

    share: q, of the sun, 0 to 1. sky_loss: k. cost: how badly it fits, 0 to 1. residual: (N,) of log brightness.
    """

    share: float
    sky_loss: float
    cost: float
    residual: Values


def smooth_terms(ground: Values) -> Values:
    """Quadratic in the plane's coordinates (N, 2), about their middle and over their extent: (N, 6)."""
    x, y = ((ground - ground.mean(axis=0)) / max(float(np.ptp(ground, axis=0).max()), 1e-12)).T
    return np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])


def fit_ground(
    brightness: Values, terms: Values, sky: Values, sun: Values | None, scale: float, rounds: int = 4
) -> GroundLight:
    """Share out the light of the ground.

    brightness: (N,) natural logarithm; terms: (N, 6) of ``smooth_terms``; sky, sun: V and v (N,), no sun: None.
    scale: of the residuals that texture leaves. rounds: of Gauss and Newton.
    """
    share, loss = (0.4 if sun is not None else 0.0), SKY_LOSS
    direct = np.zeros_like(sky) if sun is None else sun
    hidden = 1.0 - sky
    count = len(brightness)
    # What is known beforehand, as if so many points had said it: a little, or colour could pass for curvature.
    prior = count * np.diag([0.0, 0.002, 0.002, 0.01, 0.01, 0.01, 0.0, 0.005])
    smooth = np.zeros(terms.shape[1])
    smooth[0] = float(np.median(brightness))
    residual = np.zeros(count)
    for _ in range(rounds):
        ambient = 1.0 - loss * hidden
        bracket = np.maximum((1.0 - share) * ambient + share * direct, 1e-3)
        residual = brightness - terms @ smooth - np.log(bracket)
        weight = np.minimum(1.0, HUBER * scale / np.maximum(np.abs(residual), 1e-9))
        rows = np.column_stack([terms, (direct - ambient) / bracket, -(1.0 - share) * hidden / bracket])
        if sun is None:
            rows[:, -2] = 0.0
        weighted = rows * weight[:, None]
        known = np.array([0.0, *(-smooth[1:]), 0.0, SKY_LOSS - loss])
        left = rows.T @ weighted + prior + 1e-9 * count * np.eye(rows.shape[1])
        step = np.linalg.solve(left, weighted.T @ residual + prior @ known)
        smooth = smooth + step[:-2]
        share = float(np.clip(share + np.clip(step[-2], -0.3, 0.3), 0.0, MAX_SHARE))
        loss = float(np.clip(loss + np.clip(step[-1], -0.3, 0.3), 0.2, 1.2))
    bracket = np.maximum((1.0 - share) * (1.0 - loss * hidden) + share * direct, 1e-3)
    residual = brightness - terms @ smooth - np.log(bracket)
    off = (residual / (2.5 * scale)) ** 2
    return GroundLight(share=share, sky_loss=loss, cost=float(np.mean(off / (1.0 + off))), residual=residual)
