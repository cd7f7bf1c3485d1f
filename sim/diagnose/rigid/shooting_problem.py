# SPDX-License-Identifier: MIT
"""Trials as chains of segments between nodes, and how well a model follows them: residuals and normal equations.

All segments of all trials, with all worlds for their derivatives, run in one launch, and their frames are judged
together; ``multiple_shooting`` fits with the results."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .observed_poses import (
    QUATERNION,
    ObservedBody,
    PointMoments,
    as_rotvec,
    conjugate,
    from_rotvec,
    multiply,
    perturbed,
    points_information,
    state_difference,
)
from .resting_contact import height
from .rigid_candidates import BELIEFS, BodyScene, CandidateEffect, WorldSettings
from .rigid_simulator import RigidWorlds

Array = NDArray[np.float64]

SHIFT_STEP, TURN_STEP, SPEED_STEP = 3e-4, 3e-3, 4e-3
"""Finite-difference steps in m, rad, m/s; spins: speed over the body's size. Smaller steps measure contact chatter."""

SUNK = 1e-3
"""Penetration in m allowed to a state seen by one camera."""

CONTACT_DEGREES_OF_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of contact defects: a few are outliers."""


@dataclass(kw_only=True, eq=False)
class SegmentedTrial:
    """A body in a trial, split at nodes. nodes: (N,) frames, rising. states: (N, 13). end: frame after the last used.

    prior: (12,) standard deviation of the initial guess of the first state. spin_cover: (3, 3) covariance of its spin
    in its place, where other takes tell it. Per segment: covers, (12, 12) covariance of the defect at its end; weights,
    (F,) of its frames.
    """

    observations: ObservedBody
    nodes: list[int]
    states: Array
    end: int
    guess: Array
    prior: Array
    covers: list[Array] = field(default_factory=list)
    weights: list[Array] = field(default_factory=list)
    spin_cover: Array | None = None

    @property
    def spans(self) -> list[tuple[int, int]]:
        """Return first and last frame of every segment."""
        return list(zip(self.nodes, [*self.nodes[1:], self.end], strict=True))


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


@dataclass(kw_only=True, eq=False)
class Segment:
    """Simulation of one segment. frames: (F,). record: (F, 17), unperturbed; arrival: (17,), at the next node.

    turn: (F, 6, 12 + B), come: (12, 12 + B): Jacobians of poses and arrival with respect to start and beliefs.
    """

    trial: int
    index: int
    frames: NDArray[np.int64]
    record: Array
    arrival: Array
    chi2: Array
    defect: Array | None
    turn: Array | None = None
    come: Array | None = None


@dataclass(kw_only=True, eq=False)
class NormalEquations:
    """Normal equations of one trial: Hessian of states and numbers (12 N + P), negative gradient."""

    hessian: Array
    slope: Array
    cost: float

    def add(self, own: slice, tail: slice, hessian: Array, slope: Array, following: slice | None = None) -> None:
        """Add equations of the state at ``own``, the numbers at ``tail`` and the next state at ``following``."""
        places, at = [(own, slice(0, 12)), (tail, slice(12, 12 + len(self.slope) - tail.start))], 0
        at = places[1][1].stop
        if following is not None:
            places.append((following, slice(at, at + 12)))
        for row, rows in places:
            self.slope[row] += slope[rows]
            for column, columns in places:
                self.hessian[row, column] += hessian[rows, columns]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Defects:
    """Ends of all D segments that another one follows: defects (D, 12) and their costs (D,).

    come: (D, 12, n) Jacobian of the arrivals. hessians, slopes: normal equations of start, numbers and next start.
    """

    defects: Array
    costs: Array
    come: Array | None = None
    hessians: Array | None = None
    slopes: Array | None = None

    @staticmethod
    def of(
        arrivals: Array,
        nexts: Array,
        covers: list[Array],
        slopes: bool,
        steps: Array,
        held: Evaluation | None,
        follows: NDArray[np.int64],
    ) -> _Defects:
        """Return those of ``arrivals`` (D, V, 13) at ``nexts`` (D, 13), with Student's distribution."""
        nu = CONTACT_DEGREES_OF_FREEDOM
        if not len(follows):
            return _Defects(defects=np.zeros((0, 12)), costs=np.zeros(0))
        defects = state_difference(arrivals[:, 0], nexts)
        scale = np.linalg.inv(np.array(covers))
        square = np.einsum("di,dij,dj->d", defects, scale, defects)
        costs = (nu + 12) * np.log1p(square / nu)
        if not slopes:
            return _Defects(defects=defects, costs=costs)
        scale = scale * ((nu + 12) / (nu + square))[:, None, None]
        first = arrivals[:, :1]
        up, down = state_difference(first, arrivals[:, 1::2]), state_difference(first, arrivals[:, 2::2])
        come = ((up - down) / (2 * steps[:, None])).swapaxes(1, 2)
        if held is not None:
            come = np.concatenate([np.array([held.segments[k].come for k in follows]), come], axis=2)
        both = np.concatenate([come, np.broadcast_to(-np.eye(12), (len(come), 12, 12))], axis=2)
        turned = both.swapaxes(1, 2) @ scale
        return _Defects(
            defects=defects,
            costs=costs,
            come=come,
            hessians=turned @ both,
            slopes=(turned @ defects[..., None])[..., 0],
        )


