# SPDX-License-Identifier: MIT
"""Colours of the unseen side change evenly where its counterparts in the photo lie apart, and nowhere else."""

import numpy as np
import pytest
from physgen.sim.reconstruct.shape.hidden_seams import WIDTH, blended
from physgen.sim.reconstruct.shape.inflated_mesh import BodyMesh

SIDE = 41


def sheet():
    """A square of 40 pixels, a vertex at each."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    corner = (rows[:-1, :-1] * SIDE + columns[:-1, :-1]).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + SIDE]),
            np.column_stack([corner + 1, corner + SIDE + 1, corner + SIDE]),
        ]
    )
    return BodyMesh(np.column_stack([pixels, np.zeros(len(pixels))]), faces, pixels)


def striped(x):
    """Two colours that meet at 20: paint."""
    return np.where(x[:, None] < 20.0, (200.0, 40.0, 40.0), (20.0, 60.0, 220.0))


def test_colours_change_evenly_between_counterparts_that_lie_apart():
    body = sheet()
    x = body.pixels[:, 0]
    # Right of the middle, the counterpart is 100 pixels farther.
    like = body.pixels + np.where(x[:, None] < 20.0, 0.0, (100.0, 0.0))
    size = 100.0
    colours, share = blended(body, np.zeros(len(x), bool), like, striped(x), size)
    middle = np.abs(x - 19.5) < 1.0
    assert share[middle].min() == pytest.approx(1.0)
    far = np.abs(x - 19.5) > WIDTH * size + 1.0
    assert far.any() and not share[far].any()
    np.testing.assert_array_equal(colours[far], striped(x)[far])
    row = colours[SIDE * 20 : SIDE * 21, 0]
    # A ramp of 2 × 8 pixels from 200 to 20, a tenth of the step each; the edge was one step of 180.
    assert (np.diff(row) < 1e-6).all() and np.abs(np.diff(row)).max() < 15.0


def test_paint_and_what_is_seen_keep_their_edges():
    body = sheet()
    x = body.pixels[:, 0]
    colours, share = blended(body, np.zeros(len(x), bool), body.pixels, striped(x), 100.0)
    np.testing.assert_array_equal(colours, striped(x))
    assert not share.any()
    like = body.pixels + np.where(x[:, None] < 20.0, 0.0, (100.0, 0.0))
    colours, share = blended(body, np.ones(len(x), bool), like, striped(x), 100.0)
    np.testing.assert_array_equal(colours, striped(x))
    assert not share.any()
