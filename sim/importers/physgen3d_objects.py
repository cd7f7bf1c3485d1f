# SPDX-License-Identifier: MIT
"""The objects of a PhysGen3D folder: opened, their pose chosen, put on the ground, written as GLB."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import PBRMaterial

from ..errors import InputError
from ..reconstruct.photo import load_photo
from ..scene.materials import load_preset
from ..scene.matter import Material
from ..scene.meshes import read_mesh
from .masks import fitted
from .physgen3d import Physgen3dFolder, Physgen3dObject
from .physgen3d_pose import better_pose
from .physgen3d_settings import Physgen3dSettings
from .segments import bright, read_grey

MAX_SIDE = 8192
"""Pixels; a larger picture is no output of PhysGen3D."""
NEAR = 0.5
"""An object that is this share of its size off the ground is taken to stand on it."""
ROUGHNESS, METALLIC = 0.6, 0.0
"""Where nothing is known of them."""

Mask = NDArray[np.bool_]


@dataclasses.dataclass(frozen=True, eq=False)
class PlacedObject:
    """An object where it will be in the scene.

    mask: (H, W) of the photo, or None. camera_from_mesh: (4, 4) in the folder's unit. vertices: (V, 3) on the camera's
    axes.
    """

    source: Physgen3dObject
    mesh: trimesh.Trimesh
    mask: Mask | None
    camera_from_mesh: NDArray[np.float64]
    vertices: NDArray[np.float64]

    @property
    def depth(self) -> float:
        """Mean distance from the camera along its axis, in the folder's unit."""
        return float(self.vertices[:, 2].mean())


def placed_object(
    folder: Physgen3dFolder,
    item: Physgen3dObject,
    size: tuple[int, int],
    on_ground: bool,
    notice: Callable[[str], None],
) -> PlacedObject:
    """Open ``item`` for the photo of ``size`` (width, height) and put it on the ground if it nearly stands there.

    It moves along the camera's rays, so that the picture does not change; on_ground: False leaves it where it is.
    Raises InputError for a mesh or mask that cannot be used.
    """
    mesh = read_mesh(item.mesh)
    corners = np.asarray(mesh.vertices, dtype=np.float64)
    mask = None
    if item.mask is not None:
        mask = fitted(bright(read_grey(item.mask)), *size, f"{item.mask}: mask of {item.name}")
    matrix = item.camera_from_mesh
    if item.optimized is not None:
        shape = (corners, np.asarray(mesh.faces, dtype=np.int64))
        matrix, taken = better_pose(shape, item.camera_from_mesh, item.optimized, mask, folder.intrinsics(*size))
        if not taken:
            notice(f"{item.name}: its pose in matrices fits the photo better than in matrices_optimized, and is used")
    vertices = corners @ matrix[:3, :3].T + matrix[:3, 3]
    extent = float(np.ptp(vertices, axis=0).max())
    if not np.isfinite(vertices).all() or extent < 1e-9:
        raise InputError(f"{item.mesh}: has no extent; run PhysGen3D's perception again")
    if float(vertices[:, 2].max()) <= 0:
        raise InputError(f"object {item.name}: lies behind the camera; run PhysGen3D's perception again")
    lowest = float((vertices @ folder.normal).max())
    if lowest <= 0 or abs(lowest - folder.height) > NEAR * extent or not on_ground:
        if abs(lowest - folder.height) > 1e-3 * extent:
            notice(f"{item.name} does not stand on the ground; it is left where it is")
        return PlacedObject(item, mesh, mask, matrix, vertices)
    nearer = folder.height / lowest
    return PlacedObject(item, mesh, mask, np.diag([nearer, nearer, nearer, 1.0]) @ matrix, vertices * nearer)


def material_of(item: Physgen3dObject, settings: Physgen3dSettings | None) -> Material:
    """Stiffness and density as the folder has them, else its settings, else those of ``medium``. Raises InputError."""
    usual = load_preset("medium")
    modulus, density = item.youngs_modulus, item.density
    if settings is not None:
        modulus = settings.youngs_modulus if modulus is None else modulus
        density = settings.density if density is None else density
    try:
        return dataclasses.replace(
            usual,
            youngs_modulus=usual.youngs_modulus if modulus is None else modulus,
            density=usual.density if density is None else density,
        )
    except InputError as error:
        raise InputError(f"object {item.name}: {error}") from None


def object_glb(item: PlacedObject) -> bytes:
    """The mesh with its texture, roughness and metallic inside; without a texture it wears the photo later."""
    uv = getattr(item.mesh.visual, "uv", None)
    visual = None
    if uv is not None and item.source.texture is not None and len(uv) == len(item.mesh.vertices):
        texture = Image.fromarray(load_photo(item.source.texture, MAX_SIDE).pixels)
        texture.format = "PNG"
        material = PBRMaterial(
            name="photo",
            baseColorTexture=texture,
            metallicFactor=_mean(item.source.metallic, METALLIC),
            roughnessFactor=_mean(item.source.roughness, ROUGHNESS),
        )
        visual = trimesh.visual.TextureVisuals(uv=np.asarray(uv), material=material)
    mesh = trimesh.Trimesh(item.mesh.vertices, item.mesh.faces, visual=visual, process=False)
    buffer = io.BytesIO()
    mesh.export(buffer, file_type="glb", include_normals=True)
    return buffer.getvalue()


def _mean(path: Path | None, usual: float) -> float:
    """Mean of a picture, 0 to 1: PhysGen3D renders with that too."""
    if path is None:
        return usual
    values = read_grey(path)
    return float(values.mean() / (np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1))
