# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, operator, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Explicit finite elements: linear tetrahedra, lumped masses, leapfrog; many worlds of one body in one launch.

One thread runs a world from start to end, so nothing is shared and no addition needs to be atomic.

    elastic   psi = mu/2 (tr b - 3 - 2 ln J) + lambda/2 (ln J)²          (neo-Hookean, tau = mu (b - 1) + lambda ln J 1)
    fibres    psi += k/2 (s - 1)², s = |F a|                             (sim/effects/anisotropy)
    damping   tau += t (2 mu D + lambda tr D 1)                          (sim/effects/internal_damping)
    yielding  tau = 2 mu dev e + K tr e 1, e = ln of the elastic stretch, radial return at sqrt(3/2)|dev tau| = Y
              (sim/effects/plastic_yield; Simo, Comput. Methods Appl. Mech. Eng. 99, 1992)

Contact with the plane z = 0 of the world's own frame: springs, by area, at nodes of the surface that are below it, and
Coulomb's friction as an impulse that at most stops the node.
"""

from typing import NamedTuple

import taichi as ti

from ...mpm.kernels.kernel_bundles import func, kernel

real = ti.f64
mat3 = ti.types.matrix(3, 3, real)
vec3 = ti.types.vector(3, real)
Reals = ti.types.ndarray(dtype=real, ndim=1)
Reals2 = ti.types.ndarray(dtype=real, ndim=2)
Integers2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
Vectors = ti.types.ndarray(dtype=vec3, ndim=1)
Vectors2 = ti.types.ndarray(dtype=vec3, ndim=2)
Vectors3 = ti.types.ndarray(dtype=vec3, ndim=3)
Matrices = ti.types.ndarray(dtype=mat3, ndim=1)
Matrices2 = ti.types.ndarray(dtype=mat3, ndim=2)

# Numbers of a world, SI.
MU, LAMBDA, GRADE, GRADE_AT, FIBRE, FIBRE_AXIS, DAMPING, YIELD = 0, 1, 2, 5, 6, 7, 10, 11
FRICTION, CONTACT_STIFFNESS, GRAVITY, DRAG, WIND, LIFT = 12, 13, 14, 17, 18, 21
TETHER_STIFFNESS, TETHER_LENGTH, TETHER_ANCHOR, TETHER_STRING = 22, 23, 24, 27
ADHESION, REACH, STEP, START = 28, 29, 30, 31
WORLD_ROW = 32


CONTACT_LIMIT = 1.0
"""Upper bound of a contact spring's stiffness over nodal mass and squared step, for stability."""

CRUSHED = 0.15
"""Lower bound of the volume ratio of a cell."""

ROOT_HALF, LOG_SHIFT = 0x3FE6A09E, 0x3FF00000 - 0x3FE6A09E
"""High words of the square root of 1/2 in double precision, and of the step from there to 1."""


class MeshArrays(NamedTuple):
    """Tetrahedral mesh of the body at rest: T cells, N nodes."""

    cells: Integers2
    """(T, 4) nodes of a cell."""

    shapes: Matrices
    """(T,) inverse of the matrix of a cell's edges, 1/m."""

    volumes: Reals
    """(T,) m³."""

    centres: Vectors
    """(T,) m."""

    shares: Reals
    """(T,) share of the stiffness that a cell has; below 1 in slivers."""

    areas: Reals
    """(N,) area of the surface at a node, m²."""


class NodeState(NamedTuple):
    """State of W worlds."""

    masses: Reals2
    """(W, N) kg."""

    x: Vectors2
    """(W, N) m."""

    v: Vectors2
    """(W, N) m/s."""

    f: Vectors2
    """(W, N) internal forces, N."""

    plastic: Matrices2
    """(W, T) inverse plastic strain C_p^-1; (1, 1) where nothing yields."""


