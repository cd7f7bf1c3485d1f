# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene's objects as Blender meshes whose material gives colour and light separately (docs/rendering.md).

The surface reflects light over rest light, L / L₀, without colour, so that what is denoised is smooth; the photo's
colour goes into a pass of its own, averaged over the pixel and untouched by the denoiser.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from ...sim.scene.folder import SceneFolder
from ...sim.scene.meshes import ObjectMesh, load_object_mesh, read_mesh
from ...sim.scene.model import SceneObject
from . import compat
from .camera import photo_uv

REST_LIGHT = "rest_light"
"""Colour attribute at the vertices: L₀ + k, radiance of a white surface at rest plus the ambient term."""
COLOUR_LAYER = "texture"
"""Name of the pass that holds the photo's colours."""
AMBIENT_NODE = "ambient"
UV = "photo"
"""Name of the texture coordinates."""


@dataclass(frozen=True)
class RenderObject:
    """One object. ``mesh`` holds the rest positions in world metres; ``item`` is its Blender object."""

    source: SceneObject
    mesh: ObjectMesh
    item: bpy.types.Object


def add_object(collection: bpy.types.Collection, folder: SceneFolder, source: SceneObject) -> RenderObject:
    """Load ``source`` and link it to ``collection``. Raises InputError when its mesh cannot be read."""
    mesh = load_object_mesh(folder, source)
    uv, image = _appearance(folder, source, mesh)
    data = bpy.data.meshes.new(source.name)
    data.from_pydata(mesh.vertices, [], mesh.faces)
    corners = np.empty(len(data.loops), dtype=np.int32)
    data.loops.foreach_get("vertex_index", corners)
    data.uv_layers.new(name=UV).data.foreach_set("uv", uv.astype(np.float32)[corners].ravel())
    data.shade_smooth()
    attribute = data.color_attributes.new(REST_LIGHT, "FLOAT_COLOR", "POINT")
    attribute.data.foreach_set("color", np.ones(4 * len(mesh.vertices), dtype=np.float32))
    data.color_attributes.active_color = attribute
    data.materials.append(_material(source.name, image))
    item = bpy.data.objects.new(source.name, data)
    collection.objects.link(item)
    return RenderObject(source=source, mesh=mesh, item=item)


def set_rest_light(target: RenderObject, values: NDArray[np.floating], ambient: float) -> None:
    """Set L₀ + k (V, 3) at the vertices and the ambient term k, both radiances."""
    data = target.item.data
    padded = np.concatenate([values, np.ones((len(values), 1))], axis=1).astype(np.float32)
    data.color_attributes[REST_LIGHT].data.foreach_set("color", padded.ravel())
    data.materials[0].node_tree.nodes[AMBIENT_NODE].inputs["Scale"].default_value = ambient
    data.update_tag()


def get_rest_light(target: RenderObject) -> NDArray[np.float64]:
    """The attribute (V, 3)."""
    values = np.empty(4 * len(target.mesh.vertices), dtype=np.float32)
    target.item.data.color_attributes[REST_LIGHT].data.foreach_get("color", values)
    return values.reshape(-1, 4)[:, :3].astype(np.float64)


def _appearance(
    folder: SceneFolder, source: SceneObject, mesh: ObjectMesh
) -> tuple[NDArray[np.float64], bpy.types.Image]:
    """Texture coordinates (V, 2) with the origin at the bottom left, and the image.

    A mesh without a texture of its own wears the photo, projected along the camera's rays.
    """
    visual = read_mesh(folder.file(source.mesh)).visual
    uv, image = getattr(visual, "uv", None), _base_colour(visual)
    if uv is not None and image is not None and len(uv) == len(mesh.vertices) and np.isfinite(uv).all():
        return np.asarray(uv, dtype=np.float64), _load_image(source.name, image.convert("RGB"))
    with Image.open(folder.file(folder.scene.photo)) as photo:
        return photo_uv(folder.scene.camera, mesh.vertices), _load_image(source.name, photo.convert("RGB"))


def _base_colour(visual: trimesh.visual.base.Visuals) -> Image.Image | None:
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return image if isinstance(image, Image.Image) else None


def _load_image(name: str, image: Image.Image) -> bpy.types.Image:
    """A packed Blender image, so that a saved .blend needs no file beside it."""
    with tempfile.TemporaryDirectory(prefix="physgen-") as folder:
        path = Path(folder) / "texture.png"
        image.save(path, compress_level=0)
        loaded = bpy.data.images.load(str(path))
        loaded.colorspace_settings.name = "sRGB"
        loaded.alpha_mode = "NONE"
        loaded.pack()
    loaded.name = name
    return loaded


def _material(name: str, image: bpy.types.Image) -> bpy.types.Material:
    """Diffuse with albedo 1 / (L₀ + k) plus emission k / (L₀ + k): its radiance is (L + k) / (L₀ + k), 1 at rest."""
    material = bpy.data.materials.new(name)
    # It glows only towards the camera: emission that Cycles would sample as a lamp costs time and adds noise.
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"
    tree = compat.node_tree(material)
    new, link = tree.nodes.new, tree.links.new
    rest = new("ShaderNodeAttribute")
    rest.attribute_name = REST_LIGHT
    inverse = new("ShaderNodeVectorMath")
    inverse.operation = "DIVIDE"
    inverse.inputs[0].default_value = (1.0, 1.0, 1.0)
    link(rest.outputs["Color"], inverse.inputs[1])
    ambient = new("ShaderNodeVectorMath")
    ambient.operation = "SCALE"
    ambient.name = AMBIENT_NODE
    ambient.inputs["Scale"].default_value = 0.0
    link(inverse.outputs["Vector"], ambient.inputs[0])
    diffuse, emission, both = (new(f"ShaderNode{kind}") for kind in ("BsdfDiffuse", "Emission", "AddShader"))
    link(inverse.outputs["Vector"], diffuse.inputs["Color"])
    link(ambient.outputs["Vector"], emission.inputs["Color"])
    link(diffuse.outputs["BSDF"], both.inputs[0])
    link(emission.outputs["Emission"], both.inputs[1])
    output = new("ShaderNodeOutputMaterial")
    link(both.outputs["Shader"], output.inputs["Surface"])
    texture = new("ShaderNodeTexImage")
    texture.image = image
    # A pixel averages whole texels by area, so that at rest it shows the photo's pixel and no blend with others.
    texture.interpolation = "Closest"
    texture.extension = "EXTEND"
    colour = new("ShaderNodeOutputAOV")
    colour.aov_name = COLOUR_LAYER
    link(texture.outputs["Color"], colour.inputs["Color"])
    return material
