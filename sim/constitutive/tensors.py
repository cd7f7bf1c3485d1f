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
def hencky_stress(strain: vec3, two_mu: ti.f32, lam: ti.f32):
    """Principal Kirchhoff stress 2 mu e + lambda tr e and rho0 c^2 = 2 mu + lambda - the least principal stress."""
    principal = two_mu * strain + lam * strain.sum()
    return principal, two_mu + lam - ti.min(principal.min(), 0.0)
