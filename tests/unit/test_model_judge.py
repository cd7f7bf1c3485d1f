# SPDX-License-Identifier: MIT
"""A model as judge of videos, asked over HTTP on this machine: what is sent, what is read, what is said."""

import base64
import io
import json
import math
import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.errors import InputError
from physgen.sim.evaluate.judge_question import CRITERIA, question, read_scores
from physgen.sim.evaluate.model_judge import JudgeOptions, evenly_sampled, judge_videos
from physgen.sim.reconstruct.reasoning.chat_client import ChatRequest
from PIL import Image

from .chat_server import Server, completion, send

KEY = "sk-secret-0123456789abcdef"
PROMPT = "Red apple rolls on the table."
GREY = {"clip_dark": 40, "clip_middle": 120, "clip_light": 220}
PHOTO = np.full((30, 40, 3), 250, np.uint8)


def line(number, physical, photo, semantic):
    return (
        f"Video {number}: Physical Realism Score: {physical}; Photorealism Score: {photo}; "
        f"Semantic Consistency Score: {semantic};"
    )


def videos(frames=12):
    return {name: [np.full((30, 40, 3), grey, np.uint8)] * frames for name, grey in GREY.items()}


def seen(body):
    """What a judge sees: the texts, and the mean grey of the pictures after each."""
    parts = json.loads(body)["messages"][0]["content"]
    texts, greys = [], []
    for part in parts:
        if part["type"] == "text":
            texts.append(part["text"])
            greys.append([])
        else:
            data = base64.b64decode(part["image_url"]["url"].split(",")[1])
            greys[-1].append(round(float(np.asarray(Image.open(io.BytesIO(data))).mean())))
    return texts, greys


def honest(handler, number):
    """Scores each video by how bright it is, whatever its number, and less in every further question."""
    _, greys = seen(handler.server_body)
    lines = [line(i + 1, round(g[0] / 250 - 0.01 * number, 3), 0.5, 1) for i, g in enumerate(greys[2:])]
    send(handler, completion("\n".join(lines)))


class Judge(Server):
    """A server whose answer may depend on what it was sent."""

    def __init__(self, behave):
        def remembering(handler, number):
            handler.server_body = self.received[number][2]
            behave(handler, number)

        super().__init__(remembering)


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("PHYSGEN_API_KEY", KEY)


def judge(url, notices=None, given=None, **options):
    request = ChatRequest(url=url, model="m", consent=True, timeout_s=5, retries=0, backoff_s=0.01)
    said = [] if notices is None else notices
    return judge_videos(given or videos(), PHOTO, PROMPT, request, options=JudgeOptions(**options), notice=said.append)


def test_all_videos_are_judged_together_in_another_order_each_time():
    notices = []
    with Judge(honest) as server:
        found = judge(server.url, notices, repetitions=6)
    assert len(server.received) == 6 and len(set(found.orders)) > 1
    for (_, headers, body), order in zip(server.received, found.orders, strict=True):
        texts, greys = seen(body)
        assert headers["Authorization"] == f"Bearer {KEY}" and KEY.encode() not in body
        assert not any(name in body.decode() for name in GREY), "the names of the videos would tell the judge"
        assert PROMPT in texts[0] and "3 videos" in texts[0] and "nothing moves must lose points" in texts[0]
        assert len(greys[1]) == 1 and greys[1][0] == pytest.approx(250, abs=2)
        assert [round(np.mean(grey)) for grey in greys[2:]] == pytest.approx([GREY[name] for name in order], abs=2)
        assert [len(grey) for grey in greys[2:]] == [10, 10, 10]
        assert "temperature" not in json.loads(body)
    for name, grey in GREY.items():
        score = found.scores[name]["physical_realism"]
        # A judge that looks at the pictures gives each video its own score, whichever number it had.
        wanted = [round(grey / 250 - 0.01 * n, 3) for n in range(6)]
        assert score.values == pytest.approx(wanted, abs=0.01)
        assert score.spread == pytest.approx(np.std(score.values, ddof=1))
        assert found.scores[name]["photorealism"].spread == 0
    assert not found.notes and "60 frames" not in notices[0] and "30 frames of 3 videos" in notices[0]
    assert KEY not in json.dumps(found.to_json()) + "".join(notices)
    again = dict.fromkeys(found.orders)
    with Judge(honest) as server:
        assert dict.fromkeys(judge(server.url, repetitions=6).orders) == again, "orders follow from the seed"


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        ("I liked the second video best, the physics felt right.", "no line of scores in the answer, which begins"),
        ("\n".join([line(1, 0.5, 0.5, 0.5), line(2, 8, 0.5, 0.5), line(3, 0, 1, 0)]), "physical realism is '8'"),
        ("\n".join([line(1, 0.5, "8/10", 0.5), line(2, 0, 0, 0), line(3, 0, 1, 0)]), "photorealism is '8 /10'"),
        ("\n".join([line(1, 0.5, "90%", 0.5), line(2, 0, 0, 0), line(3, 0, 1, 0)]), "photorealism is '90 %'"),
        ("\n".join([line(1, 0.5, "1 out of 10", 0.5), line(2, 0, 0, 0), line(3, 0, 1, 0)]), "'1 out of 10'"),
        ("\n".join([line(1, 0.5, "0.4-0.6", 0.5), line(2, 0, 0, 0), line(3, 0, 1, 0)]), "'0.4 -0.6'"),
        ("\n".join([line(1, -0.1, 0.5, 0.5), line(2, 0, 0, 0), line(3, 0, 1, 0)]), "physical realism is '-0.1'"),
        ("\n".join([line(1, 0.5, 0.5, "high"), line(2, 0, 0, 0), line(3, 0, 1, 0)]), "consistency without a number"),
        ("\n".join([line(1, 0.5, 0.5, 0.5), line(2, 0.5, 0.5, 0.5)]), "video 3: no line in the answer"),
        ("\n".join([line(i, 0.5, 0.5, 0.5) for i in (1, 2, 3, 4)]), "video 4: there are 3; left out"),
        ("\n".join([line(i, 0.5, 0.5, 0.5) for i in (1, 2, 3, 3)]), "video 3: answered more than once"),
    ],
)
def test_answers_outside_of_scale_and_form_are_asked_for_again_and_said(answer, complaint):
    good = "\n".join(line(i, 0.25, 0.5, 0.75) for i in (1, 2, 3))
    with Judge(lambda h, n: send(h, completion(answer if n == 0 else good))) as server:
        found = judge(server.url, repetitions=1)
    assert any(complaint in note and note.startswith("answer 1: ") for note in found.notes), found.notes
    if "left out" in complaint and "there are" in complaint:
        # All that was asked for is there: nothing to ask again.
        assert len(server.received) == 1
        return
    assert len(server.received) == 2
    assert [found.scores["clip_dark"][name].values for name in CRITERIA] == [(0.25,), (0.5,), (0.75,)]
    assert found.answers == ((answer, good),)


