# SPDX-License-Identifier: MIT
"""Stopping a world in the middle of a step: at once, and without a trace in what comes after."""

import numpy as np
import pytest
import trimesh
from physgen.sim.constitutive import ElasticMaterial, RigidMaterial
from physgen.sim.errors import Cancelled, SimulationError
from physgen.sim.mpm.bodies import BodyParticles
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry.interior_sampling import sample_interior
from physgen.sim.mpm.solver_options import Ground, SolverOptions, fit_similarity
from physgen.sim.mpm.world import World

SOFT = ElasticMaterial(density=1000.0, youngs_modulus=1e5, poisson_ratio=0.3)


def a_world(material):
    mesh = trimesh.creation.box((0.06, 0.06, 0.06))
    mesh.apply_translation((0.0, 0.0, 0.032))
    options = SolverOptions()
    similarity = fit_similarity([mesh.vertices], cells_across=8, options=options)
    sample = sample_interior(mesh.vertices, mesh.faces, options.particle_spacing(similarity))
    body = BodyParticles(
        name="cube",
        positions=sample.positions,
        volumes=sample.volumes,
        contact_radii=sample.contact_radii,
        material=material,
        surface=Surface(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces)),
        velocity=(0.0, 0.0, -1.0),
    )
    return World(bodies=[body], ground=Ground(), similarity=similarity, options=options)


@pytest.mark.parametrize("material", [SOFT, RigidMaterial(density=500.0)], ids=["soft", "rigid"])
def test_a_stopped_world_goes_on_from_its_checkpoint_as_if_nothing_had_been(material):
    whole, stopped = a_world(material), a_world(material)
    whole.advance(0.01)
    whole.advance(0.02)
    stopped.advance(0.01, lambda: False)
    checkpoint = stopped.checkpoint()
    asked = iter([False] * (2 if material is SOFT else 0))
    with pytest.raises(Cancelled):
        stopped.advance(0.02, lambda: next(asked, True))
    for look in (lambda: stopped.positions(0), lambda: stopped.pose("cube"), lambda: stopped.advance(0.01)):
        with pytest.raises(SimulationError, match="restore a checkpoint"):
            look()
    stopped.restore(checkpoint)
    stopped.advance(0.02)
    assert np.array_equal(stopped.positions(0), whole.positions(0))
    assert stopped.time == whole.time
