# SPDX-License-Identifier: MIT
"""Answers as models send them: what is read, what is refused and said, and that no text does any harm."""

import dataclasses
import json
import math
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.reconstruct.reasoning.answer_entries import ObjectAnswer, yes_or_no
from physgen.sim.reconstruct.reasoning.answer_parser import MAX_TEXT, MAX_UNREAD, read_answer
from physgen.sim.reconstruct.reasoning.quantities import DENSITY, LENGTH, MODULUS, QUANTITY_TYPES, ROUGHNESS, quantity

MODEL = ObjectAnswer(name="camera_model", density=200.0, stiffness="soft", size_m=0.15, fill=True)
CAMERA = ObjectAnswer(name="camera", density=2700.0, stiffness="hard", size_m=0.2, fill=False)
PAPER = "1, camera_model, 200, soft, 0.15, yes\n2, camera, 2700, hard, 0.20, no\n0.2"

FORMS = {
    "the paper's": PAPER,
    "no numbers": "camera_model, 200, soft, 0.15, yes\ncamera, 2700, hard, 0.20, no\n0.2",
    "no spaces": PAPER.replace(" ", ""),
    "windows": PAPER.replace("\n", "\r\n\r\n"),
    "out of order": "2, camera, 2700, hard, 0.20, no\n1, camera_model, 200, soft, 0.15, yes\n0.2",
    "roughness first": "0.2\n1, camera_model, 200, soft, 0.15, yes\n2, camera, 2700, hard, 0.20, no",
    "a list": "1. camera_model, 200, soft, 0.15, yes\n2. camera, 2700, hard, 0.20, no\n3. 0.2",
    "brackets": "1) camera_model, 200, soft, 0.15, yes\n2) camera, 2700, hard, 0.20, no\nRoughness: 0.2",
    "all ones": "1. camera_model, 200, soft, 0.15, yes\n1. camera, 2700, hard, 0.20, no\n0.2",
    "twice numbered": "1. 1, camera_model, 200, soft, 0.15, yes\n2. 2, camera, 2700, hard, 0.20, no\n3. 0.2",
    "from zero": "0, camera_model, 200, soft, 0.15, yes\n1, camera, 2700, hard, 0.20, no\n0.2",
    "object n": "Object 1: camera_model, 200, soft, 0.15, yes\nObject 2: camera, 2700, hard, 0.20, no\n"
    "surface: 0.2 (smooth)",
    "dashes": "- camera_model, 200, soft, 0.15, yes\n- camera, 2700, hard, 0.20, no\n- Surface roughness: 0.2",
    "between dashes": "1 - camera_model - 200 - soft - 0.15 - yes\n2 - camera - 2700 - hard - 0.20 - no\n0.2",
    "blanks": "1 camera_model 200 soft 0.15 yes\n2 camera 2700 hard 0.20 no\n0.2",
    "name first": "camera_model: 200, soft, 0.15, yes\ncamera: 2700, hard, 0.20, no\nsurface, 0.2",
    "bold": "**1, camera_model, 200, soft, 0.15, yes**\n**2**, **camera**, 2700, `hard`, 0.20, no\n**0.2**",
    "quoted": '"1, camera_model, 200, soft, 0.15, yes"\n"2, camera, 2700, hard, 0.20, no"\n"0.2"',
    "labelled": "Answer: 1, camera_model, 200, soft, 0.15, yes\n2, camera, 2700, hard, 0.20, no\n0.2",
    "units": "1, camera_model, 200 kg/m^3, soft, 15 cm, yes\n2, camera, 2.7 g/cm³, hard, 200 mm, no\n20 %",
    "exponents": "1, camera_model, 2e2, soft, 1.5e-1, yes\n2, camera, 2.7 × 10³ kg/m³, hard, 2*10^-1 m, no\n2e-1",
    "thousands": "1, camera_model, 200, soft, 0.15, yes\n2, camera, 2,700, hard, 0.20, no\n0.2",
    "thousands, no spaces": "1,camera_model,200,soft,0.15,yes\n2,camera,2,700,hard,0.20,no\n0.2",
    "semicolons": "1; camera_model; 200,0; soft; 0,15; yes\n2; camera; 2.700,0; hard; 0,20; no\n0,2",
    "decimal commas": "1,camera_model,200,soft,0,15,yes\n2,camera,2700,hard,0,20,no\n0,2",
    "tabs": PAPER.replace(", ", "\t"),
    "words": "1, camera_model, 200, Soft (plush, foam), 0.15, Yes (solid)\n"
    "2, camera, 2700, HARD, 0.20, not required\n0.2",
    "sides": "1, camera_model, 200, soft, 15 x 10 x 8 cm, true\n2, camera, 2700, hard, 0.2 x 0.15 m, false\n0.2",
    "header": "Number, name, density, stiffness, size, filling\n" + PAPER,
    "the paper's header": "Object number, name, density in kg/m^3, Young's modulus (soft/medium/hard), size in meters, "
    "requires internal filling (yes/no)\n" + PAPER,
    "other columns": "name, fill, size (cm), Young's modulus, density (g/cm³)\ncamera_model, yes, 15, soft, 0.2\n"
    "camera, no, 20, hard, 2.7\nroughness: 0.2",
    "fence": f"Sure, here you are:\n```csv\n{PAPER}\n```\nI hope this helps!",
    "reasoning aloud": f"<think>\n1, apple, 1, hard, 3, no\n0.9\n</think>\n{PAPER}",
    "bars": "1 | camera_model | 200 | soft | 0.15 | yes\n2 | camera | 2700 | hard | 0.20 | no\n0.2",
    "table": "| # | Name | Density (kg/m³) | Young's modulus | Size (cm) | Filling |\n|---|:--|---|---|---|---|\n"
    "| 1 | camera_model | 200 | **soft** | 15 | yes |\n| 2 | camera | 2700 | hard | 20 | no |\n\n"
    "The roughness of the table is about 0.2 (0 to 1).",
    "blocks": "**Object 1**\n- Name: camera_model\n- Density: 200 kg/m³\n- Young's modulus: Soft\n- Size: 15 cm\n"
    "- Internal filling: Yes\n\n**Object 2**\n- Name: camera\n- Density: 2700 kg/m³\n- Young's modulus: Hard\n"
    "- Size: 0.2 m\n- Internal filling: No\n\n**Supporting surface roughness:** 0.2",
    "headed blocks": "camera_model:\nDensity = 200\nStiffness = soft\nSize = 0.15\nFilling = yes\n\n"
    "camera:\nDensity = 2700\nStiffness = hard\nSize = 0.2\nFilling = no\n\nRoughness = 0.2",
    "pairs": "1. Name: camera_model, Density: 200, Stiffness: soft, Size: 0.15, Filling: yes\n"
    "2. Name: camera, Density: 2700, Stiffness: hard, Size: 0.2, Filling: no\n0.2",
    "last sentence": "1, camera_model, 200, soft, 0.15, yes\n2, camera, 2700, hard, 0.20, no. Surface roughness: 0.2",
    "json": json.dumps(
        {
            "objects": [
                {"number": 2, "name": "camera", "density": 2700, "stiffness": "hard", "size_cm": 20, "fill": False},
                {"number": 1, "name": "camera_model", "density_kg_m3": "200 kg/m3", "youngs_modulus": "soft",
                 "size": [0.15, 0.1, 0.1], "internal_filling": "yes"},
            ],
            "surface_roughness": 0.2,
        }
    ),
    "json by number": "```json\n" + json.dumps(
        {
            "1": {"object": "camera_model", "density": 200, "modulus": "soft", "size_m": 0.15, "filling": True},
            "2": {"object": "camera", "density": 2700, "modulus": "hard", "size_m": 0.2, "filling": False},
            "surface": {"name": "table", "density": 700, "roughness": "0.2"},
        },
        indent=2,
    ) + "\n```",
    "json rows": 'Here:\n[[1, "camera_model", 200, "soft", 0.15, "yes"],\n[2, "camera", 2700, "hard", 0.2, "no"]]\n.2',
    "json lines": json.dumps(PAPER.splitlines()[:2]) + "\nroughness 0.2",
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_common_format_deviations_are_read(form):
    answers = read_answer(FORMS[form], 2)
    for found, meant in zip(answers.objects, (MODEL, CAMERA), strict=True):
        assert found.density == pytest.approx(meant.density) and found.size_m == pytest.approx(meant.size_m)
        assert dataclasses.replace(found, density=None, size_m=None) == dataclasses.replace(
            meant, density=None, size_m=None
        )
    assert answers.roughness == pytest.approx(0.2)
    assert answers.unread == () and answers.raw == FORMS[form]


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("200 kg/m^3", DENSITY, 200), ("0.2 g/cm³", DENSITY, 200), ("200 kg·m⁻³", DENSITY, 200),
        ("200 kilograms per cubic meter", DENSITY, 200), ("1 200 kg/m3", DENSITY, 1200), ("1'200", DENSITY, 1200),
        ("1,200.5", DENSITY, 1200.5), ("1.200,5", DENSITY, 1200.5), ("62.4 lb/ft³", DENSITY, 999.55),
        ("500-800", DENSITY, math.sqrt(500 * 800)), ("between 500 and 800 kg/m3", DENSITY, math.sqrt(500 * 800)),
        ("500 to 800 (typical)", DENSITY, math.sqrt(500 * 800)), ("~900", DENSITY, 900), ("900 ± 50", DENSITY, 900),
        ("15 cm", LENGTH, 0.15), ("15cm tall", LENGTH, 0.15), ("0,15", LENGTH, 0.15), (".5", LENGTH, 0.5),
        ("6 inches", LENGTH, 0.1524), ('6"', LENGTH, 0.1524), ("0.15 m (6 inches)", LENGTH, 0.15),
        ("8 cm - 12 cm", LENGTH, math.sqrt(0.08 * 0.12)), ("8–12 cm", LENGTH, math.sqrt(0.08 * 0.12)),
        ("1e-3", LENGTH, 1e-3), ("8×10⁻² m", LENGTH, 0.08), ("10^-1 m", LENGTH, 0.1),
        ("20 x 15 x 3 cm", LENGTH, 0.2),
        ("1e5 Pa", MODULUS, 1e5), ("5 MPa", MODULUS, 5e6), ("$5\\times10^{6}$ Pa", MODULUS, 5e6),
        ("2 GPa", MODULUS, 2e9),
        ("0.2", ROUGHNESS, 0.2), ("20%", ROUGHNESS, 0.2), ("0.2-0.4", ROUGHNESS, 0.3), ("0 - 0.4", ROUGHNESS, 0.2),
    ],
)  # fmt: skip
def test_numbers_with_units(text, kind, value):
    found, wrong = quantity(text, kind)
    assert found == pytest.approx(value, rel=1e-3) and wrong == ""


