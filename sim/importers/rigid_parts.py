# SPDX-License-Identifier: MIT
"""Common parts of MJCF and URDF: bodies with shapes and inertia, and the reader of numbers and meshes.

Formulas of volumes and inertia are those of homogeneous solids.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..scene.folder import inside
from ..scene.meshes import read_mesh

Array = NDArray[np.float64]
MAX_DEPTH, MAX_PARTS, MAX_VERTICES = 64, 5000, 2_000_000
MAX_ALL_VERTICES = 5 * MAX_VERTICES
"""Of all shapes of a model that are mesh files, as often as they are named."""
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
ROUND = 32
"""Segments of a circle in the meshes of round shapes; volumes and inertia are exact all the same."""


@dataclass(kw_only=True)
class Inertia:
    """mass kg, centre (3,) m, tensor (3, 3) kg m² about the centre; all in one frame."""

    mass: float = 0.0
    centre: Array = field(default_factory=lambda: np.zeros(3))
    tensor: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def placed(self, pose: Array) -> Inertia:
        """Return it in the frame that ``pose`` (4, 4) leads to."""
        turn = pose[:3, :3]
        return Inertia(mass=self.mass, centre=turn @ self.centre + pose[:3, 3], tensor=turn @ self.tensor @ turn.T)

    def __add__(self, other: Inertia) -> Inertia:
        mass = self.mass + other.mass
        if mass <= 0:
            return Inertia()
        centre = (self.mass * self.centre + other.mass * other.centre) / mass
        tensor = np.zeros((3, 3))
        for each in (self, other):
            d = each.centre - centre
            tensor = tensor + each.tensor + each.mass * (d @ d * np.eye(3) - np.outer(d, d))
        return Inertia(mass=mass, centre=centre, tensor=tensor)


@dataclass(kw_only=True)
class RigidModelBody:
    """A body at its place in the world. vertices (V, 3) m, faces (T, 3); free: moves. friction: None where unsaid."""

    name: str
    free: bool
    vertices: Array
    faces: NDArray[np.int64]
    inertia: Inertia
    friction: float | None = None


@dataclass(kw_only=True)
class RigidModel:
    """bodies; gravity m/s²; ground: (point, normal, friction) of the first plane, or None; notes: what was left out."""

    bodies: list[RigidModelBody]
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    ground: tuple[Array, Array, float] | None = None
    notes: list[str] = field(default_factory=list)


@dataclass(kw_only=True)
class BodyParts:
    """Parts of one body while the file is read, in world coordinates."""

    name: str
    free: bool
    shapes: list[tuple[Array, NDArray[np.int64], bool]] = field(default_factory=list)
    inertia: Inertia = field(default_factory=Inertia)
    friction: float | None = None

    def body(self, path: Path) -> RigidModelBody | None:
        """Return it with the shapes that collide, or all where none does; None without any."""
        shapes = [s for s in self.shapes if s[2]] or self.shapes
        if not shapes:
            return None
        start = np.cumsum([0, *(len(s[0]) for s in shapes)])
        if start[-1] > MAX_VERTICES:
            raise InputError(f"{path}: body {self.name!r} has {start[-1]} vertices, more than {MAX_VERTICES}")
        faces = np.concatenate([s[1] + at for s, at in zip(shapes, start, strict=False)])
        vertices = np.concatenate([s[0] for s in shapes])
        return RigidModelBody(
            name=self.name, free=self.free, vertices=vertices, faces=faces, inertia=self.inertia, friction=self.friction
        )


class ModelReader:
    """State of reading that both formats share."""

    def __init__(self, path: Path, root: ElementTree.Element) -> None:
        self.path, self.root, self.notes = path, root, list[str]()
        self.parts = self.vertices = 0
        self.read_meshes: dict[str, tuple[Array, NDArray[np.int64]]] = {}

    def fail(self, what: str) -> InputError:
        """Return the error that names the file."""
        return InputError(f"{self.path}: {what}")

    def numbers(
        self, item: ElementTree.Element | Mapping[str, str], key: str, count: int | None, default: Any
    ) -> Array:
        """Return the finite numbers in attribute ``key``, ``count`` of them; ``default`` where absent."""
        text = item.get(key)
        if text is None:
            return np.array(default, dtype=np.float64)
        try:
            found = np.array([float(word) for word in text.split()])
        except (ValueError, OverflowError):
            raise self.fail(f"{key} is {text[:60]!r}: give numbers") from None
        if (count is not None and len(found) != count) or not np.isfinite(found).all():
            raise self.fail(f"{key} is {text[:60]!r}: give {count or 'finite'} numbers")
        return found

    def count(self) -> None:
        """Count a body or shape. Raises InputError for too many."""
        self.parts += 1
        if self.parts > MAX_PARTS:
            raise self.fail(f"has more than {MAX_PARTS} bodies and shapes; split the model")

    def mesh(self, name: str, scale: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return vertices (V, 3) and faces (T, 3) of a mesh file in the model's folder, times ``scale`` (3,)."""
        if name not in self.read_meshes:
            try:
                mesh = read_mesh(inside(self.path.parent, name), textures=False)
            except InputError as error:
                raise InputError(f"{self.path}: {error}") from None
            self.read_meshes[name] = np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)
        vertices, faces = self.read_meshes[name]
        self.vertices += len(vertices)
        if self.vertices > MAX_ALL_VERTICES:
            raise self.fail(f"its meshes have more than {MAX_ALL_VERTICES} vertices together; reduce them")
        return vertices * scale, faces[:, ::-1] if np.prod(scale) < 0 else faces


