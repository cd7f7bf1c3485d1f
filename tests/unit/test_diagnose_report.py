# SPDX-License-Identifier: MIT
"""The report comes out of any diagnosis, holds nothing foreign, and says what is true."""

import base64
import dataclasses
import hashlib
import json
import math
import re
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from pathlib import Path
from unittest.mock import patch

import numpy as np
import physgen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.app.explain import title_of_cause
from physgen.sim.diagnose.capture import Camera, Capture, CaptureObject, Ground, ObjectBelief, Trial
from physgen.sim.diagnose.diagnosis import (
    Diagnosis,
    Estimate,
    Gap,
    IntervalShare,
    Localisation,
    ObjectShare,
    RankedEffect,
    TrialArrays,
    Verdict,
)
from physgen.sim.diagnose.provenance import Provenance
from physgen.sim.diagnose.report import diagnosis_figures, parameter_text, write_report
from physgen.sim.diagnose.report.diagnosis_charts import Scale, _apart, bands, timeline_picture
from physgen.sim.diagnose.report.diagnosis_figures import growth
from physgen.sim.diagnose.report.diagnosis_page import scene_effects
from physgen.sim.diagnose.report.number_format import number_text, percent_text, quantity_text
from physgen.sim.diagnose.report.object_heatmaps import object_scores
from physgen.sim.diagnose.report.trajectory_plots import camera_plane
from physgen.sim.diagnose.report.wording import headline
from physgen.sim.diagnose.verification_run import VerificationRun
from physgen.sim.effects.registry import effects
from physgen.sim.html import Picture, clean, element, text

NAN = math.nan
FILES = {"report.html", "timeline.svg", "object.svg", "ranking.svg", "gap.svg", "tracks.svg"}
HOSTILE = "<script>alert(1)</script>\"'&]]> \u202egnp\x00\ud800" + "x" * 300
SVG = "{http://www.w3.org/2000/svg}"

CORNERS = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)
CAMERA = Camera(
    width=640,
    height=480,
    fx=500.0,
    fy=500.0,
    cx=320.0,
    cy=240.0,
    world_from_camera=((1.0, 0, 0, 0), (0, 0, 1.0, -3.0), (0, -1.0, 0, 0.5), (0, 0, 0, 1.0)),
)


def cube(name="cube"):
    belief = ObjectBelief(name=name, mesh="cube.obj", density_kg_m3=200.0, stiffness="hard")
    return CaptureObject(belief=belief, vertices=CORNERS, faces=FACES)


def take(name="take01", *, role="fit", frames=20, points=8, camera=None, seed=0):
    """A thrown cube, and what a model without and with drag makes of it."""
    random = np.random.default_rng(seed)
    times = 0.1 + np.arange(frames) / 100
    wanted = times[-1] + 0.01 * np.arange(1, 11) if role == "predict" else None
    rest = CORNERS[np.arange(points) % 8]

    def way(t, drag):
        s = (t - 0.1)[:, None]
        return np.array([0, 0, 1.0]) + s * [2, 0, 1] - s**2 * [drag, 0, 4.905] + 0 * s

    nominal, found = (way(times, d)[:, None] + rest for d in (0.0, 0.8))
    points3 = found + random.normal(0, 1e-3, found.shape)
    points3[random.random(points3.shape[:2]) < 0.1] = NAN
    pixels = None
    residual = points3 - nominal
    if camera is not None:
        pixels = camera_plane(camera)(points3)
        residual = pixels - camera_plane(camera)(nominal)
    trial = Trial(
        name=name,
        role=role,
        times=times,
        points=None if pixels is not None else points3,
        pixels=pixels,
        object_index=np.zeros(points, dtype=np.int64),
        rest_points=rest,
        predict_times=wanted,
    )
    score = 1.6 + 0.1 * random.random(frames)
    arrays = TrialArrays(
        times=times,
        frame_score=score,
        point_score=np.tile(score[:, None], (1, points)),
        residual=residual,
        nominal=nominal,
        found=found,
        before=None if wanted is None else way(wanted, 0.0)[:, None] + rest,
        after=None if wanted is None else way(wanted, 0.8)[:, None] + rest,
    )
    return trial, arrays


