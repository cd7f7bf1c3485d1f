# SPDX-License-Identifier: MIT
"""What is known of the camera after the photo's lines were looked at, and how well."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .belief import Belief
from .camera import camera_from_world, pitch_and_roll
from .search import QUARTER, find_modes, guesses
from .segments import Segments
from .vanishing import background_density, log_gain

Array = NDArray[np.float64]

FEW = 4
"""Fewer segments than this are not looked at."""
CHAINS = 240
STEPS = 44
COUNTED = 20
"""The last ones, which make the samples."""
COARSE = 4.0
"""Errors allowed at first over those allowed in the end: chains wander before they settle."""
JITTER = 1e-3


@dataclass(frozen=True)
class Posterior:
    """Mean and spread of a camera's pose.

    focal: pixels. pitch, roll: radians. log_focal_sigma: of the logarithm of the focal length. normal_sigma: root mean
    square angle in radians between the true normal of the ground and this one. gain: logarithm of how much better the
    photo's lines are explained than by lines that point nowhere, on average.
    """

    focal: float
    pitch: float
    roll: float
    log_focal_sigma: float
    normal_sigma: float
    gain: float


def infer(segments: Segments, belief: Belief, seed: int = 0) -> Posterior:
    """The pose by ``belief`` and ``segments``; equal inputs give equal results."""
    rng = np.random.default_rng(seed)
    if not belief.free.any():
        (log_focal, pitch, roll) = (float(v) for v in belief.completed(np.zeros((1, 3)))[0])
        return Posterior(math.exp(log_focal), pitch, roll, 0.0, 0.0, 0.0)
    if len(segments) < FEW:
        poses = belief.draw(CHAINS * COUNTED, rng)
        weight = np.exp(belief.log_density(poses) - belief.log_proposal(poses))
        return _summary(poses, weight / weight.sum(), 0.0)
    background = background_density(segments)
    modes = find_modes(segments, background, belief, rng)
    poses, gain = _chains(_starts(modes, segments, belief, background, rng), segments, background, belief, rng)
    return _summary(poses, np.full(len(poses), 1.0 / len(poses)), gain)


def _starts(
    modes: list[Array], segments: Segments, belief: Belief, background: Array, rng: np.random.Generator
) -> Array:
    """First states (CHAINS, 3 + F): half of the modes, half of the guesses, as good as they are at a coarse look."""
    frames = len(modes[0]) - 3 if modes else 1
    drawn = guesses(segments, belief, rng)
    score = log_gain(drawn, segments, background, COARSE) + belief.log_density(drawn[:, :3])
    chance = np.exp(score - score.max())
    count = CHAINS // 2 if modes else CHAINS
    loose = drawn[rng.choice(len(drawn), size=count, p=chance / chance.sum())]
    starts = [np.column_stack([loose, rng.uniform(0.0, QUARTER, (count, frames - 1))])]
    for index in range(CHAINS - count):
        mode = modes[index % len(modes)][: 3 + frames]
        starts.append(np.concatenate([mode, rng.uniform(0.0, QUARTER, 3 + frames - len(mode))])[None])
    return np.concatenate(starts)


def _chains(
    states: Array, segments: Segments, background: Array, belief: Belief, rng: np.random.Generator
) -> tuple[Array, float]:
    """Poses (S, 3) from the posterior, and the mean gain: differential evolution Markov chains (ter Braak, 2006).

    Steps are differences of other chains, so they are as long as the posterior is wide, and run along its ridges: of
    one family of lines, focal length and pitch are known together, not each.
    """
    count = len(states)
    free = np.flatnonzero(np.concatenate([belief.free, np.ones(states.shape[1] - 3, bool)]))
    samples, gains = [], []
    widen, gain, prior = 0.0, np.zeros(count), np.zeros(count)
    for step in range(STEPS):
        wanted = max(1.0, COARSE * (1.0 - step / (STEPS - COUNTED - 6)))
        if wanted != widen:
            widen = wanted
            gain, prior = log_gain(states, segments, background, widen), belief.log_density(states[:, :3])
        one = (np.arange(count) + rng.integers(1, count, count)) % count
        two = (np.arange(count) + rng.integers(1, count, count)) % count
        # Now and then as far as from one to the other, so that chains change between ridges.
        reach = 1.0 if step % 6 == 5 else 2.38 / np.sqrt(2.0 * len(free))
        moved = states.copy()
        away = reach * (states[one] - states[two]) + JITTER * rng.standard_normal(states.shape)
        moved[:, free] += away[:, free]
        moved[:, :3] = belief.completed(moved[:, :3])
        moved_prior = belief.log_density(moved[:, :3])
        moved_gain = log_gain(moved, segments, background, widen)
        accepted = np.log(rng.uniform(size=count)) < moved_gain + moved_prior - gain - prior
        states[accepted], gain[accepted], prior[accepted] = moved[accepted], moved_gain[accepted], moved_prior[accepted]
        if step >= STEPS - COUNTED:
            samples.append(states[:, :3].copy())
            gains.append(float(gain.mean()))
    return np.concatenate(samples), float(np.mean(gains))


def _summary(poses: Array, weight: Array, gain: float) -> Posterior:
    up = camera_from_world(poses[:, 1], poses[:, 2])[..., 2]
    mean_up = weight @ up
    mean_up /= np.linalg.norm(mean_up)
    log_focal = float(weight @ poses[:, 0])
    pitch, roll = pitch_and_roll(mean_up)
    angle = np.arccos(np.clip(up @ mean_up, -1.0, 1.0))
    return Posterior(
        focal=float(np.exp(log_focal)),
        pitch=pitch,
        roll=roll,
        log_focal_sigma=float(np.sqrt(weight @ (poses[:, 0] - log_focal) ** 2)),
        normal_sigma=float(np.sqrt(weight @ angle**2)),
        gain=gain,
    )
