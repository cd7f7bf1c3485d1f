# SPDX-License-Identifier: MIT
"""A variant of a scene: other physics and effects, the same files, written once."""

import json

import pytest
from physgen.sim.app.reconstruct import Physics
from physgen.sim.app.scene_variant import make_variant
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.model import Effect
from physgen.sim.scene.scene_output import folder_kind

WIND = [{"name": "wind", "parameters": {"drag_per_mass": 0.1, "wind_x": 2, "wind_y": 0, "wind_z": 0}}]


def test_a_variant_has_its_own_physics_and_the_scenes_files(ball_scene, tmp_path):
    source = ball_scene(count=2, effects=(Effect(name="air_drag", parameters=(("drag_per_mass", 0.2),)),))
    before = (source.root / "scene.json").read_bytes()
    out = tmp_path / "variants" / "a"
    folder = make_variant(
        load_scene(source.root),
        out=out,
        effects=json.dumps(WIND),
        physics=Physics(presets=("hard",), spins=((0, 0, 3),), overrides=("ball1.density=77",)),
    )
    scene = load_scene(out).model
    assert scene == folder.model and [e.name for e in scene.effects] == ["wind"]
    assert [o.material.preset for o in scene.objects] == ["hard", "hard"]
    assert scene.objects[0].spin == (0, 0, 3) and scene.objects[1].material.density == 77
    assert (out / "meshes/ball1.glb").read_bytes() == (source.root / "meshes/ball1.glb").read_bytes()
    assert (source.root / "scene.json").read_bytes() == before
    times = {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()}
    physics = Physics(presets=("hard",), spins=((0, 0, 3),), overrides=("ball1.density=77",))
    make_variant(load_scene(source.root), out=out, physics=physics, effects=json.dumps(WIND))
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()} == times
    assert [
        e.name for e in make_variant(load_scene(source.root), out=tmp_path / "b", physics=Physics()).model.effects
    ] == ["air_drag"]
    assert (
        make_variant(load_scene(source.root), out=tmp_path / "b", effects="[]", physics=Physics()).model.effects == ()
    )
    # An attempt that was killed leaves files and no scene; a damaged file is put right.
    (out / "scene.json").unlink()
    (out / "photo.png").unlink()
    (out / "photo.png").write_bytes(b"half")
    make_variant(load_scene(source.root), out=out, physics=Physics())
    assert (out / "photo.png").read_bytes() == (source.root / "photo.png").read_bytes()


def test_a_folder_is_named_by_the_file_that_it_holds(tmp_path):
    assert folder_kind(tmp_path) is None and folder_kind(tmp_path / "missing") is None
    for name, kind in (("scene.json", "a scene"), ("compose.json", "a composition"), ("manifest.json", "a bake")):
        folder = tmp_path / name.removesuffix(".json")
        folder.mkdir()
        (folder / name).write_text("{}")
        assert folder_kind(folder) == kind
    # A composition is a scene as well: the more telling file counts.
    (tmp_path / "compose" / "scene.json").write_text("{}")
    assert folder_kind(tmp_path / "compose") == "a composition"
    assert folder_kind(tmp_path / "compose", ("reconstruct.json",)) is None


def test_invalid_variants_are_refused(ball_scene, tmp_path):
    root = ball_scene().root
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    edited, composed = ball_scene(name="edited").root, ball_scene(name="composed").root
    (edited / "reconstruct.json").write_text("{}")
    (composed / "compose.json").write_text("{}")
    for out, words in (
        (root, "is the scene itself"),
        (tmp_path / "mine", "holds other files"),
        (root / "photo.png", "is a file"),
        (edited, "is a reconstruction"),
        (composed, "is a composition"),
    ):
        with pytest.raises(InputError, match=words):
            make_variant(load_scene(root), out=out, physics=Physics())
    for text, words in (
        ("{", "not readable as JSON"),
        ("[" * 100_000, "not readable as JSON"),
        ("{}", "expected a list"),
        ('[{"name": "gusts"}]', "'gusts' is unknown"),
        ('[{"name": "wind", "parameters": {"wind_x": 1}}]', "missing"),
        ('[{"name": "buoyancy", "parameters": {"fraction": 0.1}, "objects": ["mug"]}]', "mug"),
    ):
        with pytest.raises(InputError, match=words):
            make_variant(load_scene(root), out=tmp_path / "b", effects=text, physics=Physics())
    assert not (tmp_path / "b").exists()
