# SPDX-License-Identifier: MIT
"""C3D files and bags of ROS 2 become captures; files are written by the libraries' own writers."""

import numpy as np
import physgen
import pytest
from physgen.batch.cli import main
from physgen.sim.errors import InputError
from physgen.sim.importers import recorded_files
from physgen.sim.importers.recordings import read_recording
from scipy.spatial.transform import Rotation

ezc3d = pytest.importorskip("ezc3d")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
from rosbags.typesys import Stores, get_typestore  # noqa: E402

TIMES = np.arange(0, 0.6, 0.02)
BALL = {"diameter": 0.04, "mass": 0.0027}
STORE = get_typestore(Stores.ROS2_HUMBLE)
START = 1_700_000_000_123_456_789
IDENTITY = np.tile([0.0, 0.0, 0.0, 1.0], (len(TIMES), 1))


def throw(velocity=(2.0, 0.5, 3.0)):
    return np.array([0.0, 0.0, 1.0]) + np.outer(TIMES, velocity) + np.outer(-4.905 * TIMES**2, [0, 0, 1])


def imported(files, tmp_path, name="capture", **fields):
    said = []
    request = physgen.ImportRequest(**(BALL | fields))
    found = physgen.import_capture(
        files, request, out=tmp_path / name, on_event=lambda e: said.append(e.get("message", ""))
    )
    return found, said


def a_c3d(path, points, labels, *, unit="mm", residuals=None, up=None):
    """points: (T, K, 3) in ``unit``; NaN are occluded."""
    made = ezc3d.c3d()
    group = made["parameters"]["POINT"]
    group["RATE"]["value"], group["LABELS"]["value"], group["UNITS"]["value"] = [50.0], list(labels), [unit]
    made["data"]["points"] = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=2).transpose(2, 1, 0)
    residuals = np.zeros(points.shape[:2]) if residuals is None else residuals
    made["data"]["meta_points"]["residuals"] = residuals.T[None]
    # Left out, ezc3d writes past the end of its own arrays.
    made["data"]["meta_points"]["camera_masks"] = np.zeros((7, *residuals.T.shape), dtype=bool)
    if up:
        made.add_parameter("POINT", "Y_SCREEN", [up])
    made.write(str(path))
    return path


def make(kind, **fields):
    return STORE.types[kind](**fields)


def header(stamp, frame):
    time = make("builtin_interfaces/msg/Time", sec=int(stamp) // 10**9, nanosec=int(stamp) % 10**9)
    return make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def vector(kind, xyz):
    return make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, xyz), strict=True)))


def pose(xyz, q):
    turn = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, q), strict=True)))
    return make("geometry_msgs/msg/Pose", position=vector("Point", xyz), orientation=turn)


def message(kind, stamp, xyz, q, frame="world", child="cube"):
    """Return a message of the given kind with one pose, or for PoseArray one a row of ``xyz``."""
    package = {"TFMessage": "tf2_msgs", "Odometry": "nav_msgs"}.get(kind, "geometry_msgs")
    name, head = f"{package}/msg/{kind}", header(stamp, frame)
    if kind == "PoseStamped":
        return make(name, header=head, pose=pose(xyz, q))
    if kind == "PointStamped":
        return make(name, header=head, point=vector("Point", xyz))
    if kind == "PoseArray":
        return make(name, header=head, poses=[pose(each, q) for each in xyz])
    if kind in ("TransformStamped", "TFMessage"):
        moved = make(
            "geometry_msgs/msg/Transform", translation=vector("Vector3", xyz), rotation=pose(xyz, q).orientation
        )
        one = make("geometry_msgs/msg/TransformStamped", header=head, child_frame_id=child, transform=moved)
        return one if kind == "TransformStamped" else make(name, transforms=[one])
    with_error = make("geometry_msgs/msg/PoseWithCovariance", pose=pose(xyz, q), covariance=np.zeros(36))
    still = make("geometry_msgs/msg/Twist", linear=vector("Vector3", [0] * 3), angular=vector("Vector3", [0] * 3))
    twist = make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36))
    return make(name, header=head, child_frame_id=child, pose=with_error, twist=twist)


