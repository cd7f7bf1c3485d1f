# SPDX-License-Identifier: MIT
"""How well a model follows segmented trials: residuals and normal equations.

All segments of all trials, with all worlds for their derivatives, run in one launch, and their frames are judged
together; ``multiple_shooting`` fits with the results."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .observed_poses import QUATERNION, PointMoments, points_information, state_difference
from .quaternions import as_rotvec, conjugate, from_rotvec, multiply
from .resting_contact import height
from .rigid_candidates import BELIEFS
from .rigid_simulator import RigidWorlds
from .segment_paths import Model, Paths, Worlds, simulate_segments, worlds_of
from .segmented_trial import Evaluation, NormalEquations, Segment, SegmentedTrial
from .world_settings import BodyScene, WorldSettings

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SUNK = 1e-3
"""Penetration in m allowed to a state seen by one camera."""

CONTACT_DEGREES_OF_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of contact defects: a few are outliers."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Frames:
    """The F frames of all segments, judged: chi2 (F,), weighted.

    turn: (F, 6, n) Jacobian of the poses; moved: (F, 6, n) their information times it; slope: (F, 6) descent direction.
    """

    chi2: Array
    slope: Array
    turn: Array | None = None
    moved: Array | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Defects:
    """Ends of the D segments that another one follows: defects (D, 12) and, by Student's distribution, costs (D,).

    come: (D, 12, n) Jacobian of the arrivals. hessians, slopes: normal equations of start, numbers and next start.
    """

    defects: Array
    costs: Array
    come: Array | None = None
    hessians: Array | None = None
    slopes: Array | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """All trials of one body."""

    scene: BodyScene
    simulator: RigidWorlds
    trials: list[SegmentedTrial]

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
        worlds = worlds_of(model, self.scene, z, slopes=slopes, held=held is not None, fixed=fixed)
        paths = simulate_segments(self.simulator, self.scene, self.trials, worlds, states)
        frames = self._judged_frames(paths, worlds, slopes, held)
        defects = self._defects(paths, worlds, states, slopes, held)
        trials = paths.trials
        costs = np.bincount(trials[paths.owners], frames.chi2, minlength=len(states))
        costs += np.bincount(trials[paths.goes_on], defects.costs, minlength=len(states))
        linear = [
            NormalEquations(hessian=np.zeros((count, count)), slope=np.zeros(count), cost=float(cost))
            for count, cost in zip([12 * len(s) + (0 if fixed else model.size) for s in states], costs, strict=True)
        ]
        self._add_equations(linear, paths, frames, defects, states)
        total = (float(z @ z) if z.ndim == 1 else 0.0) + sum(part.cost for part in linear)
        return Evaluation(segments=_segments(paths, frames, defects), linear=linear, cost=total)

    def _judged_frames(self, paths: Paths, worlds: Worlds, slopes: bool, held: Evaluation | None) -> _Frames:
        """Return how well ``paths`` explain what was observed, with derivatives where ``slopes``."""
        pose = self._flat_poses(paths.poses(), paths.trials[paths.owners], worlds)
        chi2, slope, info = self._information(pose[:, 0], paths)
        weights = [
            self.trials[i].weights[j] if j < len(self.trials[i].weights) else np.ones(b - a)
            for i, j, a, b in paths.spans
        ]
        weight = np.concatenate(weights)
        if not slopes:
            return _Frames(chi2=chi2 * weight, slope=slope)
        turn = _pose_slopes(pose, worlds.steps)
        if held is not None:
            turn = np.concatenate([np.concatenate([s.turn for s in held.segments]), turn], axis=-1)
        moved = (info * weight[:, None, None]) @ turn
        return _Frames(chi2=chi2 * weight, slope=slope * weight[:, None], turn=turn, moved=moved)

    def _defects(
        self, paths: Paths, worlds: Worlds, states: list[Array], slopes: bool, held: Evaluation | None
    ) -> _Defects:
        """Return how far the ends of segments are from the starts of the next, with derivatives where ``slopes``."""
        follows = np.flatnonzero(paths.goes_on)
        if not len(follows):
            return _Defects(defects=np.zeros((0, 12)), costs=np.zeros(0))
        nu, steps = CONTACT_DEGREES_OF_FREEDOM, worlds.steps
        arrivals = paths.states[follows, :, paths.counts[follows], :13]
        ends = [(self.trials[i], j) for i, j, _, _ in (paths.spans[k] for k in follows)]
        covers = [trial.covers[j] if j < len(trial.covers) else np.eye(12) for trial, j in ends]
        defects = state_difference(arrivals[:, 0], np.concatenate(states)[follows + 1])
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

    def _add_equations(
        self,
        linear: list[NormalEquations],
        paths: Paths,
        frames: _Frames,
        defects: _Defects,
        states: list[Array],
    ) -> None:
        """Add the equations of frames, defects and priors to those of their trials, ``linear``."""
        met = 0
        for (i, j, _, _), rows, goes_on in zip(paths.spans, paths.rows, paths.goes_on, strict=True):
            part, own, tail = linear[i], slice(12 * j, 12 * j + 12), slice(12 * len(states[i]), None)
            if frames.turn is not None and frames.moved is not None:
                flat = frames.turn[rows].reshape(-1, frames.turn.shape[-1])
                part.add(
                    own, tail, flat.T @ frames.moved[rows].reshape(flat.shape), flat.T @ frames.slope[rows].ravel()
                )
            if goes_on:
                if defects.hessians is not None and defects.slopes is not None:
                    following = slice(12 * j + 12, 12 * j + 24)
                    part.add(own, tail, defects.hessians[met], defects.slopes[met], following)
                met += 1
            self._add_priors(part, i, j, states[i][j])

    def _information(self, pose: Array, paths: Paths) -> tuple[Array, Array, Array]:
        """Return chi², descent direction and information (``ObservedBody.information``) of all frames.

        pose: (F, 7) in them.
        """
        if all(t.observations.camera is None for t in self.trials):
            moments = PointMoments.joined(
                [self.trials[i].observations.moments.at(slice(a, b)) for i, _, a, b in paths.spans]
            )
            return points_information(moments, pose[:, :3], pose[:, 3:])
        found = []
        for (i, _, a, b), rows in zip(paths.spans, paths.rows, strict=True):
            mine = pose[rows]
            found.append(self.trials[i].observations.information(mine[:, :3], mine[:, 3:], np.arange(a, b)))
        chi2, slope, info = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return chi2, slope, info

    def _flat_poses(self, pose: Array, trials: Indices, worlds: Worlds) -> Array:
        """Return ``seen_poses`` of ``pose`` (F, V, 7), frames of ``trials`` (F,), in place."""
        for i in np.unique(trials):
            settings = worlds.settings[int(worlds.rows(i))]
            if any(s.camera is not None for s in settings):
                mine = trials == i
                own = np.ascontiguousarray(pose[mine].swapaxes(0, 1))
                pose[mine] = self.seen_poses(own, [settings[k] for k in worlds.chosen]).swapaxes(0, 1)
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


def _segments(paths: Paths, frames: _Frames, defects: _Defects) -> list[Segment]:
    """Return the segments with their unperturbed paths and what was found of them."""
    found: list[Segment] = []
    met = 0
    for number, ((i, j, a, b), rows) in enumerate(zip(paths.spans, paths.rows, strict=True)):
        defect = come = None
        if paths.goes_on[number]:
            defect = defects.defects[met]
            come = None if defects.come is None else defects.come[met]
            met += 1
        found.append(
            Segment(
                trial=i,
                index=j,
                frames=np.arange(a, b),
                record=paths.states[number, 0, : b - a],
                arrival=paths.states[number, 0, b - a - (not paths.goes_on[number])],
                chi2=frames.chi2[rows],
                defect=defect,
                turn=None if frames.turn is None else frames.turn[rows, :, : 12 + BELIEFS.size],
                come=None if come is None else come[:, : 12 + BELIEFS.size],
            )
        )
    return found
