# SPDX-License-Identifier: MIT
"""Rotations of many bodies at once. Quaternions (..., 4), w first; rotation vectors (..., 3), world axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def product(p: Array, q: Array) -> Array:
    """Turn by ``q``, then by ``p``."""
    w, v = p[..., :1], p[..., 1:]
    a, b = q[..., :1], q[..., 1:]
    return np.concatenate([w * a - np.sum(v * b, axis=-1, keepdims=True), w * b + a * v + np.cross(v, b)], axis=-1)


def inverse(q: Array) -> Array:
    """The turn back."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def from_vector(way: Array) -> Array:
    """Quaternion of a rotation vector."""
    angle = np.linalg.norm(way, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * np.pi)) * way], axis=-1)


def to_vector(q: Array) -> Array:
    """Rotation vector, the short way round."""
    q = np.where(q[..., :1] < 0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    return np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0) * q[..., 1:]


def to_matrix(q: Array) -> Array:
    """Rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def skew(v: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with ``v``."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack(r, axis=-1) for r in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=-2)


def moved(states: Array, change: Array) -> Array:
    """States (..., 13) after small changes (..., 12): shift, turn, velocity, spin."""
    return np.concatenate(
        [
            states[..., :3] + change[..., :3],
            product(from_vector(change[..., 3:6]), states[..., 3:7]),
            states[..., 7:13] + change[..., 6:12],
        ],
        axis=-1,
    )


def between(a: Array, b: Array) -> Array:
    """The change (..., 12) from states ``a`` to states ``b``."""
    turn = to_vector(product(b[..., 3:7], inverse(a[..., 3:7])))
    return np.concatenate([b[..., :3] - a[..., :3], turn, b[..., 7:13] - a[..., 7:13]], axis=-1)
