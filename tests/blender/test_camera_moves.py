# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames seen by a moved camera, against what Cycles itself sees from there."""

import json

import numpy as np
import pytest
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.errors import InputError
from physgen.sim.scene.camera_path import CameraOffset, offset_camera
from physgen.sim.srgb import read_rgb
from scipy import ndimage

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.scene_io import import_scene
from physgen.physgen_addon.scene_io.export_animation import camera_path

REST = (0.0, 0.0, 0.0)
PIVOT = [0.02, 0.0, 0.0]
OFFSET = {"azimuth_deg": 7.0, "elevation_deg": 3.0, "dolly": -0.1}


def camera_file(tmp_path, *keys):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"format": "physgen-camera/1", "pivot": PIVOT, "keys": keys}))
    return str(path)


@pytest.mark.long
def test_the_moved_camera_sees_what_is_there(world, bake, truth, tmp_path):
    folder, plain = bake([REST, REST, REST]), tmp_path / "plain"
    path = camera_file(tmp_path, {"frame": 1}, {"frame": 3, **OFFSET})
    options = RenderOptions(samples=16, camera=path)
    first, second, third = render_frames(world.folder, load_bake(folder), out=tmp_path / "moved", options=options)
    (still,) = render_frames(world.folder, load_bake(folder), out=plain, options=RenderOptions(samples=16), frames="1")
    # The photo's own camera sees what it saw without a path, and nothing here moves but the camera.
    assert first.read_bytes() == still.read_bytes()
    assert second.read_bytes() != third.read_bytes()

    camera = offset_camera(
        world.folder.model.camera, CameraOffset(**OFFSET), pivot=np.array(PIVOT), normal=np.array([0.0, 0.0, 1.0])
    )
    expected, mask = truth(REST, tmp_path, camera)
    picture = read_rgb(third)
    assert psnr(picture, expected) > 40
    # Where the camera did not move to is far worse: the test would notice.
    assert psnr(read_rgb(still), expected) < 30
    # The ball's outline is where it is in truth: an object that slid on the ground by a pixel would fail this.
    shifted = ndimage.shift(picture.astype(float), (0, 1, 0), order=1, mode="nearest").astype(np.uint8)
    around = ndimage.binary_dilation(mask, iterations=4) & ~ndimage.binary_erosion(mask, iterations=4)
    assert psnr(picture, expected, around) > psnr(shifted, expected, around) + 3


def test_a_camera_that_goes_too_far_is_refused_before_anything_is_rendered(world, bake, tmp_path):
    folder, out = bake([REST, REST]), tmp_path / "out"
    path = camera_file(tmp_path, {"frame": 1}, {"frame": 2, "pan_deg": 29})
    with pytest.raises(InputError, match=r"frame 2: the camera sees .* beyond the photo's right border"):
        render_frames(world.folder, load_bake(folder), out=out, options=RenderOptions(samples=1, camera=path))
    with pytest.raises(InputError, match="give a camera file, or a simple move"):
        render_frames(
            world.folder, load_bake(folder), out=out, options=RenderOptions(samples=1, camera=path, orbit=5.0)
        )
    assert not out.exists()


def test_blenders_camera_becomes_a_path(world):
    physgen.register()
    try:
        scene, photo = bpy.context.scene, world.folder.model.camera
        import_scene.import_scene(scene, world.folder.root)
        frames = range(10, 13)
        assert camera_path(scene, photo, frames, first_frame=1) is None
        item = scene.camera
        item.keyframe_insert("location", frame=10)
        assert camera_path(scene, photo, frames, first_frame=1) is None
        item.location.x += 0.02
        item.keyframe_insert("location", frame=12)
        item.data.lens *= 1.1
        scene.frame_set(11)
        path = camera_path(scene, photo, frames, first_frame=1)
        assert scene.frame_current == 11
        assert [key.frame for key in path.poses] == [1.0, 2.0, 3.0]
        last = np.asarray(path.poses[-1].world_from_camera)
        assert last[:3, 3] == pytest.approx(photo.position + np.array([0.02, 0.0, 0.0]), abs=1e-6)
        assert last[:3, :3] == pytest.approx(np.asarray(photo.world_from_camera)[:3, :3], abs=1e-6)
        assert path.poses[-1].zoom == pytest.approx(1.1, abs=1e-5)
        item.data.type = "ORTHO"
        with pytest.raises(InputError, match="no perspective camera"):
            camera_path(scene, photo, frames, first_frame=1)
    finally:
        physgen.unregister()
