# SPDX-License-Identifier: MIT
"""Unit quaternions (..., 4), w first; rotation vectors (..., 3) in world axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def multiply(p: Array, q: Array) -> Array:
    """Return the rotation by ``q``, then by ``p``."""
    out = np.empty(np.broadcast_shapes(p.shape, q.shape))
    a, b, c, d = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out[..., 0] = a * w - b * x - c * y - d * z
    out[..., 1] = a * x + b * w + c * z - d * y
    out[..., 2] = a * y - b * z + c * w + d * x
    out[..., 3] = a * z + b * y - c * x + d * w
    return out


def conjugate(q: Array) -> Array:
    """Return the inverse rotation."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def from_rotvec(way: Array) -> Array:
    """Return the quaternion of a rotation vector."""
    angle = np.linalg.norm(way, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * way], axis=-1)


def as_rotvec(q: Array) -> Array:
    """Return the shortest rotation vector."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0) * q[..., 1:]


def as_matrix(q: Array) -> Array:
    """Return rotation matrices (..., 3, 3)."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return out


def skew(v: Array) -> Array:
    """Return cross product matrices (..., 3, 3) of ``v``."""
    out = np.zeros((*v.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -v[..., 0], -v[..., 1], -v[..., 2]
    return out
