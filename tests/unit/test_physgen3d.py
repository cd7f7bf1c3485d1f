# SPDX-License-Identifier: MIT
"""PhysGen3D's output folders: a made-up one whose truth is known, projected as its own renderer projects."""

import contextlib
import json
import math

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.batch.cli import main
from physgen.sim.errors import InputError
from physgen.sim.importers.physgen3d import TRANSFORM_FILE, read_physgen3d, read_settings
from physgen.sim.importers.physgen3d_scene import import_physgen3d
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.textured_mesh import read_textured_mesh
from PIL import Image
from scipy.spatial import ConvexHull

WIDTH, HEIGHT, TANGENT = 120, 80, 0.4
LABELS = ("teddy bear", "box")
DOWN = np.array([0.05, math.cos(0.6), math.sin(0.6)])
DOWN /= np.linalg.norm(DOWN)
CAMERA_HEIGHT = 0.5
"""Of the camera over the ground, in the folder's unit."""


def turn(axis, angle):
    return trimesh.transformations.rotation_matrix(angle, axis)[:3, :3]


def standing(vertices, *, at, scale, rotation):
    """Matrix of a mesh that stands on the ground below the camera axes' point ``at``."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    on_ground = np.asarray(at) + (CAMERA_HEIGHT - np.asarray(at) @ DOWN) * DOWN
    lowest = (vertices @ matrix[:3, :3].T @ DOWN).max()
    matrix[:3, 3] = on_ground - lowest * DOWN
    return matrix


def seen(points):
    """Pixels as rendering.py's camera has them: fov_x = 2 atan(fov[2]), the principal point in the middle."""
    focal = 0.5 * WIDTH / TANGENT
    return points[:, :2] / points[:, 2:] * focal + (WIDTH / 2, HEIGHT / 2)


MESHES = {"teddy1": trimesh.creation.icosphere(subdivisions=2), "box1": trimesh.creation.box((1.0, 0.6, 0.4))}
MATRICES = {
    "teddy1": standing(MESHES["teddy1"].vertices, at=(0.0, 0.0, 1.0), scale=0.1, rotation=turn((1, 2, 3), 0.7)),
    "box1": standing(MESHES["box1"].vertices, at=(0.3, 0.0, 1.4), scale=0.2, rotation=turn((0, 1, 0), 0.3)),
}


def shifted(name, way):
    matrix = MATRICES[name].copy()
    matrix[:3, 3] += way
    return matrix


def silhouette(name):
    """Where the object is seen: its corners' convex hull, as both meshes are convex. (H, W) bool."""
    matrix = MATRICES[name]
    pixels = seen(MESHES[name].vertices @ matrix[:3, :3].T + matrix[:3, 3])
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    inside = ConvexHull(pixels).equations @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    return (inside <= 0).all(axis=0).reshape(HEIGHT, WIDTH)


def transform(**changes):
    return {
        "matrices": [MATRICES[name].tolist() for name in MESHES],
        # Open3D's sign is arbitrary: this one points upward.
        "plane_model": [*(-DOWN), CAMERA_HEIGHT],
        "fov": [-TANGENT, -TANGENT * HEIGHT / WIDTH, TANGENT, TANGENT * HEIGHT / WIDTH],
        "object_names": list(MESHES),
        # As the descent leaves it: near the truth for the first object, moved off for the others (see the importer).
        "matrices_optimized": [MATRICES["teddy1"].tolist(), shifted("box1", (0.06, -0.02, 0.0)).tolist()],
        **changes,
    }


