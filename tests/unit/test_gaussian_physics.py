# SPDX-License-Identifier: MIT
"""The physical step: what it is told, what is inside of an object, and to which side of a wall its matter leaves."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.gaussians.compose.body_distances import (
    fill_points,
    obstacle_lattice,
    particle_volumes,
    point_cloud_distances,
    surface_distances,
)
from physgen.sim.gaussians.compose.physical_body import PhysicalBody, StepOptions
from physgen.sim.gaussians.compose.seating import resolve_penetration
from physgen.sim.mpm.colliders import Collider, Surface, Track
from physgen.sim.mpm.geometry.signed_distance import signed_distance

COARSE = StepOptions(cells_across=12, substeps=10)


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))


@pytest.fixture(scope="module")
def ball() -> Surface:
    return surface_of(trimesh.creation.icosphere(subdivisions=4, radius=0.05))


@pytest.mark.parametrize(
    "field, value",
    [("substeps", 0), ("cells_across", 7), ("poisson_ratio", 0.5), ("keep_strain", 1.5), ("wave_cells", 0.0),
     ("recovery_cells", 2.0), ("friction", float("nan")), ("margin", -1.0), ("exit_side", "left")],
)  # fmt: skip
def test_options_out_of_range(field, value):
    with pytest.raises(InputError, match=field):
        StepOptions(**{field: value})


def test_inside_of_a_skin_of_points(ball):
    """From the vertices alone nearly the same inside is found as from the mesh: half a node's distance."""
    skin, mesh = point_cloud_distances(ball.vertices), surface_distances(ball)
    places = np.random.default_rng(3).uniform(-0.04, 0.04, (2000, 3))
    places = places[np.linalg.norm(places, axis=1) < 0.045]
    truth = np.linalg.norm(places, axis=1) - 0.05
    assert np.abs(mesh.at(places)[0] - truth).max() < mesh.spacing
    assert np.abs(skin.at(places)[0] - truth).max() < 1.5 * skin.spacing


def test_filling_leaves_the_skin_alone_and_shares_the_volume(ball):
    solid = surface_distances(ball)
    fill = fill_points(solid, 0.006, ball.vertices)
    assert 0.4 < len(fill) * 0.006**3 / (4 / 3 * np.pi * 0.05**3) < 0.95
    apart = np.linalg.norm(fill[:, None] - ball.vertices[None, ::4], axis=2)
    assert apart.min() > 0.6 * 0.006
    volumes = particle_volumes(solid, 0.003, np.concatenate([ball.vertices, fill]))
    assert volumes.sum() == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=0.05)


def test_ring_lets_a_finger_out_on_its_own_side_only():
    """In the outer half of a ring's wall, and behind it, all leads inward; the ring's own inner face stays exact."""
    ring = surface_of(trimesh.creation.torus(major_radius=0.011, minor_radius=0.001, major_sections=96))
    finger = surface_distances(surface_of(trimesh.creation.cylinder(radius=0.0115, height=0.06)))
    bulk = obstacle_lattice(ring, finger, exit_side="bulk")
    nearest = obstacle_lattice(ring, finger, exit_side="nearest")
    angle = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(50)], axis=1)
    assert (np.einsum("ni,ni->n", nearest.at(0.0115 * out)[1], out) > 0.5).all()
    for radius in (0.0105, 0.0115, 0.0119, 0.0123):
        distance, slope = bulk.at(radius * out)
        assert (distance < 0).all()
        assert (np.einsum("ni,ni->n", slope, out) < 0).mean() > 0.95
    assert bulk.at(0.0098 * out)[0] == pytest.approx(nearest.at(0.0098 * out)[0], abs=1e-6)
    assert np.abs(bulk.at(0.0100 * out)[0]).max() < 0.1 * bulk.spacing


def test_obstacle_that_reaches_the_middle_has_no_far_side(ball):
    """A rod through a ball's middle: no wall is behind it, so nothing but the rod is closed."""
    rod = surface_of(trimesh.creation.cylinder(radius=0.01, height=0.2))
    lattice = obstacle_lattice(rod, surface_distances(ball), exit_side="bulk")
    places = np.stack([np.linspace(0.012, 0.045, 20), np.zeros(20), np.full(20, 0.01)], axis=1)
    assert (lattice.at(places)[0] > 0).all()


