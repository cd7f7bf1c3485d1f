# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene folder in Blender: the same picture through the camera, the same vertices, the same physics; or no change."""

import dataclasses
import io
import json
import math
import shutil
from pathlib import PurePosixPath
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

bpy = pytest.importorskip("bpy")
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
from physgen.physgen_addon.operators.photo_ops import (
    add_box,
    set_photo,
)
from physgen.physgen_addon.operators.reconstruct_ops import PHYSGEN_OT_reconstruct
from physgen.physgen_addon.photo.photo_image import load_photo_image
from physgen.physgen_addon.photo.photo_request import arguments, scene_folder
from physgen.physgen_addon.props.material_props import get_material
from physgen.physgen_addon.render import look_nodes
from physgen.physgen_addon.scene_io import import_scene as bridge
from physgen.physgen_addon.scene_io import photo_view
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.sim.errors import InputError
from physgen.sim.scene.folder import Scene, load_scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.meshes import load_object_mesh
from physgen.sim.scene.model import Box, Contact, Effect, Ground, Key, Motion

KINDS = ("objects", "meshes", "materials", "images", "lights", "cameras", "worlds", "collections", "actions")


pytestmark = pytest.mark.usefixtures("addon")


@pytest.fixture
def copy(world, tmp_path):
    """A copy of the world's folder that a test may damage, in a folder whose name is not plain."""
    root = tmp_path / "scène 1"
    shutil.copytree(world.folder.root, root)
    return load_scene(root)


def changed(folder: Scene, *, scene=None, **item) -> Scene:
    """``folder`` with other fields of its object and of the scene."""
    body = dataclasses.replace(folder.model.objects[0], **item)
    return save_scene(folder.root, dataclasses.replace(folder.model, objects=(body,), **(scene or {})))


def census():
    return {kind: sorted(item.name for item in getattr(bpy.data, kind)) for kind in KINDS}


def world_vertices(item):
    local = np.empty(3 * len(item.data.vertices), dtype=np.float32)
    item.data.vertices.foreach_get("co", local)
    matrix = np.array(item.matrix_world, dtype=np.float64)
    return local.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def test_the_camera_sees_what_the_photo_shows(copy):
    scene = bpy.context.scene
    bridge.import_scene(scene, copy.root)
    bpy.context.view_layer.update()
    camera = copy.model.camera
    assert (scene.render.resolution_x, scene.render.resolution_y) == (camera.width, camera.height)
    points = load_object_mesh(copy, copy.model.objects[0]).vertices[::97]
    seen = np.array([world_to_camera_view(scene, scene.camera, Vector(point)) for point in points])
    pixels = np.column_stack([seen[:, 0] * camera.width, (1 - seen[:, 1]) * camera.height])
    assert np.abs(pixels - camera.project(points)[:, :2]).max() < 0.01


def test_vertices_keep_their_order_and_place_and_the_origin_is_the_centre_of_mass(copy):
    copy = changed(copy, world_from_mesh=((0, 0.0, 2, 0.3), (2, 0.0, 0, -7), (0, 2.0, 0, 5), (0, 0, 0, 1.0)))
    item = bridge.import_scene(bpy.context.scene, copy.root).objects["ball"]
    bpy.context.view_layer.update()
    mesh = load_object_mesh(copy, copy.model.objects[0])
    assert np.abs(world_vertices(item) - mesh.vertices).max() < 1e-6
    corners = [list(face.vertices) for face in item.data.polygons[:50]]
    assert corners == mesh.faces[:50].tolist()
    assert np.allclose(item.matrix_world.translation, mesh.vertices.mean(axis=0), atol=1e-3)
    assert tuple(item.scale) == (1, 1, 1)


def test_a_mirroring_place_keeps_the_outside_outside(copy):
    copy = changed(copy, world_from_mesh=((-1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0)))
    item = bridge.import_scene(bpy.context.scene, copy.root).objects["ball"]
    outward = [face.normal.dot(face.center) for face in item.data.polygons]
    assert min(outward) > 0


