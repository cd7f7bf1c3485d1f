# SPDX-License-Identifier: GPL-3.0-or-later
"""The summary of a job: what it says, and that nothing that a job says becomes a part of the page's own language."""

import json
import os
import re
from html.parser import HTMLParser

import cv2
import numpy as np
from physgen.batch.farm.job_monitor import (
    HEIGHT,
    MOST_ROWS,
    STATES,
    Monitor,
    format_duration,
    make_strip,
    summarize,
    summary_page,
)
from physgen.batch.farm.planning.plan import Outcome, Plan, Task
from physgen.batch.farm.runners import ended_event, started_event
from physgen.batch.farm.task_records import log_path
from physgen.physgen_addon.frames.frame_files import Part, write_exr
from physgen.sim.version import VERSION

EVIL = '</pre><script>alert("x")</script><img src=x onerror=y>'


def plan_of(root, states=STATES):
    tasks = [
        Task(
            id=f"cup/v{i}/render-0001-0002",
            stage="render",
            argv=("render",),
            produces=(f"out/cup/v{i}/frames/0001.png", f"out/cup/v{i}/frames/0002.png"),
            farm_folder="out/.farm",
        )
        for i in range(len(states))
    ]
    meanings = {f"cup/v{i}": f"soft {EVIL}" for i in range(len(states))}
    return Plan(name=EVIL, root=root, version=VERSION, tasks=tuple(tasks), out="out", meanings=meanings)


class Tags(HTMLParser):
    def __init__(self, page):
        super().__init__()
        self.found, self.links = set(), []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.found.add(tag)
        self.links += [value for name, value in attributes if name in ("src", "href")]
        assert not [name for name, _ in attributes if name.startswith("on")]


def test_the_page_follows_a_job_and_says_how_it_ended(tmp_path):
    plan = plan_of(tmp_path)
    log = log_path(plan.tasks[4], tmp_path)
    log.parent.mkdir(parents=True)
    log.write_text(f"Cycles said {EVIL}\n")
    frame = tmp_path / plan.tasks[0].produces[1]
    frame.parent.mkdir(parents=True)
    cv2.imwrite(str(frame), np.full((30, 40, 3), 90, np.uint8))
    said = []
    monitor = Monitor(plan, said.append)
    page, data = tmp_path / "out" / "summary.html", tmp_path / "out" / "summary.json"
    outcomes = []
    for task, state in zip(plan.tasks, STATES, strict=True):
        monitor(started_event(task, "here", 1))
        outcomes.append(Outcome(task=task.id, state=state, exit_code=5, message=EVIL, attempts=3, seconds=2.5))
        monitor(ended_event(outcomes[-1]))
    assert "running" in page.read_text() and 'http-equiv="refresh"' in page.read_text(), "written while it runs"
    assert monitor.finish(outcomes, cancelled=False).state == "failed"
    text = page.read_text()
    tags = Tags(text)
    assert "script" not in tags.found and 'http-equiv="refresh"' not in text and "://" not in text
    assert text.count(EVIL) == 0 and text.count("&lt;script&gt;") >= len(STATES) + 3
    assert "ended with failures" in text and "Cycles said" in text and "code 5 · 3 attempts" in text
    there = [link for link in tags.links if (tmp_path / "out" / link).is_file()]
    assert "summary/cup/v0.jpg" in there and any(link.endswith("render-0001-0002.log") for link in there)
    found = json.loads(data.read_text())
    assert found["counts"] == dict.fromkeys(STATES, 1) and len(found["tasks"]) == len(STATES)
    assert [v["id"] for v in found["variants"] if v["strip"]] == ["cup/v0"]
    assert sum(e["event"] == "progress" for e in said) == len(STATES)


def test_a_large_job_has_a_page_that_can_still_be_opened(tmp_path):
    states = ["kept"] * (MOST_ROWS + 50) + ["failed"] * 60
    plan = plan_of(tmp_path, states)
    outcomes = {t.id: Outcome(task=t.id, state=s, message="m" * 50) for t, s in zip(plan.tasks, states, strict=True)}
    summary = summarize(plan, outcomes, started="2026-01-01T00:00:00+00:00", seconds=1, state="failed")
    page = summary_page(summary, lambda task: "x" * 4096, lambda task: "log")
    assert "10 more are in summary.json" in page and f"60 of {MOST_ROWS + 110}" in page
    assert len(re.findall("<tr>", page)) < 70 and len(page) < 3e6


def test_a_strip_is_made_again_only_for_other_frames(tmp_path):
    frames = [tmp_path / f"{i:04d}.png" for i in range(1, 10)]
    for i, path in enumerate(frames[:-1]):
        cv2.imwrite(str(path), np.full((60, 80, 3), 20 * i, np.uint8))
    frames[3].write_bytes(b"no picture")
    light = Part(name="picture", channels=("R", "G", "B"), pixels=np.full((60, 80, 3), 0.5, np.float32))
    frames.append(tmp_path / "0010.exr")
    write_exr(frames[-1], [light], fps=24.0)
    out = tmp_path / "summary" / "a.jpg"
    assert make_strip(frames, out)
    picture = cv2.imread(str(out))
    assert picture.shape[0] == HEIGHT and picture[5, 5].max() < 20, "the first"
    assert np.abs(picture[5, -5].astype(int) - 188).max() < 3, "the last is linear light"
    before = out.stat().st_mtime_ns
    assert make_strip(frames, out) and out.stat().st_mtime_ns == before
    cv2.imwrite(str(frames[0]), np.full((60, 80, 3), 255, np.uint8))
    assert make_strip(frames, out) and cv2.imread(str(out))[5, 5].min() > 200
    assert not make_strip([tmp_path / "none.png"], tmp_path / "b.jpg")
    # A stranger's job may have a named pipe there, without a writer.
    out.unlink()
    os.mkfifo(out)
    assert make_strip(frames, out) and out.is_file()
    assert [format_duration(s) for s in (0.04, 12.4, 200, 18123)] == ["0.0 s", "12 s", "3:20 min", "5:02 h"]
