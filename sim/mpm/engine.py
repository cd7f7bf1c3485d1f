# SPDX-License-Identifier: MIT
"""The substep loop and the arrays on the device. Lengths in cells; ``world`` converts from and to SI units."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from . import laws, sorting
from .layout import BLOCK_NODES, FIXED_ONE, SCALARS_PER_BLOCK, WINDOW_NODES, ivec3, mat3, vec3, vec4
from .materials import FIXED_COROTATED, ROW
from .substep import substep, substep_of_laws

Array = NDArray[np.float64]

PARTICLE_ARRAYS = ("x", "v", "C", "F", "constants", "reaction", "ids")

MATTER_ARRAYS = ("memory", "material")
"""Arrays that only laws other than fixed-corotated elasticity need."""

ONLY_ELASTIC = 1 << FIXED_COROTATED

SAFETY = 1.5
"""Factor by which the fastest particle may speed up within a substep."""

LEAST_MARGIN = 0.1
"""Cells kept free between the particles and the limits of their windows, for particles that start from rest."""

LEAST_REACH = 0.02
"""Cells from the ground within which a particle at rest takes part in the contact."""


RECOVERY_HEIGHT = 0.02
"""Cells that a particle which starts in the ground could fly up when it is pushed out."""


class Diverged(Exception):
    """A velocity is not finite any more, or the stable substep has gone to zero."""


@dataclass(frozen=True, kw_only=True)
class Plane:
    """Ground in cells: points with normal . x = offset; friction is Coulomb's coefficient."""

    normal: tuple[float, float, float]
    offset: float
    friction: float


@dataclass(frozen=True, kw_only=True)
class Matter:
    """All materials of a world as the kernels see them: the set of their laws and a row of numbers for each."""

    laws: int = ONLY_ELASTIC
    table: tuple[tuple[float, ...], ...] = ((0.0,) * ROW,)


@dataclass(frozen=True, kw_only=True)
class EngineOptions:
    """What the loop needs of ``SolverOptions``; see there for units and ranges."""

    grid: int
    cfl_elastic: float
    cfl_velocity: float
    max_step: float


