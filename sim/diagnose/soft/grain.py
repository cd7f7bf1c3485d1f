# SPDX-License-Identifier: MIT
"""How far a model that is right would still miss: the camera's noise, and the model's own grain after contact.

After an impact even two resolutions of one model part: the body leaves a little faster and with a little more spin,
and rings out of step. With a grain of drift g, in m/s, and of ringing r, in m, a take's residual has the covariance

    s(t)² 1 + sum over 6 modes of B B^T,    s² = noise² + r² after contact,

three modes of drift, B = g (t - t0), and three of turning, B = (g / R) (t - t0) e x (p - c), R the body's size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEVELS = (0.35, 0.6, 1.0, 1.7, 2.9)
"""Grains that are tried, over the expected one; see ``LEVEL_SPREAD``."""

LEVEL_SPREAD = 0.6
"""Standard deviation of the grain's logarithm about the expected one."""


DRIFT_SHARE, RINGING_SHARE = 0.8, 0.9
"""Grain over the difference between a lattice and one whose cells are half as large again, measured on bodies whose
truth was known; what is left of it at the finer one."""

LEAST_DRIFT, LEAST_RINGING = 0.006, 1e-4
"""m/s and m: no model of a contact is better."""


@dataclass(frozen=True, kw_only=True)
class Grain:
    """drift in m/s, ringing in m."""

    drift: float
    ringing: float

    def times(self, level: float) -> Grain:
        """``level`` times as coarse."""
        return Grain(drift=level * self.drift, ringing=level * self.ringing)


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
    points: Array, since: Array, seen: NDArray[np.bool_], *, noise: float, grain: Grain, size: float
) -> Whitened:
    """Covariance of the coordinates ``seen`` (T, K) of ``points`` (T, K, 3), ``since`` (T,) s after first contact."""
    late = np.maximum(since, 0.0)
    s = np.sqrt(noise**2 + (grain.ringing * (late > 0)) ** 2)
    scale = np.repeat(np.broadcast_to(s[:, None], seen.shape)[seen], 3)
    modes = grain.drift * modes_of(points, late, seen, size) / scale[:, None]
    core = np.eye(6) + modes.T @ modes
    log_det = 2 * float(np.log(scale).sum()) + float(np.linalg.slogdet(core)[1])
    return Whitened(scale=scale, modes=modes, core=core, log_det=log_det)


def modes_of(points: Array, late: Array, seen: NDArray[np.bool_], size: float) -> Array:
    """(n, 6): how coordinates ``seen`` (T, K) have moved at ``late`` (T,) s for 1 m/s of drift and of turning."""
    away = (points - points.mean(axis=1, keepdims=True)) / size
    columns = []
    for axis in np.eye(3):
        columns.append(np.broadcast_to(late[:, None, None] * axis, points.shape)[seen].ravel())
        columns.append((late[:, None, None] * np.cross(axis, away))[seen].ravel())
    return np.stack(columns, axis=1)


def grain_between(fine: list[Array], coarse: list[Array], since: list[Array], size: float) -> Grain:
    """The grain from two resolutions' motions of all takes, (T, K, 3) each, ``since`` (T,) s after first contact."""
    drifts, rings = [], []
    for a, b, t in zip(fine, coarse, since, strict=True):
        seen = np.isfinite(a).all(axis=2) & np.isfinite(b).all(axis=2) & (t > 0)[:, None]
        if seen.sum() < 4:
            continue
        modes, difference = modes_of(a, np.maximum(t, 0.0), seen, size), (a - b)[seen].ravel()
        amounts = np.linalg.lstsq(modes, difference, rcond=None)[0]
        drifts.append(float((amounts**2).mean()))
        rings.append(float(((difference - modes @ amounts) ** 2).mean()))
    if not drifts:
        return Grain(drift=0.02, ringing=5e-4)
    return Grain(
        drift=max(LEAST_DRIFT, DRIFT_SHARE * math.sqrt(float(np.median(drifts)))),
        ringing=max(LEAST_RINGING, RINGING_SHARE * math.sqrt(float(np.median(rings)))),
    )


def log_prior_of_level(level: float) -> float:
    """Log probability of one of ``LEVELS``."""
    weights = [math.exp(-0.5 * (math.log(x) / LEVEL_SPREAD) ** 2) for x in LEVELS]
    return -0.5 * (math.log(level) / LEVEL_SPREAD) ** 2 - math.log(sum(weights))