def case(*takes, objects=None, camera=None, **changes):
    """A diagnosis of air drag and its capture; ``changes`` replace fields of the diagnosis."""
    takes = takes or (take(camera=camera), take("take02", role="predict", seed=1, camera=camera))
    objects = objects or (cube(),)
    capture = Capture(
        gravity=(0.0, 0.0, -9.81),
        ground=Ground(),
        objects=objects,
        noise_sigma=1e-3 if camera is None else 0.5,
        camera=camera,
        trials=tuple(t for t, _ in takes),
    )
    drag = Estimate(value=0.0405, unit="1/m", low=0.0381, high=0.0429)
    diagnosis = Diagnosis(
        verdict=Verdict(effect="air_drag", probability=0.93, alternatives=("wind",), effects=("air_drag",)),
        effects=(
            RankedEffect(
                name="air_drag",
                kind="force",
                probability=0.93,
                parameters={"drag_per_mass": drag},
                heldout_rms_m=0.0027,
                closed_fraction=0.98,
            ),
            RankedEffect(name="wind", kind="force", probability=0.06),
            RankedEffect(name="none", kind="none", probability=0.01),
        ),
        gap=Gap(
            before_rms_m=0.054,
            refitted_rms_m=0.015,
            after_rms_m=0.0027,
            noise_floor_rms_m=0.0017,
            closed_fraction=0.98,
            closed_fraction_ci95=(0.96, 0.99),
            resolvable=True,
            numerics_rms_m=4e-4,
        ),
        controls={"wrong_effect_rms_m": 0.014, "last_residual_rms_m": 0.041},
        next_experiment="Throw it both ways.",
        where=Localisation(
            objects=tuple(ObjectShare(name=o.name, share=1 / len(objects)) for o in objects),
            intervals=tuple(
                IntervalShare(trial=t.name, start_s=0.1, end_s=0.2, phase="flight", share=0.5) for t, _ in takes
            ),
            direction={"normal": 0.0, "along_velocity": 0.9, "along_gravity": 0.05, "other": 0.05},
        ),
        trials={t.name: a for t, a in takes},
        summary="The air slows it down.",
    )
    return dataclasses.replace(diagnosis, **changes), capture


def written(diagnosis, capture, out):
    """The page's text and the names of all files, once they have been held to what every report must be."""
    write_report(diagnosis, capture, out)
    for path in out.iterdir():
        check(path.name, path.read_text(encoding="utf-8"))
    return (out / "report.html").read_text(encoding="utf-8"), {path.name for path in out.iterdir()}


class _Page(HTMLParser):
    """Tags opened and closed, attributes, and text outside of style."""

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.said, self.tags = [], [], "", set()

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.attributes += attributes
        if tag != "meta":
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.tags.add(tag)
        self.attributes += attributes

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.said += data


def check(name, content):
    """Well-formed, nothing from outside, nothing that runs, every picture with a title and a description."""
    tree = ElementTree.fromstring(content.removeprefix("<!DOCTYPE html>\n"))
    page = _Page()
    page.feed(content.partition("?>\n")[2] if name.endswith(".svg") else content)
    assert page.open == []
    assert not page.tags & {"script", "iframe", "object", "embed", "link", "base", "form", "img", "use", "b"}
    identifiers = [value for key, value in page.attributes if key == "id"]
    assert len(identifiers) == len(set(identifiers))
    for key, value in page.attributes:
        assert not key.startswith("on") and key not in ("src", "srcset", "action", "style")
        assert key not in ("href", "xlink:href") or value.startswith("data:image/png;base64,")
        assert key != "aria-labelledby" or set(value.split()) <= set(identifiers)
    assert "url(" not in content and "@import" not in content
    assert not re.search(r"https?:", content.replace('xmlns="http://www.w3.org/2000/svg"', ""))
    for d in re.findall(r' d="([^"]*)"', content):
        assert "nan" not in d and "inf" not in d
    space = SVG if name.endswith(".svg") else ""
    for picture in tree.iter(f"{space}svg"):
        if picture.get("aria-hidden") != "true":
            assert [picture[0].tag, picture[1].tag] == [f"{space}title", f"{space}desc"]
            assert picture[0].text and picture[1].text
    assert not re.search("[\x00-\x08\x0b\x0c\x0e-\x1f\u202e\ud800-\udfff]", content)
    return page


