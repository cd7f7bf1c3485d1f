# SPDX-License-Identifier: MIT
"""The photo on a user's mesh where the photo shows it, the mesh's own colours elsewhere, in one picture.

The picture is the part of the photo around the object with the mesh's own texture below it. Faces that the camera sees
squarely enough take the photo; for the rest the mesh's texture is brought to the photo's brightness and colour. A mesh
without colours takes them from the nearest place that is seen, or whose mirror image is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from ...scene.model import Camera
from ..shape.texture import CropTexture, TexturedSurface, crop_texture
from .mending import MendedMesh
from .sampled import Mask, Points, spread

GRAZING = 0.2
"""Cosine between face and line of sight below which a face keeps the mesh's own colours."""
BEHIND = 0.015
"""Of the mesh's extent: how far behind the nearest surface a face may lie and still be what is seen."""
POINTS = 150_000
CELLS = 220
"""Along the outline's longer side, of the depth map that tells what hides what."""
OWN_SIDE = 1024
"""Pixels of the mesh's own texture, at most."""
GAINS = (0.3, 3.0)


def reprojected(
    camera: Camera, mesh: MendedMesh, vertices: Points, seen: Mask, pixels: NDArray[np.uint8]
) -> TexturedSurface:
    """``mesh``, whose vertices stand at ``vertices`` (V, 3), with ``pixels`` (H, W, 3) where ``seen`` (H, W)."""
    crop = crop_texture(pixels, seen)
    from_photo = _seen_faces(camera, vertices, mesh.faces, seen)
    projected = camera.project(vertices)[:, :2]
    if mesh.uv is not None and mesh.picture is not None:
        own_uv, own = mesh.uv, _matched(mesh, from_photo, projected, crop)
    elif mesh.colours is not None:
        own_uv, own = _palette(mesh.colours)
    else:
        own_uv, own = None, None
    photo_uv = crop.uv(projected)
    if own_uv is None or own is None:
        uv = photo_uv.copy()
        shown = np.zeros(len(vertices), dtype=bool)
        shown[mesh.faces[from_photo]] = True
        if shown.any():
            uv[~shown] = photo_uv[_lookalike(camera, vertices, shown)]
        return TexturedSurface(vertices, mesh.faces, uv, crop.pixels)
    picture, photo_part, own_part = _stacked(crop.pixels, own)
    return _joined(vertices, mesh.faces, from_photo, photo_part(photo_uv), own_part(own_uv), picture)


def _seen_faces(camera: Camera, vertices: Points, faces: NDArray[np.int64], seen: Mask) -> NDArray[np.bool_]:
    """Which faces (T) the photo shows: turned to the camera, before all others, inside the outline."""
    points = spread(vertices, faces, POINTS)
    projected = camera.project(points.places)
    low = camera.project(vertices)[:, :2].min(axis=0)
    extent = max(float(np.ptp(camera.project(vertices)[:, :2], axis=0).max()), 1.0)
    cell = extent / CELLS
    depth = np.full((CELLS + 3, CELLS + 3), np.inf)
    rows, columns = (((projected[:, i] - low[i]) / cell + 1).astype(int).clip(0, CELLS + 2) for i in (1, 0))
    np.minimum.at(depth, (rows, columns), projected[:, 2])
    centres = vertices[faces].mean(axis=1)
    at = camera.project(centres)
    rows, columns = (((at[:, i] - low[i]) / cell + 1).astype(int).clip(0, CELLS + 2) for i in (1, 0))
    size = float(np.ptp(vertices, axis=0).max())
    before = at[:, 2] <= depth[rows, columns] + BEHIND * size
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    sight = camera.position - centres
    length = np.linalg.norm(normals, axis=1) * np.linalg.norm(sight, axis=1)
    cosine = np.einsum("ti,ti->t", normals, sight) / np.maximum(length, 1e-30)
    height, width = seen.shape
    y, x = (np.floor(at[:, i]).astype(int) for i in (1, 0))
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    inside[inside] = seen[y[inside], x[inside]]
    return np.asarray(before & (cosine > GRAZING) & inside)


