# SPDX-License-Identifier: MIT
"""Pairs that start in each other come apart on the right side; pairs that hold stay, and others fall."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.sim.gaussians.compose.composition_parts import BoundMesh
from physgen.sim.gaussians.compose.pair_stability import check_stability
from physgen.sim.gaussians.compose.penetration import penetration_of_meshes
from physgen.sim.gaussians.compose.physical_body import PhysicalBody, StepOptions
from physgen.sim.mpm.colliders import Collider, Surface


def surface_of(mesh: trimesh.Trimesh, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Surface:
    if mesh.volume < 0:
        mesh.invert()
    return Surface(vertices=np.asarray(mesh.vertices) + np.asarray(shift), faces=np.asarray(mesh.faces))


def revolved(*profile: tuple[float, float]) -> trimesh.Trimesh:
    """Radius and height of each point of the profile."""
    return trimesh.creation.revolve(np.array(profile), sections=48)


def bowl(radius: float, thickness: float, first: float, last: float) -> trimesh.Trimesh:
    """A spherical shell between two angles from the z axis."""
    angles = np.linspace(first, last, 24)
    outer = [((radius + thickness) * np.sin(a), (radius + thickness) * np.cos(a)) for a in angles]
    inner = [(radius * np.sin(a), radius * np.cos(a)) for a in angles[::-1]]
    return revolved(*outer, *inner, outer[0])


def finger(radius: float) -> trimesh.Trimesh:
    heights = np.linspace(-0.03, 0.03, 41)
    return revolved((0, -0.03), *((radius, z) for z in heights), (0, 0.03))


RING = trimesh.creation.torus(major_radius=0.01125, minor_radius=0.00125, major_sections=64, minor_sections=24)


def resolved(background: Surface, foreground: Surface, steps: int, **options: float) -> tuple[PhysicalBody, BoundMesh]:
    mesh = trimesh.Trimesh(background.vertices, background.faces)
    points = np.asarray(trimesh.sample.sample_surface(mesh, 4000, seed=5)[0])
    body = PhysicalBody(
        points=points,
        surface=background,
        obstacles=[Collider(name="foreground", surface=foreground)],
        options=StepOptions(cells_across=20, **options),
    )
    carried = BoundMesh(background, body)
    for _ in range(steps):
        body.step(np.zeros_like(points))
    return body, carried


@pytest.mark.long
@pytest.mark.parametrize("too_thick, keep", [(0.05, 0.0), (0.15, 1.0)])
def test_finger_is_squeezed_into_its_ring(too_thick, keep):
    """Nothing leaks to the ring's outside, though the finger's skin lies in the outer half of its wall (15 %)."""
    background, foreground = surface_of(finger(0.01 * (1 + too_thick))), surface_of(RING)
    start = penetration_of_meshes(background, foreground)
    body, carried = resolved(background, foreground, 30, keep_strain=keep)
    radius = np.linalg.norm(body.points[:, :2], axis=1)
    assert (radius[np.abs(body.points[:, 2]) < 0.0008] < 0.0105).all()
    assert -body.lattices[0].at(body.particles)[0].min() < 0.005 * 0.06
    assert penetration_of_meshes(carried.resolved(), foreground).volume < 0.01 * start.volume


@pytest.mark.slow
def test_ball_rises_in_a_bowl_that_is_too_small():
    """It starts with its skin beyond the wall all around, and ends in the bowl, above it, not wrapped around."""
    foreground = surface_of(bowl(0.05, 0.003, np.pi / 2, np.pi))
    background = surface_of(trimesh.creation.icosphere(subdivisions=4, radius=0.054))
    start = penetration_of_meshes(background, foreground)
    body, carried = resolved(background, foreground, 30)
    below = body.points[body.points[:, 2] < -0.01]
    assert (np.linalg.norm(below, axis=1) < 0.0505).all()
    assert body.points[:, 2].mean() > 0.001
    assert penetration_of_meshes(carried.resolved(), foreground).volume < 0.01 * start.volume


@pytest.mark.slow
def test_head_leaves_the_hat_that_was_pushed_into_it():
    foreground = surface_of(bowl(0.09, 0.003, 0.0, 0.45 * np.pi))
    background = surface_of(trimesh.creation.icosphere(subdivisions=4, radius=0.1), (0.0, 0.0, 0.004))
    start = penetration_of_meshes(background, foreground)
    body, carried = resolved(background, foreground, 40)
    above = body.points[body.points[:, 2] > 0.03]
    assert (np.linalg.norm(above, axis=1) < 0.0905).all()
    assert penetration_of_meshes(carried.resolved(), foreground).volume < 0.01 * start.volume


POST = revolved((0, 0), (0.02, 0), (0.02, 0.004), (0.004, 0.005), (0.004, 0.06), (0, 0.06))
TAPER = revolved((0, 0), (0.012, 0), (0.008, 0.06), (0, 0.06))
THIN_RING = trimesh.creation.torus(major_radius=0.0115, minor_radius=0.0015, major_sections=64, minor_sections=16)


@pytest.mark.long
@pytest.mark.parametrize(
    "background, foreground, stays",
    [
        (surface_of(TAPER), surface_of(THIN_RING, (0, 0, 0.0303)), True),
        (surface_of(POST), surface_of(THIN_RING, (0, 0, 0.05)), False),
        (surface_of(trimesh.creation.icosphere(radius=0.03), (0, 0, -0.0199)),
         surface_of(bowl(0.05, 0.004, np.pi / 2, np.pi)), True),
        (surface_of(trimesh.creation.icosphere(radius=0.04), (0, 0, 0.04)),
         surface_of(trimesh.creation.icosphere(radius=0.03), (0.004, 0, 0.1098)), False),
    ],
    ids=["ring on a tapered finger", "wide ring on a post", "ball in a bowl", "ball on a ball"],
)  # fmt: skip
def test_stable_pairs_stay_and_others_fall(background, foreground, stays):
    result = check_stability(background, foreground)
    assert result.stays == stays
    assert result.stays or result.notes
