# SPDX-License-Identifier: MIT
"""From a photo file to a scene folder: whole or not at all."""

import dataclasses
import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from physgen.sim.app.reconstruct import reconstruct
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.events import step_words
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions, reconstruct_photo
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh
from PIL import Image
from scipy import ndimage

WIDTH, HEIGHT = 360, 270
BALL = (95, 105, 175, 185)
CRATE = (215, 91, 300, 203)
SMALL_BALL, SMALL_CRATE = (tuple(v / 2 for v in box) for box in (BALL, CRATE))
QUICK = ReconstructOptions(mesh_vertices=2000, pitch_deg=25.0, patch_radius=3)
SMALL = dataclasses.replace(QUICK, mesh_vertices=500, sun=False)
"""Where only the files matter that are left behind: such bodies are inflated, without a search for a primitive."""


def small_request(box=SMALL_BALL, **fields):
    return ObjectRequest(box=box, shape="inflated", **fields)


def draw_photo():
    """A red ball and a blue crate on boards, with shadows to the right."""
    rng = np.random.default_rng(0)
    image = np.full((HEIGHT, WIDTH, 3), (185.0, 160, 120))
    image += (ndimage.gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), (1, 10)) * 40)[..., None]
    image += rng.normal(scale=3, size=(HEIGHT, WIDTH, 1))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ball = (columns - 135) ** 2 + (rows - 145) ** 2 < 35**2
    shadow = (((columns - 165) / 42) ** 2 + ((rows - 176) / 9) ** 2 < 1) & ~ball
    crate = (np.abs(columns - 257) < 32) & (np.abs(rows - 146) < 42)
    image[shadow] *= 0.45
    image[ball] = np.array([205, 50, 40]) + rng.normal(scale=5, size=(int(ball.sum()), 3))
    image[crate] = np.array([40, 70, 170]) + rng.normal(scale=5, size=(int(crate.sum()), 3))
    return np.clip(image, 0, 255).astype(np.uint8), ball, crate, shadow


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    path = tmp_path_factory.mktemp("photo") / "photo.png"
    Image.fromarray(draw_photo()[0]).save(path)
    return path


