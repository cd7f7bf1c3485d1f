# SPDX-License-Identifier: MIT
"""Environment files, and the light of a scene that is changed."""

import dataclasses
import math

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.app.set_light import LightRequest, set_light
from physgen.sim.errors import InputError
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.reconstruct.camera.ground_camera import camera_above_ground
from physgen.sim.reconstruct.lighting.light_estimate import photo_environment
from physgen.sim.scene.environment import (
    prepared,
    read_environment,
    sun_in,
    turned,
    world_from_file,
    write_environment,
)
from physgen.sim.scene.equirectangular import LUMINANCE, directions
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.model import Ground, Light, SceneModel, SceneObject
from PIL import Image

UP = np.array([0.0, 0.0, 1.0])
CAMERA = camera_above_ground(80, 60, 90.0, math.radians(35))


def spot_map(towards, size=(32, 64)):
    """A dim map with one bright spot in the direction ``towards`` of the map's own axes."""
    around, _ = directions(*size)
    return np.where((around @ np.asarray(towards) > 0.98)[..., None], 50.0, 0.2).astype(np.float32).repeat(3, axis=2)


def brightest(radiance):
    around, solid = directions(*radiance.shape[:2])
    light = np.maximum(radiance @ LUMINANCE - 1.5 * np.median(radiance @ LUMINANCE), 0) * solid
    centre = (around * light[..., None]).sum(axis=(0, 1))
    return centre / np.linalg.norm(centre)


@given(turn=st.floats(-math.pi, math.pi), height=st.floats(-1.2, 1.2))
@settings(max_examples=30, deadline=None)
def test_a_turned_map_shines_from_the_turned_direction(turn, height):
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    towards = np.array([math.cos(height), 0, math.sin(height)])
    assert brightest(turned(spot_map(towards), rotation)) @ (rotation @ towards) > math.cos(math.radians(4))


def test_environment_map_orientation():
    # The file's middle is +x of its own axes, its right half lies towards -y.
    ahead = world_from_file("ahead", CAMERA, Ground())
    assert ahead @ [1, 0, 0] == pytest.approx([0, 1, 0])
    assert ahead @ [0, -1, 0] == pytest.approx([1, 0, 0])
    assert ahead @ UP == pytest.approx(UP)
    # A mirror ball is seen along the camera's axis: its map's middle lies as far down as the camera looks.
    along = world_from_file("camera", CAMERA, Ground())
    assert along @ [1, 0, 0] == pytest.approx([0, math.cos(math.radians(35)), -math.sin(math.radians(35))])
    assert along @ [0, -1, 0] == pytest.approx([1, 0, 0])
    assert world_from_file("world", CAMERA, None) == pytest.approx(np.eye(3))


def test_straight_down_has_an_ahead_too():
    down = dataclasses.replace(
        CAMERA, world_from_camera=((1.0, 0, 0, 0), (0, -1.0, 0, 0), (0, 0, -1.0, 1.0), (0, 0, 0, 1.0))
    )
    assert world_from_file("ahead", down, Ground()) @ [1, 0, 0] == pytest.approx([0, 1, 0])


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_files_of_any_size_are_read_and_kept_small(tmp_path, suffix):
    path = tmp_path / f"sky.{suffix}"
    write_map(path, spot_map([0.6, 0, 0.8], (1100, 2200)))
    found = prepared(path, "ahead", CAMERA, Ground())
    assert found.shape == (1024, 2048, 3)
    assert float((found @ LUMINANCE).mean()) == pytest.approx(1.0, rel=0.01)
    assert brightest(found) @ [0, 0.6, 0.8] > 0.999
    assert sun_in(found, UP) > 0.5


def write_map(path, pixels):
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "float"))
    assert output.write_image(np.ascontiguousarray(pixels)) and output.close()


def broken(value):
    pixels = spot_map([0, 0, 1])
    pixels[3, 5] = value
    return pixels