def said(page):
    """All text of the page."""
    return check("report.html", page).said


def test_a_report_is_whole_and_says_the_verdict(tmp_path):
    page, names = written(*case(), tmp_path / "out")
    assert names == FILES
    text = said(page)
    assert "Air drag: very likely the cause" in text and "The air slows it down." in text
    assert "54\u00a0mm" in text and "2.7\u00a0mm" in text and "Throw it both ways." in text
    assert "cannot distinguish it from wind" in text
    assert "drag per mass 0.0405\u00a01/m (95\u00a0%: 0.0381 to 0.0429)" in text
    assert '{"name": "air_drag", "parameters": {"drag_per_mass": 0.0405}}' in text
    assert "Add Effect and Bake" in text


def test_the_page_may_load_and_run_nothing(tmp_path):
    page, _ = written(*case(), tmp_path)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page).group(1).replace("&#x27;", "'")
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy and "script-src" not in policy
    # The hash in the policy is that of the very style in the page, or browsers would drop it.
    style = re.search(r"<style>(.*?)</style>", page, re.S).group(1)
    assert f"'sha256-{base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()}'" in policy


def test_the_same_diagnosis_gives_the_same_bytes(tmp_path):
    written(*case(), tmp_path / "a")
    written(*case(), tmp_path / "b")
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_hostile_names_stay_text(tmp_path):
    first = take(HOSTILE)
    diagnosis, capture = case(
        first,
        take("](javascript:x)"),
        objects=(cube(HOSTILE), cube("{{7*7}}")),
        summary=HOSTILE,
        warnings=(HOSTILE,),
        next_experiment=HOSTILE,
        confirmation={HOSTILE: HOSTILE, "agrees": True, "rms": 0.1},
        controls={HOSTILE: 0.1},
        verdict=Verdict(effect=HOSTILE, probability=0.5, alternatives=(HOSTILE,), effects=(HOSTILE,)),
        effects=(
            RankedEffect(
                name=HOSTILE,
                kind=HOSTILE,
                probability=1.0,
                parameters={HOSTILE: Estimate(value=1.0, unit=HOSTILE, low=0.0, high=2.0)},
            ),
        ),
    )
    page, _ = written(diagnosis, capture, tmp_path)
    assert "<script>alert(1)</script>" in said(page)


@pytest.mark.parametrize("effect", ["none", "unknown"])
def test_a_verdict_without_effect_adds_nothing(effect, tmp_path):
    verdict = Verdict(effect=effect, probability=0.9)
    gap = Gap(
        before_rms_m=0.0018,
        refitted_rms_m=0.0018,
        after_rms_m=0.0018,
        noise_floor_rms_m=0.0017,
        closed_fraction=NAN,
        closed_fraction_ci95=(NAN, NAN),
        resolvable=False,
    )
    diagnosis, capture = case(verdict=verdict, gap=gap, next_experiment=None)
    text = said(written(diagnosis, capture, tmp_path)[0])
    assert "not resolvable" in text and "There is nothing to add" in text
    assert "Add Effect" not in text and '"effects"' not in text
    wanted = {"none": "Nothing is missing", "unknown": "none of the known effects"}[effect]
    assert wanted in text


def _gap(before, after, floor):
    return Gap(
        before_rms_m=before, refitted_rms_m=before, after_rms_m=after, noise_floor_rms_m=floor, noise_rms_m=floor,
        grain_rms_m=0.0, closed_fraction=(before - after) / (before - floor), closed_fraction_ci95=(NAN, NAN),
        resolvable=True,
    )  # fmt: skip