@pytest.fixture(scope="module")
def small_photo(photo, tmp_path_factory):
    """Half as wide and high, where only the files matter that a reconstruction leaves behind."""
    path = tmp_path_factory.mktemp("small") / "photo.png"
    Image.open(photo).resize((WIDTH // 2, HEIGHT // 2), Image.Resampling.BOX).save(path)
    return path


@pytest.fixture(scope="module")
def small_scene(small_photo, tmp_path_factory, without_trials):
    """A scene of it with the object ``first``; to be copied."""
    out = tmp_path_factory.mktemp("small scene") / "scene"
    with without_trials():
        reconstruct_photo(small_photo, [small_request(name="first")], out, SMALL)
    return out


@pytest.fixture
def old_scene(small_scene, tmp_path):
    return Path(shutil.copytree(small_scene, tmp_path / "scene"))


@pytest.fixture(scope="module")
def result(photo, tmp_path_factory, without_trials):
    events = []
    out = tmp_path_factory.mktemp("scenes") / "deep" / "scene"
    requests = [
        ObjectRequest(box=BALL, name="ball", size_m=0.2, preset="soft", velocity=(1.0, 0.0, 0.5)),
        ObjectRequest(box=CRATE),
    ]
    with without_trials():
        folder = reconstruct_photo(photo, requests, out, QUICK, events.append)
    return folder, events, out


def test_scene_is_complete_and_loads(result):
    folder, _, out = result
    assert load_scene(out).model == folder.model
    assert sorted(path.name for path in out.parent.iterdir()) == ["scene"]
    assert [item.name for item in folder.model.objects] == ["ball", "object_2"]
    ball, crate = folder.model.objects
    assert ball.size_m == pytest.approx(0.2)
    assert ball.material.preset == "soft"
    assert ball.velocity == (1.0, 0.0, 0.5)
    # The crate is 1.2 times as high and stands nearer.
    assert 0.1 < crate.size_m < 0.35
    assert (crate.occlusion_order, ball.occlusion_order) == (0, 1)


def test_masks_meshes_and_camera_agree(result):
    folder, _, _ = result
    camera = folder.model.camera
    for item, truth in zip(folder.model.objects, draw_photo()[1:3], strict=True):
        mask = np.asarray(Image.open(folder.file(item.mask))) > 0
        assert (mask & truth).sum() / (mask | truth).sum() > 0.95
        mesh = load_object_mesh(folder, item)
        assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(item.size_m, rel=1e-4)
        assert abs(mesh.vertices[:, 2].min()) < 1e-6
        pixels = camera.project(mesh.vertices)[:, :2]
        rows, columns = np.nonzero(mask)
        assert pixels.min(axis=0) == pytest.approx([columns.min(), rows.min()], abs=1.5)
        assert pixels.max(axis=0) == pytest.approx([columns.max() + 1, rows.max() + 1], abs=1.5)
    # The world's origin is under the first object.
    assert np.abs(load_object_mesh(folder, folder.model.objects[0]).vertices[:, :2].mean(axis=0)).max() < 0.1


def test_photo_and_background_files(result):
    folder, _, out = result
    photo = np.asarray(Image.open(out / "photo.png"))
    background = np.asarray(Image.open(out / "background.png"))
    assert (photo == draw_photo()[0]).all()
    holes = np.zeros(photo.shape[:2], bool)
    for item in folder.model.objects:
        holes |= np.asarray(Image.open(out / "holes" / f"{item.name}.png")) > 0
    assert (photo[~holes] == background[~holes]).all()
    shadow = np.asarray(Image.open(folder.file(folder.model.objects[0].shadow))) > 0
    truth = draw_photo()[3]
    assert (shadow & truth).sum() / (shadow | truth).sum() > 0.6


def test_environment_has_mean_luminance_one(result):
    folder, _, _ = result
    image = oiio.ImageBuf(str(folder.file(folder.model.light.environment)))
    pixels = image.get_pixels(oiio.FLOAT)
    assert pixels.shape == (32, 64, 3)
    weight = np.cos((0.5 - (np.arange(32) + 0.5) / 32) * math.pi)
    luminance = (pixels @ [0.2126, 0.7152, 0.0722]).mean(axis=1)
    assert np.average(luminance, weights=weight) == pytest.approx(1.0, rel=1e-3)


def test_progress_counts_up_to_the_end(result):
    _, events, _ = result
    progress = [event for event in events if event["event"] == "progress"]
    assert all(event["stage"] == "reconstruct" for event in events)
    assert [event["done"] for event in progress] == list(range(len(progress)))
    assert progress[-1]["done"] == progress[-1]["total"]
    # People read what is being done, programs the names of the steps.
    assert all(event["message"] == step_words(event["step"]) != event["step"] for event in progress[:-1])
    assert {"segment ball", "gloss"} < {event["step"] for event in progress}
    assert {"cutting out ball", "finding mirror images"} < {event["message"] for event in progress}
    json.dumps(events)


@pytest.mark.long
def test_again_gives_the_same_scene(first_fill, small_photo, tmp_path):
    requests = [
        small_request(name="ball", size_m=0.2, preset="soft", velocity=(1.0, 0.0, 0.5)),
        small_request(SMALL_CRATE),
    ]
    options = dataclasses.replace(SMALL, sun=True)
    first, second = (reconstruct_photo(small_photo, requests, tmp_path / name, options) for name in ("one", "two"))
    assert second.model == first.model
    for name in ("background.png", "meshes/ball.glb", "masks/ball.png", "shadows/ball.png"):
        assert second.file(name).read_bytes() == first.file(name).read_bytes()


def test_large_photos_are_worked_on_smaller_and_boxes_follow(first_fill, photo, tmp_path):
    large = tmp_path / "large.jpg"
    Image.open(photo).resize((WIDTH * 8, HEIGHT * 8)).save(large, quality=85)
    events = []
    box = tuple(8.0 * v for v in BALL)
    options = dataclasses.replace(SMALL, max_size=WIDTH)
    folder = reconstruct_photo(large, [small_request(box, name="ball")], tmp_path / "scene", options, events.append)
    assert (folder.model.camera.width, folder.model.camera.height) == (WIDTH, HEIGHT)
    assert any("2880x2160" in event.get("message", "") for event in events)
    mask = np.asarray(Image.open(folder.file("masks/ball.png"))) > 0
    truth = draw_photo()[1]
    assert (mask & truth).sum() / (mask | truth).sum() > 0.94


@pytest.mark.parametrize(
    ("requests", "message"),
    [
        ([], "none given"),
        ([ObjectRequest(box=(900, 900, 990, 990))], "outside the photo"),
        ([ObjectRequest(box=(0, 0, WIDTH, HEIGHT))], "whole photo"),
        ([ObjectRequest(box=BALL), ObjectRequest(box=(90, 100, 180, 190))], "same object"),
        ([ObjectRequest(box=BALL, name="a"), ObjectRequest(box=CRATE, name="A")], "name of its own"),
        ([ObjectRequest(box=BALL, name="../escape")], "object.name"),
        ([ObjectRequest(box=BALL, preset="unobtainium")], "unobtainium"),
    ],
)
def test_impossible_requests_leave_nothing_behind(photo, tmp_path, requests, message):
    with pytest.raises(InputError, match=message):
        reconstruct_photo(photo, requests, tmp_path / "scene", QUICK)
    assert list(tmp_path.iterdir()) == []


def test_objects_above_the_given_horizon_hang_and_are_held(small_photo, tmp_path, without_trials):
    """With a horizon below them both hang in the air at one distance, where the photo shows them, until touched."""
    options = dataclasses.replace(SMALL, pitch_deg=None, horizon_y=0.9)
    events = []
    with without_trials():
        folder = reconstruct(
            small_photo,
            [small_request(), small_request(SMALL_CRATE)],
            out=tmp_path / "scene",
            options=options,
            on_event=events.append,
        )
    assert sum("hangs in the air" in event.get("message", "") for event in events) == 2
    depths = []
    for item in folder.model.objects:
        vertices = load_object_mesh(folder, item).vertices
        seen = folder.model.camera.project(vertices)
        mask = np.array(Image.open(folder.file(item.mask))) > 0
        rows, columns = np.nonzero(mask)
        ends = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        # Its 500 vertices are about 2 pixels apart.
        assert (*seen[:, :2].min(axis=0), *seen[:, :2].max(axis=0)) == pytest.approx(ends, abs=2.0)
        assert vertices[:, 2].min() > 0.0 and item.asleep and item.held
        depths.append(np.median(seen[:, 2]))
    assert depths[0] == pytest.approx(depths[1], rel=1e-6)


@pytest.mark.parametrize("stop_at", ["photo", "camera", "background", "write", None])
def test_cancelling_leaves_nothing(first_fill, small_photo, tmp_path, stop_at):
    reached = []

    def cancelled():
        return stop_at is None or stop_at in reached

    with pytest.raises(Cancelled):
        reconstruct_photo(
            small_photo,
            [small_request()],
            tmp_path / "scene",
            SMALL,
            lambda event: reached.append(event.get("step")),
            cancelled,
        )
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_other_files_is_not_touched(photo, tmp_path):
    (tmp_path / "precious.txt").write_text("keep me")
    with pytest.raises(InputError, match="not part of a scene folder"):
        reconstruct_photo(photo, [ObjectRequest(box=BALL)], tmp_path, QUICK)
    assert (tmp_path / "precious.txt").read_text() == "keep me"


def test_out_below_a_file_is_refused(photo, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written|is a file"):
        reconstruct_photo(photo, [ObjectRequest(box=BALL)], tmp_path / "file" / "scene", QUICK)
    with pytest.raises(InputError, match="is a file"):
        reconstruct_photo(photo, [ObjectRequest(box=BALL)], tmp_path / "file", QUICK)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_unwritable_folder(photo, tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="cannot be written"):
            reconstruct_photo(photo, [ObjectRequest(box=BALL)], tmp_path / "scene", QUICK)
    finally:
        tmp_path.chmod(0o700)


def test_an_old_scene_survives_a_failure_and_is_replaced_on_success(first_fill, small_photo, old_scene, tmp_path):
    out = old_scene
    with pytest.raises(InputError):
        reconstruct_photo(small_photo, [ObjectRequest(box=(900, 900, 990, 990))], out, SMALL)
    assert load_scene(out).model.objects[0].name == "first"
    reconstruct_photo(small_photo, [small_request(SMALL_CRATE, name="second")], out, SMALL)
    assert [item.name for item in load_scene(out).model.objects] == ["second"]
    assert not (out / "masks" / "first.png").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene"]


@pytest.mark.parametrize(
    "fields",
    [
        {"max_size": 3},
        {"fov_deg": 400.0},
        {"horizon_y": float("nan")},
        {"pitch_deg": 95.0},
        {"horizon_y": 0.1, "pitch_deg": 10.0},
        {"mesh_vertices": 1},
        {"seed": -1},
    ],
)
def test_options_are_checked(fields):
    with pytest.raises(InputError):
        ReconstructOptions(**fields)


@pytest.mark.parametrize(
    "fields",
    [{"box": (0, 0, float("nan"), 5)}, {"box": (0, 0, 5)}, {"size_m": -1.0}, {"thickness": 0.0}],
)
def test_requests_are_checked(fields):
    with pytest.raises(InputError):
        ObjectRequest(**{"box": BALL, **fields})


def test_a_scene_folder_with_something_of_the_users_in_it_is_not_replaced(small_photo, old_scene, tmp_path):
    out = old_scene
    (out / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt"):
        reconstruct_photo(small_photo, [ObjectRequest(box=SMALL_CRATE)], out, SMALL)
    assert (out / "notes.txt").read_text() == "mine" and load_scene(out)
    stranger = tmp_path / "stranger"
    stranger.mkdir()
    for name in ("scene.json", "photo.png"):
        (stranger / name).write_text("mine")
    with pytest.raises(InputError, match="not part of a scene folder"):
        reconstruct_photo(small_photo, [ObjectRequest(box=SMALL_BALL)], stranger, SMALL)
    assert (stranger / "photo.png").read_text() == "mine"
