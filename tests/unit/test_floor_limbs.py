# SPDX-License-Identifier: MIT
"""Limbs of inflated bodies that lie on the ground towards the camera are as thick as they are wide."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.shape import inflated_mesh as meshes
from physgen.sim.reconstruct.shape.built_body import silhouette_overlap
from physgen.sim.reconstruct.shape.floor_limbs import with_limbs
from physgen.sim.reconstruct.shape.inflate import inflate
from physgen.sim.reconstruct.shape.reference_surfaces import reference_surfaces

WIDTH, HEIGHT = 320, 240
VIEW = camera_above_ground(WIDTH, HEIGHT, 400.0, math.radians(22.0))
BODY, LEG = 0.22, 0.07
"""Radii of a ball on the ground, and of the two legs that lie before it."""
FAR, REACH = 2.4, 0.5
"""Distances along the ground of the ball's middle, and from there to a leg's end."""


def outline(*parts):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for part in parts:
        corners = VIEW.project(np.asarray(part.vertices))[:, :2]
        hull = cv2.convexHull(np.round((corners - 0.5) * 16).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 1, shift=4)
    return mask > 0


def ball():
    return trimesh.creation.icosphere(4, radius=BODY).apply_translation((0.0, FAR, BODY))


def leg(x):
    capsule = trimesh.creation.capsule(height=REACH, radius=LEG)
    capsule.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (1, 0, 0)))
    # The capsule lies around the origin.
    return capsule.apply_translation((x, FAR - REACH / 2.0, LEG))


def test_legs_that_lie_before_a_body_are_as_high_as_they_are_wide():
    """Their upper sides are where the photo shows them, and their undersides near the ground. Inflated along the line
    of sight, the upper side of a leg would be at less than half of its height."""
    silhouette = inflate(outline(ball(), leg(-0.2), leg(0.2)))
    wall = replace(next(reference_surfaces(VIEW, silhouette)), origin=np.array([0.0, FAR, 0.0]))
    limbs = with_limbs(wall, silhouette)
    assert limbs.middle is not None and limbs.middle.behind is not None
    # From the end's own radius on, and before what the body covers.
    top = np.array([(x, y, 2.0 * LEG) for x in (-0.2, 0.2) for y in FAR - np.linspace(0.3, REACH, 5)])
    pixels = VIEW.project(top)[:, :2]
    middle, _, rays = limbs.depths(pixels)
    unit = limbs.unit_per_pixel / np.linalg.norm(rays, axis=1)
    half = limbs.middle.sample(np.sqrt(np.maximum(silhouette.square_height, 0.0)), pixels)
    front = middle - limbs.middle.sample(limbs.middle.rise, pixels) * unit
    heights = (VIEW.position + front[:, None] * rays)[:, 2]
    assert heights == pytest.approx(2.0 * LEG, rel=0.2)
    back = middle + limbs.middle.sample(limbs.middle.behind, pixels) * half * unit
    assert (VIEW.position + back[:, None] * rays)[:, 2] == pytest.approx(0.0, abs=0.2 * LEG)
    tongue = wall.depths(pixels)[0] - half * unit
    assert (VIEW.position + tongue[:, None] * rays)[:, 2].max() < LEG


def test_a_body_whose_wall_is_behind_its_legs_has_them(monkeypatch):
    mask = outline(ball(), leg(-0.2), leg(0.2))
    silhouette = inflate(mask)
    wall = replace(next(reference_surfaces(VIEW, silhouette)), origin=np.array([0.0, FAR, 0.0]))
    monkeypatch.setattr(meshes, "reference_surfaces", lambda camera, silhouette: iter([wall]))
    body = meshes.inflated_mesh(VIEW, silhouette, 1500)[0]
    assert silhouette_overlap(VIEW, body, mask) > 0.97
    near = FAR - REACH
    ends = body.vertices[(body.vertices[:, 1] < near + 0.1) & (body.vertices[:, 1] > near)]
    assert ends[:, 2].max() == pytest.approx(2.0 * LEG, rel=0.2)
    assert body.vertices[:, 1].min() == pytest.approx(near - LEG, abs=0.5 * LEG)


def test_a_body_without_legs_stays_as_it_is():
    """What is seen of a ball in front of its middle is wide, and no limb."""
    silhouette = inflate(outline(ball()))
    for surface in reference_surfaces(VIEW, silhouette):
        assert with_limbs(surface, silhouette) is surface
