# SPDX-License-Identifier: MIT
"""Corrections of a scene: the overridden estimate changes, and only what depends on it is computed again."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from physgen.batch.cli import main
from physgen.sim.app.reconstruct import Physics, correct, reconstruct, set_physics
from physgen.sim.app.reconstruct_record import require_request
from physgen.sim.app.set_light import LightRequest, set_light
from physgen.sim.errors import InputError
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.scene_output import STAMP_FILE
from PIL import Image

BALL, CRATE = (30, 45, 85, 105), (110, 40, 165, 115)
QUICK = ReconstructOptions(mesh_vertices=800, pitch_deg=25.0, patch_radius=3, sun=False)


def draw_photo():
    """A red ball and a blue crate on sand."""
    rng = np.random.default_rng(3)
    image = np.full((150, 200, 3), (190.0, 175, 140)) + rng.normal(scale=4, size=(150, 200, 1))
    rows, columns = np.mgrid[:150, :200] + 0.5
    ball = (columns - 57) ** 2 + (rows - 75) ** 2 < 22**2
    crate = (np.abs(columns - 137) < 20) & (np.abs(rows - 78) < 28)
    image[ball] = np.array([200, 50, 40]) + rng.normal(scale=5, size=(int(ball.sum()), 3))
    image[crate] = np.array([40, 70, 170]) + rng.normal(scale=5, size=(int(crate.sum()), 3))
    return np.clip(image, 0, 255).astype(np.uint8), ball, crate


@pytest.fixture(scope="module", autouse=True)
def quick_backgrounds(without_trials):
    with without_trials():
        yield


@pytest.fixture(scope="module")
def reconstructed(tmp_path_factory):
    """A folder with a photo and its scene; to be copied."""
    folder = tmp_path_factory.mktemp("reconstructed")
    Image.fromarray(draw_photo()[0]).save(folder / "photo.png")
    requests = [
        ObjectRequest(box=BALL, name="left", size_m=0.1, shape="inflated"),
        ObjectRequest(box=CRATE, name="right", shape="inflated"),
    ]
    reconstruct(folder / "photo.png", requests, out=folder / "scene", options=QUICK)
    return folder


@pytest.fixture
def scene(reconstructed, tmp_path):
    """A scene that came from the photo beside it."""
    shutil.copytree(reconstructed, tmp_path, dirs_exist_ok=True)
    stamp = tmp_path / "scene" / STAMP_FILE
    assert require_request(load_scene(tmp_path / "scene")).photo == reconstructed / "photo.png"
    stamp.write_text(json.dumps(json.loads(stamp.read_text()) | {"photo": str(tmp_path / "photo.png")}))
    # The record was changed by another hand than PhysGen's, and the user agrees to it.
    require_request(load_scene(tmp_path / "scene"), lambda source, claims: True)
    return tmp_path / "scene"


def stages(scene):
    """Names of the kept stages, by stage."""
    found = {}
    for path in (scene / "stages").iterdir():
        found.setdefault(path.name.rpartition("-")[0], set()).add(path.name)
    return found


def changed(scene, before):
    after = stages(scene)
    return {stage for stage in before.keys() | after.keys() if before.get(stage) != after.get(stage)}


def corrected(scene, **changes):
    """Correct fields of the object ``left``; the stages that were computed again."""
    before, earlier = stages(scene), require_request(load_scene(scene))
    first = dataclasses.replace(earlier.objects[0], **changes)
    objects = [first, *earlier.objects[1:]]
    correct(load_scene(scene), earlier=earlier, objects=objects, options=earlier.options)
    return changed(scene, before)


@pytest.mark.long
def test_each_correction_repeats_what_depends_on_it_and_nothing_else(scene, tmp_path):
    assert corrected(scene, size_m=0.3) == set()
    assert load_scene(scene).model.objects[0].size_m == pytest.approx(0.3)
    # The mirror images that the ground may show are the body's.
    assert corrected(scene, back="flat") == {"mesh", "look", "gloss"}
    mask = draw_photo()[1].copy()
    mask[:60] = False
    Image.fromarray(mask.astype(np.uint8) * 255).save(tmp_path / "mask.png")
    # What is told of one outline leaves the other's body alone.
    again = corrected(scene, mask=tmp_path / "mask.png")
    assert {"background", "mesh", "shadows"} <= again
    assert (np.asarray(Image.open(scene / "masks" / "left.png")) > 0).sum() == mask.sum()
    before, earlier = stages(scene), require_request(load_scene(scene))
    correct(
        load_scene(scene),
        earlier=earlier,
        objects=earlier.objects,
        options=dataclasses.replace(earlier.options, pitch_deg=None, horizon_y=-0.2),
    )
    assert changed(scene, before) >= {"mesh", "shadows", "background"} and "segment" not in changed(scene, before)


@pytest.mark.long
def test_matter_motion_and_light_that_were_changed_since_stay(scene):
    set_physics(load_scene(scene), Physics(presets=("hard", "soft"), velocities=((1.0, 0.0, 2.0),)))
    set_light(load_scene(scene), request=LightRequest(sun_direction=(0.0, 0.3, 1.0), sun_strength=2.0))
    before = load_scene(scene).model
    corrected(scene, size_m=0.2)
    after = load_scene(scene).model
    assert [item.material for item in after.objects] == [item.material for item in before.objects]
    assert after.objects[0].velocity == (1.0, 0.0, 2.0)
    assert after.light == before.light
    # A thing that turns out to be another one is made of other matter; the other keeps its own.
    corrected(scene, kind="orange")
    after = load_scene(scene).model
    assert after.objects[0].material != before.objects[0].material
    assert after.objects[1].material == before.objects[1].material


@pytest.mark.long
def test_on_the_command_line(scene, capsys):
    assert main(["correct", str(scene), "--size", "right=0.5", "--kind", "left=orange", "--report", "--json"]) == 0
    sizes = [item.size_m for item in load_scene(scene).model.objects]
    assert sizes[1] == pytest.approx(0.5, rel=0.6)
    page = (scene / "report.html").read_text(encoding="utf-8")
    assert "orange" in page and page.count("data:image/jpeg;base64,") >= 8
    assert "<script" not in page and "http" not in page.replace("http-equiv", "")
    capsys.readouterr()
    assert main(["correct", str(scene), "--size", "middle=0.5"]) == 3
    assert "left, right" in capsys.readouterr().err


def test_a_scene_that_cannot_say_where_it_comes_from_is_refused(scene, tmp_path):
    (tmp_path / "photo.png").rename(tmp_path / "gone.png")
    earlier = require_request(load_scene(scene))
    with pytest.raises(InputError, match="no longer there"):
        correct(load_scene(scene), earlier=earlier, objects=earlier.objects, options=earlier.options)
    for garbage in ("{}", "[1]", "nonsense", json.dumps({"inputs_hash": "x", "photo": 3})):
        (scene / STAMP_FILE).write_text(garbage, encoding="utf-8")
        with pytest.raises(InputError, match=STAMP_FILE):
            require_request(load_scene(scene))
