# SPDX-License-Identifier: MIT
"""Views from folders and from the pictures of generators: cameras, masks, labels, and what is wrong with them."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.gaussians.views.posed_images import View, orbit_camera, plain_background_mask
from physgen.sim.gaussians.views.view_files import LAYOUTS, read_view_grid, read_views, save_views
from physgen.sim.scene.model import Camera
from PIL import Image
from scipy.ndimage import binary_fill_holes

from .splat_scenes import Ball, Box, seen, views_of

SOLIDS = (Ball((0, 0, 0), 0.4), Box((0.2, -0.15, 0.1), (0.5, 0.15, 0.5)))


def blender_pose(position):
    """Blender's matrix of a camera there that looks at the origin: x right, y up, z backward."""
    back = np.asarray(position) / np.linalg.norm(position)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose.tolist()


def pinhole(pose, side, focal):
    matrix = tuple(map(tuple, pose))
    return Camera(width=side, height=side, fx=focal, fy=focal, cx=side / 2, cy=side / 2, world_from_camera=matrix)


def picture(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(np.asarray(pixels) * 255).astype(np.uint8)).save(path)


def nerf_folder(folder, count=2, **document):
    """A folder as NeRF's Blender scenes are: names without ending, one angle of view, opacity in the pictures."""
    frames = []
    for index in range(count):
        pixels = np.full((12, 16, 4), 0.25)
        pixels[..., 3] = np.arange(16) >= 8
        picture(folder / f"train/r_{index}.png", pixels)
        pose = blender_pose([2 * math.cos(index), 2 * math.sin(index), 1])
        frames.append({"file_path": f"./train/r_{index}", "rotation": 0.01, "transform_matrix": pose})
    write(folder, {"camera_angle_x": 0.8, "frames": frames, **document})
    return frames


def write(folder, document):
    (folder / "transforms.json").write_text(json.dumps(document))


def test_views_come_back_from_the_folder_they_are_saved_to(tmp_path):
    views = views_of(SOLIDS, count=4, side=48)
    views[2] = View(name="ünter 3", camera=views[2].camera, pixels=views[2].pixels)
    save_views(tmp_path / "new", views)
    again = read_views(tmp_path / "new")
    for one, other in zip(views, again, strict=True):
        assert one.name == other.name
        np.testing.assert_allclose(other.pixels, one.pixels, atol=1.01 / 255)
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(one.camera, name) == getattr(other.camera, name)
        np.testing.assert_allclose(other.camera.world_from_camera, one.camera.world_from_camera, atol=1e-12)
        if one.mask is not None:
            np.testing.assert_allclose(other.mask, one.mask, atol=0.51 / 255)
            np.testing.assert_array_equal(other.labels, one.labels)
    # A picture before white of which no mask was given: its backdrop tells, up to half covered pixels.
    mask = seen(SOLIDS, views[2].camera)[1]
    sure = (mask == 0) | (mask == 1)
    np.testing.assert_array_equal(again[2].mask[sure], mask[sure])
    assert again[2].labels is None


def test_saving_never_touches_what_is_there(tmp_path):
    views = views_of(SOLIDS, count=2, side=16)
    (tmp_path / "kept.txt").write_text("x")
    with pytest.raises(InputError, match="is not empty"):
        save_views(tmp_path, views)
    for wrong in ([], [views[0], views[0]], [View(name="../a", camera=views[0].camera, pixels=views[0].pixels)]):
        with pytest.raises(InputError, match=r"no views|cannot be called"):
            save_views(tmp_path / "new", wrong)
    assert [path.name for path in tmp_path.iterdir()] == ["kept.txt"]
    (tmp_path / "new").mkdir()
    save_views(tmp_path / "new", views)
    assert len(read_views(tmp_path / "new")) == 2


