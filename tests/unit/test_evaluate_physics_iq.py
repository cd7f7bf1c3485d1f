# SPDX-License-Identifier: MIT
"""A folder for the Physics-IQ benchmark: names, rates and lengths are checked, the table is the benchmark's."""

import csv
import json

import cv2
import numpy as np
import pytest
from physgen.batch.cli import main
from physgen.sim.app.evaluate import evaluate_physics_iq
from physgen.sim.errors import InputError
from physgen.sim.evaluate import physics_iq_folder


def clip(path, shift, fps=8.0, seconds=5.0, speed=2):
    """A square that moves to the right, in a file as the benchmark has them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    out = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), fps, (160, 120))
    for i in range(round(fps * seconds)):
        frame = np.full((120, 160, 3), 60, np.uint8)
        frame[40:70, shift + speed * i : shift + speed * i + 30] = 220
        out.write(frame)
    out.release()


SCENES = ("ball-and-block-fall", "ball-in-basket")


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """A benchmark of two scenarios from three perspectives, and a submission of 8 frames a second."""
    monkeypatch.setattr(physics_iq_folder, "VIEWS", 6)
    number = 0
    for scene in SCENES:
        for view in ("left", "center", "right"):
            number += 1
            for take in (1, 2):
                name = f"_testing-videos_30FPS_perspective-{view}_take-{take}_trimmed-{scene}.mp4"
                place = tmp_path / "benchmark" / "split-videos" / "testing" / "30FPS"
                clip(place / f"{number + 6 * (take - 1):04d}{name}", 6 + 4 * take, fps=30.0, speed=1)
            clip(tmp_path / "ours" / f"{number:04d}_perspective-{view}_trimmed-{scene}.mp4", 10, speed=3)
    return tmp_path / "ours", tmp_path / "benchmark"


def test_a_complete_folder_gives_the_table(folders, tmp_path, capsys):
    ours, benchmark = folders
    assert main(["evaluate", "--physics-iq", str(ours), "--against", str(benchmark), "--out", str(tmp_path / "o")]) == 0
    assert "6 of 6 views of ours at 8 frames a second" in capsys.readouterr().out
    found = json.loads((tmp_path / "o" / "evaluation.json").read_text())["sections"][0]
    assert found["notices"] == []
    values = {item["name"]: item for item in found["measures"]}
    rows = list(csv.DictReader((tmp_path / "o" / "physics_iq.csv").read_text().splitlines()))
    assert [row["id"] for row in rows] == [f"{i:04d}" for i in range(1, 7)]
    assert {row["scenario"] for row in rows} == set(SCENES)

    def mean(column):
        return np.mean([float(row[column]) for row in rows])

    ratios = [mean(f"ours_{n}") / mean(f"takes_{n}") for n in ("spatial_iou", "spatiotemporal_iou", "weighted_iou")]
    by_hand = 100 * min(max(np.mean(ratios) - (mean("ours_mse") - mean("takes_mse")), 0), 1)
    assert values["physics_iq"]["value"] == pytest.approx(by_hand)
    assert values["physics_iq_verified"]["value"] == pytest.approx(mean("verified_score"))
    assert values["spatial_iou"]["still"] == 0 < values["spatial_iou"]["value"]


def test_recordings_in_which_the_masks_see_no_motion_are_said(folders, tmp_path):
    ours, benchmark = folders
    for path in benchmark.rglob("0001_*.mp4"):
        path.unlink()
        clip(path, 10, fps=30.0, speed=0)
    for path in sorted(ours.iterdir())[2:]:
        path.unlink()
    found = evaluate_physics_iq(ours, benchmark=benchmark, out=tmp_path / "o")
    assert any(text.startswith("in 1 of 2 views nothing moves in the real video") for text in found.notices)


def test_a_real_take_in_our_place_has_the_best_score(folders, tmp_path):
    ours, benchmark = folders
    for path in ours.iterdir():
        path.unlink()
    place = benchmark / "split-videos" / "testing" / "30FPS"
    for path in place.glob("*take-1*"):
        parts = path.name.split("_")
        (ours / f"{parts[0]}_{parts[3]}_{parts[5]}").write_bytes(path.read_bytes())
    found = evaluate_physics_iq(ours, benchmark=benchmark, out=tmp_path / "o")
    assert found["physics_iq"] == found["physics_iq_verified"] == 100.0 and found["mse"] == 0


def test_whatever_is_wrong_with_a_folder_is_said(folders, tmp_path, capsys):
    ours, benchmark = folders
    names = sorted(path.name for path in ours.iterdir())
    (ours / names[0]).unlink()
    (ours / names[1]).write_text("no video")
    clip(ours / names[2], 10, fps=12.0)
    clip(ours / names[3], 10, seconds=4.0)
    (ours / "notes.txt").write_text("x")
    clip(ours / f"{names[4][:5]}again.mp4", 10)
    (ours / "0001_folder.mp4").mkdir()
    found = evaluate_physics_iq(ours, benchmark=None, out=tmp_path / "o")
    said = "\n".join(found.notices)
    for words in (
        "notes.txt: is no name of the benchmark's",
        f"{names[2]}: has 12 frames per second and the others 8",
        f"{names[3]}: is 4 s long",
        "0005 comes twice",
        "0001_folder.mp4: is a folder",
        f"\n{names[1]}: not a readable video",
        "2 of 6 videos are missing: 0001, 0002",
    ):
        assert words in said, words
    assert not (tmp_path / "o" / "physics_iq.csv").exists()
    found = evaluate_physics_iq(ours, benchmark=benchmark, out=tmp_path / "o")
    assert any("of 4 of 6 views: not the benchmark's score" in text for text in found.notices)
    (ours / "0001_folder.mp4").rmdir()
    for path in ours.iterdir():
        path.unlink()
    for bad, words in ((ours, "holds no video"), (tmp_path / "none", "is no folder")):
        with pytest.raises(InputError, match=words):
            evaluate_physics_iq(bad, benchmark=benchmark, out=tmp_path / "p")
    clip(ours / names[0], 10)
    with pytest.raises(InputError, match="has no split-videos/testing/30FPS"):
        evaluate_physics_iq(ours, benchmark=tmp_path, out=tmp_path / "p")
    second = next((benchmark / "split-videos" / "testing" / "30FPS").glob("*take-2*"))
    second.unlink()
    with pytest.raises(InputError, match="has one take"):
        evaluate_physics_iq(ours, benchmark=benchmark, out=tmp_path / "p")
    for command in (["evaluate"], ["evaluate", "v.mp4", "--physics-iq", str(ours)]):
        assert main(command) == 3
    assert "give VIDEO, or --physics-iq DIR" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()


def test_a_damaged_recording_costs_its_own_view_alone(folders, tmp_path, capsys):
    ours, benchmark = folders
    place = benchmark / "split-videos" / "testing" / "30FPS"
    cut, broken = next(place.glob("0002_*take-1*")), next(place.glob("0011_*take-2*"))
    clip(cut, 10, fps=30.0, seconds=2.0)
    broken.write_bytes(broken.read_bytes()[:600])
    out = tmp_path / "o"
    assert main(["evaluate", "--physics-iq", str(ours), "--against", str(benchmark), "--out", str(out)]) == 3
    said = capsys.readouterr()
    assert "4 of 6 views of ours" in said.out and cut.name in said.out and broken.name in said.out
    rows = {row["id"]: row for row in csv.DictReader((out / "physics_iq.csv").read_text().splitlines())}
    assert sorted(rows) == [f"{i:04d}" for i in range(1, 7)]
    for number, row in rows.items():
        assert (row["ours_mse"] == "") == (row["verified_score"] == "") == (number in ("0002", "0005"))
    assert cut.name in rows["0002"]["problem"] and "ends after 2 of 5 s" in rows["0002"]["problem"]
    assert broken.name in rows["0005"]["problem"]
    assert "0005 is not compared" in (out / "report.html").read_text()
    # What is left is as without the damaged ones.
    for path in (*place.glob("0002_*"), *place.glob("0008_*"), *place.glob("0005_*"), *place.glob("0011_*")):
        path.unlink()
    alone = evaluate_physics_iq(ours, benchmark=benchmark, out=tmp_path / "p")
    found = json.loads((out / "evaluation.json").read_text())["sections"][0]
    assert {item["name"]: item["value"] for item in found["measures"]} == {m.name: m.value for m in alone.measures}
    assert len(found["failures"]) == 2 and not alone.failures
    for path in place.iterdir():
        path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(InputError, match="no view can be compared; the first is"):
        evaluate_physics_iq(ours, benchmark=benchmark, out=tmp_path / "q")
