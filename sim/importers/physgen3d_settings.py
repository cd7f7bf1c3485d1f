# SPDX-License-Identifier: MIT
"""The settings of PhysGen3D's simulation: a YAML file beside its output folders (``data/sim/NAME.yaml``).

``simulation.py`` at 72d7b63 takes: ``velocities``, for each object [right, forward, down], on the axes ``down``, along
gravity, ``right``, the camera's x, and ``forward`` = down x right, which points **towards** the camera (y x x = -z);
``friction`` of the ground; ``E_default`` in Pa; ``scale``, which multiplies gravity (9.8 times it, in its unit of
length) and E; ``pull_to_ground``; ``damping``, ``filling``, ``size`` and ``R`` of its grid, ``max_num_particles``,
``density_default``; ``input_path``, the folder of ``transform.json``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .yaml_fields import number, numbers, read_yaml

GRAVITY = 9.8
"""Of its simulation, at ``scale`` 1, in its unit of length over s²."""
MAX_OBJECTS = 256
_TAKEN = {"velocities", "friction", "E_default", "density_default", "scale", "pull_to_ground", "input_path"}


@dataclass(frozen=True, kw_only=True)
class Physgen3dSettings:
    """velocities: right, towards the camera, down, in the folder's unit over s, one an object or one for all.

    folder: name of the output folder that they are for, where they say. friction, youngs_modulus (Pa), density (kg/m³):
    None where they are not told. scale: of gravity. on_ground: whether objects are moved onto the ground. unused: keys
    that mean nothing to this project's simulation, sorted.
    """

    path: Path
    folder: str | None
    velocities: tuple[tuple[float, ...], ...]
    for_all: bool
    friction: float | None
    youngs_modulus: float | None
    density: float | None
    scale: float
    on_ground: bool
    unused: tuple[str, ...]

    def velocity(self, index: int) -> tuple[float, ...] | None:
        """Of object ``index``; None where the file has none for it."""
        if self.for_all:
            return self.velocities[0]
        return self.velocities[index] if index < len(self.velocities) else None


def find_settings(root: Path) -> Path | None:
    """The settings for the output folder ``root``: the one YAML file with velocities in it, or the program's own.

    That is ``data/sim/NAME.yaml`` for ``outputs/NAME``. Raises InputError where there are several in the folder.
    """
    paths = sorted(p for pattern in ("*.yaml", "*.yml") for p in root.glob(pattern) if not p.name.startswith("."))
    found = []
    for path in paths[:64]:
        data = read_yaml(path)
        if isinstance(data, dict) and "velocities" in data:
            found.append(path)
    if len(found) > 1:
        raise InputError(f"{root}: both {found[0].name} and {found[1].name} are settings; say which with --settings")
    usual = root.resolve().parent.parent / "data" / "sim" / f"{root.resolve().name}.yaml"
    return found[0] if found else usual if usual.is_file() else None


def read_settings(path: Path) -> Physgen3dSettings:
    """Read and check the settings ``path``. Raises InputError."""
    data = read_yaml(path)
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise InputError(f"{path}: expected keys and values, as in PhysGen3D's data/sim/teddy.yaml")
    given = {key: value for key, value in data.items() if value is not None}

    def optional(key: str, low: float, high: float) -> float | None:
        return number(given[key], f"{path}: {key}", low, high) if key in given else None

    velocities, for_all = _velocities(given.get("velocities", []), path)
    pulled = given.get("pull_to_ground", True)
    if not isinstance(pulled, bool):
        raise InputError(f"{path}: pull_to_ground is {str(pulled)[:60]}: expected true or false")
    scale = optional("scale", 1e-6, 1e6)
    return Physgen3dSettings(
        path=path,
        folder=_folder(given.get("input_path")),
        velocities=velocities,
        for_all=for_all,
        friction=optional("friction", 0, 10),
        youngs_modulus=optional("E_default", 1e2, 1e12),
        density=optional("density_default", 1e-3, 3e4),
        scale=1.0 if scale is None else scale,
        on_ground=pulled,
        unused=tuple(sorted(set(given) - _TAKEN)),
    )


def _folder(value: object) -> str | None:
    return PurePosixPath(value.replace("\\", "/")).name or None if isinstance(value, str) else None


def _velocities(value: object, path: Path) -> tuple[tuple[tuple[float, ...], ...], bool]:
    where = f"{path}: velocities"
    if not isinstance(value, list) or len(value) > MAX_OBJECTS:
        raise InputError(f"{where}: expected a list of [right, forward, down], one an object")
    if len(value) == 3 and not any(isinstance(entry, list) for entry in value):
        return (numbers(value, 3, where, limit=1e4),), True
    return tuple(numbers(entry, 3, f"{where}[{i}]", limit=1e4) for i, entry in enumerate(value)), False


def camera_velocity(velocity: tuple[float, ...], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """``velocity`` on the camera's axes, (3,), as ``run_mpm_simulation`` adds it up; normal: into the ground, (3,)."""
    right = np.array([1.0, 0.0, 0.0])
    towards = np.cross(normal, right)
    return np.asarray(velocity[0] * right + velocity[1] * towards + velocity[2] * normal)
