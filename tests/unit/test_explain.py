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
from physgen.sim.composite.side_by_side import write_comparison
from physgen.sim.diagnose.track.motion_view import understand_motion
from physgen.sim.diagnose.track.moving_regions import Region, find_moving_regions
from physgen.sim.diagnose.track.plain_bodies import follow_plain_body
from physgen.sim.diagnose.track.region_track import RegionPath, true_times, with_missing_frames
from physgen.sim.diagnose.track.track_input import parse_body
from physgen.sim.errors import InputError

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "video_to_cause.py"
FPS, SCALE = 120.0, 400.0


def draw(path, places, radius, size=(320, 240), shift=None, twins=False, light=None, colour=(30, 30, 210)):
    """Write a video of a red ball at ``places`` (T, 2) px before a still, textured wall."""
    rng = np.random.default_rng(3)
    wall = cv2.GaussianBlur(rng.integers(90, 200, (size[1] + 40, size[0] + 40, 3), dtype=np.uint8), (0, 0), 2)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, size)
    for k, place in enumerate(places):
        off = np.zeros(2) if shift is None else shift[k]
        view = cv2.warpAffine(wall, np.array([[1, 0, off[0] - 20], [0, 1, off[1] - 20]]), size)
        large = cv2.resize(view, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
        centre = tuple(int(v) for v in np.round((np.asarray(place) + off) * 4))
        cv2.circle(large, centre, round(radius * 4), colour, -1)
        frame = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
        frame = np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8)
        if light is not None:
            frame = np.clip(frame * light[k], 0, 255).astype(np.uint8)
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


def test_lamps_that_flicker_make_no_frame_a_repetition(tmp_path):
    _, places = tossed()
    light = 1 + 0.04 * np.sin(1.7 * np.arange(60))
    video = draw(tmp_path / "toss.avi", places, radius=8, light=light)
    body = parse_body(f"ball:diameter={16 / SCALE}")
    found = follow_plain_body(physgen.VideoTrial(path=video, fps_override=FPS), body)
    assert found.view.kind == "flight" and len(found.frames) > 54
    assert np.linalg.norm(found.places - places[found.frames], axis=1).max() < 1.0
    assert found.view.scale == pytest.approx(SCALE, rel=0.04)


def test_exposure_that_changes_from_frame_to_frame_hides_no_dull_ball(tmp_path):
    _, places = tossed()
    light = np.where(np.random.default_rng(8).random(60) < 0.5, 0.9, 1.1)
    video = draw(tmp_path / "toss.avi", places, radius=8, light=light, colour=(105, 105, 175))
    body = parse_body(f"ball:diameter={16 / SCALE}")
    found = follow_plain_body(physgen.VideoTrial(path=video, fps_override=FPS), body)
    assert found.view.kind == "flight" and len(found.frames) > 54
    assert np.linalg.norm(found.places - places[found.frames], axis=1).max() < 1.0


def test_a_repeated_frame_is_left_out_and_the_rest_spread_evenly():
    change = np.array([0, 2, 2, 2, 0.01, 2, 2, 2, 0.01, 2, 2, 2, 0.01, 2.0])
    times, fresh, said = true_times(list(np.arange(14) / 30), change, 30.0, None)
    assert fresh.sum() == 11 and "repeat" in said and "frames per second" in said
    assert np.ptp(np.diff(times[fresh])) < 1e-9 and times[-1] == pytest.approx(13 / 30)


def test_frames_that_a_camera_has_dropped_are_put_in_and_an_impact_is_none():
    x = np.delete(10.0 * np.arange(40), 20) + np.random.default_rng(0).normal(0, 0.1, 39)
    times, missing = with_missing_frames(np.arange(39) / 30, np.stack([x, 0 * x], axis=1))
    assert missing == 1
    assert times[20] - times[19] == pytest.approx(2 / 30) and times[-1] == pytest.approx(39 / 30)
    struck = np.r_[10.0 * np.arange(20), 190 + 20.0 * np.arange(1, 20)]
    assert with_missing_frames(np.arange(39) / 30, np.stack([struck, 0 * struck], axis=1))[1] == 0


