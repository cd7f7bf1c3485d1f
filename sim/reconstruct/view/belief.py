# SPDX-License-Identifier: MIT
"""What is believed of a camera before the photo's lines are looked at: focal length, pitch, roll, and their spreads.

A pose is written (log f, pitch, roll): the logarithm of the focal length in pixels, and angles in radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import MIN_DECLINATION_DEG, camera_from_world

Array = NDArray[np.float64]

TAIL = 4.0
"""Degrees of freedom of Student's t for pitch and roll: steep views and tilted cameras are rare, not impossible."""
COMFORT_DEG = 10.0
"""Things are seldom seen at a smaller angle below the horizontal than this …"""
COMFORT_SIGMA_DEG = 3.0
"""… and this decides how seldom."""
PITCH_LIMITS_DEG = (-20.0, 85.0)
ROLL_LIMIT_DEG = 45.0


@dataclass(frozen=True)
class Guess:
    """A value and its standard deviation; 0 means that it is given and not questioned."""

    mean: float
    sigma: float


@dataclass(frozen=True)
class Belief:
    """What is believed of one photo's camera.

    log_focal, pitch, roll: radians, and log of pixels. horizon: height in pixels of the horizon in the middle column
    over the photo's middle, downward positive; when given, the pitch follows from it, the focal length and the roll.
    contacts: (N, 2) pixels from the photo's middle where objects stand: they must lie below the horizon.
    """

    log_focal: Guess
    pitch: Guess
    roll: Guess
    horizon: float | None
    contacts: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of (log f, pitch, roll) are open (3,)."""
        pitch = self.horizon is None and self.pitch.sigma > 0
        return np.array([self.log_focal.sigma > 0, pitch, self.roll.sigma > 0])

    @property
    def spread(self) -> Array:
        """Standard deviations (3,) of (log f, pitch, roll), 0 where given."""
        return np.array([self.log_focal.sigma, self.pitch.sigma, self.roll.sigma]) * self.free

    def completed(self, poses: Array) -> Array:
        """``poses`` (S, 3) with what is given in place of what they hold."""
        poses = poses.copy()
        for column, guess in enumerate((self.log_focal, self.pitch, self.roll)):
            if guess.sigma == 0:
                poses[:, column] = guess.mean
        if self.horizon is not None:
            poses[:, 1] = np.arctan2(-self.horizon * np.cos(poses[:, 2]), np.exp(poses[:, 0]))
        return poses

    def log_density(self, poses: Array) -> Array:
        """Logarithm (S,) of the density of completed ``poses`` (S, 3), up to a constant; −inf where impossible."""
        total = np.zeros(len(poses))
        if self.log_focal.sigma > 0:
            total -= 0.5 * ((poses[:, 0] - self.log_focal.mean) / self.log_focal.sigma) ** 2
        for column, guess in ((1, self.pitch), (2, self.roll)):
            if self.free[column]:
                ratio = (poses[:, column] - guess.mean) / guess.sigma
                total -= 0.5 * (TAIL + 1.0) * np.log1p(ratio**2 / TAIL)
        if self.free[1]:
            low, high = np.radians(PITCH_LIMITS_DEG)
            total[(poses[:, 1] < low) | (poses[:, 1] > high)] = -np.inf
        if self.free[2]:
            total[np.abs(poses[:, 2]) > math.radians(ROLL_LIMIT_DEG)] = -np.inf
        if self.free.any() and len(self.contacts):
            total += self._stands(poses)
        return total

    def _stands(self, poses: Array) -> Array:
        """Logarithm (S,) of how likely it is to see the contacts that little below the horizontal."""
        up = camera_from_world(poses[:, 1], poses[:, 2])[..., 2]
        rays = np.concatenate(
            [self.contacts[None] / np.exp(poses[:, 0])[:, None, None], np.ones((len(poses), len(self.contacts), 1))],
            axis=-1,
        )
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        lowest = np.degrees(np.arcsin(np.clip(-(rays @ up[..., None])[..., 0], -1.0, 1.0))).min(axis=1)
        lack = np.maximum(COMFORT_DEG - lowest, 0.0) / COMFORT_SIGMA_DEG
        # Steep but finite: whoever starts on the wrong side still finds the way.
        return -0.5 * lack**2 - 20.0 * np.maximum(MIN_DECLINATION_DEG - lowest, 0.0)

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """``count`` completed poses (S, 3) from the belief, contacts left out of account."""
        wide = rng.standard_t(TAIL, size=(count, 3))
        wide[:, 0] = rng.standard_normal(count)
        means = np.array([self.log_focal.mean, self.pitch.mean, self.roll.mean])
        return self.completed(means + wide * self.spread)

    def log_proposal(self, poses: Array) -> Array:
        """Logarithm (S,) of the density that ``draw`` has at ``poses`` (S, 3), up to a constant."""
        total = np.zeros(len(poses))
        for column, guess in enumerate((self.log_focal, self.pitch, self.roll)):
            if self.free[column]:
                ratio = (poses[:, column] - guess.mean) / guess.sigma
                total -= 0.5 * ratio**2 if column == 0 else 0.5 * (TAIL + 1.0) * np.log1p(ratio**2 / TAIL)
        return total
