# SPDX-License-Identifier: MIT
"""The pages as a browser lays them out: they fit a phone, a screen and paper, and no picture is broken."""

import os

import numpy as np
import pytest
from physgen.batch.farm.job_monitor import summarize, summary_page
from physgen.batch.farm.planning.plan import Outcome
from physgen.sim.diagnose.diagnosis import Provenance, RankedEffect
from physgen.sim.diagnose.fits import Estimate
from physgen.sim.diagnose.report import write_report
from physgen.sim.evaluate.evaluation import HIGHER, LOWER, Curve, Evaluation, Measure, Section
from physgen.sim.evaluate.judge_question import CRITERIA
from physgen.sim.evaluate.questionnaire_report import result_page
from physgen.sim.evaluate.report import page
from physgen.sim.html import page_head, prose, render
from physgen.sim.page_style import page_style
from physgen.sim.reconstruct import reconstruction_report

from .browser import PROGRAM, Browser
from .report_cases import case
from .test_farm_summary import plan_of

pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="no Chromium on this machine"),
    pytest.mark.skipif(os.name != "posix", reason="the browser is driven over a pipe"),
]

WIDE = """(() => {
  const room = document.documentElement.clientWidth;
  const inside = (e) => !!e && (getComputedStyle(e).overflowX !== "visible" || inside(e.parentElement));
  return [...document.querySelectorAll("body, body *")].filter((e) => {
    const box = e.getBoundingClientRect();
    const column = e.closest("main, header, footer") || document.body;
    return box.width && box.height && !inside(e)
      && box.right > Math.min(room, column.getBoundingClientRect().right) + 1;
  }).map((e) => e.tagName + " " + e.textContent.slice(0, 40));
})()"""
BROKEN = "[...document.images].filter((i) => !i.complete || !i.naturalWidth).length"
LONG = "predicts most held-out trials no better than the nominal model, although it closes most of the gap"


def diagnosis(folder):
    tether = RankedEffect(
        name="tether",
        kind="force",
        probability=0.05,
        parameters={f"anchor_{axis}": Estimate(value=-1.2345, unit="m", low=-1.4, high=-1.1) for axis in "xyz"},
        heldout_rms_m=0.0123,
        closed_fraction=0.12,
        reason=LONG,
    )
    found, capture = case()
    first, *_ = found.effects
    provenance = Provenance(
        capture="a" * 30, command="physgen diagnose a --out DIR --budget 20s", content_sha256="f" * 64
    )
    warnings = ("wind+adhesion, wind+rolling_resistance: not tried; give a larger --budget or --work",)
    found, capture = case(effects=(first, tether), provenance=provenance, warnings=warnings)
    write_report(found, capture, folder)
    return folder / "report.html"


def evaluation(folder):
    times = np.linspace(0, 2, 20)
    measures = tuple(
        Measure(name=f"figure_{i}", title="Error of the frame between, where it moves (DIS flow)", value=10.0**-i,
                unit="of 255", better=better, still=0.5, note="any motion lowers it: read it beside how much moves")
        for i, better in enumerate((HIGHER, LOWER))
    )  # fmt: skip
    curves = tuple(
        Curve(name="figure_0", title="Error", label=f"curve {i}", times=times, values=times * i) for i in (1, 2)
    )
    notice = "0002 is not compared: 0002_testing-videos_30FPS_perspective-center_take-1_trimmed-ball-and-block-fall.mp4"
    section = Section(
        name="alone", title="Without a real video", text="frames", measures=measures, curves=curves, notices=(notice,)
    )
    strip = [np.full((60, 80, 3), 30 * i, np.uint8) for i in range(8)]
    path = folder / "evaluation.html"
    path.write_text(page(Evaluation(root=folder, subject="video.mp4", sections=(section,)), strip))
    return path


