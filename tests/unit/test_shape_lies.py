# SPDX-License-Identifier: MIT
"""Rings and sticks lie on the ground where a wall of their outline would stand on an edge, or topple."""

import math

import cv2
import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.reconstruct_options import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.shape.built_body import build_body
from physgen.sim.reconstruct.shape.inflate import inflate
from physgen.sim.reconstruct.shape.inflated_mesh import inflated_mesh

WIDTH, HEIGHT = 320, 240
VIEW = camera_above_ground(WIDTH, HEIGHT, 400.0, math.radians(24.0))
NEAR = 2.2
"""Distance of what lies along the ground, in heights of the camera."""
WIDE, THICK = 0.3, 0.03
"""Radii of a ring's middle line and of its tube."""


def outline(mesh):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    corners = VIEW.project(np.asarray(mesh.vertices))[:, :2]
    for face in mesh.faces:
        cv2.fillConvexPoly(mask, np.round((corners[face] - 0.5) * 16).astype(np.int32), 1, shift=4)
    return mask > 0


def ring(*, upright):
    mesh = trimesh.creation.torus(WIDE, THICK, major_sections=96, minor_sections=16)
    if upright:
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    mesh.apply_translation((0.0, NEAR, WIDE + THICK if upright else THICK))
    return mesh


def stick(*ends):
    return trimesh.creation.cylinder(0.02, segment=np.array(ends), sections=16)


def test_a_ring_on_its_side_is_a_ring_again():
    true = ring(upright=False)
    body = inflated_mesh(VIEW, inflate(outline(true)), 1500)[0]
    # The tube is 11 pixels thick: half a pixel on each side, and the strip on which it rests.
    assert np.ptp(body.vertices, axis=0) == pytest.approx(np.ptp(true.vertices, axis=0), rel=0.1)


def test_a_ring_on_its_edge_stands():
    true = ring(upright=True)
    body = inflated_mesh(VIEW, inflate(outline(true)), 1500)[0]
    assert np.ptp(body.vertices[:, 2]) == pytest.approx(np.ptp(true.vertices[:, 2]), rel=0.1)


def test_a_stick_lies_as_long_as_it_is():
    true = stick((-0.6, 2.0, 0.02), (0.5, 2.5, 0.02))
    body = inflated_mesh(VIEW, inflate(outline(true)), 800)
    extent = np.ptp(body[0].vertices, axis=0)
    assert extent[:2] == pytest.approx(np.ptp(true.vertices, axis=0)[:2], rel=0.1)
    assert extent[2] < 3 * 0.02
    assert body[1] > 0.5


@pytest.mark.parametrize("touching", [False, True])
def test_a_stick_that_may_lean_on_something_does_not_lie(touching):
    mask = outline(stick((-0.5, 2.2, 0.02), (0.3, 2.2, 0.25)))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    y, x = np.argwhere(mask)[0]
    other = (np.abs(columns - x - (18 if touching else 60)) < 15) & (rows > y - 5) & (rows < y + 90) & ~mask
    body = build_body(
        VIEW,
        mask,
        ObjectRequest(name="stick", box=(0, 0, 9, 9)),
        ReconstructOptions(mesh_vertices=500),
        print,
        others=other,
    )
    height = np.ptp(body.mesh.vertices[:, 2])
    # Between the stick's own height and its thickness.
    assert (height > 0.155) == touching
