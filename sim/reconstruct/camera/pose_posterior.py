# SPDX-License-Identifier: MIT
"""Prior and posterior of a camera's pose: focal length, pitch and roll, given straight line segments.

A pose is (log f, pitch, roll): the logarithm of the focal length in pixels, and angles in radians. Candidate poses
come from triples of segments and are refined; the posterior is then sampled by Markov chains.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .ground_camera import MIN_DECLINATION_DEG, camera_from_world, pitch_and_roll
from .vanishing_points import Segments, angular_residuals, background_density, log_gain, responsibilities

Array = NDArray[np.float64]

TAIL = 4.0
"""Degrees of freedom of Student's t for pitch and roll: steep views and rolled cameras are rare, not impossible."""
COMFORT_DEG = 10.0
"""Objects are seldom seen at a smaller angle below the horizontal than this …"""
COMFORT_SIGMA_DEG = 3.0
"""… and this is the scale of the penalty below it."""
PITCH_LIMITS_DEG = (-20.0, 85.0)
ROLL_LIMIT_DEG = 45.0


@dataclass(frozen=True)
class Gaussian:
    """Mean and standard deviation; sigma 0 means a fixed value."""

    mean: float
    sigma: float


@dataclass(frozen=True)
class CameraPrior:
    """Prior of one photo's camera.

    log_focal, pitch, roll: log of pixels, and radians. horizon: height in pixels of the horizon in the middle column
    relative to the photo's middle, downward positive; if given, the pitch follows from it, the focal length and the
    roll. contacts: (N, 2) pixels from the photo's middle where objects stand: they must lie below the horizon.
    """

    log_focal: Gaussian
    pitch: Gaussian
    roll: Gaussian
    horizon: float | None
    contacts: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Free parameters (3,) among (log f, pitch, roll)."""
        pitch = self.horizon is None and self.pitch.sigma > 0
        return np.array([self.log_focal.sigma > 0, pitch, self.roll.sigma > 0])

    @property
    def spread(self) -> Array:
        """Standard deviations (3,) of (log f, pitch, roll), 0 where fixed."""
        return np.array([self.log_focal.sigma, self.pitch.sigma, self.roll.sigma]) * self.free

    def completed(self, poses: Array) -> Array:
        """Return ``poses`` (S, 3) with fixed values filled in."""
        poses = poses.copy()
        for column, guess in enumerate((self.log_focal, self.pitch, self.roll)):
            if guess.sigma == 0:
                poses[:, column] = guess.mean
        if self.horizon is not None:
            poses[:, 1] = np.arctan2(-self.horizon * np.cos(poses[:, 2]), np.exp(poses[:, 0]))
        return poses

    def log_density(self, poses: Array) -> Array:
        """Return the log density (S,) of completed ``poses`` (S, 3), up to a constant; −inf where impossible."""
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
        """Log likelihood (S,) of the contacts' smallest angle below the horizontal."""
        up = camera_from_world(poses[:, 1], poses[:, 2])[..., 2]
        rays = np.concatenate(
            [self.contacts[None] / np.exp(poses[:, 0])[:, None, None], np.ones((len(poses), len(self.contacts), 1))],
            axis=-1,
        )
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        lowest = np.degrees(np.arcsin(np.clip(-(rays @ up[..., None])[..., 0], -1.0, 1.0))).min(axis=1)
        lack = np.maximum(COMFORT_DEG - lowest, 0.0) / COMFORT_SIGMA_DEG
        # Steep but finite: a start on the wrong side can still converge.
        return -0.5 * lack**2 - 20.0 * np.maximum(MIN_DECLINATION_DEG - lowest, 0.0)

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Return ``count`` completed poses (S, 3) drawn from the prior, ignoring contacts."""
        wide = rng.standard_t(TAIL, size=(count, 3))
        wide[:, 0] = rng.standard_normal(count)
        means = np.array([self.log_focal.mean, self.pitch.mean, self.roll.mean])
        return self.completed(means + wide * self.spread)

    def log_proposal(self, poses: Array) -> Array:
        """Return the log density (S,) of ``draw`` at ``poses`` (S, 3), up to a constant."""
        total = np.zeros(len(poses))
        for column, guess in enumerate((self.log_focal, self.pitch, self.roll)):
            if self.free[column]:
                ratio = (poses[:, column] - guess.mean) / guess.sigma
                total -= 0.5 * ratio**2 if column == 0 else 0.5 * (TAIL + 1.0) * np.log1p(ratio**2 / TAIL)
        return total


TRIPLES = 500
"""Sampled triples of segments; each gives three candidate states."""
DRAWS = 500
"""Candidates from the prior with one segment assumed on the ground."""
KEPT = 8
"""Candidates that are refined."""
WIDEN = 4.0
"""Initial widening of the errors, because candidates from single segments are inexact."""
MOST_FRAMES = 3
FRAME_GAIN = 4.0
"""Log likelihood gain required for another frame."""
QUARTER = np.pi / 2.0


def find_modes(segments: Segments, background: Array, prior: CameraPrior, rng: np.random.Generator) -> list[Array]:
    """Return the best states (3 + F,) given ``segments`` and the prior, best first; each with 1 to 3 frames."""
    states = candidate_states(segments, prior, rng)
    score = log_gain(states, segments, background, WIDEN) + prior.log_density(states[:, :3])
    found: list[tuple[float, Array]] = []
    for index in _distinct(states, np.argsort(-score, kind="stable"), score):
        state = states[index]
        for widen in (WIDEN, 2.0, 1.0):
            state = refined(state, segments, background, prior, widen)
        if not any(_alike(state, other) for _, other in found):
            found.append((_value(state, segments, background, prior), state))
    found.sort(key=lambda pair: -pair[0])
    best = [state for value, state in found if value > found[0][0] - 8.0]
    return [_with_more_frames(state, segments, background, prior) for state in best[:4]]


def candidate_states(segments: Segments, prior: CameraPrior, rng: np.random.Generator) -> Array:
    """Return completed states (S, 4): of three segments two are parallel and the third is perpendicular to them, in any
    role."""
    chance = segments.weight * np.sqrt(segments.length)
    chance = chance / chance.sum()
    triple = rng.choice(len(segments), size=(TRIPLES, 3), p=chance)
    focal = np.exp(prior.draw(TRIPLES, rng)[:, 0])
    first, second, third = (_planes(segments, column, focal) for column in triple.T)
    meet = _unit(np.cross(first, second))
    square = _unit(np.cross(third, meet))
    poses, ground = [prior.draw(DRAWS, rng)], [rng.choice(len(segments), size=DRAWS, p=chance)]
    for up, lies in ((meet, triple[:, 2]), (square, triple[:, 0]), (np.cross(meet, square), triple[:, 0])):
        up = up * np.where(up[:, 1:2] > 0, -1.0, 1.0)
        pitch = np.arcsin(np.clip(-up[:, 2], -1.0, 1.0))
        poses.append(prior.completed(np.column_stack([np.log(focal), pitch, np.arctan2(up[:, 0], -up[:, 1])])))
        ground.append(lies)
    pose, lies = np.concatenate(poses), np.concatenate(ground)
    possible = np.flatnonzero(prior.log_density(pose) > -16.0)
    pose, lies = pose[possible], lies[possible]
    axes = camera_from_world(pose[:, 1], pose[:, 2])
    along = np.cross(_planes(segments, lies, np.exp(pose[:, 0])), axes[..., 2])
    azimuth = np.arctan2((along * axes[..., 1]).sum(axis=1), (along * axes[..., 0]).sum(axis=1)) % QUARTER
    return np.column_stack([pose, azimuth])


def _planes(segments: Segments, index: NDArray[np.int64], focal: Array) -> Array:
    """Normals (S, 3), in the camera's axes, of the planes through the camera and the segments ``index`` (S,)."""
    (x, y), (u, v) = segments.middle[index].T, segments.direction[index].T
    return _unit(np.column_stack([-focal * v, focal * u, x * v - y * u]))


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _alike(state: Array, other: Array) -> bool:
    turn = abs((state[3] - other[3] + QUARTER / 2) % QUARTER - QUARTER / 2)
    return bool(np.abs(state[:3] - other[:3]).max() < 0.02 and turn < 0.02)


