# SPDX-License-Identifier: MIT
"""The scene folder: what is written comes back, garbage is refused by name, nothing leads out of the folder."""

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import SCENE_FILE, inside, load_scene, parse_scene, save_scene, scene_to_json
from physgen.sim.scene.json_fields import read_json
from physgen.sim.scene.materials import load_preset, preset_names
from physgen.sim.scene.model import IDENTITY4, Camera, Effect, Ground, Light, Material, Scene, SceneObject

positive = st.floats(0.01, 1e4, allow_nan=False)
# Libraries built with -ffast-math, which other tests load, switch the processor to flush subnormal numbers to zero.
number = st.floats(-1e6, 1e6, allow_nan=False, allow_subnormal=False)
vector = st.tuples(number, number, number)


def a_scene(**changes):
    camera = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=IDENTITY4)
    item = SceneObject(name="cup", mesh="meshes/cup.glb", size_m=0.1, mask="masks/cup.png")
    return Scene(**{"camera": camera, "objects": (item,), **changes})


@st.composite
def scenes(draw):
    material = Material(
        density=draw(st.floats(1, 3e4)),
        youngs_modulus=draw(st.floats(1e2, 1e12)),
        poisson_ratio=draw(st.floats(0, 0.49, allow_subnormal=False)),
    )
    names = draw(st.lists(st.from_regex(r"[a-z][a-z0-9_-]{0,9}", fullmatch=True), min_size=1, max_size=3, unique=True))
    objects = tuple(
        SceneObject(
            name=name,
            mesh=f"meshes/{name}.glb",
            size_m=draw(positive),
            material=material,
            velocity=draw(vector),
            spin=draw(vector),
        )
        for name in names
    )
    effects = tuple(
        Effect(
            name=name,
            parameters=(("strength", draw(number)),),
            objects=tuple(draw(st.lists(st.sampled_from(names), unique=True))),
        )
        for name in draw(st.sets(st.sampled_from(["wind", "drag"])))
    )
    return a_scene(
        objects=objects,
        effects=effects,
        ground=Ground(friction=draw(st.floats(0, 2, allow_subnormal=False))),
        gravity=tuple(g / 1e3 for g in draw(vector)),
        light=Light(),
    )


@given(scenes())
@settings(max_examples=60)
def test_what_is_saved_is_what_is_loaded(scene):
    data = json.loads(json.dumps(scene_to_json(scene)))
    assert parse_scene(data, "scene.json") == scene


def test_effects_of_older_files_act_on_all():
    data = scene_to_json(a_scene(effects=(Effect(name="wind"), Effect(name="magnus", objects=("cup",)))))
    assert data["effects"] == [
        {"name": "wind", "parameters": {}},
        {"name": "magnus", "parameters": {}, "objects": ["cup"]},
    ]
    assert parse_scene(data, "scene.json").effects[0].objects == ()


def test_an_effect_on_an_object_that_is_not_there():
    with pytest.raises(InputError, match=r"effects\[1\].objects is 'mug': name some of cup"):
        a_scene(effects=(Effect(name="wind"), Effect(name="magnus", objects=("cup", "mug"))))


def write_files(root, scene):
    for name in ("photo.png", "background.png", "meshes/cup.glb", "masks/cup.png"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")
    save_scene(root, scene)


def test_a_saved_folder_loads(tmp_path):
    write_files(tmp_path, a_scene())
    assert load_scene(tmp_path).scene == a_scene()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_a_missing_file_is_named(tmp_path):
    write_files(tmp_path, a_scene())
    (tmp_path / "meshes/cup.glb").unlink()
    with pytest.raises(InputError, match=r"meshes/cup\.glb.*reconstruct"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x", "C:/x", "a\\b", "", "a\0b"])
def test_names_cannot_leave_the_folder(tmp_path, name):
    with pytest.raises(InputError, match="file name"):
        inside(tmp_path, name)


def test_links_cannot_leave_the_folder(tmp_path):
    root = tmp_path / "scene"
    root.mkdir()
    (tmp_path / "secret.txt").write_text("x")
    (root / "link.txt").symlink_to(tmp_path / "secret.txt")
    with pytest.raises(InputError, match="leads out"):
        inside(root, "link.txt")


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("format",), "physgen-scene/9", "update PhysGen"),
        (("camera", "fx"), -1.0, "fx"),
        (("camera", "fx"), "50", r"scene\.json\.camera\.fx: expected a number"),
        (("camera", "world_from_camera"), [[1, 0], [0, 1]], "world_from_camera"),
        (("objects",), [], "at least one object"),
        (("objects", 0, "role"), "actor", "role"),
        (("objects", 0, "velocity"), [0, 0], "expected 3 entries"),
        (("objects", 0, "material", "poisson_ratio"), 0.5, "poisson_ratio"),
        (("objects", 0, "material", "density"), -3, "density"),
        (("objects", 0, "name"), "../evil", "object.name"),
        (("objects", 0, "colour"), "red", "unknown field"),
        (("ground", "normal"), [0, 0, 2], "unit vector"),
        (("gravity",), [0, 0, True], r"gravity\[2\]"),
    ],
)
def test_bad_fields_are_named(tmp_path, path, value, words):
    data = scene_to_json(a_scene())
    target = data
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(InputError, match=words):
        parse_scene(data, "scene.json")


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from([*scene_to_json(a_scene()), "x"]), inner, max_size=6)
    ),
    max_leaves=12,
)


@given(json_values)
def test_json_garbage_is_refused(value):
    data = {**scene_to_json(a_scene()), **value} if isinstance(value, dict) else value
    try:
        parse_scene(data, "scene.json")
    except InputError:
        return
    assert isinstance(data, dict)


@given(st.binary(max_size=300))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_byte_garbage_is_refused(tmp_path, content):
    (tmp_path / SCENE_FILE).write_bytes(content)
    with pytest.raises(InputError):
        load_scene(tmp_path)


def test_deep_nesting_does_not_crash_the_reader(tmp_path):
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(InputError, match="JSON"):
        read_json(tmp_path / "deep.json")


def test_presets_are_the_papers():
    assert {name: load_preset(name).youngs_modulus for name in ("soft", "medium", "hard")} == {
        "soft": 5e4,
        "medium": 5e5,
        "hard": 5e6,
    }
    assert all(load_preset(name).preset == name for name in preset_names())
    with pytest.raises(InputError, match="choose one of"):
        load_preset("unobtainium")
