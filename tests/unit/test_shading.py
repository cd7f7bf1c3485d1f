# SPDX-License-Identifier: MIT
"""The photo's light in a texture: stored, taken out, and named by a scene."""

import dataclasses
import io

import numpy as np
import pytest
import trimesh
from physgen.sim.errors import InputError
from physgen.sim.reconstruct import turntable
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.meshes import read_mesh
from physgen.sim.scene.model import Camera, SceneModel, SceneObject
from physgen.sim.scene.scene_object import IDENTITY4
from physgen.sim.scene.shading import (
    NEUTRAL,
    evenly_lit,
    evenly_lit_mesh,
    factors_at,
    shading_factors,
    shading_values,
)
from physgen.sim.srgb import bytes_to_linear, linear_to_bytes
from PIL import Image

LIGHT = np.linspace(-1.2, 1.2, 64)
"""Logarithms of the light on the columns of a texture."""
COLOUR = (120, 90, 60)


def lit_texture():
    """A texture of one colour in a light that grows from left to right, and its shading."""
    light = np.repeat(np.repeat(LIGHT[None, :, None], 3, axis=2), 32, axis=0)
    linear = bytes_to_linear(np.broadcast_to(np.uint8(COLOUR), light.shape)) * np.exp(light) * 0.3
    return linear_to_bytes(linear.astype(np.float32)), shading_values(light)


@pytest.fixture
def scene(tmp_path):
    texture, shading = lit_texture()
    box = trimesh.creation.box((0.2, 0.1, 0.06))
    uv = np.random.default_rng(0).random((len(box.vertices), 2))
    picture = Image.fromarray(np.dstack([texture, np.full(texture.shape[:2], 77, np.uint8)]))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    box.export(tmp_path / "box.glb")
    Image.fromarray(shading).save(tmp_path / "shading.png")
    item = SceneObject(name="box", mesh="box.glb", size_m=0.2, shading="shading.png")
    camera = Camera(width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0, world_from_camera=IDENTITY4)
    return save_scene(tmp_path, SceneModel(camera=camera, objects=(item,), ground=None, photo=None, background=None))


def test_a_factor_is_stored_to_less_than_a_hundredth():
    logarithms = np.linspace(-1.5, 1.5, 1000)
    # Half a step of 1 / 80.
    assert np.abs(np.log(shading_factors(shading_values(logarithms))) - logarithms).max() <= 0.5 / 80 + 1e-12
    assert shading_factors(np.array([NEUTRAL]))[0] == 1.0


def test_without_its_shading_a_texture_is_of_one_colour():
    texture, shading = lit_texture()
    assert np.ptp(texture.astype(int), axis=(0, 1)).min() > 40
    even = evenly_lit(texture, shading, "box")
    # A texel of the darkest column is rounded to a half of 255 at a third of the brightness.
    assert np.ptp(even.astype(int), axis=(0, 1)).max() <= 3
    assert np.array_equal(evenly_lit(texture, np.full_like(shading, NEUTRAL), "box"), texture)


def test_vertices_have_the_factor_of_their_texel():
    _, shading = lit_texture()
    uv = np.array([[0.0, 0.0], [0.5, 0.2], [1.0, 1.0]])
    wanted = np.exp(LIGHT[[0, 32, 63]])
    assert factors_at(shading, uv)[:, 0] == pytest.approx(wanted, rel=0.5 / 80)
    flipped = np.concatenate([np.full((1, 4, 3), NEUTRAL + 80), np.full((1, 4, 3), NEUTRAL)])
    assert factors_at(flipped.astype(np.uint8), np.array([[0.5, 0.9], [0.5, 0.1]]))[:, 1] == pytest.approx([np.e, 1.0])


def test_other_programs_and_turntables_get_the_even_texture(scene):
    item = scene.objects[0]
    lit, even = read_mesh(scene.file(item.mesh)), evenly_lit_mesh(scene, item)
    assert np.array_equal(np.asarray(lit.vertices), even.vertices)
    picture = np.asarray(Image.open(io.BytesIO(even.picture)))
    assert np.ptp(picture[..., :3].astype(int), axis=(0, 1)).max() <= 3
    assert (picture[..., 3] == 77).all()
    shown = turntable.turned_object(scene, item).paint.texture
    assert np.array_equal(shown, picture[..., :3])
    plain = dataclasses.replace(item, shading=None)
    assert np.array_equal(turntable.turned_object(scene, plain).paint.texture, lit_texture()[0])
    assert evenly_lit_mesh(scene, plain).picture.startswith(b"\x89PNG")


def test_a_scene_names_its_shading_and_moves_as_without(scene):
    assert "shading.png" in scene.files()
    without = scene.with_model(
        dataclasses.replace(scene.model, objects=(dataclasses.replace(scene.objects[0], shading=None),))
    )
    assert scene.hash() == without.hash() and scene.geometry_hash() == without.geometry_hash()
    assert load_scene(scene.root).objects[0].shading == "shading.png"
    (scene.root / "shading.png").unlink()
    with pytest.raises(InputError, match=r"shading\.png"):
        load_scene(scene.root)


def test_a_shading_of_another_texture_is_refused(scene):
    Image.fromarray(np.zeros((5, 6, 3), np.uint8)).save(scene.root / "shading.png")
    for read in (evenly_lit_mesh, turntable.turned_object):
        with pytest.raises(InputError, match=r"box: shading\.png: has 6x5 pixels and its texture 64x32"):
            read(scene, scene.objects[0])
    (scene.root / "shading.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="not a readable image"):
        evenly_lit_mesh(scene, scene.objects[0])
