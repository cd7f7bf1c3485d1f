# SPDX-License-Identifier: MIT
"""Free flight against mechanics: fall, conserved momenta, the similarity map."""

from __future__ import annotations

import numpy as np
import pytest
from physgen.sim.mpm.options import Ground, SolverOptions
from physgen.sim.mpm.world import World
from physgen.sim.scene.units import Similarity


@pytest.mark.parametrize("youngs_modulus", [1e4, 1e7])
def test_free_fall_follows_half_g_t_squared(box, options, similarity, youngs_modulus):
    """Tolerance 0.5 % of the fall 1/2 g t² (Galilei)."""
    body = box(youngs_modulus=youngs_modulus, bottom=(0.01, 0.0, 0.2))
    world = World(bodies=[body], similarity=similarity, options=options)
    world.advance(0.3)
    fall = (body.positions - world.positions(0)).mean(axis=0)
    assert fall[2] == pytest.approx(0.5 * 9.81 * 0.3**2, rel=5e-3)
    assert abs(fall[:2]).max() < 5e-3 * fall[2]


@pytest.mark.parametrize("youngs_modulus", [3e4, 1e6])
def test_free_flight_conserves_momenta(box, options, similarity, youngs_modulus):
    """A soft spinning, vibrating body: both momenta within 1e-4 (Jiang et al. 2015: APIC conserves both exactly)."""
    body = box(
        cells=(4, 6, 8),
        bottom=(0.0, 0.0, -0.1),
        youngs_modulus=youngs_modulus,
        velocity=(0.4, -0.3, 0.2),
        spin=(5.0, 9.0, 3.0),
    )
    world = World(bodies=[body], gravity=(0.0, 0.0, 0.0), similarity=similarity, options=options)
    linear, angular = world.linear_momentum(), world.angular_momentum()
    for _ in range(5):
        world.advance(0.1)
        assert np.linalg.norm(world.linear_momentum() - linear) < 1e-4 * np.linalg.norm(linear)
        assert np.linalg.norm(world.angular_momentum() - angular) < 1e-4 * np.linalg.norm(angular)
    stretch = np.linalg.svd(world.deformation_gradients(0), compute_uv=False)
    assert stretch.max() > 1 + 500 / youngs_modulus, "the spin should strain the body, or the test is too easy"


def test_motion_in_metres_does_not_depend_on_the_similarity_scale(box):
    """PhysGen3D supplement A.4: k = 0.5, 1, 3 with as many cells across the body. Tolerance 1 % of the motion."""
    cell = 1.0 / 48
    results = []
    for scale, grid in ((0.5, 192), (1.0, 96), (3.0, 32)):
        half = 1.0 / scale
        similarity = Similarity(scale=scale, origin=(-half, -half, -half))
        options = SolverOptions(grid=grid)
        assert options.cell_size(similarity) == pytest.approx(cell)
        body = box(cells=(4, 4, 4), cell=cell, bottom=(0.0, 0.0, 0.0), youngs_modulus=2e5, velocity=(0.3, 0.0, 0.0))
        ground = Ground(point=(0.0, 0.0, -0.08), friction=0.3)
        world = World(bodies=[body], ground=ground, similarity=similarity, options=options)
        track = []
        for _ in range(8):
            world.advance(0.03)
            track.append(world.positions(0))
        results.append(np.array(track))
    motion = np.linalg.norm(results[1] - results[1][0], axis=-1).max()
    for other in (results[0], results[2]):
        assert np.abs(other - results[1]).max() < 0.01 * motion
