# SPDX-License-Identifier: MIT
"""The algorithms of the graphics card, run on the CPU by one thread a block, against the CPU's own."""

import numpy as np
import pytest
import taichi as ti
from physgen.benchmarks.gpu import CELL, mixed_world
from physgen.sim.mpm import world_group
from physgen.sim.mpm.kernels import runtime
from physgen.sim.mpm.kernels.kernel_arrays import BlockTable
from physgen.sim.mpm.kernels.kernel_bundles import kernel
from physgen.sim.mpm.kernels.lanes import ALONE, CUDA, SERIAL, lanes_of
from physgen.sim.mpm.kernels.layout import Integers, Keys
from physgen.sim.mpm.kernels.parallel_sorting import insert
from physgen.sim.mpm.kernels.sorting import BIAS, slot_of
from physgen.sim.mpm.solver_options import SolverOptions


@kernel
def fill(count: ti.i32, keys: Keys, table: BlockTable):
    for p in range(count):
        insert(keys[p], table)
    for h in range(table.mask + 1):
        table.slots[h] = h


@kernel
def look_up(count: ti.i32, keys: Keys, found: Integers, table: BlockTable):
    for p in range(count):
        found[p] = slot_of(keys[p], table)


def table_of(size):
    table = BlockTable(size - 1, ti.ndarray(ti.i64, size), ti.ndarray(ti.i32, size))
    table.keys.fill(-1)
    return table


def on_device(values, kind):
    array = ti.ndarray(kind, len(values))
    array.from_numpy(values)
    return array


@pytest.mark.parametrize("blocks", [1, 40, 63])
def test_a_table_filled_by_all_threads_has_every_key_once(blocks):
    """Up to a full table but one place, where nearly every key is displaced on its way."""
    runtime.ensure_started(SolverOptions(grid=64))
    rng = np.random.default_rng(blocks)
    cells = rng.choice(20**3, size=blocks, replace=False)
    places = np.stack([cells // 400, cells // 20 % 20, cells % 20], axis=1).astype(np.int64) - 10 + BIAS
    wanted = (places[:, 0] << 32) | (places[:, 1] << 16) | places[:, 2]
    keys = rng.permutation(np.repeat(wanted, 17))
    table, found = table_of(64), ti.ndarray(ti.i32, blocks)
    fill(len(keys), on_device(keys, ti.i64), table)
    stored = table.keys.to_numpy()
    assert sorted(stored[stored >= 0]) == sorted(wanted)
    look_up(blocks, on_device(wanted, ti.i64), found, table)
    assert np.array_equal(stored[found.to_numpy()], wanted)


def test_only_cuda_shares_a_block_among_threads():
    """64-bit atomics and shared float sums: Vulkan has neither in Taichi."""
    assert (lanes_of("cpu"), lanes_of("vulkan"), lanes_of("cuda")) == (SERIAL, SERIAL, CUDA)
    assert CUDA.halvings == (256, 128, 64, 32, 16, 8, 4, 2, 1)


@pytest.mark.long
def test_blocks_that_take_turns_at_windows_have_the_bytes_of_blocks_with_their_own(monkeypatch):
    """Jelly, sand, water and a rigid block: three windows for all their blocks, and one for each."""
    states = []
    for windows in (3, 10_000):
        monkeypatch.setattr(world_group, "windows_of", lambda arch, threads, windows=windows: windows)
        world = mixed_world("cpu")
        world.advance(2e-3)
        states.append(world.checkpoint())
    assert all(np.array_equal(states[0][name], states[1][name]) for name in states[0])


@pytest.mark.long
def test_the_cards_algorithms_move_all_matter_as_the_cpus_do(monkeypatch):
    """Jelly, sand, water and a rigid block, with contact between them, sorts and a pile on the ground. Sums are in
    another order: 1e-5 cells after 0.05 s."""

    def centres(lanes):
        monkeypatch.setattr(world_group, "lanes_of", lambda arch: lanes)
        world = mixed_world("cpu", threads=1)
        world.advance(0.05)
        return np.array(
            [
                world.pose(b.name).center if b.rigid else world.positions(i).mean(axis=0)
                for i, b in enumerate(world.bodies)
            ]
        )

    assert np.abs(centres(ALONE) - centres(SERIAL)).max() < 1e-5 * CELL
