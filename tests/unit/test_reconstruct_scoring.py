# SPDX-License-Identifier: GPL-3.0-or-later
"""The benchmark of reconstruction counts what it says it counts."""

import math

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from physgen.benchmarks.reconstruct_pictures import cases, scoring, shapes
from physgen.benchmarks.reconstruct_pictures import scoring as judge
from physgen.sim.scene.model import Camera

LEVEL = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, -1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def a_camera(**changes) -> Camera:
    """At the origin, looking along +Y with Z up."""
    fields = {"width": 200, "height": 100, "fx": 100.0, "fy": 100.0, "cx": 100.0, "cy": 50.0}
    return Camera(**{**fields, "world_from_camera": LEVEL, **changes})


def a_mask(x0: int, y0: int, x1: int, y1: int, shape=(100, 200)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[y0:y1, x0:x1] = True
    return mask


def test_iou_is_shared_area_over_all_area():
    assert scoring.iou(a_mask(0, 0, 20, 10), a_mask(10, 0, 30, 10)) == pytest.approx(1 / 3)
    assert scoring.iou(a_mask(0, 0, 20, 10), a_mask(50, 0, 60, 10)) == 0.0
    assert scoring.iou(a_mask(0, 0, 0, 0), a_mask(0, 0, 0, 0)) == 1.0


def test_psnr_counts_the_hole_alone():
    true = np.full((100, 200, 3), 100, np.uint8)
    found = true.copy()
    hole = a_mask(10, 10, 30, 30)
    found[hole] += 10
    assert scoring.psnr_within(found, true, hole) == pytest.approx(20 * math.log10(25.5))
    found[60:80, 60:80] = 0
    assert scoring.psnr_within(found, true, hole) == pytest.approx(20 * math.log10(25.5))
    assert scoring.psnr_within(true, true, hole) == scoring.MOST_DB


def test_the_silhouette_of_a_cube_is_the_square_that_its_near_face_covers():
    cube = trimesh.creation.box(bounds=[[-0.4, 1.0, -0.2], [0.2, 2.0, 0.3]])
    seen = scoring.silhouette(a_camera(), cube.vertices, cube.faces)
    # Depth 1, 100 pixels a metre; up is less.
    assert np.array_equal(seen, a_mask(60, 20, 120, 70))


def test_the_silhouette_has_the_pixels_that_are_more_than_half_covered():
    # From 60.3 to 120.3 across.
    cube = trimesh.creation.box(bounds=[[-0.397, 1.0, -0.2], [0.203, 2.0, 0.3]])
    seen = scoring.silhouette(a_camera(), cube.vertices, cube.faces)
    assert np.array_equal(seen, a_mask(60, 20, 120, 70))


def test_points_behind_the_camera_are_not_seen():
    cube = trimesh.creation.box(bounds=[[-0.4, -2.0, -0.2], [0.2, -1.0, 0.3]])
    assert not scoring.silhouette(a_camera(), cube.vertices, cube.faces).any()


def test_the_field_of_view_goes_along_the_longer_side():
    assert scoring.fov_deg(a_camera()) == pytest.approx(90.0)
    assert scoring.fov_deg(a_camera(width=100, height=200, cx=50.0, cy=100.0)) == pytest.approx(90.0)


@given(st.floats(-1.2, 1.2), st.floats(-3.0, 3.0))
def test_the_grounds_normal_is_compared_in_the_camera_whatever_way_it_faces(pitch, heading):
    turn = trimesh.transformations.rotation_matrix(heading, (0, 0, 1))
    tilt = trimesh.transformations.rotation_matrix(pitch, (1, 0, 0))
    tilted = a_camera(world_from_camera=tuple(map(tuple, turn @ tilt @ np.array(LEVEL))))
    level = scoring.up_in_camera(a_camera(), (0, 0, 1))
    assert np.allclose(level, (0, -1, 0))
    angle = scoring.angle_deg(scoring.up_in_camera(tilted, (0, 0, 1)), level)
    assert angle == pytest.approx(math.degrees(abs(pitch)), abs=1e-6)


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder", "book", "cone"])
def test_volumes_of_the_models_are_those_of_their_shapes(kind):
    body = shapes.make(kind, 0.2, np.random.default_rng(3))
    x, y, z = body.mesh.extents
    assert max(x, y, z) == pytest.approx(0.2, rel=1e-3)
    true = {"box": x * y * z, "book": x * y * z, "sphere": math.pi / 6 * x * y * z, "cylinder": math.pi / 4 * x * y * z}
    if kind in true:
        assert body.volume == pytest.approx(true[kind], rel=5e-3)
    far = body.mesh.vertices + np.array([5.0, -3.0, 1.0])
    assert scoring.volume(far, body.mesh.faces) == pytest.approx(body.volume, rel=1e-6)


@pytest.mark.parametrize("kind", shapes.KINDS)
def test_the_models_are_closed_and_stand_on_the_ground(kind):
    body = shapes.make(kind, 0.2, np.random.default_rng(5))
    assert all(part.is_watertight and part.volume > 0 for part, _ in body.parts)
    assert body.mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-9)
    assert len(body.paints) == len(body.mesh.faces)


def test_the_order_is_asked_where_one_hides_another():
    covers = {"a": a_mask(0, 0, 50, 50), "b": a_mask(40, 0, 90, 50), "c": a_mask(150, 0, 190, 50)}
    order = ["a", "b", "c"]
    assert scoring.pairs_in_order(covers, order, {"a": 0, "b": 1, "c": 2}) == [True]
    assert scoring.pairs_in_order(covers, order, {"a": 2, "b": 1, "c": 0}) == [False]


@given(st.integers(0, 2**32 - 1))
def test_a_loose_box_holds_the_thing_and_stays_in_the_picture(seed):
    x0, y0, x1, y1 = cases.loose_box((10.0, 30.0, 110.0, 80.0), (120, 90), np.random.default_rng(seed))
    assert 0.0 <= x0 <= 10.0 - 3.0 + 0.1
    assert 30.0 - 7.6 <= y0 <= 30.0 - 1.4
    assert 113.0 - 0.1 <= x1 <= 120.0
    assert 81.4 <= y1 <= 87.6


def test_pictures_are_the_same_each_time_and_other_ones_in_each_set():
    first, again, other = cases.draw("dev", 2), cases.draw("dev", 2), cases.draw("test", 2)
    assert first.camera == again.camera
    assert np.array_equal(first.items[0].vertices, again.items[0].vertices)
    assert first.camera != other.camera
    with pytest.raises(ValueError, match="picture 99"):
        cases.draw("dev", 99)


def test_failures_count_as_nothing_and_stay_in_the_medians():
    good = {"mask_iou": 1.0, "kind": "box", "silhouette_iou": 1.0, "silhouette_true_iou": 1.0, "volume_error": 0.0}
    bad = {**good, "mask_iou": 0.0, "volume_error": 1.0}
    case = {"exif": True, "vanishing_points": False, "fov_error": 0.0, "normal_deg": 0.0, "pairs_in_order": []}
    case |= {"background_gain_db": 5.0, "background_db": 30.0, "cpu_s": 1.0, "error": None, "stages": {"mesh": 1.0}}
    rows = [{**case, "objects": {"a": good}}, {**case, "objects": {"a": bad}, "error": "no", "background_gain_db": 0.0}]
    found = judge.medians(rows)
    assert found["mask_iou"] == {"median": 0.5, "of": 2}
    assert found["volume_error"] == {"median": 0.5, "of": 2}
    assert found["background_gain_db"]["median"] == 2.5
    assert found["failed"] == 1
    assert found["hidden_iou"] == {"median": None, "of": 0}