def a_bag(path, topics, *, plugin="MCAP", compression=None):
    """topics: name → messages, or (log time, message) where they differ."""
    from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

    writer = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
    if compression:
        writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    with writer:
        for topic, messages in topics.items():
            kind = type(messages[0]).__msgtype__
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for index, entry in enumerate(messages):
                writer.write(connection, START + 20_000_000 * index, STORE.serialize_cdr(entry, kind))
    return path


def flight(kind, way, turns=IDENTITY, **fields):
    stamps = START + np.round(TIMES * 1e9).astype(np.int64)
    return [message(kind, s, p, q, **fields) for s, p, q in zip(stamps, way, turns, strict=True)]


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    import trimesh

    path = tmp_path_factory.mktemp("box") / "box.obj"
    trimesh.creation.box((0.1, 0.06, 0.04)).export(path)
    return path


def test_c3d_markers_keep_their_names_units_and_gaps(tmp_path, box):
    rest = np.array([[0.05, 0.03, 0.02], [-0.05, 0.03, 0.02], [0.05, -0.03, 0.02], [0.05, 0.03, -0.02]])
    names = ["corner", "left", "front", "low"]
    (tmp_path / "rest.csv").write_text("".join(f"{n},{x},{y},{z}\n" for n, (x, y, z) in zip(names, rest, strict=True)))
    turns = Rotation.from_rotvec(np.outer(TIMES, [3.0, -2.0, 1.0])).as_matrix()
    way = throw()[:, None] + np.einsum("tij,kj->tki", turns, rest)
    shown = 1e3 * way
    shown[7, 2] = np.nan
    shown = np.concatenate([shown, np.full((len(TIMES), 1, 3), 9.0)], axis=1)
    residuals = np.full(shown.shape[:2], 2.0)
    residuals[3, 1] = -1
    labels = [*(f"cube:{n}" for n in names), "*12"]
    file = a_c3d(tmp_path / "toss.c3d", shown, labels, residuals=residuals)
    fields = {"diameter": None, "mass": 0.1, "mesh": box, "rest": tmp_path / "rest.csv"}
    capture, said = imported([file], tmp_path, **fields)
    (trial,) = capture.trials
    assert trial.name == "toss" and trial.times[-1] == pytest.approx(TIMES[-1])
    hidden = np.isnan(trial.points).all(axis=2)
    assert np.argwhere(hidden).tolist() == [[3, 1], [7, 2]]
    np.testing.assert_allclose(trial.points[~hidden], way[~hidden], atol=1e-6)
    text = " ".join(said)
    assert (
        "*12" in text
        and "2 of 120 points are occluded" in text
        and "2 mm in the median" in text
        and "lone take" in text
    )
    with pytest.raises(InputError, match="no point 'top'; there are corner, left"):
        imported([file], tmp_path, "other", points=("top",), **fields)


