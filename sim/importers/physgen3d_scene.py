# SPDX-License-Identifier: MIT
"""An output folder of PhysGen3D → a scene folder: objects opened, posed, put on the ground, written as GLB.

``perception.py`` at 72d7b63 refines every object's pose by descent, but always against the mask of the first one, so
that the others may end up displaced. Its simulation does not use them. Where the object's own mask is available, it
decides."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual.material import PBRMaterial

from ..errors import InputError
from ..events import OnEvent, ignore
from ..reconstruct.photo import load_photo
from ..scene.folder import Scene, load_scene, save_scene
from ..scene.material import Material, load_preset
from ..scene.meshes import read_mesh
from ..scene.model import Camera, Ground, Matrix4, SceneModel, SceneObject, Vector
from ..scene.scene_output import replacing_folder
from ..validation import valid_names
from .image_masks import binary_mask, read_grey_image
from .masks import resized_mask
from .physgen3d import (
    GRAVITY,
    Physgen3dFolder,
    Physgen3dObject,
    Physgen3dSettings,
    camera_velocity,
    find_settings,
    read_physgen3d,
    read_settings,
)

SILHOUETTE_SIDE = 384
"""Longer side in pixels of the images in which silhouettes are compared."""
MIN_ADVANTAGE, MIN_OVERLAP = 0.05, 0.5
"""IoU by which the first pose must be better, and its least IoU, to replace the refined one."""

Mask = NDArray[np.bool_]


def silhouette(
    points: NDArray[np.float64], faces: NDArray[np.int64], view: tuple[float, float, float], width: int, height: int
) -> Mask:
    """Return the silhouette (h, w) of a mesh, its longer side at most ``SILHOUETTE_SIDE`` pixels.

    points: (V, 3) on camera axes; faces: (T, 3); view: f, cx, cy in pixels of ``width`` x ``height``. Triangles that
    reach behind the camera are skipped.
    """
    scale = min(1.0, SILHOUETTE_SIDE / max(width, height))
    picture = np.zeros((max(1, round(height * scale)), max(1, round(width * scale))), dtype=np.uint8)
    focal, cx, cy = view
    ahead = points[:, 2] > 1e-9
    depth = np.where(ahead, points[:, 2], 1.0)
    pixels = np.stack([focal * points[:, 0] / depth + cx, focal * points[:, 1] / depth + cy], axis=1) * scale
    # Sixteenths of a pixel; OpenCV has pixel centres at integers.
    fixed = np.clip(np.round((pixels - 0.5) * 16), -(2**24), 2**24).astype(np.int32)
    for triangle in faces[ahead[faces].all(axis=1)]:
        cv2.fillConvexPoly(picture, fixed[triangle], 255, shift=4)
    return np.asarray(picture > 0)


def intersection_over_union(first: Mask, second: Mask) -> float:
    """Return the intersection over union of two masks of equal size, 0 where both are empty."""
    union = np.count_nonzero(first | second)
    return float(np.count_nonzero(first & second) / union) if union else 0.0


def better_pose(
    mesh: tuple[NDArray[np.float64], NDArray[np.int64]],
    first: NDArray[np.float64],
    improved: NDArray[np.float64],
    mask: Mask | None,
    view: tuple[float, float, float],
) -> tuple[NDArray[np.float64], bool]:
    """Return ``improved`` unless ``first``, both (4, 4), fits the photo clearly better; and whether it was chosen.

    mesh: vertices (V, 3) and faces (T, 3); mask: (H, W) of the photo, or None; view: f, cx, cy. A pose not entirely in
    front of the camera, or further from ``first`` than the object's size, is rejected: the descent takes small steps.
    Otherwise the IoU with the mask decides; without a mask ``improved`` is chosen.
    """
    vertices, faces = mesh
    before, after = (vertices @ matrix[:3, :3].T + matrix[:3, 3] for matrix in (first, improved))
    moved = float(np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)))
    if not (after[:, 2] > 0).all() or moved > float(np.ptp(before, axis=0).max()):
        return first, False
    if mask is None:
        return improved, True
    height, width = mask.shape
    scores = []
    for points in (before, after):
        seen = silhouette(points, faces, view, width, height)
        small = cv2.resize(mask.astype(np.uint8), seen.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        scores.append(intersection_over_union(seen, small))
    taken = scores[0] < max(MIN_OVERLAP, scores[1] + MIN_ADVANTAGE)
    return (improved if taken else first), taken


MAX_SIDE = 8192
"""Pixels; larger images are not PhysGen3D's."""
GROUND_REACH = 0.5
"""Distance from the ground, as a fraction of its size, up to which an object is considered to stand on it."""
DEFAULT_ROUGHNESS, DEFAULT_METALLIC = 0.6, 0.0
"""Used where the folder has no images of them."""


