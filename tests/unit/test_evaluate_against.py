# SPDX-License-Identifier: MIT
"""The measures of Physics-IQ: closed forms, what any two videos obey, sanity videos, what is said of bad input."""

import csv
import json
import struct
import subprocess
import sys

import cv2
import numpy as np
import physgen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.errors import InputError
from physgen.sim.evaluate import physics_iq
from physgen.sim.evaluate.footage import at_rate, open_footage
from physgen.sim.evaluate.physics_iq import (
    Take,
    compare,
    motion_masks,
    original_score,
    quarter,
    take,
    verified_scores,
    weighted_overlap,
)
from physgen.sim.srgb import read_rgb

SIZE = (160, 120)


def square_frames(count=12, step=8, grey=230, start=10, top=50, side=24):
    """A bright square that moves to the right over grey."""
    for i in range(count):
        frame = np.full((SIZE[1], SIZE[0], 3), 60, np.uint8)
        frame[top : top + side, start + step * i : start + step * i + side] = grey
        yield frame


def write_video(path, frames, fps=24.0):
    """Losslessly (FFV1), so that expectations are exact."""
    frames = list(frames)
    height, width = frames[0].shape[:2]
    out = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), fps, (width, height))
    for frame in frames:
        out.write(frame)
    out.release()
    return path


def write_folder(path, frames):
    path.mkdir()
    for i, frame in enumerate(frames, 1):
        cv2.imwrite(str(path / f"{i:04d}.png"), frame)
    return path


def taken(frames):
    return take(frames, quarter(*SIZE), name="video")


def test_masks_are_what_differs_from_the_running_average():
    first, second = np.full((60, 60, 3), 100, np.uint8), np.full((60, 60, 3), 100, np.uint8)
    second[20:40, 20:40] = 200
    masks = list(motion_masks([first, second, second, second, second, second, second, second]))
    assert not masks[0].any()
    # The average holds 0.3 of the new frame, so 100 · 0.7ⁿ of 100 remain after n frames: above 10 for n < 7.
    assert [bool(mask.any()) for mask in masks[1:]] == [100 * 0.7**n > 10 for n in range(1, 8)]
    assert masks[1][22:38, 22:38].all() and not masks[1][:15].any()
    # A speck of 3 x 3 pixels does not survive the opening.
    speck = first.copy()
    speck[30:33, 30:33] = 255
    assert not list(motion_masks([first, speck]))[1][:28].any()


def test_overlaps_have_their_closed_forms():
    a, b = np.zeros((3, 4, 4), bool), np.zeros((3, 4, 4), bool)
    a[1, 0, :2] = b[1, 0, 1:3] = True
    a[2, 3, 3] = True
    frames = np.zeros((3, 4, 4, 3), np.uint8)
    found = compare(Take(frames=frames, masks=a), Take(frames=np.full_like(frames, 51), masks=b))
    assert found.spatiotemporal_iou.tolist() == [1.0, pytest.approx(1 / 3), 0.0]
    assert found.spatial_iou == pytest.approx(1 / 4)
    # Means over time 1/3 each: one pixel in common of two and three.
    assert found.weighted_iou == pytest.approx(1 / 4)
    assert found.mse == pytest.approx([0.04] * 3)


def test_scores_relative_to_two_takes():
    ours = {"spatial_iou": 0.2, "spatiotemporal_iou": 0.1, "weighted_iou": 0.3, "mse": 0.02}
    takes = {"spatial_iou": 0.5, "spatiotemporal_iou": 0.4, "weighted_iou": 0.5, "mse": 0.01}
    assert original_score(ours, takes) == pytest.approx(100 * ((0.4 + 0.25 + 0.6) / 3 - 0.01))
    assert verified_scores(ours, takes) == pytest.approx(
        {"spatial_iou": 0.4, "spatiotemporal_iou": 0.25, "weighted_iou": 0.6, "mse": 0.5}, rel=1e-5
    )
    assert (
        original_score(takes, takes)
        == pytest.approx(100)
        == 100 * np.mean(list(verified_scores(takes, takes).values()))
    )
    assert original_score(ours, takes | {"spatial_iou": 0.0}) is None
    assert original_score(ours | {"mse": 1.0}, takes) == 0.0


masks = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).random((4, 6, 7)) < (seed % 5) / 4)


