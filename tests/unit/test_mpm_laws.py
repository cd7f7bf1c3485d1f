# SPDX-License-Identifier: MIT
"""The laws' kernels against numpy in float64; presets reach the engine with their numbers."""

import math

import numpy as np
import pytest
from physgen.sim.app.scene_bodies import engine_material
from physgen.sim.constitutive import (
    ElasticMaterial,
    FluidMaterial,
    NeoHookeanMaterial,
    RigidMaterial,
    SandMaterial,
    SnowMaterial,
    VonMisesMaterial,
    bounding_speed,
)
from physgen.sim.errors import InputError
from physgen.sim.scene.material import load_preset, preset_names
from physgen.sim.scene.model import LAWS, Material

ti = pytest.importorskip("taichi")

TWO_MU, LAM = 3.0, 2.0
VON_MISES, SNOW, SAND = VonMisesMaterial.number, SnowMaterial.number, SandMaterial.number
PLASTIC = (1 << VON_MISES) | (1 << SNOW) | (1 << SAND)


@pytest.fixture(scope="module")
def evaluate():
    from physgen.sim.mpm.kernels import runtime
    from physgen.sim.mpm.kernels.constitutive_response import law_set, map_back
    from physgen.sim.mpm.kernels.layout import Matrices, Scalars, mat3, vec4
    from physgen.sim.mpm.solver_options import SolverOptions

    runtime.ensure_started(SolverOptions())
    stress, plastic_models = NeoHookeanMaterial.device().stress, law_set(PLASTIC)

    @ti.kernel
    def elastic(F: Matrices, tau: Matrices):
        for p in range(F.shape[0]):
            t, _, _ = stress(F[p], F[p], 0.0, TWO_MU, LAM, vec4(0.0))
            tau[p] = t

    @ti.kernel
    def plastic(law: ti.i32, a: ti.f32, b: ti.f32, c: ti.f32, F: Matrices, memory: Scalars, tau: Matrices):
        for p in range(F.shape[0]):
            f, m, t, _ = map_back(law, plastic_models, F[p], memory[p], TWO_MU, LAM, vec4(a, b, c, 0.0))
            F[p], memory[p], tau[p] = f, m, t

    def call(law, F, own=(0.0, 0.0, 0.0), memory=0.0):
        n = len(F)
        given, tau, kept = ti.ndarray(mat3, n), ti.ndarray(mat3, n), ti.ndarray(ti.f32, n)
        given.from_numpy(F.astype(np.float32))
        kept.from_numpy(np.full(n, memory, dtype=np.float32))
        if law is None:
            elastic(given, tau)
        else:
            plastic(law, *own, given, kept, tau)
        return tau.to_numpy().astype(float), given.to_numpy().astype(float), kept.to_numpy().astype(float)

    return call


def deformations(n: int, low: float, high: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    q, _ = np.linalg.qr(rng.normal(size=(2, n, 3, 3)))
    q *= np.sign(np.linalg.det(q))[..., None, None]
    return q[0] * rng.uniform(low, high, (n, 1, 3)) @ q[1]


def deviator(tau: np.ndarray) -> np.ndarray:
    return tau - np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)


def test_neo_hookean_stress(evaluate):
    """1e-5 of the largest entry: float32."""
    F = deformations(2000, 0.1, 4.0).astype(np.float32).astype(float)
    tau, _, _ = evaluate(None, F)
    b = F @ F.transpose(0, 2, 1)
    expected = TWO_MU / 2 * (b - np.eye(3)) + LAM * np.log(np.linalg.det(F))[:, None, None] * np.eye(3)
    scale = np.abs(b).max(axis=(1, 2)) + np.abs(np.log(np.linalg.det(F))) + 1
    assert (np.abs(tau - expected).max(axis=(1, 2)) / (TWO_MU * scale)).max() < 1e-5


def test_von_mises_returns_to_the_yield_surface_and_keeps_volume(evaluate):
    """sqrt(3/2) |dev tau| <= yield stress, J unchanged, and a second return changes nothing; 1e-5 of the modulus."""
    F = deformations(2000, 0.5, 1.8)
    limit = 0.1
    tau, mapped, _ = evaluate(VON_MISES, F, (limit, 0.0, 0.0))
    norm = np.linalg.norm(deviator(tau), axis=(1, 2))
    assert norm.max() < TWO_MU * limit + 1e-4
    assert np.median(norm) == pytest.approx(TWO_MU * limit, abs=1e-4)
    assert np.abs(np.log(np.linalg.det(mapped) / np.linalg.det(F))).max() < 1e-4
    assert np.abs(evaluate(VON_MISES, mapped, (limit, 0.0, 0.0))[0] - tau).max() < 1e-4


