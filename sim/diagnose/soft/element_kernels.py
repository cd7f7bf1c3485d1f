# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, operator, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Explicit finite elements: linear tetrahedra, lumped masses, leapfrog; many worlds of one body in one launch.

Each world is one thread's work from start to end, so that nothing is shared and no addition needs to be atomic.

    elastic   psi = mu/2 (tr b - 3 - 2 ln J) + lambda/2 (ln J)²          (neo-Hookean, tau = mu (b - 1) + lambda ln J 1)
    fibres    psi += k/2 (s - 1)², s = |F a|                             (sim/effects/anisotropy)
    damping   tau += t (2 mu D + lambda tr D 1)                          (sim/effects/internal_damping)
    yielding  tau = 2 mu dev e + K tr e 1, e = ln of the elastic stretch, radial return at sqrt(3/2)|dev tau| = Y
              (sim/effects/plastic_yield; Simo, Comput. Methods Appl. Mech. Eng. 99, 1992)

Contact with the plane z = 0 of the world's own frame: springs, by area, at nodes of the surface that are below it, and
Coulomb's friction as an impulse that at most stops the node.
"""

import taichi as ti

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
"""Largest stiffness of the ground's spring at a node over its mass and the squared step, for what a step misjudges."""

CRUSHED = 0.15
"""Volume ratio below which a cell is treated as if it had that one."""


@ti.func
def column(a: mat3, i: ti.template()):
    """Column i."""
    return vec3(a[0, i], a[1, i], a[2, i])


@ti.func
def plus(a: mat3, c: real):
    """a + c 1."""
    out = a
    for i in ti.static(range(3)):
        out[i, i] += c
    return out


@ti.func
def half_log(b: mat3):
    """ln(b) / 2 of a symmetric b by the Padé approximant (2, 2): 1e-3 of it between stretches of 0.6 and 1.6."""
    square = b @ b
    return 1.5 * plus(square, -1.0) @ ti.math.inverse(plus(square + 4.0 * b, 1.0))


@ti.func
def exponential(a: mat3):
    """exp(a) of a symmetric a by the Padé approximant (2, 2)."""
    even = plus(a @ a, 12.0)
    return (even + 6.0 * a) @ ti.math.inverse(even - 6.0 * a)


@ti.func
def yielded(F: mat3, inverse: mat3, plastic: mat3, mu: real, lam: real, limit: real):
    """Kirchhoff stress and the new inverse plastic strain C_p^-1 of trial F, given the old ``plastic``."""
    strain = half_log(F @ plastic @ F.transpose())
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
def inner_forces(
    w: ti.i32,
    worlds: Reals2,
    cells: Integers2,
    shapes: Matrices,
    volumes: Reals,
    centres: Vectors,
    shares: Reals,
    x: Vectors2,
    v: Vectors2,
    plastic: Matrices2,
    f: Vectors2,
    damped: ti.template(),
    yields: ti.template(),
):
    """Add to f (worlds, nodes) what the matter of world w exerts; plastic strain goes on where it yields."""
    grade = vec3(worlds[w, GRADE], worlds[w, GRADE + 1], worlds[w, GRADE + 2])
    fibre = worlds[w, FIBRE]
    axis = vec3(worlds[w, FIBRE_AXIS], worlds[w, FIBRE_AXIS + 1], worlds[w, FIBRE_AXIS + 2])
    for t in range(cells.shape[0]):
        scale = shares[t] * ti.max(0.01, 1.0 + worlds[w, GRADE_AT] + grade.dot(centres[t]))
        mu = worlds[w, MU] * scale
        lam = worlds[w, LAMBDA] * scale
        n0 = cells[t, 0]
        n1 = cells[t, 1]
        n2 = cells[t, 2]
        n3 = cells[t, 3]
        x0 = x[w, n0]
        shape = shapes[t]
        F = ti.Matrix.cols([x[w, n1] - x0, x[w, n2] - x0, x[w, n3] - x0]) @ shape
        J = F.determinant()
        # A cell that is all but crushed, or inside out, is still pushed open: the cofactors point there.
        cofactors = ti.Matrix.cols(
            [column(F, 1).cross(column(F, 2)), column(F, 2).cross(column(F, 0)), column(F, 0).cross(column(F, 1))]
        )
        back = cofactors / ti.max(J, CRUSHED)
        inverse = back.transpose()
        stress = mat3(0.0)
        if ti.static(yields):
            tau, after = yielded(F, inverse, plastic[w, t], mu, lam, worlds[w, YIELD])
            plastic[w, t] = after
            stress = tau @ back
        else:
            stress = mu * (F - back) + (lam * ti.log(ti.max(J, CRUSHED))) * back
        if fibre > 0.0:
            along = F @ axis
            s = along.norm() + 1e-12
            stress += (shares[t] * fibre * (s - 1.0) / s) * along.outer_product(axis)
        if ti.static(damped):
            v0 = v[w, n0]
            rate = ti.Matrix.cols([v[w, n1] - v0, v[w, n2] - v0, v[w, n3] - v0]) @ shape @ inverse
            tau_v = mu * (rate + rate.transpose())
            for i in ti.static(range(3)):
                tau_v[i, i] += lam * rate.trace()
            stress += worlds[w, DAMPING] * (tau_v @ back)
        H = (-volumes[t]) * (stress @ shape.transpose())
        h1 = vec3(H[0, 0], H[1, 0], H[2, 0])
        h2 = vec3(H[0, 1], H[1, 1], H[2, 1])
        h3 = vec3(H[0, 2], H[1, 2], H[2, 2])
        # Not +=, which Taichi makes atomic: only this thread writes the world's forces.
        f[w, n1] = f[w, n1] + h1
        f[w, n2] = f[w, n2] + h2
        f[w, n3] = f[w, n3] + h3
        f[w, n0] = f[w, n0] - h1 - h2 - h3


