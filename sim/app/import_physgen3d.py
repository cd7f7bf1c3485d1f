# SPDX-License-Identifier: MIT
"""An output folder of PhysGen3D → a scene folder (``sim/importers/physgen3d.py`` says what is read)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import InputError
from ..events import OnEvent, ignore
from ..importers.physgen3d import Physgen3dFolder, read_physgen3d
from ..importers.physgen3d_objects import MAX_SIDE, PlacedObject, material_of, object_glb, placed_object
from ..importers.physgen3d_settings import GRAVITY, Physgen3dSettings, camera_velocity, find_settings, read_settings
from ..reconstruct.output import replacing_folder
from ..reconstruct.photo import load_photo
from ..scene.folder import SceneFolder, load_scene, save_scene
from ..scene.model import Camera, Ground, Matrix4, Scene, SceneObject, Vector
from ..scene.names import fitting_names

DEFAULT_SIZE_M = 0.15
SAME_GRAVITY = 0.1
"""How far its gravity may be from the earth's, as a share, before a notice says so."""

Notice = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class _World:
    """from_camera: (4, 4) in the folder's unit, the origin on the ground below the first object; metres: of a unit."""

    from_camera: NDArray[np.float64]
    metres: float


def import_physgen3d(
    root: Path,
    out: Path,
    *,
    size_m: float | None = None,
    settings: Path | None = None,
    on_event: OnEvent = ignore,
) -> SceneFolder:
    """Turn PhysGen3D's output folder ``root`` into the scene folder ``out``.

    size_m: largest extent of the first object in metres, 1e-4 to 1e3, which sets the scale. None takes the folder's
    unit of length as its simulation does where its settings are known, else 0.15 m.
    settings: YAML file of its simulation, with velocities and friction; None looks for it (``find_settings``).

    Objects that stand nearly on the ground are put on it along the camera's rays, so that the picture does not change
    (PhysGen3D moves them along the ground's normal). Raises InputError when something is missing or not readable, or
    ``out`` holds something else than a scene.
    """
    if size_m is not None and not (math.isfinite(size_m) and 1e-4 <= size_m <= 1e3):
        raise InputError(f"size_m is {size_m!r}: give metres from 0.0001 to 1000")

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    source = read_physgen3d(root)
    path = settings or find_settings(root)
    told = None if path is None else read_settings(path)
    photo = load_photo(source.photo, MAX_SIDE).pixels
    height, width = photo.shape[:2]
    if source.background is None:
        notice("there is no inpainted background; the objects stay in the picture behind themselves")
    background = photo if source.background is None else _sized(source.background, width, height)
    on_ground = told is None or told.on_ground
    placed = [placed_object(source, item, (width, height), on_ground, notice) for item in source.objects]
    world = _world(source, placed[0], size_m, told, notice)
    if told is not None:
        _say(told, source, world, notice)
    with replacing_folder(out) as folder:
        for sub in ("masks", "meshes"):
            (folder / sub).mkdir()
        Image.fromarray(photo).save(folder / "photo.png")
        Image.fromarray(background).save(folder / "background.png")
        names = fitting_names([item.source.name for item in placed])
        objects = []
        for index, (name, item) in enumerate(zip(names, placed, strict=True)):
            (folder / "meshes" / f"{name}.glb").write_bytes(object_glb(item))
            if item.mask is not None:
                Image.fromarray(item.mask.astype(np.uint8) * 255).save(folder / "masks" / f"{name}.png")
            order = sum(other.depth < item.depth for other in placed)
            velocity = _velocity(told, index, source, world)
            scene_object = _scene_object(name, item, world)
            objects.append(
                dataclasses.replace(
                    scene_object, occlusion_order=order, velocity=velocity, material=material_of(item.source, told)
                )
            )
        ground = Ground() if told is None or told.friction is None else Ground(friction=told.friction)
        camera = _camera(source, world, width, height)
        save_scene(folder, Scene(camera=camera, objects=tuple(objects), ground=ground))
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
            raise InputError(f"{settings.path}: scale makes {name} {metres * extent:g} m large; give --size")
        notice(f"{name} is {metres * extent:.3g} m large, as in PhysGen3D's simulation; --size sets it otherwise")
        return _World(pose, metres)
    notice(f"{name} is taken to be {DEFAULT_SIZE_M:g} m large, the folder does not say")
    return _World(pose, DEFAULT_SIZE_M / extent)


def _say(settings: Physgen3dSettings, source: Physgen3dFolder, world: _World, notice: Notice) -> None:
    """Where the settings are from, and what of them is not carried over."""
    notice(f"velocities and friction are those of {settings.path}")
    if settings.folder not in (None, source.root.resolve().name):
        notice(f"{settings.path} is for the folder {settings.folder}, not for {source.root.resolve().name}")
    if settings.unused:
        notice(f"{settings.path}: not used: {', '.join(settings.unused)}")
    count = 1 if settings.for_all else len(settings.velocities)
    if not settings.for_all and count != len(source.objects):
        notice(f"{settings.path}: {count} velocities for {len(source.objects)} objects; those without one are at rest")
    gravity = GRAVITY * settings.scale * world.metres
    if abs(gravity / 9.81 - 1) > SAME_GRAVITY:
        notice(
            f"at this size PhysGen3D simulated with a gravity of {gravity:.3g} m/s²; here things fall with 9.81, so "
            "the motion differs; leave --size out to have the same"
        )


def _velocity(settings: Physgen3dSettings | None, index: int, source: Physgen3dFolder, world: _World) -> Vector:
    told = None if settings is None else settings.velocity(index)
    if told is None:
        return (0.0, 0.0, 0.0)
    x, y, z = world.from_camera[:3, :3] @ camera_velocity(told, source.normal) * world.metres
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


def _sized(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """The picture (height, width, 3)."""
    picture = Image.fromarray(load_photo(path, MAX_SIDE).pixels)
    if picture.size != (width, height):
        picture = picture.resize((width, height), Image.Resampling.BILINEAR)
    return np.array(picture, dtype=np.uint8)
