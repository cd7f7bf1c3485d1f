# SPDX-License-Identifier: GPL-3.0-or-later
"""Torn skins in Blender and in the photo: the whole mesh until the first crack, the cut one from then on."""

import dataclasses

import bpy
import numpy as np
import pytest
from physgen.physgen_addon.playback import particles
from physgen.physgen_addon.playback.bake_record import BakeRecord
from physgen.physgen_addon.playback.point_caches import open_bake
from physgen.physgen_addon.render.render_options import RenderOptions
from physgen.physgen_addon.render.renderer import Renderer
from physgen.sim.cache.bake_folder import Bake, BakedObject, save_manifest
from physgen.sim.cache.pc2 import Pc2Reader, Pc2Writer
from physgen.sim.cache.torn_skin_file import read_torn_skin, write_torn_skin
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.skinning import bind, deform
from physgen.sim.tearing.blocks import make_blocks, opening_times, regrouped
from physgen.sim.tearing.cut_skin import tear

from ..conftest import complete_manifest

FRAMES = 6


@pytest.fixture
def torn_bake(ball_scene, tmp_path):
    """A ball whose halves part along X from sample 3 on."""
    scene = ball_scene()
    mesh = load_object_mesh(scene, scene.objects[0])
    axis = np.linspace(-0.05, 0.05, 17)
    matter = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    matter = matter[np.linalg.norm(matter, axis=1) < 0.0501] + mesh.vertices.mean(axis=0)
    still = np.tile(np.eye(3), (len(matter), 1, 1))

    def at(sample):
        side = np.sign(matter[:, :1] - 1e-9)
        return matter + side * [0.02, 0, 0] * max(0, sample - 2)

    blocks = make_blocks(matter, 4 / 3 * np.pi * 0.05**3)
    blocks = regrouped(blocks, matter, at(FRAMES - 1))
    opens = opening_times(blocks, [(s, at(s), still) for s in range(FRAMES)])
    motion = tear(mesh.vertices, mesh.faces, matter, blocks, opens)
    root = tmp_path / "bake"
    root.mkdir()
    binding = bind(mesh.vertices, matter)
    with (
        Pc2Writer(root / "ball0.pc2", vertex_count=len(mesh.vertices)) as whole,
        Pc2Writer(root / "ball0.torn.pc2", vertex_count=len(motion.skin.parents)) as cut,
    ):
        for sample in range(FRAMES):
            regular = mesh.vertices if sample == 0 else deform(binding, at(sample), still)
            whole.append(regular)
            cut.append(motion.vertices(sample, regular, at(sample), still))
    write_torn_skin(root / "ball0.torn.npz", motion.skin)
    item = BakedObject(
        name="ball0",
        file="ball0.pc2",
        vertices=len(mesh.vertices),
        torn_file="ball0.torn.pc2",
        torn_skin="ball0.torn.npz",
        torn=len(motion.skin.parents),
        torn_from=motion.skin.first,
    )
    manifest = complete_manifest(item, frames=FRAMES, particles=len(matter))
    save_manifest(root, manifest)
    return scene, Bake(root=root, manifest=manifest), mesh


def test_the_torn_skin_plays_by_native_modifiers_alone(torn_bake):
    _, bake, mesh = torn_bake
    data = particles.new_mesh("ball0", mesh.vertices, mesh.faces)
    flat = mesh.vertices[mesh.faces].reshape(-1, 3)[:, :2].astype(np.float32)
    data.uv_layers.new(name="UV").data.foreach_set("uv", flat.ravel())
    body = bpy.data.objects.new("ball0", data)
    bpy.context.collection.objects.link(body)
    baked = bake.manifest.objects[0]
    record = BakeRecord(folder=str(bake.root))
    particles.show_torn_skin(bpy.context.scene, body, baked, record)
    item = particles.find(bpy.context.scene, "ball0")
    uv = np.empty(2 * len(item.data.loops), dtype=np.float32)
    item.data.uv_layers["UV"].data.foreach_get("uv", uv)
    outer = np.empty(len(item.data.loops), dtype=np.int32)
    item.data.loops.foreach_get("vertex_index", outer)
    rest = Pc2Reader(bake.root / baked.torn_file).sample(0)
    inside = read_torn_skin(bake.root / baked.torn_skin, len(mesh.vertices), len(mesh.faces)).inside
    skin = np.repeat(~inside, 3)
    np.testing.assert_allclose(uv.reshape(-1, 2)[skin], rest[outer[skin], :2], atol=1e-4)
    for frame in range(1, FRAMES + 1):
        bpy.context.scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        counts = [len(each.evaluated_get(graph).data.vertices) for each in (body, item)]
        torn = frame - 1 >= baked.torn_from
        assert counts == ([0, baked.torn] if torn else [baked.vertices, 0])
    places = np.empty(3 * baked.torn, dtype=np.float32)
    item.evaluated_get(graph).data.attributes["position"].data.foreach_get("vector", places)
    last = Pc2Reader(bake.root / baked.torn_file).sample(FRAMES - 1)
    np.testing.assert_allclose(places.reshape(-1, 3), last, atol=1e-6)
    particles.remove(item)
    particles.uncover(body)
    assert particles.find(bpy.context.scene, "ball0") is None
    assert not len(body.modifiers)


def test_the_photo_shows_the_background_between_the_pieces(torn_bake):
    scene, bake, _ = torn_bake
    opened = open_bake(bake, scene)
    without = dataclasses.replace(opened, tears=(None,))
    options = RenderOptions(samples=4, engine="cycles", motion_blur=0.0)
    alphas = []
    for each in (opened, without):
        renderer = Renderer(scene, each, options)
        try:
            alphas.append([renderer.frame(sample).objects.alpha.copy() for sample in (0, FRAMES - 1)])
        finally:
            renderer.close()
    assert (alphas[0][0] == alphas[1][0]).all()  # the first frame is the same, bit for bit
    assert alphas[0][1].sum() < 0.9 * alphas[1][1].sum()  # the uncut skin spans the gap
