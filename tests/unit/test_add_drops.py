# SPDX-License-Identifier: MIT
"""Things that fall into a photo: their meshes and places, and what is refused before anything is written."""

import numpy as np
import pytest
import trimesh
from physgen.batch import demo
from physgen.sim.app.add_drops import Drop, add_drops
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh, read_mesh


def test_drops_stand_where_they_were_put_and_are_replaced_not_doubled(ball_scene, tmp_path):
    scene = ball_scene(preset="jelly")
    cone = tmp_path / "cone.stl"
    trimesh.creation.cone(radius=3.0, height=10.0).export(cone)
    drops = (
        Drop(name="marble", size_m=0.02, place=(0.1, 0.2, 0.4), velocity=(0.0, 0.0, -1.0), preset="rubber"),
        Drop(name="sugar", shape="block", size_m=0.03, place=(-0.1, 0.0, 0.3), spin=(1.0, 2.0, 3.0)),
        Drop(name="cone", shape="mesh", mesh=cone, size_m=0.1, place=(0.0, 0.0, 0.7)),
    )
    with_drops = add_drops(scene, drops)
    assert [item.name for item in with_drops.objects] == ["ball0", "marble", "sugar", "cone"]
    assert with_drops.objects[0] == scene.objects[0] and load_scene(scene.root) == with_drops
    for drop, item in zip(drops, with_drops.objects[1:], strict=True):
        mesh = load_object_mesh(with_drops, item)
        assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(drop.size_m)
        assert np.allclose((mesh.vertices.max(0) + mesh.vertices.min(0)) / 2, drop.place, atol=1e-6)
        assert (item.velocity, item.spin, item.material.preset) == (drop.velocity, drop.spin, drop.preset)
        assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight
        assert read_mesh(with_drops.file(item.mesh)).visual.uv is not None
    before = with_drops.hash()
    assert add_drops(with_drops, drops).hash() == before and len(add_drops(scene, drops[:1]).objects) == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shape": "pyramid"}, "shape is 'pyramid'"),
        ({"shape": "mesh"}, "mesh is None"),
        ({"size_m": 0.0}, "size_m is 0"),
        ({"place": (0.0, float("nan"), 0.0)}, "place is"),
        ({"colours": ()}, "colours is"),
        ({"colours": ((0.0, 0.0, 300.0),)}, "colours is"),
    ],
)
def test_a_drop_out_of_range_is_named(changes, words):
    with pytest.raises(InputError, match=words):
        Drop(name="thing", **changes)


def test_nothing_is_written_for_a_drop_that_cannot_be(ball_scene, tmp_path):
    scene = ball_scene()
    before = sorted(scene.root.rglob("*"))
    (tmp_path / "broken.glb").write_bytes(b"glTF?")
    good = Drop(name="good")
    for bad, words in (
        ([good, good], "good: is the name of another object"),
        ([good, Drop(name="x", preset="unobtainium")], "unobtainium"),
        ([good, Drop(name="x", shape="mesh", mesh=tmp_path / "broken.glb")], "broken.glb"),
    ):
        with pytest.raises(InputError, match=words):
            add_drops(scene, bad)
    assert sorted(scene.root.rglob("*")) == before


def test_the_demo_is_one_motion_rendered_in_two_ways():
    config = demo.load_config()
    usual, best = (demo.request(config, demo.Path("out"), best=best) for best in (False, True))
    assert usual.drops == best.drops == config.drops and len(config.drops) >= 2
    assert best.render.samples > usual.render.samples and best.render.motion_blur > usual.render.motion_blur
    # One bake serves both, so the documentation's clip is what everybody gets, finer.
    assert best.bake == usual.bake and best.video != usual.video
    assert usual.bake.fps >= 24 and 2.5 <= usual.bake.frames / usual.bake.fps <= 4.0
    assert len(config.drops) >= 3 and all(override.startswith("cup.") for override in config.overrides)
    assert usual.physics.overrides == config.overrides