def write_textured(folder, name):
    """As InstantMesh writes it (``save_obj_with_mtl``): texture coordinates of their own for every corner."""
    mesh = MESHES[name]
    lines = [f"mtllib {name}.mtl"]
    lines += ["v {:f} {:f} {:f}".format(*v) for v in mesh.vertices]
    lines += [f"vt {0.1 + 0.8 * (i % 3 == 1):f} {0.1 + 0.8 * (i % 3 == 2):f}" for i in range(3 * len(mesh.faces))]
    lines += ["usemtl material_0"]
    for i, (a, b, c) in enumerate(mesh.faces + 1):
        lines.append(f"f {a}/{3 * i + 1} {b}/{3 * i + 2} {c}/{3 * i + 3}")
    (folder / f"{name}.obj").write_text("\n".join(lines))
    (folder / f"{name}.mtl").write_text(f"newmtl material_0\nKd 1 1 1\nmap_Kd {name}.png\n")
    Image.fromarray(np.full((32, 32, 3), 77, dtype=np.uint8)).save(folder / f"{name}.png")


@pytest.fixture
def output(tmp_path):
    root = tmp_path / "outputs" / "teddy"
    for sub in ("meshes", "mask", "inpaint"):
        (root / sub).mkdir(parents=True)
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(root / "raw_image.jpg")
    Image.fromarray(np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)).save(root / "inpaint" / "inpainted_all.jpg")
    for i, name in enumerate(MESHES):
        Image.fromarray(silhouette(name).astype(np.uint8) * 255).save(root / "mask" / f"mask_{i}.jpg")
    labels = [{"value": i + 1, "label": label, "logit": 0.5, "box": [1, 2, 3, 4]} for i, label in enumerate(LABELS)]
    (root / "mask" / "mask.json").write_text(json.dumps([{"value": 0, "label": "background"}, *labels]))
    write_textured(root / "meshes", "teddy1")
    # Without a texture map its meshes have colours at their vertices.
    MESHES["box1"].export(root / "meshes" / "box1.obj")
    (root / TRANSFORM_FILE).write_text(json.dumps(transform()))
    return root


def rewrite(root, **changes):
    (root / TRANSFORM_FILE).write_text(json.dumps(transform(**changes)))


def test_the_picture_stays_and_the_world_is_ours(output, tmp_path):
    folder = import_physgen3d(output, out=tmp_path / "scene", size_m=0.3)
    scene = folder.model
    assert [o.name for o in scene.objects] == list(MESHES)
    for item in scene.objects:
        vertices = load_object_mesh(folder, item).vertices
        matrix = MATRICES[item.name]
        truth = MESHES[item.name].vertices @ matrix[:3, :3].T + matrix[:3, 3]
        pixels = scene.camera.project(vertices)[:, :2]
        expected = seen(truth)
        nearest = np.linalg.norm(pixels[:, None] - expected[None], axis=2).min(axis=1)
        assert nearest.max() < 1e-3
        assert vertices[:, 2].min() == pytest.approx(0, abs=1e-6)
    first = load_object_mesh(folder, scene.objects[0]).vertices
    assert np.ptp(first, axis=0).max() == pytest.approx(0.3, rel=1e-6)
    assert np.allclose((first.min(axis=0) + first.max(axis=0))[:2], 0, atol=1e-6)
    # Right and away, and as high over the ground as the folder says, by the scale that the size sets.
    camera = np.asarray(scene.camera.world_from_camera)
    assert camera[0, 0] > 0.9 and camera[2, 0] == pytest.approx(-DOWN[0])
    assert camera[1, 2] > 0 > camera[2, 2]
    assert camera[2, 3] == pytest.approx(CAMERA_HEIGHT * 0.3 / 0.2, rel=1e-2)
    assert scene.objects[0].occlusion_order == 0 and scene.objects[1].occlusion_order == 1


def test_textures_masks_and_background_come_along(output, tmp_path):
    folder = import_physgen3d(output, out=tmp_path / "scene")
    teddy, box = folder.model.objects
    mesh = read_textured_mesh(folder.file(teddy.mesh))
    assert mesh.picture is not None and mesh.uv is not None
    # Every corner keeps its own texture coordinates.
    corners = mesh.uv[mesh.faces[5]]
    assert np.allclose(corners, [(0.1, 0.1), (0.9, 0.1), (0.1, 0.9)], atol=1e-6)
    assert read_textured_mesh(folder.file(box.mesh)).picture is None
    for item in (teddy, box):
        assert ((np.asarray(Image.open(folder.file(item.mask))) > 0) == silhouette(item.name)).mean() > 0.999
    assert np.abs(np.asarray(Image.open(folder.file("background.png"))).astype(int) - 90).max() < 3


