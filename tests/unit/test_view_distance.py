# SPDX-License-Identifier: GPL-3.0-or-later
"""The benchmark of unseen sides: its distance agrees with its formula and with common sense; marks are counted."""

import cv2
import numpy as np
import pytest
import trimesh
from physgen.benchmarks.reconstruct_pictures.painted_bodies import noise
from physgen.benchmarks.reconstruct_pictures.picture_sets import SETS, draw
from physgen.benchmarks.reconstruct_pictures.salient_marks import Marks, marks_of, unmatched
from physgen.benchmarks.reconstruct_pictures.turntable_scoring import compared
from physgen.benchmarks.reconstruct_pictures.view_distance import Look, _bures, distance
from physgen.sim.reconstruct import turntable

SIDE = 128


def disc(radius=48, aside=0):
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    return (np.hypot(x - aside, y) < radius).astype(np.float32)


def fur(seed, tone=(140, 100, 70), strength=14.0):
    noise = np.random.default_rng(seed).normal(size=(SIDE, SIDE)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)
    noise = strength * noise / noise.std()
    return np.clip(np.array(tone) + noise[..., None], 0, 255).astype(np.uint8)


def face(seed):
    picture = fur(seed)
    for x in (44, 84):
        cv2.circle(picture, (x, 52), 6, (15, 15, 15), -1, cv2.LINE_AA)
    cv2.ellipse(picture, (64, 80), (12, 5), 0, 0, 360, (120, 20, 25), -1, cv2.LINE_AA)
    return picture


def test_equal_pictures_have_no_distance_and_it_is_symmetric():
    one, other = Look(face(1), disc()), Look(fur(2), disc(40))
    assert distance(one, one) == pytest.approx(0.0, abs=1e-3)
    assert distance(one, other) == pytest.approx(distance(other, one), rel=1e-6)


def test_other_fur_is_near_and_a_mirrored_face_streaks_and_a_plain_back_are_far():
    true = Look(fur(1), disc())
    near = distance(Look(fur(2), disc()), true)
    streaks = cv2.GaussianBlur(fur(3), (0, 0), sigmaX=12.0, sigmaY=0.3)
    for far in (face(4)[:, ::-1], streaks, np.full_like(true.pixels, (140, 100, 70))):
        assert distance(Look(np.ascontiguousarray(far), disc()), true) > 1.5 * near
    assert distance(Look(face(4), disc()), true) > 3.0 * near


def test_plain_colours_are_as_far_apart_as_they_are():
    full = np.ones((SIDE, SIDE), np.float32)
    tones = np.zeros((2, 1, 1, 3), np.uint8) + np.array([100, 160], np.uint8)[:, None, None, None]
    looks = [Look(np.broadcast_to(tone, (SIDE, SIDE, 3)).copy(), full) for tone in tones]
    lightness = [116 * (((v / 255 + 0.055) / 1.055) ** 2.4) ** (1 / 3) - 16 for v in (100, 160)]
    # OpenCV's conversion goes by tables and splines.
    assert distance(*looks) == pytest.approx(lightness[1] - lightness[0], rel=0.01)


def test_the_backdrop_has_no_part_in_it_but_the_outline_has():
    one = Look(fur(1), disc())
    painted = one.pixels.copy()
    painted[one.cover == 0] = (0, 255, 0)
    assert distance(Look(painted, disc()), one) == pytest.approx(0.0, abs=1e-3)
    shrunk = [distance(Look(fur(1), disc(radius)), one) for radius in (46, 40, 30)]
    assert 0 < shrunk[0] < shrunk[1] < shrunk[2]


def test_the_distance_of_covariances_is_that_of_normal_distributions():
    # Along common axes it is the sum of squared differences of standard deviations.
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    deviations = np.array([[1.0, 2.0, 3.0], [4.0, 2.5, 0.0]])
    first, second = (turn @ np.diag(d**2) @ turn.T for d in deviations)
    assert _bures(first[None], second[None])[0] == pytest.approx(((deviations[0] - deviations[1]) ** 2).sum())


