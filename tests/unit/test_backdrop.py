# SPDX-License-Identifier: MIT
"""The background as geometry: what a moved camera sees of the photo, against points whose place is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.composite import backdrop, disocclusion, outpaint
from physgen.sim.composite.backdrop import Backdrop, borders_of, make_proxy, on_photo
from physgen.sim.errors import InputError
from physgen.sim.scene.camera_path import CameraOffset, offset_camera
from physgen.sim.scene.model import Camera, Ground

UP = np.array([0.0, 0.0, 1.0])
PIVOT = np.array([0.05, 0.0, 0.0])
BALL = np.array([[0.0, 0.0, 0.0], [0.1, 0.1, 0.1]])


def photo_camera(pitch_deg=20.0, size=(120, 90)):
    s, c = math.sin(math.radians(pitch_deg)), math.cos(math.radians(pitch_deg))
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, -s, c, -0.6), (0.0, -c, -s, 0.35), (0.0, 0.0, 0.0, 1.0))
    width, height = size
    return Camera(
        width=width, height=height, fx=1.1 * width, fy=1.1 * width, cx=width / 2, cy=height / 2, world_from_camera=pose
    )


OFFSETS = st.builds(
    CameraOffset,
    azimuth_deg=st.floats(-10, 10),
    elevation_deg=st.floats(-8, 10),
    dolly=st.floats(-0.1, 0.1),
    roll_deg=st.floats(-3, 3),
    zoom=st.floats(0.95, 1.3),
)


@settings(max_examples=50, deadline=None)
@given(offset=OFFSETS, x=st.floats(-0.3, 0.3), y=st.floats(-0.2, 0.6), pitch=st.floats(12, 60))
def test_things_stick_to_the_ground(offset, x, y, pitch):
    photo = photo_camera(pitch)
    stage = make_proxy(photo, Ground(), [BALL])
    camera = offset_camera(photo, offset, pivot=PIVOT, normal=UP)
    point = np.array([x, y, 0.0])
    if y + 0.6 > stage.distance - stage.bend or camera.project(point)[2] < 0.05 or photo.project(point)[2] < 0.05:
        return
    # Where the moved camera draws an object that touches the ground, it draws the photo's ground at that touch.
    drawn = on_photo(stage, photo, camera, camera.project(point)[:2])
    assert drawn == pytest.approx(photo.project(point)[:2], abs=1e-6)


@settings(max_examples=50, deadline=None)
@given(offset=OFFSETS, pitch=st.floats(0, 70))
def test_the_stage_has_no_holes_and_no_jumps(offset, pitch):
    photo = photo_camera(pitch)
    stage = make_proxy(photo, Ground(), [BALL])
    camera = offset_camera(photo, offset, pivot=PIVOT, normal=UP)
    drawn = on_photo(stage, photo, camera, outpaint.pixel_grid((photo.width, photo.height)))
    assert np.isfinite(drawn).all()
    steps = [np.abs(np.diff(drawn, axis=axis)).max() for axis in (0, 1)]
    assert max(steps) < 2.5


def test_the_photos_own_camera_sees_the_photo():
    photo = photo_camera()
    stage = make_proxy(photo, Ground(), [BALL])
    pixels = outpaint.pixel_grid((photo.width, photo.height))
    assert on_photo(stage, photo, photo, pixels) == pytest.approx(pixels, abs=1e-6)
    image = np.random.default_rng(0).random((90, 120, 3)).astype(np.float32)
    warp = Backdrop(camera=photo, proxy=stage, borders=outpaint.Borders()).warp(photo)
    assert warp.colours(image) == pytest.approx(image, abs=1e-5)


def test_borders_hold_what_is_seen_and_no_more_than_allowed():
    photo = photo_camera()
    stage = make_proxy(photo, Ground(), [BALL])

    def view(**offset):
        return [("frame 7", offset_camera(photo, CameraOffset(**offset), pivot=PIVOT, normal=UP))]

    assert not borders_of(stage, photo, view(dolly=-0.1))
    right = borders_of(stage, photo, view(pan_deg=5))
    assert right.right > right.left
    with pytest.raises(InputError, match=r"frame 7: the camera sees \d+ % beyond the photo's right border"):
        borders_of(stage, photo, view(pan_deg=29))


def test_the_inside_of_a_canvas_is_the_photo_bit_for_bit():
    rng = np.random.default_rng(1)
    image = np.repeat(rng.random((60, 1, 3)), 80, axis=1).astype(np.float32)
    borders = outpaint.Borders(left=9, right=12, bottom=7)
    painted = outpaint.outpaint(image, borders)
    assert painted.shape == (67, 101, 3)
    assert np.array_equal(painted[borders.inner((80, 60))], image)
    # Rows of one colour go on as rows of that colour.
    assert np.abs(painted[:60, 0] - image[:, 0]).mean() < 0.03
    ratio = np.full((60, 80, 3), 0.25, np.float32)
    faded = borders.faded(ratio)
    assert np.array_equal(faded[borders.inner((80, 60))], ratio)
    assert faded[30, 0] == pytest.approx(1.0, abs=0.05)


def depth_of(photo, stage, card):
    """Depth of the stage with an upright card (x0, x1, y, z1) before it, and the card's mask."""
    rays = photo.rays(outpaint.pixel_grid((photo.width, photo.height)))
    length = (card[2] - photo.position[1]) / rays[..., 1]
    points = photo.position + length[..., None] * rays
    mask = (points[..., 0] > card[0]) & (points[..., 0] < card[1]) & (points[..., 2] > 0) & (points[..., 2] < card[3])
    return np.where(mask, length, backdrop.proxy_depth(stage, photo, outpaint.Borders())), mask