def _matched(
    mesh: MendedMesh, from_photo: NDArray[np.bool_], projected: Points, crop: CropTexture
) -> NDArray[np.uint8]:
    """The mesh's own picture, each channel scaled so that what the photo shows of it has the photo's mean there."""
    assert mesh.picture is not None and mesh.colours is not None
    picture = mesh.picture
    if max(picture.shape) > OWN_SIDE:
        scale = OWN_SIDE / max(picture.shape[:2])
        size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
        picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))
    vertices = np.unique(mesh.faces[from_photo])
    if len(vertices) < 20:
        return picture
    at = np.floor(projected[vertices] - (crop.left, crop.top)).astype(int)
    at = np.clip(at, 0, np.array(crop.pixels.shape[1::-1]) - 1)
    there = crop.pixels[at[:, 1], at[:, 0]].astype(np.float64).mean(axis=0)
    gain = np.clip(there / np.maximum(mesh.colours[vertices].mean(axis=0), 1.0), *GAINS)
    return np.asarray(np.clip(picture * gain + 0.5, 0, 255), dtype=np.uint8)


def _palette(colours: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """UV (V, 2) into a small picture that holds the colours (V, 3) of vertices, 32 steps a channel."""
    steps = np.clip(colours / 255.0 * 31.0 + 0.5, 0, 31).astype(int)
    used, which = np.unique(steps, axis=0, return_inverse=True)
    side = int(np.ceil(np.sqrt(len(used))))
    # Three pixels a colour, so that filtering never mixes neighbours.
    picture = np.zeros((side * side, 3), dtype=np.uint8)
    picture[: len(used)] = np.round(used * (255.0 / 31.0))
    picture = picture.reshape(side, side, 3).repeat(3, axis=0).repeat(3, axis=1)
    row, column = np.divmod(which.reshape(-1), side)
    return np.column_stack([(column + 0.5) / side, 1.0 - (row + 0.5) / side]), picture


def _lookalike(camera: Camera, vertices: Points, shown: NDArray[np.bool_]) -> NDArray[np.int64]:
    """For each vertex that is not ``shown`` the one, of those shown, nearest to it or to its mirror image.

    The mirror stands upright through the middle, across the line of sight: the back is like the front.
    """
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    sight = middle - camera.position
    sight[2] = 0.0
    sight /= max(float(np.linalg.norm(sight)), 1e-12)
    hidden = vertices[~shown]
    mirrored = hidden - 2.0 * ((hidden - middle) @ sight)[:, None] * sight
    tree, candidates = cKDTree(vertices[shown]), np.flatnonzero(shown)
    near, first = tree.query(hidden)
    mirror, second = tree.query(mirrored)
    return candidates[np.where(near <= mirror, first, second)]


def _stacked(photo: NDArray[np.uint8], own: NDArray[np.uint8]):  # type: ignore[no-untyped-def]  # noqa: ANN202
    """One picture, ``photo`` above ``own``, and the maps of the UV of each into it."""
    height, width = photo.shape[0] + own.shape[0], max(photo.shape[1], own.shape[1])
    picture = np.zeros((height, width, 3), dtype=np.uint8)
    picture[: photo.shape[0], : photo.shape[1]] = photo
    picture[photo.shape[0] :, : own.shape[1]] = own
    # Beyond a part's border its last column goes on, for filtering.
    picture[: photo.shape[0], photo.shape[1] :] = photo[:, -1:]
    picture[photo.shape[0] :, own.shape[1] :] = own[:, -1:]

    def photo_part(uv: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = (1.0 - uv[:, 1]) * photo.shape[0]
        return np.column_stack([uv[:, 0] * photo.shape[1] / width, 1.0 - rows / height])

    def own_part(uv: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = photo.shape[0] + (1.0 - uv[:, 1]) * own.shape[0]
        return np.column_stack([uv[:, 0] * own.shape[1] / width, 1.0 - rows / height])

    return picture, photo_part, own_part


def _joined(
    vertices: Points,
    faces: NDArray[np.int64],
    from_photo: NDArray[np.bool_],
    photo_uv: NDArray[np.float64],
    own_uv: NDArray[np.float64],
    picture: NDArray[np.uint8],
) -> TexturedSurface:
    """Vertices that both kinds of faces share are there twice, at the same place, with two UVs."""
    corners = faces + len(vertices) * from_photo[:, None]
    used, renumbered = np.unique(corners, return_inverse=True)
    photo, source = used >= len(vertices), used % len(vertices)
    uv = np.where(photo[:, None], photo_uv[source], own_uv[source])
    return TexturedSurface(vertices[source], renumbered.reshape(faces.shape), uv, picture)
