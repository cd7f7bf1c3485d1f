# SPDX-License-Identifier: MIT
"""Fit a user's mesh in place of a reconstructed body: repaired, aligned, textured by the photo.

The texture is the part of the photo around the object with the mesh's own texture below it. Faces that the camera sees
squarely take the photo; the rest keep the mesh's texture, matched to the photo's brightness and colour. A mesh without
colours gets an atlas as reconstructed bodies do (``shape/texture_atlas.py``), where a hidden point corresponds to the
nearest visible point, or the nearest point whose mirror image is visible.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from ...mpm.geometry.triangles import sample_surface
from ...scene.meshes import read_mesh
from ...scene.model import Camera
from ..reconstruct_options import UP_AXES, Pixel
from ..shape.body_texture import CropTexture, TexturedSurface, crop_texture
from ..shape.inflated_mesh import BodyMesh
from ..shape.texture_atlas import textured_body
from .mesh_alignment import Mask, Points, Pose, align
from .mesh_repair import RepairedMesh, repair_mesh

GRAZING = 0.2
"""Cosine between face normal and line of sight below which a face keeps the mesh's own colours."""
BEHIND = 0.015
"""Depth tolerance of visible faces, over the mesh's extent."""
POINTS = 150_000
CELLS = 220
"""Cells along the longer side of the depth map for visibility."""
OWN_SIDE = 1024
"""Largest side of the mesh's own texture in pixels."""
GAINS = (0.3, 3.0)


def reproject_photo(
    camera: Camera, mesh: RepairedMesh, vertices: Points, seen: Mask, pixels: NDArray[np.uint8]
) -> TexturedSurface:
    """Return ``mesh`` with vertices at ``vertices`` (V, 3), textured by ``pixels`` (H, W, 3) where ``seen`` (H, W)."""
    crop = crop_texture(pixels, seen)
    from_photo = _seen_faces(camera, vertices, mesh.faces, seen)
    projected = camera.project(vertices)[:, :2]
    if mesh.uv is not None and mesh.picture is not None:
        own_uv, own = mesh.uv, _matched(mesh, from_photo, projected, crop)
    elif mesh.colours is not None:
        own_uv, own = _palette(mesh.colours)
    else:
        own_uv, own = None, None
    if own_uv is None or own is None:
        alike = projected.copy()
        shown = np.zeros(len(vertices), dtype=bool)
        shown[mesh.faces[from_photo]] = True
        if shown.any():
            alike[~shown] = projected[_lookalike(camera, vertices, shown)]
        return textured_body(camera, BodyMesh(vertices, mesh.faces, projected, alike), crop, seen)
    picture, photo_part, own_part = _stacked(crop.pixels, own)
    return _joined(vertices, mesh.faces, from_photo, photo_part(crop.uv(projected)), own_part(own_uv), picture)


def _seen_faces(camera: Camera, vertices: Points, faces: NDArray[np.int64], seen: Mask) -> NDArray[np.bool_]:
    """Faces (T,) that the photo shows: towards the camera, in front of all others, inside the mask."""
    points = sample_surface(vertices, faces, POINTS)
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
    mesh: RepairedMesh, from_photo: NDArray[np.bool_], projected: Points, crop: CropTexture
) -> NDArray[np.uint8]:
    """The mesh's own texture, each channel scaled so that the visible part has the photo's mean."""
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
    """UV (V, 2) into a small palette picture of the vertex colours (V, 3), 32 steps a channel."""
    steps = np.clip(colours / 255.0 * 31.0 + 0.5, 0, 31).astype(int)
    used, which = np.unique(steps, axis=0, return_inverse=True)
    side = int(np.ceil(np.sqrt(len(used))))
    # Three pixels per colour, so that filtering never mixes neighbours.
    picture = np.zeros((side * side, 3), dtype=np.uint8)
    picture[: len(used)] = np.round(used * (255.0 / 31.0))
    picture = picture.reshape(side, side, 3).repeat(3, axis=0).repeat(3, axis=1)
    row, column = np.divmod(which.reshape(-1), side)
    return np.column_stack([(column + 0.5) / side, 1.0 - (row + 0.5) / side]), picture


