# SPDX-License-Identifier: MIT
"""Worlds that advance in the same launches: those with the same constitutive models, hence the same kernels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..errors import Cancelled, InputError, SimulationError
from ..events import IsCancelled, never
from ..memory import return_freed_memory
from ..scene.units import ENGINE_BOX_SIZE, Similarity
from . import packing
from .active_bodies import ActiveBodies
from .colliders import SAME_TIME
from .diagnostics import FittedGradients
from .engine import MOST_RETRIES, Diverged, Engine, Stopped
from .kernels import layout, runtime
from .kernels.lanes import lanes_of, windows_of
from .kernels.time_stepping import RIGID_LOST
from .particle_store import State
from .quiet_matter import new_quiet_matter
from .rigid.rigid_bodies import RigidBodies, RigidPose
from .solver_options import SolverOptions
from .timed_events import BodyChanges, checked_motion, material_choice, next_stop, velocity_due
from .world_setup import WorldSetup, check_start

Array = NDArray[np.float64]

CHECKPOINT_FORMAT = 2

RIGID_PREFIX = "solids."
"""Prefix of the rigid bodies' arrays in a checkpoint."""

ROUNDING = 1e-12
"""Rounding error of sums of times, s."""


class WorldGroup:
    """Worlds with the same set of constitutive models; ``world.Worlds`` holds one group for each set.

    numbers: of the worlds in messages, one each; see ``Worlds`` for the rest.
    """

    def __init__(
        self,
        setups: Sequence[WorldSetup],
        *,
        numbers: Sequence[int | None],
        similarity: Similarity,
        options: SolverOptions,
    ) -> None:
        self.setups = tuple(setups)
        self.numbers = tuple(numbers)
        self.options = options
        self.similarity = similarity
        self.cells = Similarity(
            scale=self.similarity.scale * self.options.grid / ENGINE_BOX_SIZE, origin=self.similarity.origin
        )
        for setup in self.setups:
            check_start(setup, self.cells)
        self.arch, self._generation = runtime.ensure_started(self.options)
        self._places = packing.world_slots(self.setups, [self.cells] * len(self.setups))
        self._bodies = ActiveBodies(self.setups, 1.0 / self.cells.scale)
        self._times = np.zeros(len(self.setups))
        self._between = False
        self._rigid_bodies = self._new_rigid_bodies()
        self._engine = self._new_engine()
        self._changes = BodyChanges(self._engine, self._places, self._bodies)
        self._host: State | None = None
        self._poses: dict[tuple[int, str], RigidPose] = {}
        self._fits: dict[int, FittedGradients] = {}
        self._quiet_matter = (
            new_quiet_matter(self._places, self._bodies.offsets, self.arch) if self.options.implicit else None
        )
        self._reach_times(np.full(len(self), -math.inf))

    def _new_rigid_bodies(self) -> RigidBodies:
        origin = self.cells.points_to_world(np.zeros((1, 3)))[0]
        place = (float(origin[0]), float(origin[1]), float(origin[2]))
        rigid_bodies = RigidBodies(self.setups, [self.cells.scale] * len(self), [place] * len(self))
        for world, setup in enumerate(self.setups):
            asleep = self._bodies.asleep[self._bodies.of(world)]
            rigid = [i for i, body in enumerate(setup.bodies) if body.rigid and asleep[i]]
            rigid_bodies.asleep |= {(world, setup.bodies[i].name) for i in rigid}
        return rigid_bodies

    def _new_engine(self) -> Engine:
        soft = [not body.rigid for setup in self.setups for body in setup.bodies]
        return Engine(
            capacity=int(np.diff(self._bodies.offsets)[soft].sum()),
            cfl_elastic=self.options.cfl_elastic,
            cfl_velocity=self.options.cfl_velocity,
            numbers=packing.pack(self._places),
            rigid_bodies=self._rigid_bodies,
            lanes=lanes_of(self.arch),
            windows=windows_of(self.arch, self.options.threads),
        )

    def __len__(self) -> int:
        return len(self.setups)

    # ---- time ---------------------------------------------------------------------------------------------------

    def time(self, world: int = 0) -> float:
        """Simulated time in s of world ``world``."""
        return float(self._times[world])

    def control(self, world: int) -> Array:
        """Progress of world ``world`` as the engine keeps it, see ``layout``."""
        return self._engine.worlds.control()[world]

    def stable_step(self, world: int) -> float:
        """Longest substep in s that the present state of world ``world`` allows."""
        return min(float(self._engine.stable_steps()[world]), self._longest_step(self._places[world]))

    def particle_passes(self, world: int) -> int:
        """Passes over the particles of world ``world`` so far: one an explicit substep."""
        substeps = int(self.control(world)[layout.SUBSTEPS])
        quiet = self._quiet_matter
        return substeps if quiet is None else substeps - quiet.steps + quiet.passes

    @property
    def device_bytes(self) -> int:
        """Bytes that the engine's arrays take on the device."""
        return self._engine.device_bytes

    @property
    def retries(self) -> int:
        """Stretches of substeps that were repeated with shorter steps because they had diverged."""
        return self._engine.retries

    def advance(self, duration: float, stop: IsCancelled = never) -> None:
        """Advance all worlds by exactly ``duration`` seconds, in substeps that are stable.

        Raises Cancelled when ``stop`` returns True, SimulationError that names the body when a world diverges
        and shorter substeps do not help.
        """
        if not (math.isfinite(duration) and duration >= 0):
            raise InputError(f"duration is {duration!r}: give seconds, 0 or more")
        self._check_generation()
        self._check_whole()
        end = self._times[0] + duration
        while (self._times < end - ROUNDING).any():
            watch = self._wake_touched()
            stops = np.array(
                [
                    min(next_stop(place, float(self._times[place.world]), end), watch[place.world])
                    for place in self._places
                ]
            )
            self._engine.worlds.set_rows(
                worlds=np.stack([packing.world_row(p, self._times[p.world], stops[p.world]) for p in self._places]),
                fields=packing.field_rows(self._places, list(self._times), list(stops)),
            )
            self._changes.follow_parameters(self._times, stops)
            if self._rigid_bodies.count:
                moving = np.flatnonzero(stops > self._times)
                self._rigid_bodies.set_segments({int(w): (float(self._times[w]), float(stops[w])) for w in moving})
            self._poses = {}
            longest = [self._longest_step(place) for place in self._places]
            self._host = None
            try:
                self._advance_matter(stops - self._times, np.array(longest), stop)
            except Stopped:
                self._between = True
                raise Cancelled("the simulation was stopped in the middle of a step") from None
            except Diverged as failure:
                self._times = self._times + self._engine.worlds.control()[:, layout.ELAPSED]
                raise self._lost(failure) from None
            before = self._times.copy()
            self._times = stops
            self._reach_times(before)

    def _advance_matter(self, durations: Array, longest: Array, stop: IsCancelled) -> None:
        """Advance the engine, in implicit steps where those are asked for and pay."""
        if self._quiet_matter is None or not durations[0] > 0:
            self._engine.advance(durations, longest_step=longest, stop=stop)
            return
        row = packing.world_row(self._places[0], float(self._times[0]), float(self._times[0]))
        recovery = float(row[layout.RECOVERY_SPEED])
        self._quiet_matter.advance(self._engine, float(durations[0]), float(longest[0]), stop, recovery)

    def _longest_step(self, place: packing.WorldSlot) -> float:
        """Longest substep in s apart from waves: the option's, and that of springs."""
        return min([self.options.max_step, *(body.spring_step for body in place.setup.bodies)])

    def _wake_touched(self) -> Array:
        """Wake the bodies that moving ones have come to touch; for each world (W,) the time until which none else is.

        What wakes is in the engine from the present time on, as if it had started now.
        """
        until = np.full(len(self), math.inf)
        watched = [place for place in self._places if self._bodies.may_wake(place.world)]
        if not watched:
            return until
        speeds = self._engine.worlds.control()[:, layout.SPEED]
        fresh = []
        for place in watched:
            world, now = place.world, float(self._times[place.world])
            moving = partial(self._moving_matter, place, float(speeds[world]))
            woken, until[world] = self._bodies.wake(world, now, moving)
            for i in woken:
                body = place.setup.bodies[i]
                if body.rigid:
                    self._rigid_bodies.asleep.discard((world, body.name))
                else:
                    fresh.append(self._new_particles(place, i, now + SAME_TIME))
        if fresh:
            self._add(fresh)
        return until

    def _new_particles(self, place: packing.WorldSlot, index: int, now: float) -> tuple[packing.NewParticles, float]:
        """Return the particles of the world's body ``index`` as they start at ``now``; see ``packing.particles``."""
        first = int(self._bodies.offsets[self._bodies.of(place.world).start + index])
        return packing.particles(place, index, first, material_choice(place.setup.bodies[index], now))

    def _add(self, fresh: list[tuple[packing.NewParticles, float]]) -> None:
        """Let the engine have these particles, see ``packing.particles``; takes them out of the list."""
        self._engine.add(fresh)
        self._host = None
        fresh.clear()
        return_freed_memory()

    def _moving_matter(self, place: packing.WorldSlot, speed: float) -> tuple[dict[int, Array], float]:
        """Particles (N, 3) in world metres of the world's bodies that have started, by index, and the speed in m/s of
        the fastest of all; ``speed``: of the fastest particle of those that deform, cells/s."""
        first = self._bodies.of(place.world).start
        fastest = speed / place.cells.scale
        ids, cells = self._engine.places()
        order = np.argsort(ids)
        ids, cells = ids[order], cells[order]
        found = {}
        for i, body in enumerate(place.setup.bodies):
            number = first + i
            if not self._bodies.started[number]:
                continue
            if body.rigid:
                pose = self.pose(place.world, body.name)
                found[i] = body.positions @ pose.rotation.T + pose.translation
                arm = float(np.linalg.norm(found[i] - pose.center, axis=1).max())
                fastest = max(fastest, float(np.linalg.norm(pose.velocity) + np.linalg.norm(pose.spin) * arm))
                continue
            low, high = np.searchsorted(ids, self._bodies.offsets[number : number + 2])
            # What has just woken is not in the engine yet, and at rest.
            found[i] = place.cells.points_to_world(cells[low:high]) if high > low else body.positions
        return found, fastest

    def asleep(self, number: int) -> bool:
        """Whether body ``number`` of all sleeps."""
        return bool(self._bodies.asleep[number])

    def _reach_times(self, before: Array) -> None:
        """Apply what starts at the worlds' present times, after ``before`` (W,): bodies, velocities, materials."""
        fresh = []
        moved = [place for place in self._places if self._times[place.world] > before[place.world]]
        for place in moved:
            now = float(self._times[place.world]) + SAME_TIME
            fresh += [self._new_particles(place, i, now) for i in self._bodies.start(place.world, now)]
        if fresh:
            self._add(fresh)
        for place in moved:
            now, then = float(self._times[place.world]) + SAME_TIME, float(before[place.world]) + SAME_TIME
            for i, body in enumerate(place.setup.bodies):
                if self._bodies.started[self._bodies.of(place.world).start + i] and not body.rigid:
                    if any(then < time <= now for time, _ in body.material_track):
                        self._changes.change_material(place, i, now)
                        self._host = None
                    velocity = velocity_due(body, then, now)
                    if velocity is not None:
                        self._changes.set_velocity(place, i, velocity)
                        self._host = None

    def material_choice(self, world: int, index: int) -> NDArray[np.int32]:
        """Present material of each particle of body ``index``, counted as in ``material_index``."""
        return material_choice(self.setups[world].bodies[index], float(self._times[world]) + SAME_TIME)

    def set_motion(
        self,
        world: int,
        index: int,
        *,
        velocities: Array,
        velocity_gradients: Array | None = None,
        positions: Array | None = None,
        gradients: Array | None = None,
    ) -> None:
        """Set the state of every particle of body ``index`` of world ``world``; see ``World.set_motion``."""
        number = self.body_number(world, index)
        place, body = self._places[world], self.setups[world].bodies[index]
        if body.rigid or not self._bodies.started[number]:
            kind = "is rigid" if body.rigid else "has not started"
            raise InputError(f"body {body.name!r} {kind}: give motion to bodies of particles that have started")
        given = checked_motion(body.name, body.count, velocities, velocity_gradients, positions, gradients)
        self._check_generation()
        self._check_whole()
        self._changes.set_motion(place, index, given)
        self._host = None

    def _lost(self, failure: Diverged) -> SimulationError:
        place = self._places[failure.world]
        time = float(self._times[failure.world])
        number = self.numbers[failure.world]
        where = "" if number is None else f" of world {number}"
        soft = place.soft
        index = failure.field - place.first_field
        name = place.setup.bodies[soft[index] if 0 <= index < len(soft) else 0].name
        if failure.field >= RIGID_LOST:
            name = self._rigid_bodies.name(failure.field - RIGID_LOST)
        return SimulationError(
            f"body {name!r}{where} became unstable after t = {time:g} s, and substeps shortened to "
            f"1/{2**MOST_RETRIES} did not help: check its density and Young's modulus, what hits it and how fast, or "
            f"lower the solver option cfl_elastic ({self.options.cfl_elastic:g})"
        )

    def _check_whole(self) -> None:
        """Raise SimulationError for a state between two times, because ``advance`` was stopped."""
        if self._between:
            raise SimulationError("the world was stopped in the middle of a step: restore a checkpoint to continue")

    def _check_generation(self) -> None:
        if self._generation != runtime.generation():
            raise SimulationError(
                "the compute runtime was restarted with other options after this world was made: make a new world and "
                "restore its checkpoint"
            )

    # ---- state --------------------------------------------------------------------------------------------------

    def state(self) -> State:
        """The engine's state; kept until the next advance."""
        self._check_generation()
        self._check_whole()
        if self._host is None:
            self._host = self._engine.state()
        return self._host

    def pose(self, world: int, name: str) -> RigidPose:
        """Pose and motion of the rigid body or collider ``name`` of world ``world``."""
        self._check_generation()
        self._check_whole()
        if (world, name) not in self._poses:
            self._poses[(world, name)] = self._rigid_bodies.pose(world, name)
        return self._poses[(world, name)]

    def started(self, number: int) -> bool:
        """Whether body ``number`` of all has entered the simulation."""
        return bool(self._bodies.started[number])

    def body_number(self, world: int, index: int) -> int:
        """Number among all bodies of body ``index`` of world ``world``. Raises InputError when there is none."""
        if not 0 <= index < len(self.setups[world].bodies):
            raise InputError(f"body index is {index}: give 0 to {len(self.setups[world].bodies) - 1}")
        return self._bodies.of(world).start + index

    def fitted(self, number: int, rest: Array) -> FittedGradients:
        """The fit of deformation gradients to body ``number`` of all, whose places at rest are ``rest``."""
        if number not in self._fits:
            self._fits[number] = FittedGradients(rest)
        return self._fits[number]

    def gather(self, name: str, number: int, resting: Array) -> Array:
        """Values of body ``number`` of all in the order of its particles; ``resting`` where it has not started."""
        if not self._bodies.started[number]:
            return resting
        state = self.state()
        rows = self._changes.rows(state, number)
        values = np.asarray(state[name][rows.mine], dtype=np.float64)
        ordered = np.empty_like(values)
        ordered[rows.numbers] = values
        return ordered

    def checkpoint(self) -> State:
        """Everything needed to continue, as arrays for ``numpy.savez``; a restored run continues with equal bytes."""
        state = dict(self.state())
        del state["position"]
        state["format"] = np.array(CHECKPOINT_FORMAT)
        state["times"] = self._times.copy()
        state["started"] = self._bodies.started.copy()
        if self._bodies.any_may_sleep:
            state["asleep"] = self._bodies.asleep.copy()
        state["offsets"] = self._bodies.offsets.astype(np.int64)
        state["similarity"] = np.array([self.similarity.scale, *self.similarity.origin])
        state["grid"] = np.array(self.options.grid)
        if self._rigid_bodies.count:
            state |= {f"{RIGID_PREFIX}{name}": values for name, values in self._rigid_bodies.state().items()}
        return state

    def restore(self, checkpoint: Mapping[str, NDArray[np.generic]]) -> None:
        """Restore a state that ``checkpoint`` returned in worlds of the same setups, similarity and grid."""
        self._check_generation()
        wanted = {"format", "times", "started", "offsets", "similarity", "grid", "keys", "control", "means"}
        missing = wanted - set(checkpoint)
        if missing:
            raise InputError(f"checkpoint has no {', '.join(sorted(missing))}: it was not written by this engine")
        if int(checkpoint["format"]) != CHECKPOINT_FORMAT:
            raise InputError(f"checkpoint format is {int(checkpoint['format'])}: this engine reads {CHECKPOINT_FORMAT}")
        same = (
            np.array_equal(checkpoint["offsets"], self._bodies.offsets)
            and np.array_equal(checkpoint["similarity"], [self.similarity.scale, *self.similarity.origin])
            and int(checkpoint["grid"]) == self.options.grid
            and len(checkpoint["times"]) == len(self)
        )
        if not same:
            raise InputError("checkpoint is of another scene: bodies, similarity and grid must be the same")
        self._times = np.array(checkpoint["times"], dtype=np.float64)
        self._bodies.started = np.array(checkpoint["started"], dtype=bool)
        asleep = checkpoint.get("asleep", np.zeros(len(self._bodies.started)))
        self._bodies.asleep = np.array(asleep, dtype=bool)
        self._rigid_bodies = self._new_rigid_bodies()
        if self._rigid_bodies.count:
            rigid_bodies = {
                name.removeprefix(RIGID_PREFIX): checkpoint[name]
                for name in checkpoint
                if name.startswith(RIGID_PREFIX)
            }
            self._rigid_bodies.restore(rigid_bodies)
        self._engine = self._new_engine()
        self._engine.restore(checkpoint)
        self._changes = BodyChanges(self._engine, self._places, self._bodies)
        self._between = False
        self._host = None
        self._poses = {}
