# SPDX-License-Identifier: MIT
"""Bodies that share space are taken apart on the sides that the photo does not show."""

import numpy as np
import pytest
import trimesh
from physgen.sim.mpm.colliders import Surface
from physgen.sim.mpm.geometry.interior_sampling import sample_interior
from physgen.sim.mpm.geometry.signed_distance import overlap, signed_distance
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.shape.object_placement import PlacedBody, separate

VIEW = camera_above_ground(400, 300, 350.0, np.radians(25.0))
SPACING = 0.03


def ball(centre, guessed=True):
    mesh = trimesh.creation.icosphere(3, 0.2)
    return PlacedBody(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces), guessed)


def box(centre, guessed=True):
    mesh = trimesh.creation.box((0.8, 0.6, 0.4)).subdivide_to_size(0.05)
    return PlacedBody(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces), guessed)


def depth(first, second, faces):
    """The deepest particle of each of two bodies in the other."""
    found = 0.0
    for (a, b), (own, other) in zip(((first, second), (second, first)), (faces, faces[::-1]), strict=True):
        inside = sample_interior(a, own, SPACING).positions
        found = max(found, overlap(inside, signed_distance(Surface(vertices=b, faces=other), SPACING, margin=0.0)))
    return found


@pytest.mark.parametrize("known", [False, True])
def test_a_ball_deep_in_a_box_gets_room_and_nothing_moves_in_the_photo(known):
    bodies = [ball((0, 2.2, 0.45)), box((0, 2.35, 0.2), guessed=not known)]
    faces = [body.faces for body in bodies]
    assert depth(*(body.vertices for body in bodies), faces) > 0.1
    apart, found = separate(VIEW, bodies, (0, 1))
    assert depth(*apart, faces) < SPACING
    for before, after in zip(bodies, apart, strict=True):
        np.testing.assert_allclose(VIEW.project(after)[:, :2], VIEW.project(before.vertices)[:, :2], atol=1e-9)
        assert after[:, 2].min() >= 0.0
    # What was inflated yields half of its depth to what is known; else the one behind yields.
    assert [(item.yielding, item.other) for item in found] == ([(0, 1), (1, 0)] if known else [(1, 0)])
    assert np.array_equal(apart[0], bodies[0].vertices) == (not known)
    # The front of the box that is not behind the ball stays as it was.
    far = np.linalg.norm(VIEW.project(bodies[1].vertices)[:, :2] - VIEW.project(np.array([0, 2.2, 0.45]))[:2], axis=1)
    assert np.array_equal(apart[1][far > 60], bodies[1].vertices[far > 60])


def test_bodies_that_touch_or_stand_apart_stay_as_they_are():
    standing = [ball((0, 2.3, 0.6)), box((0, 2.35, 0.2)), box((0, 4.0, 0.2)), ball((1.5, 2.4, 0.2))]
    apart, found = separate(VIEW, standing, (0, 1, 2, 3))
    assert not found
    for before, after in zip(standing, apart, strict=True):
        assert np.array_equal(before.vertices, after)


def test_overlapping_bodies_follow_the_photos_depth_order():
    # The photo shows the ball in front, though its body was placed behind the box.
    bodies = [ball((0, 3.2, 0.3)), box((0, 2.35, 0.2))]
    apart, found = separate(VIEW, bodies, (0, 1))
    assert [(item.yielding, item.other) for item in found] == [(1, 0)]
    middle = np.abs(VIEW.project(apart[1])[:, :2] - VIEW.project(np.array([0, 3.2, 0.3]))[:2]).max(axis=1) < 10
    assert (VIEW.project(apart[1])[middle, 2] > VIEW.project(np.array([0, 3.2, 0.3]))[2]).all()