@dataclasses.dataclass(frozen=True, eq=False)
class PlacedObject:
    """An object at its pose in the scene.

    mask: (H, W) of the photo, or None. camera_from_mesh: (4, 4) in the folder's unit. vertices: (V, 3) on camera axes.
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
    """Return ``item`` opened for the photo of ``size`` (width, height), moved onto the ground if near it.

    It moves along the camera's rays, so that the image does not change; on_ground: False leaves it in place. Raises
    InputError for an unusable mesh or mask.
    """
    mesh = read_mesh(item.mesh)
    corners = np.asarray(mesh.vertices, dtype=np.float64)
    mask = None
    if item.mask is not None:
        mask = resized_mask(binary_mask(read_grey_image(item.mask)), *size, f"{item.mask}: mask of {item.name}")
    matrix = item.camera_from_mesh
    if item.optimized is not None:
        shape = (corners, np.asarray(mesh.faces, dtype=np.int64))
        matrix, taken = better_pose(shape, item.camera_from_mesh, item.optimized, mask, folder.intrinsics(*size))
        if not taken:
            notice(f"{item.name}: its pose in matrices fits the photo better than matrices_optimized and is used")
    vertices = corners @ matrix[:3, :3].T + matrix[:3, 3]
    extent = float(np.ptp(vertices, axis=0).max())
    if not np.isfinite(vertices).all() or extent < 1e-9:
        raise InputError(f"{item.mesh}: has no extent; run PhysGen3D's perception again")
    if float(vertices[:, 2].max()) <= 0:
        raise InputError(f"object {item.name}: lies behind the camera; run PhysGen3D's perception again")
    lowest = float((vertices @ folder.normal).max())
    if lowest <= 0 or abs(lowest - folder.height) > GROUND_REACH * extent or not on_ground:
        if abs(lowest - folder.height) > 1e-3 * extent:
            notice(f"{item.name} does not stand on the ground; it is left in place")
        return PlacedObject(item, mesh, mask, matrix, vertices)
    nearer = folder.height / lowest
    return PlacedObject(item, mesh, mask, np.diag([nearer, nearer, nearer, 1.0]) @ matrix, vertices * nearer)


def object_material(item: Physgen3dObject, settings: Physgen3dSettings | None) -> Material:
    """Return the material: stiffness and density of the folder, else its settings, else of the preset ``medium``.

    The law is the paper's, which loses nothing. Raises InputError for values out of range.
    """
    usual = dataclasses.replace(load_preset("medium"), law="fixed_corotated", relaxing_share=0.0)
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
    """Return the mesh as GLB with texture, roughness and metallic; without a texture, later the photo is used."""
    uv = getattr(item.mesh.visual, "uv", None)
    visual = None
    if uv is not None and item.source.texture is not None and len(uv) == len(item.mesh.vertices):
        texture = Image.fromarray(load_photo(item.source.texture, MAX_SIDE).pixels)
        texture.format = "PNG"
        material = PBRMaterial(
            name="photo",
            baseColorTexture=texture,
            metallicFactor=_image_mean(item.source.metallic, DEFAULT_METALLIC),
            roughnessFactor=_image_mean(item.source.roughness, DEFAULT_ROUGHNESS),
        )
        visual = trimesh.visual.TextureVisuals(uv=np.asarray(uv), material=material)
    mesh = trimesh.Trimesh(item.mesh.vertices, item.mesh.faces, visual=visual, process=False)
    buffer = io.BytesIO()
    mesh.export(buffer, file_type="glb", include_normals=True)
    return buffer.getvalue()


def _image_mean(path: Path | None, usual: float) -> float:
    """Return the mean of an image, 0 to 1, with which PhysGen3D renders, too; ``usual`` without a file."""
    if path is None:
        return usual
    values = read_grey_image(path)
    return float(values.mean() / (np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1))


DEFAULT_SIZE_M = 0.15
GRAVITY_TOLERANCE = 0.1
"""Relative difference between its gravity and the earth's above which a notice is given."""

