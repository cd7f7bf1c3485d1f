# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Contact between particles of different deformable bodies, where the contact of their nodes has failed.

Nodes tell the distance of two bodies by their shares (``deformable_contact``), which takes faces of thick bodies for
granted. In the corner of a vessel whose walls are a cell thick the nodes behind the wall see air, take the water for
far away and let it go; one particle follows the other. What must not happen is known without any surface: particles of
two bodies, with contact radii r, never come nearer than their lattices let them. Faces of bodies at rest against each
other keep the outer particles r_p + r_q apart, so pairs are looked at below

    D = 0.85 (r_p + r_q)        v_n + (|x_p - x_q| - D) / dt >= 0,    j >= 0,    complementary, along x_p - x_q

which no particle can pass between four of a square lattice: half of its diagonal is 0.71 (r_p + r_q), and they stop it
half a spacing before their plane. Impulses act on the nodes around both particles with
their weights, equal and opposite and along their line: momentum and angular momentum are exact. One Gauss-Seidel pass
over all pairs, with the exact compliance of nodes, is stable for any number of them.

Only particles that lie DEEP in the share of other bodies look for partners: at the faces of bodies that touch, none.
"""

import taichi as ti

from .body_faces import left_by_others
from .contact_law import parting_speed
from .interpolation import weights
from .kernel_arrays import (
    BlockTable,
    GridBlocks,
    NodeArrays,
    OverlapBlocks,
    ParticleArrays,
    ParticleBlocks,
    WorldArrays,
)
from .kernel_bundles import func
from .layout import (
    BLOCK_NODES,
    CONTROL_ROW,
    FIELD_INTEGERS,
    FIELDS,
    FIRST_FIELD,
    FULL,
    PAIRS,
    PHASE,
    RECOVERY_SPEED,
    SPREAD,
    STEP,
    WINDOW,
    WINDOW_NODES,
    WORLD,
    WORLD_INTEGERS,
    WORLD_ROW,
    ivec3,
    vec3,
    vec4,
)
from .sorting import block_key, slot_of
from .windows import grid_node, in_cells

NEARNESS = 0.85
"""Distance over the sum of the contact radii below which two particles push each other away. Above 0.71 nothing passes
through a square lattice; at 1 faces that touch would be pushed twice."""

DEEP = 0.42
"""Share of other bodies, interpolated from the nodes, at a particle that looks for partners. It is 0.36 for particles a
quarter of a cell outside of a plane face, 0.5 on it; 0.32 and 0.42 at a wall of one cell."""

DEEP_IN_THIN = 0.05
"""The same where some bodies are thin: a rod of half a cell has 0.06 a quarter of a cell outside, 0.14 at most."""

FARTHEST = 0.5
"""Cells between two particles from which on they never push: radii are a quarter at most."""

LEAST_WINDOW, MOST_WINDOW = 0.5, 6.5
"""Places in a block's window, in cells, between which its particles stay until they are sorted."""


