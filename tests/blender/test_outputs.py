# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames as EXR with all layers, against what is known of them; the same frames as PNG; chunks as a video."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from physgen.sim.cache.bake_folder import load_bake, load_manifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.srgb import linear_to_bytes, read_rgb

bpy = pytest.importorskip("bpy")
import cv2
from physgen.physgen_addon.frames.frame_files import (
    Part,
    read_layers,
    write_exr,
)
from physgen.physgen_addon.frames.frame_index import FrameIndex
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions

ROOT = Path(__file__).resolve().parents[2]
SHIFTS = [(0, 0, 0), (0.02, 0, 0.01), (0.02, 0, 0.01), (0.05, 0.02, 0.01)]


def stack(channels, name, letters):
    return np.stack([channels[f"{name}{c}"] for c in letters], axis=-1)


def test_layers_hold_the_frame_and_where_everything_goes(world, bake, tmp_path):
    folder = bake(SHIFTS)
    quick = {"samples": 1, "scale": 0.5, "grain": False, "motion_blur": 0.0}
    layered = render_frames(
        world.folder, load_bake(folder), out=tmp_path / "exr", options=RenderOptions(format="exr-layers", **quick)
    )
    assert [path.name for path in layered] == ["0001.exr", "0002.exr", "0003.exr", "0004.exr"]
    # The third looks like the second, but moves on.
    assert layered[1].read_bytes() != layered[2].read_bytes()
    channels = read_layers(layered[1])
    height, width = channels["R"].shape
    y, x = np.mgrid[:height, :width] + 0.5
    camera = world.folder.model.camera
    centre = np.array([0.02, 0.0, 0.05]) + SHIFTS[1]

    # The picture is what the layers make, and what the PNG shows.
    beauty, objects = stack(channels, "", "RGB"), stack(channels, "objects.", "RGBA")
    ground = stack(channels, "ground.", "RGB")
    assert np.abs(objects[..., :3] + (1 - objects[..., 3:]) * ground - beauty).max() < 2e-3
    png = render_frames(
        world.folder, load_bake(folder), out=tmp_path / "png", options=RenderOptions(**quick), frames="2"
    )
    assert np.abs(linear_to_bytes(beauty).astype(int) - read_rgb(png[0])).max() <= 1

    # The ball is where a ray through the pixel's centre meets the sphere, at that depth.
    rays = camera.rays(np.stack([x, y], axis=-1) * 2)
    b, c = rays @ (camera.position - centre), (camera.position - centre) @ (camera.position - centre) - 0.05**2
    a = (rays * rays).sum(-1)
    root = b * b - a * c
    sphere = (-b - np.sqrt(np.maximum(root, 0))) / a
    inside, outside = root > 0.05 * a * 0.05**2, root < 0
    assert inside.sum() > 150
    ids = channels["object_id.X"]
    assert (ids[inside] == 1).all() and (ids[outside] == 0).all()
    assert np.abs(channels["depth.Z"] - sphere)[inside].max() < 5e-4
    # The floor is z = 0.
    floor = camera.position[2] / -rays[..., 2]
    assert np.allclose(channels["depth.Z"][outside], floor[outside], rtol=1e-5)

    # Each of its points moves by the next shift less this one; the camera stands, and so does the floor.
    flow = stack(channels, "flow.", "XYZW")
    assert (flow[outside] == 0).all()
    assert (flow[..., :2] == 0).all()  # the next frame is the same
    points = camera.position + rays * channels["depth.Z"][..., None]
    there = camera.project(points - np.array(SHIFTS[1]))[..., :2] / 2
    assert np.abs(flow[..., 2:] - (there - np.stack([x, y], -1)))[inside].max() < 0.01
    onward = stack(read_layers(layered[2]), "flow.", "XY")
    there = camera.project(points + np.array(SHIFTS[3]) - np.array(SHIFTS[2]))[..., :2] / 2
    assert np.abs(onward - (there - np.stack([x, y], -1)))[inside].max() < 0.01

    source = oiio.ImageInput.open(str(layered[1]))
    names = []
    while source.seek_subimage(len(names), 0):
        names.append(source.spec().get_string_attribute("name"))
    assert names == ["beauty", "objects", "ground", "shadow", "depth", "object_id", "flow"]
    source.seek_subimage(5, 0)
    assert json.loads(source.spec().get_string_attribute("physgen:object_ids")) == {"ball": 1}
    source.close()