def test_a_free_body_goes_where_all_its_points_want(ball):
    """Without obstacles, equal velocities move every point by γ v, whatever the filling; no strain comes of it."""
    body = PhysicalBody(points=ball.vertices, surface=ball, options=COARSE)
    assert len(body.particles) > len(ball.vertices)
    body.step(np.broadcast_to([0.01, -0.02, 0.0], ball.vertices.shape), duration=0.5)
    assert body.points == pytest.approx(ball.vertices + np.array([0.005, -0.01, 0.0]), abs=1e-6)
    assert body.gradients == pytest.approx(np.broadcast_to(np.eye(3), (len(ball.vertices), 3, 3)), abs=1e-4)
    body.step(np.zeros_like(ball.vertices))
    assert body.points == pytest.approx(ball.vertices + np.array([0.005, -0.01, 0.0]), abs=1e-6)


@pytest.mark.parametrize("keep", [0.0, 0.5, 1.0])
def test_steps_descend_and_elasticity_wants_back(ball, keep):
    """v⁰ = −P ∇L of L = ½ |x − a|² of a stretched shape: L falls, F tends to the stretch, less if strain stays."""
    aim = ball.vertices * [1.2, 1.0, 1.0]
    body = PhysicalBody(
        points=ball.vertices, surface=ball, options=StepOptions(cells_across=12, substeps=10, keep_strain=keep)
    )
    losses = []
    for _ in range(30):
        losses.append(0.5 * float(((body.points - aim) ** 2).sum()))
        body.step(-0.3 * (body.points - aim))
    assert losses[3] < 0.7 * losses[0] and losses[-1] < 0.6 * losses[0]
    stretch = float(np.median(body.gradients[:, 0, 0]))
    assert 1.05 < stretch < 1.25
    if keep == 0:
        # F at the surface is an average over a cell, so that the points themselves are judged.
        extent = np.ptp(body.points[:, 0]) / np.ptp(ball.vertices[:, 0])
        assert extent == pytest.approx(1.2, abs=0.005)


def test_obstacle_that_moves_pushes_the_body(ball):
    """A wall that comes by 0.02 m leaves no point within it."""
    wall = surface_of(trimesh.creation.box((0.02, 0.2, 0.2)))
    near = Surface(vertices=wall.vertices + np.array([-0.061, 0, 0]), faces=wall.faces)
    track = Track(times=np.array([0.0, 10.0]), values=np.array([[0.0, 0, 0], [0.02, 0, 0]]))
    body = PhysicalBody(
        points=ball.vertices,
        surface=ball,
        options=COARSE,
        obstacles=[Collider(name="w", surface=near, translations=track)],
    )
    for _ in range(14):
        body.step(np.zeros_like(ball.vertices))
    assert body.points[:, 0].min() > -0.0315


def test_points_put_elsewhere(ball):
    body = PhysicalBody(points=ball.vertices, surface=ball, options=COARSE)
    body.place(ball.vertices + np.array([0.0, 0.3, 0.0]))
    assert body.points == pytest.approx(ball.vertices + np.array([0.0, 0.3, 0.0]), abs=1e-6)
    assert body.particles.mean(axis=0) == pytest.approx([0.0, 0.3, 0.0], abs=1e-3)


def test_invalid_steps_are_refused(ball):
    body = PhysicalBody(points=ball.vertices, surface=ball, options=COARSE)
    with pytest.raises(InputError, match="velocities"):
        body.step(np.full_like(ball.vertices, np.nan))
    with pytest.raises(InputError, match="duration"):
        body.step(np.zeros_like(ball.vertices), duration=0.0)
    with pytest.raises(InputError, match="points"):
        PhysicalBody(points=np.zeros((20, 3)))
    open_ball = Surface(vertices=ball.vertices, faces=ball.faces[3:])
    with pytest.raises(InputError, match="not closed"):
        PhysicalBody(points=ball.vertices, obstacles=[Collider(name="o", surface=open_ball)], options=COARSE)


def test_cleared_mesh_leaves_the_obstacle_and_the_rest_alone(ball):
    """A plate that dips 0.3 mm into a ball is lifted out of it; what is far from the ball stays."""
    plate = trimesh.creation.box((0.2, 0.2, 0.02))
    plate = plate.subdivide().subdivide().subdivide().subdivide().subdivide()
    surface = Surface(vertices=np.asarray(plate.vertices) + np.array([0, 0, 0.0597]), faces=np.asarray(plate.faces))
    lattice = signed_distance(ball, 0.002, margin=0.006)
    result = resolve_penetration(surface, [lattice])
    middles = result.vertices[result.faces].mean(axis=1)
    assert lattice.at(middles)[0].min() > -1e-5
    moved = np.linalg.norm(result.vertices - surface.vertices, axis=1)
    assert 1e-4 < moved.max() < 1e-3
    assert moved[np.linalg.norm(surface.vertices[:, :2], axis=1) > 0.05].max() == 0