def test_what_stays_unreadable_has_no_score_and_is_said():
    bad = "\n".join([line(1, 0.5, 0.5, 0.5), line(2, 2, 0.5, 0.5), line(3, 0.5, 0.5, 0.5)])
    with Judge(lambda h, n: send(h, completion(bad))) as server:
        found = judge(server.url, repetitions=2, attempts=2)
    assert len(server.received) == 4
    lost = [order[1] for order in found.orders]
    for name in GREY:
        assert len(found.scores[name]["photorealism"].values) == 2 - lost.count(name)
    assert sum("has one value less" in note for note in found.notes) == 2
    with Judge(lambda h, n: send(h, completion("no"))) as server:
        nothing = judge(server.url, repetitions=1, attempts=1)
    assert math.isnan(nothing.scores["clip_dark"]["photorealism"].mean)
    assert nothing.to_json()["videos"]["clip_dark"]["photorealism"] == {"mean": None, "spread": None, "values": []}


def test_no_answer_at_all_is_an_error_without_the_key():
    with Server(lambda h, n: send(h, b"{}", status=500)) as server, pytest.raises(InputError) as caught:
        judge(server.url)
    assert "the videos were not judged" in str(caught.value) and KEY not in repr(caught.value)
    with Server(lambda h, n: send(h, completion(""))) as server, pytest.raises(InputError, match="holds no text"):
        judge(server.url)


def test_an_endpoint_that_falls_silent_does_not_cost_the_answers_before():
    def tires(handler, number):
        if number < 2:
            honest(handler, number)
        else:
            send(handler, b"{}", status=404)

    with Judge(tires) as server:
        found = judge(server.url, repetitions=5)
    assert len(server.received) == 3 and len(found.answers) == 3 and found.answers[2] == ()
    for of in found.scores.values():
        assert all(len(score.values) == 2 for score in of.values())
    assert any("answer 3: " in note and "404" in note for note in found.notes)
    assert "2 of 5 repetitions were not asked: the endpoint does not answer" in found.notes


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({}, "0 videos"),
        ({str(i): videos()["clip_dark"] for i in range(9)}, "9 videos"),
        ({"still": videos()["clip_dark"][:1]}, "still: video has 1 frame: give at least 2"),
        ({"odd": [np.zeros((4, 4), np.uint8)] * 3}, "give \\(H, W, 3\\) uint8"),
    ],
)
def test_bad_videos_are_refused_before_anything_is_sent(given, complaint):
    request = ChatRequest(url="http://127.0.0.1:9", model="m", consent=True)
    with pytest.raises(InputError, match=complaint):
        judge_videos(given, PHOTO, PROMPT, request)
    with pytest.raises(InputError, match="prompt has"):
        judge_videos(videos(), PHOTO, "  ", request)


@pytest.mark.parametrize("change", [{"repetitions": 0}, {"attempts": 9}, {"frames": 1}, {"temperature": 3.0}])
def test_options_out_of_range_are_refused(change):
    with pytest.raises(InputError, match=f"judge option {next(iter(change))}"):
        JudgeOptions(**change)


