# SPDX-License-Identifier: MIT
"""How far a correct model of a soft body would still miss: camera noise, and cells, of which two lattices tell."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEVELS = (0.12, 0.2, 0.35, 0.6, 1.0, 1.7, 2.9)
"""Levels of model error, relative to the expected one, over which the evidence is summed. Where both lattices are far
apart, what a candidate leaves may say that the finer one is better than that."""

LEVEL_SPREAD = 0.6
"""Prior standard deviation of the log model error about the expected one."""


DRIFT_SHARE, RINGING_SHARE = 1.0, 1.1
"""Model error of the fine lattice over what Richardson's extrapolation makes of the difference between both lattices,
calibrated on bodies of known motion."""

NOISE_KNOWN = 1.1
"""Factor within which the stated noise of a coordinate is known."""

LEAST_DRIFT, LEAST_RINGING = 0.006, 1e-4
"""Lower bounds in m/s and m."""


@dataclass(frozen=True, kw_only=True)
class ModelError:
    """Standard deviations of the model error after contact: drift in m/s, ringing in m."""

    drift: float
    ringing: float

    def times(self, level: float) -> ModelError:
        """Return the model error scaled by ``level``."""
        return ModelError(drift=level * self.drift, ringing=level * self.ringing)


@dataclass(frozen=True, kw_only=True)
class Whitened:
    """Whitened trial: residuals over s, error modes over s, and the log determinant of the covariance."""

    scale: Array
    modes: Array
    core: Array
    log_det: float

    def inner(self, a: Array, b: Array) -> Array:
        """Return a^T C^-1 b of raw vectors (n,) or (n, m)."""
        u, v = self._scaled(a), self._scaled(b)
        return np.asarray(u.T @ v - (self.modes.T @ u).T @ np.linalg.solve(self.core, self.modes.T @ v))

    def _scaled(self, a: Array) -> Array:
        return np.asarray(a / (self.scale if a.ndim == 1 else self.scale[:, None]))


def whiten(
    points: Array, since: Array, seen: NDArray[np.bool_], *, noise: float, model_error: ModelError, size: float
) -> Whitened:
    """Return the covariance of coordinates ``seen`` (T, K) of ``points`` (T, K, 3), ``since`` (T,) s after contact."""
    late = np.maximum(since, 0.0)
    s = np.sqrt(noise**2 + (model_error.ringing * (late > 0)) ** 2)
    scale = np.repeat(np.broadcast_to(s[:, None], seen.shape)[seen], 3)
    modes = model_error.drift * modes_of(points, late, seen, size) / scale[:, None]
    core = np.eye(6) + modes.T @ modes
    log_det = 2 * float(np.log(scale).sum()) + float(np.linalg.slogdet(core)[1])
    return Whitened(scale=scale, modes=modes, core=core, log_det=log_det)


def modes_of(points: Array, late: Array, seen: NDArray[np.bool_], size: float) -> Array:
    """Return error modes (n, 6): displacement of coordinates ``seen`` (T, K) per m/s of linear and angular drift."""
    away = (points - points.mean(axis=1, keepdims=True)) / size
    columns = []
    for axis in np.eye(3):
        columns.append(np.broadcast_to(late[:, None, None] * axis, points.shape)[seen].ravel())
        columns.append((late[:, None, None] * np.cross(axis, away))[seen].ravel())
    return np.stack(columns, axis=1)


def model_error_between(
    fine: list[Array], coarse: list[Array], since: list[Array], size: float, *, extrapolated: float
) -> ModelError:
    """Return the model error from motions (T, K, 3) at two resolutions, ``since`` (T,) s after contact, by trial.

    extrapolated: error of the finer one over their difference (``body_mesh.extrapolated``).
    """
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
        return ModelError(drift=0.02, ringing=5e-4)
    return ModelError(
        drift=max(LEAST_DRIFT, DRIFT_SHARE * extrapolated * math.sqrt(float(np.median(drifts)))),
        ringing=max(LEAST_RINGING, RINGING_SHARE * extrapolated * math.sqrt(float(np.median(rings)))),
    )


def modulus_between(fine: list[Array], coarse: list[Array], stiffer: list[Array], change: float) -> float:
    """Return the change of log modulus that makes most of the difference of ``fine`` and ``coarse`` motions (T, K, 3).

    stiffer: the fine ones with the log modulus raised by ``change``.
    """
    along, against = 0.0, 0.0
    for a, b, c in zip(fine, coarse, stiffer, strict=True):
        slope, difference = (c - a) / change, b - a
        known = np.isfinite(slope) & np.isfinite(difference)
        along += float((slope[known] * difference[known]).sum())
        against += float((slope[known] ** 2).sum())
    return along / against if against > 0 else 0.0


def misfit_left_open(model_error: ModelError, noise: float) -> float:
    """Return the misfit above which the right candidate leaves one in six times: its model error is not known better.

    ``noise``: of a coordinate, m. The level of the model error is one standard deviation above the expected one, and
    the noise is as large as it may be.
    """
    error, level = model_error.ringing / noise, math.exp(LEVEL_SPREAD)
    return math.hypot(NOISE_KNOWN, level * error) / math.hypot(1.0, error)


def log_prior_of_level(level: float) -> float:
    """Return the log prior of one of ``LEVELS``."""
    weights = [math.exp(-0.5 * (math.log(x) / LEVEL_SPREAD) ** 2) for x in LEVELS]
    return -0.5 * (math.log(level) / LEVEL_SPREAD) ** 2 - math.log(sum(weights))