def test_the_texture_is_packed_and_laid_as_the_file_says(copy):
    item = bridge.import_scene(bpy.context.scene, copy.root).objects["ball"]
    assert all(image.packed_file is not None for image in bpy.data.images)
    texture = item.data.materials[0].node_tree.nodes.active.image
    assert tuple(texture.size) == (copy.model.camera.width, copy.model.camera.height)
    # The fixture's texture is the photo as the camera sees it: UVs are the vertices' own pixels.
    pixels = copy.model.camera.project(load_object_mesh(copy, copy.model.objects[0]).vertices)
    uv = np.empty(2 * len(item.data.loops), dtype=np.float32)
    item.data.uv_layers["photo"].data.foreach_get("uv", uv)
    corner = np.empty(len(item.data.loops), dtype=np.int32)
    item.data.loops.foreach_get("vertex_index", corner)
    expected = pixels[corner, :2] / (texture.size[0], texture.size[1])
    assert np.abs(uv.reshape(-1, 2) - np.column_stack([expected[:, 0], 1 - expected[:, 1]])).max() < 1e-5


def colours_of(item):
    """Which picture the camera sees on an imported object, and which the light."""
    nodes = {node.label: node for node in item.data.materials[0].node_tree.nodes}
    return tuple(nodes[f"Seen by the {who}"].inputs["Color"].links[0].from_node.image for who in ("camera", "light"))


def test_light_meets_the_albedo_where_there_is_one(copy):
    photo, lit = colours_of(bridge.import_scene(bpy.context.scene, copy.root).objects["ball"])
    assert lit == photo
    (copy.root / "albedo").mkdir()
    Image.new("RGB", (copy.model.camera.width, copy.model.camera.height), (200, 100, 50)).save(
        copy.root / "albedo" / f"{PurePosixPath(copy.model.objects[0].mesh).stem}.png"
    )
    item = bridge.import_scene(bpy.context.scene, copy.root).objects["ball"]
    photo, lit = colours_of(item)
    assert item.data.materials[0].node_tree.nodes.active.image == photo != lit
    assert lit.packed_file is not None and lit.colorspace_settings.name == "sRGB"
    values = np.empty(4 * lit.size[0] * lit.size[1], dtype=np.float32)
    lit.pixels.foreach_get(values)
    assert values[:3] * 255 == pytest.approx([200, 100, 50], abs=0.6)


def test_a_damaged_albedo_is_named_and_nothing_is_left(copy):
    before = census()
    (copy.root / "albedo").mkdir()
    path = copy.root / "albedo" / f"{PurePosixPath(copy.model.objects[0].mesh).stem}.png"
    path.write_bytes(b"no picture")
    with pytest.raises(InputError, match="albedo"):
        bridge.import_scene(bpy.context.scene, copy.root)
    assert census() == before


def test_cycles_renders_the_photo_again(copy, world, tmp_path):
    from physgen.physgen_addon import compat

    compat.enable_cycles()
    scene = bpy.context.scene
    bridge.import_scene(scene, copy.root)
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", 16, False
    # Without the plate behind the objects.
    scene.render.use_compositing, scene.render.filepath = False, str(tmp_path / "seen.png")
    scene.render.image_settings.file_format = "PNG"
    bpy.ops.render.render(write_still=True)
    seen = np.asarray(Image.open(tmp_path / "seen.png").convert("RGBA")).astype(float)
    inside = np.asarray(Image.open(copy.file(copy.model.objects[0].mask))) > 127
    core = inside & (seen[..., 3] == 255)
    assert core.sum() > 0.9 * inside.sum()
    # Between the pixels' centres colours are interpolated, so a few grey values of noise in the photo average out.
    assert np.abs(seen[..., :3] - world.photo)[core].mean() < 3
    # Outside there is only the shadow, over nothing.
    assert seen[..., :3][~inside].max() < 60 or seen[..., 3][~inside].max() < 255


def test_background_world_sun_and_ground(copy):
    scene = bpy.context.scene
    mine = scene.world = bpy.data.worlds.new("mine")
    collection = bridge.import_scene(scene, copy.root)
    pictures = scene.camera.data.background_images
    assert [p.image.name for p in pictures] == ["background.png", "photo.png"]
    assert [(p.display_depth, p.show_background_image) for p in pictures] == [("BACK", True), ("FRONT", False)]
    assert scene.camera.data.show_background_images and scene.render.film_transparent
    assert scene.view_settings.view_transform == "Standard"
    sun = next(item for item in collection.objects if item.type == "LIGHT")
    toward = sun.matrix_world.to_3x3() @ Vector((0, 0, 1))
    assert np.allclose(toward, copy.model.light.sun_direction, atol=1e-5)
    # White all round lights open ground with π; the sun's share is of that, on ground that it meets at an angle.
    assert sun.data.energy == pytest.approx(1.5 * math.pi / copy.model.light.sun_direction[2], rel=1e-5)
    ground = scene.physgen.world.ground_object
    assert ground.is_shadow_catcher
    assert ground.matrix_world.translation.z == pytest.approx(0, abs=1e-7)
    assert scene.world != mine and mine.use_fake_user