class TrackArrays(NamedTuple):
    """Times at which the states are recorded, and the records; K tracked points, M times, padded."""

    times: Reals2
    """(W, M) s."""

    counts: Integers2
    """(W, 1) times of a world."""

    holders: Integers2
    """(K, 4) nodes of a point's cell."""

    weights: Reals2
    """(K, 4) weights of these nodes."""

    tracked: Vectors3
    """(W, M, K) written: places of the points, m."""

    kept_x: Vectors3
    """(W, M, N) written with ``keep``: places of all nodes, m."""

    kept_f: Vectors3
    """(W, M, N) written with ``keep``: internal accelerations of all nodes, m/s²; not of a world's last time."""


@ti.func
def column(a: mat3, i: ti.template()):
    """Return column i."""
    return vec3(a[0, i], a[1, i], a[2, i])


@ti.func
def plus(a: mat3, c: real):
    """Return a + c 1."""
    out = a
    for i in ti.static(range(3)):
        out[i, i] += c
    return out


@ti.func
def symmetric(a: mat3):
    """Return the symmetric matrix with the upper triangle of ``a``, so that equal entries are computed once."""
    return mat3([[a[0, 0], a[0, 1], a[0, 2]], [a[0, 1], a[1, 1], a[1, 2]], [a[0, 2], a[1, 2], a[2, 2]]])


@ti.func
def half_log(b: mat3):
    """Return ln(b) / 2 of a symmetric b by the Padé approximant (2, 2); error 1e-3 for stretches of 0.6 to 1.6."""
    square = b @ b
    return symmetric(1.5 * plus(square, -1.0) @ ti.math.inverse(plus(square + 4.0 * b, 1.0)))


@ti.func
def exponential(a: mat3):
    """Return exp(a) of a symmetric a by the Padé approximant (2, 2)."""
    even = plus(a @ a, 12.0)
    return (even + 6.0 * a) @ ti.math.inverse(even - 6.0 * a)


@ti.func
def yielded(F: mat3, inverse: mat3, plastic: mat3, mu: real, lam: real, limit: real):
    """Return Kirchhoff stress and new inverse plastic strain C_p^-1 of trial F, given the old ``plastic``."""
    strain = half_log(symmetric(F @ symmetric(plastic) @ F.transpose()))
    volume = strain.trace()
    dev = plus(strain, -volume / 3.0)
    size = 2.0 * mu * ti.sqrt(1.5) * dev.norm()
    after = plastic
    if size > limit:
        dev *= limit / size
        after = inverse @ exponential(2.0 * plus(dev, volume / 3.0)) @ inverse.transpose()
        after = 0.5 * (after + after.transpose())
    return plus(2.0 * mu * dev, (lam + 2.0 / 3.0 * mu) * volume), after


@ti.func
def logarithm(x: real):
    """Return ln x of a positive x by FreeBSD's e_log.c: no call, which would save and load all registers per cell."""
    shifted = ti.bit_cast(x, ti.i64) + ti.i64(LOG_SHIFT << 32)
    m = ti.bit_cast((shifted & ti.i64((1 << 52) - 1)) + ti.i64(ROOT_HALF << 32), real)
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    even = w * (real(0.3999999999940941908) + w * (real(0.2222219843214978396) + w * real(0.1531383769920937332)))
    odd = w * (real(0.2857142874366239149) + w * (real(0.1818357216161805012) + w * real(0.1479819860511658591)))
    odd = z * (real(0.6666666666666735130) + odd)
    half = 0.5 * f * f
    exponent = ti.cast((shifted >> 52) - 1023, real)
    return exponent * real(0.6931471805599453094) + (f - (half - s * (half + even + odd)))


