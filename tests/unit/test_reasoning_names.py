# SPDX-License-Identifier: MIT
"""The table of names: what it knows, how forgiving it is, and what it says of a broken file."""

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.reasoning.material_names import MAX_FILE_BYTES, NAMES_FILE, load_names, shipped_names
from physgen.sim.scene.material import load_preset

TABLE = shipped_names()
EVERYDAY = [
    *(
        "orange",
        "apple",
        "teddy",
        "plush",
        "book",
        "mug",
        "cup",
        "bottle",
        "camera",
        "clay",
        "sponge",
        "pillow",
        "brick",
    ),
    *("can", "ball", "chair", "vase", "egg", "bread", "cake", "jelly", "shoe", "hat", "phone", "banana", "box", "bag"),
    *(
        "plate",
        "bowl",
        "spoon",
        "candle",
        "toy",
        "doll",
        "car",
        "lamp",
        "laptop",
        "table",
        "duck",
        "coin",
        "key",
        "stone",
    ),
]
MATTERS = [
    "wood",
    "metal",
    "glass",
    "rubber",
    "plush",
    "foam",
    "ceramic",
    "cloth",
    "paper",
    "plastic",
    "leather",
    "wax",
]


def test_the_table_is_large_and_knows_all_its_names():
    data = tomllib.loads(NAMES_FILE.read_text(encoding="utf-8"))
    groups = [data["matter"], *data["things"].values()]
    assert sum(len(group) for group in groups) >= 120
    words = [word for group in groups for key, entry in group.items() for word in (key, *entry.get("also", []))]
    assert len(words) > 500
    for word in words:
        assert TABLE.find(word) is not None, word


@pytest.mark.parametrize("word", EVERYDAY + MATTERS)
def test_everyday_names_and_matters_are_known(word):
    found = TABLE.find(word)
    assert found is not None and load_preset(found.preset).preset == found.preset


def test_a_few_that_a_kitchen_scale_and_a_ruler_can_check():
    # By the rules of the games, in grams; the sizes are the table's.
    weights = {"football": 430, "tennis ball": 58, "golf ball": 46, "basketball": 620, "baseball": 145}
    for name, grams in weights.items():
        ball = TABLE.find(name)
        assert ball.density * 3.14159 / 6 * ball.size_m**3 * 1000 == pytest.approx(grams, rel=0.15), name
    cup, bottle = TABLE.find("cup"), TABLE.find("bottle")
    assert cup.density < TABLE.find("ceramic").density and bottle.preset == "hard"
    assert TABLE.find("orange").shape == "sphere" and TABLE.find("book").shape == "box"


@pytest.mark.parametrize(
    ("said", "meant"),
    [
        ("teddy_bear", "teddy bear"), ("TeddyBear", "teddy bear"), ("teddybear", "teddy bear"),
        ("Teddies", "teddy bear"),
        ("Oranges", "orange"), ("orange_2", "orange"), ("  ORANGE ", "orange"), ("an orange", "orange"),
        ("coffee mug", "mug"), ("my red mug", "mug"), ("coffee-mugs", "mug"), ("knives", "knife"), ("loaves", "bread"),
        ("boxes", "box"), ("cherries", "cherry"), ("children", "person"), ("glasses", "glasses"),
        ("dress", "shirt"),
        ("slice of cake", "cake"), ("pair of shoes", "shoe"), ("bottle of wine", "bottle"),
        ("ball of yarn", "yarn ball"),
        ("chair with a toy on it", "chair"), ("café cup", "cup"), ("handball", "ball"), ("water bottle", "bottle"),
    ],
)  # fmt: skip
def test_case_plural_and_compounds_do_not_matter(said, meant):
    assert TABLE.find(said).name == meant


@pytest.mark.parametrize("said", ["", None, "object_1", "zzz", "orange juice", "12", "_", "???", "left", "x" * 999])
def test_unknown_names_are_none(said):
    assert TABLE.find(said) is None


