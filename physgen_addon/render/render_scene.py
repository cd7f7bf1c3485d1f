# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene folder and its bake as three Blender scenes: objects, ground, and the light on both."""

from __future__ import annotations

import contextlib
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...sim.atomic import scratch_prefix
from ...sim.plane_axes import plane_axes
from ...sim.scene.folder import Scene, require_photo
from ...sim.scene.meshes import ObjectMesh, load_object_mesh, read_mesh
from ...sim.scene.model import Camera, Ground, SceneObject
from ...sim.scene.shading import factors_at, read_shading
from ...sim.srgb import read_rgb
from .. import compat
from ..playback import point_caches
from ..scene_io.photo_view import add_camera, aim_camera, photo_uv, render_size
from . import render_engines
from .object_material import (
    AMBIENT_NODE,
    COLOUR_LAYER,
    LACK_LAYER,
    REST_LIGHT,
    object_material,
    photo_highlights,
    show_highlights,
)
from .render_options import RenderOptions
from .render_regions import Box
from .scene_light import add_environment, add_lamps

UV = "photo"
"""Name of the texture coordinates."""


@dataclass(frozen=True)
class RenderObject:
    """One object. ``mesh`` holds the rest positions in world metres; ``item`` is its Blender object; ``shading`` (V, 3)
    how much brighter than evenly lit its texture is at the vertices."""

    source: SceneObject
    mesh: ObjectMesh
    item: bpy.types.Object
    shading: NDArray[np.float64]


def add_object(collection: bpy.types.Collection, folder: Scene, source: SceneObject) -> RenderObject:
    """Load ``source`` and link it to ``collection``. Raises InputError if its mesh or a picture is unreadable."""
    mesh = load_object_mesh(folder, source)
    uv, picture = _appearance(folder, source, mesh)
    data = bpy.data.meshes.new(source.name)
    data.from_pydata(mesh.vertices, [], mesh.faces)
    corners = np.empty(len(data.loops), dtype=np.int32)
    data.loops.foreach_get("vertex_index", corners)
    data.uv_layers.new(name=UV).data.foreach_set("uv", uv.astype(np.float32)[corners].ravel())
    data.shade_smooth()
    attribute = data.color_attributes.new(REST_LIGHT, "FLOAT_COLOR", "POINT")
    attribute.data.foreach_set("color", np.ones(4 * len(mesh.vertices), dtype=np.float32))
    data.color_attributes.active_color = attribute
    data.materials.append(object_material(source.name, _load_image(source.name, picture)))
    texture = np.asarray(picture.convert("RGB"), dtype=np.uint8)
    found = photo_highlights(folder.model.camera, mesh, uv, texture)
    if found is not None:
        matt = Image.fromarray(found.taken_out(texture))
        show_highlights(data, folder.model.camera, found, _load_image(f"{source.name} matt", matt))
    item = bpy.data.objects.new(source.name, data)
    collection.objects.link(item)
    shading = read_shading(folder, source)
    factors = np.ones_like(mesh.vertices) if shading is None else factors_at(shading, uv)
    return RenderObject(source=source, mesh=mesh, item=item, shading=factors)


def set_rest_light(target: RenderObject, values: NDArray[np.floating], ambient: float) -> None:
    """Set L₀ + k (V, 3) at the vertices and the ambient term k, both radiances."""
    data = target.item.data
    padded = np.concatenate([values, np.ones((len(values), 1))], axis=1).astype(np.float32)
    data.color_attributes[REST_LIGHT].data.foreach_set("color", padded.ravel())
    data.materials[0].node_tree.nodes[AMBIENT_NODE].inputs["Scale"].default_value = ambient
    data.update_tag()


def get_rest_light(target: RenderObject) -> NDArray[np.float64]:
    """Return L₀ + k (V, 3) at the vertices."""
    values = np.empty(4 * len(target.mesh.vertices), dtype=np.float32)
    target.item.data.color_attributes[REST_LIGHT].data.foreach_get("color", values)
    return values.reshape(-1, 4)[:, :3].astype(np.float64)


def texture_coordinates(target: RenderObject) -> NDArray[np.float32]:
    """Return the texture coordinates (V, 2) at the vertices, origin at the bottom left."""
    skin = target.item.data
    corners = np.empty(len(skin.loops), dtype=np.int32)
    skin.loops.foreach_get("vertex_index", corners)
    by_corner = np.empty(2 * len(corners), dtype=np.float32)
    skin.uv_layers[UV].data.foreach_get("uv", by_corner)
    uv = np.zeros((len(target.mesh.vertices), 2), dtype=np.float32)
    uv[corners] = by_corner.reshape(-1, 2)
    return uv