@pytest.mark.parametrize(
    ("text", "kind", "said"),
    [
        ("0", DENSITY, "not within"), ("1e9", DENSITY, "not within"), ("-3", DENSITY, "not within"),
        ("1e400", DENSITY, "not within"), ("nan", DENSITY, "not a number"), ("inf", LENGTH, "not a number"),
        ("1 km", LENGTH, "1000 m"), ("0 m", LENGTH, "not within"), ("heavy", DENSITY, "heavy"),
        ("", DENSITY, "not a number"),
        ("15 cm", DENSITY, "'cm'"), ("200 kg", DENSITY, "'kg'"), ("200 kg/m3", LENGTH, "'kg/m3'"),
        ("5 GPa", LENGTH, "'gpa'"), ("1.5", ROUGHNESS, "not within"), ("-0.1", ROUGHNESS, "not within"),
        ("0.2 m", ROUGHNESS, "'m'"), ("1e30 Pa", MODULUS, "not within"),
    ],
)  # fmt: skip
def test_numbers_that_cannot_be_are_refused(text, kind, said):
    value, wrong = quantity(text, kind)
    assert value is None and said in wrong and kind.name in wrong


def test_fields_that_miss_are_none_and_named():
    answers = read_answer("1, camera_model, 200, soft, , yes\n2, camera, N/A, hard, 0.2\n", 2)
    assert answers.objects == (
        dataclasses.replace(MODEL, size_m=None),
        dataclasses.replace(CAMERA, density=None, fill=None),
    )
    assert answers.roughness is None
    complaints = "\n".join(answers.unread)
    assert "object 1: no size in '1, camera_model" in complaints
    assert "object 2: no density and no filling in '2, camera" in complaints and "roughness" in complaints


