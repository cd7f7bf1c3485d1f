# SPDX-License-Identifier: MIT
"""How much of one object is inside another, against balls whose common lens is known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.gaussians.compose.penetration import penetration_of_meshes
from physgen.sim.mpm.colliders import Surface


def ball(radius: float, x: float = 0.0, subdivisions: int = 4) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Surface(vertices=np.asarray(mesh.vertices) + np.array([x, 0.0, 0.0]), faces=np.asarray(mesh.faces))


def lens(a: float, b: float, apart: float) -> float:
    """Volume that two balls share."""
    return np.pi * (a + b - apart) ** 2 * (apart**2 + 2 * apart * (a + b) - 3 * (a - b) ** 2) / (12 * apart)


@pytest.mark.parametrize("apart", [0.06, 0.1, 0.13])
def test_two_balls_share_a_lens(apart):
    """Volume within 2 % (the meshes are 0.4 % smaller than balls), depth within 1 %."""
    found = penetration_of_meshes(ball(0.05, apart), ball(0.1))
    assert found.volume == pytest.approx(lens(0.05, 0.1, apart), rel=0.02, abs=1e-8)
    assert found.share == pytest.approx(found.volume / (4 / 3 * np.pi * 0.05**3), rel=0.01)
    assert found.deepest == pytest.approx(0.15 - apart, rel=0.01, abs=2e-4)
    assert not found.contained and found.apart == 0


def test_contained_object_is_reported():
    inner = penetration_of_meshes(ball(0.03, 0.02), ball(0.1, subdivisions=3))
    assert inner.contained == "background"
    assert inner.volume == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=0.02)
    assert inner.share == pytest.approx(1.0, abs=0.01)
    assert inner.deepest == pytest.approx(0.1, rel=0.02)
    outer = penetration_of_meshes(ball(0.1, subdivisions=3), ball(0.03, 0.02, subdivisions=3))
    assert outer.contained == "foreground"
    assert "foreground lies completely inside the background" in outer.describe()


@pytest.mark.parametrize("apart", [0.16, 0.5])
def test_apart(apart):
    """Also where the bounding boxes overlap (moved along the diagonal by as much)."""
    for direction in (np.array([1.0, 0, 0]), np.ones(3) / np.sqrt(3)):
        other = ball(0.05)
        moved = Surface(vertices=other.vertices + apart * direction, faces=other.faces)
        found = penetration_of_meshes(moved, ball(0.1))
        assert found.volume == 0 and found.share == 0 and found.deepest == 0
        assert found.apart == pytest.approx(apart - 0.15, abs=1e-3)


def test_unmeasurable_pairs_are_refused():
    good = ball(0.1)
    holed = Surface(vertices=good.vertices, faces=good.faces[1:])
    with pytest.raises(InputError, match="background: mesh is not closed"):
        penetration_of_meshes(holed, good)
    with pytest.raises(InputError, match="foreground: mesh is not closed"):
        penetration_of_meshes(good, holed)
    with pytest.raises(InputError, match="spacing"):
        penetration_of_meshes(good, good, spacing=1e-6)