def questionnaire(folder):
    videos = ("ours", "a long name of a method v1.5 with fifty-nine letters in it all")
    values = {"mean": 2.37, "low": 1.78, "high": 2.93, "count": 27}
    means = [{"video": video, "criterion": c, **values} for video in videos for c in CRITERIA]
    means[-1] |= {"mean": None, "low": None, "high": None, "count": 0}
    pair = {"wins": 12, "losses": 108, "ties": 36, "p": 0.0001, "people_for_first": 10, "people_for_second": 12}
    found = {
        "people": 12, "cases": 40, "confidence": 0.95, "resamples": 2000, "means": means, "made_by": "1",
        "notes": ["left out: answers_person_with_a_rather_long_code_of_40_letters.json: answers another questionnaire"],
        "preferences": [
            {"first": videos[0], "second": videos[1], "criterion": c, **pair, "p_people": 0.8} for c in CRITERIA
        ],
        "agreement": [{"criterion": c, "ordinal": 0.34, "interval": None} for c in CRITERIA],
    }  # fmt: skip
    path = folder / "questionnaire.html"
    path.write_text(result_page(found))
    return path


def farm(folder):
    states = ("done", "failed", "running")
    plan = plan_of(folder, states)
    outcomes = {
        task.id: Outcome(
            task=task.id, state=state, exit_code=5, message="no memory " + "m" * 80, attempts=3, worker="w" * 30
        )
        for task, state in zip(plan.tasks, states, strict=True)
    }
    summary = summarize(plan, outcomes, started="2026-01-01T00:00:00+00:00", seconds=1, state="failed")
    path = folder / "summary.html"
    path.write_text(summary_page(summary, lambda task: "x" * 300, lambda task: "log"))
    return path


def reconstruction(folder):
    pictures = [
        reconstruction_report._figure(np.full((90, 120, 3), 90, np.uint8), "cup, seen from behind") for _ in "abc"
    ]
    wide = reconstruction_report._figure(np.full((300, 1200, 3), 90, np.uint8), "photo and clean plate")
    columns = ("object", "material", "Young's modulus", "density", "friction", "mass", "velocity")
    section = reconstruction_report.Section(
        title="Physics", text="What is simulated.", gallery=pictures, figures=[wide],
        facts=[("Camera", "31.4° down", "estimated from lines; --pitch overrides it")],
        columns=columns, rows=[["coffee_mug_on_a_saucer", *("1.0000e+05 Pa" for _ in columns[1:])]],
    )  # fmt: skip
    path = folder / "reconstruction.html"
    head = page_head("Reconstruction", page_style() + reconstruction_report._EXTRA)
    values = {
        "title": "cup",
        "notices": ["scale: guessed; give --size METRES"],
        "version": "1",
        "prose": prose,
        "sections": [section],
    }
    path.write_text(render(reconstruction_report._TEMPLATE, head=head, **values))
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    found = Browser(tmp_path_factory.mktemp("browser"))
    yield found
    found.close()


@pytest.mark.parametrize("made", [diagnosis, evaluation, farm, questionnaire, reconstruction])
def test_a_page_fits_a_screen_a_phone_and_paper(made, browser, tmp_path):
    path = made(tmp_path)
    # The last is A4 without the margins of a browser.
    for width, media in ((1280, "screen"), (390, "screen"), (717, "print")):
        browser.call("Emulation.setEmulatedMedia", media=media)
        browser.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=844, deviceScaleFactor=1, mobile=width < 500
        )
        browser.call("Page.navigate", url=path.as_uri())
        browser.wait(f"document.readyState === 'complete' && location.pathname.endsWith('{path.name}')")
        assert browser.run("document.documentElement.scrollWidth") <= width
        assert browser.run(WIDE) == []
        assert browser.run(BROKEN) == 0
        # On paper a table is a table and no list.
        hidden = "[...document.querySelectorAll('thead')].some((e) => getComputedStyle(e).position === 'absolute')"
        assert width == 390 or not browser.run(hidden)
        # A flag that is torn at its hyphens cannot be read as one.
        assert browser.run("[...document.querySelectorAll('.flag')].every((f) => f.getClientRects().length === 1)")
