# SPDX-License-Identifier: MIT
"""Highlights on drawn bodies: found by their normals, taken out, and told from paint."""

import numpy as np
import pytest
from physgen.sim.composite.highlights import CELLS, HEADROOM, find_highlights
from physgen.sim.srgb import bytes_to_linear, linear_to_bytes

COLOUR = np.array([0.55, 0.2, 0.04])
SIDE = 120
LAMP = np.array([0.3, 0.5, np.sqrt(1 - 0.34)])
"""Unit normal, right, up and towards the camera, that mirrors the lamp."""


def ball() -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (SIDE, SIDE, 3) of a ball that fills the picture, and where it is."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIDE), np.linspace(1, -1, SIDE))
    inside = x**2 + y**2 < 0.98
    return np.dstack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0.0))]), inside


def matt(normals: np.ndarray) -> np.ndarray:
    """Linear light of the ball without highlights: more from above."""
    return COLOUR * (0.7 + 0.5 * normals[..., 1:2])


def highlight(normals: np.ndarray) -> np.ndarray:
    return 0.3 * np.exp(-np.maximum(1 - normals @ LAMP, 0) / 0.03)[..., None]


def test_a_highlight_is_found_by_its_normal_and_taken_out():
    normals, inside = ball()
    picture = linear_to_bytes((matt(normals) + highlight(normals)).astype(np.float32))
    found = find_highlights(bytes_to_linear(picture)[inside], normals[inside])
    assert found is not None
    row, column = np.unravel_index(int(np.argmax(found.lobe)), found.lobe.shape)
    peak = (np.array([column, row]) + 0.5) / CELLS * 2 - 1
    assert peak == pytest.approx(LAMP[:2], abs=2 / CELLS)
    # Smoothing over a cell or two lowers the peak.
    assert float(found.lobe.max()) == pytest.approx(0.3, rel=0.25)
    left = HEADROOM * bytes_to_linear(found.taken_out(picture))
    error = np.abs(left - matt(normals))[inside].max(axis=1)
    # A step of 8 bits at this brightness, doubled, and the channel that tells white is the darkest one.
    assert np.percentile(error, 99) < 0.03
    assert np.abs(highlight(normals))[inside].max() > 0.25


def test_what_had_clipped_below_a_highlight_has_the_body_s_colour():
    normals, inside = ball()
    whole = 2.2 * matt(normals) + highlight(normals)
    assert whole.max() > 1.2
    picture = linear_to_bytes(whole.astype(np.float32))
    found = find_highlights(bytes_to_linear(picture)[inside], normals[inside])
    assert found is not None
    left = HEADROOM * bytes_to_linear(found.taken_out(picture))
    burnt = inside & (whole[..., 0] > 1.1)
    assert burnt.sum() > 100
    hue = left[burnt, 0] / left[burnt, 1]
    assert np.median(hue) == pytest.approx(COLOUR[0] / COLOUR[1], rel=0.1)


def test_below_a_highlight_that_has_nearly_burnt_out_lies_the_body_s_colour():
    normals, inside = ball()
    core = 0.5 * np.exp(-np.maximum(1 - normals @ LAMP, 0) / 0.01)[..., None]
    picture = linear_to_bytes((matt(normals) + highlight(normals) + core).astype(np.float32))
    found = find_highlights(bytes_to_linear(picture)[inside], normals[inside])
    assert found is not None
    burnt = inside & (bytes_to_linear(picture).min(axis=2) > 0.75)
    assert burnt.sum() > 10
    left = HEADROOM * bytes_to_linear(found.taken_out(picture))[burnt]
    # Neither white nor a dark hole: about as bright as the ball is there, and of its hue.
    assert left[:, 0] == pytest.approx(matt(normals)[burnt, 0], rel=0.35)
    assert left[:, 1] / left[:, 0] == pytest.approx(COLOUR[1] / COLOUR[0], rel=0.3)


def test_white_paint_stays_and_a_flat_side_tells_nothing():
    normals, inside = ball()
    lit = matt(normals) + highlight(normals)
    paint = (np.abs(normals[..., 0] + 0.4) < 0.12) & (np.abs(normals[..., 1] + 0.2) < 0.3)
    lit[paint] = 0.6
    picture = linear_to_bytes(lit.astype(np.float32))
    found = find_highlights(bytes_to_linear(picture)[inside], normals[inside])
    assert found is not None
    kept = HEADROOM * bytes_to_linear(found.taken_out(picture))[paint]
    assert kept == pytest.approx(0.6, abs=0.02)

    flat = np.broadcast_to((0.0, 0.0, 1.0), normals.shape)
    assert find_highlights(bytes_to_linear(picture)[inside], flat[inside]) is None


def test_print_that_does_not_follow_the_normal_and_white_things_have_none():
    normals, inside = ball()
    across = np.indices((SIDE, SIDE)).sum(axis=0)
    stripes = matt(normals) + np.where(across % 8 < 3, 0.25, 0.0)[..., None]
    assert (
        find_highlights(bytes_to_linear(linear_to_bytes(stripes.astype(np.float32)))[inside], normals[inside]) is None
    )
    white = 0.6 * np.ones((SIDE, SIDE, 3)) + highlight(normals)
    assert find_highlights(white[inside].astype(np.float32), normals[inside]) is None


def test_a_pale_body_on_a_coloured_floor_has_none():
    """White light from above and the floor's from below: both follow the normal, and neither mirrors a lamp."""
    normals, inside = ball()
    above = np.maximum(normals @ LAMP, 0)[..., None] ** 2
    floor = np.array([0.5, 0.3, 0.16]) * (0.8 - 0.3 * normals[..., 1:2])
    picture = linear_to_bytes((floor + 0.5 * above * np.array([0.95, 0.97, 1.0])).astype(np.float32))
    assert find_highlights(bytes_to_linear(picture)[inside], normals[inside]) is None


@pytest.mark.filterwarnings("error")
def test_a_pure_red_stays_red_below_its_highlight():
    normals, inside = ball()
    body = np.array([0.9, 0.0, 0.0]) * (0.8 + 0.4 * normals[..., 1:2])
    picture = linear_to_bytes((body + highlight(normals)).astype(np.float32))
    found = find_highlights(bytes_to_linear(picture)[inside], normals[inside])
    assert found is not None
    left = HEADROOM * bytes_to_linear(found.taken_out(picture))
    # Where red had clipped, the highlight is taken from what is left of it.
    assert left[inside][:, 0].min() > 0.7 * body[inside][:, 0].min()
    assert (left[inside][:, 0] / np.minimum(body[inside][:, 0], 1.0)).min() > 0.7
    assert left[inside][:, 1:].max() < 0.05