def messages(events):
    return " ".join(event["message"] for event in events)


def points_of(folder, item):
    return load_object_mesh(folder, item).vertices


def test_the_better_of_two_poses_is_taken(output, tmp_path):
    """``perception.py`` fits every object to the first one's mask: the own mask decides."""
    wrong = [shifted("teddy1", (0.05, 0, 0)).tolist(), MATRICES["box1"].tolist()]
    for matrices, optimized in ((wrong, [MATRICES[n].tolist() for n in MESHES]), (None, None)):
        changes = {} if matrices is None else {"matrices": matrices, "matrices_optimized": optimized}
        rewrite(output, **changes)
        events = []
        folder = import_physgen3d(output, out=tmp_path / "scene", on_event=events.append)
        for item in folder.model.objects:
            matrix = MATRICES[item.name]
            expected = seen(MESHES[item.name].vertices @ matrix[:3, :3].T + matrix[:3, 3])
            pixels = folder.model.camera.project(points_of(folder, item))[:, :2]
            assert np.linalg.norm(pixels[:, None] - expected[None], axis=2).min(axis=1).max() < 1e-3
        # The default fixture has a bad improved pose of the box, and only of that.
        assert ("box1: its pose in matrices" in messages(events)) == (matrices is None)
        assert "teddy1: its pose" not in messages(events)


def test_an_improved_pose_without_a_mask_is_taken_if_it_is_near(output, tmp_path):
    (output / "mask" / "mask_1.jpg").unlink()
    near, far = shifted("box1", (0.02, 0, 0)), shifted("box1", (0.5, 0, 0))
    for improved, expected in ((near, near), (far, MATRICES["box1"]), (np.eye(4), MATRICES["box1"])):
        rewrite(output, matrices_optimized=[MATRICES["teddy1"].tolist(), improved.tolist()])
        folder = import_physgen3d(output, out=tmp_path / "scene")
        box = folder.model.objects[1]
        truth = seen(MESHES["box1"].vertices @ expected[:3, :3].T + expected[:3, 3])
        pixels = folder.model.camera.project(points_of(folder, box))[:, :2]
        # It is put on the ground along the rays, so the picture tells which it was.
        assert np.linalg.norm(pixels[:, None] - truth[None], axis=2).min(axis=1).max() < 1e-3
        assert box.mask is None


def test_all_four_borders_of_the_view_count(output, tmp_path):
    # The photo is cut from a larger one: its middle is not on the camera's axis. Square pixels, f = 150.
    left, top, right, bottom = -0.5, -0.3, 0.3, -0.3 + 0.8 * HEIGHT / WIDTH
    rewrite(output, fov=[left, top, right, bottom])
    camera = import_physgen3d(output, out=tmp_path / "scene").model.camera
    assert (camera.fx, camera.fy) == (pytest.approx(150), pytest.approx(150))
    assert (camera.cx, camera.cy) == (pytest.approx(75), pytest.approx(45))
    # DUSt3R crops the height about the middle to what 16 divides: pixels stay square, and the middle stays.
    rewrite(output, fov=[left, top + 0.02, right, bottom - 0.02])
    camera = import_physgen3d(output, out=tmp_path / "scene").model.camera
    assert (camera.fx, camera.fy) == (pytest.approx(150), pytest.approx(150))
    assert (camera.cx, camera.cy) == (pytest.approx(75), pytest.approx(45))


SIMULATION = """size: 2
R: 256
filling: false
pull_to_ground: true
E_default: 5.0e4
damping: 5.0
friction: 0.3
input_path: outputs/teddy
scale: 1.0
velocities:
  - [0.5, 0.25, 1.0]
  - [0.0, 0.0, -2.0]
"""


def world_axes(scene):
    """The world's axes on the camera's, as columns (3, 3)."""
    return np.asarray(scene.camera.world_from_camera)[:3, :3].T