def test_implausible_values_are_refused_with_their_line():
    answers = read_answer("1, a, 1e9, soft, 0.15, yes\n2, b, 0, hard, 1 km, no\n3, c, NaN, medium, inf, maybe\n5", 3)
    assert [item.density for item in answers.objects] == [None] * 3
    assert [item.size_m for item in answers.objects] == [0.15, None, None]
    assert [item.fill for item in answers.objects] == [True, False, None]
    complaints = "\n".join(answers.unread)
    for said in (
        "1e+09",
        "density 0 ",
        "1000 m",
        "'NaN'",
        "'inf'",
        "'maybe'",
        "roughness 5 ",
        "'2, b, 0, hard, 1 km, no'",
    ):
        assert said in complaints


def test_a_modulus_in_place_of_a_class_is_kept():
    answers = read_answer("1, orange, 900, 1e5 Pa, 0.08, yes\n2, book, 700, hard (5e6 Pa), 0.2, yes\n0.3", 2)
    assert [(a.stiffness, a.youngs_modulus) for a in answers.objects] == [(None, 1e5), ("hard", 5e6)]
    assert answers.unread == ()


def test_an_entry_too_many_is_said_and_joined_with_nothing():
    answers = read_answer("1, cup, 2400, 70, hard, 0.1, no\n2,toy,200,soft,7 MPa,0.1,yes\n0.3", 2)
    assert [(a.density, a.size_m) for a in answers.objects] == [(2400, 0.1), (200, 0.1)]
    assert answers.unread == ("object 1: number '70' is one too many in '1, cup, 2400, 70, hard, 0.1, no'",)


