# SPDX-License-Identifier: GPL-3.0-or-later
"""Corrections of a photo's scene: what is told becomes the command's arguments; only what depends on it is redone."""

import argparse
import dataclasses
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image

bpy = pytest.importorskip("bpy")
from physgen.batch.cli import build_parser
from physgen.batch.commands.flags import object_requests, reconstruct_options
from physgen.batch.commands.photo_commands import add_reconstruct
from physgen.physgen_addon.operators import reconstruct_ops
from physgen.physgen_addon.operators.photo_ops import (
    add_box,
    set_photo,
)
from physgen.physgen_addon.panels.photo_panel import draw_photo
from physgen.physgen_addon.panels.scene_panel import PHYSGEN_PT_correct
from physgen.physgen_addon.photo.photo_image import store_mask
from physgen.physgen_addon.photo.photo_maths import ellipse, extent
from physgen.physgen_addon.photo.photo_request import (
    arguments,
    found_mask,
    made_folder,
    object_name,
    scene_folder,
    take_camera,
)
from physgen.physgen_addon.props.body_props import PHYSGEN_PG_body
from physgen.physgen_addon.props.material_props import WITH_UNITS, PHYSGEN_PG_material, is_modified, shown_as
from physgen.physgen_addon.props.photo_props import PHYSGEN_PG_photo_box
from physgen.physgen_addon.scene_io import import_physics
from physgen.physgen_addon.scene_io.import_scene import import_scene
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.models.known_models import KNOWN
from physgen.sim.reconstruct.reconstruct_options import BACKS, SHAPES, UP_AXES
from physgen.sim.reconstruct.segmentation.object_masks import read_mask
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.meshes import load_object_mesh

from .checked_layout import CheckedLayout, Context

SIZE = (160, 120)
"""Pixels of the photo, the world's own; small, because it is reconstructed twice."""


pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def photo(world, tmp_path):
    """The world's photo, opened, with a box around the ball; the state of the scene."""
    path = tmp_path / "a ball.png"
    shutil.copy(world.folder.file("photo.png"), path)
    state = open_photo(path)
    x0, y0, x1, y1 = extent(truth(world))
    add_box(bpy.context.scene, (x0 - 8, y0 - 8, x1 + 8, y1 + 8), "ball")
    return state


def truth(world):
    return np.asarray(Image.open(world.folder.file("masks/ball.png"))) > 127


def open_photo(path):
    set_photo(bpy.context.scene, path)
    return bpy.context.scene.physgen_photo


def read(words):
    """What the command itself makes of its arguments."""
    parser = argparse.ArgumentParser()
    add_reconstruct(parser)
    options = parser.parse_args([*words, "--out", "scene"])
    return object_requests(options, Path("scene")), reconstruct_options(options)


def drawn():
    return ellipse(*SIZE, (50, 40, 100, 90))


# -- arguments --------------------------------------------------------------------------------------------------------


def test_unset_fields_give_no_options(photo):
    words = arguments(photo)
    assert words.count("--default-motion") == 1, "as `physgen run`, so that a first bake shows something"
    photo.default_motion = False
    words = arguments(photo)
    assert [word for word in words if word.startswith("--")] == ["--box", "--name"]


def test_the_command_understands_all_that_was_set(photo, tmp_path):
    for name in ("toy.glb", "depth.npy"):
        (tmp_path / name).write_bytes(b"x")
    ball = photo.boxes[0]
    ball.kind, ball.shape, ball.back, ball.thickness = "rubber ball", "inflated", "flat", 0.75
    cup = add_box(bpy.context.scene, (0, 0, 60, 60), "cup/1")
    cup.size_m, cup.mesh, cup.mesh_up = 0.1, str(tmp_path / "toy.glb"), "+y"
    store_mask(cup, drawn())
    photo.camera, photo.horizon, photo.roll = "HORIZON", -0.25, math.radians(-3)
    photo.use_fov, photo.fov = True, math.radians(65)
    photo.depth, photo.report, photo.segmenter = str(tmp_path / "depth.npy"), True, "none"
    objects, options = read(arguments(photo))
    first, second = objects
    assert (first.name, first.size_m, first.mesh, first.mesh_up) == ("cup_1", 0.1, tmp_path / "toy.glb", "+y")
    assert first.mask == tmp_path / "a ball_scene_masks" / "cup_1.png"
    assert (second.name, second.kind, second.shape, second.back) == ("ball", "rubber ball", "inflated", "flat")
    assert (second.thickness, second.mask, second.mesh) == (0.75, None, None)
    assert (options.horizon_y, options.pitch_deg, options.roll_deg) == (-0.25, None, pytest.approx(-3, abs=1e-5))
    assert options.fov_deg == pytest.approx(65, abs=1e-4)
    assert options.depth == tmp_path / "depth.npy" and options.report and options.segmenter == "none"