@settings(max_examples=60, deadline=None)
@given(masks, masks)
def test_any_two_videos_compare_alike_both_ways_and_within_range(a, b):
    frames = np.random.default_rng(int(a.sum())).integers(0, 256, (2, 4, 6, 7, 3), dtype=np.uint8)
    first, second = Take(frames=frames[0], masks=a), Take(frames=frames[1], masks=b)
    there, back = compare(first, second).values(), compare(second, first).values()
    assert there == pytest.approx(back)
    assert all(0 <= value <= 1 for value in there.values())
    assert compare(first, first).values() == {"spatial_iou": 1, "spatiotemporal_iou": 1, "weighted_iou": 1, "mse": 0}
    # Weighing is never more generous than the union where both moved: min/max of means against sets.
    assert weighted_overlap(a.mean(axis=0), b.mean(axis=0)) <= there["spatial_iou"] + 1e-12
    scores = verified_scores(there, compare(first, first).values())
    assert all(0 <= value <= 1 for value in scores.values())


def test_sanity_videos_rank_as_they_should():
    real = taken(square_frames())
    rng = np.random.default_rng(0)
    videos = {
        "itself": real,
        "standing still": taken([next(square_frames())] * 12),
        "reversed": taken(list(square_frames())[::-1]),
        "noise": taken(rng.integers(0, 256, (12, SIZE[1], SIZE[0], 3), dtype=np.uint8)),
        "late": taken([next(square_frames())] * 2 + list(square_frames(10))),
        "elsewhere": taken(square_frames(top=90)),
    }
    found = {name: compare(video, real).values() for name, video in videos.items()}
    assert found["itself"] == {"spatial_iou": 1, "spatiotemporal_iou": 1, "weighted_iou": 1, "mse": 0}
    # One frame repeated: no motion at all, which the first frame alone counts as equal.
    assert found["standing still"] == compare(real.still(), real).values()
    assert found["standing still"]["spatial_iou"] == found["standing still"]["weighted_iou"] == 0
    assert found["standing still"]["spatiotemporal_iou"] == pytest.approx(1 / 12)
    # Backwards it moves at the same places at other times.
    assert found["reversed"]["spatial_iou"] > 0.8 > 0.5 > found["reversed"]["spatiotemporal_iou"]
    # Noise of single pixels is no motion for these masks, the opening removes nearly all of it; the error sees it.
    assert videos["noise"].masks.mean() < 0.02 and found["noise"]["spatial_iou"] < 0.1
    assert found["noise"]["mse"] > 4 * found["standing still"]["mse"]
    assert found["elsewhere"]["spatial_iou"] < 0.1
    assert (
        1
        > found["late"]["spatial_iou"]
        > found["late"]["spatiotemporal_iou"]
        > found["elsewhere"]["spatiotemporal_iou"]
    )


def test_the_folder_has_page_json_and_tables_and_says_where_standing_still_is_better(tmp_path, capsys):
    write_video(tmp_path / "real.avi", square_frames())
    write_video(tmp_path / "other.avi", square_frames(step=-8, start=98, grey=255, top=10))
    command = ["evaluate", str(tmp_path / "other.avi"), "--against", str(tmp_path / "real.avi"), "--seconds", "0.5"]
    assert main([*command, "--json"]) == 0
    done = json.loads(capsys.readouterr().out.splitlines()[-1])
    written = json.loads((tmp_path / "other_evaluation" / "evaluation.json").read_text())
    assert written["format"] == "physgen-evaluation/1" and done["sections"] == written["sections"]
    measures = {m["name"]: m for m in written["sections"][0]["measures"]}
    assert [name for name, item in measures.items() if item["below_still"]] == ["mse"]
    assert measures["spatiotemporal_iou"]["value"] == measures["spatiotemporal_iou"]["still"]
    assert measures["physics_iq"]["value"] is None and "second take" in measures["physics_iq"]["note"]
    rows = list(csv.DictReader((tmp_path / "other_evaluation" / "measures.csv").read_text().splitlines()))
    assert {row["name"]: row["below_still"] for row in rows}["mse"] == "yes"
    curves = list(csv.DictReader((tmp_path / "other_evaluation" / "curves.csv").read_text().splitlines()))
    assert len([row for row in curves if row["name"] == "mse" and row["label"] == "this video"]) == 12
    # Again: replaced. Beside anything else: refused.
    assert main(command) == 0
    assert "a video that stands still does better: " in capsys.readouterr().out
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("x")
    assert main([*command, "--out", str(tmp_path / "full")]) == 3
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["mine.txt"]


