# SPDX-License-Identifier: MIT
"""One implicit step of a world of elastic bodies: Newton's method with conjugate gradients on the nodes.

Backward Euler in the deformation only. The rigid part of each body's motion, found from its nodes, is taken ahead
exactly: the centre of mass on its parabola, the angular momentum kept. The solver looks for what is left, a change v of
the nodes' velocities after the rigid prediction u*,

    M v = dt f(u* + dt v)          f: elasticity and surfaces at the end of the step, see ``kernels.implicit_step``

so a body in free flight is not slowed down or stopped from turning by a long step, and has nothing to solve. Waves that
the step does not resolve are damped, as backward Euler does. Whatever is left of the equation when the iteration ends
acts as the rigid motion that has its momentum and angular momentum, so both are exact up to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .kernels import implicit_contact, implicit_step
from .kernels.implicit_contact import ImplicitArrays
from .kernels.implicit_step import FARTHEST, FASTEST, HIT, PRESSED, REPORT
from .kernels.kernel_arrays import (
    GridBlocks,
    NearBlocks,
    NodeArrays,
    ParticleArrays,
    ParticleBlocks,
    RigidArrays,
    ShapeArrays,
    WorldArrays,
)
from .kernels.layout import BLOCK_NODES, SCALARS_PER_BLOCK, vec4
from .kernels.runtime import new_array

Array = NDArray[np.float64]

TOLERANCE = 0.01
"""Acceleration over gravity that may be left unbalanced, r.m.s. over the mass."""

WAVES, FLIGHT_GRADIENTS = 0.1, 8
"""Share of what is unbalanced at first that may be left in flight, and iterations after which the rest is left anyway:
waves of a body that nothing touches move nothing else, and conjugate gradients lower their energy at any number."""

ROUNDING = 2e-7
"""Cells by which rounding displaces a particle against its neighbours; more accuracy than this is not there."""

MOST_NEWTON, MOST_GRADIENTS = 12, 400
"""Iterations at most of Newton's method, and of conjugate gradients in each."""

MOST_HALVINGS = 4
"""Times at most that a step of Newton's method is tried at half its length because it did not help."""

LEAST_SLIDING = 0.05
"""Acceleration along a surface over gravity above which a body is expected to go on sliding."""

FORCING = 0.1
"""Share of the residual that conjugate gradients leave."""


class Matter(NamedTuple):
    """Bundles of the engine's arrays that a step reads and writes."""

    worlds: WorldArrays
    blocks: ParticleBlocks
    grid: GridBlocks
    near: NearBlocks
    particles: ParticleArrays
    nodes: NodeArrays
    colliders: RigidArrays
    shapes: ShapeArrays


@dataclass(frozen=True)
class StepReport:
    """How a step went. Speeds in cells/s."""

    done: bool
    """Whether the particles have moved; if not, they are as they were."""

    hit: float = 0.0
    """Largest speed at which matter that touched no surface before would have reached one."""

    passes: int = 0
    """Passes over all particles."""

    speed: float = 0.0
    """Of the fastest particle."""

    farthest: float = 0.0
    """Cells that a particle moved at most."""