def theirs(velocity):
    """As ``run_mpm_simulation`` has it, on the camera's axes: forward = down x right."""
    right = np.array([1.0, 0, 0])
    return velocity[1] * np.cross(DOWN, right) + velocity[2] * DOWN + velocity[0] * right


def test_the_settings_of_its_simulation(output, tmp_path):
    (output / "sim.yaml").write_text(SIMULATION)
    events = []
    scene = import_physgen3d(output, out=tmp_path / "scene", on_event=events.append).model
    for item, told in zip(scene.objects, ([0.5, 0.25, 1.0], [0, 0, -2.0]), strict=True):
        # Its unit is the metre: gravity is 9.8 of them.
        assert item.velocity == pytest.approx(world_axes(scene).T @ theirs(told), abs=1e-9)
        assert item.material.youngs_modulus == 5e4, "PyYAML takes 5.0e4 for a text"
    teddy, box = scene.objects
    assert teddy.velocity[2] == pytest.approx(-1.0 + 0.5 * -DOWN[0]), "down is down"
    assert box.velocity == pytest.approx((0, 0, 2), abs=1e-9)
    assert teddy.velocity[1] < 0, "what it calls forward points towards the camera"
    assert scene.ground.friction == 0.3
    assert teddy.size_m == pytest.approx(np.ptp(points_of_mesh("teddy1"), axis=0).max(), rel=1e-3)
    for words in ("not used: R, damping, filling, size", "as in PhysGen3D's simulation", "sim.yaml"):
        assert words in messages(events)
    assert "gravity of" not in messages(events)


def points_of_mesh(name):
    """On the world's axes, in the folder's unit."""
    right = np.array([1.0, 0, 0]) - DOWN[0] * DOWN
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(-DOWN, right), -DOWN])
    matrix = MATRICES[name]
    return (MESHES[name].vertices @ matrix[:3, :3].T) @ axes.T


def test_another_size_keeps_the_motion_in_the_picture(output, tmp_path):
    (output / "sim.yaml").write_text(SIMULATION)
    small = import_physgen3d(output, out=tmp_path / "a").model
    events = []
    large = import_physgen3d(
        output, out=tmp_path / "b", size_m=small.objects[0].size_m * 3, on_event=events.append
    ).model
    for a, b in zip(small.objects, large.objects, strict=True):
        assert np.asarray(b.velocity) == pytest.approx(3 * np.asarray(a.velocity), abs=1e-9)
    assert "simulated with a gravity of 29.4 m/s²" in messages(events)


def test_settings_lie_where_the_program_has_them_or_are_named(output, tmp_path, capsys):
    usual = tmp_path / "data" / "sim"
    usual.mkdir(parents=True)
    (usual / "teddy.yaml").write_text(SIMULATION)
    assert import_physgen3d(output, out=tmp_path / "a").model.ground.friction == 0.3
    (tmp_path / "mine.yaml").write_text("velocities: [0, 0, 1]\nfriction: 0.9\ninput_path: outputs/panda\n")
    arguments = ["import", str(output), "--out", str(tmp_path / "b"), "--settings", str(tmp_path / "mine.yaml")]
    assert main(arguments) == 0
    said = "".join(capsys.readouterr())
    assert "is for the folder panda, not for teddy" in said
    scene = load_scene(tmp_path / "b").model
    assert scene.ground.friction == 0.9
    assert all(item.velocity == pytest.approx((0, 0, -1), abs=1e-9) for item in scene.objects), "one for all"
    (output / "a.yaml").write_text(SIMULATION)
    (output / "b.yaml").write_text(SIMULATION)
    with pytest.raises(InputError, match=r"both a\.yaml and b\.yaml"):
        import_physgen3d(output, out=tmp_path / "c")


