# SPDX-License-Identifier: MIT
"""The substep loop over particles and grid. Lengths in cells; ``packing`` and ``world_view`` convert."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ..events import IsCancelled
from .block_lists import BlockLists, bytes_of
from .implicit import ImplicitSteps, Matter, StepReport
from .kernels import layout, parallel_sorting, runtime, sorting, time_stepping
from .kernels.constitutive_response import law_set
from .kernels.kernel_arrays import CouplingArrays, StepLimits
from .kernels.kernel_bundles import Launcher
from .kernels.lanes import Lanes
from .kernels.runtime import new_array
from .kernels.substep import REPEATS, rigid_launcher, substep_launcher
from .kernels.time_stepping import prime_worlds
from .packing import NewParticles, PackedWorlds
from .particle_store import ParticleStore, State, new_rows, positions_of
from .rigid.rigid_bodies import RigidBodies
from .rigid.rigid_motion import advance_bodies, carry_colliders
from .world_tables import WorldTables

Array = NDArray[np.float64]

MOST_RETRIES = 6
"""Times that a stretch of substeps is repeated with half the step before the run fails."""

MOST_LAUNCHES = 64
"""Launches at most between two looks at whether the caller wants to stop, on a card that runs them meanwhile."""

RECOVER = 1.25
"""Factor by which a shortened step grows again after each stretch that did not diverge."""

LEAST_STEP = 1e-10
"""Seconds; a substep below this, or below a thousandth of what it was when the segment began, means a diverged run."""


class Stopped(Exception):
    """The caller cancelled; the worlds are between two times."""


class Diverged(Exception):
    """World ``world`` diverged in field ``field`` and shorter steps did not help."""

    def __init__(self, world: int, field: int) -> None:
        super().__init__(f"world {world}, field {field}")
        self.world = world
        self.field = field


class Engine:
    """State of all worlds on the device. particles: numbered by the caller, and kept sorted by field and block."""

    def __init__(
        self,
        *,
        capacity: int,
        cfl_elastic: float,
        cfl_velocity: float,
        numbers: PackedWorlds,
        rigid_bodies: RigidBodies,
        lanes: Lanes,
        windows: int,
    ) -> None:
        """lanes: threads that share a block, ``lanes_of`` the architecture in use; windows: ``windows_of`` it."""
        self._lanes = lanes
        self.cfl_elastic, self.cfl_velocity = cfl_elastic, cfl_velocity
        self.rigid_bodies = rigid_bodies
        self._most_rigid_bodies = int(numbers.world_integers[:, layout.RIGID_BODIES].max())
        self._touching = new_array(ti.f32, max(1, rigid_bodies.count))
        self.laws = numbers.laws
        self.worlds = WorldTables(numbers)
        models = law_set(self.laws)
        self._running = new_array(ti.i32, self.worlds.count if lanes.parallel else 1)
        several = bool((numbers.world_integers[:, layout.FIELDS] > 1).any())
        anchored = bool(numbers.field_integers[:, layout.HAS_ANCHORS].any())
        self._several = several
        self._thin = several and numbers.thin
        self.retries = 0
        self._implicit: ImplicitSteps | None = None
        self.particles = ParticleStore(capacity=capacity, models=models, several=several, anchored=anchored)
        self._blocks = BlockLists(
            field_count=self.worlds.field_count,
            rigid_bodies=self._most_rigid_bodies,
            flowing=models.flowing,
            fluid=bool(models.volumetric),
            lanes=lanes,
            windows=windows,
        )

    @property
    def device_bytes(self) -> int:
        """Bytes of all arrays."""
        own = bytes_of(self._touching) + bytes_of(self._running)
        return self._blocks.device_bytes + self.particles.device_bytes + self.worlds.device_bytes + own

    # ---- particles in and out -----------------------------------------------------------------------------------

    def add(self, groups: Sequence[tuple[NewParticles, float]]) -> None:
        """Add particles, each group with the speed in cells/s of the fastest wave in it (``bounding_speed``)."""
        state = self._download()
        parts = {name: [state[name]] for name in self.particles.names}
        all_keys = [state["keys"].astype(np.int64)]
        control, means = self.worlds.control(), self.worlds.means()
        for added, wave_speed in groups:
            new, keys = new_rows(added)
            for name in self.particles.names:
                parts[name].append(new[name])
            all_keys.append(keys)
            row = control[self.worlds.of_field[added.field]]
            row[layout.SPEED] = max(row[layout.SPEED], math.sqrt(float(np.max((added.v**2).sum(axis=1)))))
            row[layout.WAVE_SPEED] = max(row[layout.WAVE_SPEED], wave_speed)
            first = added.field * layout.MEAN_ROW + layout.MEAN_PLACE
            means[first : first + 3] = np.average(added.x, axis=0, weights=added.constants[:, 0])
        self.worlds.put_control(control)
        self.worlds.put_means(means)
        keys = np.concatenate(all_keys)
        # Fields one after the other, whenever they started.
        order = np.argsort(keys >> 48, kind="stable")
        # One after the other: all at once would take as much again as the particles.
        del state
        for name in self.particles.names:
            self.particles.put(name, np.concatenate(parts.pop(name))[order])
        self._begin(keys[order])

    def places(self) -> tuple[NDArray[np.int32], Array]:
        """Numbers (n,) of the particles as the caller counts, and their positions (n, 3) in cells."""
        state = self._download(("ids", "x"))
        return np.asarray(state["ids"], dtype=np.int32), positions_of(state["keys"].astype(np.int64), state["x"])

    def _download(self, names: Sequence[str] | None = None) -> State:
        """The particles in engine order, all or those arrays, with the block key of each under "keys"."""
        state = self.particles.download(names)
        state["keys"] = self._blocks.particle_keys(self.particles.count)
        return state

    def _upload(self, state: Mapping[str, NDArray[np.generic]], keys: NDArray[np.int64]) -> None:
        for name in self.particles.names:
            self.particles.put(name, state[name])
        self._begin(keys)

    def _begin(self, keys: NDArray[np.int64]) -> None:
        """Go on with the particles that were put, whose blocks these ``keys`` name."""
        self.particles.begin(keys)
        self._group()

    def state(self) -> State:
        """All that ``restore`` needs, particles in engine order, and "position" (n, 3) in cells."""
        state = self._download()
        state["position"] = positions_of(state["keys"].astype(np.int64), state["x"])
        state["control"] = self.worlds.control()
        state["means"] = self.worlds.means()
        return state

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Restore a state that ``state`` returned, on an engine of the same capacity and worlds."""
        self._upload(state, np.asarray(state["keys"], dtype=np.int64))
        self.worlds.put_control(np.asarray(state["control"], dtype=np.float64))
        self.worlds.put_means(np.asarray(state["means"], dtype=np.float32))

    def replace(self, state: State) -> None:
        """Replace the particles by ``state``, which the caller has changed, in the same order."""
        self._upload(state, np.asarray(state["keys"], dtype=np.int64))

    # ---- grouping -----------------------------------------------------------------------------------------------

    def _sort(self) -> None:
        """Group the particles anew after they have moved; ``v`` and ``C`` must be stored."""
        rebase = parallel_sorting.rebase_of(self._lanes) if self._lanes.parallel else sorting.rebase
        rebase.launch(self.particles["x"], self.particles.keys, self.worlds.arrays(), self._blocks.particle_blocks)
        self._group()

    def _group(self, *, again: bool = False) -> None:
        """Lists, neighbours and permutation for the particles' ``keys``; ``again``: those of the last time."""
        here = self.particles
        if not again:
            self._blocks.build(here.count, here["x"], here.keys, here.targets)
        here.sort(again=again)
        self._blocks.list_contacts(self.worlds.arrays(), self.rigid_bodies, several=self._several)

    # ---- time ---------------------------------------------------------------------------------------------------

    def stable_steps(self) -> Array:
        """Longest stable substep in s of each world (W,) for its state as last reported."""
        return self._stable_steps(self.worlds.control())

    def _stable_steps(self, control: Array) -> Array:
        scale = control[:, layout.CFL_SCALE]
        fastest = np.maximum(control[:, layout.SPEED], control[:, layout.RIGID_SPEED])
        wave = scale * self.cfl_elastic / np.maximum(control[:, layout.WAVE_SPEED], 1e-30)
        step = np.minimum(control[:, layout.LONGEST_STEP], wave)
        return np.asarray(np.minimum(step, scale * self.cfl_velocity / np.maximum(fastest, 1e-30)))

    def advance(self, durations: Array, *, longest_step: Array, stop: IsCancelled) -> None:
        """Advance every world by its duration (W,) in s, 0 to leave it, in substeps of at most ``longest_step`` (W,).

        stop: called before every launch. Raises Stopped when it returns True: only ``restore`` works after that.
        Raises Diverged when a world diverges and shorter steps do not help. All worlds are then as they were when
        they were last sorted, ELAPSED s after the call.
        """
        control = self.worlds.control()
        control[:, layout.LONGEST_STEP] = longest_step
        control[:, layout.REMAINING] = durations
        control[:, layout.ELAPSED] = 0.0
        control[:, layout.PHASE] = layout.IDLE
        control[:, layout.LOST_FIELD] = -1.0
        control[:, layout.STATUS] = np.where(durations > 0, layout.WANTS_SORT, layout.DONE)
        control[:, layout.SHORTEST_STEP] = np.maximum(LEAST_STEP, 1e-3 * self._stable_steps(control))
        attempts = np.zeros(self.worlds.count, dtype=np.int64)
        while (control[:, layout.STATUS] == layout.WANTS_SORT).any():
            self.worlds.put_control(control)
            means = self.worlds.means() if self.worlds.mean_fields else None
            before = self.rigid_bodies.state() if self.rigid_bodies.count else None
            self._sort()
            while True:
                prime_worlds.launch(self._limits(), self.worlds.arrays())
                self._run_substeps(stop, self._expected_launches(control))
                after = self.worlds.control()
                lost = after[:, layout.STATUS] == layout.DIVERGED
                if not lost.any():
                    break
                attempts[lost] += 1
                self.particles.unsort()
                if means is not None:
                    self.worlds.put_means(means)
                if before is not None:
                    self.rigid_bodies.put_back(before)
                self._group(again=True)
                if attempts.max() > MOST_RETRIES:
                    self.worlds.put_control(control)
                    world = int(np.argmax(attempts))
                    raise Diverged(world, int(after[world, layout.LOST_FIELD]))
                self.retries += 1
                control[lost, layout.CFL_SCALE] *= 0.5
                self.worlds.put_control(control)
            sorted_now = control[:, layout.STATUS] == layout.WANTS_SORT
            attempts[sorted_now] = 0
            control = after
            recovered = np.minimum(1.0, RECOVER * control[:, layout.CFL_SCALE])
            control[:, layout.CFL_SCALE] = np.where(sorted_now, recovered, control[:, layout.CFL_SCALE])
        self.worlds.put_control(control)

    def add_elapsed(self, seconds: float) -> None:
        """Count ``seconds`` before the last ``advance``, which diverged, among those that have passed."""
        control = self.worlds.control()
        control[:, layout.ELAPSED] += seconds
        self.worlds.put_control(control)

    @property
    def bodies_meet(self) -> bool:
        """Whether particles of several bodies share nodes."""
        return self._several and self._blocks.any_overlap

    def begin_implicit(self) -> None:
        """Make the particles ready for implicit steps."""
        control = self.worlds.control()
        control[:, layout.STATUS] = layout.WANTS_SORT
        self.worlds.put_control(control)
        self._sort()
        control[:, layout.STATUS] = layout.DONE
        self.worlds.put_control(control)

    def implicit_step(self, dt: float, gravity: Array, most_hit: float) -> StepReport:
        """An implicit step of the only world, see ``ImplicitSteps.step``."""
        if self._implicit is None:
            self._implicit = ImplicitSteps(self.laws)
        blocks = self._blocks
        rigid = self.rigid_bodies
        matter = Matter(
            worlds=self.worlds.arrays(),
            blocks=blocks.particle_blocks,
            grid=blocks.grid_blocks,
            near=blocks.near_blocks,
            particles=self.particles.bundle(self._blocks.spares),
            nodes=blocks.nodes,
            colliders=rigid.bodies,
            shapes=rigid.shapes,
        )
        control = self.worlds.control()
        report = self._implicit.step(dt, gravity, most_hit, float(control[0, layout.WAVE_SPEED]), matter)
        if report.done:
            if rigid.count:
                carry_colliders.launch(dt, rigid.bodies)
            control[0, layout.SPEED] = report.speed
            control[0, layout.SUBSTEPS] += 1.0
            self.worlds.put_control(control)
        return report

    def _expected_launches(self, control: Array) -> int:
        """Launches, at least 1, that pass at this state before the first world can want a sort or have come to its
        end; none of them needs a look at the worlds before it."""
        step, speed = self._stable_steps(control), control[:, layout.SPEED]
        # Cells that may be covered, less what a world keeps free for the substep that follows.
        room = 1.0 - time_stepping.LEAST_MARGIN
        with np.errstate(divide="ignore"):
            until_sort = room / (speed * step) - 2.0 * time_stepping.SAFETY
        waiting = control[:, layout.STATUS] == layout.WANTS_SORT
        substeps = np.minimum(control[:, layout.REMAINING] / step, until_sort)[waiting].max()
        return int(np.clip((substeps + 1) // REPEATS, 1, MOST_LAUNCHES))

    def _run_substeps(self, stop: IsCancelled, expected: int) -> None:
        """Substeps until every world wants a sort, is done or has diverged; ``expected``: launches that it is sure to
        take, about."""
        if not (self.particles.count or self.rigid_bodies.solved_together):
            if stop():
                raise Stopped
            rigid = self.rigid_bodies
            advance_bodies(self._limits(), self.worlds.arrays(), rigid.bodies, rigid.shapes, rigid.contacts)
            return
        launch = self._launcher().bind(self._arguments())
        if not (self._lanes.parallel and self.particles.count):
            self._running[0] = self.worlds.count
            while self._running[0] > 0:
                if stop():
                    raise Stopped
                launch()
            return
        # A card goes on while the host prepares the next launch, unless the host waits to read.
        launches = 0
        while launches < expected or self._running.to_numpy().any():
            if stop():
                raise Stopped
            launch()
            launches += 1

    def _launcher(self) -> Launcher:
        """The kernels that the present lists of blocks require."""
        if not self.particles.count:
            return rigid_launcher(runtime.generation())
        return substep_launcher(
            runtime.generation(),
            self.laws,
            self._lanes,
            self.worlds.mean_fields > 0,
            self._blocks.any_overlap,
            self._thin,
            self.worlds.adheres,
            self.rigid_bodies.count > 0,
            self.rigid_bodies.solved_together,
            self._blocks.any_near,
        )

    # ---- bundles ------------------------------------------------------------------------------------------------

    def _arguments(self) -> dict[str, Any]:
        """Arguments of the substep's kernels by the kernels' parameter names."""
        return {
            "limits": self._limits(),
            "worlds": self.worlds.arrays(),
            "blocks": self._blocks.particle_blocks,
            "grid": self._blocks.grid_blocks,
            "near": self._blocks.near_blocks,
            "overlap": self._blocks.overlap_blocks,
            "table": self._blocks.particle_table,
            "particles": self.particles.bundle(self._blocks.spares),
            "nodes": self._blocks.nodes,
            "flow": self._blocks.flow,
            "bodies": self.rigid_bodies.bodies,
            "shapes": self.rigid_bodies.shapes,
            "contacts": self.rigid_bodies.contacts,
            "coupling": CouplingArrays(
                self.rigid_bodies.count, self._most_rigid_bodies, self._touching, self._blocks.pushes
            ),
            "adhesion": self.worlds.adhesion,
            "running": self._running,
        }

    def _limits(self) -> StepLimits:
        return StepLimits(self.cfl_elastic, self.cfl_velocity)