class Nodes:
    """The nodes that hold mass, body by body: places x (n, 3) in cells, masses m (n, 1) in kg, velocities v (n, 3)."""

    def __init__(self, matter: Matter, momentum: Array) -> None:
        """momentum: (G BLOCK_NODES, 4) momentum and mass of all nodes."""
        self.index = np.flatnonzero(momentum[:, 3] > 0.0)
        block = self.index // BLOCK_NODES
        inner = self.index % BLOCK_NODES
        cells = matter.grid.cells.to_numpy()[: matter.grid.count].astype(np.float64)
        self.x = 4.0 * cells[block] + np.stack([inner // 16, inner // 4 % 4, inner % 4], axis=1)
        self.m = momentum[self.index, 3:4]
        self.v = momentum[self.index, :3] / self.m
        field = matter.grid.field.to_numpy()[: matter.grid.count][block]
        starts = np.flatnonzero(np.diff(field, prepend=-1))
        self.spans = {int(field[a]): slice(a, b) for a, b in zip(starts, [*starts[1:], len(field)], strict=True)}
        """Where the nodes of each field are."""

    def rms(self, v: Array) -> float:
        """Root of the mean square of velocities ``v`` (n, 3), weighed by mass."""
        return math.sqrt(float((self.m * v * v).sum() / self.m.sum()))


class Rigid(NamedTuple):
    """Rigid motion of a body: centre of mass, its velocity, angular momentum, inertia, angular velocity."""

    centre: Array
    velocity: Array
    momentum: Array
    inertia: Array
    spin: Array

    def at(self, x: Array) -> Array:
        """Velocity (n, 3) at the places ``x`` (n, 3)."""
        return np.asarray(self.velocity + np.cross(self.spin, x - self.centre))


def rigid_part(m: Array, x: Array, v: Array) -> Rigid:
    """The rigid motion with the momentum and angular momentum of masses (n, 1) at (n, 3) with velocities (n, 3)."""
    mass = m.sum()
    centre, velocity = (m * x).sum(axis=0) / mass, (m * v).sum(axis=0) / mass
    arm = x - centre
    momentum = (m * np.cross(arm, v - velocity)).sum(axis=0)
    inertia = np.eye(3) * (m * arm * arm).sum() - (m[:, :, None] * arm[:, :, None] * arm[:, None, :]).sum(axis=0)
    # What lies on a line has no inertia about it.
    spin = np.linalg.pinv(inertia, hermitian=True) @ momentum
    return Rigid(centre, velocity, momentum, inertia, spin)


class Prediction(NamedTuple):
    """A body after a step of its rigid motion: displacements (n, 3), that motion, the deforming velocities (n, 3) that
    are left, turned along, and the acceleration (3,) along a surface that it slides with: 0 where it sticks, None in
    flight."""

    shift: Array
    rigid: Rigid
    rest: Array
    sliding: Array | None

    def motion(self, x: Array, v: Array) -> Array:
        """Velocities of nodes that have come to ``x`` with the change ``v`` of velocity."""
        return np.asarray(self.rigid.at(x) + self.rest + v)

    def restored(self, m: Array, x: Array, left: Array) -> Array:
        """Velocities (n, 3) with the momentum that the solver has ``left`` over: in flight of a rigid motion, in
        sliding of one along the way. What sticks to a surface has given it away."""
        if self.sliding is None:
            return rigid_part(m, x, left / m).at(x)
        size = float(self.sliding @ self.sliding)
        along = self.sliding * (float(left.sum(axis=0) @ self.sliding) / (size * float(m.sum()))) if size > 0 else 0.0
        return np.asarray(np.zeros_like(x) + along)


def predict(m: Array, x: Array, v: Array, gravity: Array, dt: float, *, support: Array | None) -> Prediction:
    """Prediction for a body of masses (n, 1) at (n, 3) with velocities (n, 3), which nothing but gravity acts on.

    Falling for dt s it covers g dt²/2; with a ``support`` (3,), the acceleration that surfaces may give it, g dt², so
    that the same change of velocity cancels fall and speed; where it slides, the way is that of the mean speed, too.
    """
    sliding = None if support is None else gravity + support
    ahead = 0.5 * gravity if sliding is None else gravity - 0.5 * sliding
    rigid = rigid_part(m, x, v)
    spin = rigid.spin
    for _ in range(3):
        # The angular velocity of the middle of the step, where the body has turned by half.
        half = Rotation.from_rotvec(0.5 * dt * spin).as_matrix()
        spin = np.linalg.solve(half @ rigid.inertia @ half.T, rigid.momentum)
    R = Rotation.from_rotvec(dt * spin).as_matrix()
    centre = rigid.centre + dt * rigid.velocity + dt * dt * ahead
    inertia = R @ rigid.inertia @ R.T
    spin = np.linalg.solve(inertia, rigid.momentum)
    after = Rigid(centre, rigid.velocity + dt * gravity, rigid.momentum, inertia, spin)
    rest = (v - rigid.at(x)) @ R.T
    shift = centre + (x - rigid.centre) @ R.T - x + dt * rest
    return Prediction(shift, after, rest, sliding)


class Unbalanced(NamedTuple):
    """What the forces of a trial exceed the change of momentum by (n, 3), kg cells/s, and that as a speed, r.m.s."""

    left: Array
    speed: float


class ImplicitSteps:
    """Steps of a world with the set ``laws`` of elastic models, with arrays of their own on the device."""

    def __init__(self, laws: int) -> None:
        self._forces = implicit_step.find_forces_of(laws)
        self._stiffness = implicit_step.multiply_stiffness_of(laws)
        self._diagonal = implicit_step.find_diagonal_of(laws)
        self._move = implicit_step.move_particles_of(laws)
        self._room = (0, 0, 0)
        self._make_room((1, 1, 1))
        self._passes = 0

    def _make_room(self, room: tuple[int, int, int]) -> None:
        """Arrays for so many nodes, particles and blocks of particles."""
        if room == self._room:
            return
        nodes, particles, blocks = self._room = room
        self._arrays = ImplicitArrays(
            given=new_array(vec4, nodes),
            motion=new_array(vec4, nodes),
            found=new_array(vec4, nodes),
            contact=new_array(vec4, particles),
            surface=new_array(vec4, particles),
            carried=new_array(vec4, particles),
            report=new_array(ti.f32, blocks * REPORT),
        )
        self._host = np.zeros((nodes, 4), dtype=np.float32)

    # ---- kernels ------------------------------------------------------------------------------------------------

    def _put(self, array: ti.Ndarray, nodes: Nodes, values: Array) -> None:
        self._host[nodes.index, :3] = values
        array.from_numpy(self._host)

    def _run(self, kernel: Any, dt: float, matter: Matter, nodes: Nodes) -> Array:
        """What a kernel finds at the nodes (n, 3)."""
        kernel.launch(dt, matter.worlds, matter.blocks, matter.grid, matter.particles, matter.nodes, self._arrays)
        self._passes += 1
        return np.asarray(self._arrays.found.to_numpy()[nodes.index, :3], dtype=np.float64)

    def _reported(self, matter: Matter) -> Array:
        return np.asarray(self._arrays.report.to_numpy()[: matter.blocks.count * REPORT].reshape(-1, REPORT))

    def _unbalanced(self, start: Array, change: Array, dt: float, matter: Matter, nodes: Nodes) -> Unbalanced:
        """Of the trial with the changes ``change`` (n, 3) of velocity after the displacements ``start``."""
        self._put(self._arrays.given, nodes, start + dt * change)
        left = dt * self._run(self._forces, dt, matter, nodes) - nodes.m * change
        return Unbalanced(left, nodes.rms(left / nodes.m))

    # ---- a step -------------------------------------------------------------------------------------------------

    def step(self, dt: float, gravity: Array, most_hit: float, stiff: float, matter: Matter) -> StepReport:
        """Take a step of ``dt`` s under ``gravity`` (3,) in cells/s².

        most_hit: speed in cells/s above which matter that comes to the ground ends the attempt. stiff: speed of the
        fastest wave, cells/s.
        """
        blocks = matter.blocks.report.shape[0] // SCALARS_PER_BLOCK
        self._make_room((matter.nodes.velocity.shape[0], matter.particles.x.shape[0], blocks))
        self._passes = 1
        launch = implicit_step.gather_momentum.launch
        launch(matter.blocks, matter.grid, matter.particles, matter.nodes, self._arrays)
        momentum = self._arrays.found.to_numpy()[: matter.grid.count * BLOCK_NODES].astype(np.float64)
        nodes = Nodes(matter, momentum)
        self._host[:] = 0.0
        implicit_contact.find_surfaces.launch(
            dt,
            matter.worlds,
            matter.blocks,
            matter.near,
            matter.particles,
            matter.colliders,
            matter.shapes,
            self._arrays,
        )
        parts = {
            field: predict(nodes.m[s], nodes.x[s], nodes.v[s], gravity, dt, support=None)
            for field, s in nodes.spans.items()
        }
        start = np.concatenate([part.shift for part in parts.values()])
        change = np.zeros_like(start)
        now = self._unbalanced(start, change, dt, matter, nodes)
        report = self._reported(matter)
        hit = float(report[:, HIT].max())
        if hit > most_hit:
            return StepReport(done=False, hit=hit, passes=self._passes)
        pressing = np.unique(matter.blocks.field.to_numpy()[: matter.blocks.count][report[:, PRESSED] > 0.0])
        for field in map(int, pressing):
            s = nodes.spans[field]
            support = self._support(field, gravity, matter)
            parts[field] = predict(nodes.m[s], nodes.x[s], nodes.v[s], gravity, dt, support=support)
            start[s] = parts[field].shift
            change[s] = dt * support
        tolerance = max(TOLERANCE * float(np.linalg.norm(gravity)), ROUNDING * stiff * stiff) * dt
        flies = not len(pressing)
        if flies:
            # Nothing but waves is left to solve for, which the step damps anyway.
            tolerance = max(tolerance, WAVES * now.speed)
        else:
            now = self._unbalanced(start, change, dt, matter, nodes)
        solved = self._solve_step(start, change, now, tolerance, flies, dt, matter, nodes)
        if solved is None:
            return StepReport(done=False, passes=self._passes)
        return self._finish(dt, parts, start, *solved, matter, nodes)

    def _support(self, field: int, gravity: Array, matter: Matter) -> Array:
        """Acceleration (3,) that surfaces give to the body ``field`` if they carry the weight and rub as in the step
        before: for what rests or slides, the solution. What hardly slides is taken to stick, since stiff springs hold
        it then."""
        starts = matter.blocks.starts.to_numpy()[: matter.blocks.count + 1]
        mine = np.repeat(matter.blocks.field.to_numpy()[: matter.blocks.count] == field, np.diff(starts))
        masses, past, normals = (
            array.to_numpy()[: starts[-1]][mine].astype(np.float64)
            for array in (matter.particles.constants, matter.particles.reaction, self._arrays.surface)
        )
        forces, normals = masses[:, :1] * past[:, :3], normals[:, :3]
        pressing = ((forces * normals).sum(axis=1, keepdims=True) * normals).sum(axis=0)
        size = float(np.linalg.norm(pressing))
        if size == 0.0:
            return np.asarray(-gravity)
        along = gravity + forces.sum(axis=0) / masses[:, 0].sum()
        along -= (along @ pressing) / size**2 * pressing
        slides = float(np.linalg.norm(along)) > LEAST_SLIDING * float(np.linalg.norm(gravity))
        return np.asarray(along - gravity if slides else -gravity)

    def _solve_step(
        self,
        start: Array,
        change: Array,
        now: Unbalanced,
        tolerance: float,
        flies: bool,
        dt: float,
        matter: Matter,
        nodes: Nodes,
    ) -> tuple[Array, Unbalanced] | None:
        """Newton's method from the trial ``change``, until no more than ``tolerance`` (cells/s) is unbalanced; of what
        ``flies`` a few iterations. Returns the changes of velocity and what is unbalanced, None if it fails."""
        if now.speed <= tolerance:
            return change, now
        diagonal = nodes.m + dt * dt * self._run(self._diagonal, dt, matter, nodes)
        for _ in range(1 if flies else MOST_NEWTON):
            if not math.isfinite(now.speed):
                return None
            most = FLIGHT_GRADIENTS if flies else MOST_GRADIENTS
            share = max(FORCING, 0.5 * tolerance / now.speed)
            found = self._conjugate_gradients(now.left, share, most, diagonal, dt, matter, nodes)
            before = now.speed
            for _ in range(MOST_HALVINGS):
                now = self._unbalanced(start, change + found, dt, matter, nodes)
                if now.speed < before:
                    break
                found *= 0.5
            change = change + found
            if now.speed <= tolerance:
                return change, now
        return (change, now) if flies and math.isfinite(now.speed) else None

    def _conjugate_gradients(
        self, right: Array, share: float, most: int, diagonal: Array, dt: float, matter: Matter, nodes: Nodes
    ) -> Array:
        """Solution (n, 3) of (M + dt² K) x = right after ``most`` iterations, or when ``share`` of what was unbalanced
        is left; preconditioned with the ``diagonal``."""
        x = np.zeros_like(right)
        r = right.copy()
        z = r / diagonal
        p = z.copy()
        rz = float((r * z).sum())
        goal = share * nodes.rms(right / nodes.m)
        for _ in range(most):
            self._put(self._arrays.given, nodes, p)
            q = nodes.m * p + dt * dt * self._run(self._stiffness, dt, matter, nodes)
            alpha = rz / float((p * q).sum())
            x += alpha * p
            r -= alpha * q
            if nodes.rms(r / nodes.m) <= goal:
                break
            z = r / diagonal
            rz, old = float((r * z).sum()), rz
            p = z + (rz / old) * p
        return x

    def _finish(
        self,
        dt: float,
        parts: Mapping[int, Prediction],
        start: Array,
        change: Array,
        now: Unbalanced,
        matter: Matter,
        nodes: Nodes,
    ) -> StepReport:
        """Move the particles by the solution ``change``."""
        shift = start + dt * change
        place = nodes.x + shift
        motion = np.zeros_like(shift)
        for field, s in nodes.spans.items():
            motion[s] = parts[field].motion(place[s], change[s])
            motion[s] += parts[field].restored(nodes.m[s], place[s], now.left[s])
        self._put(self._arrays.given, nodes, shift)
        self._put(self._arrays.motion, nodes, motion)
        self._move.launch(dt, matter.worlds, matter.blocks, matter.particles, matter.nodes, self._arrays)
        report = self._reported(matter)
        return StepReport(
            done=True,
            passes=self._passes + 1,
            speed=math.sqrt(float(report[:, FASTEST].max())),
            farthest=float(report[:, FARTHEST].max()),
        )