def test_two_takes_give_scores(tmp_path):
    for name, step in (("ours", 8), ("one", 8), ("two", 7)):
        write_video(tmp_path / f"{name}.avi", square_frames(step=step))
    takes = [tmp_path / "one.avi", tmp_path / "two.avi"]
    found = physgen.evaluate(tmp_path / "ours.avi", against=takes, out=tmp_path / "out")
    assert found["physics_iq"] == found["physics_iq_verified"] == 100.0
    assert not any(measure.below_still for measure in found.sections[0].measures)
    other = physgen.evaluate(tmp_path / "two.avi", against=takes, out=tmp_path / "out")
    # The second take against the first is what the score is relative to.
    assert other["physics_iq"] == pytest.approx(100.0, abs=0.01) and other["spatial_iou"] < 1
    with pytest.raises(InputError, match="none of the figures"):
        _ = other["beauty"]


def test_another_rate_is_blended_as_the_benchmark_does(tmp_path):
    ramp = [np.full((16, 16, 3), 10 * i, np.uint8) for i in range(24)]
    footage = open_footage(write_video(tmp_path / "ramp.avi", ramp, fps=24.0))
    made = [int(frame[0, 0, 0]) for frame in at_rate(footage, 8.0, 100)]
    # 24 frames become 8, first and last kept, evenly between: 0, 230/7, …, 230.
    assert made == [int(230 * j / 7) for j in range(8)]
    assert len(list(at_rate(footage, 24.02, 100))) == 24
    assert len(list(at_rate(footage, 30.0, 100))) == 30 and len(list(at_rate(footage, 30.0, 7))) == 7


@pytest.mark.parametrize(
    ("ours", "theirs", "words"),
    [
        ({"count": 12}, {"count": 9}, "12 frames, of which the first 9 have a counterpart"),
        ({"count": 12}, {"count": 12, "step": 0}, "nothing moves by the measures' threshold"),
    ],
)
def test_odd_videos_are_said(tmp_path, ours, theirs, words):
    a, b = (
        write_video(tmp_path / "a.avi", square_frames(**ours)),
        write_video(tmp_path / "b.avi", square_frames(**theirs)),
    )
    said = []
    found = physgen.evaluate(a, against=[b], out=tmp_path / "o", on_event=lambda e: said.append(e.get("message", "")))
    assert any(words in text for text in found.notices) and set(found.notices) <= set(said)


def test_another_rate_and_shape_are_said(tmp_path):
    wide = [cv2.resize(frame, (320, 120)) for frame in square_frames(8)]
    a = write_video(tmp_path / "a.avi", wide, fps=12.0)
    b = write_video(tmp_path / "b.avi", square_frames(16), fps=24.0)
    found = physgen.evaluate(a, against=[b], out=tmp_path / "o")
    assert any("brought to 12 by blending" in text for text in found.notices)
    assert any("stretched to the recording's shape" in text for text in found.notices)


def test_another_size_and_one_take_given_twice_are_said(tmp_path):
    a = write_video(tmp_path / "a.avi", [cv2.resize(frame, (320, 240)) for frame in square_frames(8)])
    b = write_video(tmp_path / "b.avi", square_frames(8))
    found = physgen.evaluate(a, against=[b, b], out=tmp_path / "o")
    assert any("a.avi: has 320x240 pixels and b.avi 160x120; both" in text for text in found.notices)
    assert any("b.avi: is given twice" in text for text in found.notices)
    plain = physgen.evaluate(b, against=[b], out=tmp_path / "o")
    assert plain.notices == ()


