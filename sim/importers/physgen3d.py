# SPDX-License-Identifier: MIT
"""The output folder of PhysGen3D's perception and the settings of its simulation, read as they are.

What the files mean is read from its source (github.com/by-luckk/PhysGen3D at 72d7b63: ``perception.py`` writes them,
``simulation.py`` and ``rendering.py`` read them, ``locate/fit_object_pytorch3d.py`` makes the numbers):

- ``transform.json``: ``object_names``; ``matrices``, for each a 4x4 similarity from its mesh to the camera's axes
  (OpenCV: x right, y down, z forward), columns as in p' = M p; ``matrices_optimized``, the same after a descent on
  depth and silhouette; ``plane_model`` [a, b, c, d], the ground a x + b y + c z + d = 0 on those axes; ``fov``, the
  photo's borders [left, top, right, bottom] as x/z and y/z; perhaps ``E`` in Pa and ``density`` in kg/m³, one an
  object. Lengths are those of DUSt3R's depth, of no known unit.
- ``raw_image.jpg``, ``inpaint/inpainted_all.jpg``, ``mask/mask_I.jpg``, ``mask/mask.json``: for each object ``value``
  (from 1), ``label``, ``logit`` and ``box``, after an entry for the background; ``meshes/NAME.obj`` and its texture
  ``meshes/NAME.png``; after inverse rendering ``meshes/NAME_albedo.png``, ``_roughness`` and ``_metallic``.

Its pixels are square: the poses are fitted with one focal length, width / (right - left), and rendered so. Where the
photo's middle lies follows from all four borders.

The simulation's settings are a YAML file beside the output folders (``data/sim/NAME.yaml``): ``velocities``, for each
object [right, forward, down], on the axes ``down``, along gravity, ``right``, the camera's x, and ``forward`` = down
x right, which points **towards** the camera (y x x = -z); ``friction`` of the ground; ``E_default`` in Pa; ``scale``,
which multiplies gravity (9.8 times it, in its unit of length) and E; ``pull_to_ground``; ``damping``, ``filling``,
``size`` and ``R`` of its grid, ``max_num_particles``, ``density_default``; ``input_path``, the folder of
``transform.json``.

NumPy only: Blender's own process imports this."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.folder import inside
from ..validation import checked_number, checked_numbers, read_json, read_yaml

TRANSFORM_FILE = "transform.json"
PHOTO, BACKGROUND = "raw_image.jpg", "inpaint/inpainted_all.jpg"
LABEL_FILES = ("mask/mask.json", "mask.json")
MAX_OBJECTS = 256
MAX_TANGENT = 10.0
"""Tangent of half the angle of view: 169 degrees."""


@dataclass(frozen=True, kw_only=True)
class Physgen3dObject:
    """One object. name: as in the folder; kind: its label, or None; mesh, texture, mask: files, or None.

    camera_from_mesh: (4, 4) of ``matrices``; optimized: (4, 4) of ``matrices_optimized``, or None. roughness, metallic:
    image files, or None. youngs_modulus: Pa; density: kg/m³; None where unspecified.
    """

    name: str
    kind: str | None
    camera_from_mesh: NDArray[np.float64]
    optimized: NDArray[np.float64] | None
    mesh: Path
    texture: Path | None
    roughness: Path | None
    metallic: Path | None
    mask: Path | None
    youngs_modulus: float | None
    density: float | None


@dataclass(frozen=True, kw_only=True)
class Physgen3dFolder:
    """Content of a folder; lengths in its own unit, on camera axes (x right, y down, z forward).

    view: the photo's borders left, top, right, bottom on the plane z = 1. normal: unit vector (3,) into the ground;
    height: camera height above it, positive. background: None if missing.
    """

    root: Path
    photo: Path
    background: Path | None
    view: tuple[float, float, float, float]
    normal: NDArray[np.float64]
    height: float
    objects: tuple[Physgen3dObject, ...]

    @property
    def world_from_camera(self) -> NDArray[np.float64]:
        """(4, 4) camera pose: Z up, X right of the camera, Y away from it, origin on the ground below the camera."""
        up = -self.normal
        right = np.array([1.0, 0.0, 0.0]) - up[0] * up
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(up, right), up])
        pose[2, 3] = self.height
        return pose

    def intrinsics(self, width: int, height: int) -> tuple[float, float, float]:
        """Return focal length and principal point (f, cx, cy) in pixels of the photo at ``width`` x ``height``.

        DUSt3R crops the photo about its centre to multiples of 16, so the centre of the borders is the photo's even
        where their heights differ.
        """
        left, top, right, bottom = self.view
        focal = width / (right - left)
        return focal, width / 2 - focal * (left + right) / 2, height / 2 - focal * (top + bottom) / 2


def read_physgen3d(root: Path) -> Physgen3dFolder:
    """Return the checked content of the folder ``root``; images and meshes are not opened.

    Raises InputError when ``transform.json``, the photo or a mesh is missing, or a number is invalid.
    """
    path = root / TRANSFORM_FILE
    if not path.is_file():
        raise InputError(f"{root}: contains no {TRANSFORM_FILE}; choose an output folder of PhysGen3D's perception")
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object")
    names = _names(data, path)
    plane = _numbers(data.get("plane_model"), 4, f"{path}: plane_model")
    view = _view(data, path)
    normal, height = _ground(plane, path)
    matrices = _matrices(data, "matrices", names, path)
    optimized: list[NDArray[np.float64]] | list[None] = [None] * len(names)
    if data.get("matrices_optimized") is not None:
        optimized = _matrices(data, "matrices_optimized", names, path)
    kinds = _kinds(root, len(names))
    moduli, densities = (_per_object(data, key, names, path) for key in ("E", "density"))
    return Physgen3dFolder(
        root=root,
        photo=_required(root, PHOTO),
        background=_optional(root, BACKGROUND),
        view=view,
        normal=normal,
        height=height,
        objects=tuple(
            Physgen3dObject(
                name=name,
                kind=kinds[i],
                camera_from_mesh=matrices[i],
                optimized=optimized[i],
                mesh=_required(root, f"meshes/{name}.obj"),
                texture=_optional(root, f"meshes/{name}_albedo.png") or _optional(root, f"meshes/{name}.png"),
                roughness=_optional(root, f"meshes/{name}_roughness.png"),
                metallic=_optional(root, f"meshes/{name}_metallic.png"),
                mask=_optional(root, f"mask/mask_{i}.jpg"),
                youngs_modulus=moduli[i],
                density=densities[i],
            )
            for i, name in enumerate(names)
        ),
    )


def _names(data: dict[str, Any], path: Path) -> list[str]:
    names = data.get("object_names")
    good = isinstance(names, list) and all(isinstance(name, str) and name for name in names)
    if not good or not 0 < len(names or []) <= MAX_OBJECTS:
        raise InputError(f"{path}: object_names: expected a list of 1 to {MAX_OBJECTS} names")
    assert isinstance(names, list)
    if len(set(names)) != len(names):
        raise InputError(f"{path}: object_names: {names!r} repeats a name; run the perception again")
    return names


def _kinds(root: Path, count: int) -> list[str | None]:
    """Return the labels of ``mask.json``; Nones where it is missing or has another number of objects."""
    path = next((root / name for name in LABEL_FILES if (root / name).is_file()), None)
    entries = None if path is None else read_json(path)
    if not isinstance(entries, list):
        return [None] * count
    labels = [e.get("label") for e in entries if isinstance(e, dict) and e.get("value") != 0]
    if len(labels) != count:
        return [None] * count
    return [label.strip()[:64] or None if isinstance(label, str) else None for label in labels]


def _list(data: dict[str, Any], key: str, names: list[str], path: Path) -> list[Any]:
    values = data.get(key)
    if not isinstance(values, list) or len(values) != len(names):
        raise InputError(f"{path}: {key}: expected a list of {len(names)}, one per object; run the perception again")
    return values


def _numbers(value: Any, count: int, where: str) -> NDArray[np.float64]:
    if isinstance(value, list) and len(value) == count and all(_is_number(entry) for entry in value):
        return np.array(value, dtype=np.float64)
    raise InputError(f"{where}: expected {count} finite numbers; run the perception again")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12


def _view(data: dict[str, Any], path: Path) -> tuple[float, float, float, float]:
    left, top, right, bottom = (float(v) for v in _numbers(data.get("fov"), 4, f"{path}: fov"))
    good = all(1e-3 <= side <= MAX_TANGENT for side in ((right - left) / 2, (bottom - top) / 2))
    if not good or max(abs(left), abs(top), abs(right), abs(bottom)) > 2 * MAX_TANGENT:
        raise InputError(
            f"{path}: fov is {[left, top, right, bottom]}: expected left, top, right and bottom of the photo as x/z "
            "and y/z; run the perception again"
        )
    return left, top, right, bottom


def _matrices(data: dict[str, Any], key: str, names: list[str], path: Path) -> list[NDArray[np.float64]]:
    return [_matrix(value, f"{path}: {key}[{i}]") for i, value in enumerate(_list(data, key, names, path))]


def _matrix(value: Any, where: str) -> NDArray[np.float64]:
    if not isinstance(value, list) or len(value) != 4:
        raise InputError(f"{where}: expected 4 rows of 4 numbers; run the perception again")
    matrix = np.stack([_numbers(row, 4, where) for row in value])
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = matrix[:3, :3] / scale if scale > 1e-9 else np.zeros((3, 3))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"{where}: expected a rotation, uniform scale and translation; run the perception again")
    return matrix


def _ground(plane: NDArray[np.float64], path: Path) -> tuple[NDArray[np.float64], float]:
    length = float(np.linalg.norm(plane[:3]))
    if length < 1e-9 or abs(plane[1]) < 0.02 * length:
        raise InputError(f"{path}: plane_model is {plane.tolist()}: it is not a ground below the camera")
    # As in simulation.py: the normal is turned downward, along +y.
    plane = plane * math.copysign(1.0, plane[1]) / length
    if plane[3] >= -1e-9:
        raise InputError(f"{path}: plane_model is {plane.tolist()}: the camera is below that ground")
    return plane[:3], float(-plane[3])


def _per_object(data: dict[str, Any], key: str, names: list[str], path: Path) -> list[float | None]:
    if data.get(key) is None:
        return [None] * len(names)
    values = _list(data, key, names, path)
    return [float(number) for number in _numbers(values, len(names), f"{path}: {key}")]


def _required(root: Path, name: str) -> Path:
    path = inside(root, name)
    if not path.is_file():
        raise InputError(f"{path}: is missing; restore it or run PhysGen3D's perception again")
    return path


def _optional(root: Path, name: str) -> Path | None:
    path = inside(root, name)
    return path if path.is_file() else None


GRAVITY = 9.8
"""Gravity of its simulation at ``scale`` 1, in its unit of length over s²."""

_KEYS_READ = {"velocities", "friction", "E_default", "density_default", "scale", "pull_to_ground", "input_path"}


@dataclass(frozen=True, kw_only=True)
class Physgen3dSettings:
    """Settings of a simulation. velocities: right, towards the camera, down, in the folder's unit over s.

    There is one velocity per object, or one ``for_all``. folder: name of the output folder they belong to, or None.
    friction, youngs_modulus (Pa), density (kg/m³): None where unspecified. scale: of gravity. on_ground: whether
    objects are moved onto the ground. unused: keys without a meaning here, sorted.
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
        """Return the velocity of object ``index``, or None."""
        if self.for_all:
            return self.velocities[0]
        return self.velocities[index] if index < len(self.velocities) else None