def _distinct(states: Array, order: NDArray[np.int64], score: Array) -> list[int]:
    kept: list[int] = []
    for index in order:
        if len(kept) == KEPT or not np.isfinite(score[index]):
            break
        near = (np.abs(states[kept, :3] - states[index, :3]).max(axis=1) < 0.08) if kept else np.zeros(0, bool)
        if not near.any():
            kept.append(int(index))
    return kept


def _value(state: Array, segments: Segments, background: Array, prior: CameraPrior, widen: float = 1.0) -> float:
    return float(log_gain(state[None], segments, background, widen)[0] + prior.log_density(state[None, :3])[0])


def refined(state: Array, segments: Segments, background: Array, prior: CameraPrior, widen: float = 1.0) -> Array:
    """Return ``state`` refined to a maximum of the posterior (expectation maximisation, Gauss-Newton steps)."""
    value = _value(state, segments, background, prior, widen)
    for _ in range(10):
        matrix, slope, free = normal_equations(state, segments, background, prior, widen)
        step = np.zeros(len(state))
        step[free] = np.linalg.lstsq(matrix, slope, rcond=None)[0]
        step *= min(1.0, 0.25 / max(float(np.abs(step).max()), 1e-12))
        for share in (1.0, 0.3, 0.1):
            moved = state + share * step
            moved[:3] = prior.completed(moved[None, :3])[0]
            better = _value(moved, segments, background, prior, widen)
            if better > value:
                break
        else:
            return state
        gained, state, value = better - value, moved, better
        if gained < 1e-3:
            return state
    return state


