# SPDX-License-Identifier: MIT
"""Capture folders: what is written comes back, and whatever is wrong is said with file, field, value and remedy."""

import dataclasses
import json

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.diagnose.capture import Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.capture_folder import load_capture, save_capture
from physgen.sim.errors import InputError

BOX = trimesh.creation.box((0.1, 0.06, 0.04))


def a_trial(name="take01", role="fit", frames=20, scale=1.0, mirror=False):
    times = 0.1 + 0.01 * np.arange(frames)
    rest = np.asarray(BOX.vertices) * 0.9
    way = np.stack([0.5 * times, 0 * times, 1 + 2 * times - 4.905 * times**2], axis=1)
    shape = rest * (scale * np.array([1, 1, -1 if mirror else 1]))
    return Trial(
        name=name,
        role=role,
        times=times,
        points=way[:, None] + shape,
        pixels=None,
        object_index=np.zeros(len(rest), dtype=np.int64),
        rest_points=rest,
        predict_times=times[-1] + 0.01 * np.arange(1, 6) if role == "predict" else None,
    )


def a_capture(*trials, mesh=BOX, **changes):
    belief = ObjectBelief(name="body", mesh="body.obj", density_kg_m3=400.0, stiffness="hard")
    item = CaptureObject(belief=belief, vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    fields = {
        "gravity": (0.0, 0.0, -9.81),
        "ground": Ground(friction=0.4, restitution=0.3),
        "objects": (item,),
        "noise_sigma": 0.0005,
        "camera": None,
        "trials": trials or (a_trial(), a_trial("take02", "predict")),
    }
    return Capture(**(fields | changes))


@pytest.fixture
def folder(tmp_path):
    save_capture(a_capture(), tmp_path / "capture")
    return tmp_path / "capture"


def change(folder, **fields):
    path = folder / "capture.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def rewrite(folder, name="take01", **arrays):
    path = folder / f"{name}.npz"
    old = dict(np.load(path))
    np.savez(path, **{k: v for k, v in (old | arrays).items() if v is not None})


def test_capture_round_trip(folder):
    found, meant = load_capture(folder), a_capture()
    assert found.warnings == () and found.ground == meant.ground and found.objects[0].belief == meant.objects[0].belief
    assert np.allclose(found.objects[0].vertices, BOX.vertices, atol=1e-7)
    for a, b in zip(found.trials, meant.trials, strict=True):
        for field in dataclasses.fields(Trial):
            x, y = getattr(a, field.name), getattr(b, field.name)
            assert (x == y) if not isinstance(x, np.ndarray) else np.array_equal(x, y)


def test_pixels_need_a_camera(tmp_path):
    pixels = dataclasses.replace(a_trial(), pixels=np.full((20, 8, 2), 100.0), points=None)
    with pytest.raises(InputError, match="camera is missing"):
        save_capture(a_capture(pixels), tmp_path / "c")
        load_capture(tmp_path / "c")
    matrix = tuple(tuple(float(v) for v in row) for row in np.eye(4))
    camera = Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0, world_from_camera=matrix)
    save_capture(a_capture(pixels, camera=camera), tmp_path / "d")
    assert load_capture(tmp_path / "d").camera == camera


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"format": "physgen-capture/9"}, "physgen-capture/9"),
        ({"gravity": [0, 0]}, "gravity.*3 entries"),
        ({"noise_sigma": 0}, "noise_sigma is 0"),
        ({"noise_sigma": "small"}, "noise_sigma: expected a number"),
        ({"ground": {"friction": -1}}, "friction is -1"),
        ({"ground": {"normal": [0, 0, 0]}}, "normal"),
        ({"ground": {"restitution": 1.5}}, "restitution is 1.5"),
        ({"objects": []}, "at least one object"),
        ({"trials": []}, "at least one"),
        ({"colour": 3}, "colour: unknown field"),
        ({"trials": [{"name": "a", "file": "../../etc/x.npz", "role": "fit"}]}, "without '..'"),
        ({"trials": [{"name": "take01", "file": "take01.npz", "role": "test"}]}, "role is 'test'"),
        ({"trials": [{"name": "take02", "file": "take02.npz", "role": "predict"}]}, "nothing to fit to"),
        ({"trials": [{"name": "take01", "file": "take01.npz", "role": "fit"}] * 2}, "two are called 'take01'"),
        ({"trials": [{"name": "a", "file": "none.npz", "role": "fit"}]}, "no such file"),
    ],
)
def test_wrong_fields_are_named(folder, fields, words):
    change(folder, **fields)
    with pytest.raises(InputError, match=words):
        load_capture(folder)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"times": None}, "times is missing"),
        ({"points": None}, "either points or pixels"),
        ({"rest_points": None}, "rest_points is missing"),
        ({"times": np.arange(19.0)}, "points has shape"),
        ({"points": np.zeros((20, 8, 2))}, "points has shape"),
        ({"points": np.full((20, 8, 3), np.nan)}, "no point was seen"),
        ({"points": np.full((20, 8, 3), np.inf)}, "infinite"),
        ({"points": np.full((20, 8, 3), "x")}, "not numbers"),
        ({"times": np.zeros(20)}, r"times\[1\] is 0.0: give finite seconds in rising order"),
        ({"times": np.arange(20.0)[::-1]}, "rising order"),
        ({"object_index": np.ones(8)}, "object_index goes from 1 to 1"),
        ({"object_index": np.full(8, 0.5)}, "object_index"),
        ({"rest_points": np.full((8, 3), np.nan)}, "rest_points are not finite"),
        ({"times": np.array([0.0, 1.0]), "points": np.zeros((2, 8, 3))}, "2 frames"),
    ],
)
def test_wrong_arrays_are_named(folder, arrays, words):
    rewrite(folder, **arrays)
    with pytest.raises(InputError, match=words) as refusal:
        load_capture(folder)
    assert "take01" in str(refusal.value)


