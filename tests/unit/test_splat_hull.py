# SPDX-License-Identifier: MIT
"""Hulls of silhouettes and labels of their vertices, against solids of known shape."""

from __future__ import annotations

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.gaussians.views.hull_segmentation import VoteOptions, vote_labels
from physgen.sim.gaussians.views.posed_images import View, orbit_camera
from physgen.sim.gaussians.views.silhouettes import depth_buffer
from physgen.sim.gaussians.views.visual_hull import HullOptions, visual_hull
from physgen.sim.mpm.geometry.triangles import check_closed, signed_volume

from .splat_scenes import Ball, Box, Ring, views_of

BALL, HAT = Ball((0, 0, 0), 0.4), Box((0.2, -0.15, 0.1), (0.5, 0.15, 0.5))
FINGER, RING = Box((-0.15, -0.15, -0.5), (0.15, 0.15, 0.5)), Ring(0.3, 0.1)
QUICK = HullOptions(resolution=32)
SIDE = 48


@pytest.fixture(scope="module")
def hat():
    return views_of((BALL, HAT), side=SIDE)


@pytest.fixture(scope="module")
def ring():
    return views_of((FINGER, RING), side=SIDE)


def changed(view, **changes):
    kept = {name: getattr(view, name) for name in ("name", "camera", "pixels", "mask", "labels")}
    return View(**{**kept, **changes})


def with_changes(views, which, **functions):
    """``views``, those of numbers ``which`` with fields changed by functions of the view."""
    return [
        changed(view, **{name: function(view) for name, function in functions.items()}) if i in which else view
        for i, view in enumerate(views)
    ]


def swapped(view):
    return np.where(view.labels > 0, 3 - view.labels, -1)


def pixel(view):
    """Metres that a pixel covers at the origin."""
    return np.linalg.norm(view.camera.position) / view.camera.fx


def test_the_depth_buffer_is_the_distance_along_the_axis():
    camera = orbit_camera(30, 20, 2.0, side=33, focal=1.0)
    corners = np.array([[-1, -1, 0.1], [1, -1, 0.1], [1, 1, 0.1], [-1, 1, 0.1]])
    near = depth_buffer(corners, np.array([[0, 1, 2], [0, 2, 3]]), camera)
    pixels = np.stack(np.meshgrid(np.arange(33) + 0.5, np.arange(33) + 0.5), axis=-1)
    rays = camera.rays(pixels)
    depth = (0.1 - camera.position[2]) / rays[..., 2]
    place = camera.position + depth[..., None] * rays
    wanted = np.where((depth > 0) & (np.abs(place[..., :2]) < 1).all(axis=-1), depth, np.inf)
    edge = np.abs(np.abs(place[..., :2]).max(axis=-1) - 1) < 1e-6
    np.testing.assert_allclose(near[~edge], wanted[~edge], rtol=1e-9)
    # What stands in front wins, whatever the order; what reaches behind the camera is not drawn.
    both = np.concatenate([corners, corners + np.array([0, 0, 0.2]), 9 * corners])
    faces = np.array([[4, 5, 6], [4, 6, 7], [0, 1, 2], [0, 2, 3], [8, 9, 10]])
    middle = depth_buffer(both, faces, camera)[16, 16]
    assert middle == pytest.approx((0.3 - camera.position[2]) / rays[16, 16, 2])


def test_the_hull_of_a_ball_is_the_ball():
    views = views_of((BALL,), count=24, side=SIDE)
    hull = visual_hull(views, QUICK)
    assert check_closed(hull.faces)
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.02)
    # Never inside what it is the hull of, but for the width of a pixel.
    assert BALL.distance(hull.vertices).min() > -0.5 * pixel(views[0])
    assert max(hull.disagreement.values()) < 0.03 and hull.notes == () and hull.left_out == ()


@pytest.mark.parametrize("solids", [(BALL, HAT), (FINGER, RING)])
def test_the_hull_contains_the_object_and_projects_into_its_outlines(solids, hat, ring):
    views = hat if solids[0] is BALL else ring
    hull = visual_hull(views, QUICK)
    outside = np.min([solid.distance(hull.vertices) for solid in solids], axis=0)
    assert outside.min() > -0.6 * pixel(views[0])
    for view in views:
        drawn = np.isfinite(depth_buffer(hull.vertices, hull.faces, view.camera))
        # A pixel more or less along the outline.
        assert (drawn ^ (view.mask >= 0.5)).sum() < 0.06 * drawn.sum()
    assert hull.disagreement.keys() == {view.name for view in views}


