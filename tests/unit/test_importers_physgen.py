# SPDX-License-Identifier: MIT
"""PhysGen's folders, written here as the program has them; and YAML, as people and attackers write it."""

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.errors import InputError
from physgen.sim.importers.physgen import import_physgen, object_requests, read_physgen, with_motion
from physgen.sim.reconstruct import ReconstructOptions
from physgen.sim.scene.folder import Scene, save_scene
from physgen.sim.scene.model import Camera, Ground, SceneModel, SceneObject
from physgen.sim.validation import MAX_YAML_BYTES, checked_number, read_yaml
from PIL import Image

WIDTH, HEIGHT = 160, 120
SETTINGS = """
# general setting
cat: toys
animation_frames: 16
size: [160, 120]
num_steps: 200
display: false
gravity: 980
init_velocity:
  1: [98, -196.2]
init_acc:
  3: [-49, 0]
edge_list: [[[0, 110], [160, 110]]]
obj_info:
  1:
    label: ball
    mass: 100
    density:
    friction: 0.5
    elasticity: 0.8
    primitive: circle
  3:
    label: toy box
    mass:
    density: 2.0
    friction: 0.3
    elasticity: 0.2
    primitive: polygon
denoise_strength: 0.3
"""


@pytest.fixture
def root(tmp_path):
    folder = tmp_path / "toys"
    folder.mkdir()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    ids = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    ids[(x - 45) ** 2 + (y - 85) ** 2 < 22**2] = 1
    ids[60:105, 95:130] = 3
    ids[5:15, 5:15] = 2
    noise = np.random.default_rng(0).normal(0, 4, (HEIGHT, WIDTH, 3))
    ground = np.full((HEIGHT, WIDTH, 3), (150, 140, 130)) + noise
    photo = ground.copy()
    photo[ids == 1] += (90, -90, -90)
    photo[ids == 3] += (-100, -40, 90)
    photo[ids == 2] = 20
    for name, picture in (("original", photo), ("inpaint", ground)):
        Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8)).save(folder / f"{name}.png")
    Image.fromarray(ids).save(folder / "mask.png")
    (folder / "sim.yaml").write_text(SETTINGS)
    return folder


def test_all_files_are_read(root):
    found = read_physgen(root)
    ball, box = found.objects
    assert (ball.number, ball.label, ball.mass, ball.friction, ball.elasticity) == (1, "ball", 100, 0.5, 0.8)
    assert ball.velocity == (98, -196.2)
    # An impulse of acceleration times mass changes the velocity by the acceleration's number.
    assert box.velocity == (-49, 0) and box.label == "toy box"
    assert box.mass == pytest.approx(2.0 * 45 * 35) and box.mask.sum() == 45 * 35
    assert (found.gravity, found.walls, found.ground_friction, found.ground_elasticity) == (980, 1, 1, 0)
    assert found.unused == ("animation_frames", "denoise_strength", "display", "num_steps")


def test_the_requests(root, tmp_path):
    ball, box = object_requests(read_physgen(root), tmp_path)
    assert (ball.name, ball.kind, box.name) == ("ball", "ball", "toy box")
    assert box.box == (95, 60, 130, 105)
    assert np.asarray(Image.open(box.mask)).sum() == 255 * 45 * 35
    # 980 pixels/s² are 9.81 m/s² where a pixel is about a centimetre; the ball is 43 pixels wide.
    assert ball.size_m == pytest.approx(43 * 9.81 / 980) and box.size_m is None
    assert object_requests(read_physgen(root), tmp_path, 0.2)[0].size_m == 0.2


def cubes(tmp_path, distance, focal=200.0):
    """A scene of two cubes of 0.5 m side by side, seen along +Y from ``distance`` m."""
    (tmp_path / "meshes").mkdir()
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    for i, name in enumerate(("ball", "box")):
        lines = ["v {} {} {}".format(*(c + np.array([i, -0.25, 0]))) for c in corners]
        lines += ["f " + " ".join(str(k + 1) for k in (a, b, c)) for q in quads for a, b, c in (q[:3], (q[0], *q[2:]))]
        (tmp_path / "meshes" / f"{name}.obj").write_text("\n".join(lines))
    for name in ("photo.png", "background.png"):
        Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / name)
    pose = ((1.0, 0, 0, 0), (0, 0, 1.0, -distance), (0, -1.0, 0, 0.25), (0, 0, 0, 1.0))
    camera = Camera(width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=80, cy=60, world_from_camera=pose)
    objects = tuple(SceneObject(name=name, mesh=f"meshes/{name}.obj", size_m=0.5) for name in ("ball", "box"))
    return save_scene(tmp_path, SceneModel(camera=camera, objects=objects, ground=Ground()))


