# SPDX-License-Identifier: MIT
"""The finite elements of sim/diagnose/soft against theory: patch, vibration, energy, viscosity, yield."""

import dataclasses
import math

import numpy as np
import pytest
import taichi as ti
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.diagnose.soft.body_mesh import body_mesh, coarser, extrapolated
from physgen.sim.diagnose.soft.free_flight import State
from physgen.sim.diagnose.soft.model_errors import ModelError, misfit_left_open, modulus_between
from physgen.sim.diagnose.soft.soft_candidates import WorldParameters
from physgen.sim.diagnose.soft.soft_simulator import SimulationJob, SoftWorlds, concentrated_masses

LAWS = WorldParameters(modulus=1e5, poisson_ratio=0.3, friction=0.4, gravity=(0.0, 0.0, -9.81))
FREE = dataclasses.replace(LAWS, gravity=(0.0, 0.0, 0.0))


def box(extents=(0.06, 0.06, 0.06), lattice=(3, 3, 3)):
    mesh = trimesh.creation.box(extents)
    return body_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), lattice=lattice)


def worlds(mesh, points=None):
    return SoftWorlds(mesh, 400.0, mesh.nodes if points is None else points, threads=1)


def at(place=(0, 0, 1), velocity=(0, 0, 0), spin=(0, 0, 0), turn=None):
    place, velocity, spin = (np.asarray(a, dtype=float) for a in (place, velocity, spin))
    return State(time=0.0, place=place, velocity=velocity, turn=np.eye(3) if turn is None else turn, spin=spin)


@pytest.mark.long
@pytest.mark.parametrize("shape", [trimesh.creation.box((0.05, 0.07, 0.1)), trimesh.creation.icosphere(3, 0.04)])
def test_the_lattice_fills_the_surface(shape):
    mesh = body_mesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    assert mesh.volumes.min() > 0
    assert mesh.volumes.sum() == pytest.approx(shape.volume, rel=0.06)
    assert np.allclose(mesh.volumes @ mesh.centres / mesh.volumes.sum(), 0, atol=1e-3)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-0.029, 0.029), min_size=3, max_size=3))
def test_points_are_found_in_their_cells(place):
    mesh = box()
    nodes, weights = mesh.locate(np.array([place]))
    assert weights.min() > -1e-9
    assert np.allclose((weights[0][:, None] * mesh.nodes[nodes[0]]).sum(axis=0), place, atol=1e-12)


@pytest.mark.parametrize(
    ("lattice", "rough"), [((14, 5, 5), (11, 4, 4)), ((8, 8, 8), (5, 5, 5)), ((9, 3, 3), (6, 2, 2))]
)
def test_a_coarser_lattice_keeps_four_boxes_across(lattice, rough):
    shape = trimesh.creation.box(tuple(0.01 * n for n in lattice))
    surface = np.asarray(shape.vertices), np.asarray(shape.faces)
    mesh = body_mesh(*surface, lattice=lattice)
    coarse = coarser(mesh, *surface, factor=1.5)
    assert coarse.lattice == rough
    # Errors of second order: e_coarse = ratio² e_fine.
    ratio = (np.prod(lattice) / np.prod(rough)) ** (1 / 3)
    assert extrapolated(mesh, coarse) * (ratio**2 - 1) == pytest.approx(1.0)


def test_a_difference_of_lattices_as_a_change_of_modulus():
    rng = np.random.default_rng(0)
    fine, slope, other = rng.normal(size=(3, 6, 5, 3))
    other -= slope * (slope * other).sum() / (slope * slope).sum()
    coarse, stiffer = fine + 0.07 * slope + 0.1 * other, fine + 0.02 * slope
    coarse[0, 0], stiffer[1, 1] = np.nan, np.nan
    parts = [coarse - 0.1 * other], [stiffer]
    assert modulus_between([fine], *parts, 0.02) == pytest.approx(0.07)
    whole = np.isfinite(coarse) & np.isfinite(stiffer)
    expected = ((coarse - fine)[whole] * slope[whole]).sum() / (slope[whole] ** 2).sum()
    assert modulus_between([fine], [coarse], [stiffer], 0.02) == pytest.approx(expected)


def test_what_the_right_candidate_may_leave():
    assert misfit_left_open(ModelError(drift=0.0, ringing=1e-9), 1e-3) == pytest.approx(1.1)
    assert misfit_left_open(ModelError(drift=0.0, ringing=1.0), 1e-3) == pytest.approx(math.exp(0.6), rel=1e-3)


def test_a_homogeneous_stretch_leaves_no_force_inside():
    mesh = box()
    stretched = mesh.nodes @ np.diag([1.1, 0.97, 1.02])
    found = worlds(mesh).inner_accelerations(stretched[None], FREE)[0]
    inside = (np.abs(mesh.nodes) < 0.029).all(axis=1)
    assert inside.sum() == 8
    assert np.abs(found[inside]).max() < 1e-9 * np.abs(found[~inside]).max()


def test_flight_is_rigid_and_exact():
    mesh = box()
    start = at(velocity=(1.0, 0.5, 2.0))
    (points,), _ = worlds(mesh).run([SimulationJob(start=start, world=LAWS, times=np.array([0.05, 0.1]))])
    centre = points.mean(axis=1)
    assert np.allclose(centre[1] - [0, 0, 1], [0.1, 0.05, 0.2 - 0.5 * 9.81 * 0.01], atol=2e-4)
    assert np.allclose(points[1] - centre[1], mesh.nodes, atol=1e-9)