def find_settings(root: Path) -> Path | None:
    """Return the settings file of the output folder ``root``, or None.

    It is the one YAML file in it with velocities, else ``data/sim/NAME.yaml`` for ``outputs/NAME``. Raises InputError
    where the folder has several.
    """
    paths = sorted(p for pattern in ("*.yaml", "*.yml") for p in root.glob(pattern) if not p.name.startswith("."))
    found = []
    for path in paths[:64]:
        data = read_yaml(path)
        if isinstance(data, dict) and "velocities" in data:
            found.append(path)
    if len(found) > 1:
        raise InputError(f"{root}: both {found[0].name} and {found[1].name} are settings; choose one with --settings")
    usual = root.resolve().parent.parent / "data" / "sim" / f"{root.resolve().name}.yaml"
    return found[0] if found else usual if usual.is_file() else None


def read_settings(path: Path) -> Physgen3dSettings:
    """Return the checked settings in ``path``. Raises InputError."""
    data = read_yaml(path)
    if not isinstance(data, dict) or not all(isinstance(key, str) for key in data):
        raise InputError(f"{path}: expected keys and values, as in PhysGen3D's data/sim/teddy.yaml")
    given = {key: value for key, value in data.items() if value is not None}

    def optional(key: str, low: float, high: float) -> float | None:
        return checked_number(given[key], f"{path}: {key}", low, high) if key in given else None

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
        unused=tuple(sorted(set(given) - _KEYS_READ)),
    )


def _folder(value: object) -> str | None:
    return PurePosixPath(value.replace("\\", "/")).name or None if isinstance(value, str) else None


def _velocities(value: object, path: Path) -> tuple[tuple[tuple[float, ...], ...], bool]:
    where = f"{path}: velocities"
    if not isinstance(value, list) or len(value) > MAX_OBJECTS:
        raise InputError(f"{where}: expected a list of [right, forward, down], one per object")
    if len(value) == 3 and not any(isinstance(entry, list) for entry in value):
        return (checked_numbers(value, 3, where, limit=1e4),), True
    return tuple(checked_numbers(entry, 3, f"{where}[{i}]", limit=1e4) for i, entry in enumerate(value)), False


def camera_velocity(velocity: tuple[float, ...], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``velocity`` on camera axes (3,), as in ``run_mpm_simulation``; normal: into the ground, (3,)."""
    right = np.array([1.0, 0.0, 0.0])
    towards = np.cross(normal, right)
    return np.asarray(velocity[0] * right + velocity[1] * towards + velocity[2] * normal)
