# SPDX-License-Identifier: MIT
"""Any diagnosis gives a page, and its numbers and words say no more than they know."""

import dataclasses
import math
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from unittest.mock import patch

import numpy as np
import physgen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.diagnose.diagnosis import Gap, IntervalShare, Localisation, ObjectShare, RankedEffect, Verdict
from physgen.sim.diagnose.fits import Estimate
from physgen.sim.diagnose.provenance import Provenance
from physgen.sim.diagnose.report import diagnosis_figures, parameter_text
from physgen.sim.diagnose.report.diagnosis_charts import Scale, _apart
from physgen.sim.diagnose.report.number_format import number_text, percent_text, quantity_text
from physgen.sim.diagnose.report.wording import headline
from physgen.sim.effects.registry import effects
from physgen.sim.html import Picture, clean, element, text

from .report_cases import NAN, case, said, take, written

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
    operators = (Path(physgen.__file__).parent / "physgen_addon" / "operators" / "effect_ops.py").read_text()
    assert f'bl_label = "{label}"' in operators