def test_a_tilted_ground(copy):
    normal = (0.0, math.sin(0.2), math.cos(0.2))
    copy = changed(copy, scene={"ground": Ground(point=(0.0, 0.0, -0.1), normal=normal)})
    bridge.import_scene(bpy.context.scene, copy.root)
    ground = bpy.context.scene.physgen.world.ground_object
    assert np.allclose(ground.matrix_world.to_3x3() @ Vector((0, 0, 1)), normal, atol=1e-6)
    assert np.dot(np.array(ground.matrix_world.translation) - (0, 0, -0.1), normal) == pytest.approx(0, abs=1e-6)
    assert tuple(bpy.context.scene.physgen.world.ground_normal) == pytest.approx(normal)


def test_physics_become_fields(copy):
    material = dataclasses.replace(load_preset("jelly"), density=700.0)
    copy = changed(
        copy,
        material=material,
        velocity=(0.1, 0.2, 0.3),
        spin=(1.0, 0.0, -2.0),
        start_time=0.5,
        roughness=0.5,
        fill=False,
        shell_thickness=0.01,
        pins=(Box(low=(-0.1, 0.0, 0.2), high=(0.1, 0.4, 0.3)),),
        pin_motion=(Key(time_s=0.0, value=(0.0, 0.0, 0.0)), Key(time_s=1.0, value=(0.0, 0.0, 0.5))),
        goal_stiffness=3.0,
        scene={
            "gravity": (0.0, 1.0, -3.0),
            "ground": Ground(friction=0.7, static_friction=0.9, restitution=0.2),
            "effects": (
                Effect(name="wind", parameters=(("wind_x", 3.0),), objects=("ball",)),
                Effect(name="air_drag"),
                Effect(name="time_scale"),
            ),
            "contacts": (Contact(between=("ball", "ground"), friction=0.1),),
            "gravity_track": (Key(time_s=0.0, value=(0.0, 0.0, -1.0)),),
        },
    )
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = 30, 1.0
    collection = bridge.import_scene(scene, copy.root)
    item = collection.objects["ball"]
    body = item.physgen
    assert (body.enabled, body.source, body.role, body.fill) == (True, "ball", "dynamic", False)
    assert get_material(body.material) == dataclasses.replace(material, preset="custom")
    assert tuple(body.velocity) == pytest.approx((0.1, 0.2, 0.3)) and tuple(body.spin) == (1, 0, -2)
    assert body.start_frame == scene.physgen.simulation.frame_start + 15
    assert body.own_surface and body.friction == pytest.approx(0.5) and body.static_friction == pytest.approx(0.5)
    assert body.restitution == pytest.approx(0.2) and body.goal_stiffness == 3
    pin = body.pins[0].box
    assert tuple(pin.location) == pytest.approx((0, 0.2, 0.25)) and tuple(pin.scale) == pytest.approx((0.1, 0.2, 0.05))
    scene.frame_set(scene.physgen.simulation.frame_start + 15)
    assert pin.location.z == pytest.approx(0.25 + 0.25)
    assert tuple(scene.gravity) == (0, 1, -3)
    world = scene.physgen.world
    assert (world.friction, world.static_friction) == (pytest.approx(0.7), pytest.approx(0.9))
    wind, drag = world.effects
    assert (wind.effect, drag.effect) == ("wind", "air_drag")
    assert next(p.value for p in wind.parameters if p.name == "wind_x") == 3
    assert [target.item for target in wind.targets] == [item] and not drag.targets
    assert scene.physgen.folder.endswith("scène 1") and scene.physgen.photo_root == collection
    notes = " ".join(bridge.import_notes(collection))
    assert "time_scale" in notes and "ball and ground" in notes and "gravity changes" in notes