@pytest.mark.parametrize("end", [-1e9, -1e-9, 1e9])
def test_command_accepts_all_field_values(photo, end):
    photo.fov = photo.pitch = photo.horizon = photo.roll = end
    photo.use_fov = True
    for camera in ("PITCH", "HORIZON"):
        photo.camera = camera
        read(arguments(photo))


def test_models_are_those_that_the_command_line_knows(photo):
    for stage in ("segmenter", "depth_estimator", "inpainter"):
        names = [model.name for model in KNOWN if model.stage == stage]
        items = type(photo).bl_rna.properties[stage].enum_items.keys()
        assert names and list(items)[-len(names) :] == names
        for name in names:
            setattr(photo, stage, name)
            _, options = read(arguments(photo))
            assert getattr(options, stage) == name
        setattr(photo, stage, "none")
    photo.segmenter = "auto"
    assert not [word for word in arguments(photo) if word in ("--segmenter", "--inpainter", "--depth-estimator")]


def test_tilt_has_one_option(photo):
    photo.camera, photo.horizon, photo.pitch = "PITCH", 0.1, math.radians(30)
    _, options = read(arguments(photo))
    assert (options.horizon_y, options.pitch_deg) == (None, pytest.approx(30, abs=1e-4))
    photo.camera = "AUTO"
    assert not [word for word in arguments(photo) if word.startswith(("--pitch", "--horizon", "--roll"))]


def test_choices_are_those_of_the_reconstruction():
    for name, choices in (("shape", SHAPES), ("back", BACKS), ("mesh_up", UP_AXES)):
        items = PHYSGEN_PG_photo_box.bl_rna.properties[name].enum_items
        assert tuple(items.keys()) == choices and all(item.description for item in items)


@pytest.mark.parametrize("where, words", [("mesh", "box ball: Mesh"), ("depth", "Depth Map")])
def test_files_that_are_gone_are_told_at_once(photo, tmp_path, where, words):
    setattr(photo.boxes[0] if where == "mesh" else photo, where, str(tmp_path / "gone.glb"))
    with pytest.raises(InputError, match=f"{words}: there is no file"):
        arguments(photo)


# -- asking a model ---------------------------------------------------------------------------------------------------


def test_no_request_without_consent(photo, tmp_path):
    photo.ask_url, photo.ask_model = "https://host/v1", "seer"
    assert not photo.send_photo and "--ask=https://host/v1" not in arguments(photo, online=True)
    photo.send_photo = True
    assert arguments(photo, online=True)[-3:] == ["--ask=https://host/v1", "--model=seer", "--send-photo"]
    with pytest.raises(InputError, match="set to stay offline"):
        arguments(photo, online=False)
    # Consent is about an address.
    photo.ask_url = "http://127.0.0.1:11434"
    assert not photo.send_photo
    photo.send_photo = True
    assert "--send-photo" in arguments(photo, online=False)
    photo.ask_model = " "
    with pytest.raises(InputError, match="no model is named"):
        arguments(photo, online=True)


