# SPDX-License-Identifier: GPL-3.0-or-later
"""A small world that Cycles renders twice: once as the truth, once from a "photo" of it through the render stage."""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from physgen.sim.cache.bake_folder import BakedObject, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.scene.folder import Scene, save_scene
from physgen.sim.scene.model import Camera, Ground, Light, SceneModel, SceneObject
from physgen.sim.srgb import linear_to_bytes
from PIL import Image

from ..conftest import complete_manifest

if importlib.util.find_spec("bpy") is None:
    collect_ignore_glob = ["test_*.py"]
else:
    import bpy
    import physgen
    from mathutils import Vector
    from physgen.physgen_addon import compat
    from physgen.physgen_addon.props import material_props
    from physgen.physgen_addon.render import render_engines
    from physgen.physgen_addon.render.render_options import RenderOptions
    from physgen.physgen_addon.render.render_regions import Box
    from physgen.physgen_addon.render.render_scene import add_ground
    from physgen.physgen_addon.scene_io import photo_view as bridge_camera

    from .panel_scenes import own_folder

WIDTH, HEIGHT = 160, 120
RADIUS = 0.05
SUN = (0.48, 0.36, 0.8)
SUN_STRENGTH = 1.5
SUN_ANGLE = 0.2
SHIFT = (-0.07, 0.03, 0.0)
"""Where the moved ball is, from where it rests."""
MAKING_S = 600.0
"""Time that a worker waits for what another one makes."""


def look_down(*, pitch_deg: float = 35.0, height: float = 0.3, back: float = 0.4) -> tuple:
    """Pose of a camera behind the origin that looks along +Y and down."""
    s, c = math.sin(math.radians(pitch_deg)), math.cos(math.radians(pitch_deg))
    return ((1.0, 0.0, 0.0, 0.0), (0.0, -s, c, -back), (0.0, -c, -s, height), (0.0, 0.0, 0.0, 1.0))


def photo_camera() -> Camera:
    """Unequal focal lengths and an off-centre principal point, so that every test covers them."""
    return Camera(width=WIDTH, height=HEIGHT, fx=190.0, fy=200.0, cx=74.0, cy=63.5, world_from_camera=look_down())


@dataclass(frozen=True)
class World:
    """A scene folder with its photo, and the true pictures: photo, empty ground, ball moved by SHIFT."""

    folder: Scene
    photo: np.ndarray
    background: np.ndarray
    moved: np.ndarray
    moved_mask: np.ndarray


@pytest.fixture(scope="session")
def factory_settings():
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(autouse=True)
def fresh_blender(factory_settings):
    """One bpy serves the whole session; each test begins with an empty file and must leave none of its data.

    A new file takes a fifth of the time of factory settings, which also reload preferences that no test touches.
    """
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture
def addon(fresh_blender):
    """The extension, registered in the empty file; tests that set something beforehand do it in autouse fixtures."""
    physgen.register()
    yield
    physgen.unregister()


@pytest.fixture
def own_presets(tmp_path, monkeypatch):
    """The user's own presets of materials are in a folder of the test."""
    monkeypatch.setattr(material_props, "own_folder", lambda *, create=False: own_folder(tmp_path, create))
    material_props.forget_presets()
    yield
    material_props.forget_presets()


def floor_material() -> bpy.types.Material:
    material = bpy.data.materials.new("floor")
    tree = compat.node_tree(material)
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = 25.0
    coordinates = tree.nodes.new("ShaderNodeNewGeometry")
    tree.links.new(coordinates.outputs["Position"], noise.inputs["Vector"])
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].color = (0.25, 0.15, 0.08, 1)
    ramp.color_ramp.elements[1].color = (0.7, 0.6, 0.45, 1)
    tree.links.new(noise.outputs[0], ramp.inputs[0])
    return _diffuse(material, tree, ramp.outputs[0])


def _diffuse(material, tree, colour) -> bpy.types.Material:
    shader = tree.nodes.new("ShaderNodeBsdfDiffuse")
    if isinstance(colour, tuple):
        shader.inputs["Color"].default_value = colour
    else:
        tree.links.new(colour, shader.inputs["Color"])
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs[0], output.inputs[0])
    return material


