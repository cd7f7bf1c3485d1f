# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, ANN202
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""What an implicit step asks of the particles: momentum, forces at the end of the step, their stiffness; and its end.

Unknown are the displacements u of the nodes over the step (cells); ``implicit`` solves for them. With the gradient H
that they have at a particle, d = x_i - x_p, weights w and the Kirchhoff stress tau (times the volume at rest) of
F' = H F at the end of the step (backward Euler, as Stomakhin et al. 2013 and Gast et al. 2015):

    H = 1 + 4 sum_i w_ip u_i d^T          f_i = - sum_p 4 w_ip tau_p(H F) H^-T d
    K: stiffness of f, taken as that of isotropic matter of small strain, hence symmetric and positive definite

The ground and colliders push particles by springs, as stiff as half a cell of the matter, that start from the contact
forces of the step before, so that what rests stays where it is; friction is a spring along the surface that yields at
Coulomb's limit. Of the surfaces around a particle the nearest counts, as the plane that touches it there, which moves
along with the collider.

Kernels of a CPU: a thread takes a block and its window, as in ``particle_transfer``.
"""

import functools

import taichi as ti

from ...constitutive import ROW
from .constitutive_response import RELAXATION_TIME, RELAXING_SHARE, law_set, own_numbers, relaxed_branch
from .implicit_contact import FREE, REACH, ImplicitArrays, contact_stiffness, pushed
from .interpolation import columns, interpolate, spread, weights
from .kernel_arrays import (
    GridBlocks,
    NodeArrays,
    ParticleArrays,
    ParticleBlocks,
    WorldArrays,
)
from .kernel_bundles import BundledKernel, func, kernel
from .lanes import SERIAL
from .layout import (
    FIELD_INTEGERS,
    FIRST_TOUCH,
    FIXED_HIGH,
    FIXED_LOW,
    FIXED_ONE,
    SPREAD,
    TOUCH_ROW,
    WINDOW_NODES,
    ivec3,
    mat3,
    vec3,
    vec4,
)
from .windows import add_to, clear_window, first_of, in_cells, load_window, sum_windows, turns

HIT, PRESSED, FASTEST, FARTHEST = range(4)
"""Numbers that a block reports: largest speed (cells/s) at which a particle that did not touch reaches a surface, or
one that did is met by a collider; sum of the forces on surfaces (kg cells/s²); largest |v|² (cells²/s²) and largest
displacement (cells) of a particle."""

REPORT = 4


@ti.func
def place_of(x: ivec3):
    """Lowest node in its window of a particle at ``x`` in fixed point, and its place from there."""
    here = in_cells(x)
    base = ti.cast(here - 0.5, ti.i32)
    return base, here - ti.cast(base, ti.f32)


@ti.func
def value_and_gradient(first: ti.i32, fx: vec3, window: ti.template()):
    """Value (3) and gradient (3, 3) of the window's numbers at ``fx`` from its node ``first``."""
    A, B0, B1, B2 = interpolate(first, fx, window)
    gradient = mat3(0.0)
    for r in ti.static(range(3)):
        gradient[r, 0] = 4.0 * B0[r]
        gradient[r, 1] = 4.0 * B1[r]
        gradient[r, 2] = 4.0 * B2[r]
    return vec3(A[0], A[1], A[2]), gradient


@ti.func
def spread_linear(first: ti.i32, fx: vec3, value: vec3, slopes: mat3, mass: ti.f32, window: ti.template()):
    """Add value + slopes (x_i - x_p), and ``mass`` as fourth number, to the nodes, times their weights."""
    b = value - slopes @ fx
    c0, c1, c2 = columns(slopes)
    spread(first, fx, vec4(b[0], b[1], b[2], mass), c0, c1, c2, window)