def test_consent_is_in_no_file(photo, tmp_path):
    photo.ask_url = "https://host/v1"
    photo.send_photo = True
    path = str(tmp_path / "shot.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    state = bpy.context.scene.physgen_photo
    assert state.ask_url == "https://host/v1" and not state.send_photo


# -- the whole way ----------------------------------------------------------------------------------------------------


def stages(folder):
    """Name of each file of a stage → what it holds."""
    return {path.name: path.read_bytes() for path in (folder / "stages").iterdir()}


def volume(folder):
    """Of the object, in cubes of the camera's height, which the scale does not change."""
    scene = load_scene(folder)
    mesh = load_object_mesh(scene, scene.model.objects[0])
    height = scene.model.camera.world_from_camera[2][3]
    return trimesh.Trimesh(mesh.vertices, mesh.faces).volume / height**3


class Said:
    """A terminal that remembers the events."""

    def __init__(self):
        self.events = []

    def __call__(self, event):
        self.events.append(event)

    def line(self, text):
        pass


def command_here(command, on_event, cancelled, **_):
    """In place of ``run_stage``: the command in this process; that it has one of its own is test_import_scene.py's."""
    options = build_parser().parse_args(command[command.index("batch.cli") + 1 :])
    said = Said()
    assert options.run(options, said, cancelled) == 0
    for event in said.events[:-1]:
        on_event(event)
    return said.events[-1]


@pytest.mark.long
def test_a_correction_repeats_only_what_depends_on_it(first_fill, photo, world, monkeypatch):
    """A mask and a horizon as told; then another back: nothing is cut out again, its mirror image is looked for.

    The material that was chosen before is the object's, also where undo has taken the choice back meanwhile.
    """
    scene, box = bpy.context.scene, photo.boxes[0]
    mask = truth(world)
    mask[:, : extent(mask)[0] + 6] = False
    store_mask(box, mask)
    box.size_m, box.shape = 0.1, "inflated"
    photo.camera, photo.horizon, photo.roll, photo.report = "HORIZON", -0.1, math.radians(4), True
    photo.use_fov, photo.fov = True, math.radians(47)
    assert made_folder(photo) is None
    monkeypatch.setattr(reconstruct_ops, "run_stage", command_here)
    assert bpy.ops.physgen.reconstruct() == {"FINISHED"}
    folder = made_folder(photo)
    assert folder == scene_folder(photo)
    assert object_name(photo, box) == "ball"
    assert (read_mask(found_mask(photo, box), *SIZE) == mask).all()
    assert photo.found_horizon == pytest.approx(-0.1, abs=1e-4)
    assert math.degrees(photo.found_roll) == pytest.approx(4, abs=1e-3)
    assert math.degrees(photo.found_fov) == pytest.approx(47, abs=1e-3)
    assert bpy.ops.physgen.open_photo_report.poll()
    first, deep = stages(folder), volume(folder)
    scene.physgen.photo_root.objects["ball"].physgen.velocity = (0.0, 1.0, 2.0)
    box.back, box.preset = "flat", "jelly"

    def undone_meanwhile(*given, **named):
        photo.boxes[0].preset = "auto"
        return command_here(*given, **named)

    monkeypatch.setattr(reconstruct_ops, "run_stage", undone_meanwhile)
    assert bpy.ops.physgen.reconstruct() == {"FINISHED"}
    assert scene.physgen.photo_root.objects["ball"].physgen.material.preset == "jelly"
    second = stages(folder)
    kept, new = first.keys() & second.keys(), second.keys() - first.keys()
    assert all(first[name] == second[name] for name in kept)
    assert {name.partition("-")[0] for name in new} == {"mesh", "gloss", "look"}
    assert {name.partition("-")[0] for name in first} == {name.partition("-")[0] for name in second}
    assert volume(folder) < 0.75 * deep
    item = scene.physgen.photo_root.objects["ball"]
    assert max(item.dimensions) == pytest.approx(0.1, rel=0.01)
    assert tuple(item.physgen.velocity) == (0, 1, 2)
    # Of another photo it is no scene.
    shutil.copy(photo.path, Path(photo.path).with_name("other.png"))
    state = open_photo(Path(photo.path).with_name("other.png"))
    state.output = str(folder)
    assert made_folder(state) is None and not state.has_found


def test_manual_changes_survive_a_new_reconstruction(world, tmp_path):
    scene, root = bpy.context.scene, tmp_path / "scene"
    shutil.copytree(world.folder.root, root)
    import_scene(scene, root)
    assert import_physics.find_edits(scene, root) == {}
    import_physics.remember_imported(scene, root)
    assert import_physics.find_edits(scene, root) == {}
    item = scene.physgen.photo_root.objects["ball"]
    body, world_state = item.physgen, scene.physgen.world
    body.material.preset = "jelly"
    body.velocity, body.own_surface, body.friction = (1.0, 2.0, 3.0), True, 0.7
    body.static_friction = 0.9
    ramp, pin = bpy.data.objects.new("ramp", None), bpy.data.objects.new("my pin", None)
    for own in (ramp, pin):
        scene.collection.objects.link(own)
    body.pins.add().box = pin
    push = body.pushes.add()
    push.frame, push.velocity = 40, (0.0, 0.5, 0.0)
    scene.gravity = (0.0, 0.0, -1.6)
    for name, target in (("wind", item), ("air_drag", ramp)):
        entry = world_state.effects.add()
        entry.effect = name
        entry.targets.add().item = target
    next(number for number in world_state.effects[0].parameters if number.name == "wind_x").value = 4.5
    changed = import_physics.find_edits(scene, root)
    assert import_physics.find_edits(scene, tmp_path) == {}
    folder = load_scene(root)
    again = dataclasses.replace(folder.model.objects[0], spin=(0.0, 0.0, 5.0), velocity=(9.0, 0.0, 0.0))
    save_scene(root, dataclasses.replace(folder.model, objects=(again,)))
    bpy.data.objects.remove(ramp)
    import_scene(scene, root)
    import_physics.remember_imported(scene, root)
    import_physics.restore_edits(scene, changed)
    item = scene.physgen.photo_root.objects["ball"]
    body = item.physgen
    assert body.material.preset == "jelly" and not is_modified(body.material)
    assert tuple(body.velocity) == (1, 2, 3) and tuple(body.spin) == (0, 0, 5)
    assert (body.friction, body.static_friction) == (pytest.approx(0.7), pytest.approx(0.9)) and body.own_surface
    assert [entry.box for entry in body.pins] == [pin]
    assert [(entry.frame, *entry.velocity) for entry in body.pushes] == [(40, 0, 0.5, 0)]
    assert scene.gravity[2] == pytest.approx(-1.6)
    # The other one's only object is gone.
    (entry,) = world_state.effects
    assert entry.effect == "wind" and [target.item for target in entry.targets] == [item]
    assert next(number.value for number in entry.parameters if number.name == "wind_x") == 4.5
    # It is still the artist's change after one more import.
    assert {what.partition("/")[0] for what in import_physics.find_edits(scene, root)} == {
        *("body:ball", "material:ball", "scene", "world"),
    }


def test_every_field_of_a_body_is_kept_or_belongs_to_the_import():
    kept = {name for names in import_physics.OF_BODY for name in names}
    others = {"rna_type", "name", "enabled", "source", "cache", "material", "speed", "pins", "pin_index", "original"}
    others |= {"pushes", "push_index"}  # Kept, as the pins are.
    # Ways to show and set the number or the choice that is kept.
    others |= {"surface", "own_wall", "waits", "holds_shape"}
    assert set(PHYSGEN_PG_body.bl_rna.properties.keys()) == kept | others
    kept = {name for names in import_physics.OF_MATERIAL for name in names}
    others = {"rna_type", "name", "preset", "likeness", "relaxes", "has_fibres", *map(shown_as, WITH_UNITS)}
    assert set(PHYSGEN_PG_material.bl_rna.properties.keys()) == kept | others


# -- panels -----------------------------------------------------------------------------------------------------------


def shown(area="VIEW_3D"):
    """What the photo's panel draws: texts, and names of what it sets."""
    layout = CheckedLayout()
    space = SimpleNamespace(type=area, image=bpy.context.scene.physgen_photo.image)
    draw_photo(layout, Context(space_data=space))
    return layout.words + layout.names


def test_the_panel_shows_what_can_be_told(photo, world):
    words = shown("IMAGE_EDITOR")
    assert {"kind", "shape", "back", "own_thickness", "mesh", "mask", "x0", "depth", "report", "ask_url"} <= set(words)
    assert "Reconstruct" in words and not {"mesh_up", "pitch", "horizon"} & set(words)
    photo.boxes[0].mesh, photo.camera = "//toy.glb", "HORIZON"
    assert {"mesh_up", "horizon", "roll"} <= set(shown())
    photo.ask_url = "https://host/v1"
    assert any("keep it" in word or "offline" in word for word in shown()) is not bpy.app.online_access
    folder = scene_folder(photo)
    shutil.copytree(world.folder.root, folder)
    (folder / "reconstruct.json").write_text("[1]")
    assert "Reconstruct" in shown()
    (folder / "reconstruct.json").write_text(f'{{"photo": "{photo.path}"}}')
    assert "Reconstruct Again" in shown()
    take_camera(photo, world.folder.model.camera)
    assert any("pitch 35°" in word for word in shown())
    photo.boxes.clear()
    assert "kind" not in shown()


def test_a_scene_that_was_made_can_be_corrected_in_the_viewport(photo):
    scene = bpy.context.scene
    assert not PHYSGEN_PT_correct.poll(bpy.context)
    scene.physgen.folder = "//somewhere"
    assert PHYSGEN_PT_correct.poll(bpy.context)
    scene.physgen_photo.image = None
    assert not PHYSGEN_PT_correct.poll(bpy.context)
