# SPDX-License-Identifier: GPL-3.0-or-later
"""The photo's view in Blender: camera, sun, background image, shadow-catching ground, environment light."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import bpy
import numpy as np
from mathutils import Matrix, Quaternion, Vector
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.plane_axes import plane_axes
from ...sim.scene.equirectangular import LUMINANCE, irradiance
from ...sim.scene.folder import Scene
from ...sim.scene.model import Camera, Light
from .. import compat
from ..paths import load_image
from .export_meshes import box_corners

SENSOR_MM = 36.0
CLIP_NEAR_M, CLIP_FAR_M = 1e-3, 1e4


def render_size(camera: Camera, scale: float) -> tuple[int, int]:
    """Return width and height in pixels of the camera's image times ``scale``."""
    return max(1, round(camera.width * scale)), max(1, round(camera.height * scale))


def photo_uv(camera: Camera, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return texture coordinates (V, 2), origin at the bottom left, that project the photo onto ``vertices`` (V, 3)."""
    pixels = camera.project(vertices)
    return np.nan_to_num(np.stack([pixels[:, 0] / camera.width, 1.0 - pixels[:, 1] / camera.height], axis=1))


def add_camera(scene: bpy.types.Scene, camera: Camera, size: tuple[int, int]) -> bpy.types.Object:
    """Add ``camera`` to ``scene`` and set the scene's resolution to ``size`` (width, height).

    Blender looks along -Z with +Y up, OpenCV along +Z with +Y down. Unequal focal lengths become a pixel aspect, an
    off-centre principal point a lens shift; both are exact, also if rounding changed the aspect of ``size``.
    """
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *size, 100
    data = bpy.data.cameras.new("photo camera")
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_MM
    data.clip_start, data.clip_end = CLIP_NEAR_M, CLIP_FAR_M
    item = bpy.data.objects.new("photo camera", data)
    scene.collection.objects.link(item)
    scene.camera = item
    aim_camera(scene, camera)
    return item


def aim_camera(scene: bpy.types.Scene, camera: Camera) -> None:
    """Set pose and lens of the camera that ``add_camera`` added to those of ``camera``."""
    render, data = scene.render, scene.camera.data
    width, height = render.resolution_x, render.resolution_y
    fx, fy = camera.fx * width / camera.width, camera.fy * height / camera.height
    cx, cy = camera.cx * width / camera.width, camera.cy * height / camera.height
    aspect = fx / fy
    # Blender accepts pixel aspects from 1 up only.
    render.pixel_aspect_x, render.pixel_aspect_y = (1.0, aspect) if aspect >= 1 else (1.0 / aspect, 1.0)
    data.lens = fx / width * SENSOR_MM
    # Shifts are in units of the image's width, also the vertical one.
    data.shift_x = (width / 2 - cx) / width
    data.shift_y = (cy - height / 2) * aspect / width
    pose = np.asarray(camera.world_from_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    scene.camera.matrix_world = Matrix(pose.tolist())


MIN_SUN_COSINE = 0.05
"""A sun lower than 3° above the ground would need unbounded strength for the scene's irradiance."""


def new_sun(
    light: Light, normal: NDArray[np.float64], irradiance: float, colour: NDArray[np.floating]
) -> tuple[bpy.types.Light, Quaternion]:
    """Return the lamp of ``light``, which has a ``sun_direction``, and the rotation of its object.

    normal: unit vector (3,) of the ground; irradiance: of the ground by the sun; colour: RGB (3,) of luminance 1.
    """
    direction = np.asarray(light.sun_direction)
    data = bpy.data.lights.new("sun", "SUN")
    # Blender's strength is the irradiance of a surface that faces the sun.
    data.energy = irradiance / max(float(direction @ normal), MIN_SUN_COSINE)
    # The photo is white-balanced for the total light; a sun of another colour than the sky's light would
    # tint the shadows.
    data.color = colour.tolist()
    data.angle = light.sun_angle
    return data, turn_to(direction)


def turn_to(direction: NDArray[np.floating]) -> Quaternion:
    """Return the rotation of a lamp whose light comes from ``direction`` (3,)."""
    return Vector(direction.tolist()).to_track_quat("Z", "Y")


def with_sun_angle(folder: Scene, angle: float | None) -> Scene:
    """Return ``folder`` with a sun of this apparent diameter in radians; None keeps the scene's."""
    if angle is None:
        return folder
    light = dataclasses.replace(folder.model.light, sun_angle=angle)
    return dataclasses.replace(folder, model=dataclasses.replace(folder.model, light=light))


MARK = "physgen_import"
"""Custom property of imported data, so that nothing else is removed with it."""
REACH = 12.0
"""Half the ground's width over the extent of all objects."""
KEPT = (bpy.types.Mesh, bpy.types.Material, bpy.types.Image, bpy.types.Light, bpy.types.Camera, bpy.types.World)
Data = TypeVar("Data", bound=bpy.types.ID)


class Made:
    """Data created by an import so far, so that a failed import leaves nothing behind."""

    def __init__(self) -> None:
        self._data: list[bpy.types.ID] = []

    def add(self, item: Data) -> Data:
        """Register ``item``."""
        self._data.append(item)
        return item

    def remove(self) -> None:
        """Delete all of it."""
        bpy.data.batch_remove(self._data)
        self._data.clear()


@dataclass(frozen=True)
class View:
    """The surroundings, built but not yet shown in the scene."""

    ground: bpy.types.Object
    world: bpy.types.World
    photo: bpy.types.Image
    background: bpy.types.Image


def load_picture(made: Made, path: Path) -> bpy.types.Image:
    """Return the image at ``path``, packed, so that the .blend needs no file beside it. Raises InputError if it is
    unreadable, or claims more pixels than a picture has: Blender would take the memory before it says so.
    """
    image = made.add(load_image(path))
    # A damaged file is detected only on access; Blender then logs it to the console.
    if not image.size[0] or not image.size[1]:
        raise InputError(f"{path}: is not a readable picture; restore it or make the scene again")
    image.pack()
    return image


def build(made: Made, collection: bpy.types.Collection, folder: Scene, items: list[bpy.types.Object]) -> View:
    """Build ground, sun and world; link objects to ``collection``. Raises InputError."""
    scene = folder.model
    photo, background = (load_picture(made, folder.file(name)) for name in scene.photo_files)
    world = made.add(bpy.data.worlds.new("environment"))
    world[MARK] = True
    colour = _fill_world(made, world, folder)
    of_environment = float(colour @ LUMINANCE)
    light = scene.light
    if light.sun_direction is not None and light.sun_strength > 0:
        sun = _add_sun(made, folder, light.sun_strength * of_environment, colour / of_environment)
        collection.objects.link(sun)
    corners = np.concatenate([box_corners(item) for item in items])
    ground = _ground(made, scene.ground_plane.unit_normal, np.asarray(scene.ground_plane.point, dtype=float), corners)
    collection.objects.link(ground)
    return View(ground=ground, world=world, photo=photo, background=background)


def show(scene: bpy.types.Scene, collection: bpy.types.Collection, view: View, camera: Camera) -> None:
    """Set camera, background image and colour management of ``scene`` so that it shows the photo.

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
    # Any other view transform would change the photo's colours; without film there is no background image.
    scene.view_settings.view_transform, scene.view_settings.look = "Standard", "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0
    scene.render.film_transparent = True
    _lay_over_plate(scene, view.background)


PLATE_TREE = "PhysGen Plate"


def _lay_over_plate(scene: bpy.types.Scene, plate: bpy.types.Image) -> None:
    """Let Blender's own renders (F12) have the ``plate`` behind the objects, unless ``scene`` has a compositor of its
    own. Before Blender 5.0 nothing, as a compositor is no node group there.
    """
    if not hasattr(scene, "compositing_node_group"):
        return
    tree = scene.compositing_node_group
    if tree is not None and MARK not in tree:
        return
    if tree is None:
        tree = scene.compositing_node_group = bpy.data.node_groups.new(PLATE_TREE, "CompositorNodeTree")
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        tree[MARK] = True
    tree.nodes.clear()
    kinds = ("CompositorNodeImage", "CompositorNodeScale", "CompositorNodeRLayers", "CompositorNodeAlphaOver")
    picture, scale, render, over, output = (tree.nodes.new(kind) for kind in (*kinds, "NodeGroupOutput"))
    for node, place in ((scale, (200, 150)), (render, (100, -150)), (over, (450, 0)), (output, (650, 0))):
        node.location = place
    picture.image, picture.location = plate, (-100, 150)
    # As large as the render, whatever its percentage is.
    scale.inputs["Type"].default_value, scale.inputs["Frame Type"].default_value = "Render Size", "Stretch"
    tree.links.new(picture.outputs["Image"], scale.inputs["Image"])
    tree.links.new(scale.outputs["Image"], over.inputs["Background"])
    tree.links.new(render.outputs["Image"], over.inputs["Foreground"])
    tree.links.new(over.outputs["Image"], output.inputs["Image"])


def data_of(item: bpy.types.Object) -> set[bpy.types.ID]:
    """Return all data of ``item`` that nothing else may use."""
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
    """Delete unused items of ``data``, and then the images that only they used."""
    waiting = set(data)
    waiting |= {image for item in waiting if isinstance(item, bpy.types.World) for image in _images(item)}
    while unused := [item for item in waiting if item.users == 0]:
        waiting -= set(unused)
        bpy.data.batch_remove(unused)


def _images(owner: bpy.types.Material | bpy.types.World) -> set[bpy.types.ID]:
    tree = owner.node_tree
    nodes = tree.nodes if tree is not None else ()
    return {node.image for node in nodes if getattr(node, "image", None) is not None}


def _fill_world(made: Made, world: bpy.types.World, folder: Scene) -> NDArray[np.float64]:
    """Create the nodes of the environment; return its RGB irradiance (3,) on the open ground."""
    tree = compat.node_tree(world)
    shader, output = tree.nodes.new("ShaderNodeBackground"), tree.nodes.new("ShaderNodeOutputWorld")
    output.location = (300, 0)
    tree.links.new(shader.outputs["Background"], output.inputs["Surface"])
    name = folder.model.light.environment
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
    colour = irradiance(radiance[..., :3], folder.model.ground_plane.unit_normal) if image.channels >= 3 else None
    if colour is None or not np.isfinite(colour).all() or float(colour @ LUMINANCE) <= 0:
        raise InputError(f"{folder.file(name)}: lights nothing; give an environment with finite light in R, G and B")
    return colour


def _add_sun(made: Made, folder: Scene, ground_irradiance: float, colour: NDArray[np.floating]) -> bpy.types.Object:
    data, turn = new_sun(folder.model.light, folder.model.ground_plane.unit_normal, ground_irradiance, colour)
    item = made.add(bpy.data.objects.new("sun", made.add(data)))
    # The sun lamp's position does not matter: behind the camera its outline is out of view.
    camera = folder.model.camera
    item.matrix_world = (
        Matrix.Translation((2 * camera.position - _target(camera, folder)).tolist()) @ turn.to_matrix().to_4x4()
    )
    return item


def _target(camera: Camera, folder: Scene) -> NDArray[np.float64]:
    """Return the point (3,) on the optical axis at the distance of the ground's point."""
    forward = np.asarray(camera.world_from_camera)[:3, 2]
    away = float(np.linalg.norm(np.asarray(folder.model.ground_plane.point) - camera.position))
    return np.asarray(camera.position + max(away, 1e-3) * forward)


def _ground(
    made: Made, normal: NDArray[np.float64], point: NDArray[np.float64], corners: NDArray[np.float64]
) -> bpy.types.Object:
    """Return a plane below the objects: Cycles renders only the shadows on it, EEVEE nothing, viewports its outline."""
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