@pytest.mark.parametrize("distance", [0.5, 2.0, 30.0])
def test_a_path_in_the_picture_stays_the_same(root, tmp_path, distance):
    folder = cubes(tmp_path, distance)
    source = read_physgen(root)
    scene = with_motion(source, folder, lambda text: None)
    for item, made in zip(source.objects, scene.objects, strict=True):
        middle = np.array([0.25 + (made.name == "box"), 0.0, 0.25])
        vx, vz = made.velocity[0], made.velocity[2]
        assert made.velocity[1] == 0
        # Until it has gone the same way sideways, it must have risen and fallen the same number of pixels.
        if item.velocity[1] == 0:
            continue
        there = 0.3 * item.velocity[0] / 980
        theirs = np.array([item.velocity[0] * there, item.velocity[1] * there + 490 * there**2])
        ours_t = theirs[0] * distance / 200 / vx
        after = middle + np.array([vx * ours_t, 0, vz * ours_t - 9.81 / 2 * ours_t**2])
        moved = scene.camera.project(after)[:2] - scene.camera.project(middle)[:2]
        assert moved == pytest.approx(theirs, rel=1e-9)
    if distance == 2.0:
        # A pixel is a centimetre at 2 m and 200 pixels of focal length: then the seconds are theirs, too, but for
        # 9.81 against 9.80.
        assert scene.objects[0].velocity == pytest.approx((0.98, 0, 1.962), rel=1e-3)


def test_masses_and_surfaces(root, tmp_path):
    scene = with_motion(read_physgen(root), cubes(tmp_path, 2.0), lambda text: None)
    ball, box = scene.objects
    assert box.material.density / ball.material.density == pytest.approx(2.0 * 45 * 35 / 100)
    assert ball.material.law == "rigid" and (ball.friction, ball.restitution) == (0.5, 0.8)
    assert (ball.material.density + box.material.density) / 2 == pytest.approx(1000)
    pairs = {c.between: (c.friction, c.restitution) for c in scene.contacts}
    assert pairs[("ball", "box")] == pytest.approx((0.15, 0.16)) and pairs[("ball", "ground")] == (0.5, 0.0)
    assert scene.ground.friction == 1 and scene.ground.restitution == 0


def test_without_gravity_it_is_seen_from_above(root, tmp_path):
    (root / "sim.yaml").write_text(SETTINGS.replace("gravity: 980", "gravity: 0"))
    source = read_physgen(root)
    assert object_requests(source, tmp_path)[0].size_m is None
    scene = with_motion(source, cubes(tmp_path, 2.0), lambda text: None)
    assert scene.objects[0].velocity == pytest.approx((0.98, 1.962, 0))


@pytest.mark.long
def test_the_whole_way(first_fill, root, tmp_path, capsys):
    out = tmp_path / "scene"
    events = []
    folder = import_physgen(
        root, out=out, options=ReconstructOptions(mesh_vertices=500, sun=False), on_event=events.append
    )
    assert isinstance(folder, Scene) and [o.name for o in folder.model.objects] == ["ball", "toy box"]
    notices = " ".join(e["message"] for e in events if e["event"] == "notice")
    for words in ("1 walls (edge_list)", "not used: animation_frames", "ratios are kept"):
        assert words in notices
    found = np.asarray(Image.open(folder.file(folder.model.objects[1].mask))) > 127
    truth = np.asarray(Image.open(root / "mask.png")) == 3
    assert (found & truth).sum() / (found | truth).sum() > 0.9
    assert folder.model.objects[0].velocity[0] > 0 > folder.model.objects[1].velocity[0]
    assert folder.model.objects[0].velocity[2] > 0
    assert list(tmp_path.glob(".scene*")) == []
    assert main(["import", str(root), "--out", str(tmp_path / "no"), "--settings", "x.yaml"]) != 0
    assert "omit the flag" in capsys.readouterr().err


