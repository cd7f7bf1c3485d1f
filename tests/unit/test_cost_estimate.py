# SPDX-License-Identifier: MIT
"""Estimated cost of a run: the theoretical time step, refusal by hours and by memory."""

import numpy as np
import pytest
from physgen.sim.constitutive import ElasticMaterial, RigidMaterial, SandMaterial
from physgen.sim.errors import InputError
from physgen.sim.mpm import cost_estimate as module
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.colliders import Surface, Track
from physgen.sim.mpm.cost_estimate import Estimate, estimate, longest_step, refuse_excess, stable_step
from physgen.sim.mpm.solver_options import SolverOptions

POINTS = np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)])
SOFT = ElasticMaterial(density=1000.0, youngs_modulus=1e6, poisson_ratio=0.25)


def a_body(**changes):
    return BodyParticles(**{"name": "a", "positions": POINTS, "volumes": np.ones(8), "material": SOFT, **changes})


def test_the_time_step_is_that_of_the_fastest_wave_or_particle():
    options = SolverOptions()
    wave = 0.4 * 0.01 / np.sqrt(1200.0)
    assert stable_step([a_body()], 0.01, options) == pytest.approx(wave)
    fibres = ElasticMaterial(density=1000.0, youngs_modulus=1e6, poisson_ratio=0.25, fibre_modulus=3.6e6)
    assert stable_step([a_body(material=fibres)], 0.01, options) == pytest.approx(wave / 2)
    assert stable_step([a_body(stiffness_scale=np.full(8, 4.0))], 0.01, options) == pytest.approx(wave / 2)
    assert stable_step([a_body(velocity=(0, 0, 100.0))], 0.01, options) == pytest.approx(0.2 * 0.01 / 100)
    thrown = Track(times=np.array([1.0]), values=np.array([[0.0, 0.0, 200.0]]))
    assert stable_step([a_body(velocity_keys=thrown)], 0.01, options) == pytest.approx(0.2 * 0.01 / 200)
    skin = Surface(vertices=POINTS, faces=np.array([[0, 1, 2]]))
    rigid = a_body(material=RigidMaterial(density=500.0), surface=skin)
    assert stable_step([rigid], 0.01, options) == options.max_step


def test_sand_alone_takes_longer_steps_and_never_shorter_than_asked_for():
    options = SolverOptions()
    sand = SandMaterial(density=1600.0, youngs_modulus=3.5e5, poisson_ratio=0.3, friction_angle=0.6)
    pile, cube = a_body(material=sand), a_body()
    later = a_body(materials=(sand,), material_track=((1.0, 1),))
    assert longest_step([pile, pile], options) == 1e-3
    for bodies in ([pile, cube], [cube], [later]):
        assert longest_step(bodies, options) == options.max_step == 5e-4
    assert longest_step([pile], SolverOptions(max_step=2e-3)) == 2e-3


def test_cost_grows_with_particles_duration_and_substeps(monkeypatch):
    monkeypatch.setattr(module, "_cores", lambda: 2)
    cost = estimate(1_000_000, 2, 1e-4, 2.0, "cpu")
    assert (cost.substeps, cost.particle_substeps) == (20_000, 2e10)
    assert cost.seconds == pytest.approx(2e10 / 5e6, rel=0.01)
    assert cost.bytes > 400e6 and estimate(0, 1, 1e-4, 2.0, "cuda").bytes < 300 * 2**20
    # Meshes are filled one after the other: of two with 102,016 particles each a bake took 459 MiB.
    one, two = (estimate(204_032, 2, 1e-4, 2.0, "cpu", largest=n).bytes / 2**20 for n in (204_032, 102_016))
    assert one > 700 and two == pytest.approx(459, rel=0.15)
    with pytest.raises(InputError, match=r"time step.*velocity"):
        estimate(10, 1, 0.0, 1.0, "cpu")


def test_too_long_or_too_large_is_refused_with_a_way_out():
    def cost(hours, gib):
        return Estimate(substeps=9, particle_substeps=9.0, seconds=hours * 3600, bytes=int(gib * 2**30))

    refuse_excess(cost(1, 1), 9, 2 * 2**30)
    refuse_excess(cost(1, 100), 9, None)
    with pytest.raises(InputError, match=r"72 hours.*more than 48.*coarser quality"):
        refuse_excess(cost(72, 1), 9, None)
    with pytest.raises(InputError, match=r"3 GiB.*2 GiB are available.*coarser quality"):
        refuse_excess(cost(1, 3), 9, 2 * 2**30)