def test_a_narrow_motion_is_compared_below_whole_titles(tmp_path):
    """A drop's panels of 60 px had titles of eight letters."""
    tall, path = np.full((560, 60, 3), 40, np.uint8), np.full((2, 2), 30.0)
    written = write_comparison(
        tmp_path / "drop.mp4", iter([tall, tall]), draw=lambda k, picture: (picture, picture), window=(0, 0, 60, 560),
        seen=path, believed=path, found=path, times=np.array([0.0, 0.1]), gaps=(np.zeros(2), np.zeros(2)),
        withheld=0.05, titles=("real", "simulated as believed", "with air drag 0.069"),
    )  # fmt: skip
    ok, sheet = cv2.VideoCapture(str(tmp_path / "drop.mp4")).read()
    assert written == 2 and ok and sheet.shape[1] >= 3 * 200
    # Where the dark pictures are: three columns, each in the middle of its third.
    dark = np.flatnonzero(sheet[60:500].mean(axis=(0, 2)) < 100)
    starts = dark[np.r_[True, np.diff(dark) > 1]]
    assert np.abs(starts + 30 - (np.arange(3) * 208 + 100)).max() <= 2


def test_the_mark_of_the_real_centre_hides_no_small_body(tmp_path):
    """A ball of 8 px disappeared below its cross."""
    wall, path = np.full((200, 200, 3), 200, np.uint8), np.full((1, 2), 100.0)
    ball = cv2.circle(wall.copy(), (100, 100), 2, (20, 20, 220), -1)
    write_comparison(
        tmp_path / "small.mp4", iter([ball]), draw=lambda k, picture: (picture, picture), window=(0, 0, 200, 200),
        seen=path, believed=path, found=path, times=np.zeros(1), gaps=(np.zeros(1), np.zeros(1)),
        withheld=0.0, titles=("real", "simulated as believed", "nothing is missing"),
    )  # fmt: skip
    _, sheet = cv2.VideoCapture(str(tmp_path / "small.mp4")).read()
    for column in range(3):
        blue, _, red = sheet[228:233, 408 * column + 198 : 408 * column + 203].reshape(-1, 3).mean(axis=0)
        assert red > 150 > 100 > blue


def test_a_throw_at_thirty_frames_a_second_is_one_flight():
    t = np.arange(24) / 30
    places = np.stack([100 + 1200 * t, 700 - 2900 * t + 0.5 * 7800 * t**2], axis=1)
    places += np.random.default_rng(1).normal(0, 0.8, places.shape)
    view = understand_motion(t, places, diameter_px=53, diameter=0.066, clearance=0.033, elevation=np.pi / 2, where="v")
    assert (view.kind, view.first, view.last) == ("flight", 0, 23)


def test_a_body_that_rests_and_is_struck_slides_on_a_level_surface():
    t = np.arange(270) / 240
    moving = np.maximum(t - 190 / 240, 0)
    way = np.where(moving > 0, 600 * moving - 0.5 * 900 * moving**2, 0)
    places = np.stack([150 + way, 90 + 0.2 * way], axis=1) + np.random.default_rng(1).normal(0, 0.03, (270, 2))
    view = understand_motion(t, places, diameter_px=17, diameter=0.03, clearance=0.005, elevation=1.0, where="v")
    assert view.kind == "surface" and 185 < view.first < 205 and view.last == 269
    # Where it stays for long, only a little of that is kept.
    times = np.arange(900) / 240
    still = np.concatenate([places, places[-1] + np.random.default_rng(2).normal(0, 0.03, (630, 2))])
    view = understand_motion(times, still, diameter_px=17, diameter=0.03, clearance=0.005, elevation=1.0, where="v")
    assert 185 < view.first < 205 and 265 < view.last < 320


