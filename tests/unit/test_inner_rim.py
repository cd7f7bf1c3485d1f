# SPDX-License-Identifier: MIT
"""The outermost pixels of a mask, which a mesh covers only in part, show the photo until the outline moves."""

import numpy as np
import pytest
from physgen.sim.composite.compositing import ObjectLayer, compose, ground_layer
from physgen.sim.composite.disocclusion import INNER_RIM_PX, Rim, inner_rim

SIZE = 48
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] + 0.5
APART = np.hypot(ROWS - 24.0, COLUMNS - 24.0)
MASK = APART < 18.0
TURN = np.linspace(0.0, 2.0 * np.pi, 200)
OUTLINE = 24.0 + 18.0 * np.stack([np.cos(TURN), np.sin(TURN)], axis=1)


def frame(shift):
    """Frame of a bright disc on dark ground whose mesh covers its outermost pixels by half, moved by ``shift`` px."""
    bright, dark = (np.full((SIZE, SIZE, 3), value, np.float32) for value in (0.6, 0.05))
    photo = np.where(MASK[..., None], bright, dark)
    edge = inner_rim(MASK)
    at_rest = np.ones((SIZE, SIZE), np.float32)
    Rim(edge.astype(np.float32), OUTLINE).apply(at_rest, OUTLINE + np.array([shift, 0.0]))
    still = np.ones((SIZE, SIZE, 3), np.float32)
    ground = ground_layer(
        photo=photo, background=dark, shadow=still, rest_shadow=still, at_rest=at_rest, masks=MASK & ~edge
    )
    alpha = np.where(APART < 17.0, 1.0, np.where(MASK, 0.5, 0.0)).astype(np.float32)
    layer = ObjectLayer(texture=bright * alpha[..., None], alpha=alpha, light=still)
    return compose(layer, ground), photo, edge


def test_at_rest_the_outline_is_the_photo():
    made, photo, edge = frame(0.0)
    assert np.abs(made - photo).max() < 1e-6
    assert edge.sum() > 0.1 * MASK.sum()
    assert not edge[APART < 18.0 - INNER_RIM_PX - 1.5].any()


@pytest.mark.parametrize("shift", [1.5, 4.0])
def test_the_photo_leaves_the_outline_once_it_moves(shift):
    made, _, edge = frame(shift)
    partly = edge & (APART >= 17.0)
    assert made[partly].max() == pytest.approx(0.5 * 0.6 + 0.5 * 0.05, abs=1e-5)