def test_an_error_far_above_noise_is_never_called_nothing(tmp_path):
    """28 mm stood below “Nothing is missing” beside a floor of 9 mm."""
    diagnosis, capture = case(verdict=Verdict(effect="none", probability=0.9), gap=_gap(0.028, 0.028, 0.009))
    text = said(written(diagnosis, capture, tmp_path)[0])
    assert "No known effect stands out, and an error of 28\u00a0mm is left" in text
    assert "What is left is above the noise" in text and "mostly noise" not in text
    assert title_of_cause(diagnosis) == "no effect stands out"
    for words in ("Nothing is missing", "that nothing is missing", "No effect needs", "keep the scene as it is"):
        assert words not in text


@pytest.mark.parametrize(("after", "times"), [(0.086, "2.0"), (0.045, None)])
def test_a_cause_that_leaves_much_is_not_the_whole_one(after, times, tmp_path):
    text = said(written(*case(gap=_gap(0.179, after, 0.043)), tmp_path)[0])
    assert ("not the whole cause" in text) == (times is not None)
    assert times is None or f"is {times} times what noise" in text


def test_a_verification_run_is_a_table_with_units(tmp_path):
    run = VerificationRun(
        trial="take01",
        seconds_s=0.5,
        before_rms_m=0.0412,
        after_rms_m=0.0031,
        numerics_rms_m=0.0007,
        against_model_rms_m=0.0029,
    )
    confirmation = {"takes": [dataclasses.asdict(run) | {"word": run.word}]}
    text = said(written(*case(confirmation=confirmation), tmp_path)[0])
    assert "rms_m" not in text and "{'" not in text
    for word in ("take01", "0.500 s", "41.2\u00a0mm", "3.10\u00a0mm", "0.700\u00a0mm", "confirmed"):
        assert word in text, word


def test_a_cause_that_does_not_beat_its_controls_is_called_so(tmp_path):
    good, capture = case()
    assert "not a cause" not in said(written(good, capture, tmp_path / "good")[0])
    bad, capture = case(controls={"wrong_effect_rms_m": 0.002, "last_residual_rms_m": 0.04})
    assert "is not a cause" in said(written(bad, capture, tmp_path / "bad")[0])


def test_observation_effects_are_not_added_to_a_scene():
    clock = RankedEffect(
        name="time_scale",
        kind="observation",
        probability=1.0,
        parameters={"rate": Estimate(value=1.1, unit="1", low=1.0, high=1.2)},
    )
    verdict = Verdict(effect="time_scale", probability=1.0, effects=("time_scale",))
    assert scene_effects(case(effects=(clock,), verdict=verdict)[0]) == []


def test_the_entry_for_a_scene_is_what_the_effect_accepts():
    (entry,) = scene_effects(case()[0])
    assert effects()[entry["name"]].checked(entry["parameters"]) == {"drag_per_mass": 0.0405}
    assert json.loads(json.dumps(entry)) == entry


def test_pixels_are_drawn_as_the_camera_saw_them(tmp_path):
    diagnosis, capture = case(camera=CAMERA)
    assert "As the camera saw it." in said(written(diagnosis, capture, tmp_path)[0])
    data = growth(diagnosis, capture)
    assert data.unit == "px"
    assert np.nanmax(data.found) < 2 * 0.5 * math.sqrt(2) < np.nanmax(data.nominal)


def test_the_error_grows_as_the_drag_that_is_missing():
    diagnosis, capture = case(take(frames=60))
    data = growth(diagnosis, capture)
    np.testing.assert_allclose(data.nominal[-1], 0.8 * 0.59**2, rtol=0.02)
    assert np.nanmax(data.found) < 0.004


def test_a_trial_in_which_no_force_is_missing_has_no_worst_moment():
    """The page named 0.000 s and 0 m/s² for a single point that flies as believed."""
    name, arrays = take()
    still = dataclasses.replace(arrays, frame_score=np.zeros_like(arrays.frame_score))
    diagnosis, capture = case((name, still))
    assert bands(diagnosis, capture)[0].worst is None
    assert "nowhere above zero" in timeline_picture(diagnosis, capture, width=900.0).description