@given(count=st.integers(2, 500), wanted=st.integers(2, 32))
def test_sampled_frames_are_even_and_reach_both_ends(count, wanted):
    numbers = evenly_sampled(count, wanted)
    assert numbers[0] == 0 and numbers[-1] == count - 1 and len(numbers) == min(count, wanted)
    steps = np.diff(numbers)
    assert steps.min() >= 1 and steps.max() - steps.min() <= 1


SCORE = st.integers(0, 100).map(lambda n: n / 100)


@given(
    scores=st.lists(st.tuples(SCORE, SCORE, SCORE), min_size=1, max_size=8),
    form=st.sampled_from(["plain", "markdown", "brackets", "json", "broken lines"]),
)
def test_every_usual_form_of_an_answer_is_read_exactly(scores, form):
    text = "\n".join(line(i, *values) for i, values in enumerate(scores, start=1))
    if form == "markdown":
        text = "Here you are:\n\n" + re.sub(r"(Video \d+:)", r"- **\1**", text) + "\n"
    elif form == "brackets":
        text = re.sub(r"Score: ([\d.]+)", r"Score: [\1]", text)
    elif form == "json":
        text = json.dumps(
            {f"video {i}": dict(zip(CRITERIA, values, strict=True)) for i, values in enumerate(scores, start=1)}
        )
    elif form == "broken lines":
        text = "<think>Video 1: Photorealism 0.1</think>" + text.replace("; ", ";\n   ")
    read = read_scores(text, len(scores))
    assert read.problems == ()
    assert [tuple(found[name] for name in CRITERIA) for found in read.scores] == scores


@given(text=st.text(max_size=300) | st.text("video 123:;.realism photosemantic consistency\n0", max_size=300))
def test_no_answer_breaks_the_reader(text):
    read = read_scores(text, 2)
    assert all(s is None or all(0 <= v <= 1 for v in s.values()) for s in read.scores)
    assert read.problems or None not in read.scores


def test_the_question_keeps_to_one_line_of_prompt():
    text = question(1, 10, "a\n'quoted' line\x1b[0m")
    assert "one video" in text and "a ’quoted’ line [0m" in text and "\x1b" not in text


def a_video(path, grey):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"VP80"), 8, (64, 48))
    for frame in range(12):
        picture = np.full((48, 64, 3), grey, np.uint8)
        cv2.circle(picture, (8 + 4 * frame, 24), 6, (30, 200, 240), -1)
        writer.write(picture)
    writer.release()
    return path


def test_the_command_judges_files_beside_a_still_one_and_only_with_consent(tmp_path, capsys):
    ours, other = a_video(tmp_path / "first_clip.webm", 60), a_video(tmp_path / "second_clip.webm", 180)
    command = ["evaluate", str(ours), "--out", str(tmp_path / "out"), "--repetitions", "3", "--beside", str(other)]
    with Judge(honest) as server:
        asked = [*command, "--judge", server.url, "--judge-model", "m", "--prompt", PROMPT]
        assert main(asked) == 3 and "give --send-frames" in capsys.readouterr().err
        assert not server.received and not (tmp_path / "out").exists()
        assert main([*command, "--send-frames"]) == 3 and "need --judge URL" in capsys.readouterr().err
        assert main([*asked, "--send-frames"]) == 0
    assert len(server.received) == 3
    assert not any(b"clip" in body for _, _, body in server.received)
    assert all(len(seen(body)[1]) == 5 for _, _, body in server.received), "two videos, and one that stands still"
    sections = json.loads((tmp_path / "out" / "evaluation.json").read_text())["sections"]
    found = {row["name"]: row for section in sections for row in section["measures"]}
    assert found["judge_physical_realism"]["value"] == pytest.approx(60 / 250 - 0.01, abs=0.05)
    assert found["judge_physical_realism"]["still"] == pytest.approx(60 / 250 - 0.01, abs=0.05)
    assert found["judge_physical_realism: second_clip.webm"]["value"] == pytest.approx(180 / 250 - 0.01, abs=0.05)
    kept = json.loads((tmp_path / "out" / "judge.json").read_text())
    assert len(kept["answers"]) == 3 and kept["model"] == "m"
    shown = "".join(p.read_text(errors="replace") for p in (tmp_path / "out").iterdir() if p.is_file())
    assert KEY not in shown and "Judged by a model" in (tmp_path / "out" / "report.html").read_text()


def test_what_is_wrong_with_an_answer_is_said_once(tmp_path, capsys):
    ours = a_video(tmp_path / "clip.webm", 60)
    with Judge(lambda h, n: send(h, completion("Lovely, all of them."))) as server:
        asked = [
            "evaluate",
            str(ours),
            "--judge",
            server.url,
            "--judge-model",
            "m",
            "--prompt",
            PROMPT,
            "--send-frames",
        ]
        assert main([*asked, "--repetitions", "1", "--out", str(tmp_path / "out")]) == 0
    said = "".join(capsys.readouterr())
    assert said.count("answer 1: no line of scores") == 1
    assert "answer 1: no line of scores" in (tmp_path / "out" / "report.html").read_text()