def test_a_hole_that_several_views_look_through_stays_open():
    hull = visual_hull(views_of((RING,), side=SIDE), QUICK)
    edges = np.unique(np.sort(hull.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    assert len(hull.vertices) - len(edges) + len(hull.faces) == 0, "Euler's characteristic of a torus"


def without_bottom(share):
    def mask(view):
        rows = np.flatnonzero(view.mask.any(axis=1))
        kept = np.arange(SIDE) < rows[int(len(rows) * (1 - share))]
        return view.mask * kept[:, None]

    return mask


def pierced(view):
    rows, columns = (int(np.mean(places)) for places in np.nonzero(view.mask > 0.5))
    mask = view.mask.copy()
    mask[rows - 3 : rows + 3, columns - 3 : columns + 3] = 0
    return mask


@pytest.mark.parametrize(
    "which, mask, left_out",
    [
        ((2,), without_bottom(0.5), ("v2",)),
        ((2, 7), without_bottom(0.2), ()),
        ((2, 7), pierced, ()),
        ((2, 7, 11), lambda view: np.roll(view.mask, 8, axis=1), ("v2", "v7", "v11")),
        ((4,), lambda view: np.ones((SIDE, SIDE)), ("v4",)),
        ((4,), lambda view: np.zeros((SIDE, SIDE)), ("v4",)),
    ],
)
def test_a_few_bad_masks_change_little_and_are_named(hat, which, mask, left_out):
    good = visual_hull(hat, QUICK)
    hull = visual_hull(with_changes(hat, which, mask=mask, labels=lambda view: None), QUICK)
    volume = signed_volume(good.vertices, good.faces)
    assert signed_volume(hull.vertices, hull.faces) == pytest.approx(volume, rel=0.02)
    assert hull.left_out == left_out
    for number in which:
        assert any(f"'v{number}'" in note for note in hull.notes)
        assert hull.disagreement[f"v{number}"] > 2 * max(good.disagreement.values())


def test_masks_that_are_not_of_one_object_are_refused(hat):
    shifts = np.random.default_rng(0).integers(-25, 25, len(hat))
    scattered = [changed(v, mask=np.roll(v.mask, s, axis=1), labels=None) for v, s in zip(hat, shifts, strict=True)]
    with pytest.raises(InputError, match=r"not of one object at rest; they fit worst in v\d+, v\d+"):
        visual_hull(scattered, QUICK)
    with pytest.raises(InputError, match="view 'v3' has no mask"):
        visual_hull(with_changes(hat, [3], mask=lambda view: None), QUICK)
    with pytest.raises(InputError, match="masks are empty"):
        visual_hull(with_changes(hat, range(16), mask=lambda view: 0 * view.mask, labels=lambda view: None), QUICK)
    with pytest.raises(InputError, match="2 views do not bound"):
        visual_hull(hat[:2], QUICK)
    for wrong in ({"resolution": 8}, {"dissent": 0.6}, {"dissent": np.nan}):
        with pytest.raises(InputError, match="hull option"):
            HullOptions(**wrong)


def judged(hull, labels, solids, views):
    """Share of the vertices with the right label, away from where one object ends and the other begins."""
    distances = np.stack([np.abs(solid.distance(hull.vertices)) for solid in solids])
    clear = np.abs(distances[0] - distances[1]) > 1.5 * pixel(views[0])
    return (labels == distances.argmin(axis=0) + 1)[clear].mean()


@pytest.mark.parametrize("solids", [(BALL, HAT), (FINGER, RING)])
def test_votes_say_whose_each_vertex_is(solids, hat, ring):
    views = hat if solids[0] is BALL else ring
    hull = visual_hull(views, QUICK)
    votes = vote_labels(hull.vertices, hull.faces, views)
    assert judged(hull, votes.labels, solids, views) >= 0.98
    assert votes.conflict < 0.05 and votes.left_out == () and votes.unseen < 0.1


def test_wrong_labels_are_outvoted_or_named(hat):
    random = np.random.default_rng(0)

    def spotted(view):
        labels = view.labels.copy()
        for row, column in random.integers(0, SIDE, (12, 2)):
            spot = np.s_[row : row + 5, column : column + 5]
            labels[spot] = np.where(labels[spot] > 0, 3 - labels[spot], -1)
        return labels

    hull = visual_hull(hat, QUICK)
    votes = vote_labels(hull.vertices, hull.faces, with_changes(hat, range(16), labels=spotted))
    assert judged(hull, votes.labels, (BALL, HAT), hat) >= 0.98 and 0.01 < votes.conflict < 0.15
    votes = vote_labels(hull.vertices, hull.faces, with_changes(hat, (3, 9), labels=swapped))
    assert judged(hull, votes.labels, (BALL, HAT), hat) >= 0.98
    assert votes.left_out == ("v3", "v9") and votes.conflicts["v3"] > 0.9 and "'v9'" in votes.notes[1]
    with pytest.raises(InputError, match=r"16 views contradict each other, most in v\d+"):
        vote_labels(hull.vertices, hull.faces, with_changes(hat, range(0, 16, 2), labels=swapped))
    with pytest.raises(InputError, match="do not label two objects"):
        vote_labels(hull.vertices, hull.faces, with_changes(hat, range(16), labels=lambda view: None))
    with pytest.raises(InputError, match="vote option smoothing"):
        VoteOptions(smoothing=-1)


def test_a_few_labelled_views_label_the_unseen_side_by_what_is_nearest(hat):
    hull = visual_hull(hat, QUICK)
    votes = vote_labels(hull.vertices, hull.faces, with_changes(hat, range(1, 16), labels=lambda view: None))
    assert 0.3 < votes.unseen < 0.9 and votes.conflicts.keys() == {"v0"}
    behind = hull.vertices[:, 0] < -0.2
    assert (votes.labels[behind] == 1).all()