@pytest.mark.parametrize(
    ("name", "pixels", "message"),
    [
        ("nan.exr", broken(np.nan), "1 pixels are not finite"),
        ("inf.exr", broken(np.inf), "not finite"),
        ("dark.exr", np.zeros((32, 64, 3), np.float32), "black"),
        ("negative.exr", broken(-40.0), "negative"),
        ("square.hdr", np.ones((64, 64, 3), np.float32), "twice as wide"),
        ("tiny.exr", np.ones((2, 4, 3), np.float32), "at least 16x8"),
    ],
)
def test_maps_that_cannot_light_are_refused(tmp_path, name, pixels, message):
    path = tmp_path / name
    write_map(path, pixels)
    with pytest.raises(InputError, match=message):
        read_environment(path)


def test_eight_bits_a_missing_file_and_no_picture_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"exposure2hdr"):
        read_environment(tmp_path / "ball_ev-00.png")
    with pytest.raises(InputError, match="no such file"):
        read_environment(tmp_path / "sky.exr")
    (tmp_path / "sky.hdr").write_bytes(b"hello")
    with pytest.raises(InputError, match=r"readable|damaged"):
        read_environment(tmp_path / "sky.hdr")


@given(start=st.integers(0, 4000), garbage=st.binary(min_size=1, max_size=60), cut=st.integers(0, 4000))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_damaged_files_are_read_or_refused(tmp_path, suffix, start, garbage, cut):
    path = tmp_path / f"sky.{suffix}"
    write_map(path, spot_map([0, 0, 1], (8, 16)))
    content = bytearray(path.read_bytes())
    start %= len(content)
    content[start : start + len(garbage)] = garbage
    path.write_bytes(content[: len(content) - cut % 50])
    try:
        found = read_environment(path)
    except InputError:
        return
    assert np.isfinite(found).all() and found.min() >= 0


def test_an_even_sky_has_no_sun_and_a_spot_is_one():
    assert sun_in(np.ones((64, 128, 3), np.float32), UP) < 0.08
    assert sun_in(spot_map([0.6, 0, 0.8]), UP) > 0.5


def test_the_photos_surroundings_shine_from_where_they_are():
    pixels = np.full((60, 80, 3), 60, np.uint8)
    pixels[:, 50:] = 250
    level = camera_above_ground(80, 60, 60.0, 0.0)
    found = photo_environment(pixels, pixels, level) @ LUMINANCE
    around, _ = directions(32, 64)
    ahead = (around[..., 1] > 0.85) & (around[..., 2] > 0.05)
    assert found[ahead & (around[..., 0] > 0.2)].mean() > 1.5 * found[ahead & (around[..., 0] < -0.2)].mean()


def test_the_environment_of_a_black_photo_is_finite():
    black = np.zeros((60, 80, 3), np.uint8)
    assert np.isfinite(photo_environment(black, black, CAMERA)).all()


