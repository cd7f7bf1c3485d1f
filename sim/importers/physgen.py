# SPDX-License-Identifier: MIT
"""A folder of PhysGen: rigid bodies in the plane of a picture, read as they are.

What the files mean is read from its source (github.com/stevenlsw/physgen at c48b57a: ``simulation/animate.py`` and
``animate_utils.py`` read them; ``data/*/sim.yaml``):

- ``original.png``, ``inpaint.png`` (the same without its objects), ``mask.png``: a number for each object, 0 for the
  background; numbers that ``obj_info`` does not have stay in the background.
- ``sim.yaml``: ``obj_info``, by number: ``label``, ``mass`` or ``density`` (per pixel), ``friction``, ``elasticity``,
  ``primitive`` (circle or polygon); ``gravity`` in pixels/s², downward; ``init_velocity``, by number, [x, y] in
  pixels/s, y downward; ``init_acc``, by number: applied once as an impulse of that times the mass, so it adds to the
  velocity; ``edge_list``, walls in pixels; ``ground_friction`` (1) and ``ground_elasticity`` (0) of these. Its engine,
  Chipmunk, multiplies the frictions and elasticities of two surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.folder import inside
from .segments import read_grey
from .yaml_fields import number, numbers, read_yaml

SETTINGS, MASKS, PHOTO, BACKGROUND = "sim.yaml", "mask.png", "original.png", "inpaint.png"
MAX_OBJECTS = 256
_TAKEN = {
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
    """One body. number: in ``mask.png``; label: what it is, or None; mask: (H, W).

    mass: in a unit of its own, above 0; friction, elasticity: of its surface. velocity: pixels/s, right and down.
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
    """A read folder. gravity: pixels/s², 0 or more; 0 is a view from above. background: None where it is missing.

    walls: how many edges it has. unused: keys of ``sim.yaml`` that mean nothing to this project, sorted.
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
    """Read and check the folder ``root``; the photo is the caller's to open. Raises InputError."""
    path = _required(root, SETTINGS)
    data = read_yaml(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected keys and values, as in PhysGen's data/pool/sim.yaml")
    entries = data.get("obj_info")
    if not isinstance(entries, dict) or not 0 < len(entries) <= MAX_OBJECTS:
        raise InputError(f"{path}: obj_info: expected 1 to {MAX_OBJECTS} objects by their number in {MASKS}")
    values = read_grey(_required(root, MASKS))
    velocities = _by_number(data, "init_velocity", path)
    kicks = _by_number(data, "init_acc", path)
    objects = []
    for key, entry in entries.items():
        ident = _ident(key, f"{path}: obj_info")
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
        unused=tuple(sorted(str(key)[:60] for key in data if key not in _TAKEN)),
    )


def _object(ident: int, entry: Any, values: NDArray[Any], velocity: tuple[float, float], path: Path) -> PhysgenObject:
    where = f"{path}: obj_info[{ident}]"
    if not isinstance(entry, dict):
        raise InputError(f"{where}: expected label, mass or density, friction, elasticity and primitive")
    mask = np.asarray(values == ident)
    area = int(np.count_nonzero(mask))
    if area == 0:
        raise InputError(f"{where}: {MASKS} has no pixel of that number; take the entry out or restore the picture")
    if entry.get("mass") is not None:
        mass = number(entry["mass"], f"{where}.mass", 1e-9, 1e12)
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
    return {_ident(i, f"{path}: {key}"): numbers(v, 2, f"{path}: {key}[{i}]", 1e6) for i, v in entries.items()}


def _ident(key: Any, where: str) -> int:
    if isinstance(key, str) and key.isascii() and key.isdigit() and len(key) < 6:
        key = int(key)
    if type(key) is not int or not 0 < key < 2**16:
        raise InputError(f"{where}: {str(key)[:60]!r} is no number of an object in {MASKS}")
    return key


def _optional(data: dict[Any, Any], key: str, usual: float, low: float, high: float, where: str) -> float:
    value = data.get(key)
    return usual if value is None else number(value, f"{where}: {key}", low, high)


def _required(root: Path, name: str) -> Path:
    path = inside(root, name)
    if not path.is_file():
        raise InputError(f"{path}: is missing; choose a folder of PhysGen, with {SETTINGS}, {MASKS} and {PHOTO}")
    return path