class Engine:
    """State of one simulation on the device.

    Particles are added once (``add``) and numbered in that order; ``ids`` maps the engine's order back to it.
    """

    def __init__(
        self,
        *,
        capacity: int,
        options: EngineOptions,
        plane: Plane | None,
        gravity: tuple[float, float, float],
        matter: Matter | None = None,
    ) -> None:
        self.options = options
        self.plane = plane
        self.laws = ONLY_ELASTIC if matter is None else matter.laws
        self._names = PARTICLE_ARRAYS + (() if self.laws == ONLY_ELASTIC else MATTER_ARRAYS)
        self._table = ti.ndarray(ti.f32, ROW if matter is None else len(matter.table) * ROW)
        if matter is not None:
            self._table.from_numpy(np.asarray(matter.table, dtype=np.float32).ravel())
        self.gravity = np.asarray(gravity, dtype=np.float64)
        self.across = options.grid // 4
        self.count = 0
        self.substeps = 0
        self.sorts = 0
        self._capacity = capacity
        self._particles = [self._particle_arrays() for _ in range(2)]
        self._keys = ti.ndarray(ti.i32, capacity)
        self._targets = ti.ndarray(ti.i32, capacity)
        self._table_p = ti.ndarray(ti.i32, self.across**3)
        self._table_g = ti.ndarray(ti.i32, self.across**3)
        self._p_blocks = self._g_blocks = 0
        self._ground_p_count = self._ground_g_count = 0
        self._allocate_blocks(max(64, capacity // 64), 512)
        self._forget_all()
        self._speed = 0.0
        self._wave_speed = 0.0
        self._margin = 0.0
        self._clearance = 0.0
        self._normal = vec3(0.0, 0.0, 1.0) if plane is None else vec3(*plane.normal)
        self._offset = -1e9 if plane is None else plane.offset
        recovery_speed = math.sqrt(2.0 * RECOVERY_HEIGHT * float(np.linalg.norm(self.gravity)))
        friction = 0.0 if plane is None else plane.friction
        self._settings = ti.ndarray(ti.f32, 9)
        self._settings.from_numpy(
            np.array([*gravity, *self._normal, self._offset, friction, recovery_speed], dtype=np.float32)
        )

    # ---- arrays -------------------------------------------------------------------------------------------------

    def _particle_arrays(self) -> dict[str, ti.Ndarray]:
        n = self._capacity
        kinds = {
            "x": ivec3,
            "v": vec3,
            "C": mat3,
            "F": mat3,
            "constants": vec4,
            "reaction": vec4,
            "ids": ti.i32,
            "memory": ti.f32,
            "material": ti.i32,
        }
        return {name: ti.ndarray(kinds[name], n) for name in self._names}

    def _allocate_blocks(self, p_capacity: int, g_capacity: int) -> None:
        p, g = min(p_capacity, self.across**3), min(g_capacity, self.across**3)
        self._p_capacity, self._g_capacity = p, g
        self._p_cells, self._g_cells = ti.ndarray(ivec3, p), ti.ndarray(ivec3, g)
        self._starts = ti.ndarray(ti.i32, p + 1)
        self._cursors = ti.ndarray(ti.i32, p)
        self._p_neighbours, self._g_neighbours = ti.ndarray(ti.i32, p * 27), ti.ndarray(ti.i32, g * 27)
        self._near_ground, self._ground_p = ti.ndarray(ti.i32, p), ti.ndarray(ti.i32, p)
        self._ground_g = ti.ndarray(ti.i32, g)
        self._window, self._scattered = ti.ndarray(vec4, p * WINDOW_NODES), ti.ndarray(vec4, p * WINDOW_NODES)
        self._nodes, self._sums = ti.ndarray(vec4, g * BLOCK_NODES), ti.ndarray(vec4, g * BLOCK_NODES)
        self._masses = ti.ndarray(ti.f32, g * BLOCK_NODES)
        self._report = ti.ndarray(ti.f32, p * SCALARS_PER_BLOCK)

    def _forget_all(self) -> None:
        self._table_p.fill(-1)
        self._table_g.fill(-1)
        self._p_blocks = self._g_blocks = 0

    @property
    def device_bytes(self) -> int:
        """Bytes of all arrays."""
        per_particle = 2 * 4 * (3 + 3 + 9 + 9 + 4 + 4 + 1 + len(self._names) - len(PARTICLE_ARRAYS)) + 8
        per_p = 4 * (3 + 1 + 1 + 27 + 2 + SCALARS_PER_BLOCK) + 2 * 16 * WINDOW_NODES
        per_g = 4 * (3 + 27 + 1) + 36 * BLOCK_NODES
        return self._capacity * per_particle + self._p_capacity * per_p + self._g_capacity * per_g + 8 * self.across**3

    # ---- particles in and out -----------------------------------------------------------------------------------

    def add(
        self,
        *,
        x: Array,
        v: Array,
        C: Array,
        F: Array,
        constants: Array,
        ids: NDArray[np.int32],
        wave_speed: float,
        material: int = 0,
    ) -> None:
        """Append particles: positions (N, 3) in cells, the rest as ``transfer.advance_particles`` describes it.

        wave_speed: of the fastest wave in them, cells/s, as ``materials.bounding_speed`` gives it; material: their
        row in the table.
        """
        state = self._download()
        base = np.clip(np.floor(x - 0.5).astype(np.int64) >> 2, 1, self.across - 2)
        local = np.rint((x - (4 * base - 1)) * FIXED_ONE)
        new = {
            "x": local.astype(np.int32),
            "v": v.astype(np.float32),
            "C": C.astype(np.float32),
            "F": F.astype(np.float32),
            "constants": constants.astype(np.float32),
            "reaction": np.zeros((len(x), 4), dtype=np.float32),
            "ids": ids.astype(np.int32),
            "memory": np.zeros(len(x), dtype=np.float32),
            "material": np.full(len(x), material, dtype=np.int32),
        }
        keys = (base[:, 0] * self.across + base[:, 1]) * self.across + base[:, 2]
        merged = {name: np.concatenate([state[name], new[name]]) for name in self._names}
        self._upload(merged, np.concatenate([state["keys"], keys.astype(np.int32)]))
        self._speed = max(self._speed, math.sqrt(float(np.max((v**2).sum(axis=1)))))
        self._wave_speed = max(self._wave_speed, wave_speed)

    def _download(self) -> dict[str, NDArray[np.generic]]:
        """The active particles in engine order, with the block of each under "keys"."""
        n = self.count
        state = {name: self._particles[0][name].to_numpy()[:n] for name in self._names}
        cells = self._p_cells.to_numpy()[: self._p_blocks].astype(np.int64)
        starts = self._starts.to_numpy()[: self._p_blocks + 1]
        keys = (cells[:, 0] * self.across + cells[:, 1]) * self.across + cells[:, 2]
        state["keys"] = np.repeat(keys, np.diff(starts)).astype(np.int32) if n else np.zeros(0, dtype=np.int32)
        return state

    def _upload(self, state: dict[str, NDArray[np.generic]], keys: NDArray[np.int32]) -> None:
        n = len(keys)
        for name in self._names:
            array = self._particles[0][name]
            host = array.to_numpy()
            host[:n] = state[name]
            array.from_numpy(host)
        host = self._keys.to_numpy()
        host[:n] = keys
        self._keys.from_numpy(host)
        self.count = n
        self._group()

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Active particles in engine order: everything that ``restore`` needs, and "position" (n, 3) in cells."""
        state = self._download()
        keys = state["keys"].astype(np.int64)
        cells = np.stack([keys // self.across**2, keys // self.across % self.across, keys % self.across], axis=1)
        state["position"] = 4 * cells - 1 + state["x"].astype(np.float64) / FIXED_ONE
        state["step_bounds"] = np.array([self._speed, self._wave_speed])
        return state

    def restore(self, state: dict[str, NDArray[np.generic]]) -> None:
        """Take up a state that ``state`` returned, on an engine of the same capacity and options."""
        self._upload(state, np.asarray(state["keys"], dtype=np.int32))
        self._speed, self._wave_speed = (float(value) for value in state["step_bounds"])

    # ---- grouping -----------------------------------------------------------------------------------------------

    def _sort(self) -> None:
        """Group the particles anew after they have moved; ``v`` and ``C`` must be stored."""
        here = self._particles[0]
        sorting.rebase(self._p_blocks, self.across, self._p_cells, self._starts, here["x"], self._keys)
        self._group()
        self.sorts += 1

    def _group(self) -> None:
        """Lists, neighbours and permutation for the blocks named in ``_keys``."""
        sorting.forget_blocks(
            self._p_blocks, self._g_blocks, self.across, self._p_cells, self._g_cells, self._table_p, self._table_g
        )
        while True:
            p = sorting.list_particle_blocks(
                self.count, self.across, self._p_capacity, self._keys, self._table_p, self._p_cells, self._starts
            )
            g = 0
            if p <= self._p_capacity:
                g = sorting.list_grid_blocks(
                    p,
                    self.across,
                    self._g_capacity,
                    self._p_cells,
                    self._table_g,
                    self._g_cells,
                    self._starts,
                    self._cursors,
                )
            if p <= self._p_capacity and g <= self._g_capacity:
                break
            self._allocate_blocks(max(self._p_capacity, p * 3 // 2), max(self._g_capacity, g * 3 // 2))
            self._forget_all()
        self._p_blocks, self._g_blocks = p, g
        sorting.link_blocks(
            p,
            g,
            self.across,
            self._p_cells,
            self._g_cells,
            self._table_p,
            self._table_g,
            self._p_neighbours,
            self._g_neighbours,
        )
        found = sorting.list_ground_blocks(
            p,
            g,
            self._normal,
            self._offset,
            1.0,
            self._p_cells,
            self._g_neighbours,
            self._near_ground,
            self._ground_p,
            self._ground_g,
        )
        self._ground_p_count, self._ground_g_count = int(found[0]), int(found[1])
        sorting.place(self.count, self._keys, self._table_p, self._cursors, self._targets)
        old, new = self._particles
        sorting.permute(
            self.count,
            self._targets,
            *(old[name] for name in PARTICLE_ARRAYS),
            *(new[name] for name in PARTICLE_ARRAYS),
        )
        if self.laws != ONLY_ELASTIC:
            laws.permute_matter(
                self.count,
                self._targets,
                *(old[name] for name in MATTER_ARRAYS),
                *(new[name] for name in MATTER_ARRAYS),
            )
        self._particles.reverse()
        self._margin = 1.0
        self._clearance = 0.0

    # ---- time ---------------------------------------------------------------------------------------------------

    def stable_step(self) -> float:
        """Longest stable substep in seconds for the state as last reported."""
        fastest = self._speed + float(np.linalg.norm(self.gravity)) * self.options.max_step
        return min(
            self.options.max_step,
            self.options.cfl_elastic / max(self._wave_speed, 1e-30),
            self.options.cfl_velocity / max(fastest, 1e-30),
        )

    def advance(self, duration: float) -> None:
        """Advance by exactly ``duration`` seconds in substeps no longer than ``stable_step``.

        Raises Diverged when the state is not finite.
        """
        if self.count == 0:
            return
        done = 0.0
        shortest = 1e-3 * self.stable_step()
        self._sort()
        dt = self._even_step(duration)
        self._substep(nodes=False, gather=False, scatter=True, dt=dt, dt_next=dt)
        while True:
            done += dt
            remaining = duration - done
            last = remaining < 0.5 * dt
            must_sort = not last and self._margin < 2.0 * SAFETY * self._speed * dt + LEAST_MARGIN
            next_dt = dt if last else self._even_step(remaining)
            self._substep(nodes=True, gather=True, scatter=not (last or must_sort), dt=dt, dt_next=next_dt)
            self.substeps += 1
            if last:
                return
            if self.stable_step() < shortest:
                raise Diverged
            if must_sort:
                self._sort()
                next_dt = self._even_step(remaining)
                self._substep(nodes=False, gather=False, scatter=True, dt=next_dt, dt_next=next_dt)
            dt = next_dt

    def _even_step(self, remaining: float) -> float:
        return remaining / max(1, math.ceil(remaining / self.stable_step() - 1e-6))

    def _substep(self, *, nodes: bool, gather: bool, scatter: bool, dt: float, dt_next: float) -> None:
        """Launch one substep or a part of one, and take note of what the particles report."""
        here = self._particles[0]
        reach = SAFETY * self._speed * dt + LEAST_REACH
        contact = nodes and self.plane is not None and self._clearance < 2.0 * reach
        first = (
            self._p_blocks,
            self._g_blocks if nodes else 0,
            self._ground_p_count if contact else 0,
            self._ground_g_count if contact else 0,
            self.options.grid,
            int(gather),
            int(scatter),
            int(not scatter),
            dt,
            dt_next,
            reach,
            self._settings,
            self._p_cells,
            self._g_cells,
            self._starts,
            self._p_neighbours,
            self._g_neighbours,
            self._near_ground,
            self._ground_p,
            self._ground_g,
            here["x"],
            here["v"],
            here["C"],
            here["F"],
            here["constants"],
        )
        last = (
            here["reaction"],
            self._window,
            self._scattered,
            self._nodes,
            self._sums,
            self._masses,
            self._report,
        )
        if self.laws == ONLY_ELASTIC:
            found = substep(*first, *last)
        else:
            found = substep_of_laws(self.laws, *first, here["material"], self._table, here["memory"], *last)
        speed2, stiffness, margin, clearance, sum2 = found
        if scatter:
            if not math.isfinite(stiffness):
                raise Diverged
            self._wave_speed = math.sqrt(stiffness)
        if gather:
            if not math.isfinite(sum2):
                raise Diverged
            self._speed = math.sqrt(speed2)
            self._margin, self._clearance = margin, clearance