def test_a_force_that_shows_at_no_moment_has_no_place_and_no_direction(tmp_path):
    """A thrown ball: “25 % along the ground normal, 25 % along the motion …” of a force of 0 m/s² at any time."""
    takes = [(n, dataclasses.replace(a, frame_score=np.zeros_like(a.frame_score))) for n, a in (take(), take("two"))]
    reason = "what it leaves of whole trials bends as under a missing force"
    diagnosis, capture = case(
        *takes,
        verdict=Verdict(effect="unknown", probability=0.86),
        effects=(RankedEffect(name="none", kind="none", probability=0.14, reason=reason),),
        gap=dataclasses.replace(_gap(0.021, 0.021, 0.020), closed_fraction=NAN, resolvable=False),
    )
    page = said(written(diagnosis, capture, tmp_path)[0])
    assert "At no single moment" in page and "Direction of the missing force" not in page
    assert f"The nominal model is ruled out: {reason}." in page and "and hardly in held-out motion" in page
    # Contacts were re-fitted and moved nothing, or something.
    assert title_of_cause(diagnosis) == "no known effect; the same motion"
    moved = dataclasses.replace(diagnosis, gap=_gap(0.021, 0.015, 0.009))
    assert title_of_cause(moved) == "no known effect; contacts re-fitted"
    assert "Direction of the missing force" in said(written(*case(), tmp_path)[0])


def test_scores_of_points_come_from_all_takes_of_their_object():
    (one, a), (two, b) = take(), take("take02", seed=1)
    b = dataclasses.replace(b, point_score=np.where(np.arange(8) == 3, NAN, 5.0) * np.ones((20, 1)))
    a = dataclasses.replace(a, point_score=np.full((20, 8), 1.0))
    diagnosis, capture = case((one, a), (two, b))
    scores = object_scores(diagnosis, capture, 0)
    by_corner = {tuple(p): m for p, m in zip(np.round(scores.points, 3), scores.means, strict=True)}
    assert by_corner[tuple(CORNERS[3])] == 1.0 and by_corner[tuple(CORNERS[0])] == 3.0


EMPTY = {
    "no takes": {"trials": {}, "where": Localisation(objects=(), intervals=(), direction={})},
    "no candidates": {"effects": ()},
    "no words": {"summary": "", "next_experiment": None, "controls": {}},
}


@pytest.mark.parametrize("name", EMPTY)
def test_empty_figures_are_left_out(name, tmp_path):
    diagnosis, capture = case(**EMPTY[name])
    _, names = written(diagnosis, capture, tmp_path)
    assert names >= FILES - {"tracks.svg"}


def test_a_single_point_that_was_hardly_seen(tmp_path):
    trial, arrays = take(points=1, frames=3)
    nothing = np.full((3, 1, 3), NAN)
    arrays = dataclasses.replace(arrays, nominal=nothing, found=nothing, residual=nothing, frame_score=np.full(3, NAN))
    written(*case((trial, arrays)), tmp_path)


def test_a_large_report_stays_small(tmp_path):
    takes = [take(f"take{i}", frames=250, points=45, seed=i) for i in range(8)]
    diagnosis, capture = case(*takes, objects=(cube(), cube("other"), cube("third")))
    written(diagnosis, capture, tmp_path)
    assert (tmp_path / "report.html").stat().st_size < 1_000_000


NUMBERS = st.floats(allow_nan=True, allow_infinity=True)
TEXTS = st.text(st.characters(), max_size=20)
ESTIMATES = st.builds(
    Estimate, value=NUMBERS, unit=st.sampled_from(["m", "Pa", "rad", "s", "1", "1/m"]), low=NUMBERS, high=NUMBERS
)
NAMES = st.one_of(st.sampled_from([*effects(), "none", "unknown", "wind+friction"]), TEXTS)
FLAT = Picture(width=10, height=10, title="flat", description="nothing", body=text(""))