Notice = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class _World:
    """The scene's world. from_camera: (4, 4) in the folder's unit, origin on the ground below the first object; metres:
    length of that unit."""

    from_camera: NDArray[np.float64]
    metres: float


def import_physgen3d(
    root: Path,
    *,
    out: Path,
    size_m: float | None = None,
    settings: Path | None = None,
    on_event: OnEvent = ignore,
) -> Scene:
    """Return the scene folder ``out`` made of PhysGen3D's output folder ``root``.

    size_m: largest extent of the first object in metres, 1e-4 to 1e3, which sets the scale. None: the folder's unit of
    length as in its simulation if its settings are known, else 0.15 m.
    settings: YAML file of its simulation, with velocities and friction; None searches it (``find_settings``).

    Objects nearly on the ground are moved onto it along the camera's rays, so that the image does not change (PhysGen3D
    moves them along the ground's normal). Raises InputError when something is missing or unreadable, or ``out`` holds
    anything but a scene.
    """
    if size_m is not None and not (math.isfinite(size_m) and 1e-4 <= size_m <= 1e3):
        raise InputError(f"size_m is {size_m!r}: give metres from 0.0001 to 1000")

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    source = read_physgen3d(root)
    path = settings or find_settings(root)
    simulation = None if path is None else read_settings(path)
    photo = load_photo(source.photo, MAX_SIDE).pixels
    height, width = photo.shape[:2]
    if source.background is None:
        notice("there is no inpainted background; the photo with the objects in it is used")
    background = photo if source.background is None else _resized_photo(source.background, width, height)
    on_ground = simulation is None or simulation.on_ground
    placed = [placed_object(source, item, (width, height), on_ground, notice) for item in source.objects]
    world = _world(source, placed[0], size_m, simulation, notice)
    if simulation is not None:
        _report(simulation, source, world, notice)
    with replacing_folder(out) as folder:
        for sub in ("masks", "meshes"):
            (folder / sub).mkdir()
        Image.fromarray(photo).save(folder / "photo.png")
        Image.fromarray(background).save(folder / "background.png")
        names = valid_names([item.source.name for item in placed])
        objects = []
        for index, (name, item) in enumerate(zip(names, placed, strict=True)):
            (folder / "meshes" / f"{name}.glb").write_bytes(object_glb(item))
            if item.mask is not None:
                Image.fromarray(item.mask.astype(np.uint8) * 255).save(folder / "masks" / f"{name}.png")
            order = sum(other.depth < item.depth for other in placed)
            velocity = _velocity(simulation, index, source, world)
            scene_object = _scene_object(name, item, world)
            objects.append(
                dataclasses.replace(
                    scene_object,
                    occlusion_order=order,
                    velocity=velocity,
                    material=object_material(item.source, simulation),
                )
            )
        ground = Ground() if simulation is None or simulation.friction is None else Ground(friction=simulation.friction)
        camera = _camera(source, world, width, height)
        save_scene(folder, SceneModel(camera=camera, objects=tuple(objects), ground=ground))
    return load_scene(out)


