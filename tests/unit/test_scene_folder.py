# SPDX-License-Identifier: MIT
"""The scene folder: what is written comes back, garbage is refused by name, nothing leads out of the folder."""

import contextlib
import io
import json
import tomllib
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.mpm.surface_contact import GROUND_NAME, MODES
from physgen.sim.scene.folder import (
    SCENE_FILE,
    Scene,
    inside,
    load_scene,
    parse_scene,
    referenced_files,
    require_photo,
    save_scene,
    scene_to_json,
)
from physgen.sim.scene.material import PRESET_FOLDER, load_preset, preset_names
from physgen.sim.scene.meshes import load_vertex_track
from physgen.sim.scene.model import (
    CONTACT_MODES,
    GROUND,
    IDENTITY4,
    LAWS,
    Box,
    Camera,
    Contact,
    Effect,
    Ground,
    Key,
    Light,
    Material,
    Motion,
    SceneModel,
    SceneObject,
)
from physgen.sim.scene.overrides import apply_overrides, without_physics
from physgen.sim.validation import read_json

positive = st.floats(0.01, 1e4, allow_nan=False)
# Libraries built with -ffast-math, which other tests load, switch the processor to flush subnormal numbers to zero.
number = st.floats(-1e6, 1e6, allow_nan=False, allow_subnormal=False)
vector = st.tuples(number, number, number)


def a_scene(**changes):
    camera = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=IDENTITY4)
    item = SceneObject(name="cup", mesh="meshes/cup.glb", size_m=0.1, mask="masks/cup.png")
    return SceneModel(**{"camera": camera, "objects": (item,), **changes})


times = st.lists(number, max_size=3, unique=True).map(sorted)
share = st.floats(0, 1, allow_subnormal=False)


@st.composite
def tracks(draw):
    return tuple(Key(time_s=time, value=draw(vector)) for time in draw(times))


@st.composite
def boxes(draw):
    low = draw(vector)
    return Box(low=low, high=tuple(c + draw(positive) for c in low))


@st.composite
def surfaces(draw):
    friction = draw(st.none() | share)
    static = None if friction is None else draw(st.none() | st.just(friction + 1))
    return {
        "friction": friction,
        "static_friction": static,
        "restitution": draw(st.none() | share),
    }


@st.composite
def roles(draw):
    if draw(st.booleans()):
        motion = st.builds(Motion, translations=tracks(), rotations=tracks(), pivot=st.none() | vector)
        deforming = st.just(Motion(vertices_file="meshes/moving.npz"))
        return {"role": "collider", "motion": draw(st.none() | motion | deforming)}
    pins = tuple(draw(st.lists(boxes(), max_size=2)))
    return {
        "asleep": draw(st.booleans()),
        "held": draw(st.booleans()),
        "start_time": draw(share),
        "acceleration": draw(tracks()),
        "velocity_keys": draw(tracks()),
        "pins": pins,
        "pin_motion": draw(tracks()) if pins else (),
        "goal_stiffness": draw(share),
        "goal_damping": draw(share),
    }


@st.composite
def scenes(draw):
    material = Material(
        law=draw(st.sampled_from(LAWS)),
        fibre_modulus=draw(st.floats(0, 1e12, allow_subnormal=False)),
        fibre_axis=draw(st.sampled_from([(0.0, 0.0, 1.0), (0.6, -0.8, 0.0)])),
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
            roughness=draw(st.none() | share),
            shell_thickness=draw(st.none() | positive.map(lambda x: x / 100)),
            contact_mode=draw(st.sampled_from([None, *CONTACT_MODES])),
            **draw(surfaces()),
            **draw(roles()),
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
        gravity_track=tuple(Key(time_s=k.time_s, value=(0.0, 0.0, k.value[2] / 1e3)) for k in draw(tracks())),
        contacts=tuple(
            Contact(between=(name, GROUND), mode=draw(st.sampled_from([None, *CONTACT_MODES])), **draw(surfaces()))
            for name in names[:2]
            if name != GROUND
        ),
        light=Light(),
    )


