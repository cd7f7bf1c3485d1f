# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene folder and its bake as Blender scenes: one shows the objects, one the light on the ground.

They share objects, lights and world. Rendered apart, the ground's light has no outlines in it, is known behind the
objects too, and may be coarser than the picture.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy

from ...sim.scene.folder import SceneFolder
from . import caches, compat, passes
from .camera import add_camera, render_size
from .ground import add_ground
from .light import add_light
from .objects import COLOUR_LAYER, RenderObject, add_object
from .options import RenderOptions


@dataclass
class BlenderScene:
    """What ``build`` made. ``open_irradiance``: luminance of the light on the open ground."""

    folder: SceneFolder
    options: RenderOptions
    objects: list[RenderObject]
    object_scene: bpy.types.Scene
    shadow_scene: bpy.types.Scene
    open_irradiance: float
    first_frame: int
    own: list[bpy.types.ID] = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames."""
        return _size(self.object_scene)

    @property
    def shadow_size(self) -> tuple[int, int]:
        """Width and height of the ground's light."""
        return _size(self.shadow_scene)


def _size(scene: bpy.types.Scene) -> tuple[int, int]:
    return scene.render.resolution_x, scene.render.resolution_y


def build(folder: SceneFolder, bake: caches.Bake | None, options: RenderOptions) -> BlenderScene:
    """Build ``folder`` beside whatever is in the .blend; with ``bake`` its objects follow their caches.

    Raises InputError for a mesh, texture, light or cache that cannot be used; nothing is left behind then.
    """
    compat.enable_cycles()
    before = _everything()
    try:
        built = _build(folder, bake, options)
    except Exception:
        _remove_all(_everything() - before)
        raise
    built.own = list(_everything() - before)
    return built


def remove(built: BlenderScene) -> None:
    """Delete all that ``build`` added."""
    _remove_all(set(built.own))
    built.own = []


def _build(folder: SceneFolder, bake: caches.Bake | None, options: RenderOptions) -> BlenderScene:
    scene = folder.scene
    object_scene = bpy.data.scenes.new("PhysGen objects")
    shadow_scene = bpy.data.scenes.new("PhysGen shadows")
    scenes = [object_scene, shadow_scene]
    collection = bpy.data.collections.new("PhysGen objects")
    for item in scenes:
        item.collection.children.link(collection)
    passes.set_up(object_scene, options, options.samples)
    passes.set_up(shadow_scene, options, options.shadow_samples)
    object_scene.view_layers[0].aovs.add().name = COLOUR_LAYER
    add_camera(object_scene, scene.camera, render_size(scene.camera, options.scale))
    add_camera(shadow_scene, scene.camera, render_size(scene.camera, options.scale * options.shadow_scale))
    add_ground(shadow_scene, scene.ground, scene.camera)
    open_irradiance = add_light(scenes, folder)
    objects = [add_object(collection, folder, source) for source in scene.objects]
    # The ground's light is wanted without the objects in front of it, but with their shadows.
    compat.layer_collection(shadow_scene.view_layers[0], collection.name).indirect_only = True
    if bake is not None:
        for target, cache in zip(objects, bake.caches, strict=True):
            caches.attach(target.item, cache, bake.first_frame)
    return BlenderScene(
        folder=folder,
        options=options,
        objects=objects,
        object_scene=object_scene,
        shadow_scene=shadow_scene,
        open_irradiance=open_irradiance,
        first_frame=bake.first_frame if bake is not None else 1,
    )


def _everything() -> set[bpy.types.ID]:
    kinds = ("scenes", "collections", "objects", "meshes", "materials", "images", "worlds", "lights", "cameras")
    return {item for kind in kinds for item in getattr(bpy.data, kind)}


def _remove_all(items: set[bpy.types.ID]) -> None:
    if items:
        bpy.data.batch_remove(items)
