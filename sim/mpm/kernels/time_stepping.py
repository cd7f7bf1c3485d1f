# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM109
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Choice of each world's next substep on the device, so that the host reads nothing between two sorts.

A segment of time ends exactly on its end: what remains is always divided into equal steps no longer than

    min(LONGEST_STEP, CFL_SCALE cfl_elastic / c, CFL_SCALE cfl_velocity / |v|)         over all particles and solids

A world that must sort its particles, has reached the end or has diverged becomes idle and waits for the host.
"""

import taichi as ti

from ..rigid.rigid_layout import DYNAMIC, KIND, KINDS, KINEMATIC, NUMBERS, RADIUS, STATE, V, W
from ..rigid.rigid_math import load3
from .kernel_arrays import ParticleBlocks, RigidArrays, StepLimits, WorldArrays
from .kernel_bundles import func, kernel
from .lanes import lane_maxima, meet, reduction_pads
from .layout import (
    CFL_SCALE,
    CONTROL_ROW,
    DIVERGED,
    DONE,
    ELAPSED,
    FASTEST_FIELD,
    FIELD_INTEGERS,
    FIRST_RIGID_BODY,
    FULL,
    IDLE,
    LONGEST_STEP,
    LOST_FIELD,
    MARGIN,
    NEXT_STEP,
    PHASE,
    PRIME,
    REMAINING,
    RIGID_BODIES,
    RIGID_DRIFT,
    RIGID_SPEED,
    RUNNING,
    SCALARS_PER_BLOCK,
    SCATTER,
    SHORTEST_STEP,
    SPEED,
    STATUS,
    STEP,
    STORE,
    SUBSTEPS,
    WANTS_SORT,
    WAVE_SPEED,
    WORLD,
    WORLD_INTEGERS,
    Integers,
    vec4,
)

SAFETY = 1.5
"""Factor by which the fastest particle may speed up within a substep."""

LEAST_MARGIN = 0.1
"""Cells kept free between the particles and the limits of their windows, for particles that start from rest."""

MOST_RIGID_DRIFT = 1.0
"""Cells that rigid bodies may move before the blocks near them are listed anew."""

RIGID_LOST = 1_000_000
"""LOST_FIELD of a world in which rigid body i diverged is this plus i."""

REVIEWERS = 64
"""Groups of threads of a card that take worlds in turn."""

FARTHEST_STEP = 0.9
"""Cells that a particle may move in a substep; more is cut off by its window, and the substep counts as diverged."""


@ti.func
def not_finite(number: ti.f32):
    """Whether ``number`` is NaN or infinite, by its bits: with fast maths a comparison is not reliable."""
    return (ti.bit_cast(number, ti.i32) & 0x7F800000) == 0x7F800000


@ti.func
def double_not_finite(number: ti.f64):
    """The same of a double."""
    return (ti.bit_cast(number, ti.i64) >> 52) & 0x7FF == 0x7FF


@func
def lose(c: ti.i32, field: ti.i32, worlds: WorldArrays):
    """Note the first field that diverged."""
    if worlds.control[c + LOST_FIELD] < 0.0:
        worlds.control[c + LOST_FIELD] = field


@func
def even_step(c: ti.i32, remaining: ti.f64, limits: StepLimits, worlds: WorldArrays):
    """Return ``remaining`` divided into the fewest equal steps that are stable."""
    scale = worlds.control[c + CFL_SCALE]
    step = worlds.control[c + LONGEST_STEP]
    step = ti.min(step, scale * limits.elastic / ti.max(worlds.control[c + WAVE_SPEED], 1e-30))
    step = ti.min(
        step,
        scale * limits.velocity / ti.max(ti.max(worlds.control[c + SPEED], worlds.control[c + RIGID_SPEED]), 1e-30),
    )
    return remaining / ti.max(1.0, ti.ceil(remaining / step - 1e-6))


@func
def plan(c: ti.i32, limits: StepLimits, worlds: WorldArrays):
    """Settle the next whole substep, STEP long: whether it is the last, or the last before a sort."""
    step = worlds.control[c + STEP]
    remaining = worlds.control[c + REMAINING] - step
    last = remaining < 0.5 * step
    drift = worlds.control[c + RIGID_DRIFT] + 2.0 * worlds.control[c + RIGID_SPEED] * step
    must_sort = (
        worlds.control[c + MARGIN] < 2.0 * SAFETY * worlds.control[c + SPEED] * step + LEAST_MARGIN
        or drift > MOST_RIGID_DRIFT
    )
    stop = last or must_sort
    worlds.control[c + SCATTER] = ti.select(stop, 0.0, 1.0)
    worlds.control[c + STORE] = ti.select(stop, 1.0, 0.0)
    worlds.control[c + NEXT_STEP] = ti.select(stop, step, even_step(c, remaining, limits, worlds))


@func
def forget_reports(pushed: ti.template(), w: ti.i32, worlds: WorldArrays, bodies: RigidArrays):
    """Reset the maxima before the blocks' reports are gathered; start from the solids' speeds."""
    c = w * CONTROL_ROW
    if worlds.control[c + PHASE] == FULL:
        worlds.control[c + SPEED] = 0.0
        worlds.control[c + MARGIN] = 1e9
        worlds.control[c + FASTEST_FIELD] = -1.0
    worlds.control[c + RIGID_SPEED] = 0.0
    if ti.static(pushed):
        first = worlds.integers[w * WORLD_INTEGERS + FIRST_RIGID_BODY]
        for i in range(first, first + worlds.integers[w * WORLD_INTEGERS + RIGID_BODIES]):
            kind = bodies.kinds[i * KINDS + KIND]
            if kind == DYNAMIC or kind == KINEMATIC:
                turning = load3(bodies.state, i * STATE + W).norm() * bodies.numbers[i * NUMBERS + RADIUS]
                speed = load3(bodies.state, i * STATE + V).norm() + turning
                if double_not_finite(speed):
                    lose(c, RIGID_LOST + i, worlds)
                worlds.control[c + RIGID_SPEED] = ti.max(worlds.control[c + RIGID_SPEED], speed)
    if worlds.control[c + PHASE] != IDLE and worlds.control[c + SCATTER] == 1.0:
        worlds.control[c + WAVE_SPEED] = 0.0


@func
def settle(w: ti.i32, limits: StepLimits, worlds: WorldArrays):
    """Decide the next phase of world ``w`` from the gathered reports. Returns 1 when it needs another substep."""
    c = w * CONTROL_ROW
    running = 0
    phase = worlds.control[c + PHASE]
    if phase != IDLE:
        scattered = worlds.control[c + SCATTER] == 1.0
        if phase == FULL:
            worlds.control[c + SPEED] = ti.sqrt(worlds.control[c + SPEED])
        if scattered:
            worlds.control[c + WAVE_SPEED] = ti.sqrt(worlds.control[c + WAVE_SPEED])
        lost = worlds.control[c + LOST_FIELD] >= 0.0
        if phase == FULL:
            step = worlds.control[c + STEP]
            worlds.control[c + ELAPSED] += step
            worlds.control[c + REMAINING] -= step
            worlds.control[c + SUBSTEPS] += 1.0
            worlds.control[c + RIGID_DRIFT] += worlds.control[c + RIGID_SPEED] * step
            if not lost and worlds.control[c + SPEED] * step > FARTHEST_STEP:
                lost = True
                worlds.control[c + LOST_FIELD] = worlds.control[c + FASTEST_FIELD]
        if lost:
            worlds.control[c + STATUS] = DIVERGED
            worlds.control[c + PHASE] = IDLE
        elif not scattered:
            # The last substep of the segment is followed by nothing; a sort by the first half of a substep.
            over = worlds.control[c + REMAINING] < 0.5 * worlds.control[c + STEP]
            worlds.control[c + STATUS] = ti.select(over, DONE, WANTS_SORT)
            worlds.control[c + PHASE] = IDLE
        else:
            worlds.control[c + STEP] = worlds.control[c + NEXT_STEP]
            worlds.control[c + PHASE] = FULL
            if worlds.control[c + STEP] < worlds.control[c + SHORTEST_STEP]:
                worlds.control[c + LOST_FIELD] = worlds.control[c + FASTEST_FIELD]
                worlds.control[c + STATUS] = DIVERGED
                worlds.control[c + PHASE] = IDLE
            else:
                running = 1
                plan(c, limits, worlds)
    return running


@func
def review(limits: StepLimits, worlds: WorldArrays, blocks: ParticleBlocks, bodies: RigidArrays):
    """After a substep: gather the blocks' reports and decide each world's next phase.

    Returns the number of worlds that need another substep.
    """
    ti.loop_config(serialize=True)
    for w in range(worlds.count):
        forget_reports(True, w, worlds, bodies)
    ti.loop_config(serialize=True)
    for k in range(blocks.count):
        c = worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + WORLD] * CONTROL_ROW
        r = k * SCALARS_PER_BLOCK
        if worlds.control[c + PHASE] == FULL:
            speed2 = ti.cast(blocks.report[r], ti.f64)
            if speed2 > worlds.control[c + SPEED] or worlds.control[c + FASTEST_FIELD] < 0.0:
                worlds.control[c + SPEED] = ti.max(speed2, worlds.control[c + SPEED])
                worlds.control[c + FASTEST_FIELD] = blocks.field[k]
            worlds.control[c + MARGIN] = ti.min(worlds.control[c + MARGIN], ti.cast(blocks.report[r + 2], ti.f64))
            if not_finite(blocks.report[r + 4]):
                lose(c, blocks.field[k], worlds)
        if worlds.control[c + PHASE] != IDLE and worlds.control[c + SCATTER] == 1.0:
            worlds.control[c + WAVE_SPEED] = ti.max(
                worlds.control[c + WAVE_SPEED], ti.cast(blocks.report[r + 1], ti.f64)
            )
            if not_finite(blocks.report[r + 1]):
                lose(c, blocks.field[k], worlds)
    running = 0
    ti.loop_config(serialize=True)
    for w in range(worlds.count):
        running += settle(w, limits, worlds)
    return running


@func
def review_in_parallel(
    lanes: ti.template(),
    pushed: ti.template(),
    running: Integers,
    limits: StepLimits,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    bodies: RigidArrays,
):
    """As ``review``, with a group of threads for each world. Sets ``running[w]`` to whether world w needs another
    substep. pushed: whether there are rigid bodies or colliders."""
    if ti.static(lanes.shared):
        ti.loop_config(block_dim=ti.static(lanes.threads))
        for t in range(ti.static(REVIEWERS * lanes.threads)):
            pads = ti.static(reduction_pads(lanes))
            w = t // ti.static(lanes.threads)
            while w < worlds.count:
                lane = t % ti.static(lanes.threads)
                review_world(lanes, pushed, pads, lane, w, running, limits, worlds, blocks, bodies)
                w += REVIEWERS
    else:
        for w in range(worlds.count):
            pads = ti.static(reduction_pads(lanes))
            review_world(lanes, pushed, pads, 0, w, running, limits, worlds, blocks, bodies)


@func
def review_world(
    lanes: ti.template(),
    pushed: ti.template(),
    pads: ti.template(),
    lane: ti.i32,
    w: ti.i32,
    running: Integers,
    limits: StepLimits,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    bodies: RigidArrays,
):
    """``review_in_parallel`` of world ``w``."""
    c = w * CONTROL_ROW
    if lane == 0:
        forget_reports(pushed, w, worlds, bodies)
    meet(lanes)
    moved = worlds.control[c + PHASE] == FULL
    scattered = worlds.control[c + PHASE] != IDLE and worlds.control[c + SCATTER] == 1.0
    speed2, wave2, margin, fastest = -1.0, 0.0, 1e9, -1
    k = lane
    while k < blocks.count:
        if worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + WORLD] == w:
            r = k * SCALARS_PER_BLOCK
            if moved:
                if blocks.report[r] > speed2:
                    speed2, fastest = blocks.report[r], blocks.field[k]
                margin = ti.min(margin, blocks.report[r + 2])
                if not_finite(blocks.report[r + 4]):
                    lose(c, blocks.field[k], worlds)
            if scattered:
                wave2 = ti.max(wave2, blocks.report[r + 1])
                if not_finite(blocks.report[r + 1]):
                    lose(c, blocks.field[k], worlds)
        k += ti.static(lanes.threads)
    most = lane_maxima(lanes, lane, vec4(speed2, wave2, -margin, 0.0), pads)
    if moved and fastest >= 0 and speed2 == most[0]:
        worlds.control[c + FASTEST_FIELD] = fastest
    meet(lanes)
    if lane == 0:
        if moved:
            worlds.control[c + SPEED] = ti.max(0.0, most[0])
            worlds.control[c + MARGIN] = -most[2]
        if scattered:
            worlds.control[c + WAVE_SPEED] = most[1]
        running[w] = settle(w, limits, worlds)
    meet(lanes)


@func
def prime(c: ti.i32, limits: StepLimits, worlds: WorldArrays):
    """Let the world at ``c`` start after a sort: particles to grid, with the stress of the step that follows."""
    worlds.control[c + RIGID_DRIFT] = 0.0
    worlds.control[c + MARGIN] = 1.0
    worlds.control[c + NEXT_STEP] = even_step(c, worlds.control[c + REMAINING], limits, worlds)
    worlds.control[c + STEP] = worlds.control[c + NEXT_STEP]
    worlds.control[c + PHASE] = PRIME
    worlds.control[c + SCATTER] = 1.0
    worlds.control[c + STORE] = 0.0
    worlds.control[c + STATUS] = RUNNING


@kernel
def prime_worlds(limits: StepLimits, worlds: WorldArrays):
    """Start every world that waits for a sort; those that are done or diverged stay idle."""
    ti.loop_config(serialize=True)
    for w in range(worlds.count):
        if worlds.control[w * CONTROL_ROW + STATUS] == WANTS_SORT:
            prime(w * CONTROL_ROW, limits, worlds)
