# SPDX-License-Identifier: MIT
"""The finite elements of the blind check against closed forms."""

import dataclasses

import numpy as np
import pytest
from physgen.blind_check.finite_elements import (
    SoftWorld,
    simulate_soft,
    stable_step,
    surface_mesh,
    tetrahedral_box,
    tetrahedral_sphere,
)
from physgen.blind_check.soft_causes import KNOWN_CAUSES

WORLD = SoftWorld(density=500.0, youngs_modulus=8e4, poisson_ratio=0.3, friction=0.4)


def _moved(solid, world, times, height=0.1, velocity=(0, 0, 0), stretch=(1, 1, 1)):
    nodes = (solid.nodes * stretch + (0, 0, height))[None]
    return simulate_soft(solid, world, nodes, np.broadcast_to(np.array(velocity, float), nodes.shape).copy(), times)


def _centre(solid, motion):
    return (motion.nodes[0] * solid.share[:, None]).sum(axis=1) / solid.share.sum()


def test_solids_fill_their_volume_and_close_their_surface():
    for solid, volume in (
        (tetrahedral_box((0.1, 0.05, 0.05), (6, 3, 3)), 2.5e-4),
        (tetrahedral_sphere(0.04, 8), 4 / 3 * np.pi * 0.04**3),
    ):
        assert solid.volume.min() > 0
        assert solid.volume.sum() == pytest.approx(volume, rel=0.03)
        vertices, faces = surface_mesh(solid)
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        assert (np.cross(b, c) * a).sum() / 6 == pytest.approx(solid.volume.sum(), rel=1e-9)


def test_a_linear_field_has_an_exact_gradient():
    solid = tetrahedral_sphere(0.04, 4)
    matrix = np.array([[1.0, 0.2, 0], [0, 0.9, 0.1], [0.3, 0, 1.1]])
    found = (solid.gradient @ (solid.nodes @ matrix.T)).reshape(3, -1, 3)
    assert np.abs(found.transpose(1, 2, 0) - matrix).max() < 1e-9


def test_free_flight_is_a_parabola_and_stays_undeformed():
    solid, times = tetrahedral_box((0.06,) * 3, (3, 3, 3)), np.arange(20) / 200
    motion = _moved(solid, WORLD, times, height=0.5, velocity=(1, 0, 1))
    exact = np.column_stack([times, 0 * times, 0.5 + times - 4.905 * times**2])
    assert np.abs(_centre(solid, motion) - exact).max() < 1e-5
    assert motion.energy.max() < 1e-6


def test_a_stretched_bar_rings_at_the_bar_wave_and_keeps_its_energy():
    length = 0.2
    solid = tetrahedral_box((length, 0.02, 0.02), (20, 2, 2))
    world = dataclasses.replace(WORLD, poisson_ratio=0.0)
    period = 2 * length / np.sqrt(world.youngs_modulus / world.density)
    times = np.linspace(0, 2.5 * period, 200)
    motion = _moved(solid, world, times, height=5.0, stretch=(1.002, 1, 1))
    # cos, so that the mode, and not its higher harmonics, is measured.
    shape = np.sin(np.pi * solid.nodes[:, 0] / length) * solid.share
    mode = (motion.nodes[0, :, :, 0] - solid.nodes[:, 0]) @ shape
    crossings = times[1:][np.diff(np.sign(mode)) != 0]
    assert 2 * np.diff(crossings).mean() == pytest.approx(period, rel=0.02)
    assert np.abs(mode[-60:]).max() == pytest.approx(np.abs(mode[:60]).max(), rel=0.03)


def test_a_dropped_block_returns_and_slides_by_coulomb():
    solid, times = tetrahedral_box((0.06,) * 3, (3, 3, 3)), np.arange(40) / 200
    bounced = _moved(solid, WORLD, times, height=0.04, velocity=(0, 0, -1))
    speed = np.gradient(_centre(solid, bounced)[:, 2], times)
    assert 0.5 < speed[:30].max() < 1.0
    stiff = dataclasses.replace(WORLD, youngs_modulus=2e5, viscosity_s=5e-4)
    slid = _centre(solid, _moved(solid, stiff, times, height=0.03, velocity=(1, 0, 0)))
    assert 1 - np.gradient(slid[:, 0], times)[-1] == pytest.approx(0.4 * 9.81 * times[-1], rel=0.15)


def test_viscosity_costs_energy_and_needs_shorter_steps():
    solid, times = tetrahedral_box((0.06,) * 3, (3, 3, 3)), np.arange(30) / 200
    damped = dataclasses.replace(WORLD, viscosity_s=3e-4)
    assert stable_step(solid, damped) < stable_step(solid, WORLD)
    heights = [_centre(solid, _moved(solid, w, times, 0.04, (0, 0, -1)))[-1, 2] for w in (WORLD, damped)]
    assert heights[1] < heights[0] - 1e-3


def test_plastic_flow_stays_and_elastic_strain_does_not():
    solid, times = tetrahedral_box((0.06,) * 3, (3, 3, 3)), np.arange(30) / 200
    soft = dataclasses.replace(WORLD, yield_stress=4e3)
    elastic, plastic = (_moved(solid, w, times, 0.04, (0, 0, -2)) for w in (WORLD, soft))
    assert elastic.flow.max() == 0 and plastic.flow.max() > 0.05
    assert _centre(solid, plastic)[-1, 2] < _centre(solid, elastic)[-1, 2]
    strong = dataclasses.replace(WORLD, yield_stress=1e9)
    # Its steps are others, so that later the paths part.
    gap = np.abs(_moved(solid, strong, times, 0.04, (0, 0, -2)).nodes - elastic.nodes)
    assert gap[:, :8].max() < 1e-3 < np.abs(plastic.nodes - elastic.nodes)[:, :12].max()


@pytest.mark.parametrize("name", sorted(KNOWN_CAUSES))
def test_every_cause_changes_the_motion(name):
    solid, times = tetrahedral_box((0.06,) * 3, (3, 3, 3)), np.arange(30) / 200
    cause = KNOWN_CAUSES[name](solid, WORLD, np.random.default_rng(2))
    plain = _moved(solid, WORLD, times, 0.04, (0.2, 0, -1.5)).nodes
    sizes = [
        np.abs(_moved(solid, cause.change(s, WORLD), times, 0.04, (0.2, 0, -1.5)).nodes - plain).max()
        for s in (cause.low, np.sqrt(cause.low * cause.high))
    ]
    assert min(sizes) > 1e-5
    assert (sizes[0] > sizes[1]) == cause.weaker
