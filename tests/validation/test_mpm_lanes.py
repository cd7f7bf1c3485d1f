# SPDX-License-Identifier: MIT
"""The algorithms of the graphics card, run on the CPU by one thread a block, against the CPU's own."""

import numpy as np
import pytest
import taichi as ti
from physgen.benchmarks.gpu import CELL, mixed_world
from physgen.sim.mpm import world_group
from physgen.sim.mpm.kernels import runtime
from physgen.sim.mpm.kernels.interpolation import LARGEST_WEIGHT, largest_share, spread_kept
from physgen.sim.mpm.kernels.kernel_arrays import BlockTable, ParticleBlocks
from physgen.sim.mpm.kernels.kernel_bundles import Launcher, kernel, merged
from physgen.sim.mpm.kernels.lanes import ALONE, CUDA, SERIAL, lanes_of
from physgen.sim.mpm.kernels.layout import (
    FIXED_ONE,
    WINDOW_NODES,
    Integers,
    Keys,
    Scalars,
    Vectors4,
    ivec3,
    mat3,
    vec3,
    vec4,
)
from physgen.sim.mpm.kernels.parallel_sorting import insert, place_in_turn
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
    """64-bit atomics and shared sums: Vulkan has neither in Taichi."""
    assert (lanes_of("cpu"), lanes_of("vulkan"), lanes_of("cuda")) == (SERIAL, SERIAL, CUDA)
    assert CUDA.warps * 32 == CUDA.threads


def test_particles_of_a_block_lie_so_that_its_cells_take_turns():
    """700 particles at random in one block: while all cells have some, no two of 32 neighbours are of the same one;
    every particle has a place of its own."""
    runtime.ensure_started(SolverOptions(grid=64))
    count, rng = 700, np.random.default_rng(0)
    places = rng.uniform(1.5, 5.5, (count, 3))
    x = on_device((places * FIXED_ONE).astype(np.int32), ivec3)
    key = np.int64((BIAS << 32) | (BIAS << 16) | BIAS)
    table = table_of(4)
    table.keys.from_numpy(np.array([key, -1, -1, -1]))
    table.slots.fill(0)
    targets = ti.ndarray(ti.i32, count)
    starts = on_device(np.array([0, count], dtype=np.int32), ti.i32)
    spare = ti.ndarray(ti.i32, 27)
    blocks = ParticleBlocks(1, ti.ndarray(ivec3, 1), spare, starts, spare, ti.ndarray(ti.f32, 8))
    place_in_turn(count, x, on_device(np.full(count, key), ti.i64), ti.ndarray(ti.i32, 64), targets, table, blocks)
    found = targets.to_numpy()
    assert sorted(found) == list(range(count))
    i, j, m = (np.floor(places - 0.5).astype(int) - 1).T
    cells = np.empty(count, dtype=int)
    cells[found] = 16 * i + 4 * j + m
    least = np.bincount(cells, minlength=64).min()
    for first in range(0, 64 * least, 32):
        assert len(set(cells[first : first + 32])) == 32


@ti.func
def triple_of(numbers: ti.template(), first: ti.i32):
    return vec4(numbers[first], numbers[first + 1], numbers[first + 2], 0.0)


@kernel
def spread_and_bound(count: ti.i32, numbers: Scalars, shares: Scalars, masses: Scalars, window: Vectors4):
    """Spread particles of the random ``numbers``, each to a window of its own, and find what ``largest_share`` says."""
    for p in range(count):
        first, mass = 33 * p, masses[p]
        fx = vec3(numbers[first], numbers[first + 1], numbers[first + 2])
        v = vec3(numbers[first + 3], numbers[first + 4], numbers[first + 5])
        c0, c1, c2 = triple_of(numbers, first + 6), triple_of(numbers, first + 9), triple_of(numbers, first + 12)
        E01, E02, E12 = triple_of(numbers, first + 15), triple_of(numbers, first + 18), triple_of(numbers, first + 21)
        D0, D1, D2 = triple_of(numbers, first + 24), triple_of(numbers, first + 27), triple_of(numbers, first + 30)
        Q = mat3([[c0[0], c1[0], c2[0]], [c0[1], c1[1], c2[1]], [c0[2], c1[2], c2[2]]])
        shares[p] = largest_share(mass, v, Q, E01, E02, E12, D0, D1, D2)
        q = mass * v - Q @ fx
        b4 = vec4(q[0], q[1], q[2], mass)
        spread_kept(p * WINDOW_NODES, fx, mass, b4, c0, c1, c2, E01, E02, E12, D0, D1, D2, window)


def test_no_node_gets_more_of_a_particle_than_its_largest_share():
    """2,000 particles with any velocity, slopes and second derivatives, three quarters of them with one kind alone:
    sums of whole numbers cannot overflow."""
    runtime.ensure_started(SolverOptions(grid=64))
    count, rng = 2000, np.random.default_rng(0)
    numbers = rng.normal(size=(count, 33))
    numbers[:, :3] = rng.uniform(0.5, 1.5, (count, 3))
    numbers[:500, 6:] = 0.0
    numbers[500:1000, 3:6] = numbers[500:1000, 15:] = 0.0
    numbers[1000:1500, 3:15] = 0.0
    masses = rng.uniform(0.5, 2.0, count).astype(np.float32)
    shares, window = ti.ndarray(ti.f32, count), ti.ndarray(vec4, count * WINDOW_NODES)
    given = on_device(numbers.astype(np.float32).ravel(), ti.f32)
    spread_and_bound(count, given, shares, on_device(masses, ti.f32), window)
    got = np.abs(window.to_numpy().reshape(count, WINDOW_NODES, 4)).max(axis=1)
    assert (got[:, :3].max(axis=1) > 0.0).all()
    assert (got[:, :3].max(axis=1) <= shares.to_numpy() * (1 + 1e-5)).all()
    assert (got[:, 3] <= LARGEST_WEIGHT * masses * (1 + 1e-5)).all()


@kernel
def copy_first(count: ti.i32, bundle: BlockTable, target: Integers):
    """The first ``count`` slots to ``target``."""
    for i in range(count):
        target[i] = bundle.slots[i]


def test_a_lean_kernel_does_the_same_without_what_it_does_not_read():
    runtime.ensure_started(SolverOptions(grid=64))
    table, target = table_of(4), ti.ndarray(ti.i32, 4)
    table.slots.from_numpy(np.arange(4, dtype=np.int32))
    lean = copy_first.lean()
    assert list(lean.arguments) == ["count", "bundle_slots", "target"]
    twice = merged([copy_first, copy_first]).lean()
    Launcher([twice], repeats=2).bind({"count": 3, "bundle": table, "target": target})()
    assert list(target.to_numpy()) == [0, 1, 2, 0]
    copy_first.launch(4, table, target)
    assert list(target.to_numpy()) == [0, 1, 2, 3]


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
