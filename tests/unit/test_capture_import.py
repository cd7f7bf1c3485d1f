# SPDX-License-Identifier: MIT
"""Recordings become captures: tables, poses, Tracker and DeepLabCut; what looks wrong is asked or refused."""

import json

import numpy as np
import physgen
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.diagnose.capture_folder import load_capture
from physgen.sim.errors import InputError, PhysGenError
from physgen.sim.importers.recordings import read_recording
from scipy.spatial.transform import Rotation

TIMES = np.arange(0, 0.6, 0.02)
BALL = {"diameter": 0.04, "mass": 0.0027}


def throw(velocity=(2.0, 0.5, 3.0)):
    return np.array([0.0, 0.0, 1.0]) + np.outer(TIMES, velocity) + np.outer(-4.905 * TIMES**2, [0, 0, 1])


def table(path, way, *, times=TIMES, headings="time,x,y,z", extra=()):
    rows = [
        [f"{t:.9g}", *(f"{v:.9g}" for v in p), *map(str, e)]
        for t, p, e in zip(times, way, extra or [()] * len(way), strict=True)
    ]
    path.write_text("\n".join([headings, *(",".join(r) for r in rows)]) + "\n")
    return path


def imported(files, tmp_path, name="capture", **fields):
    said = []
    found = physgen.import_capture(
        files,
        physgen.ImportRequest(**(BALL | fields)),
        out=tmp_path / name,
        on_event=lambda e: said.append(e["message"]),
    )
    return found, said


def test_metres_seconds_and_z_up_need_no_word(tmp_path):
    capture, said = imported(
        [table(tmp_path / "a.csv", throw()), table(tmp_path / "b.csv", throw((0, 1, 4)))], tmp_path
    )
    assert [t.name for t in capture.trials] == ["a", "b"] and capture.objects[0].belief.density_kg_m3 == pytest.approx(
        80.57, 1e-3
    )
    np.testing.assert_allclose(capture.trials[0].points[:, 0], throw(), atol=1e-8)
    assert len(said) == 1 and "noise" in said[0]
    assert load_capture(tmp_path / "capture").trials[1].times[-1] == pytest.approx(TIMES[-1])


@pytest.mark.parametrize(
    ("change", "option", "fields"),
    [
        (lambda t, p: (1e3 * t, p), "--time-unit ms", {"time_unit": "ms"}),
        (lambda t, p: (t, 1e3 * p), "--length-unit mm", {"length_unit": "mm"}),
        (lambda t, p: (t, p[:, [0, 2, 1]] * [1, 1, -1]), "--up=y", {"up": "y"}),
        (lambda t, p: (t, p * [1, -1, -1]), "--up=-z", {"up": "-z"}),
    ],
)
def test_what_looks_wrong_is_refused_unless_somebody_says_so(tmp_path, change, option, fields):
    times, way = change(TIMES, throw())
    file = table(tmp_path / "a.csv", way, times=times)
    with pytest.raises(InputError, match=option):
        imported([file], tmp_path)
    assert not (tmp_path / "capture").exists()
    capture, _ = imported([file], tmp_path, **fields)
    np.testing.assert_allclose(capture.trials[0].points[:, 0], throw(), atol=1e-6)
    asked = []
    request = physgen.ImportRequest(**BALL)
    physgen.import_capture([file], request, out=tmp_path / "asked", confirm=lambda text: asked.append(text) or True)
    assert len(asked) == 1
    np.testing.assert_allclose(load_capture(tmp_path / "asked").trials[0].points[:, 0], throw(), atol=1e-6)


@pytest.mark.parametrize(
    ("times", "metres", "words"), [(1e300, 0, "lasts 1e"), (0, 1e300, "a point is 1e"), (0, 1e9, "m away")]
)
def test_numbers_that_no_recording_has_are_named(tmp_path, times, metres, words):
    """Their squares overflow, and a fit of a parabola to them does not converge."""
    clock, way = TIMES.copy(), throw()
    clock[-1], way[-1, 0] = max(clock[-1], times), way[-1, 0] + metres
    file = table(tmp_path / "a.csv", way, times=clock)
    with pytest.raises(InputError, match=words):
        imported([file], tmp_path, time_unit="s", length_unit="m")


def test_units_in_headings_count_and_takes_share_a_file(tmp_path):
    way = np.concatenate([1e3 * throw(), 1e3 * throw((1, 1, 2))])
    file = table(
        tmp_path / "all.csv", way, times=1e3 * np.concatenate([TIMES, TIMES]),
        headings="time_ms,x [mm],y [mm],z [mm],take",
        extra=[("one",)] * len(TIMES) + [("two",)] * len(TIMES),
    )  # fmt: skip
    capture, _ = imported([file], tmp_path, hold_out=0.5)
    assert [(t.name, t.role, len(t.times)) for t in capture.trials] == [("one", "fit", 30), ("two", "predict", 15)]
    np.testing.assert_allclose(capture.trials[0].points[:, 0], throw(), atol=1e-6)