def _lookalike(camera: Camera, vertices: Points, shown: NDArray[np.bool_]) -> NDArray[np.int64]:
    """For each vertex that is not ``shown``, the index of the shown one nearest to it or to its mirror image.

    The mirror plane is upright through the centre, perpendicular to the line of sight: the back is like the front.
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
    """One picture, ``photo`` above ``own``, and the maps of each one's UV into it."""
    height, width = photo.shape[0] + own.shape[0], max(photo.shape[1], own.shape[1])
    picture = np.zeros((height, width, 3), dtype=np.uint8)
    picture[: photo.shape[0], : photo.shape[1]] = photo
    picture[photo.shape[0] :, : own.shape[1]] = own
    # Repeat a part's last column beyond its border, for filtering.
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
    """Return the mesh with vertices shared by both kinds of faces duplicated, with two UVs."""
    corners = faces + len(vertices) * from_photo[:, None]
    used, renumbered = np.unique(corners, return_inverse=True)
    photo, source = used >= len(vertices), used % len(vertices)
    uv = np.where(photo[:, None], photo_uv[source], own_uv[source])
    return TexturedSurface(vertices[source], renumbered.reshape(faces.shape), uv, picture)


POOR = 0.8
"""Overlap of silhouettes below which a notice doubts the mesh."""
UNCLEAR = 0.015
"""Margin over another rotation below which a notice says that the orientation is a guess."""
USUAL_UPS = {".glb": ("+y",), ".gltf": ("+y",)}
"""Formats whose specification defines the up axis; for others all are tried, the most common first."""
ALL_UPS = ("+y", "+z", "-y", "-z", "+x", "-x")


@dataclass(frozen=True)
class FittedMesh:
    """surface: in the camera's unit, standing on z = 0. pose: of the file's mesh."""

    surface: TexturedSurface
    pose: Pose


def fit_mesh(
    path: Path,
    camera: Camera,
    seen: Mask,
    full: Mask,
    pixels: NDArray[np.uint8],
    *,
    name: str,
    up: str,
    points: tuple[tuple[tuple[float, float, float], Pixel], ...],
    notice: Callable[[str], None],
) -> FittedMesh:
    """Return the mesh at ``path``, repaired, aligned to the photo and textured by it.

    camera: 1 unit above z = 0. seen, full: (H, W) visible part of the object, and its whole mask, which is not trusted
    beyond ``seen``. pixels: (H, W, 3) the photo. up: one of ``UP_AXES``. points: points on the mesh and their pixels in
    ``pixels``. Raises InputError for a file that cannot be read or a mesh without extent.
    """
    assert up in UP_AXES
    mesh = repair_mesh(read_mesh(path), name, notice)
    ups = (up,) if up != "auto" else USUAL_UPS.get(path.suffix.lower(), ALL_UPS)
    pose = align(
        camera,
        seen,
        full & ~seen,
        mesh.vertices,
        mesh.faces,
        ups=ups,
        points=points,
        colours=mesh.colours,
        pixels=pixels,
    )
    if pose.overlap < POOR and up == "auto" and len(ups) == 1:
        # Exporters may forget to convert axes.
        other = align(
            camera, seen, full & ~seen, mesh.vertices, mesh.faces,
            ups=ALL_UPS, points=points, colours=mesh.colours, pixels=pixels,
        )  # fmt: skip
        if other.overlap > pose.overlap + 0.05:
            notice(f"{name}: the mesh lies on its side by its format; its axis {other.up} is used as up")
            pose = other
    _say(pose, name, notice)
    return FittedMesh(reproject_photo(camera, mesh, pose.place(mesh.vertices), seen, pixels), pose)


def _say(pose: Pose, name: str, notice: Callable[[str], None]) -> None:
    message = f"{name}: its mesh overlaps its mask by {100 * pose.overlap:.0f} %"
    if pose.overlap < POOR:
        notice(f"{message}: it may be of another object or wrongly oriented; give mesh_up or a few mesh_points")
    elif pose.clear < UNCLEAR:
        notice(f"{message}, and as well in another orientation; a few mesh_points settle it")
    else:
        notice(message)
