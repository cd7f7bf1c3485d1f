# SPDX-License-Identifier: MIT
"""Dropping compositions in MuJoCo: bodies whose fate is known stand, slide and fall as they must."""

import json
import math

import numpy as np
import pytest
import trimesh
from physgen.benchmarks.compose_assets.standing import FRICTION, drop, seats_text, standing_json, standing_text
from physgen.sim.mpm.colliders import Surface

pytest.importorskip("mujoco")


def surface(mesh):
    return Surface(vertices=np.asarray(mesh.vertices, dtype=np.float64), faces=np.asarray(mesh.faces, dtype=np.int64))


def block(size, place=(0, 0, 0), tilt=0.0):
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(place)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(tilt, (0, 1, 0)))
    # Triangles as small as the assets' are.
    return surface(mesh.subdivide().subdivide().subdivide())


def test_a_block_on_a_table_stands_and_one_in_the_air_falls():
    table = block((0.2, 0.2, 0.02))
    on = drop(table, [block((0.04, 0.04, 0.04), (0, 0, 0.03))], held=True, seconds=0.5)
    assert on.stands and on.drift < 0.005
    above = drop(table, [block((0.04, 0.04, 0.04), (0.2, 0, 0.03))], held=True, seconds=0.5)
    assert not above.stands and above.drift > 1
    free = drop(table, [block((0.04, 0.04, 0.04), (0, 0, 0.03))], held=False, seconds=0.5)
    assert free.stands
    rows = [("block", "free", free), ("gone", "held", above)]
    assert "yes  free: 1 of 1 stand" in standing_text(rows) and "NO   held: 0 of 1" in standing_text(rows)
    found = json.loads(json.dumps(standing_json(rows, [("ring", (40.0, 31.0), (39.5, 30.5))])))
    assert [row["stands"] for row in found["rows"]] == [True, False]
    assert found["pictures"][0]["seated_held_out_db"] == 30.5
    words = seats_text([("ring", (40.0, 31.0), (39.5, 30.5))])
    assert words == "ring     input view 40.00 dB, seated 39.50; held out 31.00, seated 30.50"


@pytest.mark.parametrize("degrees", [15, 40])
def test_a_block_on_a_slope_slides_where_friction_says_so(degrees):
    tilt = math.radians(degrees)
    slope = block((0.6, 0.2, 0.02), tilt=tilt)
    found = drop(slope, [block((0.05, 0.05, 0.02), (0, 0, 0.02), tilt)], held=True, seconds=0.25)
    # s = g (sin a - mu cos a) t² / 2, over how far the tilted plank reaches along x.
    slid = max(0.0, 9.81 * (math.sin(tilt) - FRICTION * math.cos(tilt)) * 0.25**2 / 2)
    assert found.drift == pytest.approx(slid / (0.6 * math.cos(tilt) + 0.02 * math.sin(tilt)), rel=0.05, abs=0.002)
    assert found.stands == (degrees == 15)


def test_what_is_held_has_a_ground_where_the_other_stands_on_it():
    ball, stand = block((0.04, 0.04, 0.04), (0, 0, 0.05)), block((0.06, 0.06, 0.03), (0, 0, 0.014))
    assert drop(ball, [stand], held=True, seconds=0.3).stands


def test_a_ring_on_a_ledge_is_found_to_lie_on_it():
    """A ring on the shoulder of a bar has no way to go; contacts found in a few places only let it creep."""
    bar = trimesh.creation.revolve(
        [(0, 0), (0.012, 0), (0.012, 0.03), (0.01, 0.0302), (0.01, 0.06), (0, 0.06)], sections=64
    )
    ring = trimesh.creation.annulus(0.0102, 0.014, 0.006, sections=64)
    ring.apply_translation((0, 0, 0.0332))
    found = drop(surface(bar), [surface(ring)], held=True, seconds=0.3)
    assert found.stands and found.drift < 0.001


def test_a_ring_is_not_filled():
    pole = surface(trimesh.creation.cylinder(0.01, 0.2, sections=64))
    loose = surface(trimesh.creation.annulus(0.014, 0.02, 0.01, sections=64))
    found = drop(pole, [loose], held=True, seconds=0.15)
    # A hull would be pushed off the pole; a ring with room around it falls freely.
    assert found.drift == pytest.approx(9.81 * 0.15**2 / 2 / 0.2, rel=0.1)
    assert found.depth < 0.005