def test_a_matter_in_front_replaces_the_usual_one():
    spoon, wooden = TABLE.find("spoon"), TABLE.find("wooden spoons")
    assert (spoon.preset, wooden.preset) == ("metal", "wood") and wooden.size_m == spoon.size_m
    assert wooden.density == TABLE.find("wood").density and wooden.metallic == 0.0
    cup, paper = TABLE.find("cup"), TABLE.find("paper cup")
    # As thin walls as before, of another matter.
    assert paper.density / cup.density == pytest.approx(TABLE.find("paper").density / TABLE.find("ceramic").density)
    assert TABLE.find("plush camera").density == TABLE.find("plush").density
    assert TABLE.find("ceramic unicorn") == TABLE.find("ceramic") and TABLE.find("silver car") == TABLE.find("car")


WORDS = st.sampled_from([*EVERYDAY, *MATTERS, "of", "with", "s", "_", "the"])


@settings(max_examples=100, deadline=None)
@given(st.text(max_size=60) | st.lists(WORDS).map(" ".join))
def test_any_name_may_be_looked_up(name):
    found = TABLE.find(name)
    assert found is None or (1 <= found.density <= 23_000 and load_preset(found.preset))


WOOD = "[matter]\nwood = {preset='wood', density=550, roughness=0.5, metallic=0, appearance_roughness=0.5}\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[matter", "not readable"),
        ("matter = 3", "expected a table"),
        ("other = 3", "unknown"),
        ("[matter]\nwood = 3", "expected an object"),
        (WOOD.replace("550", "0"), "density is 0"),
        (WOOD.replace("550", "nan"), "finite"),
        (WOOD.replace("550", "'x'"), "a number"),
        (WOOD.replace("'wood'", "'oak'"), "preset is 'oak'"),
        (WOOD.replace("metallic=0", "metallic=2"), "metallic is 2"),
        (WOOD + "[things]\na = 1", "expected a table"),
        (WOOD + "[things.a]\nchair = {matter='iron', size_m=1}", "'iron'"),
        (WOOD + "[things.a]\nchair = {matter='wood'}", "size_m: missing"),
        (WOOD + "[things.a]\nchair = {matter='wood', size_m=1, share=0}", "share is 0"),
        (WOOD + "[things.a]\nchair = {matter='wood', size_m=1, also=['Chair']}", "twice"),
        (WOOD.replace("metallic", "also=['wood'], metallic"), "twice"),
        (WOOD + "[things.a]\nchair = {matter='wood', size_m=1, colour='red'}", "colour"),
        (WOOD + "[things.a]\nchair = {matter='wood', size_m=1, shape='round'}", "shape is 'round'"),
        (WOOD + "[things.a]\n'??' = {matter='wood', size_m=1}", "letters"),
    ],
)
def test_a_broken_table_is_named(tmp_path, text, said):
    path = tmp_path / "names.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"names\.toml") as caught:
        load_names(path)
    assert said in str(caught.value)


def test_a_table_of_ones_own(tmp_path):
    path = tmp_path / "names.toml"
    path.write_text(WOOD + "[things.a]\nchair = {matter='wood', size_m=1, share=0.5, also=['throne']}")
    found = load_names(path).find("Thrones")
    assert (found.name, found.density, found.preset) == ("chair", 275.0, "wood") and load_names(path).find(
        "orange"
    ) is None


def test_garbage_is_no_table(tmp_path):
    with pytest.raises(InputError, match="not readable"):
        load_names(tmp_path / "missing.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * (MAX_FILE_BYTES + 1))
    with pytest.raises(InputError, match="KiB"):
        load_names(tmp_path / "large.toml")


VALUES = st.sampled_from(["1", "-1", "nan", "inf", "'x'", "[]", "['a', 1]", "true", "{}", "1e300", "'wood'", "['']"])


FIELDS = st.sampled_from(["preset", "density", "also", "fill", "modifies", "metallic"])


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=80) | st.tuples(FIELDS, VALUES))
def test_no_file_does_harm(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzz.toml"
    if isinstance(content, tuple):
        fields = {
            "preset": "'wood'",
            "density": "550",
            "roughness": "0.5",
            "metallic": "0",
            "appearance_roughness": "0.5",
        }
        fields[content[0]] = content[1]
        content = f"[matter.a]\n{''.join(f'{k} = {v}' + chr(10) for k, v in fields.items())}".encode()
    path.write_bytes(content)
    try:
        load_names(path).find("a")
    except InputError as error:
        assert "fuzz.toml" in str(error)
