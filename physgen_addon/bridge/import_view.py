# SPDX-License-Identifier: GPL-3.0-or-later
"""What makes the view through the camera the photo: background picture, shadow-catching ground, light."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.equirectangular import LUMINANCE, irradiance
from ...sim.scene.folder import SceneFolder
from ...sim.scene.model import Camera
from . import compat
from .bounds import box_corners
from .camera import add_camera
from .regions import plane_axes
from .sun import new_sun

MARK = "physgen_import"
"""Custom property of what an import has made, so that nothing else is removed with it."""
REACH = 12.0
"""Half the ground's width over the extent of all objects."""
KEPT = (bpy.types.Mesh, bpy.types.Material, bpy.types.Image, bpy.types.Light, bpy.types.Camera, bpy.types.World)
Data = TypeVar("Data", bound=bpy.types.ID)


class Made:
    """What an import has made so far, so that one that fails leaves nothing behind."""

    def __init__(self) -> None:
        self._data: list[bpy.types.ID] = []

    def add(self, item: Data) -> Data:
        """Remember ``item``."""
        self._data.append(item)
        return item

    def remove(self) -> None:
        """Delete all of it."""
        bpy.data.batch_remove(self._data)
        self._data.clear()


@dataclass(frozen=True)
class View:
    """The built surroundings, not yet the scene's."""

    ground: bpy.types.Object
    world: bpy.types.World
    photo: bpy.types.Image
    background: bpy.types.Image


def load_picture(made: Made, path: Path) -> bpy.types.Image:
    """The picture at ``path``, packed, so that the .blend needs no file beside it. Raises InputError if it is none."""
    try:
        image = made.add(bpy.data.images.load(str(path), check_existing=False))
    except RuntimeError:
        raise InputError(f"{path}: cannot be read; check that it is there and may be read") from None
    # A damaged file is only found out by looking; Blender then says so on the console.
    if not image.size[0] or not image.size[1]:
        raise InputError(f"{path}: is not a readable picture; restore it or make the scene again")
    image.pack()
    return image


def build(made: Made, collection: bpy.types.Collection, folder: SceneFolder, items: list[bpy.types.Object]) -> View:
    """Ground, sun and world, linked to ``collection`` as far as they are objects. Raises InputError."""
    scene = folder.scene
    photo = load_picture(made, folder.file(scene.photo))
    background = load_picture(made, folder.file(scene.background))
    world = made.add(bpy.data.worlds.new("environment"))
    world[MARK] = True
    colour = _fill_world(made, world, folder)
    of_environment = float(colour @ LUMINANCE)
    light = scene.light
    if light.sun_direction is not None and light.sun_strength > 0:
        sun = _add_sun(made, folder, light.sun_strength * of_environment, colour / of_environment)
        collection.objects.link(sun)
    corners = np.concatenate([box_corners(item) for item in items])
    ground = _ground(made, scene.ground.unit_normal, np.asarray(scene.ground.point, dtype=float), corners)
    collection.objects.link(ground)
    return View(ground=ground, world=world, photo=photo, background=background)


def show(scene: bpy.types.Scene, collection: bpy.types.Collection, view: View, camera: Camera) -> None:
    """Let ``scene`` be seen by ``camera``, in front of the background, in the photo's own colours.

    Its former world stays in the file.
    """
    item = add_camera(scene, camera, (camera.width, camera.height))
    scene.collection.objects.unlink(item)
    collection.objects.link(item)
    item.lock_location = item.lock_rotation = item.lock_scale = (True, True, True)
    item.data.passepartout_alpha = 0.9
    item.data.display_size = 0.15 * max((item.matrix_world.translation - view.ground.location).length, 1e-3)
    item.data.show_background_images = True
    for image, depth, shown in ((view.background, "BACK", True), (view.photo, "FRONT", False)):
        # The photo lies in front, hidden: one click compares.
        picture = item.data.background_images.new()
        picture.image, picture.display_depth = image, depth
        picture.alpha, picture.frame_method, picture.show_background_image = 1.0, "STRETCH", shown
    if scene.world is not None and MARK not in scene.world:
        scene.world.use_fake_user = True
    scene.world = view.world
    # Any other view transform would change the photo's colours; without film there is no background behind the picture.
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0
    scene.render.film_transparent = True


def data_of(item: bpy.types.Object) -> set[bpy.types.ID]:
    """Everything that ``item`` needs and that may be nobody else's."""
    found: set[bpy.types.ID] = {item.data} if item.data is not None else set()
    if item.animation_data is not None and item.animation_data.action is not None:
        found.add(item.animation_data.action)
    for slot in item.material_slots:
        if slot.material is not None:
            found.add(slot.material)
            found |= _images(slot.material)
    if item.type == "CAMERA":
        found |= {picture.image for picture in item.data.background_images if picture.image is not None}
    return found


