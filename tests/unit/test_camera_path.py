# SPDX-License-Identifier: MIT
"""The camera's path: where it leads, what is refused, and that a damaged file never passes."""

import copy
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.scene.camera_path import (
    CameraOffset,
    CameraPath,
    MoveKey,
    PoseKey,
    interpolate_keys,
    is_still,
    load_camera_path,
    offset_camera,
    reach,
    sample_cameras,
    save_camera_path,
    swing,
)
from physgen.sim.scene.model import Camera, Ground

UP = np.array([0.0, 0.0, 1.0])
PIVOT = np.array([0.1, 0.2, 0.0])


def photo_camera(pitch_deg=25.0):
    s, c = math.sin(math.radians(pitch_deg)), math.cos(math.radians(pitch_deg))
    pose = ((1.0, 0.0, 0.0, 0.0), (0.0, -s, c, -0.6), (0.0, -c, -s, 0.4), (0.0, 0.0, 0.0, 1.0))
    return Camera(width=160, height=120, fx=190.0, fy=200.0, cx=74.0, cy=63.5, world_from_camera=pose)


def follow(path, count=5, camera=None):
    camera = camera or photo_camera()
    return sample_cameras(path, camera, ground=Ground(), pivot=PIVOT, first_frame=1, count=count, fps=24.0)


@settings(max_examples=50, deadline=None)
@given(azimuth=st.floats(-29, 29), elevation=st.floats(-5, 29), dolly=st.floats(-0.29, 0.29))
def test_around_the_pivot_and_nearer(azimuth, elevation, dolly):
    camera = photo_camera()
    there = offset_camera(
        camera, CameraOffset(azimuth_deg=azimuth, elevation_deg=elevation, dolly=dolly), pivot=PIVOT, normal=UP
    )
    # The pivot stays where it is in the picture, at the distance that was asked for.
    assert there.project(PIVOT)[:2] == pytest.approx(camera.project(PIVOT)[:2], abs=1e-6)
    assert reach(camera, there, PIVOT)[1] == pytest.approx(dolly, abs=1e-9)
    alone = reach(camera, offset_camera(camera, CameraOffset(elevation_deg=elevation), pivot=PIVOT, normal=UP), PIVOT)[
        0
    ]
    assert alone == pytest.approx(abs(elevation), rel=0.02, abs=1e-6)


def test_signs_are_what_people_expect():
    camera = photo_camera()

    def there(**offset):
        return offset_camera(camera, CameraOffset(**offset), pivot=PIVOT, normal=UP)

    assert there(azimuth_deg=10).position[0] > camera.position[0]
    assert there(elevation_deg=10).position[2] > camera.position[2]
    assert there(right_m=0.1).position[0] > camera.position[0]
    assert there(up_m=0.1).position[2] > camera.position[2]
    point = camera.project(PIVOT)
    assert there(pan_deg=5).project(PIVOT)[0] < point[0]
    assert there(tilt_deg=5).project(PIVOT)[1] > point[1]
    right = np.array([PIVOT[0] + 0.2, PIVOT[1], 0.0])
    # The camera rolls clockwise, so what it sees rolls the other way.
    assert there(roll_deg=5).project(right)[1] < camera.project(right)[1]
    assert there(zoom=2.0).project(PIVOT)[0] - camera.cx == pytest.approx(2 * (point[0] - camera.cx))


def test_no_move_is_the_photos_own_camera_itself():
    camera = photo_camera()
    path = CameraPath(keys=(MoveKey(frame=1.0), MoveKey(frame=3.0), MoveKey(frame=5.0, azimuth_deg=4.0)))
    found = follow(path, camera=camera)
    assert all(f is camera for f in found[:3])
    assert found[4] != camera
    # 32-bit matrices, as Blender has them, are no move either.
    pose = np.asarray(camera.world_from_camera, dtype=np.float32)
    key = PoseKey(frame=1.0, world_from_camera=tuple(tuple(map(float, row)) for row in pose))
    assert follow(CameraPath(poses=(key,)), camera=camera) == [camera] * 5


