# SPDX-License-Identifier: GPL-3.0-or-later
"""Rendered frames against the photo and against what Cycles renders of the true world."""

import dataclasses
import shutil
from typing import Any

import numpy as np
import pytest
import trimesh
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.composite.image_metrics import psnr
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Light
from physgen.sim.scene.shading import NEUTRAL, shading_values
from physgen.sim.srgb import bytes_to_linear, linear_to_bytes, read_mask, read_rgb
from PIL import Image

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.playback.point_caches import open_bake
from physgen.physgen_addon.render.render_frames import render_frames
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.renderer import Renderer
from scipy import ndimage

SHIFT = (-0.07, 0.03, 0.0)
LIFTED = (0.0, 0.0, 0.004)


@pytest.fixture
def frames(world, bake, tmp_path):
    shifts = [(0, 0, 0), (1e-4, 0, 0), SHIFT]
    paths = render_frames(
        world.folder, load_bake(bake(shifts)), out=tmp_path / "out", options=RenderOptions(samples=32, motion_blur=0)
    )
    return [read_rgb(path) for path in paths]


def test_rest_is_the_photo_and_motion_is_the_truth(world, frames):
    mask = read_mask(world.folder.file("masks/ball.png"))
    first, second, moved = frames
    assert psnr(first, world.photo, mask) > 35
    assert psnr(first, world.photo) > 38
    # Nothing pops when the ball has moved by a tenth of a pixel.
    outside = ~ndimage.binary_dilation(mask, iterations=2)
    assert np.abs(second.astype(float) - first)[outside].mean() < 0.2

    assert psnr(moved, world.moved) > 30
    # Where the ball stood there is the background again; some of it lies in the new shadow's faint outskirts.
    gone = ndimage.binary_erosion(mask & ~world.moved_mask, iterations=3)
    assert np.abs(moved.astype(float) - world.moved)[gone].mean() < 4
    # The shadow is a ratio of light: compare it with the truth's.
    ground = ~ndimage.binary_dilation(world.moved_mask | mask, iterations=3)
    empty = np.maximum(bytes_to_linear(world.background), 1e-3)
    ratio, truth = (bytes_to_linear(image).mean(-1) / empty.mean(-1) for image in (moved, world.moved))
    shadow = ground & (truth < 0.75)
    assert shadow.sum() > 50
    assert abs(np.median(ratio[shadow] - truth[shadow])) < 0.03
    # The ball turns no brighter or darker than it would in truth.
    inside = ndimage.binary_erosion(world.moved_mask, iterations=3)
    assert abs(float((moved.astype(float) - world.moved)[inside].mean())) < 6


@pytest.mark.long
def test_only_rendering_what_can_be_seen_changes_nothing(world, bake):
    opened = open_bake(load_bake(bake([(0, 0, 0), SHIFT])), world.folder)
    pictures = []
    for crop in (True, False):
        renderer = Renderer(world.folder, opened, RenderOptions(samples=64, crop=crop))
        pictures.append(linear_to_bytes(renderer.frame(1).beauty).astype(int))
        renderer.close()
    difference = np.abs(pictures[0] - pictures[1])
    assert difference.mean() < 0.3
    assert np.percentile(difference, 99) <= 2


def test_under_an_even_sky_a_ball_darkens_the_ground_as_its_form_factor_says(world, bake):
    """It fills R² h / d³ of the sky of a point of the ground, d from a centre at the height h: all of it at contact."""
    sky = dataclasses.replace(world.folder.model, light=Light())
    folder = dataclasses.replace(world.folder, model=sky)
    options = RenderOptions(samples=32, motion_blur=0)
    renderer = Renderer(folder, open_bake(load_bake(bake([(0, 0, 0), SHIFT])), folder), options)
    shadow = renderer.frame(1).shadow
    renderer.close()
    camera = sky.camera
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.rays(np.stack([x, y], axis=-1))
    ground = camera.position - rays * (camera.position[2] / rays[..., 2:])
    vertices = load_object_mesh(folder, sky.objects[0]).vertices + SHIFT
    centre, radius = (vertices.max(axis=0) + vertices.min(axis=0)) / 2, float(np.ptp(vertices, axis=0).max()) / 2
    assert centre[2] == pytest.approx(radius, abs=1e-3 * radius)
    away = np.linalg.norm((ground - centre)[..., :2], axis=-1) / radius
    true = 1.0 - (1.0 + away**2) ** -1.5
    for near, far in ((0.0, 0.3), (0.3, 0.6), (0.6, 1.0), (1.0, 2.0), (2.0, 4.0)):
        ring = (rays[..., 2] < 0) & (away >= near) & (away < far)
        assert ring.sum() > 20
        assert shadow.mean(axis=-1)[ring].mean() == pytest.approx(true[ring].mean(), abs=0.03), (near, far)


def test_out_of_view_is_the_background_alone(world, bake):
    opened = open_bake(load_bake(bake([(0, 0, 0), (50.0, 0, 0)])), world.folder)
    renderer = Renderer(world.folder, opened, RenderOptions(samples=4, grain=False))
    gone = linear_to_bytes(renderer.frame(1).beauty)
    renderer.close()
    mask = read_mask(world.folder.file("masks/ball.png"))
    assert np.array_equal(gone[mask], world.background[mask])
    assert not [scene for scene in bpy.data.scenes if scene.name.startswith("PhysGen")]