@given(scenes())
@settings(max_examples=60)
def test_scene_round_trip(scene):
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
    assert load_scene(tmp_path).model == a_scene()
    assert repr(load_scene(tmp_path)) == f"Scene(root={str(tmp_path)!r}, objects: cup)"
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
        (("gravity_track",), [{"time_s": 0, "value": [0, 0, 1e5]}], r"gravity_track\[0\]\.value"),
        (("gravity_track",), [{"time_s": 1, "value": [0, 0, 0]}, {"time_s": 1, "value": [0, 0, 0]}], "rising times"),
        (("gravity_track",), [{"time": 1}], r"gravity_track\[0\]\.time: unknown field"),
        (("contacts",), [{"between": ["cup", "mug"]}], "no object 'mug'"),
        (("contacts",), [{"between": ["cup", "cup"]}], "two different things"),
        (("contacts",), [{"between": ["cup", "ground"]}, {"between": ["ground", "cup"]}], "every pair once"),
        (("contacts",), [{"between": ["cup", "ground"], "friction": -1}], "contact.friction"),
        (("contacts",), [{"between": ["cup", "ground"], "mode": "glue"}], "contact.mode.*separate"),
        (("objects", 0, "material", "poisson_ratio"), -0.1, "poisson_ratio"),
        (("objects", 0, "material", "youngs_modulus"), float("nan"), "youngs_modulus: expected a finite number"),
        (("objects", 0, "material", "fibre_axis"), [0, 0, 2], "fibre_axis.*unit vector"),
        (("objects", 0, "material", "fibre_modulus"), -1, "fibre_modulus"),
        (("objects", 0, "material", "law"), "rigid body", "law.*rigid"),
        (("objects", 0, "roughness"), 1.5, "object cup: roughness.*0 to 1"),
        (("objects", 0, "static_friction"), 0.5, "object cup.static_friction.*friction"),
        (("objects", 0, "restitution"), 2, "restitution"),
        (("objects", 0, "contact_mode"), "glue", "mode"),
        (("objects", 0, "start_time"), -1, "start_time"),
        (("objects", 0, "pins"), [{"low": [0, 0, 0], "high": [1, 0, 1]}], r"pins\[0\]: high"),
        (("objects", 0, "pin_motion"), [{"time_s": 0, "value": [0, 0, 0]}], "pin_motion.*pins"),
        (("objects", 0, "goal_damping"), 2, "goal_damping"),
        (("objects", 0, "motion"), {}, "role 'collider'"),
        (("objects", 0, "shell_thickness"), 0, "shell_thickness"),
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


def test_the_engine_knows_the_modes_and_the_ground_by_the_same_names():
    assert (CONTACT_MODES, GROUND) == (MODES, GROUND_NAME)


def test_an_old_scene_still_loads():
    """What scenes were before surfaces, tracks and contacts; it means the same as it did."""
    new = scene_to_json(a_scene())
    item = {key: new["objects"][0][key] for key in ("name", "mesh", "world_from_mesh", "size_m", "role", "material")}
    item["material"] = {"preset": "soft", "density": 200.0, "youngs_modulus": 5e4, "poisson_ratio": 0.3}
    old = {key: new[key] for key in ("format", "camera", "ground", "gravity", "effects", "light", "photo")}
    loaded = parse_scene({**old, "objects": [item]}, "scene.json")
    cup = loaded.objects[0]
    assert (cup.motion, cup.friction, cup.pins, loaded.contacts, loaded.gravity_track) == (None, None, (), (), ())


def test_a_collider_has_no_tracks_of_a_dynamic_object():
    with pytest.raises(InputError, match=r"acceleration.*role 'dynamic'"):
        SceneObject(name="a", mesh="-", size_m=1.0, role="collider", acceleration=(Key(time_s=0.0, value=(0, 0, 1)),))


def a_vertex_track(path, **arrays):
    np.savez(path, **{"times": np.arange(3.0), "vertices": np.ones((3, 4, 3)), **arrays})
    return path


def test_a_vertex_track_is_read(tmp_path):
    times, vertices = load_vertex_track(a_vertex_track(tmp_path / "a.npz"), 4)
    assert np.array_equal(times, [0, 1, 2]) and np.array_equal(vertices, np.ones((3, 4, 3)))


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"times": np.zeros(3)}, "rising order"),
        ({"times": np.arange(2.0)}, "vertices has shape"),
        ({"vertices": np.ones((3, 5, 3))}, r"vertices has shape.*\(3, 4, 3\)"),
        ({"vertices": np.full((3, 4, 3), np.nan)}, "not finite"),
        ({"vertices": np.array([{"a": 1}], dtype=object)}, "give numbers|pickle|not readable"),
        ({"vertices": np.array(["x"])}, "give numbers"),
    ],
)
def test_a_bad_vertex_track_is_an_input_error(tmp_path, arrays, words):
    with pytest.raises(InputError, match=words):
        load_vertex_track(a_vertex_track(tmp_path / "a.npz", **arrays), 4)


def test_a_vertex_track_of_other_content_is_an_input_error(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(InputError, match="no such file"):
        load_vertex_track(path, 4)
    whole = a_vertex_track(path).read_bytes()
    np.savez(path, times=np.arange(3.0))
    with pytest.raises(InputError, match="no array 'vertices'"):
        load_vertex_track(path, 4)
    for content in (b"", b"garbage", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"numpy\.savez"):
            load_vertex_track(path, 4)


def test_a_vertex_track_that_claims_too_much_is_refused_unread(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6, 3)})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("times.npy", header.getvalue())
        archive.writestr("vertices.npy", header.getvalue())
    with pytest.raises(InputError, match="more than 1024 MiB"):
        load_vertex_track(tmp_path / "a.npz", 4)