def solid(kind: str, size: Sequence[float] | Array) -> Inertia:
    """Return the inertia at density 1 of a shape about its own frame; sizes as in MJCF: radii and half lengths."""
    if kind in ("box", "ellipsoid"):
        a, b, c = size[:3]
        volume = 8 * a * b * c if kind == "box" else 4 / 3 * math.pi * a * b * c
        share = 3.0 if kind == "box" else 5.0
        moments = np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / share
    elif kind == "sphere":
        volume, moments = 4 / 3 * math.pi * size[0] ** 3, np.full(3, 0.4 * size[0] ** 2)
    else:
        r, h = size[0], 2 * size[1]
        middle = math.pi * r * r * h
        ends = 4 / 3 * math.pi * r**3 if kind == "capsule" else 0.0
        volume = middle + ends
        # Two half balls, their centres 3/8 r beyond the ends of the cylinder.
        across = middle * (h * h / 12 + r * r / 4) + ends * (0.4 * r * r + h * h / 4 + 3 / 8 * h * r)
        moments = np.array([across, across, middle * r * r / 2 + ends * 0.4 * r * r]) / max(volume, 1e-300)
    return Inertia(mass=volume, tensor=volume * np.diag(moments))


def shape_mesh(kind: str, size: Sequence[float] | Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the triangles of a shape."""
    from trimesh import creation

    if kind == "box":
        mesh = creation.box(2 * np.asarray(size[:3]))
    elif kind == "cylinder":
        mesh = creation.cylinder(size[0], 2 * size[1], sections=ROUND)
    elif kind == "capsule":
        mesh = creation.capsule(2 * size[1], size[0], count=[ROUND, ROUND])
        if mesh.bounds is None:
            # Numbers beyond all bounds, which whoever reads the file refuses.
            return np.full((3, 3), np.nan), np.array([[0, 1, 2]])
        mesh.apply_translation((0, 0, -mesh.bounds.mean(axis=0)[2]))
    else:
        mesh = creation.icosphere(subdivisions=3, radius=1.0)
        mesh.apply_scale(np.full(3, size[0]) if kind == "sphere" else np.asarray(size[:3]))
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def pose_matrix(turn: Array, place: Array) -> Array:
    """Return the (4, 4) matrix of rotation ``turn`` (3, 3) and then translation ``place`` (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, place
    return matrix


def rotation_matrix(kind: str, values: Array, degrees: bool = False) -> Array:
    """Return the (3, 3) rotation of a quaternion w x y z (``quat``), or of Euler angles in the order ``kind``."""
    from scipy.spatial.transform import Rotation

    if kind == "quat":
        return np.asarray(Rotation.from_quat(np.roll(values, -1)).as_matrix())
    return np.asarray(Rotation.from_euler(kind, values, degrees=degrees).as_matrix())
