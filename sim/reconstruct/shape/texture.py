# SPDX-License-Identifier: MIT
"""Project the photo onto the body, and write the mesh as GLB.

The texture is the photo around the object, and each vertex' UV is where the camera sees it at rest. The front is
therefore the photo itself, pixel for pixel; what is not seen wears the colours of what is (``unseen``).
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from trimesh.visual.material import PBRMaterial

from ...scene.model import Matrix4
from .mesh import BodyMesh

Mask = NDArray[np.bool_]
MARGIN = 8
"""Pixels around the silhouette that the texture holds, for filtering and for the last fraction of a pixel."""


@dataclass(frozen=True)
class CropTexture:
    """A part of the photo. pixels: (h, w, 3) uint8; left, top: photo pixels of its first corner."""

    pixels: NDArray[np.uint8]
    left: int
    top: int

    def uv(self, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
        """UV (n, 2), v upward as in OpenGL and Blender, of photo ``pixels`` (n, 2)."""
        height, width = self.pixels.shape[:2]
        x, y = pixels[:, 0] - self.left, pixels[:, 1] - self.top
        return np.column_stack([x / width, 1.0 - y / height])

    def photo_pixels(self, uv: NDArray[np.floating]) -> NDArray[np.float64]:
        """Photo pixels (n, 2) of ``uv`` (n, 2): the inverse of ``uv()``."""
        height, width = self.pixels.shape[:2]
        return np.column_stack([uv[:, 0] * width + self.left, (1.0 - uv[:, 1]) * height + self.top])


@dataclass(frozen=True)
class TexturedSurface:
    """vertices: (V, 3); faces: (T, 3); uv: (V, 2), origin at the bottom left, into picture: (h, w, 3) uint8 sRGB."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float64]
    picture: NDArray[np.uint8]


def worn(body: BodyMesh, texture: CropTexture) -> TexturedSurface:
    """``body`` in the colours of the photo."""
    pixels = body.pixels if body.colours is None else body.colours
    return TexturedSurface(body.vertices, body.faces, texture.uv(pixels), texture.pixels)


def crop_texture(photo: NDArray[np.uint8], mask: Mask) -> CropTexture:
    """The photo around ``mask``: equal to the photo inside it, the object's own colours carried outward around it."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = max(0, int(rows[0]) - MARGIN), max(0, int(columns[0]) - MARGIN)
    window = (slice(top, int(rows[-1]) + 1 + MARGIN), slice(left, int(columns[-1]) + 1 + MARGIN))
    inside, colours = mask[window], photo[window].copy()
    # The outermost pixels are a mixture with the background: take the colours from a little further in.
    core = ndimage.binary_erosion(inside, iterations=2)
    core |= inside & ~ndimage.binary_dilation(core, iterations=4)
    nearest = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
    carried = ndimage.gaussian_filter(colours[tuple(nearest)].astype(np.float32), (1.0, 1.0, 0.0))
    colours[~inside] = np.clip(carried[~inside] + 0.5, 0, 255).astype(np.uint8)
    return CropTexture(pixels=colours, left=left, top=top)


def glb_bytes(
    surface: TexturedSurface,
    base_centre: NDArray[np.floating],
    metres: float,
    *,
    roughness: float = 0.6,
    metallic: float = 0.0,
) -> bytes:
    """``surface`` as a GLB in metres, Y up (glTF's convention), its origin at ``base_centre`` (3,) in its own unit.

    roughness, metallic: of its shader, 0 to 1. Its colour stays the photo's, with the photo's light on it.
    """
    local = (surface.vertices - base_centre) * metres
    vertices = np.column_stack([local[:, 0], local[:, 2], -local[:, 1]])
    image = Image.fromarray(surface.picture)
    image.format = "PNG"  # trimesh embeds in this format; JPEG would change the photo's pixels
    material = PBRMaterial(
        name="photo",
        baseColorTexture=image,
        metallicFactor=metallic,
        roughnessFactor=roughness,
        doubleSided=False,
    )
    mesh = trimesh.Trimesh(
        vertices=vertices,
        faces=surface.faces,
        visual=trimesh.visual.TextureVisuals(uv=surface.uv, material=material),
        process=False,
    )
    buffer = io.BytesIO()
    # Normals are written, or glTF readers must shade every triangle flat.
    mesh.export(buffer, file_type="glb", include_normals=True)
    return buffer.getvalue()


def world_from_gltf(base_centre: NDArray[np.floating]) -> Matrix4:
    """4x4 from the GLB's Y-up metres to world metres; ``base_centre`` (3,) in world metres."""
    x, y, z = (float(v) for v in base_centre)
    return ((1.0, 0.0, 0.0, x), (0.0, 0.0, -1.0, y), (0.0, 1.0, 0.0, z), (0.0, 0.0, 0.0, 1.0))