def with_durations(path, runs):
    """``path``, an MP4 whose index lies at its end, with ``runs`` of (frames, how many steps each is shown)."""
    content, at, end, outer = bytearray(path.read_bytes()), 0, path.stat().st_size, []
    for wanted in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"):
        while content[at + 4 : at + 8] != wanted:
            at += struct.unpack(">I", content[at : at + 4])[0]
            assert at < end, f"no {wanted}"
        outer.append(at)
        end, at = at + struct.unpack(">I", content[at : at + 4])[0], at + 8
    start = outer.pop()
    (step,) = struct.unpack(">I", content[start + 20 : start + 24])
    entries = b"".join(struct.pack(">II", frames, round(steps * step)) for frames, steps in runs)
    box = struct.pack(">I4sII", 16 + len(entries), b"stts", 0, len(runs)) + entries
    longer = len(box) - (end - start)
    content[start:end] = box
    for place in outer:
        content[place : place + 4] = struct.pack(">I", struct.unpack(">I", content[place : place + 4])[0] + longer)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("runs", "fps", "seen", "words"),
    [
        ([(10, 0.6), (2, 3)], 40, [*range(11), 10, 10, 10, 10, 11], "4 frames repeated and 0 left out"),
        ([(4, 0.5), (8, 1.25)], 19.2, [0, *range(3, 12)], "0 frames repeated and 2 left out"),
    ],
)
def test_an_uneven_frame_rate_is_brought_to_what_a_player_shows_and_said(tmp_path, runs, fps, seen, words):
    out = cv2.VideoWriter(str(tmp_path / "v.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 24.0, SIZE)
    for i in range(12):
        out.write(np.full((SIZE[1], SIZE[0], 3), 20 * i, np.uint8))
    out.release()
    even = open_footage(tmp_path / "v.mp4")
    assert even.fps == 24 and not even.shown and not even.notices
    uneven = open_footage(with_durations(tmp_path / "v.mp4", runs))
    assert [round(float(frame.mean()) / 20) for frame in uneven.frames()] == seen
    assert uneven.fps == pytest.approx(fps, rel=2e-3) and uneven.count() == len(seen) and uneven.count(5) == 5
    assert [round(float(frame.mean()) / 20) for frame in uneven.frames(7)] == seen[:7]
    assert "v.mp4: its frame rate is uneven" in uneven.notices[0] and words in uneven.notices[0]
    # What the user says counts more than what the file says.
    assert open_footage(tmp_path / "v.mp4", fps=12.0).shown == ()


def test_a_folder_of_pictures_is_a_video_and_its_gaps_are_said(tmp_path):
    video = write_video(tmp_path / "v.avi", square_frames())
    folder = write_folder(tmp_path / "frames", square_frames())
    found = physgen.evaluate(folder, against=[video], out=tmp_path / "o")
    assert found["mse"] == 0 and found["spatial_iou"] == 1
    assert any("do not say their frame rate" in text for text in found.notices)
    (folder / "0005.png").unlink()
    found = physgen.evaluate(folder, against=[video], out=tmp_path / "o", options=physgen.EvaluateOptions(fps=24.0))
    assert any("1 frame is missing between 0001.png and 0012.png" in text for text in found.notices)


def test_a_file_that_is_no_video_or_no_photo_costs_one_line(tmp_path):
    """FFmpeg writes to the terminal by itself, and once a process has opened a video it does as it did then."""
    (tmp_path / "text.mp4").write_text("no video")
    command = [sys.executable, "-m", "physgen", "evaluate", "text.mp4", "--out", "out"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    wanted = "error: text.mp4: not a readable video; convert it to MP4 (H.264) or AVI (MJPEG)\n"
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "", wanted)
    with pytest.raises(InputError) as caught:
        read_rgb(tmp_path / "text.mp4")
    assert str(caught.value).endswith("(of no kind that is read); restore it, or give another as PNG or JPEG")


def test_what_is_no_video_is_refused_and_nothing_is_written(tmp_path, monkeypatch):
    good = write_video(tmp_path / "good.avi", square_frames())
    (tmp_path / "text.mp4").write_text("no video")
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "bare").mkdir()
    one = write_video(tmp_path / "one.avi", square_frames(1))
    uneven = write_folder(tmp_path / "uneven", [*square_frames(2), np.zeros((50, 50, 3), np.uint8)])
    cases = [
        (tmp_path / "none.mp4", "no such video"),
        (tmp_path / "text.mp4", "not a readable video"),
        (tmp_path / "empty.mp4", "is empty"),
        (tmp_path / "bare", "holds no pictures"),
        (one, "one frame long"),
        (uneven, "of one size"),
    ]
    for bad, words in cases:
        for pair in ((bad, good), (good, bad)):
            with pytest.raises(InputError, match=words):
                physgen.evaluate(pair[0], against=[pair[1]], out=tmp_path / "out")
    with pytest.raises(InputError, match="3 recordings"):
        physgen.evaluate(good, against=[good] * 3, out=tmp_path / "out")
    with pytest.raises(InputError, match=r"seconds is 0: give seconds from 0\.01"):
        physgen.EvaluateOptions(seconds=0)
    monkeypatch.setattr(physics_iq, "MOST_BYTES", 4 * 40 * 30 * 5)
    with pytest.raises(InputError, match="longer than 5 frames"):
        physgen.evaluate(good, against=[good], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
