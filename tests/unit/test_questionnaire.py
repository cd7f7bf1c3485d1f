# SPDX-License-Identifier: MIT
"""A questionnaire as people see it, in a real browser, and what becomes of their answers."""

import base64
import json
import math
import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.errors import InputError
from physgen.sim.evaluate.judge_question import CRITERIA
from physgen.sim.evaluate.questionnaire import load_case, load_key, make_questionnaire
from physgen.sim.evaluate.questionnaire_answers import (
    CollectOptions,
    bootstrap_interval,
    collect_questionnaire,
    krippendorff_alpha,
    sign_test,
)
from scipy.stats import binomtest

from .browser import PROGRAM, Browser

N = math.nan


def a_case(folder, name, videos=("ours", "other"), frames=8, prompt="A ball falls <b>&amp; bounces</b>."):
    place = folder / name
    place.mkdir(parents=True)
    cv2.imwrite(str(place / "photo.jpg"), np.full((60, 80, 3), 200, np.uint8))
    for i, video in enumerate(videos):
        writer = cv2.VideoWriter(str(place / f"{video}.webm"), cv2.VideoWriter_fourcc(*"VP80"), 8, (80, 60))
        for frame in range(frames):
            picture = np.full((60, 80, 3), 60 + 40 * i, np.uint8)
            cv2.circle(picture, (40, 5 + 6 * frame), 8, (40, 180, 240), -1)
            writer.write(picture)
        writer.release()
    lines = "\n".join(f'{video} = "{video}.webm"' for video in videos)
    (place / "case.toml").write_text(f'prompt = "{prompt}"\nimage = "photo.jpg"\n[videos]\n{lines}\n')
    return place


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("questionnaire")
    make_questionnaire([a_case(folder, "apple"), a_case(folder, "cup")], out=folder / "out")
    return folder / "out"


def answers(key, person, score=lambda case, video, criterion: 3, saved="2026-01-01"):
    cases = {
        case["id"]: {
            "scores": {
                token: {c: score(case["name"], video, c) for c in CRITERIA} for token, video in case["videos"].items()
            }
        }
        for case in key["cases"]
    }
    head = {"format": "physgen questionnaire answers", "version": 1, "questionnaire": key["questionnaire"]}
    return {**head, "person": person, "saved": saved, "cases": cases}


def write(folder, *sheets):
    folder.mkdir(exist_ok=True)
    for i, sheet in enumerate(sheets):
        (folder / f"{i}.json").write_text(json.dumps(sheet))
    return folder


def test_pages_do_not_tell_whose_a_video_is(made):
    key = load_key(made)
    assert sorted(key["cases"][0]["videos"].values()) == ["other", "ours"]
    pages = sorted(path.name for path in (made / "pages").iterdir())
    assert pages == ["case_01.html", "case_02.html", "index.html", "media"]
    for path in (made / "pages").rglob("*"):
        assert "ours" not in path.name
        if path.suffix == ".html":
            text = path.read_text()
            assert "ours.webm" not in text and '"ours"' not in text and "http://" not in text and "https://" not in text
    assert "&lt;b&gt;&amp;amp; bounces" in (made / "pages" / "case_01.html").read_text()


@pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine")
@pytest.mark.skipif(os.name != "posix", reason="the browser is driven over a pipe")
def test_a_person_answers_by_keyboard_and_the_page_saves_a_file_that_collect_reads(made, tmp_path):
    browser = Browser(tmp_path)
    try:
        browser.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path / "down"))
        browser.call("Page.navigate", url=(made / "pages" / "case_02.html").as_uri())
        browser.wait("!!document.getElementById('begin') && location.pathname.endsWith('index.html')")
        assert len(browser.run("document.getElementById('person').value")) == 8
        picture(browser, "start")
        browser.run("document.getElementById('person').value = 'anna'; document.querySelector('#begin button').click()")
        browser.wait(
            "document.querySelectorAll('article').length === 2 && !!document.getElementById('progress').textContent"
        )
        browser.wait("[...document.querySelectorAll('video')].every((v) => v.readyState >= 2 && v.videoWidth === 80)")
        assert browser.run("[...document.querySelectorAll('h2')].map((h) => h.textContent)") == ["Video 1", "Video 2"]
        first = browser.run("[...document.querySelectorAll('article')].map((a) => a.dataset.video)")
        # Going on with nothing answered is said, not done.
        browser.run("document.getElementById('next').click()")
        assert "6 answers are missing" in browser.run("document.getElementById('said').textContent")
        for key in "12345":
            browser.press(key)
        picture(browser, "case")
        assert "5 of 6 answered" in browser.run("document.getElementById('progress').textContent")
        browser.press("4")
        # The page before the reload says the same: it is marked, so that it is not taken for the one after.
        browser.run("window.before = true; location.reload()")
        browser.wait("!window.before && document.getElementById('progress').textContent.includes('6 of 6')")
        assert browser.run("[...document.querySelectorAll('article')].map((a) => a.dataset.video)") == first
        browser.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
        picture(browser, "phone")
        assert browser.run("document.documentElement.scrollWidth") <= 390
        browser.run("document.getElementById('next').click()")
        browser.wait("location.pathname.endsWith('case_02.html') && !!document.getElementById('progress').textContent")
        for key in "55555":
            browser.press(key)
        browser.run("document.getElementById('next').click()")
        browser.run("document.getElementById('next').click()")
        assert "missing in case 2" in browser.run("document.getElementById('said').textContent")
        file = tmp_path / "down" / "answers_anna.json"
        end = time.monotonic() + 30
        while not file.is_file() and time.monotonic() < end:
            time.sleep(0.1)
    finally:
        browser.close()
    saved = json.loads(file.read_text())
    assert saved["cases"]["case_01"]["order"] == first
    values = [saved["cases"]["case_01"]["scores"][token][c] for token in first for c in CRITERIA]
    assert values == [1, 2, 3, 4, 5, 4]
    found = collect_questionnaire([file], key=made, out=tmp_path / "result")
    assert sum(row["count"] for row in found["means"]) == 11
    assert any("1 answer missing or unusable: cup" in note for note in found["notes"])


def picture(browser, name):
    """Keep a picture of the page where PHYSGEN_PICTURES says so."""
    if folder := os.environ.get("PHYSGEN_PICTURES"):
        data = browser.call("Page.captureScreenshot", format="png")["data"]
        (Path(folder) / f"questionnaire_{name}.png").write_bytes(base64.b64decode(data))