def test_nerf_folders_of_blender(tmp_path):
    nerf_folder(tmp_path)
    views = read_views(tmp_path)
    assert [view.name for view in views] == ["r_0", "r_1"]
    camera = views[1].camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (16, 12, 8, 6)
    assert camera.fx == camera.fy == pytest.approx(8 / math.tan(0.4))
    # The origin is seen in the middle, what is above it further up, what is counter-clockwise of it on the right.
    np.testing.assert_allclose(camera.project(np.zeros(3)), [8, 6, math.sqrt(5)], atol=1e-9)
    assert camera.project(np.array([0, 0, 0.1]))[1] < 6
    assert camera.project(np.array([-math.sin(1), math.cos(1), 0]) * 0.1)[0] > 8
    np.testing.assert_array_equal(views[0].mask, np.broadcast_to(np.arange(16) >= 8, (12, 16)))
    np.testing.assert_allclose(views[0].pixels[0, [0, 15]], [[1, 1, 1], [0.25098] * 3], atol=1e-4)


def test_instant_ngp_cameras_follow_the_size_of_the_picture(tmp_path):
    lens = {"fl_x": 40, "fl_y": 42, "cx": 15, "cy": 13, "w": 32, "h": 24, "k1": 0, "aabb_scale": 16}
    frames = nerf_folder(tmp_path, **lens)
    camera = read_views(tmp_path)[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20, 21, 7.5, 6.5)
    frames[1] |= {"fl_x": 80, "fl_y": 80}
    write(tmp_path, {**lens, "frames": frames})
    assert read_views(tmp_path / "transforms.json")[1].camera.fx == 40


def test_masks_and_labels_beside_the_pictures(tmp_path):
    frames = nerf_folder(tmp_path)
    label = np.zeros((12, 16))
    label[:, 9:], label[:, 12:] = 1 / 255, 2 / 255
    picture(tmp_path / "labels/r_0.png", label)
    for name, from_column in (("frog", 9), ("sweater", 12)):
        picture(tmp_path / f"masks/{name}/r_1.png", np.broadcast_to(np.arange(16) >= from_column, (12, 16)))
    picture(tmp_path / "masks/r_1.png", np.broadcast_to(np.arange(16) >= 5, (12, 16)))
    views = read_views(tmp_path, objects=("frog", "sweater"))
    for view in views:
        assert view.labels[0].tolist() == [-1] * 9 + [1] * 3 + [2] * 4
    assert [view.mask[0].sum() for view in views] == [8, 11]
    with pytest.raises(InputError, match="objects frog, sweater: give their order"):
        read_views(tmp_path)
    with pytest.raises(InputError, match="has no folder 'cat'"):
        read_views(tmp_path, objects=("cat", "frog"))
    frames[1]["mask_path"] = "masks/frog/r_1.png"
    write(tmp_path, {"camera_angle_x": 1, "frames": frames})
    assert read_views(tmp_path, objects=("frog", "sweater"))[1].mask[0].sum() == 7
    (tmp_path / "masks/sweater/r_1.png").unlink()
    with pytest.raises(InputError, match=r"sweater/r_1.png: no such mask"):
        read_views(tmp_path, objects=("frog", "sweater"))
    picture(tmp_path / "labels/r_1.png", label[:, ::-1])
    with pytest.raises(InputError, match=r"'r_1': 84 of 84 labelled pixels lie outside its mask"):
        read_views(tmp_path, objects=("frog", "sweater"))