@pytest.mark.parametrize("kind", ["quaternion", "euler", "degrees", "matrix"])
def test_poses_carry_the_body_along(tmp_path, kind):
    import trimesh

    trimesh.creation.box((0.1, 0.06, 0.04)).export(tmp_path / "box.obj")
    turns = Rotation.from_rotvec(np.outer(TIMES, [3.0, -2.0, 1.0]))
    columns = {
        "quaternion": ("qw,qx,qy,qz", np.roll(turns.as_quat(), 1, axis=1)),
        "euler": ("roll,pitch,yaw", turns.as_euler("xyz")),
        "degrees": ("roll,pitch,yaw", turns.as_euler("xyz", degrees=True)),
        "matrix": ("r11,r12,r13,r21,r22,r23,r31,r32,r33", turns.as_matrix().reshape(-1, 9)),
    }[kind]
    file = table(tmp_path / "a.csv", throw(), headings=f"time,x,y,z,{columns[0]}", extra=[tuple(r) for r in columns[1]])
    fields = {"diameter": None, "mass": 0.1, "mesh": tmp_path / "box.obj"}
    capture, _ = imported([file], tmp_path, **fields)
    trial = capture.trials[0]
    assert trial.points.shape == (30, 8, 3)
    expected = throw()[:, None] + np.einsum("tij,kj->tki", turns.as_matrix(), trial.rest_points)
    np.testing.assert_allclose(trial.points, expected, atol=1e-6)
    if kind == "matrix":
        mirrored = columns[1].copy()
        mirrored[:, :3] *= -1
        bad = table(
            tmp_path / "m.csv", throw(), headings=f"time,x,y,z,{columns[0]}", extra=[tuple(r) for r in mirrored]
        )
        with pytest.raises(InputError, match="left-handed"):
            imported([bad], tmp_path, "mirrored", **fields)


def test_mirrored_markers_are_caught(tmp_path):
    import trimesh

    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    mesh.export(tmp_path / "box.obj")
    rest = np.array([[0.05, 0.03, 0.02], [-0.05, 0.03, 0.02], [0.05, -0.03, 0.02], [0.05, 0.03, -0.02]])
    (tmp_path / "rest.csv").write_text(
        "name,x,y,z\n" + "".join(f"m{i},{x},{y},{z}\n" for i, (x, y, z) in enumerate(rest))
    )
    for name, flip in (("good", 1.0), ("bad", -1.0)):
        way = (throw()[:, None] + rest * [1, flip, 1]).reshape(len(TIMES), -1)
        heads = ",".join(f"m{i}_{a}" for i in range(4) for a in "xyz")
        file = table(tmp_path / f"{name}.csv", way, headings=f"time,{heads}")
        fields = {
            "diameter": None,
            "mass": 0.1,
            "mesh": tmp_path / "box.obj",
            "rest": tmp_path / "rest.csv",
            "noise": 1e-4,
        }
        if flip > 0:
            assert imported([file], tmp_path, name, **fields)[0].trials[0].points.shape == (30, 4, 3)
        else:
            with pytest.raises(InputError, match="mirror"):
                imported([file], tmp_path, name, **fields)


@pytest.mark.parametrize(
    ("row", "words"),
    [("0.06,0,0,1", "0.06 of sample 4 occurs twice"), ("0.02,0,0,1", "is earlier"), ("x,0,0,1", "no number")],
)
def test_bad_stamps_are_named(tmp_path, row, words):
    file = table(tmp_path / "a.csv", throw())
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:4], row.replace("0.06", "0.04"), *lines[4:]]).replace("0.04,0,0", "0.04,0,0"))
    with pytest.raises(InputError, match=words.replace("0.06", "0.04")):
        imported([file], tmp_path)
    assert not (tmp_path / "capture").exists()


def test_a_lone_take_is_told(tmp_path):
    _, said = imported([table(tmp_path / "a.csv", throw())], tmp_path)
    assert any("lone take" in s for s in said)


def test_deeplabcut_needs_frame_rate_and_scale(tmp_path):
    pixels = np.stack([100 + 500 * throw()[:, 0], 900 - 500 * throw()[:, 2]], axis=1)
    rows = [f"{i},{x:.6f},{y:.6f},{0.1 if i == 5 else 0.99}" for i, (x, y) in enumerate(pixels)]
    file = tmp_path / "d.csv"
    file.write_text("\n".join(["scorer,m,m,m", "bodyparts,ball,ball,ball", "coords,x,y,likelihood", *rows]))
    with pytest.raises(InputError, match="fps"):
        imported([file], tmp_path)
    with pytest.raises(InputError, match="scale"):
        imported([file], tmp_path, fps=50.0)
    seen = imported([file], tmp_path, fps=50.0, scale=1 / 500, ground=-10.0)[0].trials[0].points[:, 0]
    assert np.isnan(seen[5]).all() and not np.isnan(seen[6]).any()
    np.testing.assert_allclose(np.diff(seen[6:, 2]), np.diff(throw()[6:, 2]), atol=1e-6)


