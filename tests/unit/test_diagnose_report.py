# SPDX-License-Identifier: MIT
"""The report comes out of any diagnosis, holds nothing foreign, and says what is true."""

import base64
import dataclasses
import hashlib
import json
import math
import re

import numpy as np
import pytest
from physgen.sim.app.explain import title_of_cause
from physgen.sim.diagnose.diagnosis import Gap, Localisation, RankedEffect, Verdict
from physgen.sim.diagnose.fits import Estimate
from physgen.sim.diagnose.report.diagnosis_charts import bands, timeline_picture
from physgen.sim.diagnose.report.diagnosis_figures import growth
from physgen.sim.diagnose.report.diagnosis_page import scene_effects
from physgen.sim.diagnose.report.object_heatmaps import object_scores
from physgen.sim.diagnose.verification_run import VerificationRun
from physgen.sim.effects.registry import effects

from .report_cases import CAMERA, CORNERS, FILES, HOSTILE, NAN, case, cube, said, take, written


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


@pytest.mark.parametrize(("found", "way"), [(0.322, "lower"), (0.71, "higher")])
def test_a_coefficient_is_said_beside_what_was_assumed(found, way, tmp_path):
    diagnosis, capture = case(
        verdict=Verdict(effect="friction", probability=0.98),
        effects=(
            RankedEffect(
                name="friction",
                kind="contact",
                probability=0.98,
                parameters={"friction": Estimate(value=found, unit="1", low=found - 0.01, high=found + 0.01)},
            ),
        ),
    )
    believed = dataclasses.replace(capture, ground=dataclasses.replace(capture.ground, friction=0.5))
    text = said(written(diagnosis, believed, tmp_path / "a")[0])
    assert f"Friction is {way} than assumed: {found:.3f}, not 0.500." in text
    same = dataclasses.replace(capture, ground=dataclasses.replace(capture.ground, friction=found))
    assert "than assumed:" not in said(written(diagnosis, same, tmp_path / "b")[0])


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
