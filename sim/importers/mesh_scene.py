# SPDX-License-Identifier: MIT
"""Mesh files become a scene without a photo: it can be baked, analysed and opened in Blender."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..atomic import replacing
from ..errors import InputError
from ..scene.folder import Scene, inside, load_scene, save_scene, side_files
from ..scene.material import load_preset
from ..scene.meshes import read_mesh
from ..scene.model import Camera, SceneModel, SceneObject, Vector

CAMERA_SIZE = 512
"""Pixels a side of the camera, which nothing is rendered with until the user sets one."""


def scene_from_meshes(
    meshes: Mapping[str, str | Path],
    *,
    out: str | Path,
    presets: Sequence[str] = ("medium",),
    velocities: Sequence[Vector] = (),
    colliders: Sequence[str] = (),
) -> Scene:
    """Return a scene of mesh files as the new folder ``out``: world metres, Z up, ground at z = 0, no photo.

    meshes: name → OBJ, glTF, GLB, PLY or STL file, in world coordinates; materials, textures and buffers in the same
    folder or below are copied with it. presets: material presets in the order of
    ``meshes``; a single one goes to all. velocities: m/s, at rest where the list ends. colliders: names of those that
    stay in place.

    >>> import physgen
    >>> scene = physgen.scene_from_meshes({"ball": "ball.obj"}, out="scene", presets=["rubber"])  # doctest: +SKIP

    Raises InputError for unreadable meshes, unknown presets or names, and a folder that is not empty; nothing is
    written then.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is not empty; choose a new folder for the scene")
    if not 1 <= len(presets) <= max(1, len(meshes)):
        raise InputError(f"presets: {len(presets)} given for {len(meshes)} meshes; give one for all or one per mesh")
    if unknown := [name for name in colliders if name not in meshes]:
        raise InputError(f"colliders: there is no mesh {unknown[0]!r}; choose some of {', '.join(meshes)}")
    objects, extent = [], 0.0
    for index, (name, source) in enumerate(meshes.items()):
        mesh = read_mesh(Path(source))
        size = float(np.ptp(np.asarray(mesh.vertices), axis=0).max())
        extent = max(extent, size, float(np.abs(mesh.vertices).max()))
        objects.append(
            SceneObject(
                name=name,
                mesh=_mesh_name(name, Path(source)),
                size_m=size,
                role="collider" if name in colliders else "dynamic",
                material=load_preset(presets[index if len(presets) > 1 else 0]),
                velocity=velocities[index] if index < len(velocities) else (0.0, 0.0, 0.0),
            )
        )
    scene = SceneModel(camera=overview_camera(extent), objects=tuple(objects), photo=None, background=None)
    with replacing(out) as folder:
        folder.mkdir()
        for item, source in zip(objects, map(Path, meshes.values()), strict=True):
            _copy_mesh(source, inside(folder, item.mesh))
        save_scene(folder, scene)
        if out.is_dir():
            # Empty, as checked above; Windows does not rename onto a folder.
            out.rmdir()
    return load_scene(out)


def _copy_mesh(source: Path, target: Path) -> None:
    """Copy a mesh file with the materials, textures and buffers that it names (``side_files``)."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    for name in side_files(source):
        beside = target.parent / name
        beside.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source.parent / name, beside)


def _mesh_name(name: str, source: Path) -> str:
    """Return the mesh's file name in the scene; a folder of its own keeps apart materials that share a name."""
    folder = f"meshes/{name}" if side_files(source) else "meshes"
    return f"{folder}/{name}{source.suffix.lower()}"


def overview_camera(extent: float) -> Camera:
    """A camera that looks at the origin from behind (-Y) and above, far enough for ``extent`` (m)."""
    pose = (
        (1.0, 0.0, 0.0, 0.0),
        (0.0, -0.5, 0.866, -3 * extent),
        (0.0, -0.866, -0.5, 2 * extent),
        (0.0, 0.0, 0.0, 1.0),
    )
    half = CAMERA_SIZE / 2
    return Camera(
        width=CAMERA_SIZE, height=CAMERA_SIZE, fx=CAMERA_SIZE, fy=CAMERA_SIZE, cx=half, cy=half, world_from_camera=pose
    )
