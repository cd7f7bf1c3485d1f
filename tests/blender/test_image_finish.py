# SPDX-License-Identifier: GPL-3.0-or-later
"""What makes rendered things belong to the photo, in real frames: nothing at rest, and the truth when they move."""

import dataclasses

import cv2
import numpy as np
import pytest
from physgen.sim.cache.bake_folder import load_bake
from physgen.sim.scene.folder import Scene

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.playback.point_caches import open_bake
from physgen.physgen_addon.render.clean_plate import make_camera_motion
from physgen.physgen_addon.render.render_frames import plan_frames
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.renderer import Renderer

OFF = RenderOptions(samples=16, motion_blur=0, grain=False, match_sharpness=False, reflections=False)
DRAFT = dataclasses.replace(OFF, samples=4)
"""For pictures that are compared bit for bit, or have little noise to begin with."""
LIFT = 0.02
SHIFT = (-0.07, 0.03, 0.0)


def with_ground(folder: Scene, **fields) -> Scene:
    ground = dataclasses.replace(folder.model.ground, **fields)
    return dataclasses.replace(folder, model=dataclasses.replace(folder.model, ground=ground))


def frames(folder, opened, options, samples):
    renderer = Renderer(folder, opened, options)
    made = [renderer.frame(sample) for sample in samples]
    renderer.close()
    return made


@pytest.mark.long
def test_everything_on_changes_nothing_at_rest_and_each_changes_what_moves(world, bake):
    glossy = with_ground(world.folder, reflectivity=0.3)
    opened = open_bake(load_bake(bake([(0, 0, 0), (0, -0.05, LIFT)])), world.folder)
    everything = dataclasses.replace(
        DRAFT, motion_blur=0.5, grain=True, match_sharpness=True, reflections=True, f_number=1
    )
    plain, full = (frames(glossy, opened, options, (0, 1)) for options in (DRAFT, everything))
    assert np.array_equal(plain[0].beauty, full[0].beauty)
    assert not np.array_equal(plain[1].shadow, full[1].shadow)
    assert np.abs(plain[1].beauty - full[1].beauty).mean() > 1e-3
    assert not bpy.data.scenes.get("PhysGen colours") and not bpy.data.cameras


@pytest.mark.long
def test_motion_blur_is_the_mean_over_the_shutter(world, bake):
    way = np.array([0.06, 0.0, 0.03])
    fine = [(0, 0, 0), *(0.5 * way + way * 0.5 * (i + 0.5) / 12 for i in range(12))]
    mean = np.mean(
        [
            f.objects.alpha
            for f in frames(world.folder, open_bake(load_bake(bake(fine, "fine")), world.folder), DRAFT, range(1, 13))
        ],
        axis=0,
    )
    opened = open_bake(load_bake(bake([(0, 0, 0), way])), world.folder)
    blurred = frames(world.folder, opened, dataclasses.replace(OFF, motion_blur=0.5), [1])[0]
    assert np.abs(blurred.objects.alpha - mean).max() < 0.15
    assert np.abs(blurred.objects.alpha - mean).mean() < 0.004


def test_a_glossy_floor_shows_the_ball_upside_down(world, bake):
    glossy = with_ground(world.folder, reflectivity=0.5, reflection_roughness=0.0)
    opened = open_bake(load_bake(bake([(0, 0, 0), (0, 0, LIFT)])), world.folder)
    options = dataclasses.replace(OFF, reflections=True)
    shown = frames(glossy, opened, options, [1])[0]
    matte = frames(world.folder, opened, options, [1])[0]
    change = np.abs(shown.ground - matte.ground).max(axis=-1)
    # The ball's image lies as far below the floor as the ball above it.
    camera, ground = world.folder.model.camera, world.folder.model.ground
    ball = np.array([0.02, 0.0, 0.05 + LIFT])
    middle = camera.project(ball * (1, 1, -1))[:2]
    edge = camera.project(np.array([0.02 + 0.05, 0.0, -0.05 - LIFT]))[:2]
    rows, columns = np.indices(change.shape)
    distance = np.hypot(columns + 0.5 - middle[0], rows + 0.5 - middle[1])
    radius = np.linalg.norm(edge - middle)
    seen = shown.objects.alpha == 0
    assert (change[seen & (distance < 0.8 * radius)] > 0.01).mean() > 0.9
    assert change[seen & (distance > 1.3 * radius)].max() < 1e-3
    assert ground.reflectivity == 0


def test_hard_sun_hard_shadow(world, bake):
    opened = open_bake(load_bake(bake([(0, 0, 0), (0, 0, 0.1)])), world.folder)

    def steepest(angle: float) -> float:
        shadow = frames(world.folder, opened, dataclasses.replace(OFF, sun_angle=angle, light_scale=1.0), [1])[0].shadow
        return float(np.hypot(*np.gradient(cv2.GaussianBlur(shadow.mean(axis=-1), (0, 0), 1.0))).max())

    assert steepest(0.0) > 2 * steepest(0.6)


def test_blurred_frames_depend_on_the_frame_before(world, bake):
    options = RenderOptions()

    def hashes(shifts, name):
        opened = open_bake(load_bake(bake(shifts, name)), world.folder)
        numbers = range(1, len(shifts) + 1)
        rest = [cache.sample(0) for cache in opened.caches]
        shot = make_camera_motion(world.folder, rest, options, first_frame=1, count=len(shifts), fps=24.0)
        made = plan_frames(world.folder, opened, numbers, options=options, shot=shot, blender="")
        return [frame.inputs for frame in made], [frame.sample for frame in made]

    a, b = (0.02, 0, 0), (0.04, 0, 0)
    first, samples = hashes([(0, 0, 0), a, a, a, b, b, (0, 0, 0), (0, 0, 0)], "first")
    assert samples == [0, 1, 2, 2, 4, 5, 6, 0]
    assert len(set(first)) == 6 and first[0] == first[7] and first[2] == first[3]
    other, _ = hashes([(0, 0, 0), SHIFT, a, a, b, b, (0, 0, 0), (0, 0, 0)], "other")
    assert [x == y for x, y in zip(first, other, strict=True)] == [True, False, False, True, True, True, True, True]