def test_objects_that_its_simulation_leaves_in_the_air_stay_there(output, tmp_path):
    lifted = MATRICES["teddy1"].copy()
    lifted[:3, 3] -= 0.03 * DOWN
    rewrite(output, matrices=[lifted.tolist(), MATRICES["box1"].tolist()], matrices_optimized=None)
    (output / "sim.yaml").write_text(SIMULATION.replace("pull_to_ground: true", "pull_to_ground: false"))
    folder = import_physgen3d(output, out=tmp_path / "scene")
    assert points_of(folder, folder.model.objects[0])[:, 2].min() == pytest.approx(0.03, rel=1e-6)


def test_inverse_rendering_output_is_used(output, tmp_path):
    Image.new("RGB", (32, 32), (10, 200, 10)).save(output / "meshes" / "teddy1_albedo.png")
    Image.new("L", (32, 32), 51).save(output / "meshes" / "teddy1_roughness.png")
    Image.new("L", (32, 32), 204).save(output / "meshes" / "teddy1_metallic.png")
    folder = import_physgen3d(output, out=tmp_path / "scene")
    mesh = trimesh.load(folder.file(folder.model.objects[0].mesh), force="mesh")
    material = mesh.visual.material
    assert (material.roughnessFactor, material.metallicFactor) == (pytest.approx(0.2), pytest.approx(0.8))
    assert material.baseColorTexture.getpixel((5, 5))[:3] == (10, 200, 10)


def test_labels(output):
    assert [item.kind for item in read_physgen3d(output).objects] == list(LABELS)
    (output / "mask" / "mask.json").rename(output / "mask.json")
    assert [item.kind for item in read_physgen3d(output).objects] == list(LABELS)
    (output / "mask.json").write_text('[{"value": 0}, {"value": 1, "label": 3}]')
    assert [item.kind for item in read_physgen3d(output).objects] == [None, None]


SETTINGS_BAD = {
    "no list": ("velocities: 5", "velocities: expected a list"),
    "two numbers": ("velocities: [[1, 2]]", r"velocities\[0\] is \[1, 2\]"),
    "words": ("velocities: [[a, b, c]]", r"velocities\[0\]\[0\] is 'a'"),
    "friction": ("friction: -1", "friction is -1"),
    "stiffness": ("E_default: soft", "E_default is 'soft'"),
    "scale": ("scale: 0", "scale is 0"),
    "pull": ("pull_to_ground: 3", "pull_to_ground is 3"),
    "a list": ("[1, 2]", "expected keys and values"),
}


@pytest.mark.parametrize("what", SETTINGS_BAD)
def test_mistakes_in_the_settings_are_named(output, tmp_path, what):
    text, words = SETTINGS_BAD[what]
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(InputError, match=rf"bad\.yaml: {words}"):
        import_physgen3d(output, out=tmp_path / "scene", settings=tmp_path / "bad.yaml")
    assert not (tmp_path / "scene").exists()


def test_an_object_near_the_ground_is_put_on_it_without_moving_in_the_picture(output, tmp_path):
    lifted = MATRICES["teddy1"].copy()
    lifted[:3, 3] -= 0.03 * DOWN
    far = MATRICES["box1"].copy()
    far[:3, 3] -= 0.3 * DOWN
    rewrite(output, matrices=[lifted.tolist(), far.tolist()], matrices_optimized=None)
    events = []
    folder = import_physgen3d(output, out=tmp_path / "scene", on_event=events.append)
    near, high = (load_object_mesh(folder, item).vertices for item in folder.model.objects)
    assert near[:, 2].min() == pytest.approx(0, abs=1e-6) and high[:, 2].min() > 0.05
    truth = MESHES["teddy1"].vertices @ lifted[:3, :3].T + lifted[:3, 3]
    pixels = folder.model.camera.project(near)[:, :2]
    assert np.linalg.norm(pixels[:, None] - seen(truth)[None], axis=2).min(axis=1).max() < 1e-3
    assert any("box1 does not stand on the ground" in event["message"] for event in events)


def test_matter_that_the_folder_names(output, tmp_path):
    rewrite(output, E=[5e4, 2e6], density=[300, 900])
    materials = [item.material for item in import_physgen3d(output, out=tmp_path / "scene").model.objects]
    assert [m.youngs_modulus for m in materials] == [5e4, 2e6] and [m.density for m in materials] == [300, 900]