def test_poses_lead_where_they_say_and_seconds_are_frames():
    camera = photo_camera()
    end = offset_camera(camera, CameraOffset(azimuth_deg=8.0, dolly=-0.05), pivot=PIVOT, normal=UP)
    keys = [PoseKey(time_s=t, world_from_camera=c.world_from_camera) for t, c in ((0.0, camera), (4 / 24, end))]
    found = follow(CameraPath(poses=tuple(keys)), camera=camera)
    assert found[0] is camera
    assert np.asarray(found[4].world_from_camera) == pytest.approx(np.asarray(end.world_from_camera), abs=1e-9)
    assert not is_still(camera, found[1], PIVOT)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.floats(-10, 10), min_size=2, max_size=6),
    st.lists(st.floats(0.2, 5), min_size=5, max_size=5),
    st.booleans(),
)
def test_interpolation_meets_its_keys_and_never_overshoots(values, widths, smooth):
    times = np.cumsum([0.0, *widths])[: len(values)]
    column = np.array(values)[:, None]
    assert interpolate_keys(times, column, times, smooth=smooth)[:, 0] == pytest.approx(values, abs=1e-9)
    dense = np.linspace(-1.0, times[-1] + 1.0, 200)
    found = interpolate_keys(times, column, dense, smooth=smooth)[:, 0]
    index = np.clip(np.searchsorted(times, dense, side="right") - 1, 0, len(times) - 2)
    low, high = np.minimum(column[index, 0], column[index + 1, 0]), np.maximum(column[index, 0], column[index + 1, 0])
    assert (found >= low - 1e-9).all()
    assert (found <= high + 1e-9).all()


def test_a_swing_starts_and_ends_at_rest():
    rows = [c.position[0] for c in follow(swing(first=1, last=21, azimuth_deg=10.0), count=21)]
    steps = np.diff(rows)
    assert steps[0] < 0.3 * steps.max()
    assert steps[-1] < 0.3 * steps.max()
    assert (steps > 0).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"keys": [{"frame": 1, "azimuth_deg": 31}]}, r"keys\[0\].*azimuth_deg is 31.0: give degrees from -30 to 30"),
        ({"keys": [{"frame": 1, "azimut_deg": 3}]}, r"keys\[0\].azimut_deg: unknown field"),
        ({"keys": [{"frame": 1}, {"frame": 1}]}, r"keys\[1\].frame is 1.0: give more than the 1 before it"),
        ({"keys": [{"frame": 1}, {"time_s": 2}]}, r"keys\[1\].frame is None: give all keys a frame"),
        ({"keys": [{"azimuth_deg": 3}]}, "give one of the two"),
        ({"keys": []}, "give keys, or poses"),
        ({"format": "physgen-camera/2", "keys": [{"frame": 1}]}, "this program reads physgen-camera/1"),
        ({"keys": [{"frame": 1}], "interpolation": "bouncy"}, "choose one of smooth, linear"),
        ({"keys": [{"frame": 1}], "backdrop_m": 0}, "backdrop_m is 0.0"),
        ({"poses": [{"frame": 1, "world_from_camera": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]}]},
         "not a rotation"),
    ],
)  # fmt: skip
def test_errors_name_the_wrong_field(tmp_path, content, message):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"format": "physgen-camera/1", **content}))
    with pytest.raises(InputError, match=message):
        load_camera_path(path)


def test_a_path_below_the_ground_is_refused_with_its_frame():
    path = CameraPath(keys=(MoveKey(frame=1.0), MoveKey(frame=5.0, elevation_deg=-29.0)))
    with pytest.raises(InputError, match=r"frame [345]: the camera is .* m above the ground"):
        follow(path, camera=photo_camera(pitch_deg=10.0))


GOOD = {
    "format": "physgen-camera/1",
    "interpolation": "linear",
    "pivot": [0, 0, 0],
    "keys": [{"frame": 1}, {"frame": 9, "azimuth_deg": 5, "zoom": 1.1}],
}
JUNK = (
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers()
    | st.text(max_size=5)
    | st.lists(st.integers())
    | st.just({})
)


@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_refused_or_a_good_path(tmp_path_factory, data):
    content = copy.deepcopy(GOOD)
    place = data.draw(st.sampled_from([content, content["keys"][0], content["keys"][1]]))
    name = data.draw(st.sampled_from([*place, "poses", "time_s", "roll_deg", "x"]))
    place[name] = data.draw(JUNK)
    text = json.dumps(content)
    cut = data.draw(st.integers(0, len(text)))
    path = tmp_path_factory.getbasetemp() / "fuzz.json"
    path.write_text(text[:cut] if data.draw(st.booleans()) else text)
    try:
        loaded = load_camera_path(path)
    except InputError as error:
        assert str(path) in str(error)
        return
    save_camera_path(path, loaded)
    assert load_camera_path(path) == loaded