@st.composite
def anything(draw):
    """A diagnosis of which every number may be no number, and every array too short."""
    trial, arrays = take(frames=6, points=2, role=draw(st.sampled_from(["fit", "predict"])))
    holes = np.random.default_rng(draw(st.integers(0, 99))).random(6) < draw(st.floats(0, 1))
    arrays = dataclasses.replace(
        arrays,
        times=draw(st.sampled_from([arrays.times, arrays.times[:0]])),
        frame_score=np.where(holes, draw(NUMBERS), arrays.frame_score),
        nominal=np.where(holes[:, None, None], draw(NUMBERS), arrays.nominal),
        found=draw(st.sampled_from([arrays.found, arrays.found[:3], np.full_like(arrays.found, NAN)])),
        after=draw(st.sampled_from([arrays.after, None])),
    )
    name = draw(NAMES)
    ranked = st.builds(
        RankedEffect,
        name=NAMES,
        kind=TEXTS,
        probability=NUMBERS,
        parameters=st.dictionaries(TEXTS, ESTIMATES, max_size=2),
        heldout_rms_m=NUMBERS,
        closed_fraction=NUMBERS,
    )
    intervals = st.builds(
        IntervalShare,
        trial=st.just("take01"),
        start_s=NUMBERS,
        end_s=NUMBERS,
        phase=st.sampled_from(["flight", "impact", "odd"]),
        share=NUMBERS,
    )
    return case(
        (trial, arrays),
        verdict=Verdict(effect=name, probability=draw(NUMBERS), alternatives=tuple(draw(st.lists(NAMES, max_size=2)))),
        effects=tuple(draw(st.lists(ranked, max_size=4))),
        gap=Gap(
            before_rms_m=draw(NUMBERS),
            refitted_rms_m=draw(NUMBERS),
            after_rms_m=draw(NUMBERS),
            noise_floor_rms_m=draw(NUMBERS),
            closed_fraction=draw(NUMBERS),
            closed_fraction_ci95=(draw(NUMBERS), draw(NUMBERS)),
            resolvable=draw(st.booleans()),
            numerics_rms_m=draw(NUMBERS),
        ),
        controls=draw(st.dictionaries(TEXTS, NUMBERS, max_size=2)),
        where=Localisation(
            objects=(ObjectShare(name="cube", share=draw(NUMBERS)),),
            intervals=tuple(draw(st.lists(intervals, max_size=3))),
            direction=draw(st.dictionaries(TEXTS, NUMBERS, max_size=2)),
        ),
        summary=draw(TEXTS),
        seconds=draw(NUMBERS),
    )


@settings(max_examples=60, deadline=None)
@given(anything())
def test_any_diagnosis_gives_a_page(tmp_path_factory, built):
    # The picture of the object takes most of the time; other tests draw it.
    with patch.object(diagnosis_figures, "object_pictures", lambda *_: [FLAT]):
        written(*built, tmp_path_factory.mktemp("report"))


@given(st.text(st.characters()))
def test_text_never_becomes_markup(given_text):
    parsed = ElementTree.fromstring(element("p", given_text, title=given_text))
    wanted = clean(given_text).replace("\r\n", "\n").replace("\r", "\n")
    assert (parsed.text or "") == wanted and len(parsed) == 0


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (0.0539, "m", "53.9\u00a0mm"),
        (3e-5, "m", "30.0\u00a0µm"),
        (2.5, "m", "2.50\u00a0m"),
        (3.2e5, "Pa", "320\u00a0kPa"),
        (math.pi / 6, "rad", "30.0°"),
        (0.3, "1", "0.300"),
        (-0.02, "s", "−20.0\u00a0ms"),
        (NAN, "m", "–"),
        (None, "m", "–"),
        (1.14e-14, "m", "<\u00a01\u00a0nm"),
        (1.5e9, "kg", "1.50\u00a0×\u00a010⁹\u00a0kg"),
    ],
)
def test_quantities(value, unit, shown):
    assert quantity_text(value, unit) == shown


