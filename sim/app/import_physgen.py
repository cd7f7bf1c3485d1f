# SPDX-License-Identifier: MIT
"""A folder of PhysGen → a scene folder: its masks reconstructed, its plane motion given to the bodies.

PhysGen simulates flat bodies in the picture's plane. Here its masks become bodies by the usual reconstruction, and its
numbers are carried over as far as they mean something in space (docs/importing.md).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import InputError
from ..events import IsCancelled, OnEvent, ignore, never
from ..importers.physgen import PhysgenFolder, PhysgenObject, read_physgen
from ..reconstruct import ObjectRequest, ReconstructOptions, reconstruct
from ..reconstruct.output import replacing_folder
from ..reconstruct.photo import load_photo
from ..scene.control import GROUND, Contact
from ..scene.folder import SceneFolder, load_scene, save_scene
from ..scene.matter import Material
from ..scene.meshes import load_object_mesh
from ..scene.model import Scene, SceneObject, Vector
from ..scene.names import fitting_names

GRAVITY = 9.81
ABOVE_DEG = 85.0
"""Pitch of a view from above, the steepest that the reconstruction takes."""
DENSITY = 1000.0
"""Mean density in kg/m³ of all bodies together: PhysGen's masses have no unit, only their ratios are carried over."""
MOST_PAIRS = 512
MAX_SIDE = 8192

Notice = Callable[[str], None]


def import_physgen(
    root: Path,
    out: Path,
    *,
    size_m: float | None = None,
    options: ReconstructOptions | None = None,
    on_event: OnEvent = ignore,
    cancelled: IsCancelled = never,
) -> SceneFolder:
    """Turn PhysGen's folder ``root`` into the scene folder ``out``.

    size_m: largest extent of the first object in metres, 1e-4 to 1e3. None takes the size at which things fall as many
    pixels a second as PhysGen says; where it has no gravity, ``options.default_size_m``.
    options: of the reconstruction; its ``inpainter`` becomes the folder's own background unless one is given.
    Raises what ``reconstruct`` raises, and InputError for a folder that cannot be read.
    """

    def notice(message: str) -> None:
        on_event({"event": "notice", "stage": "import", "message": message})

    source = read_physgen(root)
    settings = _options(source, options or ReconstructOptions())
    with tempfile.TemporaryDirectory(prefix="physgen-import-") as temporary, replacing_folder(out) as partial:
        requests = object_requests(source, Path(temporary), size_m)
        folder = reconstruct(source.photo, requests, partial, settings, on_event, cancelled)
        save_scene(partial, with_motion(source, folder, notice))
        _say(source, notice)
    return load_scene(out)


def object_requests(source: PhysgenFolder, masks: Path, size_m: float | None = None) -> tuple[ObjectRequest, ...]:
    """What to cut out of the photo; the masks are written into the folder ``masks``.

    size_m: of the first object, as ``import_physgen`` takes it. Raises InputError.
    """
    picture = load_photo(source.photo, MAX_SIDE)
    names = fitting_names([item.label or f"object_{item.number}" for item in source.objects])
    requests: list[ObjectRequest] = []
    for name, item in zip(names, source.objects, strict=True):
        path = masks / f"{name}.png"
        Image.fromarray(item.mask.astype(np.uint8) * 255).save(path)
        rows, columns = np.flatnonzero(item.mask.any(axis=1)), np.flatnonzero(item.mask.any(axis=0))
        # The box is in pixels of the photo, the mask perhaps of another size.
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
    """Metres at which a fall of ``source.gravity`` pixels/s² is one of 9.81 m/s²; None without gravity."""
    if source.gravity <= 0:
        return None
    sides = [np.ptp(np.flatnonzero(item.mask.any(axis=axis))) + 1 for axis in (0, 1)]
    return min(1e3, max(1e-4, float(max(sides)) * GRAVITY / source.gravity))


def _options(source: PhysgenFolder, options: ReconstructOptions) -> ReconstructOptions:
    changes: dict[str, object] = {}
    if options.inpainter is None and source.background is not None:
        changes["inpainter"] = f"picture:{source.background.resolve()}"
    if source.gravity <= 0 and options.pitch_deg is None and options.horizon_y is None:
        changes["pitch_deg"] = ABOVE_DEG
    return dataclasses.replace(options, **changes)  # type: ignore[arg-type]


def with_motion(source: PhysgenFolder, folder: SceneFolder, notice: Notice) -> Scene:
    """The scene of ``folder`` with PhysGen's masses, surfaces and velocities; its objects in PhysGen's order.

    A path in the picture stays the same if velocity² over gravity times length does: velocities in pixels/s become
    m/s by the root of the two gravities' ratio, which is 1 where the size is PhysGen's own.
    """
    scene = folder.scene
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
            notice(f"{made.name}: its mass asks for a density of {wanted:.3g} kg/m³; {density:g} is taken")
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
        notice("too many pairs of objects for PhysGen's products of frictions; they follow this program's rule")
    return dataclasses.replace(scene, objects=tuple(objects), ground=ground, contacts=contacts)


def _velocity(item: PhysgenObject, metres_per_pixel: float, gravity: float) -> Vector:
    right, down = item.velocity
    if gravity <= 0:
        # Seen from above: the picture's plane is the ground.
        return right * metres_per_pixel, -down * metres_per_pixel, 0.0
    factor = math.sqrt(GRAVITY * metres_per_pixel / gravity)
    return right * factor, 0.0, -down * factor


def _contacts(source: PhysgenFolder, objects: list[SceneObject]) -> tuple[Contact, ...]:
    """A pair's coefficients are the products of both surfaces'; none at all where the pairs are too many."""
    surfaces = [(made.name, item.friction, item.elasticity) for made, item in zip(objects, source.objects, strict=True)]
    surfaces.append((GROUND, source.ground_friction, source.ground_elasticity))
    pairs = list(itertools.combinations(surfaces, 2))
    if len(pairs) > MOST_PAIRS:
        return ()
    return tuple(
        Contact(between=(a, b), friction=min(10.0, first * second), restitution=one * other)
        for (a, first, one), (b, second, other) in pairs
    )


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Of a closed mesh, m³; at least a thousandth of its bounding box."""
    corners = vertices[faces] - vertices.mean(axis=0)
    volume = float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)
    return max(abs(volume), 1e-3 * float(np.prod(np.ptp(vertices, axis=0))), 1e-15)


def _say(source: PhysgenFolder, notice: Notice) -> None:
    notice("PhysGen's masses have no unit: their ratios are kept, at 1000 kg/m³ on the whole")
    if source.gravity <= 0:
        notice("no gravity, so this is a view from above: velocities are along the ground")
    if source.walls:
        notice(f"{source.walls} walls (edge_list) are not carried over; the ground is the one found in the photo")
    if source.unused:
        notice(f"sim.yaml: not used: {', '.join(source.unused)}")