def test_a_modulus_beside_a_class_leaves_the_class():
    answers = read_answer("1, cup, 2400, 7e10 Pa, hard, 0.1, no\n2, toy, 200, soft, 1e5 Pa, 0.1, yes\n0.3", 2)
    assert [(a.stiffness, a.youngs_modulus) for a in answers.objects] == [("hard", 7e10), ("soft", 1e5)]
    assert answers.unread == ()


@pytest.mark.parametrize(
    "line",
    [
        "With 2 objects on the table, I would say that its roughness is 0.3.",
        "The table surface has a roughness of 0.3, with 2 objects on it.",
        "Surface: wooden table (roughness 0.3)",
        "Roughness of the surface (0 = smooth, 1 = rough): 0.3",
        "Surface roughness (0-1): about 0.3",
        "roughness = 0.3/1",
    ],
)
def test_sentences_about_the_surface(line):
    answers = read_answer(f"1, floor_lamp, 900, hard, 1.5, no\n2, table, 700, hard, 1.2, yes\n{line}", 2)
    assert answers.roughness == 0.3 and [a.name for a in answers.objects] == ["floor_lamp", "table"]


def test_a_thing_on_which_others_stand_may_be_an_object():
    text = "Object 1\n- Name: floor lamp\n- Density: 900\n- Size: 1.5\n"
    text += "Object 2: table\nDensity: 700\nSize: 1.2\nRoughness: 0.3"
    answers = read_answer(text, 2)
    assert [(a.name, a.density, a.size_m) for a in answers.objects] == [("floor lamp", 900, 1.5), ("table", 700, 1.2)]
    assert answers.roughness == 0.3