@given(st.binary(max_size=400))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
def test_damaged_vertex_tracks_are_refused(tmp_path, content):
    whole = a_vertex_track(tmp_path / "a.npz").read_bytes()
    cut = len(content) * len(whole) // 400
    (tmp_path / "b.npz").write_bytes(whole[:cut] + content + whole[cut + len(content) :])
    with contextlib.suppress(InputError):
        load_vertex_track(tmp_path / "b.npz", 4)


def test_a_scene_needs_its_vertex_track_inside_the_folder(tmp_path):
    def scene(name):
        wall = SceneObject(
            name="wall", mesh="meshes/cup.glb", size_m=1.0, role="collider", motion=Motion(vertices_file=name)
        )
        return a_scene(objects=(*a_scene().objects, wall))

    write_files(tmp_path, scene("meshes/wall.npz"))
    with pytest.raises(InputError, match=r"meshes/wall\.npz.*is missing"):
        load_scene(tmp_path)
    with pytest.raises(InputError, match="file name"):
        save_scene(tmp_path, scene("../wall.npz"))


def test_every_preset_says_where_its_numbers_are_from():
    for name in preset_names():
        data = tomllib.loads((PRESET_FOLDER / f"{name}.toml").read_text(encoding="utf-8"))
        assert len(data["description"]) > 4 and len(data["source"]) > 40, name
    assert {name for name in preset_names() if load_preset(name).law == "rigid"} == {"metal", "wood"}


def test_presets_are_the_papers():
    assert {name: load_preset(name).youngs_modulus for name in ("soft", "medium", "hard")} == {
        "soft": 5e4,
        "medium": 5e5,
        "hard": 5e6,
    }
    assert all(load_preset(name).preset == name for name in preset_names())
    with pytest.raises(InputError, match="choose one of"):
        load_preset("unobtainium")


def test_a_scene_may_have_neither_photo_nor_ground(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "cup.glb").write_bytes(b"")
    item = SceneObject(name="cup", mesh="meshes/cup.glb", size_m=0.1)
    scene = a_scene(objects=(item,), photo=None, background=None, ground=None)
    save_scene(tmp_path, scene)
    folder = load_scene(tmp_path)
    assert folder.model == scene and referenced_files(scene) == ["meshes/cup.glb"]
    with pytest.raises(InputError, match="no photo to render into; render it in Blender"):
        require_photo(folder)
    with pytest.raises(InputError, match="no ground"):
        require_photo(Scene(root=tmp_path, model=a_scene(ground=None)))
    assert require_photo(Scene(root=tmp_path, model=a_scene())) == ("photo.png", "background.png", Ground())
    with pytest.raises(InputError, match="null for both"):
        a_scene(photo=None)


def test_contacts_of_missing_objects_are_refused():
    pair = Contact(between=("cup", GROUND), friction=0.2)
    assert a_scene(contacts=(pair,)).contacts == (pair,)
    with pytest.raises(InputError, match="there is no ground; choose two of cup"):
        a_scene(contacts=(pair,), ground=None)
    with pytest.raises(InputError, match="the scene has no ground"):
        apply_overrides(a_scene(ground=None), ["ground.friction=0.2"])
    assert without_physics(a_scene(ground=None), 0.3).ground is None


@pytest.mark.parametrize("scale", [1e-7, 1.0, 1e5])
def test_any_matrix_that_can_be_undone_places_a_mesh(scale):
    def placed(matrix):
        return SceneObject(name="cup", mesh="cup.glb", size_m=0.1, world_from_mesh=matrix)

    rows = np.eye(4)
    rows[:3] *= scale
    for change in (
        np.eye(3),
        np.diag([1.0, 1e-3, 30.0]),
        np.diag([-1.0, 1.0, 1.0]),
        [[1, 0.9, 0], [0, 1, 0], [0, 0, 1]],
    ):
        matrix = rows.copy()
        matrix[:3, :3] = matrix[:3, :3] @ change
        placed(tuple(map(tuple, matrix.tolist())))
    flat = rows.copy()
    flat[2, 2] = 0.0
    tilted = rows.copy()
    tilted[3, 0] = 0.5
    for matrix in (flat, tilted, np.full((4, 4), np.nan)):
        with pytest.raises(InputError, match=r"object cup: world_from_mesh.*invertible"):
            placed(tuple(map(tuple, matrix.tolist())))
