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
from physgen.sim.app.import_physgen3d import import_physgen3d
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.glb import read_textured_mesh
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.physgen3d import TRANSFORM_FILE, read_physgen3d
from PIL import Image

WIDTH, HEIGHT, TANGENT = 120, 80, 0.4
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


def transform(**changes):
    return {
        "matrices": [MATRICES[name].tolist() for name in MESHES],
        # Open3D's sign is arbitrary: this one points upward.
        "plane_model": [*(-DOWN), CAMERA_HEIGHT],
        "fov": [-TANGENT, -TANGENT * HEIGHT / WIDTH, TANGENT, TANGENT * HEIGHT / WIDTH],
        "object_names": list(MESHES),
        "matrices_optimized": [np.eye(4).tolist()] * 2,
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
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[30:50, 50:70] = 255
    Image.fromarray(mask).save(root / "mask" / "mask_0.jpg")
    write_textured(root / "meshes", "teddy1")
    # Without a texture map its meshes have colours at their vertices.
    MESHES["box1"].export(root / "meshes" / "box1.obj")
    (root / TRANSFORM_FILE).write_text(json.dumps(transform()))
    return root


def rewrite(root, **changes):
    (root / TRANSFORM_FILE).write_text(json.dumps(transform(**changes)))


def test_the_picture_stays_and_the_world_is_ours(output, tmp_path):
    folder = import_physgen3d(output, tmp_path / "scene", size_m=0.3)
    scene = folder.scene
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
    folder = import_physgen3d(output, tmp_path / "scene")
    teddy, box = folder.scene.objects
    mesh = read_textured_mesh(folder.file(teddy.mesh))
    assert mesh.picture is not None and mesh.uv is not None
    # Every corner keeps its own texture coordinates.
    corners = mesh.uv[mesh.faces[5]]
    assert np.allclose(corners, [(0.1, 0.1), (0.9, 0.1), (0.1, 0.9)], atol=1e-6)
    assert read_textured_mesh(folder.file(box.mesh)).picture is None
    mask = np.asarray(Image.open(folder.file(teddy.mask)))
    assert mask[40, 60] == 255 and mask[10, 10] == 0 and box.mask is None
    assert np.abs(np.asarray(Image.open(folder.file("background.png"))).astype(int) - 90).max() < 3


def test_an_object_near_the_ground_is_put_on_it_without_moving_in_the_picture(output, tmp_path):
    lifted = MATRICES["teddy1"].copy()
    lifted[:3, 3] -= 0.03 * DOWN
    far = MATRICES["box1"].copy()
    far[:3, 3] -= 0.3 * DOWN
    rewrite(output, matrices=[lifted.tolist(), far.tolist()])
    events = []
    folder = import_physgen3d(output, tmp_path / "scene", on_event=events.append)
    near, high = (load_object_mesh(folder, item).vertices for item in folder.scene.objects)
    assert near[:, 2].min() == pytest.approx(0, abs=1e-6) and high[:, 2].min() > 0.05
    truth = MESHES["teddy1"].vertices @ lifted[:3, :3].T + lifted[:3, 3]
    pixels = folder.scene.camera.project(near)[:, :2]
    assert np.linalg.norm(pixels[:, None] - seen(truth)[None], axis=2).min(axis=1).max() < 1e-3
    assert any("box1 does not stand on the ground" in event["message"] for event in events)


def test_matter_that_the_folder_names(output, tmp_path):
    rewrite(output, E=[5e4, 2e6], density=[300, 900])
    materials = [item.material for item in import_physgen3d(output, tmp_path / "scene").scene.objects]
    assert [m.youngs_modulus for m in materials] == [5e4, 2e6] and [m.density for m in materials] == [300, 900]


def test_names_become_names_of_scenes(output, tmp_path):
    for suffix in ("obj", "png", "mtl"):
        (output / "meshes" / f"teddy1.{suffix}").rename(output / "meshes" / f"teddy.bär(1).{suffix}")
    rewrite(output, object_names=["teddy.bär(1)", "box1"])
    assert import_physgen3d(output, tmp_path / "scene").scene.objects[0].name == "teddy_bär_1_"


def test_the_command(output, tmp_path, capsys):
    assert main(["import", str(output), "--out", str(tmp_path / "scene"), "--size", "0.2"]) == 0
    assert load_scene(tmp_path / "scene").scene.objects[0].size_m == pytest.approx(0.2)
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
    "a name twice": ({"object_names": ["box1", "box1"]}, "twice"),
    "a matrix too few": ({"matrices": [np.eye(4).tolist()]}, "matrices: expected a list of 2"),
    "a skewed matrix": ({"matrices": skewed()}, "one scale"),
    "a mirroring matrix": ({"matrices": [np.diag([-1.0, 1, 1, 1]).tolist()] * 2}, "one scale"),
    "text in a matrix": ({"matrices": [[["a"] * 4] * 4] * 2}, r"matrices\[0\]"),
    "no plane": ({"plane_model": None}, "plane_model"),
    "a wall": ({"plane_model": [0, 0, 1, -2]}, "no ground"),
    "a ceiling": ({"plane_model": [0, 1, 0, 2]}, "below that ground"),
    "no angle of view": ({"fov": [0, 0, 0, 0]}, r"fov\[2\]"),
    "stiffness of garbage": ({"E": [-5, 5]}, "teddy1: .*youngs_modulus"),
    "infinite density": ({"density": [1e400, 5]}, "density"),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_mistakes_are_named_and_nothing_is_written(output, tmp_path, what):
    changes, words = MISTAKES[what]
    rewrite(output, **changes)
    with pytest.raises(InputError, match=words):
        import_physgen3d(output, tmp_path / "scene")
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]


@pytest.mark.parametrize("name", ["raw_image.jpg", "meshes/box1.obj", TRANSFORM_FILE])
def test_missing_and_damaged_files_are_named(output, tmp_path, name):
    (output / name).write_bytes(b"\x00garbage")
    with pytest.raises(InputError, match=name.split("/")[-1]):
        import_physgen3d(output, tmp_path / "scene")
    (output / name).unlink()
    with pytest.raises(InputError, match=name.split("/")[-1]):
        import_physgen3d(output, tmp_path / "scene")


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
