# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene folder and its bake as three Blender scenes: the objects' colours, their light, the light on the ground.

They share the objects, the latter two also lamps and world. Rendered apart, outlines and colours are as sharp as the
photo and cost little, because no light is computed; light is smooth, denoised, and may be coarser than the picture;
the ground's light has no outlines in it and is known behind the objects too.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import bpy

from ...sim.scene.folder import SceneFolder, require_photo
from ...sim.scene.model import Camera
from . import caches, compat, passes
from .camera import add_camera, aim_camera, render_size
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
    colour_scene: bpy.types.Scene
    light_scene: bpy.types.Scene
    shadow_scene: bpy.types.Scene
    open_irradiance: float
    first_frame: int
    own: list[bpy.types.ID] = field(default_factory=list)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames."""
        return _size(self.colour_scene)

    @property
    def light_size(self) -> tuple[int, int]:
        """Width and height in which light is computed."""
        return _size(self.shadow_scene)


def _size(scene: bpy.types.Scene) -> tuple[int, int]:
    return scene.render.resolution_x, scene.render.resolution_y


def build(folder: SceneFolder, bake: caches.Bake | None, options: RenderOptions) -> BlenderScene:
    """Build ``folder`` beside whatever is in the .blend; with ``bake`` its objects follow their caches.

    Raises InputError for a scene without a photo or ground, and for a mesh, texture, light or cache that cannot be
    used; nothing is left behind then.
    """
    require_photo(folder)
    compat.enable_cycles()
    before = everything()
    try:
        built = _build(folder, bake, options)
    except Exception:
        _remove_all(everything() - before)
        raise
    built.own = list(everything() - before)
    return built


def aim(built: BlenderScene, camera: Camera) -> None:
    """Let all scenes of ``built`` be seen by ``camera``."""
    for scene in (built.colour_scene, built.light_scene, built.shadow_scene):
        aim_camera(scene, camera)


def remove(built: BlenderScene) -> None:
    """Delete all that ``build`` added."""
    _remove_all(set(built.own))
    built.own = []


def _build(folder: SceneFolder, bake: caches.Bake | None, options: RenderOptions) -> BlenderScene:
    scene = folder.scene
    colour_scene, light_scene, shadow_scene = scenes = [
        bpy.data.scenes.new(f"PhysGen {name}") for name in ("colours", "light", "shadows")
    ]
    collection = bpy.data.collections.new("PhysGen objects")
    size = render_size(scene.camera, options.scale)
    light_scale = options.scale * options.light_scale_for(max(size))
    for item in scenes:
        item.collection.children.link(collection)
        passes.set_up(item, options, denoise=item is not colour_scene)
        add_camera(item, scene.camera, size if item is colour_scene else render_size(scene.camera, light_scale))
    colour_scene.view_layers[0].aovs.add().name = COLOUR_LAYER
    add_ground(shadow_scene, scene.ground, scene.camera)
    open_irradiance = add_light([light_scene, shadow_scene], folder)
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
        colour_scene=colour_scene,
        light_scene=light_scene,
        shadow_scene=shadow_scene,
        open_irradiance=open_irradiance,
        first_frame=bake.first_frame if bake is not None else 1,
    )


def everything() -> set[bpy.types.ID]:
    """All data that ``build`` or what completes it can have added."""
    kinds = ("scenes", "collections", "objects", "meshes", "materials", "images", "worlds", "lights", "cameras")
    return {item for kind in (*kinds, "node_groups") for item in getattr(bpy.data, kind)}


def _remove_all(items: set[bpy.types.ID]) -> None:
    if items:
        bpy.data.batch_remove(items)