def render_truth(
    shift: tuple[float, float, float] | None, folder: Path, camera: Camera | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The picture (H, W, 3) in 8-bit sRGB and the ball's mask (H, W), by Cycles alone; None leaves the ball out."""
    camera = camera or photo_camera()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    compat.enable_cycles()
    scene = bpy.data.scenes.new("truth")
    render_engines.set_up_passes(scene)
    render_engines.set_up_cycles(scene, RenderOptions(samples=256, seed=7), denoise=False)
    scene.render.use_persistent_data = False
    bridge_camera.add_camera(scene, camera, (WIDTH, HEIGHT))
    scene.world = bpy.data.worlds.new("sky")
    tree = compat.node_tree(scene.world)
    sky, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    sky.inputs["Color"].default_value, sky.inputs["Strength"].default_value = (1, 1, 1, 1), 0.3
    tree.links.new(sky.outputs[0], output.inputs[0])
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle = 0.3 * SUN_STRENGTH * math.pi / SUN[2], SUN_ANGLE
    lamp = bpy.data.objects.new("sun", sun)
    lamp.rotation_euler = Vector(SUN).to_track_quat("Z", "Y").to_euler()
    scene.collection.objects.link(lamp)
    floor = add_ground(scene, Ground(), photo_camera())
    floor.data.materials[0] = floor_material()
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    box = Box(0, 0, WIDTH, HEIGHT)
    if shift is not None:
        ball = ball_mesh()
        data = bpy.data.meshes.new("ball")
        data.from_pydata((ball.vertices + np.asarray(shift)).tolist(), [], ball.faces.tolist())
        data.shade_smooth()
        material = bpy.data.materials.new("ball")
        data.materials.append(_diffuse(material, compat.node_tree(material), (0.55, 0.25, 0.08, 1)))
        scene.collection.objects.link(bpy.data.objects.new("ball", data))
        floor.hide_render = True
        mask = render_engines.render_passes(scene, 1, box, folder)["Combined.A"] > 0.5
        floor.hide_render = False
    scene.render.film_transparent = False
    picture = render_engines.stack(render_engines.render_passes(scene, 1, box, folder), "Combined")
    return linear_to_bytes(picture), mask


def ball_mesh() -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    ball.vertices += [0.02, 0.0, RADIUS]
    return ball


def made_once(tmp_path_factory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that ``make`` fills, shared by all workers of a run: the first one makes it while others wait."""
    base = tmp_path_factory.getbasetemp()
    # Workers have folders of their own below the run's.
    root = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    done, making = root.with_suffix(".done"), root.with_suffix(".making")
    end = time.monotonic() + MAKING_S
    while not done.exists():
        assert time.monotonic() < end, f"{name}: the worker that makes it has not finished"
        try:
            making.mkdir()
        except FileExistsError:
            time.sleep(0.2)
            continue
        try:
            root.mkdir(exist_ok=True)
            make(root)
            done.touch()
        finally:
            making.rmdir()
    return root


def _photograph(root: Path) -> None:
    photo, mask = render_truth((0.0, 0.0, 0.0), root)
    background, _ = render_truth(None, root)
    moved, moved_mask = render_truth(SHIFT, root)
    np.savez(root / "truth.npz", photo=photo, mask=mask, background=background, moved=moved, moved_mask=moved_mask)


@pytest.fixture(scope="session")
def shared_world(tmp_path_factory) -> tuple[World, dict[Path, bytes]]:
    """The world, reconstructed perfectly, and its files."""
    with np.load(made_once(tmp_path_factory, "truth", _photograph) / "truth.npz") as truth:
        photo, mask, background = truth["photo"], truth["mask"], truth["background"]
        moved, moved_mask = truth["moved"], truth["moved_mask"]
    root = tmp_path_factory.mktemp("scene")
    for name in ("meshes", "masks", "shadows"):
        (root / name).mkdir()
    camera, ball = photo_camera(), ball_mesh()
    pixels = camera.project(ball.vertices)
    uv = np.stack([pixels[:, 0] / WIDTH, 1 - pixels[:, 1] / HEIGHT], axis=1)
    # What a reconstruction does: colours beyond the outline continue those inside.
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(_extended(photo, mask)))
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    trimesh.Trimesh(ball.vertices, ball.faces, visual=visual, process=False).export(root / "meshes" / "ball.glb")
    Image.fromarray(photo).save(root / "photo.png")
    Image.fromarray(background).save(root / "background.png")
    Image.fromarray(mask.astype(np.uint8) * 255).save(root / "masks" / "ball.png")
    item = SceneObject(name="ball", mesh="meshes/ball.glb", size_m=2 * RADIUS, mask="masks/ball.png")
    light = Light(sun_direction=SUN, sun_strength=SUN_STRENGTH, sun_angle=SUN_ANGLE)
    folder = save_scene(root, SceneModel(camera=camera, objects=(item,), light=light))
    world = World(folder=folder, photo=photo, background=background, moved=moved, moved_mask=moved_mask)
    return world, _contents(root)


def _contents(root: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def world(shared_world) -> Iterator[World]:
    """The world that a worker's tests share; one that changes a file of it, instead of a copy's, fails."""
    world, files = shared_world
    yield world
    now = _contents(world.folder.root)
    changed = {path.name for path in files.keys() | now.keys() if files.get(path) != now.get(path)}
    for path in now.keys() - files.keys():
        path.unlink()
    for path, content in files.items() if changed else ():
        path.write_bytes(content)
    assert not changed, f"the world of all tests was changed: {', '.join(sorted(changed))}"


def _extended(photo: np.ndarray, mask: np.ndarray) -> np.ndarray:
    from scipy import ndimage

    rows, columns = ndimage.distance_transform_edt(~mask, return_indices=True)[1]
    return photo[rows, columns]


@pytest.fixture
def truth():
    """``render_truth``, for other cameras and places."""
    return render_truth


@pytest.fixture
def bake(world, tmp_path):
    """A function that writes a bake of the ball's shifts, one (3,) a frame; its folder."""

    def write(shifts, name: str = "bake", vertices: np.ndarray | None = None) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        rest = ball_mesh().vertices if vertices is None else vertices
        with Pc2Writer(folder / "ball.pc2", vertex_count=len(rest)) as writer:
            for shift in shifts:
                writer.append(rest + np.asarray(shift))
        item = BakedObject(name="ball", file="ball.pc2", vertices=len(rest))
        save_manifest(folder, complete_manifest(item, frames=len(shifts)))
        return folder

    return write


@contextlib.contextmanager
def _held_elsewhere(folder: Path) -> Iterator[None]:
    code = "import pathlib, sys; from physgen.sim.folder_lock import folder_lock\n"
    code += "with folder_lock(pathlib.Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, str(folder)]
    holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        yield
    finally:
        holder.communicate()
    assert holder.returncode == 0


@pytest.fixture
def held_elsewhere():
    """A context in which another, living process holds a folder."""
    return _held_elsewhere