def texture_colours(target: RenderObject, uv: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the sRGB colours (N, 3) of the texture of ``target`` at the texture coordinates ``uv`` (N, 2)."""
    material = target.item.data.materials[0]
    image = next(node for node in material.node_tree.nodes if node.type == "TEX_IMAGE").image
    width, height = image.size
    pixels = np.empty(4 * width * height, dtype=np.float32)
    image.pixels.foreach_get(pixels)
    columns = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    rows = np.clip((uv[:, 1] * height).astype(int), 0, height - 1)
    # The pixels of an 8-bit image are as stored: sRGB.
    return np.rint(pixels.reshape(height, width, 4)[rows, columns, :3] * 255.0).astype(np.uint8)


def _appearance(folder: Scene, source: SceneObject, mesh: ObjectMesh) -> tuple[NDArray[np.float64], Image.Image]:
    """Return texture coordinates (V, 2), origin at the bottom left, and the image.

    A mesh without a texture gets the photo, projected along the camera's rays.
    """
    visual = read_mesh(folder.file(source.mesh)).visual
    uv, image = getattr(visual, "uv", None), _base_colour(visual)
    if uv is not None and image is not None and len(uv) == len(mesh.vertices) and np.isfinite(uv).all():
        return np.asarray(uv, dtype=np.float64), image
    photo = Image.fromarray(read_rgb(folder.file(folder.model.photo_files[0])))
    return photo_uv(folder.model.camera, mesh.vertices), photo


def _base_colour(visual: Any) -> Image.Image | None:
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return image if isinstance(image, Image.Image) else None


def _load_image(name: str, image: Image.Image) -> bpy.types.Image:
    """Return a packed Blender image, so that a saved .blend needs no file beside it."""
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as folder:
        path = Path(folder) / "texture.png"
        soft = image.mode == "RGBA"
        (image if soft else image.convert("RGB")).save(path, compress_level=0)
        loaded = bpy.data.images.load(str(path))
        loaded.colorspace_settings.name = "sRGB"
        # Colours below a soft outline are whole, not premultiplied.
        loaded.alpha_mode = "CHANNEL_PACKED" if soft else "NONE"
        loaded.pack()
    loaded.name = name
    return loaded


ALBEDO = 0.8
REACH = 200.0
"""Half the plane's width over the camera's height: beyond, no shadow would be visible."""


def add_ground(scene: bpy.types.Scene, ground: Ground, camera: Camera) -> bpy.types.Object:
    """Add the plane to ``scene``. It receives light but neither blocks it nor is visible to other surfaces.

    Light from below the horizon, which represents the photo's ground, thus reaches the objects as if bounced.
    """
    point, normal = np.asarray(ground.point, dtype=float), np.asarray(ground.normal, dtype=float)
    first, second = plane_axes(normal)
    height = abs(float((camera.position - point) @ normal))
    half = REACH * max(height, 0.1)
    centre = camera.position - ((camera.position - point) @ normal) * normal
    corners = [centre + half * (a * first + b * second) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    mesh = bpy.data.meshes.new("ground")
    mesh.from_pydata([tuple(corner) for corner in corners], [], [(0, 1, 2, 3)])
    mesh.materials.append(_ground_material())
    item = bpy.data.objects.new("ground", mesh)
    item.visible_diffuse = item.visible_glossy = item.visible_transmission = item.visible_shadow = False
    scene.collection.objects.link(item)
    return item


def _ground_material() -> bpy.types.Material:
    material = bpy.data.materials.new("ground")
    tree = compat.node_tree(material)
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    diffuse.inputs["Color"].default_value = (ALBEDO, ALBEDO, ALBEDO, 1.0)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(diffuse.outputs["BSDF"], output.inputs["Surface"])
    return material


@dataclass
class BlenderScene:
    """Result of ``build``. ``open_irradiance``: luminance of the light on the open ground."""

    folder: Scene
    options: RenderOptions
    objects: list[RenderObject]
    collection: bpy.types.Collection
    colour_scene: bpy.types.Scene
    light_scene: bpy.types.Scene
    shadow_scene: bpy.types.Scene
    open_irradiance: float
    first_frame: int
    own: list[bpy.types.ID] = field(default_factory=list)

    def colours(
        self, number: int, box: Box, folder: Path
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Return the objects' colours (h, w, 3), premultiplied, coverage (h, w), and (h, w, 2) what of it their
        textures' alpha leaves uncovered and the highlights of what has turned, in ``box`` at frame ``number``.

        ``folder`` takes temporary files. Raises RenderError if Blender fails.
        """
        if self.options.engine == "eevee":
            side = render_engines.subpixels(self.options)
            return render_engines.colours(self.colour_scene, (COLOUR_LAYER, LACK_LAYER), number, box, side, folder)
        channels = render_engines.render_passes(self.colour_scene, number, box, folder)
        both = np.dstack([channels[f"{LACK_LAYER}.{channel}"] for channel in "RG"])
        return render_engines.stack(channels, COLOUR_LAYER), channels["Combined.A"], both

    def ground_light(self, number: int, box: Box, folder: Path) -> NDArray[np.float32]:
        """Return the light on the ground in ``box`` (h, w, 3) at frame ``number``, with nothing in front of it.

        ``folder`` takes temporary files. Raises RenderError if Blender fails.
        """
        hidden = render_engines.unseen(self.collection) if self.options.engine == "eevee" else contextlib.nullcontext()
        with hidden:
            return render_engines.stack(
                render_engines.render_passes(self.shadow_scene, number, box, folder), "Combined"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the frames."""
        return render_size(self.folder.model.camera, self.options.scale)

    @property
    def drawn_size(self) -> tuple[int, int]:
        """Width and height at which colours are drawn, including subpixels."""
        return _size(self.colour_scene)

    @property
    def light_size(self) -> tuple[int, int]:
        """Width and height at which light is computed."""
        return _size(self.shadow_scene)


def _size(scene: bpy.types.Scene) -> tuple[int, int]:
    return scene.render.resolution_x, scene.render.resolution_y


def build(folder: Scene, bake: point_caches.OpenedBake | None, options: RenderOptions) -> BlenderScene:
    """Build ``folder`` beside the .blend's other contents; with ``bake`` its objects follow their caches.

    Raises InputError for a scene without a photo or ground, and for an unusable mesh, texture, light or cache; nothing
    is left behind then.
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
    """Set the camera of all scenes of ``built`` to ``camera``."""
    for scene in (built.colour_scene, built.light_scene, built.shadow_scene):
        aim_camera(scene, camera)


def remove(built: BlenderScene) -> None:
    """Delete all that ``build`` added."""
    _remove_all(set(built.own))
    built.own = []


def _build(folder: Scene, bake: point_caches.OpenedBake | None, options: RenderOptions) -> BlenderScene:
    scene = folder.model
    colour_scene, light_scene, shadow_scene = scenes = [
        bpy.data.scenes.new(f"PhysGen {name}") for name in ("colours", "light", "shadows")
    ]
    collection = bpy.data.collections.new("PhysGen objects")
    size = render_size(scene.camera, options.scale)
    side = render_engines.subpixels(options) if options.engine == "eevee" else 1
    drawn = (size[0] * side, size[1] * side)
    light_scale = options.scale * options.light_scale_for(max(size))
    for item in scenes:
        item.collection.children.link(collection)
        render_engines.set_up_passes(item)
        add_camera(item, scene.camera, drawn if item is colour_scene else render_size(scene.camera, light_scale))
    for name in (COLOUR_LAYER, LACK_LAYER):
        colour_scene.view_layers[0].aovs.add().name = name
    add_ground(shadow_scene, scene.ground_plane, scene.camera)
    if options.engine == "cycles":
        for item in scenes:
            render_engines.set_up_cycles(item, options, denoise=item is not colour_scene)
        open_irradiance = add_environment([light_scene, shadow_scene], folder)
    else:
        render_engines.set_up_colours(colour_scene, options)
        for item in (light_scene, shadow_scene):
            render_engines.set_up_eevee(item, options)
        open_irradiance = add_lamps(light_scene, shadow_scene, folder)
    objects = [add_object(collection, folder, source) for source in scene.objects]
    # The ground's light without the objects in front of it, but with their shadows.
    if options.engine == "cycles":
        compat.layer_collection(shadow_scene.view_layers[0], collection.name).indirect_only = True
    if bake is not None:
        for target, cache in zip(objects, bake.caches, strict=True):
            point_caches.attach(target.item, cache, bake.first_frame)
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
    """Return all data that ``build`` and its completions can have added."""
    kinds = ("scenes", "collections", "objects", "meshes", "materials", "images", "worlds", "lights", "cameras")
    return {item for kind in (*kinds, "node_groups") for item in getattr(bpy.data, kind)}


def _remove_all(items: set[bpy.types.ID]) -> None:
    if items:
        bpy.data.batch_remove(items)
