# SPDX-License-Identifier: MIT
"""MJCF, the models of MuJoCo → rigid bodies. Source: mujoco.readthedocs.io (XML reference)."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..mpm.geometry.mass_properties import mesh_properties
from .rigid_parts import (
    MAX_DEPTH,
    SIZES,
    Array,
    BodyParts,
    Inertia,
    ModelReader,
    RigidModel,
    pose_matrix,
    rotation_matrix,
    shape_mesh,
    solid,
)

WATER = 1000.0
"""Density in kg/m³ that MJCF takes where nothing is said."""
NOT_READ = ("include", "attach", "replicate", "composite", "flexcomp")


class MjcfReader(ModelReader):
    """Reads one file: defaults and assets first, then the bodies from the world downwards."""

    def read(self) -> RigidModel:
        """Return the model. Raises InputError, as every method here, for what is wrong or not read."""
        compiler = {k: v for item in self.root.findall("compiler") for k, v in item.attrib.items()}
        if compiler.get("coordinate", "local") != "local":
            raise self.fail("uses global coordinates, which MuJoCo no longer reads; save it again")
        self.degrees = compiler.get("angle", "degree") == "degree"
        self.order = compiler.get("eulerseq", "xyz")
        if (
            len(self.order) != 3
            or set(self.order.lower()) - set("xyz")
            or not (self.order.islower() or self.order.isupper())
        ):
            raise self.fail(f"eulerseq is {self.order[:20]!r}: give three of x, y, z")
        self.folder = compiler.get("meshdir", compiler.get("assetdir", "")).rstrip("/")
        self.from_geoms = compiler.get("inertiafromgeom", "auto")
        self.ground: tuple[Array, Array, float] | None = None
        for name in NOT_READ:
            if self.root.find(f".//{name}") is not None:
                raise self.fail(f"has {name}, which is not read: save the compiled model (mj_saveLastXML)")
        self.defaults: dict[str, dict[str, str]] = {"main": {}}
        for item in self.root.findall("default"):
            self._defaults(item, {}, "main", 0)
        self.meshes = {}
        for item in self.root.findall("asset/mesh"):
            name = item.get("name") or Path(item.get("file", "")).stem
            self.meshes[name] = item
        gravity = self.numbers(next(iter(self.root.findall("option")), {}), "gravity", 3, (0.0, 0.0, -9.81))
        fixed = BodyParts(name="fixed", free=False)
        bodies = [fixed]
        for world in self.root.findall("worldbody"):
            self._body(world, np.eye(4), fixed, bodies, "main", 0)
        found = [body for each in bodies if (body := each.body(self.path)) is not None]
        x, y, z = map(float, gravity)
        return RigidModel(bodies=found, gravity=(x, y, z), ground=self.ground, notes=self.notes)

    def _defaults(self, item: ElementTree.Element, above: dict[str, str], name: str, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise self.fail(f"has defaults nested deeper than {MAX_DEPTH}")
        own = above | {k: v for geom in item.findall("geom") for k, v in geom.attrib.items()}
        self.defaults[name] = own
        for child in item.findall("default"):
            self._defaults(child, own, child.get("class", ""), depth + 1)

    def _orientation(self, item: Mapping[str, str] | ElementTree.Element) -> Array:
        if item.get("quat") is not None:
            q = self.numbers(item, "quat", 4, ())
            if not np.linalg.norm(q) > 1e-9:
                raise self.fail("a quat is 0 0 0 0: give one of length 1")
            return rotation_matrix("quat", q)
        if item.get("euler") is not None:
            return rotation_matrix(
                self.order.upper() if self.order.islower() else self.order.lower(),
                self.numbers(item, "euler", 3, ()), self.degrees,
            )  # fmt: skip
        if item.get("axisangle") is not None:
            from scipy.spatial.transform import Rotation

            *axis, angle = self.numbers(item, "axisangle", 4, ())
            way = np.array(axis) / max(float(np.linalg.norm(axis)), 1e-12)
            return np.asarray(Rotation.from_rotvec(way * (math.radians(angle) if self.degrees else angle)).as_matrix())
        if item.get("zaxis") is not None:
            return _from_z(self.numbers(item, "zaxis", 3, ()))
        if item.get("xyaxes") is not None:
            x, y = self.numbers(item, "xyaxes", 6, ()).reshape(2, 3)
            x = x / max(float(np.linalg.norm(x)), 1e-12)
            y = y - (x @ y) * x
            y = y / max(float(np.linalg.norm(y)), 1e-12)
            return np.column_stack([x, y, np.cross(x, y)])
        return np.eye(3)

    def _placed(self, item: Mapping[str, str] | ElementTree.Element) -> Array:
        return pose_matrix(self._orientation(item), self.numbers(item, "pos", 3, (0.0, 0.0, 0.0)))

    def _body(
        self, item: ElementTree.Element, pose: Array, owner: BodyParts, bodies: list[BodyParts], kind: str, depth: int
    ) -> None:
        """Add what is in ``item``, whose frame is ``pose``, to ``owner``; its free bodies are bodies of their own."""
        if depth > MAX_DEPTH:
            raise self.fail(f"has bodies nested deeper than {MAX_DEPTH}")
        self.count()
        kind = item.get("childclass", kind)
        given = item.find("inertial") if item.tag == "body" else None
        explicit = given is not None and self.from_geoms != "true"
        if explicit and given is not None:
            owner.inertia += self._inertial(given).placed(pose)
        for geom in item.findall("geom"):
            self._geom(geom, pose, owner, kind, weighs=not explicit)
        for frame in item.findall("frame"):
            self._body(frame, pose @ self._placed(frame), owner, bodies, kind, depth + 1)
        for child in item.findall("body"):
            joints = [joint.get("type", "hinge") for joint in child.findall("joint")]
            free = child.find("freejoint") is not None or "free" in joints
            name = child.get("name") or f"body{len(bodies)}"
            if joints and not free:
                self.notes.append(f"the joint of {name} is frozen: it is part of {owner.name}")
            into = owner
            if free:
                into = BodyParts(name=name, free=True)
                bodies.append(into)
            self._body(child, pose @ self._placed(child), into, bodies, kind, depth + 1)

    def _inertial(self, item: ElementTree.Element) -> Inertia:
        pose = self._placed(item)
        if item.get("fullinertia") is not None:
            xx, yy, zz, xy, xz, yz = self.numbers(item, "fullinertia", 6, ())
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        else:
            tensor = np.diag(self.numbers(item, "diaginertia", 3, (0.0, 0.0, 0.0)))
        return Inertia(mass=float(self.numbers(item, "mass", 1, (0.0,))[0]), tensor=tensor).placed(pose)

    def _geom(self, item: ElementTree.Element, pose: Array, owner: BodyParts, kind: str, *, weighs: bool) -> None:
        self.count()
        named = item.get("class", kind)
        if named not in self.defaults:
            raise self.fail(f"class {named[:60]!r} of a geom is not among the defaults")
        values = self.defaults[named] | item.attrib
        shape = values.get("type", "mesh" if "mesh" in values else "sphere")
        friction = float(self.numbers(values, "friction", None, (1.0,))[:1].sum())
        place, size = self._placed(values), self.numbers(values, "size", None, ())
        if shape == "plane":
            at = pose @ place
            if self.ground is None and not owner.free:
                self.ground = (at[:3, 3], at[:3, 2], friction)
            else:
                self.notes.append("another plane than the first is left out")
            return
        if shape == "mesh":
            vertices, faces = self._mesh(values.get("mesh", ""))
            try:
                found = mesh_properties(vertices, faces)
            except InputError as error:
                raise self.fail(f"mesh {values.get('mesh', '')[:60]!r}: {error}") from None
            inner = Inertia(mass=found.mass, centre=found.center, tensor=found.inertia)
        elif shape in SIZES:
            if values.get("fromto") is not None and shape in ("capsule", "cylinder", "box", "ellipsoid"):
                ends = self.numbers(values, "fromto", 6, ()).reshape(2, 3)
                way = ends[1] - ends[0]
                half = float(np.linalg.norm(way)) / 2
                place = pose_matrix(_from_z(way), ends.mean(axis=0))
                radius = size[:1]
                size = np.array([*radius, half] if shape in ("capsule", "cylinder") else [*radius, *radius, half])
            if len(size) < SIZES[shape] or not (size[: SIZES[shape]] > 0).all():
                raise self.fail(f"size of a {shape} is {values.get('size', '')[:40]!r}: give {SIZES[shape]} above 0")
            vertices, faces = shape_mesh(shape, size)
            inner = solid(shape, size)
        else:
            raise self.fail(f"a geom of type {shape[:40]!r} is not read: give {', '.join(SIZES)}, plane or mesh")
        at = pose @ place
        if weighs:
            density = float(self.numbers(values, "density", 1, (WATER,))[0])
            if values.get("mass") is not None:
                density = float(self.numbers(values, "mass", 1, (0.0,))[0]) / max(inner.mass, 1e-300)
            inner = Inertia(mass=inner.mass * density, centre=inner.centre, tensor=inner.tensor * density)
            owner.inertia += inner.placed(at)
        collides = values.get("contype", "1") != "0" or values.get("conaffinity", "1") != "0"
        owner.shapes.append((vertices @ at[:3, :3].T + at[:3, 3], faces, collides))
        if collides and owner.friction is None:
            owner.friction = friction

    def _mesh(self, name: str) -> tuple[Array, NDArray[np.int64]]:
        item = self.meshes.get(name)
        if item is None:
            raise self.fail(f"there is no mesh {name[:60]!r} among its assets")
        scale = self.numbers(item, "scale", 3, (1.0, 1.0, 1.0))
        if item.get("file") is not None:
            file = item.get("file", "")
            return self.mesh(f"{self.folder}/{file}" if self.folder else file, scale)
        vertices = self.numbers(item, "vertex", None, ())
        faces = self.numbers(item, "face", None, ())
        if not len(vertices) or len(vertices) % 3 or len(faces) % 3:
            raise self.fail(f"mesh {name[:60]!r} has vertices or faces that are not threes")
        points = vertices.reshape(-1, 3) * scale
        if not len(faces):
            from scipy.spatial import ConvexHull, QhullError

            try:
                hull = ConvexHull(points)
            except (QhullError, ValueError):
                raise self.fail(f"mesh {name[:60]!r} is flat") from None
            # Qhull's triangles face either way: turned outwards by their planes.
            corners = points[hull.simplices]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            inwards = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0
            return points, np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices).astype(np.int64)
        if faces.min() < 0 or faces.max() >= len(points):
            raise self.fail(f"mesh {name[:60]!r} has faces with indices out of range")
        return points, faces.astype(np.int64).reshape(-1, 3)


def _from_z(way: Array) -> Array:
    """Return the smallest rotation of z to ``way``."""
    from scipy.spatial.transform import Rotation

    length = float(np.linalg.norm(way))
    if not length > 1e-12:
        return np.eye(3)
    x, y, z = way / length
    sine, angle = math.hypot(x, y), math.atan2(math.hypot(x, y), z)
    axis = np.array([-y, x, 0.0]) / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    return np.asarray(Rotation.from_rotvec(angle * axis).as_matrix())
