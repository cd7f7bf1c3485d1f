# SPDX-License-Identifier: MIT
"""A model's worlds, those for its derivatives included, and the paths of all segments in them, from one launch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .observed_poses import perturbed
from .rigid_candidates import BELIEFS, CandidateEffect
from .rigid_simulator import RigidWorlds
from .segmented_trial import SegmentedTrial
from .world_settings import BodyScene, WorldSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SHIFT_STEP, TURN_STEP, SPEED_STEP = 3e-4, 3e-3, 4e-3
"""Finite-difference steps in m, rad, m/s; spins: speed over the body's size. Smaller steps measure contact chatter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """The nominal model's own parameters plus added effects."""

    candidates: tuple[CandidateEffect, ...]

    @property
    def size(self) -> int:
        """Return the number of free numbers."""
        return BELIEFS.size + sum(f.size for f in self.candidates)

    @property
    def steps(self) -> Array:
        """Return the finite-difference steps (P,)."""
        parts = [np.full(BELIEFS.size, BELIEFS.step), *(np.full(f.size, f.step) for f in self.candidates)]
        return np.concatenate(parts)

    def setting(self, scene: BodyScene, z: Array) -> WorldSettings:
        """Return the world settings of the numbers ``z`` (P,)."""
        setting = BELIEFS.change(scene, scene.base, z[: BELIEFS.size])
        at = BELIEFS.size
        for candidate in self.candidates:
            setting = candidate.change(scene, setting, z[at : at + candidate.size])
            at += candidate.size
        return setting


@dataclass(frozen=True, kw_only=True, eq=False)
class Worlds:
    """The V worlds in which a segment runs: the unperturbed one, then pairs for central differences.

    changes: (V, 12) of the start. settings: for each row of the numbers. chosen: (V,) index among them. steps: (n,) of
    the differences.
    """

    changes: Array
    settings: list[list[WorldSettings]]
    chosen: Indices
    steps: Array

    def rows(self, trials: Indices) -> Indices:
        """Return the row of the numbers for each of ``trials``: their own, or the only one."""
        return trials if len(self.settings) > 1 else np.zeros_like(trials)


@dataclass(frozen=True, kw_only=True, eq=False)
class Paths:
    """The S segments of all trials as they were simulated.

    spans: trial, number in it, first frame, frame after the last. goes_on: (S,) whether another segment follows; its
    start is one frame more. states: (S, V, frames, 17).
    """

    spans: list[tuple[int, int, int, int]]
    goes_on: NDArray[np.bool_]
    states: Array

    @property
    def trials(self) -> Indices:
        """Return the trial (S,) of each segment."""
        return np.array([i for i, _, _, _ in self.spans])

    @property
    def counts(self) -> Indices:
        """Return the number of frames (S,) of each segment."""
        return np.array([b - a for _, _, a, b in self.spans])

    @property
    def owners(self) -> Indices:
        """Return the segment (F,) of each frame, those of all segments one after the other."""
        return np.repeat(np.arange(len(self.spans)), self.counts)

    @property
    def rows(self) -> list[slice]:
        """Return the places of each segment's frames among those of all."""
        ends = np.cumsum(self.counts)
        return [slice(int(end - count), int(end)) for end, count in zip(ends, self.counts, strict=True)]

    def poses(self) -> Array:
        """Return the poses (F, V, 7) in the frames of all segments."""
        ends, owners = np.cumsum(self.counts), self.owners
        columns = np.arange(int(ends[-1])) - np.repeat(ends - self.counts, self.counts)
        return self.states[owners, :, columns, :7]


def state_steps(scene: BodyScene) -> Array:
    """Return the finite-difference steps (12,) of a state."""
    spin = SPEED_STEP / scene.body.bound
    return np.repeat([SHIFT_STEP, TURN_STEP, SPEED_STEP, spin], 3)


def worlds_of(model: Model, scene: BodyScene, z: Array, *, slopes: bool, held: bool, fixed: bool) -> Worlds:
    """Return the worlds of every segment for the numbers ``z`` (P,) or (trials, P).

    slopes: with those for derivatives. held: of these only such as the added effects need. fixed: only such as the
    states need.
    """
    rows = [_variants(model, scene, row, slopes, held, fixed) for row in np.atleast_2d(z)]
    changes, settings = rows[0]
    # Worlds with another start have the unperturbed setting.
    moved = len(changes) - len(settings) + 1
    steps = np.concatenate([state_steps(scene), model.steps[: 0 if fixed else model.size]])
    return Worlds(
        changes=changes,
        settings=[row[1] for row in rows],
        chosen=np.concatenate([np.zeros(moved), np.arange(1, len(settings))]).astype(int),
        steps=model.steps[BELIEFS.size :] if held else steps,
    )


def _variants(
    model: Model, scene: BodyScene, z: Array, slopes: bool, held: bool, fixed: bool
) -> tuple[Array, list[WorldSettings]]:
    """Return start changes (V, 12) and settings of a segment's worlds: unperturbed, then central differences."""
    settings = [model.setting(scene, z)]
    if not slopes:
        return np.zeros((1, 12)), settings
    steps = state_steps(scene)
    first = BELIEFS.size if held else 0
    last = first if fixed else model.size
    changes = np.zeros((1 + 2 * ((0 if held else 12) + last - first), 12))
    if not held:
        for c in range(12):
            changes[1 + 2 * c, c], changes[2 + 2 * c, c] = steps[c], -steps[c]
    for p, step in list(enumerate(model.steps))[first:last]:
        for sign in (1, -1):
            shifted = z.copy()
            shifted[p] += sign * step
            settings.append(model.setting(scene, shifted))
    return changes, settings


def simulate_segments(
    simulator: RigidWorlds, scene: BodyScene, trials: list[SegmentedTrial], worlds: Worlds, states: list[Array]
) -> Paths:
    """Return all segments from the trials' ``states``, each (N, 13), in all ``worlds``, from one launch."""
    spans = [(i, j, a, b) for i, trial in enumerate(trials) for j, (a, b) in enumerate(trial.spans)]
    goes_on = np.array([b < trials[i].end for i, _, _, b in spans])
    counts = np.array([b - a for _, _, a, b in spans]) + goes_on
    clocks = np.zeros((len(spans), int(counts.max())))
    for row, (i, _, a, _), count in zip(clocks, spans, counts, strict=True):
        times = trials[i].observations.times
        row[:count] = times[a : a + count] - times[a]
    tables = np.array([scene.numbers(settings) for settings in worlds.settings])[:, worlds.chosen]
    rates = np.array([[settings[k].rate for k in worlds.chosen] for settings in worlds.settings])
    which = worlds.rows(np.array([i for i, _, _, _ in spans]))
    out = simulator.run(
        perturbed(np.concatenate(states)[:, None], worlds.changes[None]).reshape(-1, 13),
        tables[which].reshape(-1, tables.shape[-1]),
        (clocks[:, None] * rates[which][..., None]).reshape(-1, clocks.shape[1]),
        np.repeat(counts, len(worlds.changes)),
    )
    return Paths(spans=spans, goes_on=goes_on, states=out.reshape(len(spans), -1, *out.shape[1:]))