@pytest.mark.parametrize("look", ["grains", "surface"])
def test_particles_have_the_id_of_their_object_and_flow(world, bake, tmp_path, look):
    centre, apart, step = np.array([0.02, 0.0, 0.05]), np.array([0.0, 0.0, 0.06]), np.array([0.03, 0.0, 0.0])
    side = np.arange(-0.03, 0.031, 0.012)
    rest = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3) + centre
    skin = load_object_mesh(world.folder, world.folder.model.objects[0]).vertices
    torn = (skin - centre) * [3.0, 3.0, 0.05] + centre
    folder = bake([(0, 0, 0)] * 3)
    for name, samples in (
        ("ball.pc2", [skin, torn, torn + step]),
        ("ball.points.pc2", [rest, rest + apart, rest + apart + step]),
    ):
        with Pc2Writer(folder / name, vertex_count=len(samples[0])) as writer:
            for sample in samples:
                writer.append(sample)
    manifest = load_manifest(folder)
    flowing = dataclasses.replace(manifest.objects[0], points_file="ball.points.pc2", points=len(rest), points_as=look)
    save_manifest(folder, dataclasses.replace(manifest, objects=(flowing,)))
    options = RenderOptions(samples=1, format="exr-layers", scale=0.5)
    (path,) = render_frames(world.folder, load_bake(folder), out=tmp_path / "out", options=options, frames="2")
    channels = read_layers(path)
    seen = channels["object_id.X"] == 1
    camera = world.folder.model.camera
    columns, rows = (camera.project(rest + apart)[:, :2].T / 2).astype(int)
    assert seen[rows, columns].mean() > 0.6
    y, x = np.mgrid[: seen.shape[0], : seen.shape[1]] + 0.5
    pixels = np.stack([x, y], axis=-1)
    points = camera.position + camera.rays(pixels * 2) * channels["depth.Z"][..., None]
    expected = camera.project(points + step)[..., :2] / 2 - pixels
    assert np.abs(stack(channels, "flow.", "XY") - expected)[seen].max() < 0.02


def test_chunks_become_one_video_in_a_process_of_its_own(tmp_path):
    chunks = []
    for first in (1, 4):
        chunks.append(tmp_path / f"{first}")
        ledger = FrameIndex(chunks[-1], suffix=".exr", fps=12.5)
        for number in range(first, first + 3):
            light = np.full((48, 64, 3), number / 10, np.float32)
            write_exr(ledger.path(number), [Part(name="beauty", channels=("R", "G", "B"), pixels=light)], fps=12.5)
            ledger.record(number, "inputs")
    command = [sys.executable, str(ROOT / "batch" / "encode.py"), str(chunks[1]), str(chunks[0]), "--json", "--out"]
    done = subprocess.run([*command, tmp_path / "clip.webm"], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    final = json.loads(done.stdout.splitlines()[-1])
    assert final == {"event": "done", "out": str(tmp_path / "clip.webm"), "frames": 6, "fps": 12.5}
    video = cv2.VideoCapture(str(tmp_path / "clip.webm"))
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    for number in range(1, 7):
        grey = linear_to_bytes(np.float32(number / 10))
        assert np.abs(video.read()[1].mean() - grey) < 4
    video.release()
    (chunks[1] / "0005.exr").unlink()
    refused = subprocess.run([*command, tmp_path / "clip.mp4"], capture_output=True, text=True, timeout=200)
    assert refused.returncode == 3
    assert "frame 5 of 1 to 6" in json.loads(refused.stdout.splitlines()[-1])["message"]
    assert not (tmp_path / "clip.mp4").exists()