def test_what_people_prefer_comes_out(made, tmp_path, capsys):
    key = load_key(made)
    liked = lambda case, video, criterion: 5 if video == "ours" else 2  # noqa: E731
    folder = write(tmp_path / "answers", *(answers(key, f"p{i}", liked) for i in range(6)))
    code = main(
        ["questionnaire", str(folder), "--collect", "--key", str(made / "key.json"), "--out", str(tmp_path / "r")]
    )
    assert code == 0 and "ours, photorealism: 5.00 (5.00 to 5.00), n = 12" in capsys.readouterr().out
    found = json.loads((tmp_path / "r" / "questionnaire.json").read_text())
    row = found["preferences"][0]
    assert {row["first"], row["second"]} == {"ours", "other"}
    assert sorted([row["wins"], row["losses"]]) == [0, 12] and row["p"] == pytest.approx(2 * 0.5**12)
    assert row["p_people"] == pytest.approx(2 * 0.5**6)
    assert found["agreement"][0]["ordinal"] == 1.0
    assert len((tmp_path / "r" / "scores.csv").read_text().splitlines()) == 1 + 6 * 2 * 2 * 3
    page = (tmp_path / "r" / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>") and "5.00 (5.00 to 5.00), n = 12" in page
    assert sum("same answers throughout" in note for note in found["notes"]) == 15


def test_incomplete_repeated_and_foreign_answers_are_all_said(made, tmp_path):
    key = load_key(made)
    old, new = answers(key, "ann", saved="1"), answers(key, "ann", lambda *_: 4, saved="2")
    off = answers(key, "bob", lambda case, video, c: 7 if c == "photorealism" else True)
    foreign = answers({**key, "questionnaire": "x"}, "eve")
    found = collect_questionnaire(
        [write(tmp_path / "a", new, old, new, off, foreign)], key=made, out=tmp_path / "result"
    )
    notes = "\n".join(found["notes"])
    for said in (
        "ann answered twice: 0.json, saved last, counts, and 1.json does not",
        "2.json: holds the same answers of ann as 0.json; counted once",
        "3.json: 12 answers missing or unusable",
        "'7' is not on the scale of 1 to 5; left out",
        "nothing is left of bob, who is not counted",
        "left out: 4.json: answers another questionnaire than this key",
    ):
        assert said in notes, notes
    # The page is passed on: no folder of this machine is in it.
    assert str(tmp_path) not in (tmp_path / "result" / "report.html").read_text()
    assert found["people"] == 1
    assert {row["mean"] for row in found["means"]} == {4.0} and {row["count"] for row in found["means"]} == {2}
    with pytest.raises(InputError, match="no usable answers in 1 files; left out"):
        collect_questionnaire([write(tmp_path / "b", foreign)], key=made, out=tmp_path / "other")
    with pytest.raises(InputError, match="something other than results"):
        collect_questionnaire([tmp_path / "a"], key=made, out=made)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda p: (p / "ours.webm").unlink(), "there is no file 'ours.webm'"),
        (lambda p: (p / "ours.webm").write_bytes(b"no video"), "is no WEBM file"),
        (
            lambda p: (p / "case.toml").write_text('prompt = "x"\nimage = "../a.jpg"\n[videos]\na = "a.mp4"'),
            "leads out",
        ),
        (lambda p: (p / "case.toml").write_text('prompt = "x"\nimage = "photo.jpg"\n'), "must name 1 to 8 videos"),
        (lambda p: (p / "case.toml").write_text('prompt = ""\n'), "prompt must be"),
        (lambda p: (p / "case.toml").write_text('text = "x"\n'), "'text' is not known"),
        (lambda p: (p / "case.toml").unlink(), "no such file; a case is"),
    ],
)
def test_bad_cases_are_refused_and_nothing_is_written(tmp_path, change, complaint):
    case = a_case(tmp_path, "apple")
    change(case)
    with pytest.raises(InputError, match=complaint):
        make_questionnaire([case], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_other_bad_requests(tmp_path):
    case = a_case(tmp_path, "apple")
    with pytest.raises(InputError, match="two cases are called 'apple'"):
        make_questionnaire([case, case], out=tmp_path / "out")
    with pytest.raises(InputError, match="something other than a questionnaire"):
        make_questionnaire([case], out=case)
    with pytest.raises(InputError, match="1 readable frame"):
        make_questionnaire([a_case(tmp_path, "still", frames=1)], out=tmp_path / "out")
    assert load_case(case).videos["ours"].name == "ours.webm"
    # MPEG-4 in an MP4: no browser shows more of it than a black box.
    out = cv2.VideoWriter(str(case / "ours.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 8, (80, 60))
    for level in (0, 100, 200):
        out.write(np.full((60, 80, 3), level, np.uint8))
    out.release()
    (case / "case.toml").write_text('prompt = "x"\nimage = "photo.jpg"\n[videos]\nours = "ours.mp4"\n')
    with pytest.raises(InputError, match=r"ours.mp4: is encoded as '\w+'; browsers play H.264"):
        make_questionnaire([case], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


KRIPPENDORFF_2011 = [
    [1, 2, 3, 3, 2, 1, 4, 1, 2, N, N, N],
    [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, N, 3],
    [N, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, N],
    [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, N],
]


@pytest.mark.parametrize(("level", "alpha"), [("nominal", 0.743), ("ordinal", 0.815), ("interval", 0.849)])
def test_alpha_is_that_of_krippendorffs_worked_example(level, alpha):
    assert krippendorff_alpha(np.array(KRIPPENDORFF_2011), level) == pytest.approx(alpha, abs=5e-4)


def test_alpha_of_chance_and_of_nothing():
    random = np.random.default_rng(0).integers(1, 6, (20, 400)).astype(float)
    assert krippendorff_alpha(random) == pytest.approx(0, abs=0.01)
    for undefined in (np.full((3, 4), 2.0), np.full((3, 4), N), np.array([[1.0, 2.0]])):
        assert math.isnan(krippendorff_alpha(undefined))


@given(wins=st.integers(0, 40), losses=st.integers(0, 40))
def test_the_sign_test_is_the_binomial_one(wins, losses):
    wanted = binomtest(wins, wins + losses).pvalue if wins + losses else 1.0
    assert sign_test(wins, losses) == pytest.approx(wanted)


@settings(max_examples=10)
@given(seed=st.integers(0, 100))
def test_intervals_hold_the_mean_and_grow_with_the_spread_of_people(seed):
    random = np.random.default_rng(seed)
    alike = random.normal(3, 0.1, (15, 8))
    differing = alike + random.normal(0, 1, (15, 1))
    low, high = bootstrap_interval(alike, CollectOptions(seed=seed))
    assert low <= alike.mean() <= high
    wide = bootstrap_interval(differing, CollectOptions(seed=seed))
    # The mean of 15 people who differ by 1 has a standard error of about 1/√15, its 95 % interval is 3.9 of those.
    assert 0.4 * 3.9 / 15**0.5 < wide[1] - wide[0] < 1.8 * 3.9 / 15**0.5
    assert wide[1] - wide[0] > 3 * (high - low)
