# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM109
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""How each world chooses its next substep, on the device: the host need not read anything between two sorts.

A segment of time ends exactly on its end: what remains is always divided into equal steps no longer than

    min(LONGEST_STEP, CFL_SCALE cfl_elastic / c, CFL_SCALE cfl_velocity / |v|)         over all particles and solids

A world that must sort its particles anew, has reached the end or has gone wrong becomes idle and waits for the host.
"""

import taichi as ti

from .layout import (
    CFL_SCALE,
    CONTROL_ROW,
    DIVERGED,
    DONE,
    ELAPSED,
    FASTEST_FIELD,
    FIELD_INTEGERS,
    FIELDS,
    FIRST_SOLID,
    FULL,
    IDLE,
    LONGEST_STEP,
    LOST_FIELD,
    MARGIN,
    NEXT_STEP,
    PHASE,
    PRIME,
    REMAINING,
    RUNNING,
    SCALARS_PER_BLOCK,
    SCATTER,
    SHORTEST_STEP,
    SOLID_DRIFT,
    SOLID_SPEED,
    SOLIDS,
    SPEED,
    STATUS,
    STEP,
    STORE,
    SUBSTEPS,
    WANTS_SORT,
    WAVE_SPEED,
    WORLD,
    WORLD_INTEGERS,
    Doubles,
    Integers,
    Scalars,
)
from .rigid_math import load3
from .solid_layout import DYNAMIC, KIND, KINDS, KINEMATIC, NUMBERS, RADIUS, SOLID, V, W

SAFETY = 1.5
"""Factor by which the fastest particle may speed up within a substep."""

LEAST_MARGIN = 0.1
"""Cells kept free between the particles and the limits of their windows, for particles that start from rest."""

MOST_SOLID_DRIFT = 1.0
"""Cells that solids may move before the blocks near them are listed anew."""

SOLID_LOST = 1_000_000
"""LOST_FIELD of a world in which solid i went wrong is this plus i."""

FARTHEST_STEP = 0.9
"""Cells that a particle may move in a substep; more is cut off by its window, and the substep is not to be trusted."""


@ti.func
def not_finite(number: ti.f32):
    """Whether ``number`` is NaN or infinite, told from its bits: with fast maths a comparison may not."""
    return (ti.bit_cast(number, ti.i32) & 0x7F800000) == 0x7F800000


@ti.func
def double_not_finite(number: ti.f64):
    """The same of a double."""
    return (ti.bit_cast(number, ti.i64) >> 52) & 0x7FF == 0x7FF


@ti.func
def lose(c: ti.i32, field: ti.i32, control: Doubles):
    """Note the first field that went wrong."""
    if control[c + LOST_FIELD] < 0.0:
        control[c + LOST_FIELD] = field


@ti.func
def even_step(c: ti.i32, remaining: ti.f64, cfl_elastic: ti.f64, cfl_velocity: ti.f64, control: Doubles):
    """What remains, divided into the fewest equal steps that are stable."""
    scale = control[c + CFL_SCALE]
    step = control[c + LONGEST_STEP]
    step = ti.min(step, scale * cfl_elastic / ti.max(control[c + WAVE_SPEED], 1e-30))
    step = ti.min(step, scale * cfl_velocity / ti.max(ti.max(control[c + SPEED], control[c + SOLID_SPEED]), 1e-30))
    return remaining / ti.max(1.0, ti.ceil(remaining / step - 1e-6))


@ti.func
def plan(c: ti.i32, matter: ti.i32, cfl_elastic: ti.f64, cfl_velocity: ti.f64, control: Doubles):
    """Settle the next whole substep, STEP long: whether it is the last, or (with ``matter``) the last before a sort."""
    step = control[c + STEP]
    remaining = control[c + REMAINING] - step
    last = remaining < 0.5 * step
    drift = control[c + SOLID_DRIFT] + 2.0 * control[c + SOLID_SPEED] * step
    must_sort = (
        control[c + MARGIN] < 2.0 * SAFETY * control[c + SPEED] * step + LEAST_MARGIN or drift > MOST_SOLID_DRIFT
    )
    stop = last or must_sort
    control[c + SCATTER] = ti.select(stop, 0.0, 1.0)
    control[c + STORE] = ti.select(stop, 1.0, 0.0)
    control[c + NEXT_STEP] = ti.select(stop, step, even_step(c, remaining, cfl_elastic, cfl_velocity, control))


@ti.func
def forget_reports(
    w: ti.i32,
    world_integers: Integers,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
    control: Doubles,
):
    """Before the blocks' reports are gathered: start the maxima anew, with the solids' speeds."""
    c = w * CONTROL_ROW
    if control[c + PHASE] == FULL:
        control[c + SPEED] = 0.0
        control[c + MARGIN] = 1e9
        control[c + FASTEST_FIELD] = -1.0
    control[c + SOLID_SPEED] = 0.0
    first = world_integers[w * WORLD_INTEGERS + FIRST_SOLID]
    for i in range(first, first + world_integers[w * WORLD_INTEGERS + SOLIDS]):
        kind = solid_kinds[i * KINDS + KIND]
        if kind == DYNAMIC or kind == KINEMATIC:
            turning = load3(solids, i * SOLID + W).norm() * solid_numbers[i * NUMBERS + RADIUS]
            speed = load3(solids, i * SOLID + V).norm() + turning
            if double_not_finite(speed):
                lose(c, SOLID_LOST + i, control)
            control[c + SOLID_SPEED] = ti.max(control[c + SOLID_SPEED], speed)
    if control[c + PHASE] != IDLE and control[c + SCATTER] == 1.0:
        control[c + WAVE_SPEED] = 0.0


@ti.func
def settle(w: ti.i32, cfl_elastic: ti.f64, cfl_velocity: ti.f64, world_integers: Integers, control: Doubles):
    """After the reports are gathered: what world ``w`` does next. Returns 1 when it wants another substep."""
    c = w * CONTROL_ROW
    running = 0
    phase = control[c + PHASE]
    if phase != IDLE:
        scattered = control[c + SCATTER] == 1.0
        if phase == FULL:
            control[c + SPEED] = ti.sqrt(control[c + SPEED])
        if scattered:
            control[c + WAVE_SPEED] = ti.sqrt(control[c + WAVE_SPEED])
        lost = control[c + LOST_FIELD] >= 0.0
        if phase == FULL:
            step = control[c + STEP]
            control[c + ELAPSED] += step
            control[c + REMAINING] -= step
            control[c + SUBSTEPS] += 1.0
            control[c + SOLID_DRIFT] += control[c + SOLID_SPEED] * step
            if not lost and control[c + SPEED] * step > FARTHEST_STEP:
                lost = True
                control[c + LOST_FIELD] = control[c + FASTEST_FIELD]
        if lost:
            control[c + STATUS] = DIVERGED
            control[c + PHASE] = IDLE
        elif not scattered:
            # The last substep of the segment is followed by nothing; a sort by the first half of a substep.
            over = control[c + REMAINING] < 0.5 * control[c + STEP]
            control[c + STATUS] = ti.select(over, DONE, WANTS_SORT)
            control[c + PHASE] = IDLE
        else:
            control[c + STEP] = control[c + NEXT_STEP]
            control[c + PHASE] = FULL
            if control[c + STEP] < control[c + SHORTEST_STEP]:
                control[c + LOST_FIELD] = control[c + FASTEST_FIELD]
                control[c + STATUS] = DIVERGED
                control[c + PHASE] = IDLE
            else:
                running = 1
                matter = ti.cast(world_integers[w * WORLD_INTEGERS + FIELDS] > 0, ti.i32)
                plan(c, matter, cfl_elastic, cfl_velocity, control)
    return running


@ti.func
def review(
    world_count: ti.i32,
    p_blocks: ti.i32,
    cfl_elastic: ti.f64,
    cfl_velocity: ti.f64,
    p_field: Integers,
    field_integers: Integers,
    report: Scalars,
    control: Doubles,
    world_integers: Integers,
    solid_kinds: Integers,
    solid_numbers: Doubles,
    solids: Doubles,
):
    """After a substep: gather the blocks' reports and settle what every world does next.

    Returns the number of worlds that want another substep.
    """
    ti.loop_config(serialize=True)
    for w in range(world_count):
        forget_reports(w, world_integers, solid_kinds, solid_numbers, solids, control)
    ti.loop_config(serialize=True)
    for k in range(p_blocks):
        c = field_integers[p_field[k] * FIELD_INTEGERS + WORLD] * CONTROL_ROW
        r = k * SCALARS_PER_BLOCK
        if control[c + PHASE] == FULL:
            speed2 = ti.cast(report[r], ti.f64)
            if speed2 > control[c + SPEED] or control[c + FASTEST_FIELD] < 0.0:
                control[c + SPEED] = ti.max(speed2, control[c + SPEED])
                control[c + FASTEST_FIELD] = p_field[k]
            control[c + MARGIN] = ti.min(control[c + MARGIN], ti.cast(report[r + 2], ti.f64))
            if not_finite(report[r + 4]):
                lose(c, p_field[k], control)
        if control[c + PHASE] != IDLE and control[c + SCATTER] == 1.0:
            control[c + WAVE_SPEED] = ti.max(control[c + WAVE_SPEED], ti.cast(report[r + 1], ti.f64))
            if not_finite(report[r + 1]):
                lose(c, p_field[k], control)
    running = 0
    ti.loop_config(serialize=True)
    for w in range(world_count):
        running += settle(w, cfl_elastic, cfl_velocity, world_integers, control)
    return running


@ti.func
def prime(c: ti.i32, cfl_elastic: ti.f64, cfl_velocity: ti.f64, control: Doubles):
    """Let the world at ``c`` start after a sort: particles to grid, with the stress of the step that follows."""
    control[c + SOLID_DRIFT] = 0.0
    control[c + MARGIN] = 1.0
    control[c + NEXT_STEP] = even_step(c, control[c + REMAINING], cfl_elastic, cfl_velocity, control)
    control[c + STEP] = control[c + NEXT_STEP]
    control[c + PHASE] = PRIME
    control[c + SCATTER] = 1.0
    control[c + STORE] = 0.0
    control[c + STATUS] = RUNNING


@ti.kernel
def prime_worlds(world_count: ti.i32, cfl_elastic: ti.f64, cfl_velocity: ti.f64, control: Doubles):
    """Start every world that wants a sort; those that are done or lost stay idle."""
    ti.loop_config(serialize=True)
    for w in range(world_count):
        if control[w * CONTROL_ROW + STATUS] == WANTS_SORT:
            prime(w * CONTROL_ROW, cfl_elastic, cfl_velocity, control)
