# SPDX-License-Identifier: MIT
"""How far a model that is right would still miss: the camera's noise, and the model's own grain after contact.

After an impact even two resolutions of one model part: the body leaves a little faster and with a little more spin,
and rings out of step. With the grain g, in m/s, a take's residual has the covariance

    s(t)² 1 + sum over 6 modes of B B^T,    s² = noise² + (RINGING g)² after contact,

three modes of drift, B = g (t - t0), and three of turning, B = (g / R) (t - t0) e x (p - c), R the body's size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RINGING = 0.06
"""Seconds: error of the deformation over that of the velocity. Larger than its size, since it lasts for many frames."""

LEVELS = (0.35, 0.6, 1.0, 1.7, 2.9)
"""Grains that are tried, over the expected one; see ``LEVEL_SPREAD``."""

LEVEL_SPREAD = 0.6
"""Standard deviation of the grain's logarithm about the expected one."""


@dataclass(frozen=True, kw_only=True)
class Whitened:
    """One take under a grain: residuals divided by s, modes divided by s, and the log determinant of all of it."""

    scale: Array
    modes: Array
    core: Array
    log_det: float

    def inner(self, a: Array, b: Array) -> Array:
        """a^T C^-1 b of raw vectors (n,) or (n, m)."""
        u, v = self._scaled(a), self._scaled(b)
        return np.asarray(u.T @ v - (self.modes.T @ u).T @ np.linalg.solve(self.core, self.modes.T @ v))

    def _scaled(self, a: Array) -> Array:
        return np.asarray(a / (self.scale if a.ndim == 1 else self.scale[:, None]))


def whiten(
    points: Array, since: Array, seen: NDArray[np.bool_], *, noise: float, grain: float, size: float
) -> Whitened:
    """Covariance of the coordinates ``seen`` (T, K) of ``points`` (T, K, 3), ``since`` (T,) s after first contact."""
    late = np.maximum(since, 0.0)
    s = np.sqrt(noise**2 + (RINGING * grain * (late > 0)) ** 2)
    scale = np.repeat(np.broadcast_to(s[:, None], seen.shape)[seen], 3)
    centre = points.mean(axis=1, keepdims=True)
    columns = []
    for axis in np.eye(3):
        drift = np.broadcast_to(grain * late[:, None, None] * axis, points.shape)
        turning = (grain / size) * late[:, None, None] * np.cross(axis, points - centre)
        columns += [drift[seen].ravel(), turning[seen].ravel()]
    modes = np.stack(columns, axis=1) / scale[:, None]
    core = np.eye(6) + modes.T @ modes
    log_det = 2 * float(np.log(scale).sum()) + float(np.linalg.slogdet(core)[1])
    return Whitened(scale=scale, modes=modes, core=core, log_det=log_det)


def log_prior_of_level(level: float) -> float:
    """Log probability of one of ``LEVELS``."""
    weights = [math.exp(-0.5 * (math.log(x) / LEVEL_SPREAD) ** 2) for x in LEVELS]
    return -0.5 * (math.log(level) / LEVEL_SPREAD) ** 2 - math.log(sum(weights))
