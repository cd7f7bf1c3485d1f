# SPDX-License-Identifier: MIT
"""Bodies, options and placement: what the engine is told before it computes."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.materials import ElasticMaterial
from physgen.sim.mpm.options import PADDING_CELLS, Ground, SolverOptions
from physgen.sim.mpm.placement import fit_similarity

MATERIAL = ElasticMaterial(density=1000.0, youngs_modulus=1e6, poisson_ratio=0.25)
CUBE = np.array([[x, y, z] for x in (0.0, 0.3) for y in (0.0, 0.2) for z in (0.5, 0.6)])


def test_preparing_a_simulation_does_not_import_taichi():
    modules = ("sampling", "bodies", "options", "placement", "diagnostics")
    code = ";".join(
        [f"import physgen.sim.mpm.{m}" for m in modules] + ["import sys; assert 'taichi' not in sys.modules"]
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


def test_fitted_box_holds_the_bodies_their_fall_and_the_margin():
    options = SolverOptions(grid=128)
    for margin in (None, 0.0, 0.4):
        similarity = fit_similarity([CUBE], Ground(), motion_margin=margin, options=options)
        points = np.vstack([CUBE, CUBE * [1, 1, 0]])
        wanted = 0.5 if margin is None else margin
        cells = similarity.points_to_engine(np.vstack([points - wanted, points + wanted])) * 64
        assert cells.min() >= PADDING_CELLS - 1e-6
        assert cells.max() <= 128 - PADDING_CELLS + 1e-6
        assert 0.3 / options.cell_size(similarity) <= 32 + 1e-6


def test_fit_refuses_what_it_cannot_resolve():
    with pytest.raises(InputError, match="motion_margin"):
        fit_similarity([CUBE], None, motion_margin=50.0)
    with pytest.raises(InputError, match="empty"):
        fit_similarity([], None)
    with pytest.raises(InputError, match="finite points"):
        fit_similarity([np.full((4, 3), np.inf)], None)
    with pytest.raises(InputError, match="no extent"):
        fit_similarity([np.zeros((4, 3))], None)


def test_particle_spacing_follows_from_the_grid():
    options = SolverOptions(grid=200, particles_per_cell=27)
    similarity = fit_similarity([CUBE], Ground(), options=options)
    assert options.particle_spacing(similarity) == pytest.approx(2.0 / (200 * similarity.scale) / 3)
