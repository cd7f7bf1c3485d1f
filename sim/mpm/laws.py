# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102, SIM109
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Constitutive laws beyond fixed-corotated elasticity, all on the left stretch b = F F^T, whose axes are the stress's.

Plastic laws map the trial deformation back onto the yield surface: F <- U diag(s_new / s) U^T F, which changes the
principal stretches s and keeps everything else, so no right singular vectors are needed.

    neo_hookean  psi = mu/2 (tr b - 3) - mu ln J + lambda/2 (ln J)^2         Bonet and Wood 1997
    von_mises    Hencky strain e = ln s, tau = 2 mu e + lambda tr e,  sqrt(3/2) |dev tau| <= yield stress: radial return
                                                                             Simo 1992, Simo and Hughes 1998
    snow         fixed-corotated, s clamped to [1 - theta_c, 1 + theta_s], moduli times exp(xi (1 - J_P))
                                                                             Stomakhin et al. 2013
    sand         Hencky strain, Drucker–Prager cone by return without dilatancy, expansion remembered and taken back
                 before pressure returns                       Klár et al. 2016; Tampubolon et al. 2017 for the latter
    fluid        p = K/7 (J^-7 - 1), never below 0; tau = -J p + 2 eta J dev D      Cole 1948, Becker and Teschner 2007
    fibres       psi += k/2 (s - 1)^2, s = |F a|: tau += k (s - 1) / s  F a (F a)^T      Bonet and Burton 1998
    damping      tau += t (2 mu D + lambda tr D)      Kelvin–Voigt, with one retardation time t for shear and volume

D is the symmetric part of the velocity gradient. ``memory`` is one number a particle, 0 at rest: ln J_P in snow, the
remembered ln of expansion in sand, ln J in fluids.
"""

import taichi as ti

from .constitutive import eigen_symmetric, fixed_corotated
from .layout import Integers, Matrices, Scalars, mat3, vec3, vec4
from .materials import DAMPED, FIBRED, FLUID, NEO_HOOKEAN, ROW, SAND, SNOW, STABLE_WAVENUMBER, VON_MISES

LEAST_STRETCH = 1e-3
"""Principal stretches below this (and inverted ones) count as this in logarithms."""

PACKED = -0.5
LOOSE = 0.7
"""Limits of ln J_P of snow: beyond a volume ratio of 0.6 to 2 its moduli change no further."""

TAIT = 7.0
"""Exponent of Tait's equation for water."""

FLUID_LOOSE = 0.02
FLUID_PACKED = -1.0
"""Limits of ln J of fluids: matter that flies apart forgets how far, so that it meets resistance when it returns."""


@ti.func
def axis_of(axes: mat3, i: ti.template()):
    """Column ``i``."""
    return vec3(axes[0, i], axes[1, i], axes[2, i])


@ti.func
def isotropic(values: vec3, axes: mat3):
    """Symmetric matrix of the eigenvalues ``values`` along the columns of ``axes``."""
    result = mat3(0.0)
    for i in ti.static(range(3)):
        a = axis_of(axes, i)
        result += values[i] * a.outer_product(a)
    return result


@ti.func
def neo_hookean(F: mat3, two_mu: ti.f32, lam: ti.f32):
    """Kirchhoff stress mu (b - I) + lambda ln J I and the stiffness rho0 c^2 of the fastest wave.

    Along the principal direction i, rho0 c_i^2 = mu (s_i^2 + 1) + lambda (1 - ln J).
    """
    mu = 0.5 * two_mu
    log_j = ti.log(ti.max(F.determinant(), LEAST_STRETCH**3))
    b = F @ F.transpose()
    tau = mu * b
    for i in ti.static(range(3)):
        tau[i, i] += lam * log_j - mu
    b2 = b @ b
    I1 = b.trace()
    largest = I1 * (1.0 / 3.0) + ti.sqrt(ti.max((2.0 / 3.0) * (b2.trace() - I1 * I1 * (1.0 / 3.0)), 0.0))
    return tau, mu * (largest + 1.0) + lam * ti.max(1.0 - log_j, 0.0)


@ti.func
def hencky(strain: vec3, axes: mat3, two_mu: ti.f32, lam: ti.f32):
    """Kirchhoff stress 2 mu e + lambda tr e and rho0 c^2 = 2 mu + lambda - the least principal stress."""
    principal = two_mu * strain + lam * strain.sum()
    return isotropic(principal, axes), two_mu + lam - ti.min(principal.min(), 0.0)


