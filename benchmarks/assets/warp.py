# SPDX-License-Identifier: MIT
"""Smooth distortions that are known exactly: what a reconstruction gets wrong of a shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .fields import Array, Triple


@dataclass(frozen=True, kw_only=True)
class Bulge:
    """A push by ``shift`` metres and a swelling by the share ``swell``, both fading as exp(-r² / 2 radius²)."""

    centre: Triple
    radius: float
    shift: Triple = (0.0, 0.0, 0.0)
    swell: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Warp:
    """Where each place x goes: x + (scale - 1)(x - base) + bend h² / height + twist + bulges, h = x_z - base_z.

    base: the point that stays. scale: factors along the axes. bend: metres by which what is ``height`` metres above
    the base leans, growing with the square. twist: radians at ``height``, growing evenly (to first order in it).
    """

    base: Triple = (0.0, 0.0, 0.0)
    height: float
    scale: Triple = (1.0, 1.0, 1.0)
    bend: tuple[float, float] = (0.0, 0.0)
    twist: float = 0.0
    bulges: tuple[Bulge, ...] = ()

    def __call__(self, points: Array) -> Array:
        """The warped places (N, 3) of ``points`` (N, 3), metres."""
        away = points - np.array(self.base)
        level = away[:, 2] / self.height
        moved = points + away * (np.array(self.scale) - 1.0)
        moved[:, :2] += np.array(self.bend) * (level**2)[:, None]
        moved[:, 0] -= self.twist * level * away[:, 1]
        moved[:, 1] += self.twist * level * away[:, 0]
        for bulge in self.bulges:
            offset, share = _fading(points, bulge)
            moved += share[:, None] * (np.array(bulge.shift) + bulge.swell * offset)
        return moved

    def jacobian(self, points: Array) -> Array:
        """(N, 3, 3) its derivative at ``points``: row i is that of coordinate i."""
        away = points - np.array(self.base)
        level = away[:, 2] / self.height
        result = np.repeat(np.diag(self.scale)[None], len(points), axis=0)
        result[:, :2, 2] += 2.0 * np.array(self.bend) * (level / self.height)[:, None]
        result[:, 0, 1] -= self.twist * level
        result[:, 1, 0] += self.twist * level
        result[:, 0, 2] -= self.twist * away[:, 1] / self.height
        result[:, 1, 2] += self.twist * away[:, 0] / self.height
        for bulge in self.bulges:
            offset, share = _fading(points, bulge)
            push = np.array(bulge.shift) + bulge.swell * offset
            slope = -offset / bulge.radius**2
            result += share[:, None, None] * (push[:, :, None] * slope[:, None, :] + bulge.swell * np.eye(3))
        return result


def _fading(points: Array, bulge: Bulge) -> tuple[Array, Array]:
    offset = points - np.array(bulge.centre)
    return offset, np.exp(-0.5 * (offset**2).sum(axis=1) / bulge.radius**2)