def test_a_preset_that_was_not_changed_keeps_its_name(copy):
    copy = changed(copy, material=load_preset("honey"))
    body = bridge.import_scene(bpy.context.scene, copy.root).objects["ball"].physgen
    assert body.material.preset == "honey" and not body.own_surface


def test_a_moving_collider_is_animated(copy):
    turn = (Key(time_s=0.0, value=(0.0, 0.0, 0.0)), Key(time_s=1.0, value=(0.0, 0.0, math.pi / 2)))
    shift = (Key(time_s=0.0, value=(0.0, 0.0, 0.0)), Key(time_s=1.0, value=(0.0, 0.0, 1.0)))
    copy = changed(copy, role="collider", motion=Motion(rotations=turn, translations=shift, pivot=(0.0, 0.0, 0.0)))
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = 20, 1.0
    item = bridge.import_scene(scene, copy.root).objects["ball"]
    first = scene.physgen.simulation.frame_start
    rest = load_object_mesh(copy, copy.model.objects[0]).vertices
    for share in (0.0, 0.35, 0.5, 1.0):
        frame = first + 20 * share
        scene.frame_set(int(frame), subframe=frame - int(frame))
        angle = share * math.pi / 2
        c, s = math.cos(angle), math.sin(angle)
        expected = rest @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + (0, 0, share)
        assert np.abs(world_vertices(item) - expected).max() < 1e-5


def test_importing_again_replaces_and_keeps_what_people_added(copy):
    scene = bpy.context.scene
    first = bridge.import_scene(scene, copy.root)
    before = census()
    own = bpy.data.objects.new("my ramp", None)
    first.objects.link(own)
    bridge.import_scene(scene, copy.root)
    assert own.name in scene.collection.objects
    bpy.data.objects.remove(own)
    after = census()
    assert [len(after[kind]) for kind in KINDS] == [len(before[kind]) for kind in KINDS]
    assert after["objects"] == before["objects"] and after["collections"] != []
    assert (scene.camera.name, scene.world.name) == ("photo camera", "environment")


def test_two_scenes_of_one_file_do_not_disturb_each_other(copy):
    one, two = bpy.context.scene, bpy.data.scenes.new("two")
    first = bridge.import_scene(one, copy.root)
    bridge.import_scene(two, copy.root)
    bridge.import_scene(two, copy.root)
    assert len(one.objects) == len(two.objects) == len(first.objects)
    assert one.world is not None and one.world != two.world and one.camera != two.camera


def damage_glb(folder):
    path = folder.file(folder.model.objects[0].mesh)
    path.write_bytes(path.read_bytes()[:-2000])


def damage_texture(folder):
    path = folder.file(folder.model.objects[0].mesh)
    content = path.read_bytes()
    start = content.index(b"\x89PNG")
    path.write_bytes(content[: start + 4] + bytes(60) + content[start + 64 :])


def claim(path, side=60_000):
    """Let the PNG in the file ``path`` say that it is of ``side`` pixels a side: Blender would take 14 GB for it."""
    content = path.read_bytes()
    start = content.index(b"IHDR") + 4
    path.write_bytes(content[:start] + 2 * side.to_bytes(4, "big") + content[start + 8 :])


def newer(folder):
    path = folder.root / "scene.json"
    path.write_text(path.read_text().replace("physgen-scene/1", "physgen-scene/9"))


