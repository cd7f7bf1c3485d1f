# SPDX-License-Identifier: MIT
"""Parts seated in each other: air in a contact is closed, what is beside it bulges, a base becomes flat."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.sim.gaussians.compose.composition_parts import CompositionPart, part_distances, seated_parts
from physgen.sim.gaussians.mesh_to_splats import splats_on_mesh
from physgen.sim.mpm.colliders import Surface
from physgen.sim.scene.model import Ground

RADIUS, AIR, HEIGHT, BAND = 0.01, 0.0002, 0.06, 0.006
"""Metres: of a pole, the air between it and a ring around it, the pole's and the ring's height."""
SHARE = 0.01
THICKNESS = SHARE * HEIGHT
UP = np.array([0.0, 0.0, HEIGHT / 2])


def turned(outline, middle):
    """The closed surface of an outline [(radius, height)] turned about the z axis."""
    mesh = trimesh.creation.revolve(np.array(outline), sections=64)
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    if mesh.volume < 0:
        mesh.invert()
    return Surface(vertices=np.asarray(mesh.vertices) + middle, faces=np.asarray(mesh.faces, dtype=np.int64))


def piece(name, own):
    splats = splats_on_mesh(own.vertices, own.faces, np.full(own.vertices.shape, 0.5), 600)
    return CompositionPart(name=name, splats=splats, surface=own)


@pytest.fixture(scope="module")
def parts():
    """A ring around the middle of a pole that stands on z = 0, its base raised by up to a quarter of a millimetre."""
    near, far, half = RADIUS + AIR, RADIUS + 0.005, BAND / 2
    ring = turned([(near, -half), (far, -half), (far, half), (near, half), (near, -half)], UP)
    rows = [(RADIUS, height) for height in np.linspace(0.0, HEIGHT, 61)]
    pole = turned([(0.0, 0.0), (0.005, 0.0), *rows, (0.005, HEIGHT), (0.0, HEIGHT)], 0.0 * UP)
    low = pole.vertices[:, 2] < 1e-6
    pole.vertices[low, 2] += 0.00025 * (0.5 + 0.5 * np.sin(400.0 * pole.vertices[low, 0]))
    return piece("ring", ring), piece("pole", pole)


@pytest.fixture(scope="module")
def seats(parts):
    return seated_parts(parts, SHARE, Ground())


def side(places, low, high):
    """Distances from the axis, metres, of what lies on the pole's side at these heights over the ring's middle."""
    away, radius = np.abs(places[:, 2] - HEIGHT / 2), np.linalg.norm(places[:, :2], axis=1)
    return radius[(away >= low) & (away <= high) & (radius > 0.9 * RADIUS)]


def test_air_is_closed_and_what_is_beside_makes_a_groove(parts, seats):
    assert np.array_equal(seats[0].surface.vertices, parts[0].surface.vertices)
    under = np.median(side(seats[1].surface.vertices, 0.0, 0.4 * BAND))
    assert RADIUS + 0.5 * AIR < under < RADIUS + AIR + 1e-5
    # The wall of the groove is as high over the closed contact as asked for, whatever the air was.
    beside = np.median(side(seats[1].surface.vertices, 0.5 * BAND + 0.0015, 0.5 * BAND + 0.0023))
    assert beside == pytest.approx(RADIUS + AIR + THICKNESS, abs=2e-5)
    # A tenth of the spacing of the lattice that says what is inside.
    lattice = part_distances(seats[0])
    assert lattice.at(seats[1].surface.vertices)[0].min() > -0.1 * lattice.spacing


def test_what_is_far_stays_and_splats_go_with_their_surface(parts, seats):
    before, after = parts[1].surface.vertices, seats[1].surface.vertices
    far = (np.abs(before[:, 2] - HEIGHT / 2) > 0.015) & (before[:, 2] > 2 * THICKNESS)
    assert far.sum() > 100 and np.array_equal(after[far], before[far])
    before, after = parts[1].splats.centres, seats[1].splats.centres
    beside = np.abs(np.abs(before[:, 2] - HEIGHT / 2) - 0.5 * BAND - 0.0025) < 0.001
    out = np.linalg.norm(after[beside, :2], axis=1) - np.linalg.norm(before[beside, :2], axis=1)
    assert beside.sum() > 10 and np.median(out) > 0.5 * THICKNESS
    assert np.array_equal(after[before[:, 2] > HEIGHT - 0.01], before[before[:, 2] > HEIGHT - 0.01])


def test_a_base_becomes_flat(parts, seats):
    base = parts[1].surface.vertices[:, 2] < 0.5 * THICKNESS
    assert np.ptp(parts[1].surface.vertices[base, 2]) > 2e-4
    assert seats[1].surface.vertices[base, 2] == pytest.approx(0.0, abs=1e-12)
    assert seats[1].surface.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("sunk", "flat"), [(0.015, True), (0.03, False)])
def test_a_base_that_sank_while_composed_is_lifted_and_one_through_the_ground_is_not(parts, sunk, flat):
    ring, pole = parts
    vertices = pole.surface.vertices.copy()
    low = vertices[:, 2] < 0.001
    vertices[low, 2] -= sunk * HEIGHT
    bent = piece("pole", Surface(vertices=vertices, faces=pole.surface.faces))
    # Thin seats: the ground's reach does not come from them.
    after = seated_parts((ring, bent), 0.002, Ground())[1].surface.vertices
    assert (after[:, 2].min() == pytest.approx(0.0, abs=1e-12)) == flat
    assert flat or np.array_equal(after[low], vertices[low])
