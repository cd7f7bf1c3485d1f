# SPDX-License-Identifier: MIT
"""An output folder of PhysGen3D → a scene folder (``sim/scene/physgen3d.py`` says what is read)."""

from __future__ import annotations

import dataclasses
import io
import math
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import PBRMaterial

from ..errors import InputError
from ..events import OnEvent, ignore
from ..reconstruct.output import replacing_folder
from ..reconstruct.photo import load_photo
from ..scene.folder import SceneFolder, load_scene, save_scene
from ..scene.materials import load_preset
from ..scene.matter import Material
from ..scene.meshes import read_mesh
from ..scene.model import Camera, Matrix4, Scene, SceneObject
from ..scene.names import fitting_names
from ..scene.physgen3d import Physgen3dFolder, Physgen3dObject, read_physgen3d

DEFAULT_SIZE_M = 0.15
MAX_SIDE = 8192
"""Pixels; a larger photo is no output of PhysGen3D."""
NEAR = 0.5
"""An object that is this share of its size off the ground is taken to stand on it."""


@dataclasses.dataclass(frozen=True)
class _Placed:
    """camera_from_mesh: (4, 4) in the folder's unit, the object on the ground; vertices: (V, 3) on camera axes."""

    source: Physgen3dObject
    mesh: trimesh.Trimesh
    camera_from_mesh: NDArray[np.float64]
    vertices: NDArray[np.float64]


def import_physgen3d(root: Path, out: Path, *, size_m: float | None = None, on_event: OnEvent = ignore) -> SceneFolder:
    """Turn PhysGen3D's output folder ``root`` into the scene folder ``out``.

    size_m: largest extent of the first object in metres, 1e-4 to 1e3, which sets the scale; None takes 0.15, because
    the folder does not know.

    Objects that stand nearly on the ground are put on it along the camera's rays, so that the picture does not change
    (PhysGen3D moves them along the ground's normal). Raises InputError when something is missing or not readable, or
    ``out`` holds something else than a scene.
    """
    if size_m is not None and not (math.isfinite(size_m) and 1e-4 <= size_m <= 1e3):
        raise InputError(f"size_m is {size_m!r}: give metres from 0.0001 to 1000")
    source = read_physgen3d(root)

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    if size_m is None:
        notice(f"{source.objects[0].name} is taken to be {DEFAULT_SIZE_M:g} m large, the folder does not say")
    photo = load_photo(source.photo, MAX_SIDE).pixels
    height, width = photo.shape[:2]
    if source.background is None:
        notice("there is no inpainted background; the objects stay in the picture behind themselves")
    background = photo if source.background is None else _sized(source.background, width, height)
    placed = [_placed(source, item) for item in source.objects]
    for item in placed:
        if item.camera_from_mesh is item.source.camera_from_mesh:
            notice(f"{item.source.name} does not stand on the ground; it is left where it is")
    world = source.world_from_camera
    first = placed[0].vertices @ world[:3, :3].T
    low, high = first.min(axis=0), first.max(axis=0)
    metres = (size_m or DEFAULT_SIZE_M) / float((high - low).max())
    world[:2, 3] = -(low + high)[:2] / 2
    with replacing_folder(out) as folder:
        for sub in ("masks", "meshes"):
            (folder / sub).mkdir()
        Image.fromarray(photo).save(folder / "photo.png")
        Image.fromarray(background).save(folder / "background.png")
        names = fitting_names([item.source.name for item in placed])
        objects = tuple(
            _write_object(folder, name, item, world, metres, placed) for name, item in zip(names, placed, strict=True)
        )
        for name, item in zip(names, placed, strict=True):
            if item.source.mask is not None:
                mask = _sized(item.source.mask, width, height).mean(axis=2) > 127.5
                Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "masks" / f"{name}.png")
        save_scene(folder, Scene(camera=_camera(source, world, metres, width, height), objects=objects))
    return load_scene(out)


def _placed(folder: Physgen3dFolder, item: Physgen3dObject) -> _Placed:
    mesh = read_mesh(item.mesh)
    matrix = item.camera_from_mesh
    vertices = np.asarray(mesh.vertices, dtype=np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    size = float(np.ptp(vertices, axis=0).max())
    if not np.isfinite(vertices).all() or size < 1e-9:
        raise InputError(f"{item.mesh}: has no extent; run PhysGen3D's perception again")
    if float(vertices[:, 2].max()) <= 0:
        raise InputError(f"object {item.name}: lies behind the camera; run PhysGen3D's perception again")
    lowest = float((vertices @ folder.normal).max())
    if lowest <= 0 or abs(lowest - folder.height) > NEAR * size:
        return _Placed(item, mesh, matrix, vertices)
    nearer = folder.height / lowest
    return _Placed(item, mesh, np.diag([nearer, nearer, nearer, 1.0]) @ matrix, vertices * nearer)


def _write_object(
    folder: Path, name: str, item: _Placed, world: NDArray[np.float64], metres: float, others: list[_Placed]
) -> SceneObject:
    (folder / "meshes" / f"{name}.glb").write_bytes(_glb(item))
    pose = np.diag([metres, metres, metres, 1.0]) @ world @ item.camera_from_mesh
    depth = float(item.vertices[:, 2].mean())
    extent = np.ptp(item.vertices @ world[:3, :3].T, axis=0).max()
    return SceneObject(
        name=name,
        mesh=f"meshes/{name}.glb",
        world_from_mesh=_rows(pose),
        size_m=float(extent) * metres,
        material=_material(item.source),
        occlusion_order=sum(float(other.vertices[:, 2].mean()) < depth for other in others),
        mask=f"masks/{name}.png" if item.source.mask is not None else None,
    )


def _material(item: Physgen3dObject) -> Material:
    usual = load_preset("medium")
    try:
        return dataclasses.replace(
            usual,
            youngs_modulus=usual.youngs_modulus if item.youngs_modulus is None else item.youngs_modulus,
            density=usual.density if item.density is None else item.density,
        )
    except InputError as error:
        raise InputError(f"object {item.name}: {error}") from None


def _glb(item: _Placed) -> bytes:
    """The mesh with its texture inside; without one it wears the photo later."""
    uv = getattr(item.mesh.visual, "uv", None)
    visual = None
    if uv is not None and item.source.texture is not None and len(uv) == len(item.mesh.vertices):
        texture = Image.fromarray(load_photo(item.source.texture, MAX_SIDE).pixels)
        texture.format = "PNG"
        material = PBRMaterial(name="photo", baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=0.6)
        visual = trimesh.visual.TextureVisuals(uv=np.asarray(uv), material=material)
    mesh = trimesh.Trimesh(item.mesh.vertices, item.mesh.faces, visual=visual, process=False)
    buffer = io.BytesIO()
    mesh.export(buffer, file_type="glb", include_normals=True)
    return buffer.getvalue()


def _camera(source: Physgen3dFolder, world: NDArray[np.float64], metres: float, width: int, height: int) -> Camera:
    pose = world.copy()
    pose[:3, 3] *= metres
    focal = 0.5 * width / source.tangent
    return Camera(
        width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, world_from_camera=_rows(pose)
    )


def _rows(matrix: NDArray[np.float64]) -> Matrix4:
    rows = [(float(a), float(b), float(c), float(d)) for a, b, c, d in matrix]
    return rows[0], rows[1], rows[2], rows[3]


def _sized(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """The picture (height, width, 3)."""
    picture = Image.fromarray(load_photo(path, MAX_SIDE).pixels)
    if picture.size != (width, height):
        picture = picture.resize((width, height), Image.Resampling.BILINEAR)
    return np.array(picture, dtype=np.uint8)