@ti.func
def whole_motion(w: ti.i32, masses: Reals2, x: Vectors2, v: Vectors2):
    """Centre of mass, its velocity, and the spin that has the body's angular momentum."""
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


@ti.kernel
def advance_worlds(
    worlds: Reals2,
    cells: Integers2,
    shapes: Matrices,
    volumes: Reals,
    centres: Vectors,
    shares: Reals,
    areas: Reals,
    masses: Reals2,
    times: Reals2,
    counts: Integers2,
    holders: Integers2,
    weights: Reals2,
    x: Vectors2,
    v: Vectors2,
    f: Vectors2,
    plastic: Matrices2,
    tracked: Vectors3,
    kept_x: Vectors3,
    kept_f: Vectors3,
    damped: ti.template(),
    yields: ti.template(),
    keep: ti.template(),
):
    """Advance every world from its START through its ``times`` (worlds, frames) and write the tracked points.

    areas (nodes,): of the surface, m². counts (worlds, 1): frames of a world. holders (points, 4) and weights
    (points, 4): nodes of a point's cell.
    keep: also write places and inner accelerations of all nodes; those of a world's last frame are not written.
    """
    ti.loop_config(block_dim=1)
    for w in range(worlds.shape[0]):
        now = worlds[w, START]
        gravity = vec3(worlds[w, GRAVITY], worlds[w, GRAVITY + 1], worlds[w, GRAVITY + 2])
        wind = vec3(worlds[w, WIND], worlds[w, WIND + 1], worlds[w, WIND + 2])
        anchor = vec3(worlds[w, TETHER_ANCHOR], worlds[w, TETHER_ANCHOR + 1], worlds[w, TETHER_ANCHOR + 2])
        drag = worlds[w, DRAG]
        for frame in range(counts[w, 0]):
            steps = ti.max(1, ti.cast(ti.ceil((times[w, frame] - now) / worlds[w, STEP] - 1e-9), ti.i32))
            dt = (times[w, frame] - now) / steps
            for step in range(steps):
                common = gravity
                if worlds[w, LIFT] != 0.0 or worlds[w, TETHER_STIFFNESS] > 0.0:
                    centre, speed, spin = whole_motion(w, masses, x, v)
                    common += worlds[w, LIFT] * spin.cross(speed)
                    away = anchor - centre
                    length = away.norm() + 1e-12
                    pull = worlds[w, TETHER_STIFFNESS] * (length - worlds[w, TETHER_LENGTH])
                    if worlds[w, TETHER_STRING] > 0.5:
                        pull = ti.max(pull, 0.0)
                    common += pull / length * away
                if worlds[w, ADHESION] > 0.0:
                    lowest = 1e9
                    for n in range(x.shape[1]):
                        lowest = ti.min(lowest, x[w, n][2])
                    if lowest < worlds[w, REACH]:
                        common[2] -= worlds[w, ADHESION]
                for n in range(x.shape[1]):
                    f[w, n] = vec3(0.0)
                inner_forces(w, worlds, cells, shapes, volumes, centres, shares, x, v, plastic, f, damped, yields)
                if ti.static(keep):
                    begun = step == 0 and frame > 0
                    for n in range(x.shape[1] if begun else 0):
                        kept_f[w, frame - 1, n] = f[w, n] / masses[w, n]
                for n in range(x.shape[1]):
                    m = masses[w, n]
                    speed_n = v[w, n]
                    pushed = common
                    if drag > 0.0:
                        past = speed_n - wind
                        pushed -= drag * past.norm() * past
                    speed_n += dt * (f[w, n] / m + pushed)
                    depth = -x[w, n][2]
                    if depth > 0.0:
                        spring = worlds[w, CONTACT_STIFFNESS] * areas[n] / m
                        press = ti.min(spring, CONTACT_LIMIT / (dt * dt)) * depth * dt
                        slide = vec3(speed_n[0], speed_n[1], 0.0)
                        fast = slide.norm()
                        speed_n[2] += press
                        if fast > 1e-12:
                            speed_n -= ti.min(1.0, worlds[w, FRICTION] * press / fast) * slide
                    v[w, n] = speed_n
                    x[w, n] = x[w, n] + dt * speed_n
            now = times[w, frame]
            for k in range(holders.shape[0]):
                place = vec3(0.0)
                for j in range(4):
                    place = place + weights[k, j] * x[w, holders[k, j]]
                tracked[w, frame, k] = place
            if ti.static(keep):
                for n in range(x.shape[1]):
                    kept_x[w, frame, n] = x[w, n]