@func
def sum_others(worlds: WorldArrays, grid: GridBlocks, overlap: OverlapBlocks, nodes: NodeArrays):
    """Share of all other fields at the nodes where several meet, to ``overlap.others``, from the shares in ``sums``."""
    for ss in range(overlap.lead_count * SPREAD):
        if ss % SPREAD == 0:
            lead = overlap.leads[ss // SPREAD]
            w = worlds.field_integers[grid.field[lead] * FIELD_INTEGERS + WORLD]
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                a = lead
                while a >= 0:
                    for i in range(BLOCK_NODES):
                        others = -left_by_others(0.0, a, lead, i, overlap, nodes)
                        overlap.others[overlap.slot[a] * BLOCK_NODES + i] = others
                    a = overlap.mate[a]


@func
def other_share(k: ti.i32, n: ti.i32, blocks: ParticleBlocks, overlap: OverlapBlocks):
    """Share of other fields at node ``n`` of the window of block ``k``."""
    node = grid_node(k, n, blocks.neighbours)
    slot = overlap.slot[node // BLOCK_NODES]
    share = 0.0
    if slot >= 0:
        share = overlap.others[slot * BLOCK_NODES + node % BLOCK_NODES]
    return share


@func
def load_others(k: ti.i32, blocks: ParticleBlocks, overlap: OverlapBlocks, nodes: NodeArrays):
    """Copy the share of other fields around block ``k`` to its window in ``nodes.scattered``; return the largest."""
    most = 0.0
    for line in range(WINDOW * WINDOW):
        # As in ``windows.grid_node``.
        i, j = (line >> 3) + 3, (line & 7) + 3
        first = k * 27 + (i >> 2) * 9 + (j >> 2) * 3
        for m in ti.static(range(WINDOW)):
            slot = overlap.slot[blocks.neighbours[first + (m + 3) // 4]]
            share = 0.0
            if slot >= 0:
                share = overlap.others[slot * BLOCK_NODES + (i & 3) * 16 + (j & 3) * 4 + (m + 3) % 4]
            nodes.scattered[k * WINDOW_NODES + line * WINDOW + m] = vec4(share, 0.0, 0.0, 0.0)
            most = ti.max(most, share)
    return most


@func
def others_at(
    lanes: ti.template(), k: ti.i32, gp: vec3, blocks: ParticleBlocks, overlap: OverlapBlocks, nodes: NodeArrays
):
    """Share of other fields at ``gp`` in the window of block ``k``, which ``load_others`` has filled, on a CPU."""
    base = ti.cast(gp - 0.5, ti.i32)
    w3 = weights(gp - ti.cast(base, ti.f32))
    first = base[0] * 64 + base[1] * 8 + base[2]
    share = 0.0
    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
        weight = w3[i][0] * w3[j][1] * w3[m][2]
        n = first + (i * 64 + j * 8 + m)
        if ti.static(lanes.parallel):
            share += weight * other_share(k, n, blocks, overlap)
        else:
            share += weight * nodes.scattered[k * WINDOW_NODES + n][0]
    return share


@func
def least_distance(p: ti.i32, q: ti.i32, particles: ParticleArrays):
    """Cells that particles ``p`` and ``q`` of two bodies are apart at least; what is compressed comes nearer."""
    return NEARNESS * (own_radius(p, particles) + own_radius(q, particles))


@func
def own_radius(p: ti.i32, particles: ParticleArrays):
    """Contact radius (cells) of particle ``p`` as it is compressed now."""
    J = ti.min(ti.max(particles.F[p].determinant(), 0.05), 1.0)
    return particles.constants[p][3] * ti.pow(J, 1.0 / 3.0)


@func
def list_pairs(
    thin: ti.template(),
    lanes: ti.template(),
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    overlap: OverlapBlocks,
    particles: ParticleArrays,
    nodes: NodeArrays,
    table: BlockTable,
):
    """List the pairs of particles that are too near, block by block, to ``overlap.pairs``; ``table``: of the particle
    blocks."""
    for s in range(overlap.particle_count):
        overlap.pair_counts[s] = 0
    for ss in range(overlap.particle_count * ti.static(lanes.span)):
        lane = ss % ti.static(lanes.span)
        if lane < ti.static(lanes.threads):
            k = overlap.particle_blocks[ss // ti.static(lanes.span)]
            w = worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + WORLD]
            deep = ti.static(DEEP_IN_THIN if thin else DEEP)
            if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
                p = blocks.starts[k] + lane
                if ti.static(not lanes.parallel):
                    if load_others(k, blocks, overlap, nodes) < deep:
                        p = blocks.starts[k + 1]
                while p < blocks.starts[k + 1]:
                    gp = in_cells(particles.x[p])
                    if others_at(lanes, k, gp, blocks, overlap, nodes) > deep:
                        list_partners(
                            p, k, ss // ti.static(lanes.span), w, gp, worlds, blocks, overlap, particles, table
                        )
                    p += ti.static(lanes.threads)


@func
def list_partners(
    p: ti.i32,
    k: ti.i32,
    s: ti.i32,
    w: ti.i32,
    gp: vec3,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    overlap: OverlapBlocks,
    particles: ParticleArrays,
    table: BlockTable,
):
    """List the particles of other fields of world ``w`` that are too near to ``p``, at ``gp`` in the window of block
    ``k``, which is the overlap block ``s``."""
    first = worlds.integers[w * WORLD_INTEGERS + FIRST_FIELD]
    count = worlds.integers[w * WORLD_INTEGERS + FIELDS]
    for d in range(27):
        side = ivec3(d // 9 - 1, d // 3 % 3 - 1, d % 3 - 1)
        # Place of ``p`` in that block's window.
        at = gp - 4.0 * ti.cast(side, ti.f32)
        if at.min() > LEAST_WINDOW - FARTHEST and at.max() < MOST_WINDOW + FARTHEST:
            for other in range(first, first + count):
                if other != blocks.field[k]:
                    near = slot_of(block_key(other, blocks.cells[k] + side), table)
                    if near >= 0:
                        for q in range(blocks.starts[near], blocks.starts[near + 1]):
                            apart = at - in_cells(particles.x[q])
                            if apart.norm_sqr() < FARTHEST * FARTHEST:
                                if apart.norm() < least_distance(p, q, particles):
                                    n = ti.atomic_add(overlap.pair_counts[s], 1)
                                    if n < PAIRS:
                                        row = (s * PAIRS + n) * 3
                                        overlap.pairs[row] = p
                                        overlap.pairs[row + 1] = near
                                        overlap.pairs[row + 2] = q


@func
def part_pairs(
    lanes: ti.template(),
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    overlap: OverlapBlocks,
    particles: ParticleArrays,
    nodes: NodeArrays,
):
    """Apply the impulses of all listed pairs to ``nodes.velocity``, one after the other; on a card at once."""
    if ti.static(lanes.parallel):
        for s in range(overlap.particle_count):
            part_pairs_of(lanes, s, worlds, blocks, overlap, particles, nodes)
    else:
        ti.loop_config(serialize=True)
        for s in range(overlap.particle_count):
            part_pairs_of(lanes, s, worlds, blocks, overlap, particles, nodes)


@func
def part_pairs_of(
    lanes: ti.template(),
    s: ti.i32,
    worlds: WorldArrays,
    blocks: ParticleBlocks,
    overlap: OverlapBlocks,
    particles: ParticleArrays,
    nodes: NodeArrays,
):
    """``part_pairs`` of the particles of overlap block ``s``."""
    k = overlap.particle_blocks[s]
    w = worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + WORLD]
    if worlds.control[w * CONTROL_ROW + PHASE] == FULL:
        dt = ti.cast(worlds.control[w * CONTROL_ROW + STEP], ti.f32)
        recovery = worlds.numbers[w * WORLD_ROW + RECOVERY_SPEED]
        for n in range(ti.min(overlap.pair_counts[s], PAIRS)):
            row = (s * PAIRS + n) * 3
            p, near, q = overlap.pairs[row], overlap.pairs[row + 1], overlap.pairs[row + 2]
            side = ti.cast(4 * (blocks.cells[near] - blocks.cells[k]), ti.f32)
            gp = in_cells(particles.x[p])
            gq = in_cells(particles.x[q])
            apart = gp - side - gq
            distance = apart.norm()
            if distance > 1e-6:
                normal = apart / distance
                up = motion_at(k, gp, blocks, nodes)
                uq = motion_at(near, gq, blocks, nodes)
                speed = (vec3(up[0], up[1], up[2]) - vec3(uq[0], uq[1], uq[2])).dot(normal)
                wanted = parting_speed(distance - least_distance(p, q, particles), dt, recovery)
                if wanted > speed:
                    given = ((wanted - speed) / (up[3] + uq[3])) * normal
                    give(lanes, k, gp, given, blocks, nodes)
                    give(lanes, near, gq, -given, blocks, nodes)


@func
def motion_at(k: ti.i32, gp: vec3, blocks: ParticleBlocks, nodes: NodeArrays):
    """Velocity at ``gp`` in the window of block ``k``, and how much of it (1/kg) an impulse there makes."""
    base = ti.cast(gp - 0.5, ti.i32)
    w3 = weights(gp - ti.cast(base, ti.f32))
    found = vec4(0.0)
    for i in range(3):
        for j in range(3):
            for m in ti.static(range(3)):
                n = grid_node(k, (base[0] + i) * 64 + (base[1] + j) * 8 + base[2] + m, blocks.neighbours)
                weight = weight_of(w3, i, 0) * weight_of(w3, j, 1) * w3[m][2]
                u = nodes.velocity[n]
                found += weight * vec4(u[0], u[1], u[2], weight / ti.max(nodes.mass[n], 1e-20))
    return found


@func
def give(lanes: ti.template(), k: ti.i32, gp: vec3, given: vec3, blocks: ParticleBlocks, nodes: NodeArrays):
    """Add the impulse ``given`` (kg cells/s) at ``gp`` in the window of block ``k`` to the nodes there."""
    base = ti.cast(gp - 0.5, ti.i32)
    w3 = weights(gp - ti.cast(base, ti.f32))
    for i in range(3):
        for j in range(3):
            for m in ti.static(range(3)):
                n = grid_node(k, (base[0] + i) * 64 + (base[1] + j) * 8 + base[2] + m, blocks.neighbours)
                weight = weight_of(w3, i, 0) * weight_of(w3, j, 1) * w3[m][2]
                change = (weight / ti.max(nodes.mass[n], 1e-20)) * given
                if ti.static(lanes.parallel):
                    ti.atomic_add(nodes.velocity[n], vec4(change[0], change[1], change[2], 0.0))
                else:
                    nodes.velocity[n] = nodes.velocity[n] + vec4(change[0], change[1], change[2], 0.0)


@ti.func
def weight_of(w3: ti.template(), i: ti.i32, axis: ti.template()):
    """Weight ``i`` (0 to 2) along ``axis``."""
    return ti.select(i == 0, w3[0][axis], ti.select(i == 1, w3[1][axis], w3[2][axis]))