def test_c3d_doubts_are_asked(tmp_path):
    y_up = throw()[:, None, [0, 2, 1]] * [1, 1, -1]
    file = a_c3d(tmp_path / "y.c3d", 1e3 * y_up, ["ball"], unit="")
    with pytest.raises(InputError, match="--length-unit mm"):
        imported([file], tmp_path)
    with pytest.raises(InputError, match="--up=y"):
        imported([file], tmp_path, length_unit="mm")
    capture, _ = imported([file], tmp_path, length_unit="mm", up="y")
    np.testing.assert_allclose(capture.trials[0].points[:, 0], throw(), atol=1e-6)
    # Nothing falls here, but the file says which axis is up.
    slide = np.outer(TIMES, [1.0, 0.0, 0.3])[:, None, [0, 1, 2]] + [0, 0.02, 0]
    told = a_c3d(tmp_path / "told.c3d", slide, ["ball"], unit="m", up="+Y")
    with pytest.raises(InputError, match="calls y up"):
        imported([told], tmp_path, "told")
    assert imported([told], tmp_path, "z", up="z")[0].trials[0].points[-1, 0, 2] == pytest.approx(0.3 * TIMES[-1])
    timeless = a_c3d(tmp_path / "rate.c3d", throw()[:, None], ["ball"], unit="m")
    # ezc3d does not write a rate of 0; others do.
    timeless.write_bytes(timeless.read_bytes().replace(np.float32(50).tobytes(), bytes(4)))
    with pytest.raises(InputError, match="give fps"):
        imported([timeless], tmp_path, "rate")
    assert imported([timeless], tmp_path, "rate", fps=50.0)[0].trials[0].times[1] == pytest.approx(0.02)


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("kind", ["PoseStamped", "TransformStamped", "TFMessage", "Odometry"])
def test_poses_of_bags_carry_the_body_along(tmp_path, box, plugin, kind):
    turns = Rotation.from_rotvec(np.outer(TIMES, [3.0, -2.0, 1.0]))
    bag = a_bag(tmp_path / "bag", {"/cube/pose": flight(kind, throw(), turns.as_quat())}, plugin=plugin)
    fields = {"diameter": None, "mass": 0.1, "mesh": box}
    capture, said = imported([bag], tmp_path, **fields)
    (trial,) = capture.trials
    expected = throw()[:, None] + np.einsum("tij,kj->tki", turns.as_matrix(), trial.rest_points)
    np.testing.assert_allclose(trial.points, expected, atol=1e-9)
    np.testing.assert_allclose(trial.times, TIMES, atol=1e-9)
    assert any("frame world" in s for s in said)
    (file,) = [p for p in bag.iterdir() if p.suffix in (".mcap", ".db3")]
    again, _ = imported([file], tmp_path, "again", **fields)
    np.testing.assert_array_equal(again.trials[0].points, trial.points)


def test_a_pose_array_is_markers_and_packed_messages_are_unpacked(tmp_path, box):
    rest = np.array([[0.05, 0.03, 0.02], [-0.05, 0.03, 0.02], [0.05, -0.03, 0.02]])
    way = throw()[:, None] + rest
    bag = a_bag(tmp_path / "bag", {"/markers": flight("PoseArray", way)}, plugin="SQLITE3", compression="MESSAGE")
    (tmp_path / "rest.csv").write_text("".join(f"/markers[{i}],{x},{y},{z}\n" for i, (x, y, z) in enumerate(rest)))
    fields = {"diameter": None, "mass": 0.1, "mesh": box, "rest": tmp_path / "rest.csv"}
    np.testing.assert_allclose(imported([bag], tmp_path, **fields)[0].trials[0].points, way, atol=1e-9)


def test_several_bodies_are_listed_and_one_is_chosen(tmp_path):
    topics = {"/a": flight("PoseStamped", throw()), "/b": flight("PoseStamped", throw((0, 1, 2)))}
    bag = a_bag(tmp_path / "bag", topics)
    with pytest.raises(InputError, match=r"which with points: /a \(PoseStamped, 30 in world\), /b"):
        imported([bag], tmp_path)
    with pytest.raises(InputError, match="nothing is called '/c'"):
        imported([bag], tmp_path, points=("/c",))
    capture, said = imported([bag], tmp_path, points=("/b",))
    np.testing.assert_allclose(capture.trials[0].points[:, 0], throw((0, 1, 2)), atol=1e-9)
    assert any("orientation never changes" in s for s in said)


def test_a_frame_that_stands_still_is_followed_and_one_that_moves_is_refused(tmp_path):
    quarter = Rotation.from_euler("x", 90, degrees=True)
    seen = quarter.inv().apply(throw() - [0.0, 0.0, 2.0])
    static = [message("TFMessage", START, [0.0, 0.0, 2.0], quarter.as_quat(), "map", "camera")]
    ball = flight("TFMessage", seen, frame="camera", child="ball")
    bag = a_bag(tmp_path / "bag", {"/tf": ball, "/tf_static": static})
    capture, said = imported([bag], tmp_path)
    np.testing.assert_allclose(capture.trials[0].points[:, 0], throw(), atol=1e-9)
    assert any("camera stands still in map" in s for s in said)
    drift = flight("TFMessage", np.outer(TIMES, [1.0, 0, 0]), frame="map", child="camera")
    both = [x for pair in zip(ball, drift, strict=True) for x in pair]
    moving = a_bag(tmp_path / "moving", {"/tf": both})
    with pytest.raises(InputError, match="'camera', which itself moves in 'map'"):
        imported([moving], tmp_path, "moving_capture", points=("ball",))