DAMAGES = {
    "cut off": (damage_glb, "ball.glb: not a readable mesh"),
    "picture in the mesh": (damage_texture, "picture"),
    "photo": (
        lambda folder: folder.file("photo.png").write_bytes(b"no picture"),
        "photo.png: is not a readable picture",
    ),
    "photo of 3,600 million pixels": (
        lambda folder: claim(folder.file("photo.png")),
        "photo.png: claims 60000x60000 pixels",
    ),
    "background of as many": (lambda folder: claim(folder.file("background.png")), "claims 60000x60000 pixels"),
    "texture of as many": (
        lambda folder: claim(folder.file(folder.model.objects[0].mesh)),
        r"the picture in meshes/ball\.glb: claims 60000x60000 pixels",
    ),
    "missing": (lambda folder: folder.file("background.png").unlink(), "background.png"),
    "newer": (newer, "update PhysGen"),
    "no scene": (lambda folder: (folder.root / "scene.json").unlink(), "there is no scene.json in it"),
    "nothing": (lambda folder: shutil.rmtree(folder.root), "no such file or folder"),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_a_folder_that_cannot_be_read_changes_nothing(copy, what):
    scene = bpy.context.scene
    damage, words = DAMAGES[what]
    damage(copy)
    before = census(), scene.camera, scene.world, tuple(scene.gravity), scene.render.resolution_x
    with pytest.raises(InputError, match=words):
        bridge.import_scene(scene, copy.root)
    assert (census(), scene.camera, scene.world, tuple(scene.gravity), scene.render.resolution_x) == before
    assert scene.physgen.photo_root is None and scene.physgen.folder == ""


@pytest.mark.parametrize("name, parameters", [("telekinesis", ()), ("wind", (("strength", 3.0),))])
def test_an_effect_nobody_knows_is_refused(copy, name, parameters):
    copy = changed(copy, scene={"effects": (Effect(name=name, parameters=parameters),)})
    with pytest.raises(InputError, match=name):
        bridge.import_scene(bpy.context.scene, copy.root)


def test_the_operator_takes_the_file_the_folder_and_nothing_else(copy, tmp_path):
    scene = bpy.context.scene
    cube = bpy.data.objects.new("Cube", bpy.data.meshes.new("Cube"))
    scene.collection.objects.link(cube)
    assert bpy.ops.physgen.import_scene(filepath=str(copy.root / "scene.json")) == {"FINISHED"}
    # It would stand in the picture; what is added later is part of it.
    assert cube.hide_viewport and cube.hide_render
    assert bpy.context.view_layer.objects.active.physgen.enabled
    cube.hide_viewport = cube.hide_render = False
    assert bpy.ops.physgen.import_scene(filepath=str(copy.root)) == {"FINISHED"}
    assert not cube.hide_viewport
    other = tmp_path / "package.json"
    other.write_text(json.dumps({"name": "something"}))
    with pytest.raises(RuntimeError, match="is no scene; choose"):
        bpy.ops.physgen.import_scene(filepath=str(other))
    with pytest.raises(RuntimeError, match="choose the file"):
        bpy.ops.physgen.import_scene()


def test_the_folder_is_kept_relative_to_a_saved_file(copy):
    bpy.ops.wm.save_as_mainfile(filepath=str(copy.root.parent / "shot.blend"))
    bridge.import_scene(bpy.context.scene, copy.root)
    assert bpy.context.scene.physgen.folder == "//scène 1"


@pytest.mark.parametrize("turn", range(1, 9))
def test_photos_stand_upright_as_the_reconstruction_has_them(tmp_path, turn):
    from PIL import ImageOps

    pixels = np.zeros((40, 60, 3), dtype=np.uint8)
    pixels[:20, :30], pixels[:20, 30:], pixels[20:, :30] = (250, 10, 10), (10, 250, 10), (10, 10, 250)
    stored = io.BytesIO()
    exif = Image.Exif()
    exif[0x0112] = turn
    Image.fromarray(pixels).save(stored, "JPEG", quality=95, exif=exif)
    path = tmp_path / "photo.jpg"
    path.write_bytes(stored.getvalue())
    upright = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB"))
    image, size = load_photo_image(path)
    assert size == (upright.shape[1], upright.shape[0]) == tuple(image.size)
    values = np.empty(image.size[0] * image.size[1] * image.channels, dtype=np.float32)
    image.pixels.foreach_get(values)
    shown = values.reshape(image.size[1], image.size[0], image.channels)[::-1, :, :3] * 255
    assert np.abs(shown - upright).mean() < 2


def test_boxes_become_the_commands_arguments(world, tmp_path):
    photo = tmp_path / "coffee cup.png"
    shutil.copy(world.folder.file("photo.png"), photo)
    scene = bpy.context.scene
    assert bpy.ops.physgen.open_photo(filepath=str(photo)) == {"FINISHED"}
    state = scene.physgen_photo
    assert not bpy.ops.physgen.reconstruct.poll()
    add_box(scene, (70, 80, -5, 20), "cup/1")
    add_box(scene, (80, 20, 9000, 9000), "cup/1")
    state.boxes[1].size_m = 0.2
    box = state.boxes[0]
    assert (box.x0, box.y0, box.x1, box.y1) == (0, 20, 70, 80)
    state.camera, state.pitch = "PITCH", math.radians(40)
    found = arguments(state)
    assert found == [
        *(str(photo), "--box", f"80,20,{state.width},{state.height}", "0,20,70,80"),
        *("--name", "cup_1", "cup_1_2", "--size", "0.2", "--pitch=40", "--default-motion"),
    ]
    assert scene_folder(state) == tmp_path / "coffee cup_scene"
    box.x1 = 3
    with pytest.raises(InputError, match="draw it larger"):
        arguments(state)
    assert bpy.ops.physgen.remove_box() == {"FINISHED"}
    assert [b.x0 for b in state.boxes] == [0]
    set_photo(scene, photo)
    assert len(state.boxes) == 1
    other = tmp_path / "other.png"
    shutil.copy(photo, other)
    set_photo(scene, other)
    assert not state.boxes


def test_other_files_than_photos_are_refused(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "large.png")
    claim(tmp_path / "large.png")
    large = (tmp_path / "large.png").read_bytes()
    for name, content, words in (
        ("a.png", b"nothing", "not a readable"),
        ("large.png", large, "claims 60000x60000"),
        ("a.txt", b"x", "is no photo"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(RuntimeError, match=words):
            bpy.ops.physgen.open_photo(filepath=str(tmp_path / name))
    with pytest.raises(RuntimeError, match="there is no such photo"):
        bpy.ops.physgen.open_photo(filepath=str(tmp_path / "b.png"))
    with pytest.raises(RuntimeError, match="is a folder; choose a photo in it"):
        bpy.ops.physgen.open_photo(filepath=str(tmp_path))
    assert not bpy.data.images


@pytest.mark.long
def test_a_photo_becomes_a_scene_in_the_worker(world, tmp_path):
    """The whole way, blocking as a script has it: boxes, child process, import."""
    photo = tmp_path / "ball.png"
    Image.open(world.folder.file("photo.png")).save(photo)
    scene = bpy.context.scene
    set_photo(scene, photo)
    rows, columns = np.nonzero(np.asarray(Image.open(world.folder.file("masks/ball.png"))))
    corners = (columns.min() - 4, rows.min() - 4, columns.max() + 5, rows.max() + 5)
    add_box(scene, tuple(map(int, corners)), "ball").size_m = 0.1
    assert bpy.ops.physgen.reconstruct() == {"FINISHED"}
    item = scene.physgen.photo_root.objects["ball"]
    assert max(item.dimensions) == pytest.approx(0.1, rel=0.01)
    assert load_scene(tmp_path / "ball_scene").model.objects[0].name == item.physgen.source
    assert (scene.render.resolution_x, scene.render.resolution_y) == (160, 120)


@pytest.mark.skipif(not look_nodes.available(), reason="compositor node groups are Blender 5.0's")
def test_blenders_own_render_has_the_plate_behind_the_objects(copy, tmp_path):
    """F12, at half the size: the plate, the ball before it; a compositor of one's own is left alone."""
    scene = bpy.context.scene
    for _ in range(2):
        bridge.import_scene(scene, copy.root)
    scene.render.engine, scene.cycles.samples = "CYCLES", 4
    scene.render.resolution_percentage, scene.render.dither_intensity = 50, 0.0
    scene.render.image_settings.file_format, scene.render.filepath = "PNG", str(tmp_path / "out.png")
    bpy.ops.render.render(write_still=True)
    seen = np.asarray(Image.open(tmp_path / "out.png").convert("RGB")).astype(float)
    plate, photo = (
        np.asarray(Image.open(copy.file(name)).convert("RGB").resize((80, 60), Image.Resampling.BOX)).astype(float)
        for name in copy.model.photo_files[::-1]
    )
    ball = np.asarray(Image.open(copy.file("masks/ball.png")).resize((80, 60), Image.Resampling.BOX))
    # The ground's far corners have neither shadow nor ball.
    for corner in (np.s_[:12, :12], np.s_[:12, -12:]):
        assert np.abs(seen[corner] - plate[corner]).mean() < 4
    assert np.abs(seen - photo)[ball == 255].mean() < 0.25 * np.abs(plate - photo)[ball == 255].mean()
    assert len([tree for tree in bpy.data.node_groups if tree.name.startswith(photo_view.PLATE_TREE)]) == 1
    own = bpy.data.node_groups.new("mine", "CompositorNodeTree")
    scene.compositing_node_group = own
    bridge.import_scene(scene, copy.root)
    assert scene.compositing_node_group == own and not own.nodes


def test_a_reconstructed_motion_starts_at_the_frames_of_its_own_slow_motion(copy):
    """Twice slower, 0.5 s after the beginning is frame 25 of 24 a second, also at the first reconstruction."""
    scene = bpy.context.scene
    changed(copy, start_time=0.5, velocity=(0.0, 0.0, 1.0))
    set_photo(scene, copy.file("photo.png"))
    assert scene.physgen.simulation.slow == 1.0
    final = {"scene": str(copy.root), "materials": {}, "clip": {"frames": 108, "slow": 2.0}}
    words = PHYSGEN_OT_reconstruct.finished(SimpleNamespace(), scene, final)
    body = scene.physgen.photo_root.objects["ball"].physgen
    assert (body.start_frame, scene.physgen.simulation.frame_end) == (25, 108)
    assert words.startswith("1 object imported")


def test_every_push_of_a_motion_comes_to_blender_and_goes_back_as_it_was(copy, tmp_path):
    """Of the default motion only the first push of an object came, and what was baked was another clip."""
    keys = (Key(time_s=1.0, value=(0.1, 0.0, 0.0)), Key(time_s=1.75, value=(0.0, 0.0, 2.5)))
    folder = changed(copy, velocity=(0.0, 0.0, 1.0), start_time=0.25, velocity_keys=keys)
    scene = bpy.context.scene
    scene.physgen.simulation.frame_end, scene.physgen.simulation.slow = 150, 2.0
    collection = bridge.import_scene(scene, folder.root)
    body = collection.objects["ball"].physgen
    assert body.start_frame == 13 and [push.frame for push in body.pushes] == [49, 85]
    assert tuple(body.pushes[1].velocity) == (0, 0, 2.5) and "push" not in " ".join(bridge.import_notes(collection))
    back = next(item for item in export_scene(scene, tmp_path / "back").model.objects if item.name == "ball")
    assert (back.velocity, back.start_time, back.velocity_keys) == ((0.0, 0.0, 1.0), 0.25, keys)


def test_pushes_at_one_frame_are_the_last_of_them_and_one_at_the_start_is_the_velocity(copy):
    times = ((0.0, (1.0, 0.0, 0.0)), (0.5, (2.0, 0.0, 0.0)), (1.0, (3.0, 0.0, 0.0)), (1.001, (4.0, 0.0, 0.0)))
    keys = tuple(Key(time_s=time, value=value) for time, value in times)
    folder = changed(copy, velocity=(0.0, 0.0, 1.0), start_time=0.5, velocity_keys=keys)
    body = bridge.import_scene(bpy.context.scene, folder.root).objects["ball"].physgen
    assert tuple(body.velocity) == (2, 0, 0)
    assert [(push.frame, *push.velocity) for push in body.pushes] == [(25, 4, 0, 0)]


def test_an_output_folder_of_physgen3d_becomes_a_scene_in_the_worker(world, tmp_path):
    root = tmp_path / "teddy"
    (root / "meshes").mkdir(parents=True)
    Image.open(world.folder.file("photo.png")).save(root / "raw_image.jpg")
    import trimesh

    trimesh.creation.box((0.2, 0.2, 0.2)).export(root / "meshes" / "teddy1.obj")
    place = np.eye(4)
    place[:3, 3] = (0, 0.3, 1.0)
    told = {
        "matrices": [place.tolist()],
        "plane_model": [0, -1, 0, 0.4],
        "fov": [-0.4, -0.3, 0.4, 0.3],
        "object_names": ["teddy1"],
    }
    (root / "transform.json").write_text(json.dumps(told))
    assert bpy.ops.physgen.import_physgen3d(directory=str(root), size_m=0.5) == {"FINISHED"}
    item = bpy.context.scene.physgen.photo_root.objects["teddy1"]
    bpy.context.view_layer.update()
    assert tuple(item.dimensions) == pytest.approx((0.5, 0.5, 0.5), rel=1e-5)
    assert world_vertices(item)[:, 2].min() == pytest.approx(0, abs=1e-6)
    with pytest.raises(RuntimeError, match=r"contains no transform\.json"):
        bpy.ops.physgen.import_physgen3d(directory=str(tmp_path))