@pytest.mark.parametrize("stiffer", [1.0, 4.0])
def test_a_wave_runs_up_a_bar_at_the_bar_speed(stiffer):
    """Stopped at its foot, the top of a bar goes on falling until the wave has come up to turn it round."""
    long, fall = 0.2, 0.3
    mesh = box((long, 0.02, 0.02), (24, 2, 2))
    upright = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    times = np.arange(1, 250) * 1e-4
    start = at(place=(0, 0, long / 2), velocity=(0, 0, -fall), turn=upright)
    world = dataclasses.replace(FREE, factor=stiffer)
    (points,), _ = worlds(mesh, np.array([[-long / 2, 0, 0]])).run(
        [SimulationJob(start=start, world=world, times=times)]
    )
    speed = np.gradient(points[:, 0, 2], times)
    turned = times[np.argmax(speed > 0)]
    assert turned == pytest.approx(long / math.sqrt(stiffer * 1e5 / 400), rel=0.1)
    assert speed[times < 0.7 * turned] == pytest.approx(-fall, rel=0.1)


def bounce(world, velocity=-2.0):
    mesh = box((0.06, 0.06, 0.06), (4, 4, 4))
    times = np.arange(1, 60) * 1e-3
    start = at(place=(0, 0, 0.0301), velocity=(0, 0, velocity))
    (points,), (history,) = worlds(mesh).run([SimulationJob(start=start, world=world, times=times)], keep=True)
    return mesh, times, points, history


def test_an_elastic_bounce_keeps_its_energy():
    mesh, times, points, _ = bounce(FREE)
    masses = 400.0 * mesh.node_volumes()
    velocity = np.gradient(points, times, axis=0)
    kinetic = 0.5 * (masses[None, :, None] * velocity**2).sum(axis=(1, 2))
    whole = 0.5 * masses.sum() * 4.0
    # Ringing goes back and forth between motion and strain; what is moving never exceeds what came in, and the
    # translation alone is most of it.
    assert kinetic[30:].max() <= 1.03 * whole
    assert kinetic[30:].max() >= 0.7 * whole


def test_viscosity_takes_ringing_away_and_yield_keeps_a_shape():
    _, _, elastic, _ = bounce(FREE)
    _, _, damped, _ = bounce(dataclasses.replace(FREE, damping=1e-3))
    _, _, yielding, _ = bounce(dataclasses.replace(FREE, yield_stress=5e3))

    def height(points):
        return np.ptp(points[:, :, 2], axis=1)

    assert np.ptp(height(damped)[-15:]) < 0.3 * np.ptp(height(elastic)[-15:])
    assert height(damped)[-1] == pytest.approx(0.06, rel=0.04)
    assert height(yielding)[-15:].mean() < 0.97 * height(elastic)[-15:].mean()


def test_the_last_inner_accelerations_are_those_of_the_places():
    mesh, _, _, history = bounce(FREE)
    found = worlds(mesh).inner_accelerations(history.places[10:12], FREE)
    scale = np.abs(found).max()
    assert scale > 10
    assert np.abs(found - history.accelerations[10:12]).max() < 1e-6 * scale


@settings(max_examples=20, deadline=None)
@given(st.floats(0.05, 0.5), st.lists(st.floats(-0.012, 0.012), min_size=3, max_size=3))
def test_a_pellet_keeps_the_mass_and_moves_its_centre(fraction, offset):
    mesh = box()
    masses = 400.0 * mesh.node_volumes()
    centre = masses @ mesh.nodes / masses.sum()
    loaded = concentrated_masses(mesh.nodes, masses, fraction, centre + np.array(offset))
    assert loaded.sum() == pytest.approx(masses.sum())
    assert np.allclose(loaded @ mesh.nodes / masses.sum(), centre + fraction * np.array(offset), atol=1e-6)


def test_the_logarithm_is_that_of_the_library():
    from physgen.sim.diagnose.soft import element_kernels as kernels

    box_worlds = worlds(box())
    box_worlds.run([SimulationJob(start=at(), world=FREE, times=np.array([1e-3]))])  # starts Taichi

    @ti.kernel
    def logarithms(ratios: kernels.Reals, found: kernels.Reals):
        for i in range(ratios.shape[0]):
            found[i] = kernels.logarithm(ratios[i])

    ratios = np.concatenate([np.linspace(0.15, 8.0, 3001), 1.0 + np.geomspace(1e-14, 1e-2, 200), [1.0]])
    found = np.zeros_like(ratios)
    logarithms(ratios, found)
    assert np.allclose(found, np.log(ratios), rtol=4e-16 * 2, atol=0)


def test_fibres_along_a_bar_carry_a_wave_like_a_stiffer_bar():
    """Without lateral contraction a bar of modulus E with fibres of modulus k is a bar of modulus E + k."""
    long, fall = 0.2, 0.3
    mesh = box((long, 0.02, 0.02), (24, 2, 2))
    upright = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    times = np.arange(1, 250) * 1e-4
    start = at(place=(0, 0, long / 2), velocity=(0, 0, -fall), turn=upright)
    base = dataclasses.replace(FREE, poisson_ratio=0.0)
    models = [
        dataclasses.replace(base, fibre=1e5, axis=(1.0, 0.0, 0.0)),
        dataclasses.replace(base, factor=2.0, contact=0.5),
        base,
    ]
    jobs = [SimulationJob(start=start, world=world, times=times) for world in models]
    (fibred, stiffer, plain), _ = worlds(mesh, np.array([[-long / 2, 0, 0]])).run(jobs)
    apart = np.abs(fibred - stiffer).max()
    assert apart < 0.02 * np.abs(fibred - plain).max()
