# SPDX-License-Identifier: MIT
"""A folder of PhysGen (rigid bodies in the plane of an image), read as it is, and turned into a scene folder.

What the files mean is read from its source (github.com/stevenlsw/physgen at c48b57a: ``simulation/animate.py`` and
``animate_utils.py`` read them; ``data/*/sim.yaml``):

- ``original.png``, ``inpaint.png`` (the same without its objects), ``mask.png``: a number for each object, 0 for the
  background; numbers that ``obj_info`` does not have stay in the background.
- ``sim.yaml``: ``obj_info``, by number: ``label``, ``mass`` or ``density`` (per pixel), ``friction``, ``elasticity``,
  ``primitive`` (circle or polygon); ``gravity`` in pixels/s², downward; ``init_velocity``, by number, [x, y] in
  pixels/s, y downward; ``init_acc``, by number: applied once as an impulse of that times the mass, so it adds to the
  velocity; ``edge_list``, walls in pixels; ``ground_friction`` (1) and ``ground_elasticity`` (0) of these. Its engine,
  Chipmunk, multiplies the frictions and elasticities of two surfaces.

PhysGen simulates flat bodies in the image plane. Here its masks become bodies by the usual reconstruction, and its
numbers are carried over as far as they mean something in space (docs/reconstruction.md)."""

from __future__ import annotations

import dataclasses
import itertools
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..atomic import scratch_prefix
from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..reconstruct import ObjectRequest, ReconstructOptions
from ..reconstruct.photo import load_photo
from ..scene.folder import Scene, inside, load_scene, save_scene
from ..scene.material import Material
from ..scene.meshes import load_object_mesh
from ..scene.model import SceneModel, SceneObject, Vector
from ..scene.scene_object import Contact
from ..scene.scene_output import replacing_folder
from ..validation import GROUND, checked_number, checked_numbers, read_yaml, valid_names
from .image_masks import read_grey_image

