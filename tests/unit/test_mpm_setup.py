# SPDX-License-Identifier: MIT
"""Bodies, options and placement: the engine's input."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from physgen.sim.constitutive import ElasticMaterial
from physgen.sim.errors import InputError
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.solver_options import SolverOptions, fit_similarity

MATERIAL = ElasticMaterial(density=1000.0, youngs_modulus=1e6, poisson_ratio=0.25)
CUBE = np.array([[x, y, z] for x in (0.0, 0.3) for y in (0.0, 0.2) for z in (0.5, 0.6)])


def test_preparing_a_simulation_does_not_import_taichi():
    modules = ("geometry.interior_sampling", "bodies", "solver_options", "world_setup", "cost_estimate", "diagnostics")
    names = [*(f"mpm.{m}" for m in modules), "constitutive"]
    code = ";".join(
        [f"import physgen.sim.{name}" for name in names] + ["import sys; assert 'taichi' not in sys.modules"]
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_material_constants():
    assert MATERIAL.shear_modulus == pytest.approx(4e5)
    assert MATERIAL.lame_lambda == pytest.approx(4e5)
    assert MATERIAL.wave_speed == pytest.approx(np.sqrt(1200.0))


@pytest.mark.parametrize(
    "field, value",
    [
        ("positions", np.zeros((0, 3))),
        ("positions", np.full((8, 3), np.nan)),
        ("volumes", np.zeros(8)),
        ("volumes", np.ones(7)),
        ("contact_radii", -np.ones(8)),
        ("velocity", (0.0, float("nan"), 0.0)),
        ("spin", (0.0, 0.0)),
        ("start_time", -1.0),
    ],
)
def test_bad_bodies_are_input_errors(field, value):
    good = {"name": "cup", "positions": CUBE, "volumes": np.ones(8), "material": MATERIAL}
    BodyParticles(**good)
    with pytest.raises(InputError, match=f"cup.*{field}"):
        BodyParticles(**{**good, field: value})


def test_spin_is_about_the_centre_of_mass():
    body = BodyParticles(
        name="cup",
        positions=CUBE,
        volumes=np.ones(8),
        material=MATERIAL,
        velocity=(1.0, 0.0, 0.0),
        spin=(0.0, 0.0, 2.0),
    )
    np.testing.assert_allclose(body.initial_velocities.mean(axis=0), (1.0, 0.0, 0.0), atol=1e-12)
    arm = CUBE[0] - CUBE.mean(axis=0)
    np.testing.assert_allclose(body.initial_velocities[0], (1.0 - 2 * arm[1], 2 * arm[0], 0.0), atol=1e-12)
    np.testing.assert_allclose(body.initial_velocity_gradient @ arm, np.cross((0, 0, 2.0), arm), atol=1e-12)


def test_largest_body_gets_the_cells_that_were_asked_for_amid_the_box():
    options = SolverOptions(grid=128)
    similarity = fit_similarity([CUBE, CUBE * 0.5], cells_across=24.0, options=options)
    assert 0.3 / options.cell_size(similarity) == pytest.approx(24.0)
    middle = 0.5 * (np.minimum(CUBE.min(axis=0), 0.5 * CUBE.min(axis=0)) + CUBE.max(axis=0))
    np.testing.assert_allclose(similarity.points_to_engine(middle), 1.0)


def test_fit_refuses_what_it_cannot_resolve():
    with pytest.raises(InputError, match="cells_across"):
        fit_similarity([CUBE, CUBE * 0.01])
    with pytest.raises(InputError, match="cells_across"):
        fit_similarity([CUBE], cells_across=float("nan"))
    with pytest.raises(InputError, match="empty"):
        fit_similarity([])
    with pytest.raises(InputError, match="finite points"):
        fit_similarity([np.full((4, 3), np.inf)])
    with pytest.raises(InputError, match="no extent"):
        fit_similarity([np.zeros((4, 3))])


def test_particle_spacing_follows_from_the_grid():
    options = SolverOptions(grid=200, particles_per_cell=27)
    similarity = fit_similarity([CUBE], options=options)
    assert options.particle_spacing(similarity) == pytest.approx(2.0 / (200 * similarity.scale) / 3)