def test_names_become_names_of_scenes(output, tmp_path):
    for suffix in ("obj", "png", "mtl"):
        (output / "meshes" / f"teddy1.{suffix}").rename(output / "meshes" / f"teddy.bär(1).{suffix}")
    rewrite(output, object_names=["teddy.bär(1)", "box1"])
    assert import_physgen3d(output, out=tmp_path / "scene").model.objects[0].name == "teddy_bär_1_"


def test_the_command(output, tmp_path, capsys):
    assert main(["import", str(output), "--out", str(tmp_path / "scene"), "--size", "0.2"]) == 0
    assert load_scene(tmp_path / "scene").model.objects[0].size_m == pytest.approx(0.2)
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "other")]) != 0
    assert "transform.json" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def skewed():
    matrix = np.eye(4)
    matrix[0, 1] = 0.5
    return [matrix.tolist()] * 2


MISTAKES = {
    "no objects": ({"object_names": []}, "object_names"),
    "a name that leads out": ({"object_names": ["../../x", "box1"]}, r"leads out|must be relative"),
    "a name twice": ({"object_names": ["box1", "box1"]}, "repeats a name"),
    "a matrix too few": ({"matrices": [np.eye(4).tolist()]}, "matrices: expected a list of 2"),
    "a skewed matrix": ({"matrices": skewed()}, "uniform scale"),
    "a mirroring matrix": ({"matrices": [np.diag([-1.0, 1, 1, 1]).tolist()] * 2}, "uniform scale"),
    "text in a matrix": ({"matrices": [[["a"] * 4] * 4] * 2}, r"matrices\[0\]"),
    "no plane": ({"plane_model": None}, "plane_model"),
    "a wall": ({"plane_model": [0, 0, 1, -2]}, "not a ground"),
    "a ceiling": ({"plane_model": [0, 1, 0, 2]}, "below that ground"),
    "no angle of view": ({"fov": [0, 0, 0, 0]}, "fov is"),
    "stiffness of garbage": ({"E": [-5, 5]}, "teddy1: .*youngs_modulus"),
    "infinite density": ({"density": [1e400, 5]}, "density"),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_mistakes_are_named_and_nothing_is_written(output, tmp_path, what):
    changes, words = MISTAKES[what]
    rewrite(output, **changes)
    with pytest.raises(InputError, match=words):
        import_physgen3d(output, out=tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]


@pytest.mark.parametrize("name", ["raw_image.jpg", "meshes/box1.obj", TRANSFORM_FILE])
def test_missing_and_damaged_files_are_named(output, tmp_path, name):
    (output / name).write_bytes(b"\x00garbage")
    with pytest.raises(InputError, match=name.split("/")[-1]):
        import_physgen3d(output, out=tmp_path / "scene")
    (output / name).unlink()
    with pytest.raises(InputError, match=name.split("/")[-1]):
        import_physgen3d(output, out=tmp_path / "scene")


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(sorted(transform())), value=json_values, whole=st.booleans())
def test_any_json_is_refused_or_read(output, key, value, whole):
    (output / TRANSFORM_FILE).write_text(json.dumps(value if whole else {**transform(), key: value}))
    with contextlib.suppress(InputError):
        read_physgen3d(output)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.dictionaries(
        st.sampled_from(["velocities", "friction", "E_default", "scale", "pull_to_ground", "input_path", "R"]),
        st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=5), st.lists, max_leaves=6),
    )
)
def test_any_settings_are_refused_or_read(tmp_path, data):
    # JSON is YAML, but for NaN and infinity, which are texts there.
    (tmp_path / "s.yaml").write_text(json.dumps(data))
    with contextlib.suppress(InputError):
        told = read_settings(tmp_path / "s.yaml")
        assert all(len(v) == 3 and np.isfinite(v).all() for v in told.velocities) and told.scale > 0