@func
def inner_forces(
    w: ti.i32,
    worlds: Reals2,
    damped: ti.template(),
    yields: ti.template(),
    fibred: ti.template(),
    mesh: MeshArrays,
    state: NodeState,
):
    """Add the internal forces of world w to f (worlds, nodes) and update plastic strain where it yields."""
    grade = vec3(worlds[w, GRADE], worlds[w, GRADE + 1], worlds[w, GRADE + 2])
    fibre = worlds[w, FIBRE]
    axis = vec3(worlds[w, FIBRE_AXIS], worlds[w, FIBRE_AXIS + 1], worlds[w, FIBRE_AXIS + 2])
    for t in range(mesh.cells.shape[0]):
        scale = mesh.shares[t] * ti.max(0.01, 1.0 + worlds[w, GRADE_AT] + grade.dot(mesh.centres[t]))
        mu = worlds[w, MU] * scale
        lam = worlds[w, LAMBDA] * scale
        n0 = mesh.cells[t, 0]
        n1 = mesh.cells[t, 1]
        n2 = mesh.cells[t, 2]
        n3 = mesh.cells[t, 3]
        x0 = state.x[w, n0]
        shape = mesh.shapes[t]
        F = ti.Matrix.cols([state.x[w, n1] - x0, state.x[w, n2] - x0, state.x[w, n3] - x0]) @ shape
        cofactors = ti.Matrix.cols(
            [column(F, 1).cross(column(F, 2)), column(F, 2).cross(column(F, 0)), column(F, 0).cross(column(F, 1))]
        )
        # A nearly crushed or inverted cell is still pushed open: the cofactors point there.
        J = ti.max(column(F, 0).dot(column(cofactors, 0)), CRUSHED)
        back = cofactors / J
        inverse = back.transpose()
        stress = mat3(0.0)
        if ti.static(yields):
            tau, after = yielded(F, inverse, state.plastic[w, t], mu, lam, worlds[w, YIELD])
            state.plastic[w, t] = after
            stress = tau @ back
        else:
            stress = mu * F + ((lam * logarithm(J) - mu) / J) * cofactors
        if ti.static(fibred):
            along = F @ axis
            s = along.norm() + 1e-12
            stress += (mesh.shares[t] * fibre * (s - 1.0) / s) * along.outer_product(axis)
        if ti.static(damped):
            v0 = state.v[w, n0]
            rate = ti.Matrix.cols([state.v[w, n1] - v0, state.v[w, n2] - v0, state.v[w, n3] - v0]) @ shape @ inverse
            tau_v = mu * (rate + rate.transpose())
            for i in ti.static(range(3)):
                tau_v[i, i] += lam * rate.trace()
            stress += worlds[w, DAMPING] * (tau_v @ back)
        H = stress @ (-mesh.volumes[t] * shape).transpose()
        h1 = vec3(H[0, 0], H[1, 0], H[2, 0])
        h2 = vec3(H[0, 1], H[1, 1], H[2, 1])
        h3 = vec3(H[0, 2], H[1, 2], H[2, 2])
        # Not +=, which Taichi makes atomic: only this thread writes the world's forces.
        state.f[w, n1] = state.f[w, n1] + h1
        state.f[w, n2] = state.f[w, n2] + h2
        state.f[w, n3] = state.f[w, n3] + h3
        state.f[w, n0] = state.f[w, n0] - h1 - h2 - h3


@ti.func
def whole_motion(w: ti.i32, masses: Reals2, x: Vectors2, v: Vectors2):
    """Return centre of mass, its velocity, and the spin with the body's angular momentum."""
    total = 0.0
    centre = vec3(0.0)
    speed = vec3(0.0)
    for n in range(x.shape[1]):
        total = total + masses[w, n]
        centre = centre + masses[w, n] * x[w, n]
        speed = speed + masses[w, n] * v[w, n]
    centre /= total
    speed /= total
    momentum = vec3(0.0)
    inertia = mat3(0.0)
    for n in range(x.shape[1]):
        r = x[w, n] - centre
        momentum = momentum + masses[w, n] * r.cross(v[w, n] - speed)
        turning = (-masses[w, n]) * r.outer_product(r)
        for i in ti.static(range(3)):
            turning[i, i] += masses[w, n] * r.dot(r)
        inertia = inertia + turning
    return centre, speed, ti.math.inverse(inertia) @ momentum