@pytest.fixture
def scene(tmp_path):
    """A scene folder with a grey photo; nothing in it throws a shadow."""
    root = tmp_path / "scene"
    for name in ("meshes", "masks"):
        (root / name).mkdir(parents=True)
    (root / "meshes" / "box.obj").write_text(
        "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    grey = np.full((60, 80, 3), 128, np.uint8)
    mask = np.zeros((60, 80), np.uint8)
    mask[20:30, 35:45] = 255
    Image.fromarray(grey).save(root / "photo.png")
    Image.fromarray(grey).save(root / "background.png")
    Image.fromarray(mask).save(root / "masks" / "box.png")
    item = SceneObject(name="box", mesh="meshes/box.obj", size_m=0.1, mask="masks/box.png")
    save_scene(root, SceneModel(camera=CAMERA, objects=(item,), light=Light(sun_direction=(0.0, 0.0, 1.0))))
    return root


def test_a_sun_is_set_changed_and_taken_away(scene):
    light = set_light(
        load_scene(scene), request=LightRequest(sun_direction=(3.0, 0.0, 4.0), sun_angle_deg=2.0)
    ).model.light
    assert light.sun_direction == pytest.approx((0.6, 0.0, 0.8))
    assert light.sun_angle == pytest.approx(math.radians(2))
    assert set_light(load_scene(scene), request=LightRequest(sun_strength=3.0)).model.light == dataclasses.replace(
        light, sun_strength=3.0
    )
    assert set_light(load_scene(scene), request=LightRequest(sun=False)).model.light.sun_direction is None
    assert load_scene(scene).model.light.sun_direction is None
    with pytest.raises(InputError, match="no sun"):
        set_light(load_scene(scene), request=LightRequest(sun_strength=1.0))
    with pytest.raises(InputError, match="below the ground"):
        set_light(load_scene(scene), request=LightRequest(sun_direction=(1.0, 0.0, -0.5)))


def test_an_environment_replaces_the_old_one_and_its_file(scene, tmp_path):
    write_environment(tmp_path / "sun.exr", spot_map([0.6, 0, 0.8]))
    write_environment(tmp_path / "even.exr", np.ones((32, 64, 3), np.float32))
    said = []
    first = set_light(
        load_scene(scene), request=LightRequest(environment=tmp_path / "sun.exr"), on_event=said.append
    ).model.light
    # Its own sun is enough.
    assert first.sun_direction is None and any("sun of its own" in event["message"] for event in said)
    second = set_light(load_scene(scene), request=LightRequest(environment=tmp_path / "even.exr")).model.light
    assert [path.name for path in (scene / "light").iterdir()] == [second.environment.removeprefix("light/")]
    assert load_scene(scene).model.light == second


def test_failed_changes_leave_the_scene_unchanged(scene, tmp_path):
    before = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}
    write_environment(tmp_path / "even.exr", np.ones((32, 64, 3), np.float32))
    for request in (
        LightRequest(environment=tmp_path / "missing.exr"),
        LightRequest(environment=tmp_path / "even.exr", sun_direction=(0.0, 1.0, -1.0)),
    ):
        with pytest.raises(InputError):
            set_light(load_scene(scene), request=request)
        assert {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    "fields",
    [
        {"sun_direction": (0.0, 0.0, 0.0)},
        {"sun_direction": (math.nan, 0.0, 1.0)},
        {"sun_strength": -1.0},
        {"sun_angle_deg": 400.0},
        {"sun": False, "sun_strength": 1.0},
        {"estimate": True, "sun_strength": 1.0},
        {"frame": "upside down"},
    ],
)
def test_requests_are_checked(fields):
    with pytest.raises(InputError):
        LightRequest(**fields)


def test_a_photo_is_reconstructed_under_a_file_and_again_when_the_file_changes(first_fill, tmp_path):
    rng = np.random.default_rng(0)
    pixels = rng.integers(150, 170, (90, 120, 3), dtype=np.uint8)
    pixels[30:60, 40:75] = (200, 30, 30)
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    sky = tmp_path / "sky.exr"
    options = ReconstructOptions(environment=sky, pitch_deg=30.0, mesh_vertices=600, patch_radius=2)
    said = []

    def once():
        said.clear()
        request = ObjectRequest(box=(30, 20, 85, 70), shape="inflated")
        return reconstruct(
            tmp_path / "photo.png", [request], out=tmp_path / "scene", options=options, on_event=said.append
        )

    with pytest.raises(InputError, match="no such file"):
        once()
    assert not (tmp_path / "scene").exists()
    write_environment(sky, spot_map([0.8, 0, 0.6]))
    folder = once()
    assert folder.model.light.sun_direction is None
    kept = read_environment(folder.file(folder.model.light.environment))
    assert brightest(kept) @ [0, 0.8, 0.6] > 0.999
    once()
    assert any("up to date" in event.get("message", "") for event in said)
    write_environment(sky, spot_map([0, 0, 1]))
    once()
    assert not any("up to date" in event.get("message", "") for event in said)