@given(st.floats(min_value=-9e4, max_value=9e4), st.integers(1, 6))
def test_numbers_keep_their_digits(value, digits):
    shown = number_text(value, digits=digits).replace("−", "-")
    if "×" not in shown:
        assert float(shown) == pytest.approx(value, rel=0.5001 * 10.0 ** (1 - digits), abs=0)


def test_percent_is_never_rounded_to_certainty():
    assert [percent_text(v) for v in (0.0, 1e-6, 0.004, 0.996, 0.9999, 1.0, NAN)] == [
        "0\u00a0%",
        "<\u00a00.1\u00a0%",
        "0.4\u00a0%",
        "99.6\u00a0%",
        "99.9\u00a0%",
        "100\u00a0%",
        "–",
    ]


@pytest.mark.parametrize(
    ("estimate", "shown"),
    [
        ((0.040499, "1/m", 0.0381, 0.0429), "k 0.0405 1/m (95 %: 0.0381 to 0.0429)"),
        ((0.0021, "m", 0.0017, 0.0025), "k 2.10 mm (95 %: 1.70 to 2.50)"),
        ((12345.0, "Pa", 8345.0, 16345.0), "k 12.3 kPa (95 %: 8.3 to 16.3)"),
        ((0.1, "1", NAN, NAN), "k 0.100"),
        ((NAN, "1", 0.0, 1.0), "k –"),
    ],
)
def test_parameters_have_the_digits_that_their_interval_supports(estimate, shown):
    value, unit, low, high = estimate
    written_so = parameter_text("k", Estimate(value=value, unit=unit, low=low, high=high))
    assert written_so.replace("\u00a0", " ") == shown


def test_the_headline_is_no_surer_than_the_probability():
    said_so = [headline(case(verdict=Verdict(effect="wind", probability=p))[0]) for p in (0.3, 0.6, 0.9, 0.99, NAN)]
    assert ["guess" in said_so[0], "more likely" in said_so[1], "very" in said_so[2], "almost" in said_so[3]] == [
        True
    ] * 4
    assert "not known" in said_so[4]


def test_alternatives_that_predict_better_are_named(tmp_path):
    found, capture = case()
    drag, wind, none = found.effects
    text = said(written(found, capture, tmp_path / "a")[0])
    assert "Closer on held-out motion" not in text
    closer = dataclasses.replace(found, effects=(drag, dataclasses.replace(wind, heldout_rms_m=0.0011), none))
    assert "Closer on held-out motion than its 2.7\u00a0mm: wind (1.1\u00a0mm)." in said(
        written(closer, capture, tmp_path / "b")[0]
    )


def test_labels_of_an_axis_do_not_touch():
    """On a square root scale 0 and 2 of 60 lay upon each other."""
    scale = Scale(low=0.0, high=60.0, start=62.0, end=4.0, root=True)
    assert scale.ticks() == [0.0, 2.0, 10.0, 50.0]
    assert _apart(scale, scale.ticks()) == [0.0, 10.0, 50.0]
    assert _apart(Scale(low=0.0, high=10.0, start=62.0, end=4.0), [0.0, 5.0, 10.0]) == [0.0, 5.0, 10.0]


def test_the_page_names_its_capture_and_the_button_as_blender_does(tmp_path):
    origin = Provenance(capture="bounces", content_sha256="0" * 64, command="physgen diagnose bounces --out DIR")
    page, _ = written(*case(provenance=origin), tmp_path)
    assert "<title>bounces: Air drag: very likely the cause</title>" in page
    assert "bounces · Where simulation and recording diverge" in said(page)
    assert '<span class="flag">--out</span>' in page
    (label,) = re.findall("<kbd>(.*?)</kbd>", page)
    operators = (Path(physgen.__file__).parent / "physgen_addon" / "operators" / "diagnose_ops.py").read_text()
    assert f'bl_label = "{label}"' in operators
