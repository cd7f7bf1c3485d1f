# SPDX-License-Identifier: GPL-3.0-or-later
"""Sand and liquids in the photo: the photo while their skin holds, their particles in its colours afterwards."""

import dataclasses

import numpy as np
import pytest
from physgen.sim.cache.bake_folder import load_bake, load_manifest, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.srgb import read_mask, read_rgb

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions

RADIUS, CENTRE = 0.05, np.array([0.02, 0.0, 0.05])
"""Of the world's ball."""
SPACING = 0.012


def heap(skin):
    """Particles that fill the ball, its ``skin`` (V, 3) and them when it has fallen apart to the left."""
    steps = np.arange(-RADIUS, RADIUS, SPACING) + SPACING / 2
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    rest = grid[np.linalg.norm(grid, axis=1) < RADIUS - SPACING / 2] + CENTRE
    flat = (rest - CENTRE) * [1.3, 1.3, 0.35] + [-0.07, 0.03, 0.35 * RADIUS]
    spread = (skin - CENTRE) * [2.2, 2.2, 0.05] + [-0.07, 0.03, 0.01]
    return rest, spread, flat


def hue(pixels):
    """Mean colour (3,) without its brightness."""
    mean = pixels.astype(float).reshape(-1, 3).mean(axis=0)
    return mean / mean.sum()


@pytest.mark.parametrize("look", ["grains", "surface"])
def test_particles_show_the_photo_until_they_separate_and_keep_its_colours(world, bake, tmp_path, look):
    vertices = load_object_mesh(world.folder, world.folder.model.objects[0]).vertices
    rest, spread, flat = heap(vertices)
    folder = bake([(0, 0, 0)] * 2)
    lifted = np.array([0.0, 0.0, 0.05])
    for name, samples in (
        ("ball.pc2", [vertices, vertices + lifted, spread]),
        ("ball.points.pc2", [rest, rest + lifted, flat]),
    ):
        with Pc2Writer(folder / name, vertex_count=len(samples[0])) as writer:
            for sample in samples:
                writer.append(sample)
    manifest = load_manifest(folder)
    flowing = dataclasses.replace(manifest.objects[0], points_file="ball.points.pc2", points=len(rest), points_as=look)
    save_manifest(folder, dataclasses.replace(manifest, frames=3, frames_done=3, objects=(flowing,)))
    before = set(bpy.data.node_groups)
    paths = render_frames(world.folder, load_bake(folder), out=tmp_path / "out", options=RenderOptions(samples=8))
    first, whole, apart = (read_rgb(path) for path in paths)
    assert psnr(first, world.photo) > 38
    # In the air it is still one ball: the same as without particles, but for the noise of light in another crop.
    save_manifest(folder, dataclasses.replace(manifest, frames=3, frames_done=3))
    skin = render_frames(
        world.folder, load_bake(folder), out=tmp_path / "skin", options=RenderOptions(samples=8), frames="2-3"
    )
    assert psnr(whole, read_rgb(skin[0])) > 50
    assert psnr(apart, read_rgb(skin[1])) < 35
    # The heap is where its particles are, in the ball's colour and not the floor's, whatever the light.
    columns, rows = np.rint(world.folder.model.camera.project(flat + np.array([0, 0, 0.01]))[:, :2]).astype(int).T
    ball = hue(first[read_mask(world.folder.file("masks/ball.png"))])
    floor = hue(world.background[rows, columns])
    assert np.linalg.norm(hue(apart[rows, columns]) - ball) < np.linalg.norm(floor - ball) / 2
    assert set(bpy.data.node_groups) == before
