# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Fixed-corotated elasticity (Stomakhin et al. 2012, "Energetically consistent invertible elasticity").

    psi = mu * sum_i (s_i - 1)^2 + lambda / 2 * (J - 1)^2
    tau = 2 mu (F - R) F^T + lambda J (J - 1) I          (Kirchhoff stress)

With the left stretch V (F = V R, b = F F^T = V^2) the first term is 2 mu (b - V), so no rotation is needed. V follows
from the invariants of b: i1 = tr V is the largest root of (i1^2 - I1)^2 / 4 = I2 + 2 J i1, found by Newton's method
from above (Hoger and Carlson 1984 give V from its invariants). Where that is ill-conditioned (collapsed or inverted
particles, extreme stretch) b is diagonalised instead, and an inverted particle has its smallest stretch negative, as in
the paper. Both branches describe the same energy.
"""

import taichi as ti

from .layout import mat3, vec3

NEWTON_STEPS = 4
"""Enough for 1e-6 between stretches of 0.5 and 2; where it is not, the last change shows it."""


@ti.func
def eigen_symmetric(a: mat3):
    """Eigenvalues and eigenvectors (columns) of a symmetric 3x3 matrix by cyclic Jacobi rotations."""
    d = a
    q = ti.Matrix.identity(ti.f32, 3)
    for _ in range(6):
        for pair in ti.static(((0, 1), (0, 2), (1, 2))):
            i, j = ti.static(pair[0], pair[1])
            off = d[i, j]
            if ti.abs(off) > 1e-12 * (ti.abs(d[i, i]) + ti.abs(d[j, j])):
                theta = (d[j, j] - d[i, i]) / (2.0 * off)
                t = 1.0 / (ti.abs(theta) + ti.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / ti.sqrt(t * t + 1.0)
                s = t * c
                g = ti.Matrix.identity(ti.f32, 3)
                g[i, i] = c
                g[j, j] = c
                g[i, j] = s
                g[j, i] = -s
                d = g.transpose() @ d @ g
                q = q @ g
    return vec3(d[0, 0], d[1, 1], d[2, 2]), q


@ti.func
def fixed_corotated(F: mat3, two_mu: ti.f32, lam: ti.f32):
    """Kirchhoff stress and the longitudinal stiffness rho0 c^2 that bounds the time step.

    A longitudinal wave along the principal direction i of the deformed body travels at
    c_i^2 = (2 mu s_i^2 + lambda J^2) / rho0; the largest s_i^2 is bounded by I1/3 + 2/3 sqrt(I1^2 - 3 I2).
    Both results carry the factor of ``two_mu`` and ``lam`` (the kernels pass them times the particle's volume).
    """
    J = F.determinant()
    b = F @ F.transpose()
    I1 = b.trace()
    b2 = b @ b
    I2 = 0.5 * (I1 * I1 - b2.trace())
    i1 = ti.sqrt(3.0 * I1 + 1e-30)
    change = 0.0
    for _ in ti.static(range(NEWTON_STEPS)):
        q = 0.5 * (i1 * i1 - I1)
        change = (q * q - I2 - 2.0 * J * i1) / (2.0 * (q * i1 - J) + 1e-30)
        i1 -= change
    i2 = 0.5 * (i1 * i1 - I1)
    pairs = i1 * i2 - J  # (s1 + s2)(s2 + s3)(s3 + s1)
    deviator = mat3(0.0)
    if J > 0.0 and pairs > 1e-2 * i1 * i1 * i1 and ti.abs(change) < 1e-3 * i1:
        scale = 1.0 / pairs
        deviator = (1.0 - (i1 * i1 - i2) * scale) * b + scale * b2
        for i in ti.static(range(3)):
            deviator[i, i] -= i1 * J * scale
    else:
        squares, axes = eigen_symmetric(b)
        stretch = ti.sqrt(ti.max(squares, 0.0))
        if J < 0.0:
            if stretch[0] <= stretch[1] and stretch[0] <= stretch[2]:
                stretch[0] = -stretch[0]
            elif stretch[1] <= stretch[2]:
                stretch[1] = -stretch[1]
            else:
                stretch[2] = -stretch[2]
        for i in ti.static(range(3)):
            axis = vec3(axes[0, i], axes[1, i], axes[2, i])
            deviator += (stretch[i] * (stretch[i] - 1.0)) * axis.outer_product(axis)
    tau = two_mu * deviator
    pressure = lam * J * (J - 1.0)
    for i in ti.static(range(3)):
        tau[i, i] += pressure
    largest = I1 * (1.0 / 3.0) + (2.0 / 3.0) * ti.sqrt(ti.max(I1 * I1 - 3.0 * I2, 0.0))
    return tau, two_mu * largest + lam * J * J