def test_depth_is_cut_into_things_that_move_as_they_should():
    photo = photo_camera(15.0, (200, 150))
    stage = make_proxy(photo, Ground(), [BALL], 3.0)
    depth, mask = depth_of(photo, stage, (-0.3, -0.1, 0.3, 0.2))
    cut = backdrop.split_depth(depth, np.zeros(mask.shape, bool), stage, photo, outpaint.Borders())
    things, where = cut.layers, cut.hidden
    assert cut.ratio[~mask & ~where] == pytest.approx(1.0)
    assert len(things) == 1
    # Near its foot the card is as near as the ground, and is left to it.
    assert (where & mask).sum() > 0.8 * mask.sum()
    assert not (where & ~mask).any()
    camera = offset_camera(photo, CameraOffset(azimuth_deg=8.0), pivot=PIVOT, normal=UP)
    behind = np.zeros((150, 200, 3), np.float32)
    image = np.where(mask[..., None], np.float32(1.0), behind)
    relief = Backdrop(camera=photo, proxy=stage, borders=outpaint.Borders(), layers=things, hidden=where, behind=behind)
    seen = relief.warp(camera).colours(image)[..., 0] > 0.5
    truth = depth_of(camera, stage, (-0.3, -0.1, 0.3, 0.2))[1]
    assert (seen & truth).sum() > 0.93 * (seen | truth).sum()
    # One sheet over all would be torn between card and wall; as a plane it would not be where it is.
    flat = replace(relief, layers=(), hidden=None, behind=None).warp(camera).colours(image)[..., 0] > 0.5
    assert (flat & truth).sum() < 0.8 * (flat | truth).sum()


def test_depth_that_says_nothing_is_the_stage():
    photo = photo_camera()
    stage = make_proxy(photo, Ground(), [BALL])
    nothing = np.full((90, 120), np.nan, np.float32)
    cut = backdrop.split_depth(nothing, np.zeros((90, 120), bool), stage, photo, outpaint.Borders())
    assert cut.layers == ()
    assert (cut.ratio == 1).all()


def test_a_wall_in_the_depth_stands_where_it_is():
    photo = photo_camera(15.0, (200, 150))
    stage = make_proxy(photo, Ground(), [BALL], 3.0)
    rays = photo.rays(outpaint.pixel_grid((200, 150)))
    wall = 1.0
    with np.errstate(divide="ignore"):
        ground = np.where(rays[..., 2] < 0, -photo.position[2] / rays[..., 2], np.inf)
    depth = np.minimum(ground, (wall - photo.position[1]) / rays[..., 1])
    cut = backdrop.split_depth(depth, np.zeros((150, 200), bool), stage, photo, outpaint.Borders())
    relief = Backdrop(camera=photo, proxy=stage, borders=outpaint.Borders(), layers=cut.layers, ratio=cut.ratio)
    camera = offset_camera(photo, CameraOffset(azimuth_deg=6.0), pivot=PIVOT, normal=UP)
    image = np.broadcast_to(outpaint.pixel_grid((200, 150))[..., :1], (150, 200, 3)).astype(np.float32)
    seen = relief.warp(camera).colours(image)[..., 0]
    for x, z in ((-0.1, 0.2), (0.2, 0.3), (0.0, 0.1)):
        point = np.array([x, wall, z])
        column, row = camera.project(point)[:2]
        assert seen[int(row), int(column)] == pytest.approx(photo.project(point)[0], abs=1.5)


@settings(max_examples=25, deadline=None)
@given(dark=st.floats(0.2, 0.9), seed=st.integers(0, 99))
def test_disoccluded_background_is_shaded_like_the_photo(dark, seed):
    background = (0.4 + 0.2 * np.random.default_rng(seed).random((40, 60, 3))).astype(np.float32)
    mask, shadow = np.zeros((40, 60), bool), np.zeros((40, 60), bool)
    mask[10:25, 20:40] = True
    shadow[18:35, 12:48] = True
    photo = np.where(shadow[..., None], background * np.float32(dark), background)
    ratio = disocclusion.shade(photo, background, shadow=shadow & ~mask, unknown=mask)
    assert ratio[22, 30] == pytest.approx(dark, abs=0.12)
    assert ratio[12, 30].mean() > ratio[22, 30].mean()
    assert (ratio[0] == 1).all()
    (halo,) = disocclusion.object_halos(photo, background, [mask], shadow & ~mask)
    assert halo[30, 30] < 0.1