def normal_equations(
    state: Array, segments: Segments, background: Array, prior: CameraPrior, widen: float = 1.0
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return the information matrix (P, P) and gradient (P,) of the log posterior in the free parameters, and their
    indices."""
    free = np.flatnonzero(np.concatenate([prior.free, np.ones(len(state) - 3, bool)]))
    step = 1e-4
    around = np.repeat(state[None], 1 + len(free), axis=0)
    around[1 + np.arange(len(free)), free] += step
    around[:, :3] = prior.completed(around[:, :3])
    sine = angular_residuals(around, segments)
    slopes = (sine[1:] - sine[0]) / step
    share = responsibilities(state, segments, background, widen) * segments.weight[:, None]
    share = share / (segments.sigma[:, None] * widen) ** 2
    matrix = np.einsum("pnk,qnk,nk->pq", slopes, slopes, share)
    slope = -np.einsum("pnk,nk,nk->p", slopes, sine[0], share)
    for row, column in enumerate(free):
        if column >= 3:
            continue
        guess = (prior.log_focal, prior.pitch, prior.roll)[column]
        away = (state[column] - guess.mean) / guess.sigma
        tail = 1.0 if column == 0 else (TAIL + 1.0) / (TAIL + away**2)
        matrix[row, row] += tail / guess.sigma**2
        slope[row] -= tail * away / guess.sigma
    return matrix, slope, free


def _with_more_frames(state: Array, segments: Segments, background: Array, prior: CameraPrior) -> Array:
    """``state`` with further frames while each explains the segments clearly better."""
    azimuths = np.arange(0.0, QUARTER, np.radians(1.5))
    while len(state) < 3 + MOST_FRAMES:
        tried = np.column_stack([np.repeat(state[None], len(azimuths), axis=0), azimuths])
        turned = tried[int(np.argmax(log_gain(tried, segments, background, 1.5)))]
        turned = refined(turned, segments, background, prior)
        gained = _value(turned, segments, background, prior) - _value(state, segments, background, prior)
        if gained < FRAME_GAIN:
            return state
        state = turned
    return state


FEW = 4
"""Fewer segments than this are ignored."""
CHAINS = 240
STEPS = 44
COUNTED = 20
"""Final steps whose states are the samples."""
COARSE = 4.0
"""Initial widening of the errors: chains explore before they settle."""
JITTER = 1e-3


@dataclass(frozen=True)
class PosePosterior:
    """Posterior mean and uncertainty of a camera's pose.

    focal: pixels. pitch, roll: radians. log_focal_sigma: of the logarithm of the focal length. normal_sigma: RMS angle
    in radians between the true normal of the ground and this one. gain: mean log likelihood ratio of the photo's lines
    over outliers.
    """

    focal: float
    pitch: float
    roll: float
    log_focal_sigma: float
    normal_sigma: float
    gain: float


def infer_pose(segments: Segments, prior: CameraPrior, seed: int = 0) -> PosePosterior:
    """Return the posterior from ``prior`` and ``segments``; deterministic for equal inputs."""
    rng = np.random.default_rng(seed)
    if not prior.free.any():
        (log_focal, pitch, roll) = (float(v) for v in prior.completed(np.zeros((1, 3)))[0])
        return PosePosterior(math.exp(log_focal), pitch, roll, 0.0, 0.0, 0.0)
    if len(segments) < FEW:
        poses = prior.draw(CHAINS * COUNTED, rng)
        weight = np.exp(prior.log_density(poses) - prior.log_proposal(poses))
        return _summary(poses, weight / weight.sum(), 0.0)
    background = background_density(segments)
    modes = find_modes(segments, background, prior, rng)
    poses, gain = _chains(_starts(modes, segments, prior, background, rng), segments, background, prior, rng)
    return _summary(poses, np.full(len(poses), 1.0 / len(poses)), gain)


def _starts(
    modes: list[Array], segments: Segments, prior: CameraPrior, background: Array, rng: np.random.Generator
) -> Array:
    """Initial states (CHAINS, 3 + F): half from the modes, half from candidates weighted by a coarse score."""
    frames = len(modes[0]) - 3 if modes else 1
    drawn = candidate_states(segments, prior, rng)
    score = log_gain(drawn, segments, background, COARSE) + prior.log_density(drawn[:, :3])
    chance = np.exp(score - score.max())
    count = CHAINS // 2 if modes else CHAINS
    loose = drawn[rng.choice(len(drawn), size=count, p=chance / chance.sum())]
    starts = [np.column_stack([loose, rng.uniform(0.0, QUARTER, (count, frames - 1))])]
    for index in range(CHAINS - count):
        mode = modes[index % len(modes)][: 3 + frames]
        starts.append(np.concatenate([mode, rng.uniform(0.0, QUARTER, 3 + frames - len(mode))])[None])
    return np.concatenate(starts)


def _chains(
    states: Array, segments: Segments, background: Array, prior: CameraPrior, rng: np.random.Generator
) -> tuple[Array, float]:
    """Poses (S, 3) sampled from the posterior, and the mean gain: differential evolution Markov chains (ter Braak,
    2006).

    Steps are differences of other chains, so they adapt to the posterior's width and follow its ridges: one family of
    lines couples focal length and pitch.
    """
    count = len(states)
    free = np.flatnonzero(np.concatenate([prior.free, np.ones(states.shape[1] - 3, bool)]))
    samples, gains = [], []
    widen, gain, log_prior = 0.0, np.zeros(count), np.zeros(count)
    for step in range(STEPS):
        wanted = max(1.0, COARSE * (1.0 - step / (STEPS - COUNTED - 6)))
        if wanted != widen:
            widen = wanted
            gain, log_prior = log_gain(states, segments, background, widen), prior.log_density(states[:, :3])
        one = (np.arange(count) + rng.integers(1, count, count)) % count
        two = (np.arange(count) + rng.integers(1, count, count)) % count
        # Occasionally a full difference, so that chains jump between ridges.
        reach = 1.0 if step % 6 == 5 else 2.38 / np.sqrt(2.0 * len(free))
        moved = states.copy()
        away = reach * (states[one] - states[two]) + JITTER * rng.standard_normal(states.shape)
        moved[:, free] += away[:, free]
        moved[:, :3] = prior.completed(moved[:, :3])
        moved_log_prior = prior.log_density(moved[:, :3])
        moved_gain = log_gain(moved, segments, background, widen)
        accepted = np.log(rng.uniform(size=count)) < moved_gain + moved_log_prior - gain - log_prior
        states[accepted], gain[accepted], log_prior[accepted] = (
            moved[accepted],
            moved_gain[accepted],
            moved_log_prior[accepted],
        )
        if step >= STEPS - COUNTED:
            samples.append(states[:, :3].copy())
            gains.append(float(gain.mean()))
    return np.concatenate(samples), float(np.mean(gains))


def _summary(poses: Array, weight: Array, gain: float) -> PosePosterior:
    up = camera_from_world(poses[:, 1], poses[:, 2])[..., 2]
    mean_up = weight @ up
    mean_up /= np.linalg.norm(mean_up)
    log_focal = float(weight @ poses[:, 0])
    pitch, roll = pitch_and_roll(mean_up)
    angle = np.arccos(np.clip(up @ mean_up, -1.0, 1.0))
    return PosePosterior(
        focal=float(np.exp(log_focal)),
        pitch=pitch,
        roll=roll,
        log_focal_sigma=float(np.sqrt(weight @ (poses[:, 0] - log_focal) ** 2)),
        normal_sigma=float(np.sqrt(weight @ angle**2)),
        gain=gain,
    )