CLEAR = np.zeros((12, 16))


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda f, d: (f / "transforms.json").unlink(), r"1 images but no transforms.json.*colmap2nerf"),
        (lambda f, d: d["frames"][1].pop("transform_matrix"), r"frames\[1\]: has no camera"),
        (lambda f, d: d.pop("camera_angle_x"), r"no focal length: give fl_x"),
        (lambda f, d: d.update(camera_angle_x=4), "radians below pi"),
        (lambda f, d: d.update(fl_x=math.nan), "fl_x is 'nan'"),
        (lambda f, d: d.update(fl_x=-3), "above 0"),
        (lambda f, d: d.update(k1=0.1), "k1 distorts the image: undistort"),
        (lambda f, d: d.update(camera_model="OPENCV_FISHEYE"), "pinhole"),
        (lambda f, d: d.update(w=16, h=16), "the image that belongs to this camera"),
        (lambda f, d: d.update(frames=[]), "no list of frames"),
        (lambda f, d: d["frames"].append(3), r"frames\[2\]: is not an object"),
        (lambda f, d: d["frames"][0].update(transform_matrix=[[1, 2], [3]]), "not a 4x4 matrix"),
        (lambda f, d: d["frames"][0].update(transform_matrix=(2 * np.eye(4)).tolist()), "scales or mirrors"),
        (lambda f, d: d["frames"][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()), "scales or mirrors"),
        (lambda f, d: d["frames"][0].update(file_path=7), "file_path is '7'"),
        (lambda f, d: d["frames"][0].update(file_path="../secret.png"), r"frames\[0\]: file name.*without"),
        (lambda f, d: d["frames"][0].update(file_path="/etc/passwd"), "must be relative"),
        (lambda f, d: d["frames"][0].update(mask_path="../../x.png"), "without"),
        (lambda f, d: d["frames"][0].update(file_path="train/r_9"), "no such image"),
        (lambda f, d: d["frames"][0].update(file_path="train/r_1.png"), "another frame has too"),
        (lambda f, d: picture(f / "masks/r_0.png", np.ones((3, 3))), "has 3x3 pixels, its image 16x12"),
        (lambda f, d: picture(f / "labels/r_0.png", CLEAR + 1), "holds 255: use 0 outside"),
        (lambda f, d: picture(f / "labels/r_0.png", np.ones((12, 16, 3))), "stored as colours"),
        (lambda f, d: (f / "train/r_0.png").write_bytes(b"\x89PNG\r\n\x1a\n garbage"), "not a readable image"),
    ],
)
def test_invalid_views_folders_are_refused(tmp_path, change, said):
    folder = tmp_path / "views"
    document = {"camera_angle_x": 0.8, "frames": nerf_folder(folder)}
    picture(folder / "loose.png", CLEAR)
    picture(tmp_path / "secret.png", CLEAR)
    change(folder, document)
    if (folder / "transforms.json").exists():
        write(folder, document)
    with pytest.raises(InputError, match=said):
        read_views(folder)


def test_opacity_that_is_none_is_no_mask(tmp_path):
    frames = nerf_folder(tmp_path)
    solid = np.ones((12, 16, 4))
    solid[4:8, 6:10, :3] = 0.2
    for index in range(2):
        picture(tmp_path / f"train/r_{index}.png", solid)
    label = np.zeros((12, 16))
    label[4:8, 6:8] = 1 / 255
    picture(tmp_path / "labels/r_1.png", label)
    write(tmp_path, {"camera_angle_x": 0.8, "frames": frames})
    first, second = read_views(tmp_path)
    assert (first.mask == (solid[..., 0] < 1)).all() and (second.mask == (label > 0)).all()


def test_links_that_lead_out_are_refused(tmp_path):
    nerf_folder(tmp_path / "views")
    picture(tmp_path / "secret.png", CLEAR)
    (tmp_path / "views/train/r_0.png").unlink()
    (tmp_path / "views/train/r_0.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match="leads out"):
        read_views(tmp_path / "views")


def test_pictures_beyond_bounds_are_refused_unread(tmp_path, monkeypatch):
    nerf_folder(tmp_path)
    monkeypatch.setattr("physgen.sim.gaussians.views.posed_images.MAX_PIXELS", 300)
    with pytest.raises(InputError, match=r"r_1.png: with its 16x12 pixels the views exceed"):
        read_views(tmp_path)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=8,
)
FIELDS = ["file_path", "transform_matrix", "mask_path", "fl_x", "fl_y", "cx", "w", "h", "k1", "camera_model"]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([*FIELDS, "camera_angle_x"]), JSON, st.booleans())
def test_any_value_of_a_field_is_refused_or_read(tmp_path, field, value, shared):
    frames = nerf_folder(tmp_path)
    document = {"camera_angle_x": 0.8, "frames": frames}
    (document if shared else frames[0])[field] = value
    write(tmp_path, document)
    try:
        assert len(read_views(tmp_path)) == 2
    except InputError as error:
        assert str(tmp_path) in str(error) and len(str(error)) < 600


