# SPDX-License-Identifier: MIT
"""The photo's light on an object's texture, as far as it follows the object's shape: a picture beside the mesh.

The mesh shows the photo with its light. Divided by the shading, the texture is evenly lit, as if it had the light that
falls on what faces the photo's camera; other programs and the report show it so. A value v of a channel stands for the
factor exp((v - 128) / 80) in linear light, 0.2 to 4.9.
"""

from __future__ import annotations

import dataclasses
import io
import warnings

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import InputError
from ..files import PICTURE_FORMATS
from ..srgb import bytes_to_linear, linear_to_bytes, read_rgb
from .folder import Scene
from .scene_object import SceneObject
from .textured_mesh import TexturedMesh, read_textured_mesh

Pixels = NDArray[np.uint8]

NEUTRAL = 128
"""Value of the factor 1."""
STEPS = 80.0
"""Values to a factor of e."""
ROWS = 256
"""Rows of a texture that are worked on at a time."""


def shading_values(logarithms: NDArray[np.floating]) -> Pixels:
    """Return the picture's values of the ``logarithms`` of factors, any shape."""
    return np.clip(np.rint(np.asarray(logarithms) * STEPS + NEUTRAL), 0, 255).astype(np.uint8)


def shading_factors(values: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the factors that the picture's ``values`` stand for, any shape."""
    return np.asarray(_FACTORS[values])


_FACTORS = np.exp((np.arange(256) - NEUTRAL) / STEPS)


def evenly_lit(texture: Pixels, shading: Pixels, where: str) -> Pixels:
    """Return ``texture`` (h, w, 3), sRGB, without its ``shading`` (h, w, 3).

    where: names the two in the InputError that is raised for another size.
    """
    if texture.shape != shading.shape:
        sizes = (f"{values.shape[1]}x{values.shape[0]} pixels" for values in (shading, texture))
        raise InputError(f"{where}: has {' and its texture '.join(sizes)}; reconstruct the scene again")
    result = np.empty_like(texture)
    for first in range(0, len(texture), ROWS):
        some = slice(first, first + ROWS)
        result[some] = linear_to_bytes(bytes_to_linear(texture[some]) / shading_factors(shading[some]))
    return result


def factors_at(shading: Pixels, uv: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the factors (N, 3) of ``shading`` (h, w, 3) at texture coordinates ``uv`` (N, 2), origin at the bottom
    left: those of the nearest texels."""
    height, width = shading.shape[:2]
    columns = np.clip(np.floor(uv[:, 0] * width), 0, width - 1).astype(np.int64)
    rows = np.clip(np.floor((1.0 - uv[:, 1]) * height), 0, height - 1).astype(np.int64)
    return shading_factors(shading[rows, columns])


def read_shading(folder: Scene, item: SceneObject) -> Pixels | None:
    """Return the shading (h, w, 3) of ``item``; None where its texture is shown as it is. Raises InputError."""
    return None if item.shading is None else read_rgb(folder.file(item.shading))


def evenly_lit_mesh(folder: Scene, item: SceneObject) -> TexturedMesh:
    """Return the mesh of ``item`` in its file's coordinates, its picture evenly lit where its shading is known.

    Raises InputError for a mesh or shading that cannot be read.
    """
    mesh = read_textured_mesh(folder.file(item.mesh))
    shading = read_shading(folder, item)
    if shading is None or mesh.picture is None:
        return mesh
    picture = _decoded(mesh.picture, item.mesh)
    even = Image.fromarray(evenly_lit(np.asarray(picture.convert("RGB")), shading, f"{item.name}: {item.shading}"))
    if "A" in picture.getbands():
        even.putalpha(picture.getchannel("A"))
    buffer = io.BytesIO()
    even.save(buffer, format="PNG", compress_level=4)
    return dataclasses.replace(mesh, picture=buffer.getvalue())


def _decoded(content: bytes, name: str) -> Image.Image:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            picture = Image.open(io.BytesIO(content), formats=PICTURE_FORMATS)
            picture.load()
            return picture
    # Decoders of damaged files raise arbitrary exceptions.
    except Exception as error:
        raise InputError(f"{name}: its picture is not readable ({error}); export it again") from error