def test_a_highlight_stays_where_its_lamp_is_while_the_ball_turns(world, bake, tmp_path):
    """Its texture holds the highlight: it would turn with the ball, and go dim where less light falls."""
    shutil.copytree(world.folder.root, tmp_path / "glossy")
    folder = load_scene(tmp_path / "glossy")
    camera, rest = folder.model.camera, load_object_mesh(folder, folder.model.objects[0]).vertices
    towards = camera.rays(np.array([camera.project(rest.mean(axis=0)[None])[0, :2]]))[0]
    mirror = np.array([-0.25, -0.1, 1.0]) - towards / np.linalg.norm(towards)
    centre = (rest.max(axis=0) + rest.min(axis=0)) / 2
    spot = centre + np.linalg.norm(rest - centre, axis=1).mean() * mirror / np.linalg.norm(mirror)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    place = camera.project(spot[None])[0, :2]
    white = 0.3 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 30.0)
    mesh: Any = trimesh.load(folder.file("meshes/ball.glb"), process=False, force="mesh")
    texture = mesh.visual.material.baseColorTexture
    for name, pixels in (("photo.png", world.photo), ("texture", np.asarray(texture.convert("RGB")))):
        shiny = linear_to_bytes((bytes_to_linear(pixels) + white[..., None]).astype(np.float32))
        if name == "texture":
            mesh.visual.material.baseColorTexture = Image.fromarray(shiny)
        else:
            Image.fromarray(shiny).save(folder.root / name)
    mesh.export(folder.root / "meshes" / "ball.glb")
    turn = trimesh.transformations.rotation_matrix(np.radians(50), (1.0, 0.0, 0.0))[:3, :3]
    turned = (rest - centre) @ turn.T + centre
    opened = open_bake(load_bake(bake([(0, 0, 0), turned - rest])), folder)
    renderer = Renderer(folder, opened, RenderOptions(samples=8, grain=False, motion_blur=0))
    still, now = (renderer.frame(sample).beauty for sample in (0, 1))
    renderer.close()
    inside = ndimage.binary_erosion(read_mask(world.folder.file("masks/ball.png")), iterations=4)
    assert psnr(linear_to_bytes(still), read_rgb(folder.root / "photo.png"), inside) > 35
    # The ball's own colour has hardly any blue.
    blue = np.where(inside, ndimage.gaussian_filter(now[..., 2], 1.5), 0.0)
    at = np.array(np.unravel_index(int(np.argmax(blue)), blue.shape))[::-1] + 0.5
    assert at == pytest.approx(place, abs=4.0)
    went = camera.project(((spot - centre) @ turn.T + centre)[None])[0, :2]
    assert inside[int(went[1]), int(went[0])] and np.hypot(*(went - place)) > 10
    assert now[int(went[1]), int(went[0]), 2] < 0.5 * blue.max()


def with_an_even_back(folder, photo, *, shading):
    """Let the ball show the photo where that shows it, and behind the colour of its middle; return the scene.

    Its own colour is even, so the photo's light over that of its middle is its shading.
    """
    item, camera = folder.model.objects[0], folder.model.camera
    mesh: Any = trimesh.load(folder.file(item.mesh), process=False, force="mesh")
    height, width = photo.shape[:2]
    at = camera.project(mesh.vertices)
    towards = ((camera.position - mesh.vertices) * mesh.vertex_normals).sum(axis=1) > 0
    front = towards[mesh.faces].all(axis=1)
    own = np.stack([at[:, 0] / (2 * width), 1 - at[:, 1] / height], axis=1)
    uv = np.concatenate([own, np.full_like(own, (0.75, 0.5))])
    faces = np.where(front[:, None], mesh.faces, mesh.faces + len(own))
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    light = bytes_to_linear(texture)
    x, y = camera.project(mesh.vertices.mean(axis=0)[None])[0, :2].astype(int)
    middle = light[y - 3 : y + 4, x - 3 : x + 4].mean(axis=(0, 1))
    back = np.broadcast_to(linear_to_bytes(middle.astype(np.float32)), texture.shape)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(np.hstack([texture, back])))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    twice = np.concatenate([mesh.vertices, mesh.vertices])
    trimesh.Trimesh(twice, faces, visual=visual, process=False).export(folder.file(item.mesh))
    if not shading:
        return folder
    factors = shading_values(np.log(np.maximum(light, 1e-3) / middle))
    Image.fromarray(np.hstack([factors, np.full_like(factors, NEUTRAL)])).save(folder.root / "shading.png")
    shaded = dataclasses.replace(item, shading="shading.png")
    return folder.with_model(dataclasses.replace(folder.model, objects=(shaded,)))


def test_a_ball_of_one_colour_that_turns_its_back_looks_as_before(world, bake, tmp_path):
    """The light at rest goes on behind without the shade of the photo's dark side, as the even texture there does."""
    inside = ndimage.binary_erosion(read_mask(world.folder.file("masks/ball.png")), iterations=3)
    found = {}
    for shading in (False, True):
        shutil.copytree(world.folder.root, tmp_path / str(shading))
        folder = with_an_even_back(load_scene(tmp_path / str(shading)), world.photo, shading=shading)
        rest = load_object_mesh(folder, folder.model.objects[0]).vertices
        centre = (rest.max(axis=0) + rest.min(axis=0)) / 2
        poses = [(rest - centre) * (turn, turn, 1.0) + centre - rest for turn in (1.0, -1.0)]
        opened = open_bake(load_bake(bake(poses, f"bake {shading}", rest)), folder)
        renderer = Renderer(folder, opened, RenderOptions(samples=16, grain=False, motion_blur=0))
        still, turned = (linear_to_bytes(renderer.frame(sample).beauty) for sample in (0, 1))
        renderer.close()
        assert psnr(still, world.photo, inside) > 35
        found[shading] = psnr(turned, world.photo, inside)
    # As close as the ball that only moves.
    assert found[True] > 30 > found[False] + 3, found
