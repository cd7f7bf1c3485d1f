# SPDX-License-Identifier: MIT
"""Look for poses that explain a photo's segments: guesses from three segments each, the best of them made exact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .belief import TAIL, Belief
from .camera import camera_from_world
from .segments import Segments
from .vanishing import log_gain, misses, responsibilities

Array = NDArray[np.float64]

TRIPLES = 500
"""Samples of three segments; each gives three guesses."""
DRAWS = 500
"""Guesses from the belief with one segment that lies on the ground."""
KEPT = 8
"""Guesses that are made exact."""
WIDEN = 4.0
"""Guesses from single segments are inexact: errors allowed at first, over those allowed in the end."""
MOST_FRAMES = 3
FRAME_GAIN = 4.0
"""Logarithm of how much better another frame must explain the segments to be believed in."""
QUARTER = np.pi / 2.0


def find_modes(segments: Segments, background: Array, belief: Belief, rng: np.random.Generator) -> list[Array]:
    """States (3 + F,) that explain ``segments`` best and the belief allows, the best first; each with 1 to 3 frames."""
    states = guesses(segments, belief, rng)
    score = log_gain(states, segments, background, WIDEN) + belief.log_density(states[:, :3])
    found: list[tuple[float, Array]] = []
    for index in _distinct(states, np.argsort(-score, kind="stable"), score):
        state = states[index]
        for widen in (WIDEN, 2.0, 1.0):
            state = refined(state, segments, background, belief, widen)
        if not any(_alike(state, other) for _, other in found):
            found.append((_value(state, segments, background, belief), state))
    found.sort(key=lambda pair: -pair[0])
    best = [state for value, state in found if value > found[0][0] - 8.0]
    return [_with_more_frames(state, segments, background, belief) for state in best[:4]]


def guesses(segments: Segments, belief: Belief, rng: np.random.Generator) -> Array:
    """Completed states (S, 4): of three segments two are parallel and the third is square to them, in any role."""
    chance = segments.weight * np.sqrt(segments.length)
    chance = chance / chance.sum()
    triple = rng.choice(len(segments), size=(TRIPLES, 3), p=chance)
    focal = np.exp(belief.draw(TRIPLES, rng)[:, 0])
    first, second, third = (_planes(segments, column, focal) for column in triple.T)
    meet = _unit(np.cross(first, second))
    square = _unit(np.cross(third, meet))
    poses, ground = [belief.draw(DRAWS, rng)], [rng.choice(len(segments), size=DRAWS, p=chance)]
    for up, lies in ((meet, triple[:, 2]), (square, triple[:, 0]), (np.cross(meet, square), triple[:, 0])):
        up = up * np.where(up[:, 1:2] > 0, -1.0, 1.0)
        pitch = np.arcsin(np.clip(-up[:, 2], -1.0, 1.0))
        poses.append(belief.completed(np.column_stack([np.log(focal), pitch, np.arctan2(up[:, 0], -up[:, 1])])))
        ground.append(lies)
    pose, lies = np.concatenate(poses), np.concatenate(ground)
    possible = np.flatnonzero(belief.log_density(pose) > -16.0)
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


def _value(state: Array, segments: Segments, background: Array, belief: Belief, widen: float = 1.0) -> float:
    return float(log_gain(state[None], segments, background, widen)[0] + belief.log_density(state[None, :3])[0])


def refined(state: Array, segments: Segments, background: Array, belief: Belief, widen: float = 1.0) -> Array:
    """``state`` moved to where it explains ``segments`` best (expectation maximization, Gauss-Newton steps)."""
    value = _value(state, segments, background, belief, widen)
    for _ in range(10):
        matrix, slope, free = normal_equations(state, segments, background, belief, widen)
        step = np.zeros(len(state))
        step[free] = np.linalg.lstsq(matrix, slope, rcond=None)[0]
        step *= min(1.0, 0.25 / max(float(np.abs(step).max()), 1e-12))
        for share in (1.0, 0.3, 0.1):
            moved = state + share * step
            moved[:3] = belief.completed(moved[None, :3])[0]
            better = _value(moved, segments, background, belief, widen)
            if better > value:
                break
        else:
            return state
        gained, state, value = better - value, moved, better
        if gained < 1e-3:
            return state
    return state


def normal_equations(
    state: Array, segments: Segments, background: Array, belief: Belief, widen: float = 1.0
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Information matrix (P, P) and slope (P,) of the logarithm of the posterior in the open parameters, and these."""
    free = np.flatnonzero(np.concatenate([belief.free, np.ones(len(state) - 3, bool)]))
    step = 1e-4
    around = np.repeat(state[None], 1 + len(free), axis=0)
    around[1 + np.arange(len(free)), free] += step
    around[:, :3] = belief.completed(around[:, :3])
    sine = misses(around, segments)
    slopes = (sine[1:] - sine[0]) / step
    share = responsibilities(state, segments, background, widen) * segments.weight[:, None]
    share = share / (segments.sigma[:, None] * widen) ** 2
    matrix = np.einsum("pnk,qnk,nk->pq", slopes, slopes, share)
    slope = -np.einsum("pnk,nk,nk->p", slopes, sine[0], share)
    for row, column in enumerate(free):
        if column >= 3:
            continue
        guess = (belief.log_focal, belief.pitch, belief.roll)[column]
        away = (state[column] - guess.mean) / guess.sigma
        tail = 1.0 if column == 0 else (TAIL + 1.0) / (TAIL + away**2)
        matrix[row, row] += tail / guess.sigma**2
        slope[row] -= tail * away / guess.sigma
    return matrix, slope, free


def _with_more_frames(state: Array, segments: Segments, background: Array, belief: Belief) -> Array:
    """``state`` with another frame as long as that explains the segments clearly better."""
    azimuths = np.arange(0.0, QUARTER, np.radians(1.5))
    while len(state) < 3 + MOST_FRAMES:
        tried = np.column_stack([np.repeat(state[None], len(azimuths), axis=0), azimuths])
        turned = tried[int(np.argmax(log_gain(tried, segments, background, 1.5)))]
        turned = refined(turned, segments, background, belief)
        gained = _value(turned, segments, background, belief) - _value(state, segments, background, belief)
        if gained < FRAME_GAIN:
            return state
        state = turned
    return state