def a_tracker_project(way, scale=200.0, origin=(50.0, 300.0)):
    marks = "".join(
        f'<property name="[{i}]" type="object">'
        '<object class="org.opensourcephysics.cabrillo.tracker.PointMass$FrameData">'
        f'<property name="x" type="double">{origin[0] + scale * x}</property>'
        f'<property name="y" type="double">{origin[1] - scale * z}</property></object></property>'
        for i, (x, _, z) in enumerate(way)
    )
    return (
        '<?xml version="1.0"?><object class="org.opensourcephysics.cabrillo.tracker.TrackerPanel">'
        '<property name="clipcontrol" type="object"><object class="org.opensourcephysics.media.core.ClipControl">'
        '<property name="delta_t" type="double">20.0</property></object></property>'
        '<property name="coords" type="object"><object class="org.opensourcephysics.media.core.ImageCoordSystem">'
        '<property name="framedata" type="array"><property name="[0]" type="object">'
        '<object class="org.opensourcephysics.media.core.ImageCoordSystem$FrameData">'
        f'<property name="xorigin" type="double">{origin[0]}</property>'
        f'<property name="yorigin" type="double">{origin[1]}</property>'
        f'<property name="angle" type="double">0.0</property><property name="xscale" type="double">{scale}'
        "</property></object></property></property></object></property>"
        '<property name="tracks" type="collection"><property name="item" type="object">'
        '<object class="org.opensourcephysics.cabrillo.tracker.PointMass">'
        '<property name="name" type="string">ball</property>'
        f'<property name="framedata" type="array">{marks}</property></object></property></property></object>'
    )


def test_a_tracker_project_has_its_own_scale_and_clock(tmp_path):
    (tmp_path / "p.trk").write_text(a_tracker_project(throw()))
    capture, _ = imported([tmp_path / "p.trk"], tmp_path)
    np.testing.assert_allclose(capture.trials[0].points[:, 0, [0, 2]], throw()[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(capture.trials[0].times, TIMES, atol=1e-12)
    (tmp_path / "bomb.trk").write_text('<!DOCTYPE x [<!ENTITY a "b">]>' + a_tracker_project(throw()))
    with pytest.raises(InputError, match="entities"):
        imported([tmp_path / "bomb.trk"], tmp_path, "bomb")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2000), st.integers(0, 255), st.sampled_from(["a.csv", "p.trk", "d.csv"]))
def test_damaged_files_are_refused_in_words(tmp_path, at, byte, name):
    source = {"a.csv": table(tmp_path / "s.csv", throw()).read_text(), "p.trk": a_tracker_project(throw())}
    source["d.csv"] = "scorer,m,m\nbodyparts,b,b\ncoords,x,y\n" + "".join(f"{i},{i},{i}\n" for i in range(9))
    data = bytearray(source[name].encode())
    data[at % len(data)] = byte
    file = tmp_path / name
    file.write_bytes(bytes(data[: len(data) - at % 7]))
    try:
        assert read_recording(file)[0].points.ndim == 3
    except PhysGenError as error:
        assert str(file) in str(error)


def test_the_command_writes_a_capture_or_says_what_is_missing(tmp_path, capsys):
    file = table(tmp_path / "a.csv", throw(), times=1e3 * TIMES)
    line = [
        "capture",
        "import",
        str(file),
        "--diameter",
        "0.04",
        "--mass",
        "0.0027",
        "--out",
        str(tmp_path / "c"),
        "--json",
    ]
    assert main(line) == 3
    assert "--time-unit ms" in capsys.readouterr().out
    assert main([*line, "--time-unit", "ms"]) == 0
    events = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert events[-1]["event"] == "done" and events[-1]["trials"] == ["a"]
    assert any("lone take" in e.get("message", "") for e in events)
    assert load_capture(tmp_path / "c").trials[0].times[-1] == pytest.approx(TIMES[-1])


@pytest.mark.parametrize(
    "fields", [{"diameter": None}, {"density": 3.0}, {"mass": -1.0}, {"up": "w"}, {"hold_out": 1.0}, {"time_unit": "h"}]
)
def test_requests_are_checked(fields):
    with pytest.raises(InputError):
        physgen.ImportRequest(**(BALL | fields))