@dataclass(kw_only=True, eq=False)
class Evaluation:
    """Evaluation of one model at given states and numbers."""

    segments: list[Segment]
    linear: list[NormalEquations]
    cost: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """All trials of one body."""

    scene: BodyScene
    simulator: RigidWorlds
    trials: list[SegmentedTrial]

    def state_steps(self) -> Array:
        """Return the finite-difference steps (12,) of a state."""
        spin = SPEED_STEP / self.scene.body.bound
        return np.repeat([SHIFT_STEP, TURN_STEP, SPEED_STEP, spin], 3)

    def evaluate(
        self,
        model: Model,
        z: Array,
        states: list[Array],
        *,
        slopes: bool = True,
        held: Evaluation | None = None,
        fixed: bool = False,
    ) -> Evaluation:
        """Return residuals of ``model`` with numbers ``z`` (P,) at ``states``; with ``slopes`` normal equations too.

        z: (P,), or (trials, P). held: a nearby evaluation whose Jacobians with states and beliefs are reused (chord
        method). fixed: numbers are constant, derivatives only with the states.
        """
        scene, size = self.scene, 0 if fixed else model.size
        many = [self._variants(model, row, slopes, held is not None, fixed) for row in np.atleast_2d(z)]
        changes = many[0][0]
        around = [m[1] for m in many] if len(many) > 1 else [many[0][1]] * len(states)
        variants, settings = len(changes), many[0][1]
        owner = np.concatenate([np.zeros(variants - len(settings) + 1), np.arange(1, len(settings))]).astype(int)
        spans = [(i, j, a, b) for i, trial in enumerate(self.trials) for j, (a, b) in enumerate(trial.spans)]
        index = np.array([i for i, _, _, _ in spans])
        counts = np.array([b - a for _, _, a, b in spans])
        # The next node, where there is one, is one frame more.
        goes_on = np.array([b < self.trials[i].end for i, _, _, b in spans])
        clocks = np.zeros((len(spans), int((counts + goes_on).max())))
        for row, (i, _, a, _), more in zip(clocks, spans, counts + goes_on, strict=True):
            times = self.trials[i].observations.times
            row[:more] = times[a : a + more] - times[a]
        begins = np.concatenate(states)
        tables = np.array([scene.numbers(m[1]) for m in many])[:, owner]
        rates = np.array([[m[1][o].rate for o in owner] for m in many])
        which = index if len(many) > 1 else np.zeros_like(index)
        out = self.simulator.run(
            perturbed(begins[:, None], changes[None]).reshape(-1, 13),
            tables[which].reshape(-1, tables.shape[-1]),
            (clocks[:, None] * rates[which][..., None]).reshape(-1, clocks.shape[1]),
            np.repeat(counts + goes_on, variants),
        )
        out = out.reshape(len(spans), variants, *out.shape[1:])
        steps = np.concatenate([self.state_steps(), model.steps[:size]])
        if held is not None:
            steps = model.steps[BELIEFS.size :]
        ends = np.cumsum(counts)
        owners = np.repeat(np.arange(len(spans)), counts)
        columns = np.arange(int(ends[-1])) - np.repeat(ends - counts, counts)
        pose = self._flat_poses(out[owners, :, columns, :7], index[owners], around, owner)
        chi2, slope, info = self._information(pose[:, 0], spans, ends)
        weight = np.concatenate(
            [self.trials[i].weights[j] if j < len(self.trials[i].weights) else np.ones(b - a) for i, j, a, b in spans]
        )
        chi2 = chi2 * weight
        costs = np.bincount(index[owners], chi2, minlength=len(states))
        turn = _pose_slopes(pose, steps) if slopes else None
        if turn is not None:
            if held is not None:
                turn = np.concatenate([np.concatenate([s.turn for s in held.segments]), turn], axis=-1)
            slope, moved = slope * weight[:, None], (info * weight[:, None, None]) @ turn
        follows = np.flatnonzero(goes_on)
        arrivals = out[follows, :, counts[follows], :13]
        covers = [
            self.trials[i].covers[j] if j < len(self.trials[i].covers) else np.eye(12)
            for i, j, _, _ in (spans[k] for k in follows)
        ]
        ties = _Defects.of(arrivals, begins[follows + 1], covers, slopes, steps, held, follows)
        costs += np.bincount(index[follows], ties.costs, minlength=len(states))
        segments: list[Segment] = []
        linear = [
            NormalEquations(hessian=np.zeros((12 * len(s) + size,) * 2), slope=np.zeros(12 * len(s) + size), cost=c)
            for s, c in zip(states, map(float, costs), strict=True)
        ]
        met = 0
        for number, (i, j, a, b) in enumerate(spans):
            rows = slice(int(ends[number] - counts[number]), int(ends[number]))
            part, own, tail = linear[i], slice(12 * j, 12 * j + 12), slice(12 * len(states[i]), None)
            defect = come = None
            if turn is not None:
                flat = turn[rows].reshape(-1, turn.shape[-1])
                part.add(own, tail, flat.T @ moved[rows].reshape(flat.shape), flat.T @ slope[rows].ravel())
            if goes_on[number]:
                defect = ties.defects[met]
                if ties.come is not None and ties.hessians is not None and ties.slopes is not None:
                    come = ties.come[met]
                    part.add(own, tail, ties.hessians[met], ties.slopes[met], slice(12 * j + 12, 12 * j + 24))
                met += 1
            self._add_priors(part, i, j, states[i][j])
            segments.append(
                Segment(
                    trial=i,
                    index=j,
                    frames=np.arange(a, b),
                    record=out[number, 0, : counts[number]],
                    arrival=out[number, 0, counts[number] - (not goes_on[number])],
                    chi2=chi2[rows],
                    defect=defect,
                    turn=None if turn is None else turn[rows, :, : 12 + BELIEFS.size],
                    come=None if come is None else come[:, : 12 + BELIEFS.size],
                )
            )
        total = (float(z @ z) if z.ndim == 1 else 0.0) + sum(part.cost for part in linear)
        return Evaluation(segments=segments, linear=linear, cost=total)

    def _information(
        self, pose: Array, spans: list[tuple[int, int, int, int]], ends: NDArray[np.int64]
    ) -> tuple[Array, Array, Array]:
        """Return chi², descent direction and information (``ObservedBody.information``) of all segments' frames."""
        if all(t.observations.camera is None for t in self.trials):
            moments = PointMoments.joined([self.trials[i].observations.moments.at(slice(a, b)) for i, _, a, b in spans])
            return points_information(moments, pose[:, :3], pose[:, 3:])
        found = []
        for (i, _, a, b), end in zip(spans, ends, strict=True):
            rows = pose[end - (b - a) : end]
            found.append(self.trials[i].observations.information(rows[:, :3], rows[:, 3:], np.arange(a, b)))
        chi2, slope, info = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return chi2, slope, info

    def _flat_poses(
        self, pose: Array, index: NDArray[np.int64], around: list[list[WorldSettings]], owner: NDArray[np.int64]
    ) -> Array:
        """Return ``seen_poses`` of (F, V, 7), frames of the trials ``index`` (F,) under their settings ``around``."""
        for i in np.unique(index):
            if any(s.camera is not None for s in around[i]):
                mine = index == i
                own = np.ascontiguousarray(pose[mine].swapaxes(0, 1))
                pose[mine] = self.seen_poses(own, [around[i][o] for o in owner]).swapaxes(0, 1)
        return pose

    def _add_priors(self, part: NormalEquations, i: int, j: int, state: Array) -> None:
        """Add what is known of node ``j`` of trial ``i`` beside its observations."""
        trial, own = self.trials[i], slice(12 * j, 12 * j + 12)
        if trial.observations.camera is not None:
            # Pixels leave the depth open, but it cannot be below the ground.
            gap, rise = height(self.scene, state)
            sunk = min(gap, 0.0) / SUNK
            part.cost += sunk**2
            if sunk < 0:
                low = slice(12 * j, 12 * j + 6)
                part.hessian[low, low] += np.outer(rise, rise) / SUNK**2
                part.slope[low] -= rise * sunk / SUNK
        if j == 0:
            off, known = state_difference(state, trial.guess), np.diag(trial.prior**-2.0)
            if trial.spin_cover is not None:
                known[9:, 9:] = np.linalg.inv(trial.spin_cover)
            part.cost += float(off @ known @ off)
            part.hessian[own, own] += known
            part.slope[own] += known @ off

    def _variants(
        self, model: Model, z: Array, slopes: bool, held: bool, fixed: bool
    ) -> tuple[Array, list[WorldSettings]]:
        """Return start changes (V, 12) and settings of a segment's worlds: unperturbed, then central differences."""
        settings = [model.setting(self.scene, z)]
        if not slopes:
            return np.zeros((1, 12)), settings
        steps = self.state_steps()
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
                settings.append(model.setting(self.scene, shifted))
        return changes, settings

    def seen_poses(self, world: Array, settings: list[WorldSettings]) -> Array:
        """Return poses (V, F, 7) in the frame of the assumed camera."""
        pose = world[..., :7]
        if not any(s.camera is not None for s in settings):
            return pose
        pose = pose.copy()
        for v, s in enumerate(settings):
            if s.camera is not None:
                turn, shift = s.camera
                pose[v, :, :3] = pose[v, :, :3] @ turn.T + shift
                pose[v, :, QUATERNION] = multiply(_quaternion(turn), pose[v, :, QUATERNION])
        return pose


def _quaternion(turn: Array) -> Array:
    """Return the quaternion of a small rotation matrix."""
    from scipy.spatial.transform import Rotation

    return from_rotvec(Rotation.from_matrix(turn).as_rotvec())


def _pose_slopes(pose: Array, steps: Array) -> Array:
    """Return the Jacobian (F, 6, (V - 1) / 2) of poses (F, V, 7) from their central differences."""
    up, down = pose[:, 1::2], pose[:, 2::2]
    slopes = np.empty((len(pose), 6, len(steps)))
    slopes[:, :3] = (up[..., :3] - down[..., :3]).swapaxes(1, 2)
    slopes[:, 3:] = as_rotvec(multiply(up[..., QUATERNION], conjugate(down[..., QUATERNION]))).swapaxes(1, 2)
    return slopes / (2 * steps)