def _world(
    source: Physgen3dFolder,
    first: PlacedObject,
    size_m: float | None,
    settings: Physgen3dSettings | None,
    notice: Notice,
) -> _World:
    pose = source.world_from_camera
    corners = first.vertices @ pose[:3, :3].T
    low, high = corners.min(axis=0), corners.max(axis=0)
    extent = float((high - low).max())
    pose[:2, 3] = -(low + high)[:2] / 2
    name = first.source.name
    if size_m is not None:
        return _World(pose, size_m / extent)
    if settings is not None:
        metres = 1.0 / settings.scale
        if not 1e-4 <= metres * extent <= 1e3:
            raise InputError(f"{settings.path}: scale makes {name} {metres * extent:g} m large; use --size")
        notice(f"{name} is {metres * extent:.3g} m large, as in PhysGen3D's simulation; --size overrides it")
        return _World(pose, metres)
    notice(f"{name} is assumed to be {DEFAULT_SIZE_M:g} m large, because the folder gives no size")
    return _World(pose, DEFAULT_SIZE_M / extent)


def _report(settings: Physgen3dSettings, source: Physgen3dFolder, world: _World, notice: Notice) -> None:
    """Notify of the settings' source, and of what is not imported from them."""
    notice(f"velocities and friction are from {settings.path}")
    if settings.folder not in (None, source.root.resolve().name):
        notice(f"{settings.path} is for the folder {settings.folder}, not for {source.root.resolve().name}")
    if settings.unused:
        notice(f"{settings.path}: not used: {', '.join(settings.unused)}")
    count = 1 if settings.for_all else len(settings.velocities)
    if not settings.for_all and count != len(source.objects):
        notice(f"{settings.path}: {count} velocities for {len(source.objects)} objects; those without one are at rest")
    gravity = GRAVITY * settings.scale * world.metres
    if abs(gravity / 9.81 - 1) > GRAVITY_TOLERANCE:
        notice(
            f"at this size PhysGen3D simulated with a gravity of {gravity:.3g} m/s²; here gravity is 9.81, so the "
            "motion differs; omit --size to get the same"
        )


def _velocity(settings: Physgen3dSettings | None, index: int, source: Physgen3dFolder, world: _World) -> Vector:
    velocity = None if settings is None else settings.velocity(index)
    if velocity is None:
        return (0.0, 0.0, 0.0)
    x, y, z = world.from_camera[:3, :3] @ camera_velocity(velocity, source.normal) * world.metres
    return float(x), float(y), float(z)


def _scene_object(name: str, item: PlacedObject, world: _World) -> SceneObject:
    scale = np.diag([world.metres, world.metres, world.metres, 1.0])
    extent = np.ptp(item.vertices @ world.from_camera[:3, :3].T, axis=0).max()
    return SceneObject(
        name=name,
        mesh=f"meshes/{name}.glb",
        world_from_mesh=_rows(scale @ world.from_camera @ item.camera_from_mesh),
        size_m=float(extent) * world.metres,
        mask=f"masks/{name}.png" if item.mask is not None else None,
    )


def _camera(source: Physgen3dFolder, world: _World, width: int, height: int) -> Camera:
    pose = world.from_camera.copy()
    pose[:3, 3] *= world.metres
    focal, cx, cy = source.intrinsics(width, height)
    return Camera(width=width, height=height, fx=focal, fy=focal, cx=cx, cy=cy, world_from_camera=_rows(pose))


def _rows(matrix: NDArray[np.float64]) -> Matrix4:
    rows = [(float(a), float(b), float(c), float(d)) for a, b, c, d in matrix]
    return rows[0], rows[1], rows[2], rows[3]


def _resized_photo(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """Return the image (height, width, 3) in ``path``, resized if needed."""
    picture = Image.fromarray(load_photo(path, MAX_SIDE).pixels)
    if picture.size != (width, height):
        picture = picture.resize((width, height), Image.Resampling.BILINEAR)
    return np.array(picture, dtype=np.uint8)
