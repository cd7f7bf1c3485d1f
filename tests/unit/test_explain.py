# SPDX-License-Identifier: MIT
"""Videos of plain bodies, drawn here from known physics, become captures and causes without a scene."""

import json
import runpy
from pathlib import Path

import cv2
import numpy as np
import physgen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.diagnose.track.body_request import parse_body
from physgen.sim.diagnose.track.motion_view import understand_motion
from physgen.sim.diagnose.track.plain_bodies import follow_plain_body
from physgen.sim.diagnose.track.region_track import true_times
from physgen.sim.errors import InputError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "video_to_cause.py"
FPS, SCALE = 120.0, 400.0


def draw(path, places, radius, size=(320, 240), shift=None, twins=False):
    """Write a video of a red ball at ``places`` (T, 2) px before a still, textured wall."""
    rng = np.random.default_rng(3)
    wall = cv2.GaussianBlur(rng.integers(90, 200, (size[1] + 40, size[0] + 40, 3), dtype=np.uint8), (0, 0), 2)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, size)
    for k, place in enumerate(places):
        off = np.zeros(2) if shift is None else shift[k]
        view = cv2.warpAffine(wall, np.array([[1, 0, off[0] - 20], [0, 1, off[1] - 20]]), size)
        large = cv2.resize(view, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
        centre = tuple(int(v) for v in np.round((np.asarray(place) + off) * 4))
        cv2.circle(large, centre, round(radius * 4), (30, 30, 210), -1)
        frame = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
        frame = np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8)
        writer.write(frame)
        if twins and k % 6 == 5:
            writer.write(frame)
    writer.release()
    return path


def tossed(count=60):
    t = np.arange(count) / FPS
    return t, np.stack([30 + SCALE * 1.1 * t, 190 - SCALE * (2.4 * t - 4.905 * t**2)], axis=1)


def test_a_tossed_ball_gives_scale_gravity_and_its_path(tmp_path):
    _, places = tossed()
    drift = np.stack([0.05 * np.arange(60), 0.02 * np.arange(60)], axis=1)
    video = draw(tmp_path / "toss.avi", places, radius=8, shift=drift)
    found = follow_plain_body(
        physgen.VideoTrial(path=video, fps_override=FPS), parse_body(f"ball:diameter={16 / SCALE}")
    )
    assert found.view.kind == "flight"
    assert found.view.scale == pytest.approx(SCALE, rel=0.04)
    seen = found.capture.trials[0].observed[:, 0]
    clock = found.capture.trials[0].times
    assert np.polyfit(clock, seen[:, 2], 2)[0] == pytest.approx(-4.905, rel=0.04)
    assert np.polyfit(clock, seen[:, 0], 1)[0] == pytest.approx(1.1, rel=0.05)
    assert np.abs(seen[:, 1]).max() == 0
    # The picture of the world is where the ball was drawn, on a background that does not drift.
    apart = found.view.pixels(seen) - places[found.frames]
    assert np.linalg.norm(apart - apart.mean(axis=0), axis=1).max() < 1.0


def test_a_repeated_frame_is_left_out_and_the_rest_spread_evenly():
    change = np.array([0, 2, 2, 2, 0.01, 2, 2, 2, 0.01, 2, 2, 2, 0.01, 2.0])
    times, fresh, said = true_times(list(np.arange(14) / 30), change, 30.0, None)
    assert fresh.sum() == 11 and "repeat" in said and "frames per second" in said
    assert np.ptp(np.diff(times[fresh])) < 1e-9 and times[-1] == pytest.approx(13 / 30)


@settings(max_examples=25, deadline=None)
@given(
    angle=st.floats(12, 40), friction=st.floats(0.02, 0.15), scale=st.floats(200, 2000), left=st.booleans()
)  # fmt: skip
def test_a_slope_is_found_from_the_path_alone(angle, friction, scale, left):
    t = np.arange(80) / 240
    a = 9.81 * (np.sin(np.radians(angle)) - friction * np.cos(np.radians(angle)))
    way = np.array([(-1 if left else 1) * np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    noise = np.random.default_rng(0).normal(0, 0.05, (80, 2))
    places = np.array([100.0, 50.0]) + np.outer(0.5 * a * t**2, way) * scale + noise
    view = understand_motion(
        t, places, diameter_px=0.05 * scale, diameter=0.05, clearance=0.02, elevation=np.pi / 2, where="v"
    )
    assert view.kind == "slope"
    assert np.degrees(np.arctan2(abs(view.normal[0]), view.normal[2])) == pytest.approx(angle, abs=1.0)
    assert view.normal[0] * way[0] > 0
    above = understand_motion(
        t, places, diameter_px=0.05 * scale, diameter=0.05, clearance=0.02, elevation=1.2, where="v", from_above=True
    )
    assert above.kind == "surface"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ball", "diameter is missing"),
        ("ball:diameter=x", "give a number"),
        ("ball:diameter=40", "millimetres"),
        ("egg:diameter=1", "start with"),
        ("ball:diameter=0.04,colour=3", "write NAME=VALUE"),
        ("cylinder:diameter=0.1", "height is missing"),
        ("ball:diameter=0.04,mass=5000", "check kg"),
        ("ball:diameter=0.04,friction=-1", "friction"),
        ("mesh:file=nothing.obj", "nothing.obj"),
    ],
)
def test_a_body_that_makes_no_sense_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        parse_body(text).capture_object()


def test_bad_videos_are_answered_by_one_line_and_nothing_is_written(tmp_path, capsys):
    still = draw(tmp_path / "still.avi", np.full((30, 2), 50.0), radius=6)
    short = draw(tmp_path / "short.avi", tossed(6)[1], radius=6)
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video at all")
    for path, message in ((still, "moves"), (short, "frames could be read"), (broken, "not a readable video")):
        for verb in ("explain", "track"):
            code = main([verb, str(path), "--object", "ball:diameter=0.04", "--out", str(tmp_path / "out")])
            said = capsys.readouterr().err.strip().splitlines()
            assert code == InputError.exit_code and message in said[-1]
            assert not (tmp_path / "out").exists()
    assert main(["track", str(still), "--out", str(tmp_path / "out")]) == InputError.exit_code
    assert "--scene" in capsys.readouterr().err


@pytest.mark.long
def test_example_video_to_cause(tmp_path):
    found = runpy.run_path(str(EXAMPLE))["main"](tmp_path)
    assert found.setting == "slope"
    assert found.diagnosis.verdict.effect == "friction"
    friction = next(e for e in found.diagnosis.effects if e.name == "friction").parameters["friction"].value
    assert friction == pytest.approx(0.2, abs=0.03)
    assert found.closed > 0.8
    assert json.loads((found.root / "explain.json").read_text())["effect"] == "friction"
    video = cv2.VideoCapture(str(found.video))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) > 20
    assert (found.root / "diagnosis" / "report.html").is_file()
