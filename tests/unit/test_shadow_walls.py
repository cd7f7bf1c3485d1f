# SPDX-License-Identifier: MIT
"""Shadows on a wall behind the objects, on pictures drawn with shadows that are known exactly."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.lighting.ground_lighting import overcast_sky, sun_disc
from physgen.sim.reconstruct.lighting.shadow_masks import cast_shadows
from physgen.sim.reconstruct.lighting.shadow_planes import ground_plane, wall_behind
from physgen.sim.srgb import linear_to_bytes
from scipy import ndimage

WIDTH, HEIGHT = 320, 240
PITCH_DEG = 18.0
RADIUS = 0.42
PIXELS = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)


def camera(pitch_deg=PITCH_DEG):
    return camera_above_ground(WIDTH, HEIGHT, 300.0, math.radians(pitch_deg))


def wall_frame(distance, turn_deg):
    """A point and the normal towards the room of a wall ``distance`` ahead, turned about the vertical."""
    turn = math.radians(turn_deg)
    return np.array([0.0, distance, 0.0]), np.array([math.sin(turn), -math.cos(turn), 0.0])


def first_hits(view, point, normal):
    """World points (N, 3) on ground or wall that the pixels show, and whether (N,) each is on the wall."""
    rays = view.rays(PIXELS.reshape(-1, 2))
    eye = view.position
    down = np.where(rays[:, 2] < -1e-9, -eye[2] / np.minimum(rays[:, 2], -1e-9), np.inf)
    ahead = ((point - eye) @ normal) / (rays @ normal)
    along = np.minimum(down, np.where(ahead > 0, ahead, np.inf))
    return eye + along[:, None] * rays, ahead < down


def blocked(places, centre, direction):
    """Whether (N,) the ball around ``centre`` stands between ``places`` (N, 3) and light from ``direction``."""
    apart = places - centre
    along = apart @ direction
    return (along < 0.0) & ((apart**2).sum(axis=1) - along**2 < RADIUS**2)


@functools.cache
def room(sun, distance=3.6, turn_deg=6.0, *, on_wall=True, share=0.7, ball_at=2.9, wall_light=(0.62, 0.6, 0.55)):
    """Photo, mask of a ball, its true shadow and the wall's pixels. sun: towards it. on_wall: else the shadow ends at
    the wall, which no light of this world does."""
    view = camera()
    point, normal = wall_frame(distance, turn_deg)
    places, wall = first_hits(view, point, normal)
    centre = np.array([0.0, ball_at, RADIUS])
    ball = _hides(view, centre)
    up = np.array([0.0, 0.0, 1.0])
    kept = np.zeros(len(places))
    sky = overcast_sky(80)[0]
    sun = np.asarray(sun) / np.linalg.norm(sun)
    for surface, axis in ((~wall, up), (wall, normal)):
        # Both halves of a wall's view are as bright: the sky, and the ground that reflects it.
        helper = np.stack([np.cross(axis, [1.0, 0.3, 0.2]), np.cross(axis, np.cross(axis, [1.0, 0.3, 0.2])), axis])
        helper /= np.linalg.norm(helper, axis=1, keepdims=True)
        around, discs = sky @ helper, sun_disc(sun, 0.03, 12)[0]
        for part, directions in ((share, discs), (1.0 - share, around)):
            for direction in directions:
                kept[surface] += part / len(directions) * ~blocked(places[surface], centre, direction)
    if not on_wall:
        kept[wall] = 1.0
    grain = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(HEIGHT, WIDTH)), 1.5)
    floor = np.array([0.3, 0.22, 0.15]) * np.exp(0.12 * grain / grain.std()).reshape(-1)[:, None]
    light = np.where(wall[:, None], np.array(wall_light), floor) * kept[:, None]
    light[ball] = [0.45, 0.08, 0.05]
    picture = ndimage.gaussian_filter(light.reshape(HEIGHT, WIDTH, 3), (0.6, 0.6, 0.0))
    noise = np.random.default_rng(6).normal(0.0, 1.0, picture.shape)
    pixels = np.clip(np.rint(linear_to_bytes(picture) + noise), 0, 255).astype(np.uint8)
    shape = (HEIGHT, WIDTH)
    return pixels, ball.reshape(shape), ((kept < 0.9) & ~ball).reshape(shape), wall.reshape(shape)


def _hides(view, centre):
    """Which pixels (N,) show the ball around ``centre``."""
    rays = view.rays(PIXELS.reshape(-1, 2))
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    apart = centre - view.position
    along = rays @ apart
    return (apart @ apart) - along**2 < RADIUS**2


def overlap(first, second):
    return (first & second).sum() / (first | second).sum()


SUNS = ((-0.5, -0.62, 0.45), (0.55, -0.6, 0.4))
"""From behind the camera, low: the shadow climbs the wall at one side of the ball."""


@pytest.mark.parametrize("sun", SUNS)
def test_a_shadow_climbs_the_wall(sun):
    pixels, ball, true, wall = room(sun)
    assert (true & wall).sum() > 0.25 * true.sum(), "the drawing itself"
    (found,) = cast_shadows(pixels, [ball], camera())
    assert overlap(found.shadow & wall, true & wall) > 0.75
    assert overlap(found.shadow, true) > 0.75


@pytest.mark.parametrize("sun", SUNS)
def test_no_shadow_is_found_on_a_wall_that_shows_none(sun):
    pixels, ball, true, wall = room(sun, on_wall=False)
    (found,) = cast_shadows(pixels, [ball], camera())
    assert (found.shadow & wall).sum() < 0.05 * true.sum()


@settings(max_examples=12, deadline=None)
@given(distance=st.floats(3.0, 5.0), turn_deg=st.floats(-9.0, 9.0))
def test_the_wall_is_where_its_foot_is_seen(distance, turn_deg):
    pixels, ball, _, wall = room((0.3, -0.4, 0.8), distance, turn_deg, ball_at=distance - 0.8)
    plane = wall_behind(pixels, [ball], camera())
    assert plane is not None
    assert (plane.region != wall).mean() < 0.01
    point, normal = wall_frame(distance, turn_deg)
    assert plane.axes[2] @ normal > math.cos(math.radians(4.0))
    assert abs((plane.origin - point) @ normal) < 0.12 * distance


@given(row=st.floats(0.0, 100.0), column=st.floats(0.0, float(WIDTH)))
def test_a_pixel_of_the_wall_is_put_where_its_ray_meets_it(row, column):
    pixels, ball, _, _ = room(SUNS[0])
    view = camera()
    plane = wall_behind(pixels, [ball], view)
    across, up, before = plane.places(view, np.array([column, row]))
    assert before == pytest.approx(0.0, abs=1e-9)
    world = plane.origin + across * plane.axes[0] + up * plane.axes[1]
    ray = view.rays(np.array([column, row]))
    along = (world - view.position) @ ray / (ray @ ray)
    assert np.allclose(view.position + along * ray, world, atol=1e-9)


def test_the_ground_ends_at_its_wall():
    pixels, ball, _, _ = room(SUNS[0])
    plane = wall_behind(pixels, [ball], camera())
    assert not (ground_plane(ball.shape, plane).region & plane.region).any()
    assert ground_plane(ball.shape).region.all()


def test_the_edge_of_a_thing_that_stays_is_no_wall():
    pixels, ball, _, _ = room((0.3, -0.4, 0.8), wall_light=(0.3, 0.22, 0.15))
    board = np.zeros_like(ball)
    rows = np.flatnonzero(ball.any(axis=1))
    board[round(rows.mean()) - 8 : round(rows.mean()) + 8] = True
    board &= ~ball
    pixels = np.where(board[..., None], pixels // 2 + np.array([0, 40, 110], np.uint8), pixels)
    assert wall_behind(pixels, [ball], camera()) is not None, "the drawing itself"
    assert wall_behind(pixels, [ball], camera(), board) is None


def test_a_joint_between_like_tiles_is_no_wall():
    pixels, ball, _, _ = room((0.3, -0.4, 0.8), wall_light=(0.3, 0.22, 0.15))
    foot = wall_behind(pixels, [ball], camera())
    assert foot is None