@pytest.mark.parametrize("unit", [1.0, 0.37])
def test_a_known_scene_comes_back(tmp_path, unit):
    """A scene with a camera of known place, written as PhysGen3D would have it, in units of ``unit`` metres.

    Tolerances: meshes are written with 8 decimals of at most 1, times sizes of at most 0.3 m, which moves the origin
    by as much; GLBs have 32 bits, 6e-8 of at most 1, times the same.
    """
    width, height, focal, centre = 320, 240, 400.0, (171.0, 109.0)
    pitch = 0.5
    # Columns are the camera's axes in the world: right, down, forward.
    axes = np.array(
        [
            [1, 0, 0],
            [0, -math.sin(pitch), math.cos(pitch)],
            [0, -math.cos(pitch), -math.sin(pitch)],
        ]
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, (0.1, -1.2, 0.7)
    meshes = {"ball1": trimesh.creation.icosphere(subdivisions=2), "brick1": trimesh.creation.box((1.0, 0.6, 0.4))}
    places = {
        "ball1": (0.1, (0.0, 0.0), turn((1, 2, 3), 0.7)),
        "brick1": (0.3, (0.25, 0.3), turn((0, 0, 1), 0.4)),
    }
    speeds = {"ball1": np.array([0.3, -0.2, 1.1]), "brick1": np.array([-0.5, 0.4, 0.0])}
    root = tmp_path / "outputs" / "known"
    (root / "meshes").mkdir(parents=True)
    for name, mesh in meshes.items():
        (root / "meshes" / f"{name}.obj").write_text(trimesh.exchange.obj.export_obj(mesh, digits=8))
    Image.new("RGB", (width, height), (90, 120, 30)).save(root / "raw_image.jpg")
    truth, matrices, velocities = {}, [], []
    up = axes.T @ (0, 0, 1.0)
    basis = np.stack([(1.0, 0, 0), np.cross(-up, (1.0, 0, 0)), -up], axis=1)
    for name, (scale, at, rotation) in places.items():
        world_from_mesh = np.eye(4)
        world_from_mesh[:3, :3] = scale * rotation
        turned = meshes[name].vertices @ world_from_mesh[:3, :3].T
        low, high = turned.min(axis=0), turned.max(axis=0)
        world_from_mesh[:3, 3] = (*(at - (low + high)[:2] / 2), -low[2])
        truth[name] = turned + world_from_mesh[:3, 3]
        matrix = np.linalg.inv(pose) @ world_from_mesh
        matrix[:3] /= unit
        matrices.append(matrix.tolist())
        velocities.append(np.linalg.solve(basis, axes.T @ speeds[name] / unit).tolist())
    borders = [-centre[0], -centre[1], width - centre[0], height - centre[1]]
    data = {
        "matrices": matrices,
        "plane_model": [*up, pose[2, 3] / unit],
        "fov": [b / focal for b in borders],
        "object_names": list(meshes),
    }
    (root / TRANSFORM_FILE).write_text(json.dumps(data))
    # With gravity as it is in its unit of length, the settings alone give the scale.
    (root / "sim.yaml").write_text(json.dumps({"velocities": velocities, "scale": 1 / unit, "friction": 0.25}))
    folder = import_physgen3d(root, out=tmp_path / "scene")
    scene = folder.model
    camera = np.asarray(scene.camera.world_from_camera)
    assert np.allclose(camera, pose, atol=1e-7)
    assert (scene.camera.fx, scene.camera.fy) == (pytest.approx(focal), pytest.approx(focal))
    assert (scene.camera.cx, scene.camera.cy) == (pytest.approx(centre[0]), pytest.approx(centre[1]))
    assert scene.ground.friction == 0.25 and scene.ground.point[2] == 0 and scene.ground.normal == (0, 0, 1)
    for item in scene.objects:
        found = points_of(folder, item)
        # A mesh in a GLB has 32 bits and perhaps more vertices than it came with.
        nearest = np.linalg.norm(found[:, None] - truth[item.name][None], axis=2)
        assert max(nearest.min(axis=0).max(), nearest.min(axis=1).max()) < 1e-6
        assert item.velocity == pytest.approx(speeds[item.name], abs=1e-9)