def test_objects_are_never_unpickled(folder):
    path = folder / "take01.npz"
    np.savez(path, times=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="not a readable archive"):
        load_capture(folder)


def test_an_archive_that_unpacks_to_too_much_is_refused_unread(folder, monkeypatch):
    monkeypatch.setattr("physgen.sim.diagnose.capture_folder.MAX_TRIAL_BYTES", 1000)
    with pytest.raises(InputError, match="shorten the trial"):
        load_capture(folder)


def test_millimetres_and_mirrors_are_found(tmp_path):
    for name, capture, words in (
        ("a", a_capture(a_trial(scale=1000.0)), "times as far apart"),
        ("b", a_capture(a_trial(mirror=True)), None),
        ("c", a_capture(mesh=trimesh.creation.box((100, 60, 40))), "millimetres"),
    ):
        save_capture(capture, tmp_path / name)
        if words is not None:
            with pytest.raises(InputError, match=words):
                load_capture(tmp_path / name)
    # A mirrored box is a box again; a corner cut off tells the hands apart.
    rest = np.random.default_rng(0).uniform(-0.02, 0.02, (12, 3))
    trial = dataclasses.replace(
        a_trial(), rest_points=rest, object_index=np.zeros(12, dtype=np.int64), points=np.tile(-rest, (20, 1, 1)) + 1.0
    )
    save_capture(a_capture(trial), tmp_path / "mirrored")
    with pytest.raises(InputError, match="left-handed"):
        load_capture(tmp_path / "mirrored")


def test_points_off_the_mesh_and_open_meshes_are_warned_about(tmp_path):
    far = dataclasses.replace(a_trial(), rest_points=a_trial().rest_points + np.array([0.2, 0, 0]))
    save_capture(a_capture(far), tmp_path / "far")
    assert "outside the mesh" in load_capture(tmp_path / "far").warnings[0]
    opened = trimesh.Trimesh(BOX.vertices, BOX.faces[:-2], process=False)
    save_capture(a_capture(mesh=opened), tmp_path / "open")
    assert "not closed" in load_capture(tmp_path / "open").warnings[0]


def test_a_take_without_enough_frames_is_left_out(tmp_path):
    points = a_trial().points.copy()
    points[2:] = np.nan
    lost = dataclasses.replace(a_trial("lost"), points=points)
    save_capture(a_capture(a_trial(), lost), tmp_path / "c")
    found = load_capture(tmp_path / "c")
    assert [t.name for t in found.trials] == ["take01"] and "'lost'" in found.warnings[0]


def test_a_mesh_with_flat_vertices_is_refused(folder):
    path = folder / "body.obj"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(" ".join(n.split()[:3]) if n.startswith("v ") else n for n in lines))
    with pytest.raises(InputError, match=r"body\.obj"):
        load_capture(folder)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_garbage_gives_a_clear_error(folder, data):
    name = data.draw(st.sampled_from(["capture.json", "take01.npz", "body.obj"]))
    path = folder / name
    whole = path.read_bytes()
    try:
        cut = data.draw(st.integers(0, len(whole)))
        noise = data.draw(st.binary(max_size=40))
        path.write_bytes(whole[:cut] + noise + whole[cut + data.draw(st.integers(0, 40)) :])
        try:
            found = load_capture(folder)
        except InputError as error:
            assert str(error)
        else:
            assert all(np.isfinite(trial.times).all() for trial in found.trials)
    finally:
        path.write_bytes(whole)
