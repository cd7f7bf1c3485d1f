# SPDX-License-Identifier: GPL-3.0-or-later
"""Objects of Gaussian splats into a Blender scene: each as the body that is simulated and the splats that are seen."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.errors import InputError
from ...sim.gaussians.moving import placed
from ...sim.gaussians.ply.read import read_splats
from ...sim.gaussians.splats import Splats
from ...sim.scene.folder import SceneFolder, load_scene
from ...sim.scene.glb import TexturedMesh, read_textured_mesh
from ...sim.scene.model import Ground, SceneObject
from . import compat, import_objects, import_physics, splats

COLOURS = "colour"


def read_object_splats(folder: SceneFolder, source: SceneObject) -> Splats | None:
    """The splats of ``source`` in the coordinates of its mesh file; None without. Raises InputError."""
    return None if source.splats is None else read_splats(folder.file(source.splats))


def add_splats(item: bpy.types.Object, source: SceneObject, seen: Splats) -> bpy.types.Object:
    """Give the imported ``item`` the splats ``seen`` of ``source``, in the coordinates of its mesh file."""
    matrix = np.array(item.matrix_world.inverted()) @ np.asarray(source.world_from_mesh)
    return splats.add(item, placed(seen, matrix))


def import_splats(scene: bpy.types.Scene, root: Path) -> list[bpy.types.Object]:
    """Add the objects with splats of the scene folder ``root`` to ``scene``, simulated, at its cursor; these objects.

    Nothing else of the scene changes but how many transparent surfaces Cycles looks through. Raises InputError when
    anything is missing or not readable, or nothing in the folder has splats; then nothing has changed.
    """
    folder = load_scene(root)
    read = []
    for source in folder.scene.objects:
        seen = read_object_splats(folder, source)
        if seen is not None:
            read.append((source, read_textured_mesh(folder.file(source.mesh)), seen))
    if not read:
        raise InputError(f"{root}: no object in it has splats; import a PLY file of splats")
    items, notes = [], []
    for source, mesh, seen in read:
        item = _add_body(scene, source, mesh)
        import_physics.fill_body(scene, scene.collection, item, source, folder.scene.ground or Ground(), notes)
        # Of the folder and of nobody's here: it is no photo's scene.
        item.physgen.source = ""
        add_splats(item, source, seen)
        item.matrix_world = Matrix.Translation(scene.cursor.location) @ item.matrix_world
        items.append(item)
    splats.allow_transparency(scene)
    return items


def _add_body(scene: bpy.types.Scene, source: SceneObject, mesh: TexturedMesh) -> bpy.types.Object:
    matrix = np.asarray(source.world_from_mesh)
    vertices = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    faces = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
    centre = import_objects.centre_of_mass(vertices, faces).astype(np.float32).astype(np.float64)
    data = bpy.data.meshes.new(source.name)
    import_objects.fill_mesh(data, vertices - centre, faces)
    data.shade_smooth()
    if mesh.colours is not None:
        _colour(data, mesh.colours)
    item = bpy.data.objects.new(source.name, data)
    item.matrix_world = Matrix.Translation(centre.tolist())
    scene.collection.objects.link(item)
    return item


def _colour(data: bpy.types.Mesh, colours: NDArray[np.float64]) -> None:
    """Let ``data`` wear ``colours`` (V, 3), linear, as a matt material."""
    attribute = data.color_attributes.new(COLOURS, "FLOAT_COLOR", "POINT")
    rows = np.concatenate([colours, np.ones((len(colours), 1))], axis=1)
    attribute.data.foreach_set("color", rows.astype(np.float32).ravel())
    material = bpy.data.materials.new(data.name)
    tree = compat.node_tree(material)
    source, matt, output = (
        tree.nodes.new(f"ShaderNode{kind}") for kind in ("Attribute", "BsdfDiffuse", "OutputMaterial")
    )
    source.attribute_name = COLOURS
    tree.links.new(source.outputs["Color"], matt.inputs["Color"])
    tree.links.new(matt.outputs[0], output.inputs["Surface"])
    data.materials.append(material)