@kernel
def advance_worlds(
    worlds: Reals2,
    damped: ti.template(),
    yields: ti.template(),
    fibred: ti.template(),
    keep: ti.template(),
    mesh: MeshArrays,
    state: NodeState,
    tracks: TrackArrays,
):
    """Advance every world from its START through its times and write the tracked points.

    worlds (W, WORLD_ROW): parameters. damped, yields, fibred: whether they have viscosity, a yield stress, fibres.
    keep: also write positions and internal accelerations of all nodes.
    """
    ti.loop_config(block_dim=1)
    for w in range(worlds.shape[0]):
        now = worlds[w, START]
        gravity = vec3(worlds[w, GRAVITY], worlds[w, GRAVITY + 1], worlds[w, GRAVITY + 2])
        wind = vec3(worlds[w, WIND], worlds[w, WIND + 1], worlds[w, WIND + 2])
        anchor = vec3(worlds[w, TETHER_ANCHOR], worlds[w, TETHER_ANCHOR + 1], worlds[w, TETHER_ANCHOR + 2])
        drag = worlds[w, DRAG]
        for frame in range(tracks.counts[w, 0]):
            steps = ti.max(1, ti.cast(ti.ceil((tracks.times[w, frame] - now) / worlds[w, STEP] - 1e-9), ti.i32))
            dt = (tracks.times[w, frame] - now) / steps
            for step in range(steps):
                common = gravity
                if worlds[w, LIFT] != 0.0 or worlds[w, TETHER_STIFFNESS] > 0.0:
                    centre, speed, spin = whole_motion(w, state.masses, state.x, state.v)
                    common += worlds[w, LIFT] * spin.cross(speed)
                    away = anchor - centre
                    length = away.norm() + 1e-12
                    pull = worlds[w, TETHER_STIFFNESS] * (length - worlds[w, TETHER_LENGTH])
                    if worlds[w, TETHER_STRING] > 0.5:
                        pull = ti.max(pull, 0.0)
                    common += pull / length * away
                if worlds[w, ADHESION] > 0.0:
                    lowest = 1e9
                    for n in range(state.x.shape[1]):
                        lowest = ti.min(lowest, state.x[w, n][2])
                    if lowest < worlds[w, REACH]:
                        common[2] -= worlds[w, ADHESION]
                for n in range(state.x.shape[1]):
                    state.f[w, n] = vec3(0.0)
                inner_forces(w, worlds, damped, yields, fibred, mesh, state)
                if ti.static(keep):
                    begun = step == 0 and frame > 0
                    for n in range(state.x.shape[1] if begun else 0):
                        tracks.kept_f[w, frame - 1, n] = state.f[w, n] / state.masses[w, n]
                for n in range(state.x.shape[1]):
                    m = state.masses[w, n]
                    speed_n = state.v[w, n]
                    pushed = common
                    if drag > 0.0:
                        past = speed_n - wind
                        pushed -= drag * past.norm() * past
                    speed_n += dt * (state.f[w, n] / m + pushed)
                    depth = -state.x[w, n][2]
                    if depth > 0.0:
                        spring = worlds[w, CONTACT_STIFFNESS] * mesh.areas[n] / m
                        press = ti.min(spring, CONTACT_LIMIT / (dt * dt)) * depth * dt
                        slide = vec3(speed_n[0], speed_n[1], 0.0)
                        fast = slide.norm()
                        speed_n[2] += press
                        if fast > 1e-12:
                            speed_n -= ti.min(1.0, worlds[w, FRICTION] * press / fast) * slide
                    state.v[w, n] = speed_n
                    state.x[w, n] = state.x[w, n] + dt * speed_n
            now = tracks.times[w, frame]
            for k in range(tracks.holders.shape[0]):
                place = vec3(0.0)
                for j in range(4):
                    place = place + tracks.weights[k, j] * state.x[w, tracks.holders[k, j]]
                tracks.tracked[w, frame, k] = place
            if ti.static(keep):
                for n in range(state.x.shape[1]):
                    tracks.kept_x[w, frame, n] = state.x[w, n]
