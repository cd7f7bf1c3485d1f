# SPDX-License-Identifier: MIT
"""Multiple shooting: a trial as a chain of short flights and contacts.

A trial has states at nodes: at its start, after every impact, and at intervals in a long contact. From a node the
kernel runs to the next; the path is compared with the observations under their noise, and its end with the next node's
state under the uncertainty of contact models (how well simulators of impacts agree with each other, or with reality).
Bock and Plitt, A multiple shooting algorithm, IFAC 1984; Gauss–Newton steps, with the states eliminated trial by trial
(Schur complement).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded, solveh_banded
from scipy.special import gammaln

from .observed_poses import ObservedBody, as_rotvec, conjugate, from_rotvec, multiply, perturbed, state_difference
from .resting_contact import height
from .rigid_candidates import BELIEFS, BodyScene, CandidateEffect, WorldSettings
from .rigid_simulator import RigidWorlds

Array = NDArray[np.float64]

SHIFT_STEP, TURN_STEP, SPEED_STEP = 3e-4, 3e-3, 4e-3
"""Finite-difference steps in m, rad, m/s; spins: speed over the body's size. Smaller steps measure contact chatter."""

LONGEST_STEP = 2.0
"""Largest step of a number of an effect, in prior standard deviations."""

MOST_FAILURES = 3
"""Consecutive rejected steps after which a fit ends."""

PLAUSIBLE = 3.0
"""Prior standard deviations within which the nominal model's own numbers may move; beyond that it is an effect."""

SUNK = 1e-3
"""Penetration in m allowed to a state seen by one camera."""

