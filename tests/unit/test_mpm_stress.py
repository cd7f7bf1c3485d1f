# SPDX-License-Identifier: MIT
"""The stress kernel against an SVD in float64."""

import numpy as np
import pytest

ti = pytest.importorskip("taichi")


def reference(F: np.ndarray, two_mu: float, lam: float) -> np.ndarray:
    """Fixed-corotated Kirchhoff stress (Stomakhin et al. 2012) by SVD, inverted elements with a negative stretch."""
    U, s, _ = np.linalg.svd(F)
    s[:, 2] *= np.sign(np.linalg.det(F))
    U[:, :, 2] *= np.sign(np.linalg.det(F))[:, None]
    J = s.prod(axis=1)
    principal = two_mu * (s**2 - s) + lam * (J * (J - 1))[:, None]
    return np.einsum("nij,nj,nkj->nik", U, principal, U)


@pytest.fixture(scope="module")
def evaluate():
    from physgen.sim.constitutive import ElasticMaterial
    from physgen.sim.mpm.kernels import runtime
    from physgen.sim.mpm.kernels.layout import Matrices, Scalars, mat3, vec4
    from physgen.sim.mpm.solver_options import SolverOptions

    runtime.ensure_started(SolverOptions())
    stress = ElasticMaterial.device().stress

    @ti.kernel
    def kernel(two_mu: ti.f32, lam: ti.f32, F: Matrices, tau: Matrices, modulus: Scalars):
        for p in range(F.shape[0]):
            t, m, _ = stress(F[p], F[p], 0.0, two_mu, lam, vec4(0.0))
            tau[p] = t
            modulus[p] = m

    def call(F: np.ndarray, two_mu: float, lam: float) -> tuple[np.ndarray, np.ndarray]:
        n = len(F)
        given, tau, modulus = ti.ndarray(mat3, n), ti.ndarray(mat3, n), ti.ndarray(ti.f32, n)
        given.from_numpy(F.astype(np.float32))
        kernel(two_mu, lam, given, tau, modulus)
        return tau.to_numpy().astype(float), modulus.to_numpy().astype(float)

    return call


def rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(n, 3, 3)))
    return q * np.sign(np.linalg.det(q))[:, None, None]


@pytest.mark.parametrize(
    "low, high, invert, tolerance",
    [(0.999, 1.001, False, 2e-6), (0.5, 2.0, False, 1e-5), (0.01, 8.0, False, 1e-5), (0.01, 4.0, True, 1e-5)],
)
def test_stress_matches_the_svd(evaluate, low, high, invert, tolerance):
    """Tolerance relative to the largest entry of b = F Fᵀ times the modulus: float32 has 6e-8."""
    rng = np.random.default_rng(0)
    stretch = rng.uniform(low, high, (4000, 3))
    if invert:
        stretch[:, 0] *= -1
    F = rotations(rng, 4000) * stretch[:, None, :] @ rotations(rng, 4000)
    F = F.astype(np.float32).astype(float)
    tau, _ = evaluate(F, 3.0, 2.0)
    J = np.abs(np.linalg.det(F))
    scale = 3.0 * (F**2).sum(axis=(1, 2)) + 2.0 * J * (J + 1)
    error = np.abs(tau - reference(F, 3.0, 2.0)).max(axis=(1, 2)) / scale
    assert error.max() < tolerance


def test_rest_and_collapse_are_finite(evaluate):
    F = np.stack(
        [np.eye(3), np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([1e-6] * 3), np.diag([50.0, 1e-3, 1.0])]
    )
    tau, modulus = evaluate(F, 3.0, 2.0)
    assert np.isfinite(tau).all()
    assert np.isfinite(modulus).all()
    assert np.abs(tau[0]).max() < 3e-6
    assert modulus[0] == pytest.approx(5.0, rel=1e-3)
