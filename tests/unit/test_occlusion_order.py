# SPDX-License-Identifier: MIT
"""Who stands in front of whom, on drawn things with known answers."""

import numpy as np
import pytest
from physgen.sim.reconstruct.segmentation.occlusion_order import occlusion_order

from .segmentation_scenes import HEIGHT, WIDTH, bottle, cylinder, disc, polygon


def in_front_of(order, index):
    """The objects in front of ``index`` that share a border with it."""
    before = order.front_to_back[: order.front_to_back.index(index)]
    touching = {frozenset((pair.front, pair.behind)) for pair in order.pairs if pair.touching}
    return tuple(other for other in before if frozenset((other, index)) in touching)


def stacked(*front_to_back):
    """What is seen of things given from the front to the back."""
    taken = np.zeros((HEIGHT, WIDTH), bool)
    seen = []
    for mask in front_to_back:
        seen.append(mask & ~taken)
        taken |= mask
    return seen


@pytest.mark.parametrize(
    ("front", "behind"),
    [
        pytest.param(disc(190, 150, 40), disc(150, 100, 55), id="two balls"),
        pytest.param(bottle(150, 60, 190, 28), polygon((90, 50), (220, 50), (220, 160), (90, 160)), id="bottle, book"),
        pytest.param(disc(150, 110, 30), polygon((80, 30), (220, 30), (220, 200), (80, 200)), id="toy on a chair"),
        pytest.param(cylinder(150, 60, 100, 25), polygon((90, 90), (210, 90), (250, 150), (50, 150)), id="cup on book"),
    ],
)
def test_touching_things_are_put_in_order(front, behind):
    seen = stacked(front, behind)
    assert occlusion_order(seen).front_to_back == (0, 1)
    assert occlusion_order(seen[::-1]).front_to_back == (1, 0)
    pair = occlusion_order(seen).pairs[0]
    assert (pair.front, pair.behind, pair.touching) == (0, 1, True)
    assert 0.0 < pair.confidence <= 1.0
    assert pair.reason


def test_things_apart_go_by_their_feet():
    order = occlusion_order([disc(60, 80, 25), disc(240, 160, 25), disc(150, 120, 25)])
    assert order.front_to_back == (1, 2, 0)
    assert in_front_of(order, 0) == ()
    # A foot that is known to be lower than what is seen counts in place of the mask's lowest row.
    order = occlusion_order([disc(60, 80, 25), disc(240, 160, 25), disc(150, 120, 25)], contacts=[230.0, 185.0, 145.0])
    assert order.front_to_back == (0, 1, 2)


def test_depth_map_outweighs_the_rest():
    near, far = disc(60, 80, 25), disc(240, 160, 25)
    depth = np.full((HEIGHT, WIDTH), np.nan)
    depth[near], depth[far] = 1.0, 3.0
    assert occlusion_order([near, far]).front_to_back == (1, 0)
    assert occlusion_order([near, far], depth=depth).front_to_back == (0, 1)
    assert "depth" in occlusion_order([near, far], depth=depth).pairs[0].reason
    # Unknown depth says nothing.
    assert occlusion_order([near, far], depth=np.full((HEIGHT, WIDTH), np.nan)).front_to_back == (1, 0)


def test_only_what_touches_may_hide():
    order = occlusion_order(stacked(disc(190, 160, 40), disc(150, 110, 50), disc(280, 60, 20)))
    assert order.front_to_back == (0, 1, 2)
    assert in_front_of(order, 1) == (0,)
    assert in_front_of(order, 2) == ()
    assert in_front_of(order, 0) == ()


def test_a_circle_gives_way_at_its_weakest_pair():
    # 0 before 1 and 1 before 2 by their feet; the depth map puts 2 a little before 0 and says nothing else.
    things = [disc(60, 190, 30), disc(160, 150, 30), disc(260, 140, 30)]
    depth = np.full((HEIGHT, WIDTH), np.nan)
    depth[things[0]], depth[things[2]] = 2.0, 1.96
    order = occlusion_order(things, depth=depth, contacts=[185.0, 182.0, 179.0])
    loop = {(pair.front, pair.behind) for pair in order.pairs}
    assert loop == {(0, 1), (1, 2), (2, 0)}
    weakest = order.pairs[-1]
    places = order.front_to_back
    assert sorted(places) == [0, 1, 2]
    for pair in order.pairs:
        kept = places.index(pair.front) < places.index(pair.behind)
        assert kept == (pair is not weakest)


def test_order_of_one_object_and_of_none():
    assert occlusion_order([disc(60, 80, 25)]).front_to_back == (0,)
    assert occlusion_order([]).front_to_back == ()


def test_twins_stay_in_the_given_order():
    assert occlusion_order([disc(60, 80, 25), disc(200, 80, 25)]).front_to_back == (0, 1)