CONTACT_DEGREES_OF_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution of contact defects: a few are outliers."""


@dataclass(kw_only=True, eq=False)
class SegmentedTrial:
    """A body in a trial, split at nodes. nodes: (N,) frames, rising. states: (N, 13). end: frame after the last used.

    prior: (12,) standard deviation of the initial guess of the first state. Per segment: covers, (12, 12) covariance
    of the defect at its end; weights, (F,) of its frames.
    """

    observations: ObservedBody
    nodes: list[int]
    states: Array
    end: int
    guess: Array
    prior: Array
    covers: list[Array] = field(default_factory=list)
    weights: list[Array] = field(default_factory=list)

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
        tables = [scene.numbers(m[1]) for m in many]
        rows = tables if len(many) > 1 else tables * len(states)
        owner = np.concatenate([np.zeros(variants - len(settings) + 1), np.arange(1, len(settings))]).astype(int)
        spans = [(i, j, a, b) for i, trial in enumerate(self.trials) for j, (a, b) in enumerate(trial.spans)]
        starts, times = [], []
        for i, j, a, b in spans:
            trial = self.trials[i]
            last = b if b < trial.end else b - 1
            clock = trial.observations.times[a : last + 1] - trial.observations.times[a]
            starts.append(perturbed(np.repeat(states[i][j][None], variants, axis=0), changes))
            times += [clock * around[i][o].rate for o in owner]
        numbers = np.concatenate([rows[i][owner] for i, _, _, _ in spans])
        out = self.simulator.run(np.concatenate(starts), numbers, times)
        out = out.reshape(len(spans), variants, *out.shape[1:])
        steps = np.concatenate([self.state_steps(), model.steps[:size]])
        if held is not None:
            steps = model.steps[BELIEFS.size :]
        segments: list[Segment] = []
        linear = [
            NormalEquations(hessian=np.zeros((12 * len(s) + size,) * 2), slope=np.zeros(12 * len(s) + size), cost=0.0)
            for s in states
        ]
        for number, ((i, j, a, b), world) in enumerate(zip(spans, out, strict=True)):
            trial = self.trials[i]
            old = held.segments[number] if held is not None else None
            turn = come = None
            part = linear[i]
            frames = np.arange(a, b)
            count = len(frames)
            pose = self.seen_poses(world[:, :count], [around[i][o] for o in owner])
            chi2, slope, info = trial.observations.information(pose[0, :, :3], pose[0, :, 3:7], frames)
            weight = trial.weights[j] if j < len(trial.weights) else np.ones(count)
            chi2 = chi2 * weight
            part.cost += float(chi2.sum())
            defect = None
            own = slice(12 * j, 12 * j + 12)
            where = np.r_[own, 12 * len(states[i]) : 12 * len(states[i]) + size]
            if slopes:
                turn = _pose_slopes(pose, steps)
                if old is not None:
                    turn = np.concatenate([old.turn, turn], axis=-1)
                info, slope = info * weight[:, None, None], slope * weight[:, None]
                part.hessian[np.ix_(where, where)] += np.einsum("fav,fab,fbw->vw", turn, info, turn, optimize=True)
                part.slope[where] += np.einsum("fav,fa->v", turn, slope)
            if b < trial.end:
                arrival = world[:, count]
                defect = state_difference(arrival[0, :13], states[i][j + 1])
                scale = np.linalg.inv(trial.covers[j]) if j < len(trial.covers) else np.eye(12)
                square = float(defect @ scale @ defect)
                nu = CONTACT_DEGREES_OF_FREEDOM
                part.cost += (nu + 12) * np.log1p(square / nu)
                if slopes:
                    scale = scale * (nu + 12) / (nu + square)
                    up, down = (
                        state_difference(arrival[:1, :13], arrival[1::2, :13]),
                        state_difference(arrival[:1, :13], arrival[2::2, :13]),
                    )
                    come = ((up - down) / (2 * steps[:, None])).T
                    if old is not None:
                        come = np.concatenate([old.come, come], axis=1)
                    both = np.concatenate([come, -np.eye(12)], axis=1)
                    spot = np.r_[where, 12 * (j + 1) : 12 * (j + 2)]
                    part.hessian[np.ix_(spot, spot)] += both.T @ scale @ both
                    part.slope[spot] += both.T @ scale @ defect
            if trial.observations.camera is not None:
                # Pixels leave the depth open, but it cannot be below the ground.
                gap, rise = height(scene, states[i][j])
                sunk = min(gap, 0.0) / SUNK
                part.cost += sunk**2
                if sunk < 0:
                    low = slice(12 * j, 12 * j + 6)
                    part.hessian[low, low] += np.outer(rise, rise) / SUNK**2
                    part.slope[low] -= rise * sunk / SUNK
            if j == 0:
                off = state_difference(states[i][0], trial.guess) / trial.prior
                part.cost += float(off @ off)
                part.hessian[own, own] += np.diag(trial.prior**-2.0)
                part.slope[own] += off / trial.prior
            segments.append(
                Segment(
                    trial=i,
                    index=j,
                    frames=frames,
                    record=world[0, :count],
                    arrival=world[0, count] if b < trial.end else world[0, count - 1],
                    chi2=chi2,
                    defect=defect,
                    turn=None if turn is None else turn[..., : 12 + BELIEFS.size],
                    come=None if come is None else come[:, : 12 + BELIEFS.size],
                )
            )
        total = (float(z @ z) if z.ndim == 1 else 0.0) + sum(part.cost for part in linear)
        return Evaluation(segments=segments, linear=linear, cost=total)

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
                pose[v, :, 3:7] = multiply(_quaternion(turn), pose[v, :, 3:7])
        return pose


def _quaternion(turn: Array) -> Array:
    """Return the quaternion of a small rotation matrix."""
    from scipy.spatial.transform import Rotation

    return from_rotvec(Rotation.from_matrix(turn).as_rotvec())


def _pose_slopes(pose: Array, steps: Array) -> Array:
    """Return the Jacobian (F, 6, (V - 1) / 2) of poses (V, F, 7) from their central differences."""
    up, down = pose[1::2], pose[2::2]
    shift = (up[..., :3] - down[..., :3]) / (2 * steps[:, None, None])
    turn = as_rotvec(multiply(up[..., 3:7], conjugate(down[..., 3:7]))) / (2 * steps[:, None, None])
    return np.moveaxis(np.concatenate([shift, turn], axis=-1), 0, -1)


@dataclass(kw_only=True, eq=False)
class Fit:
    """A fitted model. schur: (trials, P, P) information of each trial on the numbers; pull: (trials, P) its gradient.

    evidence: log probability of the data in nats.
    """

    problem: Problem
    model: Model
    z: Array
    states: list[Array]
    evaluation: Evaluation
    schur: Array
    pull: Array
    evidence: float

    @property
    def cost(self) -> float:
        """Return the objective, including the priors."""
        return self.evaluation.cost


def eliminate_states(linear: NormalEquations, size: int, damping: float) -> tuple[Array, Array, Array, Array]:
    """Return information on the numbers, its gradient, the states' response to them (12 N, P) and own step (12 N,)."""
    n = len(linear.slope) - size
    b, c = linear.hessian[:n, n:], linear.hessian[n:, n:]
    # States couple only to their neighbours: 23 off-diagonals. A banded solve also avoids the threads of a full one,
    # which wait for each other on a busy machine.
    band = np.zeros((24, n))
    for k in range(min(24, n)):
        band[k, : n - k] = np.diagonal(linear.hessian[:n, :n], -k)
    band[0] = band[0] * (1 + damping) + 1e-9
    solved = solveh_banded(band, np.concatenate([b, linear.slope[:n, None]], axis=1), lower=True, check_finite=False)
    answer, own = solved[:, :-1], solved[:, -1]
    return c - b.T @ answer, linear.slope[n:] - b.T @ own, answer, own