def test_sand_stays_in_its_cone_and_remembers_expansion(evaluate):
    """|dev tau| <= -sqrt(2)/3 tan(angle) tr tau; ln J = ln J elastic + memory."""
    sand = SandMaterial(density=1.0, youngs_modulus=1.0, poisson_ratio=0.2, friction_angle=0.6)
    stiff = (3 * LAM + TWO_MU) / TWO_MU
    slope = math.sqrt(2) / 3 * math.tan(0.6)
    assert sand.row[2] == pytest.approx(slope * (3 * sand.lame_lambda / sand.shear_number + 1))
    F = deformations(2000, 0.7, 1.25)
    tau, mapped, memory = evaluate(SAND, F, (slope * stiff, 0.0, 0.0))
    trace = np.trace(tau, axis1=1, axis2=2)
    assert (np.linalg.norm(deviator(tau), axis=(1, 2)) <= -slope * trace + 1e-4).all()
    assert np.abs(np.log(np.linalg.det(F)) - np.log(np.linalg.det(mapped)) - memory).max() < 1e-4
    assert (memory > 0).any() and (memory == 0).any()


@pytest.mark.parametrize(("low", "high"), [(0.93, 1.05), (0.5, 1.8)])
def test_hencky_returns_are_those_of_the_principal_axes(evaluate, low, high):
    """Stress and F of sand and of von Mises' solid against principal axes in float64, for strains that the kernels take
    by series and for larger ones; 2e-6 of the modulus times 1 + the largest strain: float32."""
    F = deformations(2000, low, high).astype(np.float32).astype(float)
    U, stretch, Vt = np.linalg.svd(F)
    strain = np.log(stretch)
    volume = strain.sum(axis=1)
    shear = strain - volume[:, None] / 3
    norm = np.linalg.norm(shear, axis=1)
    scale = 1 + np.abs(strain).max()

    slope, memory = 0.9, 0.01
    elastic = np.minimum(volume + np.float32(memory), 0.0)
    inside = np.minimum(1.0, -slope * elastic / norm)
    limit = 0.04
    cases = (
        (SAND, (slope, 0.0, 0.0), memory, elastic, inside),
        (VON_MISES, (limit, 0.0, 0.0), 0.0, volume, np.minimum(1.0, limit / norm)),
    )
    for law, own, before, kept_volume, kept in cases:
        tau, mapped, _ = evaluate(law, F, own, before)
        left = kept_volume[:, None] / 3 + kept[:, None] * shear
        principal = TWO_MU * left + LAM * kept_volume[:, None]
        assert (kept < 1).mean() > 0.3 and (kept > 0).any()
        assert np.abs(tau - (U * principal[:, None, :]) @ U.transpose(0, 2, 1)).max() < 2e-6 * TWO_MU * scale
        assert np.abs(mapped - (U * np.exp(left)[:, None, :]) @ Vt).max() < 2e-6 * scale**2


def test_snow_clamps_its_stretches(evaluate):
    F = deformations(2000, 0.9, 1.1)
    _, mapped, memory = evaluate(SNOW, F, (0.025, 0.0075, 10.0))
    stretch = np.linalg.svd(mapped, compute_uv=False)
    assert stretch.min() > 0.975 - 1e-5
    assert stretch.max() < 1.0075 + 1e-5
    assert np.abs(np.log(np.linalg.det(F) / np.linalg.det(mapped)) - memory).max() < 1e-4


def test_plastic_laws_are_finite_when_crushed_or_inverted(evaluate):
    F = np.stack([np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([-1.0, 1.0, 1.0]), np.diag([50.0, 1e-5, 1.0])])
    for law, own in ((VON_MISES, (0.1, 0.0, 0.0)), (SNOW, (0.025, 0.0075, 10.0)), (SAND, (0.5, 0.0, 0.0))):
        for values in evaluate(law, F, own):
            assert np.isfinite(values).all()


def test_the_substep_bound_is_the_limit_of_its_recurrence():
    """The damped oscillator of the grid's highest mode is stable just below the bound and unstable just above it."""
    k = 2.0 / 0.58
    for wave_speed, diffusivity in ((10.0, 0.0), (10.0, 3.0), (1.0, 50.0)):
        limit = 0.58 / bounding_speed(wave_speed, diffusivity)
        for factor, stable in ((0.99, True), (1.01, False)):
            dt = factor * limit
            w2, r = (wave_speed * k) ** 2, diffusivity * k**2
            step = np.array([[1 - dt * r, -dt * w2], [dt * (1 - dt * r), 1 - dt * dt * w2]])
            assert (np.abs(np.linalg.eigvals(step)).max() <= 1 + 1e-9) == stable


@pytest.mark.parametrize("name", preset_names())
def test_presets_reach_the_engine(name):
    preset = load_preset(name)
    material = engine_material(preset)
    assert material.density == preset.density
    if preset.law == "rigid":
        assert isinstance(material, RigidMaterial)
        return
    assert material.law == preset.law
    assert math.isfinite(material.wave_speed)


def test_bad_matter_is_an_input_error():
    assert LAWS == ("fixed_corotated", "neo_hookean", "von_mises", "snow", "sand", "fluid", "rigid")
    assert Material().law == ElasticMaterial.law
    with pytest.raises(InputError, match="law"):
        Material(law="cheese")
    for field, value in (
        ("yield_stress", 0.0),
        ("friction_angle", 2.0),
        ("viscosity", -1.0),
        ("damping_time", math.nan),
    ):
        with pytest.raises(InputError, match=field):
            Material(**{field: value})
    with pytest.raises(InputError, match="bulk_modulus"):
        FluidMaterial(density=1000.0, bulk_modulus=0.0, viscosity=0.0)