@ti.func
def plastic(law: ti.i32, laws: ti.template(), F: mat3, memory: ti.f32, two_mu: ti.f32, lam: ti.f32, own: vec4):
    """Return mapping and stress of the plastic laws: F, memory, Kirchhoff stress, stiffness."""
    squares, axes = eigen_symmetric(F @ F.transpose())
    stretch = ti.sqrt(ti.max(squares, LEAST_STRETCH**2))
    kept = stretch
    tau = mat3(0.0)
    stiffness = 0.0
    remembered = memory
    if ti.static(laws & (1 << SNOW)):
        if law == SNOW:
            kept = ti.min(ti.max(stretch, 1.0 - own[0]), 1.0 + own[1])
            lost = ti.log(stretch[0] * stretch[1] * stretch[2] / (kept[0] * kept[1] * kept[2]))
            remembered = ti.min(ti.max(memory + lost, PACKED), LOOSE)
            harder = ti.exp(own[2] * (1.0 - ti.exp(remembered)))
            J = kept[0] * kept[1] * kept[2]
            tau = isotropic(harder * (two_mu * (kept * kept - kept) + lam * J * (J - 1.0)), axes)
            stiffness = harder * (two_mu * kept.max() ** 2 + lam * J * J)
    if ti.static(laws & ((1 << VON_MISES) | (1 << SAND))):
        if law == VON_MISES or law == SAND:
            strain = ti.log(stretch)
            if ti.static(laws & (1 << VON_MISES)):
                if law == VON_MISES:
                    shear = strain - strain.sum() / 3.0
                    norm = shear.norm()
                    if norm > own[0]:
                        strain -= (1.0 - own[0] / norm) * shear
                        kept = ti.exp(strain)
            if ti.static(laws & (1 << SAND)):
                if law == SAND:
                    strain += memory / 3.0
                    volumetric = strain.sum()
                    if volumetric >= 0.0:
                        strain = vec3(0.0)
                        remembered = volumetric
                    else:
                        remembered = 0.0
                        shear = strain - volumetric / 3.0
                        norm = shear.norm()
                        beyond = norm + volumetric * own[0]
                        if beyond > 0.0:
                            strain -= (beyond / norm) * shear
                    if (strain != ti.log(stretch)).any():
                        kept = ti.exp(strain)
            tau, stiffness = hencky(strain, axes, two_mu, lam)
    mapped = F
    if (kept != stretch).any() or squares.min() < LEAST_STRETCH**2:
        mapped = isotropic(kept / stretch, axes) @ F
        if squares.min() < LEAST_STRETCH**2:
            mapped = isotropic(kept, axes)
    return mapped, remembered, tau, stiffness


@ti.func
def fluid(log_j: ti.f32, C: mat3, two_eta: ti.f32, bulk: ti.f32):
    """Kirchhoff stress, rho0 c^2 and the longitudinal viscosity times the volume."""
    J = ti.exp(log_j)
    pressure = ti.max(bulk / TAIT * (ti.exp(-TAIT * log_j) - 1.0), 0.0)
    D = 0.5 * (C + C.transpose())
    tau = two_eta * J * D
    for i in ti.static(range(3)):
        tau[i, i] -= J * (pressure + two_eta * C.trace() / 3.0)
    return tau, bulk * ti.exp((1.0 - TAIT) * log_j), two_eta * (2.0 / 3.0) * J


@ti.func
def deform(
    laws: ti.template(),
    p: ti.i32,
    dt: ti.f32,
    C: mat3,
    F: Matrices,
    material: Integers,
    table: Scalars,
    memory: Scalars,
):
    """Deformation gradient of particle ``p`` after ``dt``; of fluids only the volume changes, in ``memory``."""
    Fp = F[p]
    if ti.static(laws & (1 << FLUID)):
        if ti.cast(table[material[p] * ROW], ti.i32) == FLUID:
            memory[p] = ti.min(ti.max(memory[p] + dt * C.trace(), FLUID_PACKED), FLUID_LOOSE)
        else:
            Fp += dt * C @ Fp
    else:
        Fp += dt * C @ Fp
    return Fp


@ti.func
def respond(
    laws: ti.template(),
    p: ti.i32,
    Fp: mat3,
    C: mat3,
    fixed: vec4,
    F: Matrices,
    material: Integers,
    table: Scalars,
    memory: Scalars,
):
    """Kirchhoff stress of particle ``p`` and the stiffness m c^2 that bounds the substep; F and memory are mapped back.

    Both carry the particle's volume, as ``fixed`` does. ``laws``: the set of laws that occur, known to the compiler.
    """
    row = material[p] * ROW
    law = ti.cast(table[row], ti.i32)
    tau = mat3(0.0)
    stiffness = 0.0
    viscosity = 0.0
    if ti.static(laws & 1):
        if law == 0:
            tau, stiffness = fixed_corotated(Fp, fixed[1], fixed[2])
    if ti.static(laws & (1 << NEO_HOOKEAN)):
        if law == NEO_HOOKEAN:
            tau, stiffness = neo_hookean(Fp, fixed[1], fixed[2])
    if ti.static(laws & ((1 << VON_MISES) | (1 << SNOW) | (1 << SAND))):
        if law == VON_MISES or law == SNOW or law == SAND:
            own = vec4(table[row + 2], table[row + 3], table[row + 4], table[row + 5])
            mapped, remembered, stress, modulus = plastic(law, laws, Fp, memory[p], fixed[1], fixed[2], own)
            tau, stiffness = stress, modulus
            F[p] = mapped
            memory[p] = remembered
    if ti.static(laws & (1 << FLUID)):
        if law == FLUID:
            tau, stiffness, viscosity = fluid(memory[p], C, fixed[1], fixed[2])
    if ti.static(laws & FIBRED):
        fibres = table[row + 6] * fixed[1]
        if fibres > 0.0:
            along = Fp @ vec3(table[row + 7], table[row + 8], table[row + 9])
            stretch = along.norm() + 1e-12
            tau += (fibres * (stretch - 1.0) / stretch) * along.outer_product(along)
            stiffness += fibres * stretch * stretch
    if ti.static(laws & DAMPED):
        time = table[row + 1]
        if time > 0.0 and law != FLUID:
            tau += (0.5 * time * fixed[1]) * (C + C.transpose())
            for i in ti.static(range(3)):
                tau[i, i] += time * fixed[2] * C.trace()
            viscosity = time * (fixed[1] + fixed[2])
    if ti.static(laws & (DAMPED | (1 << FLUID))):
        if viscosity > 0.0:
            # See materials.bounding_speed.
            half = (0.5 * STABLE_WAVENUMBER) * viscosity / fixed[0]
            speed = half + ti.sqrt(half * half + stiffness / fixed[0])
            stiffness = fixed[0] * speed * speed
    return tau, stiffness