def test_pictures_of_two_sizes_and_empty_ones_are_refused():
    one = Look(fur(1), disc())
    with pytest.raises(ValueError, match="one size"):
        distance(one, Look(one.pixels[:64], one.cover[:64]))
    with pytest.raises(ValueError, match="no body"):
        distance(one, Look(one.pixels, np.zeros_like(one.cover)))


def test_eyes_and_mouth_are_marks_and_fur_light_and_shade_are_not():
    assert marks_of(Look(face(1), disc())).count == 3
    assert marks_of(Look(fur(1), disc())).count == 0
    shade = np.linspace(0.5, 1.2, SIDE)[None, :, None]
    assert marks_of(Look(np.clip(fur(1) * shade, 0, 255).astype(np.uint8), disc())).count == 0


def test_marks_that_are_truly_there_do_not_count():
    found = marks_of(Look(face(1), disc()))
    assert unmatched(found, found, 1) == 0
    assert unmatched(found, Marks(np.zeros_like(found.labels), 0), 1) == 3
    one_eye = Marks((found.labels == found.labels[52, 44]).astype(np.int32), 1)
    assert unmatched(found, one_eye, 3) == 2
    # A logo that merely touches a ring that goes around is still a logo.
    ring = np.zeros_like(found.labels)
    ring[55:58] = 1
    assert unmatched(found, Marks(ring, 1), 1) == 3


def a_ball(behind):
    """A furry ball with a face in front (-y); ``behind``: "true" fur, "clean" other fur, or "mirrored"."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.2)
    places = np.asarray(ball.vertices) / 0.2
    other = behind == "clean"
    fur = np.where((places[:, 1] > 0) & other, noise(places, 0.12, 2), noise(places, 0.12, 1))
    colours = np.array([140, 100, 70]) + 12.0 * fur[:, None]
    for x, z, radius in ((-0.35, 0.3, 0.14), (0.35, 0.3, 0.14), (0.0, -0.1, 0.16)):
        near = np.hypot(places[:, 0] - x, places[:, 2] - z) < radius
        colours[near & ((places[:, 1] < 0) | (behind == "mirrored"))] = (15, 15, 15)
    mesh = trimesh.Trimesh(ball.vertices, ball.faces, vertex_colors=colours.astype(np.uint8), process=False)
    return turntable.turned(mesh, np.array([0.0, -2.0, 0.5]))


@pytest.mark.long
def test_a_mirrored_face_is_worse_than_clean_fur_and_its_eyes_count():
    true = a_ball("true")
    numbers = {name: compared(true, a_ball(name)).numbers for name in ("clean", "mirrored")}
    assert [numbers[name]["marks_behind"] for name in numbers] == [0, 3]
    assert numbers["clean"]["back_view"] < numbers["mirrored"]["back_view"] * 2 / 3
    assert numbers["mirrored"]["front_view"] == pytest.approx(0.0, abs=1e-3)


def test_distance_ignores_exposure_and_scale():
    true, other = a_ball("true"), a_ball("true")
    dim = 0.7 * np.asarray(other.paint.colours)
    larger = other.vertices * 3.0
    mesh = trimesh.Trimesh(larger, other.faces, vertex_colors=dim.astype(np.uint8), process=False)
    numbers = compared(true, turntable.turned(mesh, np.array([0.0, -6.0, 1.5]))).numbers
    # A tenth of the 20 that the plain change of tone would be.
    assert numbers["unseen_views"] < 2.0


PAINTED = [(name, number) for name in ("turntable", "fresh") for number in range(SETS[name][0])]


@pytest.mark.parametrize(("name", "number"), PAINTED)
def test_each_painted_thing_stands_in_its_picture(name, number):
    case = draw(name, number)
    item = case.items[0]
    assert item.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    assert item.body.colours.shape == item.body.mesh.vertices.shape
    assert 0 < item.body.colours.min() <= item.body.colours.max() < 1
    seen = case.camera.project(item.vertices)
    assert (seen[:, :2] > 0).all()
    assert (seen[:, :2] < (case.camera.width, case.camera.height)).all()
    with pytest.raises(ValueError, match="0 to 4"):
        draw("turntable", 5)