BAD = {
    "no object": ("obj_info: {}", "obj_info: expected 1 to 256"),
    "a list": ("- 1\n- 2", "expected keys and values"),
    "no pixels": ("obj_info: {77: {label: x}}", "no pixel of that number"),
    "a number that is none": ("obj_info: {-1: {label: x}}", "'-1' is not the number"),
    "a mass of nothing": ("obj_info: {1: {mass: 0}}", r"obj_info\[1\].mass is 0: expected a number"),
    "a mass of text": ("obj_info: {1: {mass: heavy}}", "mass is 'heavy'"),
    "friction below 0": ("obj_info: {1: {friction: -1}}", "friction is -1"),
    "endless gravity": ("gravity: .inf\nobj_info: {1: {}}", "gravity is inf"),
    "velocity of three": ("init_velocity: {1: [1, 2, 3]}\nobj_info: {1: {}}", "list of 2 numbers"),
}


@pytest.mark.parametrize("what", BAD)
def test_mistakes_are_named(root, what):
    text, words = BAD[what]
    (root / "sim.yaml").write_text(text)
    with pytest.raises(InputError, match=rf"(?s)sim\.yaml.*{words}"):
        read_physgen(root)


@pytest.mark.parametrize("name", ["sim.yaml", "mask.png", "original.png"])
def test_missing_and_damaged_files_are_named(root, tmp_path, name):
    (root / name).write_bytes(b"\x00garbage")
    with pytest.raises(InputError, match=name):
        import_physgen(root, out=tmp_path / "scene")
    (root / name).unlink()
    with pytest.raises(InputError, match=name):
        import_physgen(root, out=tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_a_folder_of_neither_program(tmp_path, capsys):
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "x")]) != 0
    assert "contains neither transform.json" in capsys.readouterr().err


def yaml_of(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_yaml(path)


YAML_BAD = {
    "aliases": "a: &x [1, 2]\nb: *x",
    "a bomb": "a: &a [x, x]\n"
    + "\n".join(f"{c}: &{c} [*{b}, *{b}]" for b, c in zip("abcdefgh", "bcdefghi", strict=True)),
    "merged": "a: &a {b: 1}\nc:\n  <<: *a",
    "objects": "a: !!python/object/apply:os.system ['true']",
    "deep": "[" * 5_000,
    "a date that is none": "a: 2001-99-99",
    "bytes": b"\xff\xfe\x00a",
    "tabs": "a:\n\t- b",
    "two documents": "a: 1\n---\nb: 2",
    "a list as key": "? [1, 2]\n: 3",
}


@pytest.mark.parametrize("what", YAML_BAD)
def test_yaml_that_is_refused(tmp_path, what):
    with pytest.raises(InputError, match=r"x\.yaml"):
        yaml_of(tmp_path / "x.yaml", YAML_BAD[what])


def test_yaml_is_bounded(tmp_path):
    with pytest.raises(InputError, match="larger than 64 KiB"):
        yaml_of(tmp_path / "x.yaml", "a: " + "x" * MAX_YAML_BYTES)


def test_numbers_as_people_write_them():
    assert checked_number("5.0e4", "x", 0, 1e6) == 5e4 and checked_number(3, "x", 0, 9) == 3.0
    for value in (True, None, "nan", float("nan"), "five", [], 10**400, "1e999"):
        with pytest.raises(InputError, match="x is"):
            checked_number(value, "x", 0, 9)


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.integers(0, 4) | st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.fixed_dictionaries(
        {
            "obj_info": plain
            | st.dictionaries(
                st.integers(1, 3),
                st.dictionaries(
                    st.sampled_from(["label", "mass", "density", "friction", "elasticity", "primitive"]),
                    plain,
                    max_size=3,
                ),
                min_size=1,
            )
        },
        optional=dict.fromkeys(("init_velocity", "init_acc", "edge_list", "gravity", "size"), plain),
    )
)
def test_any_settings_are_refused_or_read(root, data):
    import yaml

    (root / "sim.yaml").write_text(yaml.safe_dump(data, allow_unicode=True), encoding="utf-8")
    with contextlib.suppress(InputError):
        found = read_physgen(root)
        assert all(o.mass > 0 and np.isfinite(o.velocity).all() for o in found.objects) and found.gravity >= 0


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(max_size=60) | st.binary(max_size=60))
def test_any_yaml_is_refused_or_read(tmp_path, text):
    with contextlib.suppress(InputError, UnicodeEncodeError):
        yaml_of(tmp_path / "x.yaml", text)