def test_a_class_that_is_none_is_not_guessed():
    answers = read_answer("1, a, 900, soft/hard, 0.08, yes\n2, b, 900, squeaky, 0.1, yes\n0.3", 2)
    assert [a.stiffness for a in answers.objects] == [None, None]
    assert "several classes" in answers.unread[0] and "'squeaky'" in answers.unread[1]


def test_more_lines_than_objects_and_repeated_ones_are_said():
    answers = read_answer(f"{PAPER}\n3, pear, 900, medium, 0.08, yes\n1, cup, 2400, hard, 0.1, no", 2)
    assert answers.objects[0].name == "cup" and answers.objects[1] == CAMERA and answers.roughness == 0.2
    assert any("object 3" in said and "pear" in said for said in answers.unread)
    assert any("more than once" in said for said in answers.unread)
    answers = read_answer("cup, 2400, hard, 0.1, no\nbook, 700, hard, 0.2, yes\n0.3", 1)
    assert answers.objects[0].name == "cup" and "more lines" in answers.unread[0]


def test_fewer_lines_than_objects_leave_the_others_empty():
    answers = read_answer("2, camera, 2700, hard, 0.20, no\n0.2", 3)
    assert answers.objects == (ObjectAnswer(), CAMERA, ObjectAnswer())
    assert "object 1: no line in the answer" in answers.unread and "object 3: no line in the answer" in answers.unread


@pytest.mark.parametrize(
    "text", ["", "I'm sorry, but I can't help with that.", "<html><body>502</body></html>", "{}", "[]"]
)
def test_a_text_without_answers_gives_none(text):
    answers = read_answer(text, 2)
    assert answers.objects == (ObjectAnswer(),) * 2 and answers.roughness is None and answers.unread


YES = ("yes", "Y", "TRUE", "Required.", "solid", "1")
NO = ("no", "n", "False", "not needed", "hollow", "0")
NEITHER = ("maybe", "nothing", "yesterday", "")


@pytest.mark.parametrize(
    ("word", "meant"), [(w, m) for words, m in ((YES, True), (NO, False), (NEITHER, None)) for w in words]
)
def test_words_for_yes_and_no(word, meant):
    assert yes_or_no(word) is meant


def test_the_surface_counts_before_a_number_alone():
    assert (
        read_answer(f"{PAPER}\nThe roughness of the supporting surface (0 = smooth, 1 = rough): 0.4", 2).roughness
        == 0.4
    )
    answers = read_answer("Surface roughness: 0.4\nSurface roughness: 0.5", 1)
    assert answers.roughness == 0.5 and any("more than once" in said for said in answers.unread)


WORDS = st.sampled_from(
    [
        *(
            "1",
            "2",
            "camera",
            "soft",
            "hard",
            "yes",
            "no",
            "0.15",
            "200",
            ",",
            ", ",
            "\n",
            "|",
            "-",
            ":",
            "**",
            "kg/m3",
            "cm",
        ),
        *(
            "density",
            "size",
            "roughness",
            "surface",
            "{",
            "}",
            "[",
            "]",
            '"',
            "e",
            "10^",
            "x",
            "(",
            ")",
            "```",
            "1e999",
        ),
        *("nan", "\t", ";", "…", "³", "½", "٣", "𝟙", "\u2028", "\x00", "</think>", "Object 1:", "#", "%", "to", "−"),
    ]
)


