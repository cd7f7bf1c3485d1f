# SPDX-License-Identifier: GPL-3.0-or-later
"""The objects of a scene folder as textured Blender objects that look like the photo, without any light.

An object's origin is its centre of mass and its axes are the world's, so that gizmos and transforms mean something;
vertices keep their order in the file. The render stage has materials of its own (``objects.py``).
"""

from __future__ import annotations

from pathlib import PurePosixPath

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.scene.folder import SceneFolder
from ...sim.scene.glb import TexturedMesh
from ...sim.scene.model import SceneObject
from . import compat
from .camera import photo_uv
from .import_view import Made, load_picture

UV = "photo"


def add_object(
    made: Made, collection: bpy.types.Collection, folder: SceneFolder, source: SceneObject, mesh: TexturedMesh
) -> bpy.types.Object:
    """``source`` with the read ``mesh``, linked to ``collection``. Raises InputError for a picture that is none."""
    matrix = np.asarray(source.world_from_mesh)
    vertices = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    faces = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
    # As Blender keeps it, or vertices would come back shifted by what rounding took.
    centre = centre_of_mass(vertices, faces).astype(np.float32).astype(np.float64)
    data = made.add(bpy.data.meshes.new(source.name))
    fill_mesh(data, vertices - centre, faces)
    uv, picture, albedo = _appearance(made, folder, source, mesh, vertices)
    data.uv_layers.new(name=UV).data.foreach_set("uv", uv[faces.ravel()].astype(np.float32).ravel())
    data.shade_smooth()
    data.materials.append(_material(made, source.name, picture, albedo))
    item = made.add(bpy.data.objects.new(source.name, data))
    item.matrix_world = Matrix.Translation(centre.tolist())
    collection.objects.link(item)
    return item


def centre_of_mass(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Centre (3,) of the solid inside; the middle of its box where the surface encloses nothing."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2
    corners = (vertices - middle)[faces]
    volumes = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total = float(volumes.sum())
    if abs(total) <= 1e-6 * float(np.prod(high - low)):
        return np.asarray(middle)
    centre = middle + (corners.sum(axis=1) * volumes[:, None]).sum(axis=0) / (4 * total)
    # Of a surface with holes the formula can name any place.
    return np.asarray(centre if (low <= centre).all() and (centre <= high).all() else middle)


def fill_mesh(data: bpy.types.Mesh, vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> None:
    """Give the empty mesh ``data`` the ``vertices`` (V, 3) and triangles ``faces`` (T, 3)."""
    data.vertices.add(len(vertices))
    data.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    data.loops.add(faces.size)
    data.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
    data.polygons.add(len(faces))
    data.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    data.update(calc_edges=True)


def _appearance(
    made: Made, folder: SceneFolder, source: SceneObject, mesh: TexturedMesh, vertices: NDArray[np.float64]
) -> tuple[NDArray[np.float64], bpy.types.Image, bpy.types.Image]:
    """Texture coordinates (V, 2), picture and albedo.

    A mesh without a picture wears the photo, projected along the camera's rays. The albedo is
    ``albedo/NAME.png`` for ``meshes/NAME.glb``, laid out as its picture; without one, the picture.
    """
    if mesh.uv is not None and mesh.picture is not None:
        image = made.add(bpy.data.images.new(source.name, 1, 1))
        image.pack(data=mesh.picture, data_len=len(mesh.picture))
        image.source = "FILE"
        if not image.size[0] or not image.size[1]:
            raise InputError(f"object {source.name}: the picture in {source.mesh} is not readable; export it again")
        path = folder.file(f"albedo/{PurePosixPath(source.mesh).stem}.png")
        return mesh.uv, image, load_picture(made, path) if path.is_file() else image
    image = load_picture(made, folder.file(folder.scene.photo))
    return photo_uv(folder.scene.camera, vertices), image, image


def _material(made: Made, name: str, picture: bpy.types.Image, albedo: bpy.types.Image) -> bpy.types.Material:
    """The photo's colours as they are towards the camera; towards everything else a matt surface that gives no light.

    So the ground gets a shadow and no glow, and the first frame is the photo. The matt surface has the ``albedo``, for
    the photo's own light is already in the ``picture``; both have the same texture coordinates.
    """
    material = made.add(bpy.data.materials.new(name))
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"
    tree = compat.node_tree(material)
    kinds = ("TexImage", "LightPath", "BsdfDiffuse", "Emission", "MixShader", "OutputMaterial")
    texture, path, matt, photo, mix, output = (tree.nodes.new(f"ShaderNode{kind}") for kind in kinds)
    texture.image, texture.extension = picture, "EXTEND"
    texture.label, photo.label, matt.label = "Photo", "Seen by the camera", "Seen by the light"
    lit = texture
    if albedo != picture:
        lit = tree.nodes.new("ShaderNodeTexImage")
        lit.image, lit.extension, lit.label, lit.location = albedo, "EXTEND", "Albedo", (-900, 0)
    tree.links.new(lit.outputs["Color"], matt.inputs["Color"])
    tree.links.new(texture.outputs["Color"], photo.inputs["Color"])
    tree.links.new(path.outputs["Is Camera Ray"], mix.inputs[0])
    tree.links.new(matt.outputs[0], mix.inputs[1])
    tree.links.new(photo.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    for column, node in enumerate((texture, matt, photo, path, mix, output)):
        node.location = (300 * (column // 2) - 600, -320 * (column % 2))
    # The texture that Solid mode shows.
    tree.nodes.active = texture
    return material
