# SPDX-License-Identifier: GPL-3.0-or-later
"""A scene folder and its bake as three Blender scenes: the objects' colours, their light, the light on the ground.

They share the objects, the latter two also lamps and world. Rendered apart, outlines and colours are as sharp as the
photo and cost little, because no light is computed; light is smooth, denoised, and may be coarser than the picture;
the ground's light has no outlines in it and is known behind the objects too.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...sim.scene.folder import SceneFolder, require_photo
from ...sim.scene.model import Camera
from . import caches, compat, cycles, eevee, passes
from .camera import add_camera, aim_camera, render_size
from .ground import add_ground
from .light import add_environment, add_lamps
from .objects import COLOUR_LAYER, RenderObject, add_object
from .options import RenderOptions
from .regions import Box


@dataclass
class BlenderScene:
    """What ``build`` made. ``open_irradiance``: luminance of the light on the open ground."""

    folder: SceneFolder
    options: RenderOptions
    objects: list[RenderObject]
    collection: bpy.types.Collection
    colour_scene: bpy.types.Scene
    light_scene: bpy.types.Scene
    shadow_scene: bpy.types.Scene
    open_irradiance: float
    first_frame: int
    own: list[bpy.types.ID] = field(default_factory=list)

    def colours(self, number: int, box: Box, folder: Path) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The objects' colours (h, w, 3), premultiplied, and coverage (h, w) in ``box`` at frame ``number``.

        ``folder`` takes temporary files. Raises RenderError when Blender fails.
        """
        if self.options.engine == "eevee":
            side = eevee.subpixels(self.options)
            return eevee.colours(self.colour_scene, COLOUR_LAYER, number, box, side, folder)
        channels = passes.render(self.colour_scene, number, box, folder)
        return passes.stack(channels, COLOUR_LAYER), channels["Combined.A"]

    def ground_light(self, number: int, box: Box, folder: Path) -> NDArray[np.float32]:
        """Light on the ground in ``box`` (h, w, 3) at frame ``number``, nothing in front of it.

        ``folder`` takes temporary files. Raises RenderError when Blender fails.
        """
        hidden = eevee.unseen(self.collection) if self.options.engine == "eevee" else contextlib.nullcontext()
        with hidden:
            return passes.stack(passes.render(self.shadow_scene, number, box, folder), "Combined")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames."""
        return render_size(self.folder.scene.camera, self.options.scale)

    @property
    def drawn_size(self) -> tuple[int, int]:
        """Width and height in which colours are drawn, subpixels among them."""
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
    if options.engine == "cycles":
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
    side = eevee.subpixels(options) if options.engine == "eevee" else 1
    drawn = (size[0] * side, size[1] * side)
    light_scale = options.scale * options.light_scale_for(max(size))
    for item in scenes:
        item.collection.children.link(collection)
        passes.set_up(item)
        add_camera(item, scene.camera, drawn if item is colour_scene else render_size(scene.camera, light_scale))
    colour_scene.view_layers[0].aovs.add().name = COLOUR_LAYER
    add_ground(shadow_scene, scene.ground, scene.camera)
    if options.engine == "cycles":
        for item in scenes:
            cycles.set_up(item, options, denoise=item is not colour_scene)
        open_irradiance = add_environment([light_scene, shadow_scene], folder)
    else:
        eevee.set_up_colours(colour_scene, options)
        for item in (light_scene, shadow_scene):
            eevee.set_up(item, options)
        open_irradiance = add_lamps(light_scene, shadow_scene, folder)
    objects = [add_object(collection, folder, source) for source in scene.objects]
    # The ground's light is wanted without the objects in front of it, but with their shadows.
    if options.engine == "cycles":
        compat.layer_collection(shadow_scene.view_layers[0], collection.name).indirect_only = True
    if bake is not None:
        for target, cache in zip(objects, bake.caches, strict=True):
            caches.attach(target.item, cache, bake.first_frame)
    return BlenderScene(
        folder=folder,
        options=options,
        objects=objects,
        collection=collection,
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
