# SPDX-License-Identifier: GPL-3.0-or-later
"""Import of a scene folder, or of Gaussian splat files: through the imported camera one sees the photo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...sim.effects.registry import effect
from ...sim.errors import InputError
from ...sim.gaussians.splat_ply import read_splats
from ...sim.gaussians.splats import Splats, transform_splats
from ...sim.picture_header import require_picture_bytes
from ...sim.scene.folder import SCENE_FILE, Scene, load_scene
from ...sim.scene.model import Ground, SceneObject
from ...sim.scene.textured_mesh import TexturedMesh, read_textured_mesh
from .. import compat
from ..playback import splat_clouds
from . import import_physics, photo_view
from .photo_view import MARK, Made, load_picture, photo_uv

UV = "photo"


def add_object(
    made: Made, collection: bpy.types.Collection, folder: Scene, source: SceneObject, mesh: TexturedMesh
) -> bpy.types.Object:
    """Return ``source`` as an object with ``mesh``, linked to ``collection``. Raises InputError for an unreadable
    texture.
    """
    matrix = np.asarray(source.world_from_mesh)
    vertices = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    faces = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
    # Rounded as Blender stores it, else vertices would come back shifted.
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
    """Return the centre of mass (3,) of the enclosed solid; the bounding box centre if the surface encloses nothing."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2
    corners = (vertices - middle)[faces]
    volumes = np.einsum("ti,ti->t", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    total = float(volumes.sum())
    if abs(total) <= 1e-6 * float(np.prod(high - low)):
        return np.asarray(middle)
    centre = middle + (corners.sum(axis=1) * volumes[:, None]).sum(axis=0) / (4 * total)
    # For a surface with holes the formula may return any point.
    return np.asarray(centre if (low <= centre).all() and (centre <= high).all() else middle)


def fill_mesh(data: bpy.types.Mesh, vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> None:
    """Fill the empty mesh ``data`` with ``vertices`` (V, 3) and triangles ``faces`` (T, 3)."""
    data.vertices.add(len(vertices))
    data.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    data.loops.add(faces.size)
    data.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
    data.polygons.add(len(faces))
    data.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    data.update(calc_edges=True)


def _appearance(
    made: Made, folder: Scene, source: SceneObject, mesh: TexturedMesh, vertices: NDArray[np.float64]
) -> tuple[NDArray[np.float64], bpy.types.Image, bpy.types.Image]:
    """Return texture coordinates (V, 2), image and albedo.

    A mesh without a texture gets the photo, projected along the camera's rays. The albedo is ``albedo/NAME.png`` for
    ``meshes/NAME.glb``, in the same layout; without one, the texture itself.
    """
    if mesh.uv is not None and mesh.picture is not None:
        require_picture_bytes(mesh.picture, f"object {source.name}: the picture in {source.mesh}")
        image = made.add(bpy.data.images.new(source.name, 1, 1))
        image.pack(data=mesh.picture, data_len=len(mesh.picture))
        image.source = "FILE"
        if not image.size[0] or not image.size[1]:
            raise InputError(f"object {source.name}: the picture in {source.mesh} is not readable; export it again")
        path = folder.file(f"albedo/{PurePosixPath(source.mesh).stem}.png")
        return mesh.uv, image, load_picture(made, path) if path.is_file() else image
    image = load_picture(made, folder.file(folder.model.photo_files[0]))
    return photo_uv(folder.model.camera, vertices), image, image


def _material(made: Made, name: str, picture: bpy.types.Image, albedo: bpy.types.Image) -> bpy.types.Material:
    """Return a material that shows the photo's colours to the camera and is a matte, non-emitting surface to other
    rays.

    So the ground receives a shadow but no glow, and the first frame equals the photo. The matte surface has the
    ``albedo``, because the ``picture`` contains the photo's light; both share texture coordinates.
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
    # The texture shown in Solid mode.
    tree.nodes.active = texture
    return material


COLOURS = "colour"


def read_object_splats(folder: Scene, source: SceneObject) -> Splats | None:
    """Return the splats of ``source`` in mesh coordinates; None without. Raises InputError."""
    return None if source.splats is None else read_splats(folder.file(source.splats))


def add_splats(item: bpy.types.Object, source: SceneObject, seen: Splats) -> bpy.types.Object:
    """Add the splats ``seen`` of ``source``, in mesh coordinates, to the imported ``item``."""
    matrix = np.array(item.matrix_world.inverted()) @ np.asarray(source.world_from_mesh)
    return splat_clouds.add(item, transform_splats(seen, matrix))


def import_splats(scene: bpy.types.Scene, root: Path) -> list[bpy.types.Object]:
    """Add the splat objects of the scene folder ``root`` to ``scene``, simulated, at its cursor; return them.

    Apart from that only Cycles' limit of transparent bounces changes. Raises InputError if anything is missing or
    unreadable, or the folder has no splats; then nothing has changed.
    """
    folder = load_scene(root)
    read = []
    for source in folder.model.objects:
        seen = read_object_splats(folder, source)
        if seen is not None:
            read.append((source, read_textured_mesh(folder.file(source.mesh)), seen))
    if not read:
        raise InputError(f"{root}: no object in it has splats; import a PLY file of splats")
    items: list[bpy.types.Object] = []
    notes: list[str] = []
    for source, mesh, seen in read:
        item = _add_body(scene, source, mesh)
        import_physics.fill_body(scene, scene.collection, item, source, folder.model.ground or Ground(), notes)
        # Not linked to a scene's photo.
        item.physgen.source = ""
        add_splats(item, source, seen)
        item.matrix_world = Matrix.Translation(scene.cursor.location) @ item.matrix_world
        items.append(item)
    splat_clouds.allow_transparency(scene)
    return items


def _add_body(scene: bpy.types.Scene, source: SceneObject, mesh: TexturedMesh) -> bpy.types.Object:
    matrix = np.asarray(source.world_from_mesh)
    vertices = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    faces = mesh.faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else mesh.faces
    centre = centre_of_mass(vertices, faces).astype(np.float32).astype(np.float64)
    data = bpy.data.meshes.new(source.name)
    fill_mesh(data, vertices - centre, faces)
    data.shade_smooth()
    if mesh.colours is not None:
        _colour(data, mesh.colours)
    item = bpy.data.objects.new(source.name, data)
    item.matrix_world = Matrix.Translation(centre.tolist())
    scene.collection.objects.link(item)
    return item


def _colour(data: bpy.types.Mesh, colours: NDArray[np.float64]) -> None:
    """Give ``data`` the vertex colours (V, 3), linear, as a matte material."""
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


NOTES = "physgen_notes"
"""Custom property of the collection: notes about what Blender does not show, one sentence a line."""


@dataclass(frozen=True)
class _Read:
    """A scene folder in memory."""

    folder: Scene
    meshes: tuple[TexturedMesh, ...]
    splats: tuple[Splats | None, ...]


def scene_root(path: Path) -> Path:
    """Return the scene folder of ``path``, a folder or its scene.json. Raises InputError if it is none."""
    if not path.exists():
        raise InputError(f"{path}: there is no such file or folder; choose a PhysGen scene folder")
    root = path if path.is_dir() else path.parent
    if path.is_file() and path.name != SCENE_FILE:
        raise InputError(f"{path.name}: is no scene; choose the file {SCENE_FILE} of a PhysGen scene folder")
    if not (root / SCENE_FILE).is_file():
        raise InputError(f"{path}: there is no {SCENE_FILE} in it; choose a PhysGen scene folder")
    return root


def import_scene(scene: bpy.types.Scene, root: Path) -> bpy.types.Collection:
    """Import the scene folder ``root`` (or its scene.json) into ``scene``; return the collection of all new objects.

    Camera, resolution, world and gravity become the scene's, objects get their ``physgen`` properties, and an earlier
    import in the scene is removed. Raises InputError if anything is missing or unreadable; then nothing has changed.
    ``import_notes`` lists what could not be imported.
    """
    read = _read(scene_root(root))
    made = photo_view.Made()
    try:
        collection = made.add(bpy.data.collections.new(f"PhysGen {read.folder.root.resolve().name}"))
        items = [
            add_object(made, collection, read.folder, source, mesh)
            for source, mesh in zip(read.folder.model.objects, read.meshes, strict=True)
        ]
        for item, source, seen in zip(items, read.folder.model.objects, read.splats, strict=True):
            if seen is not None:
                made.add(add_splats(item, source, seen))
        view = photo_view.build(made, collection, read.folder, items)
    except BaseException:
        made.remove()
        raise
    old = scene.physgen.photo_root
    scene.collection.children.link(collection)
    photo_view.show(scene, collection, view, read.folder.model.camera)
    if any(seen is not None for seen in read.splats):
        splat_clouds.allow_transparency(scene)
    notes = import_physics.apply_physics(scene, collection, read.folder.model, items, view.ground)
    for item in collection.all_objects:
        item[MARK] = True
    if old is not None:
        remove_import(scene, old)
    # Without the ".001" caused by an earlier import; none of these names has a full stop.
    for named in (view.world, *(owner for item in collection.all_objects for owner in (item, item.data) if owner)):
        named.name = named.name.split(".")[0]
    state = scene.physgen
    state.photo_root, state.folder, state.simulation.bake = collection, _stored(read.folder.root), ""
    collection[NOTES] = "\n".join(notes)
    return collection


def import_notes(collection: bpy.types.Collection) -> list[str]:
    """Return notes about what of the scene folder is not in Blender."""
    return [line for line in collection.get(NOTES, "").splitlines() if line]


def remove_import(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Delete what an import created and nothing else uses; what users added to its collection stays in ``scene``."""
    data: set[bpy.types.ID] = set()
    for item in list(collection.all_objects):
        if MARK in item:
            data |= photo_view.data_of(item)
            bpy.data.objects.remove(item)
        elif item.name not in scene.collection.objects:
            scene.collection.objects.link(item)
    for child in list(collection.children):
        if child.name not in scene.collection.children:
            scene.collection.children.link(child)
    bpy.data.collections.remove(collection)
    data |= {world for world in bpy.data.worlds if MARK in world}
    photo_view.remove_unused(data)


def _read(root: Path) -> _Read:
    folder = load_scene(root)
    if folder.model.photo is None:
        raise InputError(
            f"{root}: is a scene without a photo, as a bake in Blender leaves it; open the .blend that it comes from"
        )
    for entry in folder.model.effects:
        known = effect(entry.name)
        try:
            known.checked({**known.defaults, **dict(entry.parameters)})
        except InputError as error:
            raise InputError(f"effect {entry.name!r}: {error}") from None
    meshes, seen = [], []
    for item in folder.model.objects:
        try:
            meshes.append(read_textured_mesh(folder.file(item.mesh)))
            seen.append(read_object_splats(folder, item))
        except InputError as error:
            raise InputError(f"object {item.name}: {error}") from None
    return _Read(folder=folder, meshes=tuple(meshes), splats=tuple(seen))


def _stored(root: Path) -> str:
    """Return ``root`` as stored in the .blend: relative if it lies beside or below the file, so that both can move."""
    root = root.resolve()
    if bpy.data.filepath:
        beside = Path(bpy.data.filepath).resolve().parent
        if root.is_relative_to(beside):
            return "//" + root.relative_to(beside).as_posix()
    return str(root)