def test_stamps_that_repeat_fall_or_lack_are_named(tmp_path):
    twice = flight("PoseStamped", throw())
    same = a_bag(tmp_path / "same", {"/ball": [*twice[:5], twice[4], *twice[5:]]})
    capture, said = imported([same], tmp_path, "a")
    assert capture.trials[0].points.shape == (30, 1, 3) and any("sent twice" in s for s in said)
    other = message("PoseStamped", START + 80_000_000, [9.0, 9.0, 9.0], IDENTITY[0])
    bad = a_bag(tmp_path / "bad", {"/ball": [*twice[:5], other, *twice[5:]]})
    with pytest.raises(InputError, match=r"message 6 of /ball .*occurs twice, with different poses.*time=log"):
        imported([bad], tmp_path, "b")
    falling = a_bag(tmp_path / "falling", {"/ball": [*twice[5:10], *twice[:5], *twice[10:]]})
    with pytest.raises(InputError, match=r"message 6 of /ball .* earlier"):
        imported([falling], tmp_path, "c")
    # The recorder's clock: a message each 20 ms.
    capture, _ = imported([bad], tmp_path, "d", columns={"time": "log"}, up="z")
    assert np.diff(capture.trials[0].times) == pytest.approx(0.02)
    unstamped = [message("PoseStamped", 0, p, q) for p, q in zip(throw(), IDENTITY, strict=True)]
    _, said = imported([a_bag(tmp_path / "none", {"/ball": unstamped})], tmp_path, "e")
    assert any("times are the recorder's" in s for s in said)


def test_what_holds_no_motion_is_refused_in_words(tmp_path, monkeypatch):
    text = make("std_msgs/msg/String", data="hello")
    words = a_bag(tmp_path / "words", {"/chat": [text]})
    for path, wanted in (
        (words, "no poses, transforms or points in this bag; it has std_msgs/msg/String"),
        (tmp_path / "gone.mcap", "no such file"),
        (tmp_path, "without .mcap or .db3"),
    ):
        with pytest.raises(InputError, match=wanted):
            read_recording(path)
    (tmp_path / "x.c3d").write_bytes(b"hello there, this is text")
    with pytest.raises(InputError, match=r"is no \.c3d file"):
        read_recording(tmp_path / "x.c3d")
    for name, wanted in (("x.bag", "rosbags-convert"), ("x.db3.zstd", "zstd -d")):
        with pytest.raises(InputError, match=wanted):
            read_recording(tmp_path / name)
    file = a_c3d(tmp_path / "good.c3d", throw()[:, None], ["ball"], unit="m")
    monkeypatch.setattr(recorded_files.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"needs ezc3d: pip install 'physgen\[recordings\]'"):
        read_recording(file)


def test_a_reader_that_crashes_is_a_message(tmp_path):
    """At some 100 of the first 1,120 bytes ezc3d ends with a segmentation fault."""
    content = a_c3d(tmp_path / "a.c3d", throw()[:, None], ["ball"], unit="m").read_bytes()
    ends = []
    for at in (525, 651, 773):
        (tmp_path / "b.c3d").write_bytes(content[:at] + b"\xff" + content[at + 1 :])
        with pytest.raises(InputError, match=r"b\.c3d: ") as refused:
            read_recording(tmp_path / "b.c3d")
        ends.append("its reader ended with -" in str(refused.value))
    assert any(ends)


def test_the_command_takes_names_of_points(tmp_path, capsys):
    topics = {"/a": flight("PoseStamped", throw()), "/b": flight("PoseStamped", throw((0, 1, 2)))}
    bag = a_bag(tmp_path / "bag", topics)
    line = ["capture", "import", str(bag), "--diameter", "0.04", "--mass", "0.0027", "--out", str(tmp_path / "c")]
    assert main([*line, "--points", "/a"]) == 0
    assert "physgen diagnose" in capsys.readouterr().out