@func
def sum_nodes(grid: GridBlocks, nodes: NodeArrays, arrays: ImplicitArrays):
    """``found`` from the windows of the particle blocks."""
    for gg in range(grid.count * SPREAD):
        if gg % SPREAD == 0:
            sum_windows(gg // SPREAD, grid.neighbours, nodes.scattered, arrays.found)


@kernel
def gather_momentum(
    blocks: ParticleBlocks, grid: GridBlocks, particles: ParticleArrays, nodes: NodeArrays, arrays: ImplicitArrays
):
    """Momentum (kg cells/s) and mass (kg) of the nodes."""
    for kk in range(blocks.count * SPREAD):
        if kk % SPREAD == 0:
            k = kk // SPREAD
            offset = k * WINDOW_NODES
            clear_window(SERIAL, 0, offset, nodes.scattered)
            for p in range(blocks.starts[k], blocks.starts[k + 1]):
                base, fx = place_of(particles.x[p])
                m = particles.constants[p][0]
                first = offset + first_of(base, nodes.scattered)
                spread_linear(first, fx, m * particles.v[p], m * particles.C[p], m, nodes.scattered)
    sum_nodes(grid, nodes, arrays)


@functools.cache
def find_forces_of(laws: int) -> BundledKernel:
    """Kernel of the forces at the end of a step for the set ``laws`` of constitutive models."""
    models = law_set(laws)

    @kernel
    def find_forces(
        dt: ti.f32,
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        grid: GridBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        arrays: ImplicitArrays,
    ):
        """Forces (kg cells/s²) on the nodes after the displacements ``given``, with those of surfaces, which are kept
        in ``contact``."""
        for kk in range(turns(SERIAL, blocks.count, nodes.window) * SPREAD):
            if kk % SPREAD == 0:
                turn, all_turns = kk // SPREAD, turns(SERIAL, blocks.count, nodes.window)
                spot = turn * WINDOW_NODES
                for k in range(turn * blocks.count // all_turns, (turn + 1) * blocks.count // all_turns):
                    load_window(k, spot, blocks.neighbours, nodes.window, arrays.given)
                    offset = k * WINDOW_NODES
                    clear_window(SERIAL, 0, offset, nodes.scattered)
                    ground = worlds.field_integers[blocks.field[k] * FIELD_INTEGERS + FIRST_TOUCH] * TOUCH_ROW
                    hit, sum_pressed = 0.0, 0.0
                    for p in range(blocks.starts[k], blocks.starts[k + 1]):
                        base, fx = place_of(particles.x[p])
                        window_node = first_of(base, nodes.window)
                        shift, H = value_and_gradient(spot + window_node, fx, nodes.window)
                        for r in ti.static(range(3)):
                            H[r, r] += 1.0
                        tau = stress_after(models, p, dt, H, worlds, particles)
                        force = vec3(0.0)
                        state = FREE
                        surface = arrays.surface[p]
                        gap = surface[3]
                        if gap < REACH:
                            normal = vec3(surface[0], surface[1], surface[2])
                            carried = arrays.carried[p]
                            touch = ti.cast(carried[3], ti.i32)
                            relative = shift - vec3(carried[0], carried[1], carried[2])
                            past = particles.reaction[p]
                            is_ground = touch == ground
                            force, state = pushed(p, touch, is_ground, gap, normal, relative, worlds, particles)
                            sum_pressed += force.dot(normal)
                            if (past.norm_sqr() == 0.0 or not is_ground) and gap + relative.dot(normal) < 0.0:
                                hit = ti.max(hit, -relative.dot(normal) / dt)
                        arrays.contact[p] = vec4(force[0], force[1], force[2], state)
                        Q = -4.0 * tau @ H.inverse().transpose()
                        spread_linear(offset + window_node, fx, force, Q, 0.0, nodes.scattered)
                    arrays.report[k * REPORT + HIT] = hit
                    arrays.report[k * REPORT + PRESSED] = sum_pressed
        sum_nodes(grid, nodes, arrays)

    return find_forces


@func
def stress_after(laws: ti.template(), p: ti.i32, dt: ti.f32, H: mat3, worlds: WorldArrays, particles: ParticleArrays):
    """Kirchhoff stress times volume of particle ``p`` after a step with the gradient ``H``."""
    fixed = particles.constants[p]
    F = H @ particles.F[p]
    tau = mat3(0.0)
    if ti.static(laws.only_elastic):
        tau, _, _ = laws.solid[0].stress(F, H, 0.0, fixed[1], fixed[2], fixed)
    else:
        row = particles.material[p] * ROW
        law = ti.cast(worlds.materials[row], ti.i32)
        for model in ti.static(laws.solid):
            if law == model.number:
                tau, _, _ = model.stress(F, H, 0.0, fixed[1], fixed[2], own_numbers(row, worlds))
        if ti.static(laws.relaxing):
            share = worlds.materials[row + RELAXING_SHARE]
            if share > 0.0:
                B = relaxed_branch(p, row, dt, H, worlds, particles)
                for i in ti.static(range(3)):
                    B[i, i] -= 1.0
                tau += (0.5 * share * fixed[1]) * B
    return tau


@func
def moduli(laws: ti.template(), p: ti.i32, dt: ti.f32, worlds: WorldArrays, particles: ParticleArrays):
    """2 mu V0 and lambda V0 of particle ``p`` for a step of ``dt``, with what has no time to relax in it."""
    two_mu, lam = particles.constants[p][1], particles.constants[p][2]
    if ti.static(laws.relaxing):
        row = particles.material[p] * ROW
        share = worlds.materials[row + RELAXING_SHARE]
        if share > 0.0:
            two_mu *= 1.0 + share * ti.exp(-dt / worlds.materials[row + RELAXATION_TIME])
    return two_mu, lam


@functools.cache
def multiply_stiffness_of(laws: int) -> BundledKernel:
    """Kernel of the stiffness for the set ``laws`` of constitutive models."""
    models = law_set(laws)

    @kernel
    def multiply_stiffness(
        dt: ti.f32,
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        grid: GridBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        arrays: ImplicitArrays,
    ):
        """K times ``given``; contacts are in the state that ``find_forces`` has found last."""
        for kk in range(turns(SERIAL, blocks.count, nodes.window) * SPREAD):
            if kk % SPREAD == 0:
                turn, all_turns = kk // SPREAD, turns(SERIAL, blocks.count, nodes.window)
                spot = turn * WINDOW_NODES
                for k in range(turn * blocks.count // all_turns, (turn + 1) * blocks.count // all_turns):
                    load_window(k, spot, blocks.neighbours, nodes.window, arrays.given)
                    offset = k * WINDOW_NODES
                    clear_window(SERIAL, 0, offset, nodes.scattered)
                    for p in range(blocks.starts[k], blocks.starts[k + 1]):
                        base, fx = place_of(particles.x[p])
                        window_node = first_of(base, nodes.window)
                        shift, G = value_and_gradient(spot + window_node, fx, nodes.window)
                        two_mu, lam = moduli(models, p, dt, worlds, particles)
                        stress = (2.0 * two_mu) * (G + G.transpose())
                        for r in ti.static(range(3)):
                            stress[r, r] += 4.0 * lam * G.trace()
                        force = vec3(0.0)
                        state = arrays.contact[p][3]
                        if state != FREE:
                            spring = contact_stiffness(p, particles)
                            surface = arrays.surface[p]
                            normal = vec3(surface[0], surface[1], surface[2])
                            # What slides counts as held by a weaker spring (iteratively reweighted least squares).
                            along = shift.dot(normal)
                            force = spring * (state * shift + (1.0 - state) * along * normal)
                        spread_linear(offset + window_node, fx, force, stress, 0.0, nodes.scattered)
        sum_nodes(grid, nodes, arrays)

    return multiply_stiffness


@functools.cache
def find_diagonal_of(laws: int) -> BundledKernel:
    """Kernel of the diagonal of the stiffness for the set ``laws`` of constitutive models."""
    models = law_set(laws)

    @kernel
    def find_diagonal(
        dt: ti.f32,
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        grid: GridBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        arrays: ImplicitArrays,
    ):
        """Diagonal of K (kg/s²); contacts are in the state that ``find_forces`` has found last."""
        for kk in range(blocks.count * SPREAD):
            if kk % SPREAD == 0:
                k = kk // SPREAD
                offset = k * WINDOW_NODES
                clear_window(SERIAL, 0, offset, nodes.scattered)
                for p in range(blocks.starts[k], blocks.starts[k + 1]):
                    base, fx = place_of(particles.x[p])
                    two_mu, lam = moduli(models, p, dt, worlds, particles)
                    spring = vec3(0.0)
                    state = arrays.contact[p][3]
                    if state != FREE:
                        surface = arrays.surface[p]
                        for c in ti.static(range(3)):
                            spring[c] = contact_stiffness(p, particles) * (
                                state + (1.0 - state) * surface[c] * surface[c]
                            )
                    w3 = weights(fx)
                    first = offset + first_of(base, nodes.scattered)
                    for i, j, m in ti.static(ti.ndrange(3, 3, 3)):
                        w = w3[i][0] * w3[j][1] * w3[m][2]
                        d = 4.0 * w * (vec3(float(i), float(j), float(m)) - fx)
                        held = w * w * spring
                        across = 0.5 * two_mu * d.norm_sqr()
                        more = 0.5 * two_mu + lam
                        share = vec4(
                            across + more * d[0] * d[0] + held[0],
                            across + more * d[1] * d[1] + held[1],
                            across + more * d[2] * d[2] + held[2],
                            0.0,
                        )
                        add_to(nodes.scattered, first + (i * 64 + j * 8 + m), share)
        sum_nodes(grid, nodes, arrays)

    return find_diagonal


@functools.cache
def move_particles_of(laws: int) -> BundledKernel:
    """Kernel of the end of a step for the set ``laws`` of constitutive models."""
    models = law_set(laws)

    @kernel
    def move_particles(
        dt: ti.f32,
        worlds: WorldArrays,
        blocks: ParticleBlocks,
        particles: ParticleArrays,
        nodes: NodeArrays,
        arrays: ImplicitArrays,
    ):
        """Particles to the end of the step: displacements ``given``, velocities ``motion``, forces ``contact``. The
        velocity gradient is that in the place where the matter has come to."""
        for kk in range(turns(SERIAL, blocks.count, nodes.window) * SPREAD):
            if kk % SPREAD == 0:
                turn, all_turns = kk // SPREAD, turns(SERIAL, blocks.count, nodes.window)
                spot = turn * WINDOW_NODES
                for k in range(turn * blocks.count // all_turns, (turn + 1) * blocks.count // all_turns):
                    speed2, farthest = 0.0, 0.0
                    load_window(k, spot, blocks.neighbours, nodes.window, arrays.motion)
                    for p in range(blocks.starts[k], blocks.starts[k + 1]):
                        base, fx = place_of(particles.x[p])
                        v, C = value_and_gradient(spot + first_of(base, nodes.window), fx, nodes.window)
                        particles.v[p] = v
                        particles.C[p] = C
                        speed2 = ti.max(speed2, v.norm_sqr())
                    load_window(k, spot, blocks.neighbours, nodes.window, arrays.given)
                    for p in range(blocks.starts[k], blocks.starts[k + 1]):
                        x = particles.x[p]
                        base, fx = place_of(x)
                        shift, H = value_and_gradient(spot + first_of(base, nodes.window), fx, nodes.window)
                        for r in ti.static(range(3)):
                            H[r, r] += 1.0
                        particles.C[p] = particles.C[p] @ H.inverse()
                        particles.F[p] = H @ particles.F[p]
                        if ti.static(models.relaxing):
                            row = particles.material[p] * ROW
                            if worlds.materials[row + RELAXING_SHARE] > 0.0:
                                particles.conformation[p] = relaxed_branch(p, row, dt, H, worlds, particles)
                        particles.x[p] = ti.min(
                            ti.max(x + ti.floor(shift * FIXED_ONE + 0.5, ti.i32), FIXED_LOW), FIXED_HIGH
                        )
                        force, m = arrays.contact[p], particles.constants[p][0]
                        share = particles.reaction[p][3]
                        particles.reaction[p] = vec4(force[0] / m, force[1] / m, force[2] / m, share)
                        farthest = ti.max(farthest, shift.norm_sqr())
                    arrays.report[k * REPORT + FASTEST] = speed2
                    arrays.report[k * REPORT + FARTHEST] = ti.sqrt(farthest)

    return move_particles
