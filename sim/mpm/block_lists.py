# SPDX-License-Identifier: MIT
"""The sparse grid on the device: which blocks hold particles or nodes, and the arrays that these size."""

from __future__ import annotations

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from .kernels import broad_phase, parallel_sorting, sorting
from .kernels.collider_distance import PUSH
from .kernels.grid import SUMS
from .kernels.kernel_arrays import (
    BlockTable,
    FlowArrays,
    GridBlocks,
    NearBlocks,
    NodeArrays,
    OverlapBlocks,
    ParticleBlocks,
    WorldArrays,
)
from .kernels.lanes import Lanes
from .kernels.layout import BLOCK, BLOCK_NODES, PAIRS, SCALARS_PER_BLOCK, WINDOW_NODES, ivec3, vec4
from .kernels.runtime import new_array
from .rigid.rigid_bodies import RigidBodies

LEAST_BLOCKS = 64
GROWTH = 1.3
"""Spare capacity of block arrays, so that they are not reallocated at every sort."""


class BlockLists:
    """Blocks of 4³ cells, listed anew at every sort of the particles.

    Particle blocks (p) hold particles of one field, grid blocks (g) the nodes that those reach. Near blocks are those
    within reach of rigid bodies and colliders, overlap blocks those in which several fields have nodes.
    """

    def __init__(
        self, *, field_count: int, rigid_bodies: int, flowing: bool, fluid: bool, lanes: Lanes, windows: int
    ) -> None:
        """rigid_bodies: the most that one world has. flowing, fluid: whether any law needs past values of the nodes,
        or the crowding of particles. lanes: threads that share a block. windows: at most, to read nodes from, where
        those do not lie in shared memory."""
        self._field_count, self._rigid_bodies, self._lanes = field_count, rigid_bodies, lanes
        self._flowing, self._fluid, self._windows = flowing, fluid, windows
        self._g_starts = new_array(ti.i32, field_count + 1)
        self._p_count = self._g_count = 0
        self._near = (0, 0)
        self._overlap = (0, 0, 0)
        self._p_capacity = self._g_capacity = 0
        self._allocate(LEAST_BLOCKS, 4 * LEAST_BLOCKS)
        self._allocate_overlap(1, 1)

    def _allocate(self, p: int, g: int) -> None:
        """Make room for ``p`` particle blocks and ``g`` grid blocks, where there is less; contents are lost."""
        if p > self._p_capacity:
            self._p_capacity = p
            self._p_cells, self._p_field = new_array(ivec3, p), new_array(ti.i32, p)
            self._starts = new_array(ti.i32, p + 1)
            # Of a card: how many particles a cell holds.
            self._cursors = new_array(ti.i32, p * BLOCK**3 if self._lanes.parallel else p)
            self._p_neighbours = new_array(ti.i32, p * 27)
            self._near_of_p, self._near_p = new_array(ti.i32, p), new_array(ti.i32, p)
            self._meets_p, self._meet_p = new_array(ti.i32, p), new_array(ti.i32, p)
            self._touched, self._slack = new_array(ti.i32, p), new_array(ti.f32, p)
            self.pushes = new_array(ti.f32, max(1, p * self._rigid_bodies * PUSH))
            read = 1 if self._lanes.shared else min(p, self._windows) * WINDOW_NODES
            self._window, self._scattered = new_array(vec4, read), new_array(vec4, p * WINDOW_NODES)
            self._past_window = new_array(vec4, read if self._flowing else 1)
            self._past_scattered = new_array(vec4, p * WINDOW_NODES if self._flowing else 1)
            crowded = p * WINDOW_NODES if self._lanes.shared else read
            self._crowding_window = new_array(ti.f32, crowded if self._fluid else 1)
            self._report = new_array(ti.f32, p * SCALARS_PER_BLOCK)
            self._p_mask = (1 << math.ceil(math.log2(4 * p))) - 1
            self._p_keys, self._p_slots = new_array(ti.i64, self._p_mask + 1), new_array(ti.i32, self._p_mask + 1)
        if g > self._g_capacity:
            self._g_capacity = g
            self._g_cells, self._g_field = new_array(ivec3, g), new_array(ti.i32, g)
            self._g_neighbours = new_array(ti.i32, g * 27)
            self._near_g, self._mate, self._meet = (new_array(ti.i32, g) for _ in range(3))
            self._meet_g, self._leads = new_array(ti.i32, g), new_array(ti.i32, g)
            self._nodes, self._sums = new_array(vec4, g * BLOCK_NODES), new_array(vec4, g * BLOCK_NODES)
            self._past_nodes = new_array(vec4, g * BLOCK_NODES if self._flowing else 1)
            self._crowding, self._fill = (new_array(ti.f32, g * BLOCK_NODES if self._fluid else 1) for _ in range(2))
            self._around = new_array(ti.i32, g * 27 if self._fluid else 1)
            crowded = max(1, g * self._rigid_bodies * PUSH) if self._fluid else 1
            self._crowd_pushes = new_array(ti.f32, crowded)
            self._masses = new_array(ti.f32, g * BLOCK_NODES)
            self._block_sums = new_array(ti.f32, g * SUMS)
            self._g_mask = (1 << math.ceil(math.log2(4 * g))) - 1
            self._g_keys, self._g_slots = new_array(ti.i64, self._g_mask + 1), new_array(ti.i32, self._g_mask + 1)

    def _allocate_overlap(self, p: int, g: int) -> None:
        """Make room for ``p`` particle blocks and ``g`` grid blocks where bodies meet; contents are lost."""
        self._met_p_capacity, self._met_g_capacity = p, g
        self._pair_counts, self._pairs = new_array(ti.i32, p), new_array(ti.i32, 3 * PAIRS * p)
        self._met_around, self._lead_fields = new_array(ti.i32, g * 27), new_array(ti.i32, g)
        self._faces, self._others = new_array(vec4, g * BLOCK_NODES), new_array(ti.f32, g * BLOCK_NODES)

    @property
    def device_bytes(self) -> int:
        """Bytes of all arrays."""
        return sum(bytes_of(array) for array in vars(self).values() if isinstance(array, ti.Ndarray))

    # ---- listing ------------------------------------------------------------------------------------------------

    def build(self, count: int, x: ti.Ndarray, keys: ti.Ndarray, targets: ti.Ndarray) -> None:
        """List the blocks and neighbours of ``count`` particles, and write into ``targets`` where each is to go.

        x: their positions in the windows of their blocks; keys: block of each, as ``sorting.block_key`` packs it.
        """
        while True:
            self._p_keys.fill(-1)
            self._p_count = self._list_particle_blocks(count, keys)
            if self._p_count <= self._p_capacity:
                break
            self._allocate(int(GROWTH * self._p_count) + LEAST_BLOCKS, 0)
        if self._lanes.parallel:
            parallel_sorting.turn_counts_into_offsets_of(self._lanes).launch(self.particle_blocks)
        # The serial list of the grid turns the counts of particles into offsets, once: they are put back for every new
        # attempt.
        counts = None
        while True:
            self._g_keys.fill(-1)
            if self._lanes.parallel:
                pass
            elif counts is None:
                counts = self._starts.to_numpy()
            else:
                self._starts.from_numpy(counts)
            self._g_count = self._list_grid_blocks()
            if self._g_count <= self._g_capacity:
                break
            self._allocate(0, int(GROWTH * self._g_count) + LEAST_BLOCKS)
        sorting.link_blocks.launch(self.particle_blocks, self.grid_blocks, self.particle_table, self._g_table)
        if self._fluid:
            sorting.link_grid_blocks.launch(self.grid_blocks, self._g_table, self._around)
        if self._lanes.parallel:
            blocks = self.particle_blocks
            parallel_sorting.place_in_turn.launch(count, x, keys, self._cursors, targets, self.particle_table, blocks)
        else:
            sorting.place.launch(count, keys, self._cursors, targets, self.particle_table)

    def _list_particle_blocks(self, count: int, keys: ti.Ndarray) -> int:
        table, blocks = self.particle_table, self.particle_blocks
        if self._lanes.parallel:
            return int(
                parallel_sorting.list_particle_blocks_in_parallel(
                    count, self._p_capacity, self._field_count, keys, self._g_starts, table, blocks
                )
            )
        return int(sorting.list_particle_blocks(count, self._p_capacity, keys, table, blocks))

    def _list_grid_blocks(self) -> int:
        table, blocks, grid = self._g_table, self.particle_blocks, self.grid_blocks
        if self._lanes.parallel:
            return int(
                parallel_sorting.list_grid_blocks_in_parallel(self._field_count, self._g_capacity, table, blocks, grid)
            )
        return int(sorting.list_grid_blocks(self._field_count, self._g_capacity, self._cursors, table, blocks, grid))

    def list_contacts(self, worlds: WorldArrays, rigid: RigidBodies, *, several: bool) -> None:
        """List the near blocks and, where a world has ``several`` fields, the overlap blocks."""
        blocks, grid, parallel = self.particle_blocks, self.grid_blocks, self._lanes.parallel
        list_near = broad_phase.list_near_blocks_in_parallel if parallel else broad_phase.list_near_blocks
        found = list_near(worlds, blocks, grid, self.near_blocks, rigid.bodies, rigid.shapes)
        self._touched.fill(0)
        self._slack.fill(0.0)
        self._near = (int(found[0]), int(found[1]))
        if several:
            list_overlap = broad_phase.list_overlap_blocks_in_parallel if parallel else broad_phase.list_overlap_blocks
            found = list_overlap(worlds, blocks, grid, self._g_table, self.overlap_blocks)
            self._overlap = (int(found[0]), int(found[1]), int(found[2]))
            p, g = self._overlap[2], self._overlap[0]
            if p > self._met_p_capacity or g > self._met_g_capacity:
                # Few blocks of most worlds: room for all of them would be a fifteenth of a particle's bytes.
                self._allocate_overlap(int(GROWTH * p) + LEAST_BLOCKS, int(GROWTH * g) + LEAST_BLOCKS)
            if g:
                broad_phase.link_overlap_blocks.launch(grid, self._g_table, self.overlap_blocks)

    # ---- what the host reads ------------------------------------------------------------------------------------

    def particle_keys(self, count: int) -> NDArray[np.int64]:
        """Key (count,) of the block of each particle, in the order in which the engine keeps them."""
        if not count:
            return np.zeros(0, dtype=np.int64)
        cells = self._p_cells.to_numpy()[: self._p_count].astype(np.int64)
        fields = self._p_field.to_numpy()[: self._p_count].astype(np.int64)
        return np.repeat(block_keys(fields, cells), np.diff(self._starts.to_numpy()[: self._p_count + 1]))

    @property
    def any_near(self) -> bool:
        """Whether particles are within reach of a rigid body or collider."""
        return self._near[0] > 0

    @property
    def any_overlap(self) -> bool:
        """Whether particles of several fields share nodes."""
        return self._overlap[2] > 0

    # ---- bundles ------------------------------------------------------------------------------------------------

    @property
    def particle_blocks(self) -> ParticleBlocks:
        """Blocks of particles, for kernels."""
        return ParticleBlocks(
            self._p_count, self._p_cells, self._p_field, self._starts, self._p_neighbours, self._report
        )

    @property
    def grid_blocks(self) -> GridBlocks:
        """Blocks of nodes, for kernels."""
        return GridBlocks(self._g_count, self._g_cells, self._g_field, self._g_starts, self._g_neighbours)

    @property
    def particle_table(self) -> BlockTable:
        """Particle blocks by their keys, for kernels."""
        return BlockTable(self._p_mask, self._p_keys, self._p_slots)

    @property
    def _g_table(self) -> BlockTable:
        return BlockTable(self._g_mask, self._g_keys, self._g_slots)

    @property
    def near_blocks(self) -> NearBlocks:
        """Blocks within reach of rigid bodies and colliders, as last listed."""
        lists = (self._near_of_p, self._near_p, self._near_g)
        return NearBlocks(*self._near, *lists, touched=self._touched, slack=self._slack)

    @property
    def overlap_blocks(self) -> OverlapBlocks:
        """Blocks in which several fields have nodes, as last listed."""
        return OverlapBlocks(
            *self._overlap,
            self._mate,
            self._meet,
            self._meet_g,
            self._leads,
            self._meet_p,
            self._meets_p,
            self._met_around,
            self._lead_fields,
            self._faces,
            self._others,
            self._pair_counts,
            self._pairs,
        )

    @property
    def nodes(self) -> NodeArrays:
        """Values of the nodes, and the windows that blocks of particles read and write."""
        return NodeArrays(self._window, self._scattered, self._nodes, self._sums, self._masses, self._block_sums)

    @property
    def flow(self) -> FlowArrays:
        """Fields of the nodes that only laws that flow need; single elements where none does."""
        return FlowArrays(
            self._past_window,
            self._past_scattered,
            self._past_nodes,
            self._crowding,
            self._crowding_window,
            self._fill,
            self._around,
            self._crowd_pushes,
        )

    @property
    def spares(self) -> dict[str, ti.Ndarray]:
        """Arrays of other uses, by the name of an optional array of the particles of the same type."""
        return {"material": self._starts, "memory": self._masses, "volumes": self._masses, "anchors": self._nodes}


def block_keys(fields: NDArray[np.int64] | np.int64, blocks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Keys (n,) of the blocks (n, 3) of the fields, as ``sorting.block_key`` packs them."""
    x, y, z = (blocks + sorting.BIAS).T
    return np.asarray(((fields << 16 | x) << 16 | y) << 16 | z)


def bytes_of(array: ti.Ndarray) -> int:
    """Bytes of ``array`` on the device."""
    elements = int(np.prod(array.shape)) * int(np.prod(array.element_shape))
    return elements * (8 if array.dtype in (ti.i64, ti.f64) else 4)