SETTINGS, MASKS, PHOTO, BACKGROUND = "sim.yaml", "mask.png", "original.png", "inpaint.png"
MAX_OBJECTS = 256
_KEYS_READ = {
    "obj_info",
    "gravity",
    "init_velocity",
    "init_acc",
    "edge_list",
    "ground_friction",
    "ground_elasticity",
    "cat",
    "size",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class PhysgenObject:
    """One body. number: in ``mask.png``; label: kind of object, or None; mask: (H, W).

    mass: above 0, without unit; friction, elasticity: of its surface; velocity: pixels/s, right and down.
    """

    number: int
    label: str | None
    mask: NDArray[np.bool_]
    mass: float
    friction: float
    elasticity: float
    velocity: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class PhysgenFolder:
    """Content of a folder. gravity: pixels/s², at least 0; 0 is a view from above. background: None if missing.

    walls: number of edges. unused: keys of ``sim.yaml`` without a meaning here, sorted.
    """

    root: Path
    photo: Path
    background: Path | None
    objects: tuple[PhysgenObject, ...]
    gravity: float
    walls: int
    ground_friction: float
    ground_elasticity: float
    unused: tuple[str, ...]


def read_physgen(root: Path) -> PhysgenFolder:
    """Return the checked content of the folder ``root``; the photo is not opened. Raises InputError."""
    path = _required(root, SETTINGS)
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected keys and values, as in PhysGen's data/pool/sim.yaml")
    entries = data.get("obj_info")
    if not isinstance(entries, dict) or not 0 < len(entries) <= MAX_OBJECTS:
        raise InputError(f"{path}: obj_info: expected 1 to {MAX_OBJECTS} objects by their number in {MASKS}")
    values = read_grey_image(_required(root, MASKS))
    velocities = _by_number(data, "init_velocity", path)
    kicks = _by_number(data, "init_acc", path)
    objects = []
    for key, entry in entries.items():
        ident = _object_number(key, f"{path}: obj_info")
        parts = [found[ident] for found in (velocities, kicks) if ident in found]
        velocity = (sum(part[0] for part in parts), sum(part[1] for part in parts))
        objects.append(_object(ident, entry, values, velocity, path))
    edges = data.get("edge_list")
    background = inside(root, BACKGROUND)
    return PhysgenFolder(
        root=root,
        photo=_required(root, PHOTO),
        background=background if background.is_file() else None,
        objects=tuple(objects),
        gravity=_optional(data, "gravity", 980.0, 0, 1e6, str(path)),
        walls=len(edges) if isinstance(edges, list) else 0,
        ground_friction=_optional(data, "ground_friction", 1.0, 0, 10, str(path)),
        ground_elasticity=_optional(data, "ground_elasticity", 0.0, 0, 1, str(path)),
        unused=tuple(sorted(str(key)[:60] for key in data if key not in _KEYS_READ)),
    )


def _object(ident: int, entry: Any, values: NDArray[Any], velocity: tuple[float, float], path: Path) -> PhysgenObject:
    where = f"{path}: obj_info[{ident}]"
    if not isinstance(entry, dict):
        raise InputError(f"{where}: expected label, mass or density, friction, elasticity and primitive")
    mask = np.asarray(values == ident)
    area = int(np.count_nonzero(mask))
    if area == 0:
        raise InputError(f"{where}: {MASKS} has no pixel of that number; remove the entry or restore the image")
    if entry.get("mass") is not None:
        mass = checked_number(entry["mass"], f"{where}.mass", 1e-9, 1e12)
    else:
        mass = area * _optional(entry, "density", 1.0, 1e-9, 1e9, where)
    label = entry.get("label")
    return PhysgenObject(
        number=ident,
        label=label.strip()[:64] or None if isinstance(label, str) else None,
        mask=mask,
        mass=mass,
        friction=_optional(entry, "friction", 0.4, 0, 10, where),
        elasticity=_optional(entry, "elasticity", 0.5, 0, 1, where),
        velocity=velocity,
    )


def _by_number(data: dict[Any, Any], key: str, path: Path) -> dict[int, tuple[float, ...]]:
    entries = data.get(key) or {}
    if not isinstance(entries, dict):
        raise InputError(f"{path}: {key}: expected [x, y] by the objects' numbers")
    return {
        _object_number(i, f"{path}: {key}"): checked_numbers(v, 2, f"{path}: {key}[{i}]", 1e6)
        for i, v in entries.items()
    }


def _object_number(key: Any, where: str) -> int:
    if isinstance(key, str) and key.isascii() and key.isdigit() and len(key) < 6:
        key = int(key)
    if type(key) is not int or not 0 < key < 2**16:
        raise InputError(f"{where}: {str(key)[:60]!r} is not the number of an object in {MASKS}")
    return key


def _optional(data: dict[Any, Any], key: str, usual: float, low: float, high: float, where: str) -> float:
    value = data.get(key)
    return usual if value is None else checked_number(value, f"{where}: {key}", low, high)


def _required(root: Path, name: str) -> Path:
    path = inside(root, name)
    if not path.is_file():
        raise InputError(f"{path}: is missing; choose a folder of PhysGen, with {SETTINGS}, {MASKS} and {PHOTO}")
    return path


GRAVITY = 9.81
ABOVE_DEG = 85.0
"""Camera pitch for a view from above, the steepest that the reconstruction accepts."""
DENSITY = 1000.0
"""Mean density of all bodies in kg/m³: PhysGen's masses have no unit, only their ratios are kept."""
MAX_PAIRS = 512
MAX_SIDE = 8192

Notice = Callable[[str], None]


def import_physgen(
    root: Path,
    *,
    out: Path,
    size_m: float | None = None,
    options: ReconstructOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> Scene:
    """Return the scene folder ``out`` made of PhysGen's folder ``root``.

    size_m: largest extent of the first object in metres, 1e-4 to 1e3. None: the size at which 9.81 m/s² is PhysGen's
    gravity in pixels/s²; without gravity, ``options.default_size_m``.
    options: of the reconstruction; ``inpainter`` is set to the folder's own background unless given.
    Raises what ``reconstruct`` raises, and InputError for a folder that cannot be read.
    """

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    source = read_physgen(root)
    settings = _reconstruct_options(source, options or ReconstructOptions())
    with tempfile.TemporaryDirectory(prefix=scratch_prefix("import")) as temporary, replacing_folder(out) as partial:
        requests = object_requests(source, Path(temporary), size_m)
        from ..reconstruct import reconstruct_photo

        folder = reconstruct_photo(source.photo, requests, partial, settings, on_event, cancelled)
        save_scene(partial, with_motion(source, folder, notice))
        _report(source, notice)
    return load_scene(out)


def object_requests(source: PhysgenFolder, masks: Path, size_m: float | None = None) -> tuple[ObjectRequest, ...]:
    """Return the objects to reconstruct; their masks are written to the folder ``masks``.

    size_m: of the first object, as in ``import_physgen``. Raises InputError.
    """
    picture = load_photo(source.photo, MAX_SIDE)
    names = valid_names([item.label or f"object_{item.number}" for item in source.objects])
    requests: list[ObjectRequest] = []
    for name, item in zip(names, source.objects, strict=True):
        path = masks / f"{name}.png"
        Image.fromarray(item.mask.astype(np.uint8) * 255).save(path)
        rows, columns = np.flatnonzero(item.mask.any(axis=1)), np.flatnonzero(item.mask.any(axis=0))
        # The box is in pixels of the photo; the mask may have another size.
        across, down = picture.original_size[0] / item.mask.shape[1], picture.original_size[1] / item.mask.shape[0]
        box = (columns[0] * across, rows[0] * down, (columns[-1] + 1) * across, (rows[-1] + 1) * down)
        requests.append(
            ObjectRequest(
                box=(float(box[0]), float(box[1]), float(box[2]), float(box[3])),
                mask=path,
                name=name,
                kind=item.label,
                size_m=None if requests else size_m or _usual_size(source, item),
            )
        )
    return tuple(requests)


def _usual_size(source: PhysgenFolder, item: PhysgenObject) -> float | None:
    """Return the size in metres at which ``source.gravity`` pixels/s² is 9.81 m/s²; None without gravity."""
    if source.gravity <= 0:
        return None
    sides = [np.ptp(np.flatnonzero(item.mask.any(axis=axis))) + 1 for axis in (0, 1)]
    return min(1e3, max(1e-4, float(max(sides)) * GRAVITY / source.gravity))


def _reconstruct_options(source: PhysgenFolder, options: ReconstructOptions) -> ReconstructOptions:
    changes: dict[str, object] = {}
    if options.inpainter is None and source.background is not None:
        changes["inpainter"] = f"picture:{source.background.resolve()}"
    if source.gravity <= 0 and options.pitch_deg is None and options.horizon_y is None:
        changes["pitch_deg"] = ABOVE_DEG
    return dataclasses.replace(options, **changes)  # type: ignore[arg-type]


def with_motion(source: PhysgenFolder, folder: Scene, notice: Notice) -> SceneModel:
    """Return the scene of ``folder`` with PhysGen's masses, surfaces and velocities; objects in PhysGen's order.

    Image-space paths are preserved if velocity² / (gravity · length) is: velocities in pixels/s become m/s by the
    square root of the ratio of the gravities, which is 1 at PhysGen's own size. Raises InputError where the numbers of
    objects differ.
    """
    scene = folder.model
    if len(scene.objects) != len(source.objects):
        raise InputError(f"{folder.root}: has {len(scene.objects)} objects, {source.root} {len(source.objects)}")
    meshes = [load_object_mesh(folder, item) for item in scene.objects]
    volumes = [_volume(mesh.vertices, mesh.faces) for mesh in meshes]
    total = sum(item.mass for item in source.objects)
    objects = []
    for item, made, mesh, volume in zip(source.objects, scene.objects, meshes, volumes, strict=True):
        wanted = DENSITY * item.mass / total * sum(volumes) / volume
        density = min(3e4, max(1.0, wanted))
        if density != wanted:
            notice(f"{made.name}: its mass implies a density of {wanted:.3g} kg/m³; {density:g} is used")
        depth = float(scene.camera.project(mesh.vertices.mean(axis=0))[2])
        objects.append(
            dataclasses.replace(
                made,
                material=Material(law="rigid", density=density),
                velocity=_velocity(item, depth / scene.camera.fx, source.gravity),
                friction=item.friction,
                restitution=item.elasticity,
            )
        )
    ground = scene.ground
    if ground is not None:
        ground = dataclasses.replace(ground, friction=source.ground_friction, restitution=source.ground_elasticity)
    contacts = _contacts(source, objects)
    if not contacts:
        notice("too many pairs of objects for PhysGen's products of frictions; the usual rule for pairs is used")
    return dataclasses.replace(scene, objects=tuple(objects), ground=ground, contacts=contacts)


def _velocity(item: PhysgenObject, metres_per_pixel: float, gravity: float) -> Vector:
    right, down = item.velocity
    if gravity <= 0:
        # Seen from above: the image plane is the ground.
        return right * metres_per_pixel, -down * metres_per_pixel, 0.0
    factor = math.sqrt(GRAVITY * metres_per_pixel / gravity)
    return right * factor, 0.0, -down * factor


def _contacts(source: PhysgenFolder, objects: list[SceneObject]) -> tuple[Contact, ...]:
    """Return contacts whose coefficients are the products of both surfaces'; none where there are too many pairs."""
    surfaces = [(made.name, item.friction, item.elasticity) for made, item in zip(objects, source.objects, strict=True)]
    surfaces.append((GROUND, source.ground_friction, source.ground_elasticity))
    pairs = list(itertools.combinations(surfaces, 2))
    if len(pairs) > MAX_PAIRS:
        return ()
    return tuple(
        Contact(between=(a, b), friction=min(10.0, first * second), restitution=one * other)
        for (a, first, one), (b, second, other) in pairs
    )


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the volume of a closed mesh in m³, at least a thousandth of its bounding box."""
    corners = vertices[faces] - vertices.mean(axis=0)
    volume = float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)
    return max(abs(volume), 1e-3 * float(np.prod(np.ptp(vertices, axis=0))), 1e-15)


def _report(source: PhysgenFolder, notice: Notice) -> None:
    notice("PhysGen's masses have no unit: their ratios are kept, at a mean of 1000 kg/m³")
    if source.gravity <= 0:
        notice("no gravity, so this is a view from above: velocities are along the ground")
    if source.walls:
        notice(f"{source.walls} walls (edge_list) are not imported; the ground is the one estimated from the photo")
    if source.unused:
        notice(f"sim.yaml: not used: {', '.join(source.unused)}")