def sound(answers, count):
    assert len(answers.objects) == count and len(answers.unread) <= MAX_UNREAD
    assert all(len(said) < 400 and said.isprintable() for said in answers.unread)
    for item in answers.objects:
        assert item.density is None or DENSITY.low <= item.density <= DENSITY.high
        assert item.size_m is None or LENGTH.low <= item.size_m <= LENGTH.high
        assert item.youngs_modulus is None or MODULUS.low <= item.youngs_modulus <= MODULUS.high
        assert item.stiffness in (None, "soft", "medium", "hard") and item.fill in (None, True, False)
        assert item.name is None or 0 < len(item.name) <= 64
    assert answers.roughness is None or 0 <= answers.roughness <= 1


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.text(max_size=300), st.lists(WORDS, max_size=60).map("".join)), st.integers(0, 4))
def test_no_text_does_harm(text, count):
    sound(read_answer(text, count), count)


LEAVES = st.none() | st.booleans() | st.floats() | st.integers() | WORDS
KEYS = WORDS | st.sampled_from(["name", "fill"])
JSON = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=6) | st.dictionaries(KEYS, inner, max_size=6), max_leaves=20
)


@settings(max_examples=60, deadline=None)
@given(JSON)
def test_no_json_does_harm(value):
    sound(read_answer(json.dumps(value), 2), 2)


@settings(max_examples=100, deadline=None)
@given(st.one_of(st.text(max_size=40), st.lists(WORDS, max_size=8).map(" ".join)), st.sampled_from(QUANTITY_TYPES))
def test_no_number_does_harm(text, kind):
    value, wrong = quantity(text, kind)
    assert (value is None) == bool(wrong) and (value is None or kind.low <= value <= kind.high)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.from_regex(r"[a-df-z]{3,9}", fullmatch=True).filter(
                lambda w: yes_or_no(w) is None and w not in ("nan", "inf")
            ),
            st.floats(1, 20000).map(lambda v: float(f"{v:.4g}")),
            st.sampled_from(["soft", "medium", "hard"]),
            st.floats(0.01, 100).map(lambda v: float(f"{v:.3g}")),
            st.booleans(),
        ),
        min_size=1,
        max_size=6,
    ),
    st.floats(0, 1).map(lambda v: round(v, 2)),
    st.sampled_from([", ", ",", "; "]),
    st.randoms(use_true_random=False),
)
def test_every_answer_in_the_format_comes_back(objects, roughness, comma, random):
    lines = [
        comma.join((str(i), name, repr(density), kind, repr(size), "yes" if fill else "no"))
        for i, (name, density, kind, size, fill) in enumerate(objects, start=1)
    ]
    random.shuffle(lines)
    answers = read_answer("\n".join([*lines, repr(roughness)]), len(objects))
    meant = tuple(
        ObjectAnswer(name=name, density=density, stiffness=kind, size_m=size, fill=fill)
        for name, density, kind, size, fill in objects
    )
    assert answers.objects == meant and answers.roughness == roughness and answers.unread == ()


GARBAGE = [
    *("1, ", "0.1", "a|", "(", "\n", "{", "[", "1,1,1,1,1\n", "10^", " ", "x 10", "- ", "*_", '"', "density: 1\n"),
    *("\\", "1 to ", "a:", "1, cup, 2400, hard, 0.1, yes\n", '{"name": "cup", "density": 1}\n', "<think>"),
    *("roughness ", ". rough 1", "kg ^3"),
]


@pytest.mark.parametrize("piece", GARBAGE)
def test_a_megabyte_of_garbage_takes_bounded_time(piece):
    text = piece * (2**20 // len(piece))
    start = time.process_time()
    answers = read_answer(text, 3)
    # Quadratic time would take minutes; this is a wide bound on the processor's own seconds, not a speed.
    assert time.process_time() - start < 10
    sound(answers, 3)
    assert len(answers.raw) == MAX_TEXT and "characters" in answers.unread[0]
