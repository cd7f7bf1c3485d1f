# SPDX-License-Identifier: MIT
"""Files of other programs: a folder of PhysGen or PhysGen3D, splats, MJCF or URDF → a scene folder; masks → objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..atomic import replacing
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..importers import DEFAULT_UP_AXIS
from ..importers.masks import read_masks
from ..importers.mesh_scene import overview_camera
from ..importers.physgen import MASKS, SETTINGS, import_physgen
from ..importers.physgen3d import TRANSFORM_FILE
from ..importers.physgen3d_scene import import_physgen3d
from ..importers.rigid_models import SUFFIXES, read_rigid_model
from ..importers.rigid_parts import RigidModelBody
from ..importers.splat_scene import import_splats
from ..reconstruct import ObjectRequest
from ..reconstruct.photo import load_photo
from ..scene.folder import Scene, load_scene, save_scene
from ..scene.material import load_preset
from ..scene.model import Ground, SceneModel
from ..scene.scene_object import SceneObject
from .scene_bodies import mass_of


def mask_requests(
    path: Path, photo: Path, folder: Path, *, max_size: int, only: Sequence[str] = ()
) -> tuple[ObjectRequest, ...]:
    """Return an object request for each mask in ``path`` (``sim.importers.masks``) of ``photo``; writes the masks to
    ``folder``, where a correction finds them again.

    max_size: longest side in pixels of the written masks, the resolution of the reconstruction. only: names to import;
    () for all. Raises InputError for files that cannot be read or hold no mask.
    """
    picture = load_photo(photo, max_size)
    found = read_masks(path, picture.width, picture.height, photo.name, only)
    if not found:
        raise InputError(f"{path}: contains no mask; give --box around each object instead")
    requests = []
    for item in found:
        target = folder / f"{item.name}.png"
        with replacing(target) as partial:
            Image.fromarray(item.mask.astype(np.uint8) * 255).save(partial)
        requests.append(ObjectRequest(mask=target, name=item.name, kind=item.kind))
    return tuple(requests)


def import_folder(
    root: Path,
    *,
    out: Path,
    size_m: float | None = None,
    settings: Path | None = None,
    up: str | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Scene:
    """Return the scene folder ``out`` made of ``root``: a folder of PhysGen3D or PhysGen, splats, MJCF or URDF.

    size_m: largest extent of the first object in metres. settings: YAML file of PhysGen3D's simulation. up: up axis of
    a splat file, one of ``SPLAT_UP_AXES``. Raises InputError for anything else and for arguments that do
    not apply, and what the importers raise.
    """
    if root.suffix.lower() in SUFFIXES and not root.is_dir():
        if size_m is not None or settings is not None or up is not None:
            raise InputError(
                f"{root}: a model of rigid bodies has its own size and axes; omit --size, --settings, --up"
            )
        return import_rigid_model(root, out=out, on_event=on_event)
    if root.is_file():
        if settings is not None:
            raise InputError(f"--settings {settings}: {root} is a splat file, which has none; omit the flag")
        return import_splats(root, out=out, size_m=size_m, up=up or DEFAULT_UP_AXIS, on_event=on_event)
    if up is not None:
        raise InputError(f"--up {up}: {root} is not a splat file; omit the flag")
    if (root / TRANSFORM_FILE).is_file():
        return import_physgen3d(root, out=out, size_m=size_m, settings=settings, on_event=on_event)
    if (root / SETTINGS).is_file() and (root / MASKS).is_file():
        if settings is not None:
            raise InputError(f"--settings {settings}: PhysGen's settings are {root / SETTINGS}; omit the flag")
        return import_physgen(root, out=out, size_m=size_m, on_event=on_event, cancelled=cancelled)
    raise InputError(
        f"{root}: contains neither {TRANSFORM_FILE} of PhysGen3D's perception nor {SETTINGS} and {MASKS} of PhysGen; "
        "choose such a folder, a PLY file of splats, MJCF or URDF"
    )


UNIFORM = 0.02
"""Difference of moments or centre, over the body's own, up to which it counts as homogeneous."""


def import_rigid_model(path: Path, *, out: Path, on_event: OnEvent = ignore) -> Scene:
    """Return the new scene folder ``out`` with the rigid bodies of the MJCF or URDF file ``path``.

    Each has the file's mass exactly, as a density of its mesh. Scenes have homogeneous bodies: where the file's inertia
    or centre differ, a notice says by how much. Raises InputError as ``read_rigid_model`` does.
    """
    import trimesh

    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is not empty; choose a new folder for the scene")
    model = read_rigid_model(path)

    def say(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    for note in dict.fromkeys(model.notes):
        say(note)
    objects: list[SceneObject] = []
    for body in model.bodies:
        name = "".join(c if c.isalnum() or c in "_-" else "_" for c in body.name)[:60].strip() or "body"
        while name in {item.name for item in objects}:
            name += "x"
        objects.append(_rigid_object(name, body, say))
    extent = max(float(np.abs(body.vertices).max()) for body in model.bodies)
    ground = None
    if model.ground is not None:
        point, normal, friction = model.ground
        ground = Ground(point=_three(point), normal=_three(normal), friction=min(max(friction, 0.0), 10.0))
    elif path.suffix.lower() == ".urdf":
        ground = Ground()
    scene = SceneModel(
        camera=overview_camera(max(extent, 0.1)), objects=tuple(objects), photo=None, background=None, ground=ground,
        gravity=model.gravity,
    )  # fmt: skip
    with replacing(out) as folder:
        (folder / "meshes").mkdir(parents=True)
        for item, body in zip(objects, model.bodies, strict=True):
            trimesh.Trimesh(body.vertices, body.faces, process=False).export(folder / item.mesh)
        save_scene(folder, scene)
        if out.is_dir():
            out.rmdir()
    return load_scene(out)


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _rigid_object(name: str, body: RigidModelBody, say: Callable[[str], None]) -> SceneObject:
    size = float(np.ptp(body.vertices, axis=0).max())
    item = SceneObject(
        name=name,
        mesh=f"meshes/{name}.ply",
        size_m=size,
        role="dynamic" if body.free else "collider",
        material=dataclasses.replace(load_preset("wood"), density=1.0),
        friction=None if body.friction is None else min(max(body.friction, 0.0), 10.0),
    )
    if not body.free:
        return item
    uniform = mass_of(item, body.vertices, body.faces)
    density = body.inertia.mass / uniform.mass
    if not 0.01 <= density <= 30_000:
        raise InputError(f"object {name}: {body.inertia.mass:.3g} kg in its shapes are {density:.3g} kg/m³: no matter")
    wanted = np.linalg.eigvalsh(body.inertia.tensor)
    away = np.abs(np.sort(uniform.inertia) * density / np.maximum(wanted, 1e-300) - 1).max()
    shift = float(np.linalg.norm(uniform.centre - body.inertia.centre))
    if away > UNIFORM or shift > UNIFORM * size:
        say(
            f"{name}: as a homogeneous body its moments of inertia are up to {100 * away:.0f} % from the file's, its "
            f"centre {1000 * shift:.1f} mm"
        )
    return dataclasses.replace(item, material=dataclasses.replace(item.material, density=density))
