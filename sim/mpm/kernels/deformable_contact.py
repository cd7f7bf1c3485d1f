# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Contact between deformable bodies: each has grid nodes of its own, and coinciding nodes exchange impulses.

Bardenhagen et al. 2001 stop two bodies where both have mass at a node, which keeps them up to two cells apart. Here a
node has its distance to each body, so they touch where their surfaces do (as Nairn et al. 2020 find the gap by
regression). The share f of a body's volume around a node, smoothed by the B-spline, tells the distance: at d outside
of a plane face, in cells,

    f(d) = (3/2 - d)^3 / 6   for 1/2 <= d <= 3/2,     1/2 - 3/4 d + d^3 / 3   for |d| <= 1/2,     f(-d) = 1 - f(d)

exactly, where the face lies across an axis of the grid, and nearly elsewhere, since the spline has the same variance in
all directions. With the normal n from the gradients of both shares, gap = d_a + d_b, and the impulses j, t at the node

    j >= 0,   v_n + gap / dt >= 0,   one of the two an equality;     |t| <= mu j (Coulomb)

or, for the share e of it (the pair's restitution), j from a spring on the overlap, as in ``contact_law``.
They are equal and opposite and act at one point: momentum and angular momentum are exact. Edges and corners fill
less of their surroundings than faces do and count as rounded, by about a third of a cell.

**Thin bodies** never fill a node's surroundings. A sheet of thickness t fills, at the distance s from its middle,

    g(s) = f(s - t/2) - f(s + t/2),

a strip or rod a part of it. The ratio g / |g'| knows neither that part nor how much the body is stretched; it falls
with s, so that share and gradient at a node give s, and s - t/2 is the distance. g looks alike from both sides. Where
the shares of both bodies rise in the same direction the node lies behind the thin one, which touches with the face on
its other side: its distance is -(s + t/2), its normal the other way round.
"""

import taichi as ti

from .adhesion import counted, largest_pull, least_speed
from .body_faces import facing, facing_thin, find_faces, meet_as_thin, surer
from .constitutive_response import LOG_VOLUMES, is_fluid, is_one_of, law_of
from .contact_law import HOLD, SPRING, coulomb, parting_speed
from .interpolation import weights
from .kernel_arrays import (
    AdhesionArrays,
    GridBlocks,
    NodeArrays,
    OverlapBlocks,
    ParticleArrays,
    ParticleBlocks,
    WorldArrays,
)
from .kernel_bundles import func
from .lanes import meet, pads_of
from .layout import (
    ADHESION_REACH,
    ADHESION_ROW,
    ADHESION_UNIT,
    BLOCK_NODES,
    CONTROL_ROW,
    FIELD_INTEGERS,
    FIELD_ROW,
    FIELDS,
    FIRST_FIELD,
    FIRST_PAIR,
    FULL,
    MODE,
    PHASE,
    RECOVERY_SPEED,
    RESTITUTION,
    SEPARATE,
    SLIDING,
    SLIP,
    SPREAD,
    STEP,
    STICKING,
    TOUCH_ROW,
    WINDOW_NODES,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    vec3,
    vec4,
)
from .windows import add_to, clear_window, first_of, gathered, in_cells, layer, store_window, sum_chosen_windows

SWEEPS = 8
"""Passes over the pairs of bodies at a node where three or more meet and some are thin."""


@func
def scatter_shares(
    laws: ti.template(),
    lanes: ti.template(),
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    overlap: OverlapBlocks,
    particles: ParticleArrays,
    nodes: NodeArrays,
):
    """Scatter the particles' present volumes (cells^3) and the gradient of their spread to the blocks' windows."""
    if ti.static(lanes.shared):
        ti.loop_config(block_dim=ti.static(lanes.threads))
    for ss in range(overlap.particle_count * ti.static(lanes.span)):
        lane = ss % ti.static(lanes.span)
        if lane < ti.static(lanes.threads):
            k = overlap.particle_blocks[ss // ti.static(lanes.span)]
            pads = ti.static(pads_of(lanes, nodes))
            offset = 0 if ti.static(lanes.shared) else k * WINDOW_NODES
            w = worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + WORLD]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                clear_window(lanes, lane, offset, pads.scattered)
                meet(lanes)
                p = blocks.starts[k] + lane
                while p < blocks.starts[k + 1]:
                    volume = particles.volumes[p]
                    law = 0
                    if ti.static(laws.log_volume):
                        law = law_of(p, worlds, particles)
                    if not is_fluid(law):
                        volume *= ti.max(particles.F[p].determinant(), 0.0)
                    if ti.static(laws.log_volume):
                        if is_one_of(law, LOG_VOLUMES):
                            volume *= ti.exp(particles.memory[p])
                    gp = in_cells(particles.x[p])
                    base = ti.cast(gp - 0.5, ti.i32)
                    fx = gp - ti.cast(base, ti.f32)
                    w3 = weights(fx)
                    # Derivatives of the weights by the node's place.
                    s3 = [1.5 - fx, 2.0 * (fx - 1.0), 0.5 - fx]
                    first = offset + first_of(base, pads.scattered)
                    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
                        n = first + (i * ti.static(layer(pads.scattered)) + j * 8 + m)
                        share = volume * vec4(
                            s3[i][0] * w3[j][1] * w3[m][2],
                            w3[i][0] * s3[j][1] * w3[m][2],
                            w3[i][0] * w3[j][1] * s3[m][2],
                            w3[i][0] * w3[j][1] * w3[m][2],
                        )
                        add_to(pads.scattered, n, share)
                    p += ti.static(lanes.threads)
                meet(lanes)
                store_window(lanes, lane, k, pads.scattered, nodes.scattered)
                meet(lanes)


@func
def gather_shares(
    lanes: ti.template(), worlds: WorldArrays, grid: GridBlocks, overlap: OverlapBlocks, nodes: NodeArrays
):
    """Sum the windows: gradient (1/cell) and share of the field at each node of the meeting blocks, in ``sums``."""
    if ti.static(lanes.parallel):
        for n in range(overlap.grid_count * BLOCK_NODES):
            g = overlap.grid_blocks[n // BLOCK_NODES]
            w = worlds.field_integers[grid.field[g] * FIELD_INTEGERS + WORLD]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                nodes.sums[n] = gathered(g, n % BLOCK_NODES, grid.neighbours, overlap.chosen, nodes.scattered)
    else:
        for ss in range(overlap.grid_count * SPREAD):
            if ss % SPREAD == 0:
                s = ss // SPREAD
                g = overlap.grid_blocks[s]
                w = worlds.field_integers[grid.field[g] * FIELD_INTEGERS + WORLD]
                if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                    sum_chosen_windows(g, s, grid.neighbours, overlap.chosen, nodes.scattered, nodes.sums)


@func
def separate(
    thin: ti.template(),
    adheres: ti.template(),
    lanes: ti.template(),
    worlds: WorldArrays,
    grid: GridBlocks,
    overlap: OverlapBlocks,
    nodes: NodeArrays,
    adhesion: AdhesionArrays,
):
    """Apply impulses between every two fields at every node that both reach, to ``nodes.velocity``; ``thin``: some
    fields are thin bodies; ``adheres``: some adhere to others."""
    find_faces(worlds, grid, overlap, nodes)
    if ti.static(adheres):
        for n in range(adhesion.pair_count):
            adhesion.pair_sums[n] = 0
        visit_leads(thin, True, True, lanes, worlds, grid, overlap, nodes, adhesion)
    visit_leads(thin, adheres, False, lanes, worlds, grid, overlap, nodes, adhesion)


@func
def visit_leads(
    thin: ti.template(),
    adheres: ti.template(),
    summing: ti.template(),
    lanes: ti.template(),
    worlds: WorldArrays,
    grid: GridBlocks,
    overlap: OverlapBlocks,
    nodes: NodeArrays,
    adhesion: AdhesionArrays,
):
    """The impulses of ``separate``, or, if ``summing``, the sums of mass in reach that they need."""
    share = ti.static(BLOCK_NODES if lanes.parallel else SPREAD)
    for ss in range(overlap.lead_count * share):
        if ti.static(lanes.parallel):
            lead = overlap.leads[ss // share]
            separate_node(thin, adheres, summing, lead, ss % share, worlds, grid, overlap, nodes, adhesion)
        elif ss % share == 0:
            for i in range(BLOCK_NODES):
                lead = overlap.leads[ss // share]
                separate_node(thin, adheres, summing, lead, i, worlds, grid, overlap, nodes, adhesion)


@func
def separate_node(
    thin: ti.template(),
    adheres: ti.template(),
    summing: ti.template(),
    lead: ti.i32,
    i: ti.i32,
    worlds: WorldArrays,
    grid: GridBlocks,
    overlap: OverlapBlocks,
    nodes: NodeArrays,
    adhesion: AdhesionArrays,
):
    """The same at node ``i`` of the fields' blocks in the place of the block ``lead``."""
    w = worlds.field_integers[grid.field[lead] * FIELD_INTEGERS + WORLD]
    if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
        if ti.static(thin and not summing):
            # What is light between heavy bodies takes one push and the other in turn.
            sweeps = 1
            if overlap.mate[lead] >= 0 and overlap.mate[overlap.mate[lead]] >= 0:
                sweeps = SWEEPS
            part = 1.0
            if ti.static(adheres):
                part /= sweeps
            for _ in range(sweeps):
                separate_pairs(thin, adheres, summing, lead, i, w, part, worlds, grid, overlap, nodes, adhesion)
        else:
            separate_pairs(thin, adheres, summing, lead, i, w, 1.0, worlds, grid, overlap, nodes, adhesion)


@func
def separate_pairs(
    thin: ti.template(),
    adheres: ti.template(),
    summing: ti.template(),
    lead: ti.i32,
    i: ti.i32,
    w: ti.i32,
    part: ti.f32,
    worlds: WorldArrays,
    grid: GridBlocks,
    overlap: OverlapBlocks,
    nodes: NodeArrays,
    adhesion: AdhesionArrays,
):
    """Pass once over all pairs of fields of world ``w`` at node ``i``; ``part``: of the largest pull, where there are
    several passes."""
    dt = ti.cast(worlds.control[w * CONTROL_ROW + STEP], ti.f32)
    recovery = worlds.numbers[w * WORLD_ROW + RECOVERY_SPEED]
    first = worlds.integers[w * WORLD_INTEGERS + FIRST_FIELD]
    count = worlds.integers[w * WORLD_INTEGERS + FIELDS]
    a = lead
    while overlap.mate[a] >= 0:
        b = overlap.mate[a]
        while b >= 0:
            pair = (
                worlds.integers[w * WORLD_INTEGERS + FIRST_PAIR]
                + (grid.field[a] - first) * count
                + (grid.field[b] - first)
            )
            na, nb = a * BLOCK_NODES + i, b * BLOCK_NODES + i
            if nodes.mass[na] > 0.0 and nodes.mass[nb] > 0.0:
                sa, sb = (
                    nodes.sums[overlap.slot[a] * BLOCK_NODES + i],
                    nodes.sums[overlap.slot[b] * BLOCK_NODES + i],
                )
                found, normal, gap = False, vec3(0.0), 0.0
                as_thin = False
                if ti.static(thin):
                    as_thin = meet_as_thin(grid.field[a] * FIELD_ROW, grid.field[b] * FIELD_ROW, worlds)
                if as_thin:
                    if ti.static(thin):
                        found, normal, gap = facing_thin(
                            grid.field[a] * FIELD_ROW, grid.field[b] * FIELD_ROW, sa, sb, worlds
                        )
                elif a == lead:
                    found, normal, gap = surer(b, i, sa, sb, overlap)
                else:
                    found, normal, gap = facing(sa, sb)
                if found:
                    if ti.static(summing):
                        row = pair * ADHESION_ROW
                        if gap < adhesion.pairs[row + ADHESION_REACH]:
                            ma, mb = nodes.mass[na], nodes.mass[nb]
                            share = ma * mb / (ma + mb) * adhesion.pairs[row + ADHESION_UNIT]
                            ti.atomic_add(adhesion.pair_sums[pair], counted(share))
                    else:
                        pull = 0.0
                        if ti.static(adheres):
                            pull = part * largest_pull(pair, gap, dt, adhesion.pairs, adhesion.pair_sums)
                        push_apart(adheres, na, nb, normal, gap, pair * TOUCH_ROW, pull, dt, recovery, worlds, nodes)
            b = overlap.mate[b]
        a = overlap.mate[a]


@func
def push_apart(
    adheres: ti.template(),
    na: ti.i32,
    nb: ti.i32,
    normal: vec3,
    gap: ti.f32,
    pair: ti.i32,
    pull: ti.f32,
    dt: ti.f32,
    recovery: ti.f32,
    worlds: WorldArrays,
    nodes: NodeArrays,
):
    """Apply the impulse between nodes of surfaces ``gap`` cells apart; ``normal``: from the first to the second;
    ``pull``: the relative speed (cells/s) that they can hold back where they adhere."""
    ua, ub = nodes.velocity[na], nodes.velocity[nb]
    relative = vec3(ua[0] - ub[0], ua[1] - ub[1], ua[2] - ub[2])
    closing = relative.dot(normal)
    wanted = parting_speed(gap, dt, recovery)
    mode = ti.cast(worlds.pairs[pair + MODE], ti.i32)
    elastic = worlds.pairs[pair + RESTITUTION]
    push = (1.0 - elastic) * ti.max(0.0, closing + wanted) + elastic * (SPRING * ti.max(0.0, -gap) / dt)
    touching = push > 0.0
    pressing = push
    if ti.static(adheres):
        push += ti.max(-pull, ti.min(0.0, closing + least_speed(gap, wanted, dt)))
        pressing = push + pull
        touching = push != 0.0
    if mode != SEPARATE and gap < HOLD:
        push = closing
        touching = True
    if touching:
        rub = relative - closing * normal
        if mode == SLIP:
            rub *= 0.0
        elif mode == SEPARATE:
            rub = coulomb(rub, pressing, worlds.pairs[pair + STICKING], worlds.pairs[pair + SLIDING])
        change = push * normal + rub
        ma, mb = nodes.mass[na], nodes.mass[nb]
        part = mb / (ma + mb)
        nodes.velocity[na] = vec4(ua[0] - part * change[0], ua[1] - part * change[1], ua[2] - part * change[2], ua[3])
        part = ma / (ma + mb)
        nodes.velocity[nb] = vec4(ub[0] + part * change[0], ub[1] + part * change[1], ub[2] + part * change[2], ub[3])