def solve(
    problem: Problem,
    model: Model,
    z: Array,
    states: list[Array],
    *,
    rounds: int = 8,
    tolerance: float = 0.2,
    held: Evaluation | None = None,
) -> Fit:
    """Return the fit by damped Gauss–Newton (Levenberg–Marquardt) from ``z`` (P,) and ``states``."""
    size = model.size
    best = problem.evaluate(model, z, states, held=held)
    damping, failed = 1e-3, 0
    for _ in range(rounds):
        parts = [eliminate_states(part, size, damping) for part in best.linear]
        matrix = np.eye(size) + sum(p[0] for p in parts)
        matrix[np.diag_indices(size)] *= 1 + damping
        step = np.linalg.solve(matrix, sum(p[1] for p in parts) - z)
        step = np.clip(step, -LONGEST_STEP, LONGEST_STEP)
        step[: BELIEFS.size] = (
            np.clip(z[: BELIEFS.size] + step[: BELIEFS.size], -PLAUSIBLE, PLAUSIBLE) - z[: BELIEFS.size]
        )
        tried = [
            perturbed(s, (own - answer @ step).reshape(-1, 12))
            for s, (_, _, answer, own) in zip(states, parts, strict=True)
        ]
        # Jacobians cost tens of worlds: where a step may be rejected, one world decides first.
        new = problem.evaluate(model, z + step, tried, held=held, slopes=held is not None and not failed)
        if np.isfinite(new.cost) and new.cost < best.cost:
            gain = best.cost - new.cost
            if held is None or failed:
                new = problem.evaluate(model, z + step, tried, held=held)
            z, states, best, damping, failed = z + step, tried, new, max(damping / 5, 1e-6), 0
            if gain < tolerance:
                break
        else:
            failed += 1
            damping *= 20
            if failed > MOST_FAILURES:
                break
    parts = [eliminate_states(part, size, 0.0) for part in best.linear]
    schur, pull = np.array([p[0] for p in parts]), np.array([p[1] for p in parts])
    matrix = np.eye(size) + schur.sum(axis=0)
    evidence = -0.5 * best.cost - 0.5 * float(np.linalg.slogdet(0.5 * (matrix + matrix.T))[1])
    evidence += _volumes(problem, best, size)
    return Fit(
        problem=problem, model=model, z=z, states=states, evaluation=best, schur=schur, pull=pull, evidence=evidence
    )


def _volumes(problem: Problem, evaluation: Evaluation, size: int) -> float:
    """Return the log Laplace integral over the states relative to the volumes of priors and defects.

    It hardly differs between candidates with the same nodes, and makes those with other nodes comparable.
    """
    total = 0.0
    nu = CONTACT_DEGREES_OF_FREEDOM
    # Student's distribution relative to the normal one, in 12 dimensions.
    student = gammaln((nu + 12) / 2) - gammaln(nu / 2) - 6 * np.log(nu / 2)
    for trial, part in zip(problem.trials, evaluation.linear, strict=True):
        n = len(part.slope) - size
        hessian = part.hessian[:n, :n]
        band = np.zeros((24, n))
        for k in range(min(24, n)):
            band[k, : n - k] = np.diagonal(hessian, -k)
        total -= float(np.sum(np.log(np.abs(cholesky_banded(band + 0.0, lower=True, check_finite=False)[0]))))
        total -= float(np.sum(np.log(trial.prior)))
        for cover in trial.covers[: len(trial.nodes) - 1]:
            total += float(student) - 0.5 * float(np.sum(np.log(np.diag(cover))))
    return total