def understood(t, places, **other):
    known = {"diameter_px": 17, "diameter": 0.03, "clearance": 0.005, "elevation": 1.0, "where": "v"}
    return understand_motion(t, places, **(known | other))


def test_a_motion_that_fills_little_of_a_video_is_understood_like_the_same_motion_alone():
    t = np.arange(60) / 240
    way = 160 * t - 0.5 * 640 * t**2
    way[t > 0.25] = way.max()
    noise = np.random.default_rng(3).normal(0, 0.05, (900, 2))
    places = np.stack([190 + np.r_[way, np.full(840, way.max())], np.full(900, 105.0)], axis=1) + noise
    long = understood(np.arange(900) / 240, places)
    assert long.kind == "surface" and long.first <= 12 and 50 < long.last < 90
    pace = np.polyfit(t[long.first : 55], long.points[: 55 - long.first, 0], 2)[0]
    assert 2 * pace == pytest.approx(-640 / 17 * 0.03, rel=0.1)


def test_a_fall_that_is_none_names_the_size_and_the_frame_rate():
    t = np.arange(40) / 30
    drop = np.stack([np.full(40, 160.0), 20 + 0.5 * (9.81 / 16) * 400 * t**2], axis=1)
    drop += np.random.default_rng(0).normal(0, 0.1, drop.shape)
    # Recorded at 120 frames per second, played at 30: four times the frame rate.
    with pytest.raises(InputError, match=r"falls with 0\.6.* (119|12\d) frames per second in place of 30"):
        understood(t, drop, diameter_px=16, diameter=0.04)
    view = understood(t / 4, drop, diameter_px=16, diameter=0.04)
    assert view.kind == "flight"
    toss = np.stack([60 + 100 * t, 200 - 150 * t + 0.5 * (9.81 / 16) * 400 * t**2], axis=1)
    with pytest.raises(InputError, match="--fps-override"):
        understood(t, toss, diameter_px=16, diameter=0.04)


def test_a_collision_out_of_sight_ends_the_motion_before_it():
    """Touching another body, it is not told apart from it: six frames are missing, and its velocity is another."""
    t = np.arange(190) / 240
    struck, brake = 38 / 240, 1100.0

    def slide(start, velocity, since):
        speed = np.hypot(*velocity)
        moving = np.clip(since, 0, speed / brake)
        return start + np.outer(speed * moving - 0.5 * brake * moving**2, np.divide(velocity, speed))

    before = slide(np.array([33.0, 75.0]), (700.0, 300.0), t)
    at = slide(np.array([33.0, 75.0]), (700.0, 300.0), np.array([struck]))[0]
    places = np.where((t < struck)[:, None], before, slide(at, (90.0, 265.0), t - struck))
    places += np.random.default_rng(2).normal(0, 0.05, places.shape)
    seen = np.abs(t - struck) > 3.1 / 240
    view = understood(t[seen], places[seen])
    assert view.kind == "surface" and view.first >= np.flatnonzero(t[seen] > struck)[0]


def test_braking_beyond_friction_and_a_body_on_a_pivot_are_refused():
    t = np.arange(60) / 240
    way = np.stack([150 + 2000 * t - 0.5 * 16000 * np.minimum(t, 0.125) ** 2 - 2000 * np.maximum(t - 0.125, 0),
                    np.full(60, 90.0)], axis=1)  # fmt: skip
    way += np.random.default_rng(0).normal(0, 0.05, way.shape)
    with pytest.raises(InputError, match="more than friction can"):
        understood(t, way)
    turn = 9 * np.arange(200) / 240
    round_ = np.stack([200 + 75 * np.cos(turn), 110 + 75 * np.sin(turn)], axis=1)
    with pytest.raises(InputError, match="around one point"):
        understood(np.arange(200) / 240, round_ + np.random.default_rng(0).normal(0, 0.3, round_.shape))


