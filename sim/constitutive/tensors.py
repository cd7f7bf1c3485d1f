# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Device functions that several constitutive models share."""

import taichi as ti

vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
mat3 = ti.types.matrix(3, 3, ti.f32)

LEAST_STRETCH = 1e-3
"""Principal stretches below this (and inverted ones) count as this in logarithms."""

TERMS = 12
MOST_SERIES = 0.0675
"""Terms of a ``series``, and its largest p: eigenvalues of Y up to 0.3, where the next term is below 1.2e-8."""

FEW = 6
FEW_SERIES = 0.0027
"""The same of what is hardly strained: eigenvalues of Y up to 0.06, where the next term is below 4e-10."""

LOG = (0.0, *((-1.0) ** (n + 1) / n for n in range(1, TERMS + 1)))
"""Taylor coefficients of ln(1 + y)."""


@ti.func
def eigen_symmetric(a: mat3):
    """Eigenvalues and eigenvectors (columns) of a symmetric 3x3 matrix by cyclic Jacobi rotations, which converge in
    some four sweeps: the rest are skipped."""
    d = vec3(a[0, 0], a[1, 1], a[2, 2])
    off = vec3(a[1, 2], a[0, 2], a[0, 1])  # that of the axes other than i
    q = ti.Matrix.identity(ti.f32, 3)
    for _ in range(6):
        for pair in ti.static(((0, 1, 2), (0, 2, 1), (1, 2, 0))):
            i, j, k = ti.static(pair[0], pair[1], pair[2])
            if ti.abs(off[k]) > 1e-10 * (ti.abs(d[i]) + ti.abs(d[j])):
                theta = (d[j] - d[i]) / (2.0 * off[k])
                t = 1.0 / (ti.abs(theta) + ti.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / ti.sqrt(t * t + 1.0)
                s = t * c
                d[i] -= t * off[k]
                d[j] += t * off[k]
                off[k] = 0.0
                ik, jk = off[j], off[i]
                off[j] = c * ik - s * jk
                off[i] = s * ik + c * jk
                for r in ti.static(range(3)):
                    qi, qj = q[r, i], q[r, j]
                    q[r, i] = c * qi - s * qj
                    q[r, j] = s * qi + c * qj
    return d, q


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
def series(coefficients: ti.template(), p: ti.f32, q: ti.f32):
    """Numbers f of f[0] + f[1] Y + f[2] Y² = sum of coefficients[n] Y^n for a traceless symmetric matrix Y, of which
    p = tr Y² / 2 and q = det Y: by Horner's rule, with Y³ = p Y + q (Cayley and Hamilton)."""
    f = vec3(0.0)
    if p < FEW_SERIES:
        f = vec3(coefficients[FEW - 2], coefficients[FEW - 1], coefficients[FEW])
        for i in ti.static(range(FEW - 2)):
            f = vec3(q * f[2] + coefficients[FEW - 3 - i], f[0] + p * f[2], f[1])
    else:
        f = vec3(coefficients[TERMS - 2], coefficients[TERMS - 1], coefficients[TERMS])
        for i in ti.static(range(TERMS - 2)):
            f = vec3(q * f[2] + coefficients[TERMS - 3 - i], f[0] + p * f[2], f[1])
    return f


@ti.func
def log_series(p: ti.f32, q: ti.f32):
    """``series`` of ln(1 + Y)."""
    return series(LOG, p, q)


@ti.func
def power_series(exponent: ti.f32, p: ti.f32, q: ti.f32):
    """``series`` of (1 + Y)^exponent."""
    binomials = ti.Vector.one(ti.f32, TERMS + 1)
    for n in ti.static(range(1, TERMS + 1)):
        binomials[n] = binomials[n - 1] * ((exponent - float(n - 1)) * (1.0 / n))
    return series(binomials, p, q)


@ti.func
def hencky_stress(volume: ti.f32, deviator: mat3, shear: ti.f32, two_mu: ti.f32, lam: ti.f32):
    """Stress 2 mu e + lambda tr e of the Hencky strain with the trace ``volume`` and this deviator, ``shear`` its norm;
    and rho0 c^2 = 2 mu + lambda - the least principal stress, or a little more."""
    tau = two_mu * deviator
    mean = (two_mu * (1.0 / 3.0) + lam) * volume
    for i in ti.static(range(3)):
        tau[i, i] += mean
    # No eigenvalue of a traceless symmetric matrix is below -sqrt(2/3) times its norm.
    return tau, two_mu + lam - ti.min(mean - 0.8164966 * two_mu * shear, 0.0)