def test_the_backdrop_is_what_is_connected_to_the_border():
    random = np.random.default_rng(0)
    colours, mask, _ = seen(SOLIDS, orbit_camera(20, 20, 2.5, side=64, focal=1.2))
    grey = colours * mask[..., None] + 0.5 * (1 - mask[..., None]) + random.normal(0, 0.004, colours.shape)
    sure = (mask == 0) | (mask == 1)
    for pixels in (colours, np.clip(grey, 0, 1)):
        found = plain_background_mask(pixels.astype(np.float32))
        np.testing.assert_array_equal(found[sure], mask[sure])
    inner = colours.copy()
    inner[30:34, 30:34] = 1
    assert plain_background_mask(inner.astype(np.float32))[32, 32] == 1
    assert plain_background_mask(random.uniform(size=(64, 64, 3)).astype(np.float32)) is None
    assert plain_background_mask(np.ones((64, 64, 3), np.float32)) is None


@pytest.mark.parametrize("layout", LAYOUTS)
def test_pictures_of_generators_have_their_published_cameras(tmp_path, layout):
    """Each view is rendered by the camera that the program's scripts describe, worked out here from those words."""
    side = 40
    solids = (Ball((0.0, 0.0, 0.0), 0.2), Ball((0.3, 0.1, 0.2), 0.1))
    if layout == "syncdreamer":
        places = [(22.5 * i, 30) for i in range(16)]
        angle, distance, shape = 2 * math.atan(16 / 35), 1.5, (1, 16)
    else:
        high, low = (30, -20) if layout.endswith("1") else (20, -10)
        places = [(30 + 60 * i, (high, low)[i % 2]) for i in range(6)]
        angle, distance, shape = 2 * math.atan(16 / 35), 1.5, (3, 2)
        if layout.endswith("2"):
            angle, distance = math.radians(30), 0.5 / math.tan(math.radians(15))
    sheet = np.zeros((shape[0] * side, shape[1] * side, 3))
    truth = []
    for index, (azimuth, elevation) in enumerate(places):
        around, up = math.radians(azimuth), math.radians(elevation)
        place = distance * np.array([math.cos(up) * math.cos(around), math.cos(up) * math.sin(around), math.sin(up)])
        pose = np.array(blender_pose(place)) @ np.diag([1, -1, -1, 1])
        camera = pinhole(pose, side, 0.5 * side / math.tan(angle / 2))
        colours, mask, _ = seen(solids, camera)
        truth.append((camera, mask))
        row, column = divmod(index, shape[1])
        sheet[row * side : (row + 1) * side, column * side : (column + 1) * side] = colours
    picture(tmp_path / "0.png", sheet)
    views = read_view_grid(tmp_path / "0.png", layout)
    for view, (camera, mask) in zip(views, truth, strict=True):
        np.testing.assert_allclose(view.camera.world_from_camera, camera.world_from_camera, atol=1e-9)
        assert (view.camera.fx, view.camera.cx, view.camera.cy) == pytest.approx((camera.fx, side / 2, side / 2))
        # A gap between the two that the border cannot be reached from counts as object.
        sure = (binary_fill_holes(mask > 0) == 0) | (mask == 1)
        np.testing.assert_array_equal(view.mask[sure], mask[sure])
    other = next(name for name in LAYOUTS if LAYOUTS[name].columns != LAYOUTS[layout].columns)
    with pytest.raises(InputError, match="square views of"):
        read_view_grid(tmp_path / "0.png", other)


def test_layouts_and_views_are_checked(tmp_path):
    picture(tmp_path / "a.png", np.ones((16, 256)))
    with pytest.raises(InputError, match="layout is 'x': choose one of syncdreamer"):
        read_view_grid(tmp_path / "a.png", "x")
    with pytest.raises(InputError, match="distance is -1"):
        read_view_grid(tmp_path / "a.png", "syncdreamer", distance=-1)
    views = read_view_grid(tmp_path / "a.png", "syncdreamer", distance=3)
    assert np.linalg.norm(views[3].camera.position) == pytest.approx(3) and views[3].mask is None
    camera, pixels = views[0].camera, views[0].pixels
    for wrong in ({"pixels": pixels[1:]}, {"pixels": pixels * np.nan}, {"mask": pixels[..., 0] * 2}):
        with pytest.raises(InputError, match="view 'x': "):
            View(**{"name": "x", "camera": camera, "pixels": pixels, **wrong})
    with pytest.raises(InputError, match=r"values 0.0: give"):
        View(name="x", camera=camera, pixels=pixels, labels=pixels[..., 0] * 0)
    assert not views[0].pixels.flags.writeable
