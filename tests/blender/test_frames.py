# SPDX-License-Identifier: GPL-3.0-or-later
"""The loop over frames: what is skipped, what is resumed, what is refused; the script; the video."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.errors import Cancelled, InputError
from physgen.sim.scene.folder import load_scene
from physgen.sim.srgb import bytes_to_linear, read_rgb

bpy = pytest.importorskip("bpy")
import cv2
from physgen.physgen_addon.frames.frame_files import Part, write_exr, write_png
from physgen.physgen_addon.frames.frame_index import parse_frame_range
from physgen.physgen_addon.frames.video_encoding import encode_video
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.renderer import Renderer

ROOT = Path(__file__).resolve().parents[2]
QUICK = RenderOptions(samples=1, scale=0.5, motion_blur=0)
SHIFTS = [(0, 0, 0), (0.02, 0, 0), (0.02, 0, 0), (0.04, 0, 0)]


@pytest.fixture
def rendered(monkeypatch):
    """Samples that were really rendered."""
    calls = []
    original = Renderer.frame

    def count(self, sample, camera=None):
        calls.append(sample)
        return original(self, sample, camera)

    monkeypatch.setattr(Renderer, "frame", count)
    return calls


def test_nothing_is_rendered_twice(world, bake, tmp_path, rendered, monkeypatch):
    folder, out = bake(SHIFTS), tmp_path / "out"
    paths = render_frames(world.folder, load_bake(folder), out=out, options=QUICK)
    assert [p.name for p in paths] == ["0001.png", "0002.png", "0003.png", "0004.png"]
    assert rendered == [0, 1, 3]
    assert paths[1].read_bytes() == paths[2].read_bytes()

    rendered.clear()
    render_frames(world.folder, load_bake(folder), out=out, options=QUICK)
    assert rendered == []

    # Whatever the clock says, and the times of frames, bake and scene.
    paths[3].unlink()
    for moment, place in ((4e9, out), (1e6, folder), (3e9, world.folder.root)):
        for path in place.rglob("*"):
            os.utime(path, (moment, moment))
    monkeypatch.setattr(time, "time", lambda: 3e7)
    render_frames(world.folder, load_bake(folder), out=out, options=QUICK)
    assert rendered == [3]

    paths[0].write_bytes(paths[0].read_bytes()[:200])
    rendered.clear()
    render_frames(world.folder, load_bake(folder), out=out, options=QUICK)
    assert rendered == [0]
    assert read_rgb(paths[0]).shape == (60, 80, 3)


def test_cancelling_keeps_complete_frames(world, bake, tmp_path, rendered):
    folder, out = bake(SHIFTS), tmp_path / "out"
    with pytest.raises(Cancelled, match="1 of 4"):
        render_frames(world.folder, load_bake(folder), out=out, options=QUICK, cancelled=lambda: len(rendered) >= 1)
    assert sorted(p.name for p in out.iterdir()) == ["0001.png", "frames.json"]
    assert read_rgb(out / "0001.png").shape == (60, 80, 3)


def test_a_frame_of_two_bakes_or_scenes_is_not_kept(world, bake, tmp_path, rendered):
    """Another command bakes anew, frees the bake, or corrects the scene, while Blender reads it."""
    folder, other, out = (
        bake(SHIFTS),
        bake([(0, 0, 0), (0, 0, 0.03), (0, 0, 0.05), (0, 0, 0.06)], "other"),
        tmp_path / "out",
    )

    def once(change):
        changes = [change]

        def heard(event):
            if event.get("done") == 1 and changes:
                changes.pop()()

        return heard

    def baked_anew():
        for name in ("ball.pc2", "manifest.json"):
            (folder / name).unlink()
            shutil.copy(other / name, folder / name)

    with pytest.raises(InputError, match="was baked anew or freed by another command"):
        render_frames(world.folder, load_bake(folder), out=out, options=QUICK, on_event=once(baked_anew))
    assert list(json.loads((out / "frames.json").read_text())["frames"]) == ["0001.png"]
    rendered.clear()
    render_frames(world.folder, load_bake(folder), out=out, options=QUICK)
    assert rendered == [1, 2, 3]

    fresh = tmp_path / "fresh"
    # Not the world of the other tests.
    scene = load_scene(shutil.copytree(world.folder.root, tmp_path / "corrected"))
    photo = scene.file(scene.model.photo)

    def corrected():
        write_png(tmp_path / "new.png", 255 - read_rgb(photo))
        (tmp_path / "new.png").replace(photo)

    with pytest.raises(InputError, match="was changed by another command"):
        render_frames(scene, load_bake(folder), out=fresh, options=QUICK, cancelled=lambda: bool(corrected()) and False)
    assert not (fresh / "0001.png").exists()


def test_unusable_input_is_named(world, bake, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="no bake there"):
        render_frames(world.folder, load_bake(tmp_path / "none"), out=out, options=QUICK)
    with pytest.raises(InputError, match="has 7 vertices, the mesh of 'ball' has"):
        render_frames(world.folder, load_bake(bake(SHIFTS, "other", np.zeros((7, 3)))), out=out, options=QUICK)
    folder = bake(SHIFTS)
    with pytest.raises(InputError, match="frames 1 to 4 are baked"):
        render_frames(world.folder, load_bake(folder), out=out, options=QUICK, frames="1-9")
    cache = folder / "ball.pc2"
    cache.write_bytes(cache.read_bytes()[:-5])
    with pytest.raises(InputError, match="cut off"):
        render_frames(world.folder, load_bake(folder), out=out, options=QUICK)
    assert not out.exists()
    foreign = tmp_path / "holiday"
    write_png(foreign / "0001.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="choose an empty or new folder"):
        render_frames(world.folder, load_bake(bake(SHIFTS, "again")), out=foreign, options=QUICK)


@pytest.mark.skipif(os.name == "nt", reason="backslashes separate folders there")
def test_a_cache_that_blender_would_not_find_is_refused(world, bake, tmp_path):
    """It takes the backslash for a slash, and a missing cache for one that does not move."""
    with pytest.raises(InputError, match=r"backslashes .* rename or move its folder"):
        render_frames(world.folder, load_bake(bake(SHIFTS, "a\\b")), out=tmp_path / "frames", options=QUICK)


@pytest.mark.parametrize(
    ("text", "numbers"), [(None, [1, 2, 3, 4, 5]), ("2-4", [2, 3, 4]), ("5,1", [1, 5]), ("1-5x2", [1, 3, 5])]
)
def test_ranges(text, numbers):
    assert parse_frame_range(text, 1, 5) == numbers


@pytest.mark.parametrize("text", ["", "x", "3-1", "1-5x0", "0", "6", "-1", "1-"])
def test_ranges_that_are_none(text):
    with pytest.raises(InputError, match="frames"):
        parse_frame_range(text, 1, 5)


def as_tagged(rgb):
    """The colour that players show. OpenCV before 5 decodes by BT.601 whatever the file says; it says BT.709."""
    if int(cv2.__version__.split(".")[0]) >= 5:
        return rgb
    weights = {"601": (0.299, 0.587, 0.114), "709": (0.2126, 0.7152, 0.0722)}

    def from_rgb(r, g, b):
        luma = np.array([r, g, b])
        return np.array([luma, (np.array([0, 0, 1]) - luma) / (1 - b) / 2, (np.array([1, 0, 0]) - luma) / (1 - r) / 2])

    return np.linalg.solve(from_rgb(*weights["709"]), from_rgb(*weights["601"]) @ rgb)


@pytest.mark.parametrize(("suffix", "size"), [(".mp4", (64, 48)), (".mp4", (65, 47)), (".webm", (65, 47))])
def test_video_keeps_number_size_and_colours(tmp_path, suffix, size):
    width, height = size
    colours = [(200, 60, 40), (40, 160, 90), (30, 60, 190), (128, 128, 128), (250, 245, 240)]
    paths = []
    for index, colour in enumerate(colours):
        pixels = np.full((height, width, 3), colour, np.uint8)
        # Frames of either kind come out in the same colours.
        paths.append(tmp_path / f"{index + 3:04d}{'.exr' if index % 2 else '.png'}")
        if index % 2:
            part = Part(name="beauty", channels=("R", "G", "B"), pixels=bytes_to_linear(pixels))
            write_exr(paths[-1], [part], fps=24.0)
        else:
            write_png(paths[-1], pixels)
    clip = tmp_path / f"clip{suffix}"
    encode_video(paths, clip, fps=23.976)
    video = cv2.VideoCapture(str(clip))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(23.976, abs=0.01)
    for colour in colours:
        there, frame = video.read()
        assert there
        assert frame.shape[:2] == (height + height % 2, width + width % 2)
        assert np.abs(as_tagged(frame[..., ::-1].mean((0, 1))) - colour).max() < 6
    assert not video.read()[0]
    video.release()
    assert [p.name for p in tmp_path.iterdir() if p not in paths] == [clip.name]


def run_script(*arguments):
    command = [sys.executable, str(ROOT / "batch" / "render.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


def test_script_speaks_json_and_exit_codes(world, bake, tmp_path):
    folder = bake(SHIFTS)
    common = [world.folder.root, "--bake", folder, "--out", tmp_path / "out", "--json"]
    result = run_script(*common, "--frames", "1,4", "--samples", 1, "--scale", 0.5, "--video", tmp_path / "v.mp4")
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert result.returncode == 0, result.stderr
    assert events[0]["event"] == "progress"
    assert events[-1]["event"] == "done"
    assert events[-1]["frames"] == 2
    assert (tmp_path / "v.mp4").stat().st_size > 0
    refused = run_script(*common, "--frames", "99")
    assert refused.returncode == 3
    assert json.loads(refused.stdout.splitlines()[-1])["kind"] == "InputError"
    assert run_script("--nonsense").returncode == 2
