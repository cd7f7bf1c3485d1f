# SPDX-License-Identifier: GPL-3.0-or-later
"""Splat objects in Blender: imported, seen as they are, baked with the real worker, played without the add-on."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

bpy = pytest.importorskip("bpy")
import physgen
from physgen.physgen_addon import compat
from physgen.physgen_addon.playback import bake_record, point_caches, show_bake, splat_clouds
from physgen.physgen_addon.scene_io import import_scene as import_splats
from physgen.physgen_addon.scene_io.export_scene import export_scene
from physgen.physgen_addon.scene_io.import_scene import import_scene, remove_import
from physgen.physgen_addon.scene_io.motion_fingerprint import fingerprint
from physgen.sim.errors import InputError
from physgen.sim.gaussians.splat_ply import (
    read_splats,
    write_splats,
)
from physgen.sim.gaussians.splats import (
    Splats,
    half_axes,
    transform_splats,
)
from physgen.sim.scene.folder import load_scene, save_scene
from physgen.sim.scene.model import Camera, SceneModel, SceneObject

LOOKING_AWAY = ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0), (0.0, -1.0, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0))
TURNED = ((0.0, -2.0, 0.0, 0.1), (2.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0, 0.25), (0.0, 0.0, 0.0, 1.0))
COUNT = 300


pytestmark = pytest.mark.usefixtures("addon")


def some(count=COUNT, radius=0.05):
    random = np.random.default_rng(0)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Splats(
        centres=radius * directions,
        scales=random.uniform(2e-3, 8e-3, (count, 3)),
        rotations=random.normal(size=(count, 4)),
        opacities=random.uniform(0.2, 0.95, count),
        colours=random.uniform(0, 1, (count, 3)),
    )


@pytest.fixture
def a_folder(tmp_path):
    """A scene folder with one ball of splats, without a photo, that is twice as large as its files and turned."""
    root = tmp_path / "scene"
    (root / "meshes").mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=3, radius=0.05).export(root / "meshes/ball.glb")
    write_splats(root / "splats/ball.ply", some())
    item = SceneObject(
        name="ball", mesh="meshes/ball.glb", splats="splats/ball.ply", world_from_mesh=TURNED, size_m=0.2
    )
    camera = Camera(width=60, height=40, fx=50.0, fy=50.0, cx=30.0, cy=20.0, world_from_camera=LOOKING_AWAY)
    return save_scene(root, SceneModel(camera=camera, objects=(item,), photo=None, background=None))


def seen(body, frame=1):
    """What geometry nodes make of the splats at ``frame``: their matrices [a b c | centre] (N, 4, 4) in the world."""
    bpy.context.scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    name = splat_clouds.find(body).name
    found = [
        np.array(instance.matrix_world)
        for instance in graph.object_instances
        if instance.is_instance
        and instance.parent.original.name == name
        and isinstance(instance.object.data, bpy.types.Mesh)
    ]
    return np.array(found).reshape(-1, 4, 4)


def assert_shows(matrices, wanted):
    """Centres and ellipsoids, to float32: half axes may differ, what they span may not."""
    assert len(matrices) == len(wanted)
    np.testing.assert_allclose(matrices[:, :3, 3], wanted.centres, atol=2e-6)
    spread = matrices[:, :3, :3] @ matrices[:, :3, :3].transpose(0, 2, 1) / splat_clouds.SIGMAS**2
    size = np.linalg.norm(wanted.covariances(), axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(spread / size, wanted.covariances() / size, atol=2e-3)


def test_a_splat_object_is_seen_as_its_ellipsoids(a_folder):
    (item,) = import_splats.import_splats(bpy.context.scene, a_folder.root)
    assert_shows(seen(item), transform_splats(some(), np.array(TURNED)))
    assert item.hide_render and item.physgen.enabled and item.physgen.role == "dynamic"
    item.location.x += 1.0
    bpy.context.view_layer.update()
    shift = np.array([1.0, 0.0, 0.0])
    there = transform_splats(some(), np.array(TURNED))
    assert_shows(seen(item), there.changed(centres=there.centres + shift))


def test_the_choice_is_ellipsoids_points_or_the_mesh(a_folder):
    (item,) = import_splats.import_splats(bpy.context.scene, a_folder.root)
    cloud = splat_clouds.find(item)
    item.physgen.splats_as = "POINTS"
    assert len(seen(item)) == 0
    graph = bpy.context.evaluated_depsgraph_get()
    geometry = cloud.evaluated_get(graph).evaluated_geometry()
    radii = np.array([point.radius for point in geometry.pointcloud.points])
    assert len(radii) == COUNT
    # Through the matrix of the body nothing is scaled: it is in the mesh.
    wanted = transform_splats(some(), np.array(TURNED)).scales.mean(axis=1) * splat_clouds.DOT
    np.testing.assert_allclose(radii, wanted, rtol=1e-3)
    item.physgen.splats_as = "MESH"
    assert cloud.hide_render and not item.hide_render
    item.physgen.splats_as = "ELLIPSOIDS"
    assert not cloud.hide_render and item.hide_render and len(seen(item)) == COUNT


def test_splats_go_out_as_they_came_in(a_folder, tmp_path):
    (item,) = import_splats.import_splats(bpy.context.scene, a_folder.root)
    before = fingerprint(bpy.context.scene)
    (source,) = export_scene(bpy.context.scene, tmp_path / "out").model.objects
    back = transform_splats(read_splats(tmp_path / "out" / source.splats), np.array(source.world_from_mesh))
    wanted = transform_splats(some(), np.array(TURNED))
    np.testing.assert_allclose(back.centres, wanted.centres, atol=1e-7)
    # Blender's own way between sRGB and light is not exact, to a sixteenth of a step of 8 bits.
    np.testing.assert_allclose(back.colours, wanted.colours, atol=2.5e-4)
    np.testing.assert_allclose(back.opacities, wanted.opacities, atol=1e-5)
    size = np.linalg.norm(wanted.covariances(), axis=(1, 2))[:, None, None]
    np.testing.assert_allclose(back.covariances() / size, wanted.covariances() / size, atol=1e-4)
    bpy.data.objects.remove(splat_clouds.find(item))
    assert fingerprint(bpy.context.scene) != before
    assert export_scene(bpy.context.scene, tmp_path / "out").model.objects[0].splats is None
    assert not (tmp_path / "out" / source.splats).exists()


def test_a_bake_plays_on_the_splats_also_without_the_add_on(a_folder, tmp_path):
    scene = bpy.context.scene
    (item,) = import_splats.import_splats(scene, a_folder.root)
    item.physgen.velocity = (0.0, 0.0, -2.0)
    simulation = scene.physgen.simulation
    simulation.quality, simulation.frame_start, simulation.frame_end = "preview", 3, 6
    path = tmp_path / "file.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    assert bpy.ops.physgen.bake() == {"FINISHED"}
    folder = Path(bpy.path.abspath(scene.physgen.simulation.bake))
    name = bake_record.manifest_of(folder).objects[0].splats_folder
    for frame in (3, 5, 6):
        own = read_splats(folder / name / f"{frame - 2:04d}.ply")
        assert_shows(seen(item, frame), transform_splats(own, np.array(item.matrix_world)))
    fallen = seen(item, 6)[:, 2, 3].mean() - seen(item, 3)[:, 2, 3].mean()
    assert fallen < -0.05
    show_bake.hide(scene)
    assert point_caches.MODIFIER not in splat_clouds.find(item).modifiers
    assert bpy.ops.physgen.bake() == {"FINISHED"}
    last = seen(item, 6)
    bpy.ops.wm.save_mainfile()
    physgen.unregister()
    bpy.ops.wm.open_mainfile(filepath=str(path))
    np.testing.assert_allclose(seen(bpy.data.objects["ball"], 6), last, atol=1e-6)
    physgen.register()


def test_a_photos_scene_brings_its_splats(a_folder):
    """And takes them away with it."""
    picture = bpy.data.images.new("grey", 60, 40)
    for name in ("photo.png", "background.png"):
        picture.save(filepath=str(a_folder.root / name))
    bpy.data.images.remove(picture)
    photo = dataclasses.replace(a_folder.model, photo="photo.png", background="background.png")
    save_scene(a_folder.root, photo)
    collection = import_scene(bpy.context.scene, a_folder.root)
    item = next(item for item in collection.all_objects if item.physgen.enabled)
    assert_shows(seen(item), transform_splats(some(), np.array(TURNED)))
    assert bpy.context.scene.cycles.transparent_max_bounces >= splat_clouds.BOUNCES
    remove_import(bpy.context.scene, collection)
    assert not [item for item in bpy.data.objects if splat_clouds.SPLATS in item]


def test_one_splat_renders_as_a_gaussian():
    """Seen along its axis it holds back opacity · exp(-b²/2), less what it would have at its end, of what is behind it:
    a white one over black, its middle, and one standard deviation beside it along its longer axis."""
    scene = bpy.context.scene
    compat.enable_cycles()
    mesh = bpy.data.meshes.new("body")
    body = bpy.data.objects.new("body", mesh)
    scene.collection.objects.link(body)
    one = Splats(
        centres=[[0, 0, 0]], scales=[[0.2, 0.1, 0.4]], rotations=[[1, 0, 0, 0]], opacities=[0.6], colours=[[1, 1, 1]]
    )
    splat_clouds.add(body, one)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type, camera.data.ortho_scale, camera.location = "ORTHO", 1.0, (0, 0, 5)
    scene.collection.objects.link(camera)
    scene.camera, scene.render.engine = camera, "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.pixel_filter_type = 64, False, "BOX"
    scene.render.resolution_x = scene.render.resolution_y = 50
    scene.render.film_transparent = False
    scene.view_settings.view_transform = "Raw"
    alpha = rendered(scene)
    end = np.exp(-0.5 * splat_clouds.SIGMAS**2)
    for across, b in ((0.0, 0.0), (0.2, 1.0), (0.3, 1.5), (0.45, 99.0)):
        wanted = 0.6 * max(np.exp(-0.5 * b**2) - end, 0) / (1 - end)
        # A pixel is 0.02 wide; its middle lies half of that aside.
        column = 25 + round(across / 0.02)
        assert alpha[24:26, column - 1 : column + 1].mean() == pytest.approx(wanted, abs=0.03)


def rendered(scene):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.exr"
        scene.render.image_settings.file_format = "OPEN_EXR"
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(str(path))
        pixels = np.array(image.pixels[:]).reshape(50, 50, 4)
    return pixels[..., 0]


def test_a_file_of_splats_becomes_an_object(tmp_path):
    write_splats(tmp_path / "a ball.ply", some(3000).changed(scales=np.full((3000, 3), 2e-3)))
    bpy.context.scene.cursor.location = (1.0, 0.0, 0.0)
    path = str(tmp_path / "a ball.ply")
    assert bpy.ops.physgen.import_splats(filepath=path, size_m=0.3, up="z") == {"FINISHED"}
    item = bpy.context.view_layer.objects.active
    assert item.name == "a ball" and splat_clouds.find(item) is not None
    assert max(item.dimensions) == pytest.approx(0.3, rel=1e-3)
    matrices = seen(item)
    assert len(matrices) == 3000
    middle = (matrices[:, :3, 3].min(axis=0) + matrices[:, :3, 3].max(axis=0)) / 2
    assert middle == pytest.approx([1.0, 0.0, 0.15], abs=0.01)
    # Read from the file, coloured by it.
    assert half_axes(splat_clouds.read(splat_clouds.find(item))).shape == (3000, 3, 3)
    with pytest.raises(RuntimeError, match="no such file"):
        bpy.ops.physgen.import_splats(filepath=str(tmp_path / "none.ply"))
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    with pytest.raises(RuntimeError, match="mesh"):
        bpy.ops.physgen.import_splats(filepath=str(tmp_path / "mesh.ply"))


def test_folders_without_splats_are_refused(a_folder):
    item = dataclasses.replace(a_folder.model.objects[0], splats=None)
    save_scene(a_folder.root, dataclasses.replace(a_folder.model, objects=(item,)))
    before = len(bpy.data.objects)
    with pytest.raises(InputError, match="no object in it has splats"):
        import_splats.import_splats(bpy.context.scene, a_folder.root)
    assert len(bpy.data.objects) == before and load_scene(a_folder.root)
