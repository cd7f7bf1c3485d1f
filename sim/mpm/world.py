# SPDX-License-Identifier: MIT
"""The engine's facade: a world of bodies above a ground, in metres, kilograms and seconds.

similarity = fit_similarity([vertices], ground, options=options)
sample = sample_interior(vertices, faces, options.particle_spacing(similarity))
world = World(bodies=[BodyParticles(...)], ground=ground, similarity=similarity, options=options)
world.advance(1 / 24)
world.positions(0)
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, SimulationError
from ..scene.units import ENGINE_BOX_SIZE, Similarity
from . import diagnostics, runtime
from .bodies import BodyParticles, Vector
from .engine import Diverged, Engine, EngineOptions, Matter, Plane
from .fitting import FittedGradients
from .materials import bounding_speed
from .options import PADDING_CELLS, Ground, SolverOptions
from .placement import fit_similarity

Array = NDArray[np.float64]

CHECKPOINT_FORMAT = 1

DEEPEST_START = 1.0
"""Cells that a body may stand in the ground at the start; it is pushed out gently. Deeper is an error."""

STANDARD_GRAVITY: Vector = (0.0, 0.0, -9.81)


class World:
    """Bodies above a ground plane, advanced in time.

    bodies: in the order in which ``positions(i)`` and the rest count them.
    ground: the plane that carries them, or None for free flight.
    gravity: m/s².
    similarity: where the world stands in the engine's box; None fits it to the bodies.

    Deterministic on the CPU: equal input gives equal bytes. Raises InputError when a body does not fit into the box
    or stands too deep in the ground.
    """

    def __init__(
        self,
        *,
        bodies: Sequence[BodyParticles],
        ground: Ground | None = None,
        gravity: Vector = STANDARD_GRAVITY,
        similarity: Similarity | None = None,
        options: SolverOptions | None = None,
    ) -> None:
        if not bodies:
            raise InputError("bodies is empty: give at least one body")
        if len(gravity) != 3 or not all(math.isfinite(c) for c in gravity):
            raise InputError(f"gravity is {gravity!r}: give three finite numbers in m/s²")
        self.options = options or SolverOptions()
        self.bodies = tuple(bodies)
        self.ground = ground
        self.gravity = gravity
        self.similarity = similarity or fit_similarity(
            [body.positions for body in bodies], ground, options=self.options
        )
        self._cells = Similarity(
            scale=self.similarity.scale * self.options.grid / ENGINE_BOX_SIZE, origin=self.similarity.origin
        )
        self._offsets = np.concatenate([[0], np.cumsum([body.count for body in bodies])])
        self._check_placement()
        self.arch, self._generation = runtime.ensure_started(self.options)
        self._time = 0.0
        self._started = [False] * len(bodies)
        self._engine = self._new_engine()
        self._host: dict[str, NDArray[np.generic]] | None = None
        self._fits: dict[int, FittedGradients] = {}
        self._start_bodies()

    # ---- setup --------------------------------------------------------------------------------------------------

    def _check_placement(self) -> None:
        for body in self.bodies:
            cells = self._cells.points_to_engine(body.positions)
            low, high = float(np.min(cells)), float(np.max(cells))
            if low < PADDING_CELLS or high > self.options.grid - PADDING_CELLS:
                raise InputError(
                    f"body {body.name!r}: positions span {low:.1f} to {high:.1f} of {self.options.grid} cells, the box "
                    f"holds {PADDING_CELLS} to {self.options.grid - PADDING_CELLS}: use fit_similarity, or a smaller "
                    f"similarity scale than {self.similarity.scale:g}"
                )
            if self.ground is not None:
                assert body.contact_radii is not None
                heights = (body.positions - np.asarray(self.ground.point)) @ self._normal()
                gap = float((heights - body.contact_radii).min())
                if gap < -DEEPEST_START / self._cells.scale:
                    raise InputError(
                        f"body {body.name!r}: positions reach {-gap:g} m below the ground: lift the body by that much"
                    )

    def _normal(self) -> Array:
        assert self.ground is not None
        normal = np.asarray(self.ground.normal, dtype=np.float64)
        return np.asarray(normal / np.linalg.norm(normal))

    def _new_engine(self) -> Engine:
        plane = None
        if self.ground is not None:
            normal = self._normal()
            point = self._cells.points_to_engine(np.asarray(self.ground.point))
            plane = Plane(
                normal=(float(normal[0]), float(normal[1]), float(normal[2])),
                offset=float(normal @ point),
                friction=self.ground.friction,
            )
        o = self.options
        return Engine(
            capacity=int(self._offsets[-1]),
            options=EngineOptions(
                grid=o.grid,
                cfl_elastic=o.cfl_elastic,
                cfl_velocity=o.cfl_velocity,
                max_step=o.max_step,
            ),
            plane=plane,
            gravity=(
                self._cells.length(self.gravity[0]),
                self._cells.length(self.gravity[1]),
                self._cells.length(self.gravity[2]),
            ),
            matter=Matter(
                laws=functools.reduce(operator.or_, (body.material.laws for body in self.bodies)),
                table=tuple(body.material.row for body in self.bodies),
            ),
        )

    def _start_bodies(self) -> None:
        """Bring in the bodies whose time has come."""
        for i, body in enumerate(self.bodies):
            if self._started[i] or body.start_time > self._time + 1e-12:
                continue
            self._started[i] = True
            assert body.contact_radii is not None
            scale = self._cells.scale
            volumes = body.volumes * scale**3
            constants = np.stack(
                [
                    body.masses,
                    self._cells.modulus(body.material.shear_number) * volumes,
                    self._cells.modulus(body.material.bulk_number) * volumes,
                    body.contact_radii * scale,
                ],
                axis=1,
            )
            self._engine.add(
                x=self._cells.points_to_engine(body.positions),
                v=body.initial_velocities * scale,
                C=np.broadcast_to(body.initial_velocity_gradient, (body.count, 3, 3)),
                F=np.broadcast_to(np.eye(3), (body.count, 3, 3)),
                constants=constants,
                ids=np.arange(self._offsets[i], self._offsets[i + 1], dtype=np.int32),
                wave_speed=bounding_speed(
                    self._cells.length(body.material.wave_speed), scale**2 * body.material.diffusivity
                ),
                material=i,
            )
            self._host = None

    # ---- time ---------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time in s."""
        return self._time

    @property
    def substeps(self) -> int:
        """Substeps taken since the world was made."""
        return self._engine.substeps

    @property
    def stable_step(self) -> float:
        """Longest substep in s that the present state allows."""
        return self._engine.stable_step()

    @property
    def device_bytes(self) -> int:
        """Bytes that the engine's arrays take on the device."""
        return self._engine.device_bytes

    def advance(self, duration: float) -> None:
        """Advance by exactly ``duration`` seconds, in substeps that are stable.

        Raises SimulationError that names the body when the state is not finite any more.
        """
        if not (math.isfinite(duration) and duration >= 0):
            raise InputError(f"duration is {duration!r}: give seconds, 0 or more")
        self._check_generation()
        end = self._time + duration
        while True:
            self._start_bodies()
            waiting = [b.start_time for b, started in zip(self.bodies, self._started, strict=True) if not started]
            until = min([end, *(t for t in waiting if t < end)])
            if until > self._time:
                try:
                    self._engine.advance(until - self._time)
                except Diverged:
                    self._host = None
                    raise self._lost() from None
                self._host = None
            self._time = until
            if until >= end:
                self._start_bodies()
                return

    def _lost(self) -> SimulationError:
        state = self._state()
        finite = np.isfinite(state["v"]).all(axis=1) & np.isfinite(state["F"]).all(axis=(1, 2))
        speeds = np.where(finite, np.abs(np.nan_to_num(np.asarray(state["v"], dtype=np.float64))).max(axis=1), np.inf)
        worst = int(np.asarray(state["ids"])[int(np.argmax(speeds))])
        name = self.bodies[int(np.searchsorted(self._offsets, worst, side="right")) - 1].name
        return SimulationError(
            f"body {name!r} became unstable near t = {self._time:g} s: check its density and Young's modulus, or lower "
            f"the solver option cfl_elastic ({self.options.cfl_elastic:g})"
        )

    def _check_generation(self) -> None:
        if self._generation != runtime.generation():
            raise SimulationError(
                "the compute runtime was restarted with other options after this world was made: make a new world and "
                "restore its checkpoint"
            )

    # ---- state --------------------------------------------------------------------------------------------------

    def _state(self) -> dict[str, NDArray[np.generic]]:
        self._check_generation()
        if self._host is None:
            self._host = self._engine.state()
        return self._host

    def _gather(self, name: str, index: int, resting: Array) -> Array:
        """Values of one body in the original particle order; ``resting`` where it has not started yet."""
        if not 0 <= index < len(self.bodies):
            raise InputError(f"body index is {index}: give 0 to {len(self.bodies) - 1}")
        if not self._started[index]:
            return resting
        state = self._state()
        ids = np.asarray(state["ids"], dtype=np.int64)
        mine = (ids >= self._offsets[index]) & (ids < self._offsets[index + 1])
        values = np.asarray(state[name][mine], dtype=np.float64)
        ordered = np.empty_like(values)
        ordered[ids[mine] - self._offsets[index]] = values
        return ordered

    def positions(self, index: int) -> Array:
        """Particle positions (N, 3) of body ``index``, world metres, in the order in which they were given."""
        body = self._body(index)
        if not self._started[index]:
            return body.positions.copy()
        return self._cells.points_to_world(self._gather("position", index, np.zeros((body.count, 3))))

    def velocities(self, index: int) -> Array:
        """Particle velocities (N, 3) of body ``index``, m/s. Zero before the body starts."""
        return self._gather("v", index, np.zeros((self._body(index).count, 3))) / self._cells.scale

    def velocity_gradients(self, index: int) -> Array:
        """APIC velocity gradients (N, 3, 3) of body ``index``, 1/s."""
        return self._gather("C", index, np.zeros((self._body(index).count, 3, 3)))

    def deformation_gradients(self, index: int) -> Array:
        """Deformation gradients (N, 3, 3) of body ``index``: current from undeformed shape.

        Of matter that flows they are fitted to the particles' positions, because its own deformation gradient knows
        the elastic part only; see ``fitting``.
        """
        body = self._body(index)
        if not body.material.flows:
            return self.elastic_gradients(index)
        if index not in self._fits:
            self._fits[index] = FittedGradients(body.positions)
        return self._fits[index].gradients(self.positions(index))

    def elastic_gradients(self, index: int) -> Array:
        """Elastic parts (N, 3, 3) of the deformation gradients of body ``index``, which carry its stress."""
        return self._gather("F", index, np.broadcast_to(np.eye(3), (self._body(index).count, 3, 3)).copy())

    def memories(self, index: int) -> Array:
        """What the law remembers of each particle (N,): ln J_P of snow, ln of lost contact in sand, ln J of fluids."""
        body = self._body(index)
        if not body.material.flows:
            return np.zeros(body.count)
        return self._gather("memory", index, np.zeros(body.count))

    def _body(self, index: int) -> BodyParticles:
        if not 0 <= index < len(self.bodies):
            raise InputError(f"body index is {index}: give 0 to {len(self.bodies) - 1}")
        return self.bodies[index]

    # ---- diagnostics --------------------------------------------------------------------------------------------

    def _moving(self) -> list[int]:
        return [i for i, started in enumerate(self._started) if started]

    def linear_momentum(self) -> Array:
        """Momentum (3,) of all bodies, kg m/s."""
        terms = [diagnostics.linear_momentum(self.bodies[i].masses, self.velocities(i)) for i in self._moving()]
        return np.asarray(np.sum(terms, axis=0)) if terms else np.zeros(3)

    def angular_momentum(self, about: Vector = (0.0, 0.0, 0.0)) -> Array:
        """Angular momentum (3,) of all bodies about a world point, kg m²/s, with the affine velocities' part."""
        terms = [
            diagnostics.angular_momentum(
                self.bodies[i].masses,
                self.positions(i),
                self.velocities(i),
                self.velocity_gradients(i),
                1.0 / self._cells.scale,
                np.asarray(about, dtype=np.float64),
            )
            for i in self._moving()
        ]
        return np.asarray(np.sum(terms, axis=0)) if terms else np.zeros(3)

    def energy(self) -> diagnostics.Energy:
        """Energies of all bodies that have started, J."""
        kinetic = elastic = potential = 0.0
        for i in self._moving():
            body = self.bodies[i]
            masses = body.masses
            kinetic += diagnostics.kinetic_energy(
                masses, self.velocities(i), self.velocity_gradients(i), 1.0 / self._cells.scale
            )
            elastic += diagnostics.elastic_energy(
                body.material, body.volumes, self.elastic_gradients(i), self.memories(i)
            )
            potential -= float(masses @ (self.positions(i) @ np.asarray(self.gravity)))
        return diagnostics.Energy(kinetic=kinetic, elastic=elastic, potential=potential)

    def ground_gap(self, index: int) -> float:
        """Least distance in metres of body ``index``'s surface to the ground; below 0 under it, inf without ground."""
        if self.ground is None:
            return math.inf
        body = self._body(index)
        assert body.contact_radii is not None
        heights = (self.positions(index) - np.asarray(self.ground.point)) @ self._normal()
        return float((heights - body.contact_radii).min())

    def particles_at_walls(self, index: int) -> int:
        """Particles of body ``index`` that have reached the walls of the box, which hold them."""
        cells = self._cells.points_to_engine(self.positions(index))
        outside = (cells < PADDING_CELLS) | (cells > self.options.grid - PADDING_CELLS)
        return int(outside.any(axis=1).sum())

    # ---- checkpoints --------------------------------------------------------------------------------------------

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Everything needed to continue, as arrays for ``numpy.savez``; a restored world continues with equal bytes."""
        state = dict(self._state())
        del state["position"]
        state["format"] = np.array(CHECKPOINT_FORMAT)
        state["time"] = np.array(self._time)
        state["started"] = np.array(self._started)
        state["offsets"] = self._offsets.astype(np.int64)
        state["similarity"] = np.array([self.similarity.scale, *self.similarity.origin])
        state["grid"] = np.array(self.options.grid)
        return state

    def restore(self, checkpoint: Mapping[str, NDArray[np.generic]]) -> None:
        """Take up a state that ``checkpoint`` returned in a world of the same bodies, similarity and grid."""
        self._check_generation()
        missing = {"format", "time", "started", "offsets", "similarity", "grid", "keys", "step_bounds"} - set(
            checkpoint
        )
        if missing:
            raise InputError(f"checkpoint has no {', '.join(sorted(missing))}: it was not written by this engine")
        if int(checkpoint["format"]) != CHECKPOINT_FORMAT:
            raise InputError(f"checkpoint format is {int(checkpoint['format'])}: this engine reads {CHECKPOINT_FORMAT}")
        same = (
            np.array_equal(checkpoint["offsets"], self._offsets)
            and np.array_equal(checkpoint["similarity"], [self.similarity.scale, *self.similarity.origin])
            and int(checkpoint["grid"]) == self.options.grid
        )
        if not same:
            raise InputError("checkpoint is of another scene: bodies, similarity and grid must be the same")
        self._time = float(checkpoint["time"])
        self._started = [bool(s) for s in checkpoint["started"]]
        self._engine = self._new_engine()
        self._engine.restore(dict(checkpoint))
        self._host = None