def test_a_slow_ball_that_covers_its_place_all_the_time_is_seen_whole_on_a_plain_table(tmp_path):
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[0:240, 0:320]
    table = np.stack([150 + 0.1 * columns, 150 + 0.1 * columns, 155 + 0.08 * rows], axis=-1)
    writer = cv2.VideoWriter(str(tmp_path / "slow.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (320, 240))
    centres = [np.array([120 + 1.4 * k, 120 + 0.3 * k]) for k in range(40)]
    for centre in centres:
        frame = np.clip(table + rng.normal(0, 2, table.shape), 0, 255).astype(np.uint8)
        middle = tuple(int(v) for v in np.round(centre * 16))
        cv2.circle(frame, middle, 40 * 16, (60, 190, 190), -1, cv2.LINE_AA, 4)
        writer.write(frame)
    writer.release()
    found = find_moving_regions(tmp_path / "slow.avi")
    # In 29 of its 40 frames it covers the middle of its way: the median shows it there.
    away = np.abs(found.background.astype(float) - table)[20:-20, 20:-20].max(axis=-1)
    assert away.max() < 25 and away.mean() < 4
    for centre, regions in zip(centres, found.regions, strict=True):
        assert regions[0].area == pytest.approx(np.pi * 40**2, rel=0.05)
        assert np.linalg.norm(regions[0].middle - 0.5 - centre) < 1.5


def region(frame, middle, area=300.0, axes=(5.0, 4.6), **other):
    return Region(
        frame=frame, middle=np.asarray(middle, float), area=area, axes=np.array(axes), angle=0.0,
        outline=np.zeros((3, 2)), colour=np.zeros(3), cut=False, solid=1.0, **other,
    )  # fmt: skip


def test_a_short_toss_that_turns_has_a_way_and_a_column_of_compression_has_none():
    height = 40 + 5.4 * (np.arange(11) - 4.5) ** 2
    toss = RegionPath([region(k, (380, y)) for k, y in enumerate(height)])
    assert toss.travel > 0.8 * np.abs(np.diff(height)).sum() and toss.freedom() > 100
    assert RegionPath([region(k, (126, y), axes=(5.0, 0.1)) for k, y in enumerate(height)]).freedom() == 0


def test_a_plain_table_beside_a_hedge_and_a_ledge_fills_neither(tmp_path):
    rng = np.random.default_rng(7)
    scene = np.full((240, 320, 3), 170.0) + 0.1 * np.mgrid[0:240, 0:320][1][..., None]
    hedge = rng.integers((10, 40, 10), (90, 150, 90), (15, 54, 3)).astype(np.uint8)
    scene[:90] = cv2.resize(hedge, (320, 90)).astype(float)
    scene[90:96, 60:300] = 40.0
    writer = cv2.VideoWriter(str(tmp_path / "ledge.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (320, 240))
    for k in range(40):
        frame = np.clip(scene + rng.normal(0, 2, scene.shape), 0, 255).astype(np.uint8)
        cv2.circle(frame, (120 + round(1.5 * k), 138), 38, (40, 60, 200), -1, cv2.LINE_AA)
        writer.write(frame)
    writer.release()
    found = find_moving_regions(tmp_path / "ledge.avi")
    away = np.abs(found.background.astype(float) - scene).max(axis=-1)
    assert away[98:186, 80:220].max() < 30
    assert np.percentile(away[:96], 98) < 40
    assert all(len(r) and r[0].area == pytest.approx(np.pi * 38**2, rel=0.08) for r in found.regions)


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
    # Nothing gains speed on a level surface; but a disc on its rim looks like one from above.
    known = {"diameter_px": 0.05 * scale, "diameter": 0.05, "clearance": 0.02, "elevation": 1.2, "from_above": True}
    with pytest.raises(InputError, match="film a slope from its side"):
        understood(t, places, **known)
    rolls = understood(t, places, **known, rim=0.025)
    assert rolls.on_rim and rolls.kind == "slope"
    assert np.linalg.norm(rolls.point) == pytest.approx(0.025)


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
