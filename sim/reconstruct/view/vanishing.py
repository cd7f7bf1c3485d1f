# SPDX-License-Identifier: MIT
"""How well a camera's pose explains a photo's straight segments.

The world is taken to have one up, and on the ground one or more frames of two directions at right angles, each turned
by an azimuth of its own (Coughlan & Yuille, ICCV 1999, for one frame; Schindler & Dellaert, CVPR 2004, for several).
Each segment points to one of the vanishing points that these have, up to a normal error of its direction in the photo,
or to none of them.

A state is (log f, pitch, roll, azimuth, azimuth, …), in radians and log of pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from .camera import camera_from_world
from .segments import Segments

Array = NDArray[np.float64]

STRAY = (0.25, 0.5, 0.75, 0.92, 1.0)
"""Shares of segments that point nowhere in particular, all held possible; 1 is a photo whose lines say nothing."""
UPRIGHT = 0.35
"""Share of upright ones among the others."""
CHUNK = 2_000_000
"""Numbers held at once for a table of states × segments × directions."""
HATCH_DEG = 6.0
"""Strokes and grain run in one direction of the photo, about so exactly: that alone says nothing about the camera."""


def world_directions(states: Array) -> Array:
    """Up, and two directions for each frame, as the camera sees them: (S, 1 + 2 F, 3) for ``states`` (S, 3 + F)."""
    axes = camera_from_world(states[:, 1], states[:, 2])
    right, away, up = axes[..., 0], axes[..., 1], axes[..., 2]
    found = [up]
    for azimuth in states[:, 3:].T:
        c, s = np.cos(azimuth)[:, None], np.sin(azimuth)[:, None]
        found += [c * right + s * away, c * away - s * right]
    return np.stack(found, axis=1)


def misses(states: Array, segments: Segments) -> Array:
    """Sine of the angle (S, N, 1 + 2 F) between each segment and the line from its middle to each vanishing point."""
    directions = world_directions(states)
    focal = np.exp(states[:, 0])[:, None]
    x, y = segments.middle.T
    u, v = segments.direction.T
    depth = directions[..., 2]
    # Towards the vanishing point: (f dx − x dz, f dy − y dz), for each state, segment and direction.
    tx = (focal * directions[..., 0])[:, None, :] - x[None, :, None] * depth[:, None, :]
    ty = (focal * directions[..., 1])[:, None, :] - y[None, :, None] * depth[:, None, :]
    return (u[None, :, None] * ty - v[None, :, None] * tx) / np.maximum(np.hypot(tx, ty), 1e-9)


def _shares(frames: int) -> Array:
    """How often a segment that points somewhere points to each direction (1 + 2 F,)."""
    return np.array([1.0]) if frames == 0 else np.array([UPRIGHT] + [(1.0 - UPRIGHT) / (2 * frames)] * (2 * frames))


def background_density(segments: Segments) -> Array:
    """Density (N,) per radian of each segment's direction in the photo, were it to point nowhere in particular.

    Half even, half as the photo's other segments run, smoothed by HATCH_DEG: hatching is explained by this already, and
    only lines that converge as they should are explained better by a vanishing point.
    """
    if not len(segments):
        return np.zeros(0)
    angle = np.arctan2(segments.direction[:, 1], segments.direction[:, 0])
    apart = np.angle(np.exp(2j * (angle[:, None] - angle[None, :]))) / 2.0
    sigma = np.radians(HATCH_DEG)
    kernel = np.exp(-0.5 * (apart / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    np.fill_diagonal(kernel, 0.0)
    weight = segments.weight
    rest = np.maximum(weight.sum() - weight, 1e-9)
    return 0.5 / np.pi + 0.5 * (kernel @ weight) / rest


def log_gain(states: Array, segments: Segments, background: Array, widen: float = 1.0) -> Array:
    """Logarithm (S,) of how much better ``states`` explain the segments than pointing nowhere does.

    background: from ``background_density``. widen: factor on the errors allowed, for a first coarse look.
    """
    frames = states.shape[1] - 3
    total = np.zeros(len(states))
    step = max(1, CHUNK // max(1, len(segments) * (1 + 2 * frames)))
    for start in range(0, len(states), step):
        part = slice(start, start + step)
        total[part] = logsumexp(_gains(misses(states[part], segments), segments, background, widen), axis=0)
    return total - np.log(len(STRAY))


def _densities(sine: Array, segments: Segments, background: Array, widen: float) -> Array:
    """Density (S, N, K) of each segment's direction if it points there, over that of one that points nowhere."""
    sigma = (segments.sigma * widen)[:, None]
    scale = _shares((sine.shape[-1] - 1) // 2) / (np.sqrt(2.0 * np.pi) * sigma * background[:, None])
    return np.exp(-0.5 * (sine / sigma) ** 2) * scale


def _gains(sine: Array, segments: Segments, background: Array, widen: float) -> Array:
    ratio = _densities(sine, segments, background, widen).sum(axis=-1)
    return np.stack([np.log(part + (1.0 - part) * ratio) @ segments.weight for part in map(segments.stray, STRAY)])


def responsibilities(state: Array, segments: Segments, background: Array, widen: float = 1.0) -> Array:
    """Probability (N, 1 + 2 F) that each segment points to each direction of ``state`` (3 + F,); the rest is stray."""
    sine = misses(state[None], segments)
    stray = segments.stray(STRAY[int(np.argmax(_gains(sine, segments, background, widen)[:-1, 0]))])[:, None]
    density = (1.0 - stray) * _densities(sine, segments, background, widen)[0]
    return density / (stray + density.sum(axis=1, keepdims=True))