def remove_unused(data: Iterable[bpy.types.ID]) -> None:
    """Delete what of ``data`` nothing uses any more, and then the pictures that only it used."""
    waiting = set(data)
    waiting |= {image for item in waiting if isinstance(item, bpy.types.World) for image in _images(item)}
    while unused := [item for item in waiting if item.users == 0]:
        waiting -= set(unused)
        bpy.data.batch_remove(unused)


def _images(owner: bpy.types.Material | bpy.types.World) -> set[bpy.types.ID]:
    tree = owner.node_tree
    nodes = tree.nodes if tree is not None else ()
    return {node.image for node in nodes if getattr(node, "image", None) is not None}


def _fill_world(made: Made, world: bpy.types.World, folder: SceneFolder) -> NDArray[np.float64]:
    """Nodes of the environment; its RGB irradiance (3,) on the open ground."""
    tree = compat.node_tree(world)
    shader, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    output.location = (300, 0)
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])
    name = folder.scene.light.environment
    if name is None:
        shader.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
        return np.full(3, math.pi)
    image = load_picture(made, folder.file(name))
    image.colorspace_settings.name = "Linear Rec.709"
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image, texture.location = image, (-300, 0)
    tree.links.new(texture.outputs["Color"], shader.inputs["Color"])
    width, height = image.size
    pixels = np.empty(width * height * image.channels, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    radiance = pixels.reshape(height, width, image.channels)[::-1]
    colour = irradiance(radiance[..., :3], folder.scene.ground.unit_normal) if image.channels >= 3 else None
    if colour is None or not np.isfinite(colour).all() or float(colour @ LUMINANCE) <= 0:
        raise InputError(f"{folder.file(name)}: lights nothing; give an environment with finite light in R, G and B")
    return colour


def _add_sun(
    made: Made, folder: SceneFolder, ground_irradiance: float, colour: NDArray[np.floating]
) -> bpy.types.Object:
    data, turn = new_sun(folder.scene.light, folder.scene.ground.unit_normal, ground_irradiance, colour)
    item = made.add(bpy.data.objects.new("sun", made.add(data)))
    # Where a sun stands does not matter: behind the camera its line is out of the picture.
    camera = folder.scene.camera
    item.matrix_world = (
        Matrix.Translation((2 * camera.position - _target(camera, folder)).tolist()) @ turn.to_matrix().to_4x4()
    )
    return item


def _target(camera: Camera, folder: SceneFolder) -> NDArray[np.float64]:
    """The point (3,) on the optical axis as far away as the ground's point."""
    forward = np.asarray(camera.world_from_camera)[:3, 2]
    away = float(np.linalg.norm(np.asarray(folder.scene.ground.point) - camera.position))
    return np.asarray(camera.position + max(away, 1e-3) * forward)


def _ground(
    made: Made, normal: NDArray[np.float64], point: NDArray[np.float64], corners: NDArray[np.float64]
) -> bpy.types.Object:
    """A plane below the objects: Cycles renders only the shadows on it, EEVEE nothing, viewports its outline."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre = (low + high) / 2
    centre = centre - ((centre - point) @ normal) * normal
    half = REACH * max(float(np.linalg.norm(high - low)), 1e-3)
    mesh = made.add(bpy.data.meshes.new("ground"))
    mesh.from_pydata([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)], [], [(0, 1, 2, 3)])
    mesh.materials.append(_ground_material(made))
    item = made.add(bpy.data.objects.new("ground", mesh))
    first, second = plane_axes(normal)
    place = np.eye(4)
    place[:3, 0], place[:3, 1], place[:3, 2], place[:3, 3] = first, second, normal, centre
    item.matrix_world = Matrix(place.tolist())
    item.is_shadow_catcher = True
    item.display_type = "WIRE"
    item.hide_select = True
    return item


def _ground_material(made: Made) -> bpy.types.Material:
    material = made.add(bpy.data.materials.new("ground"))
    tree = compat.node_tree(material)
    for target, kind, y in (("CYCLES", "BsdfDiffuse", 0), ("EEVEE", "BsdfTransparent", -200)):
        surface, output = tree.nodes.new(f"ShaderNode{kind}"), tree.nodes.new("ShaderNodeOutputMaterial")
        output.target, surface.location, output.location = target, (0, y), (250, y)
        tree.links.new(surface.outputs[0], output.inputs["Surface"])
    return material
