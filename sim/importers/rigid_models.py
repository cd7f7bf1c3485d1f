# SPDX-License-Identifier: MIT
"""MJCF (MuJoCo) and URDF files → rigid bodies: shapes, mass, centre and inertia, friction.

Joints are not simulated: what hangs on a body by joints is frozen as the file places it and counts as part of it.
Formulas of volumes and inertia are those of homogeneous solids. Sources: mujoco.readthedocs.io (XML reference),
wiki.ros.org/urdf/XML.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files import read_text
from ..mpm.geometry.mass_properties import mesh_properties
from ..scene.folder import inside
from ..scene.meshes import read_mesh

Array = NDArray[np.float64]
SUFFIXES = (".xml", ".mjcf", ".urdf")
MAX_BYTES, MAX_DEPTH, MAX_PARTS, MAX_VERTICES = 16 * 2**20, 64, 5000, 2_000_000
WATER = 1000.0
"""Density in kg/m³ that MJCF takes where nothing is said."""
NOT_READ = ("include", "attach", "replicate", "composite", "flexcomp")
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
class _Collected:
    """What belongs to one body while the file is read, in world coordinates."""

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


def read_rigid_model(path: Path) -> RigidModel:
    """Return the bodies in the MJCF or URDF file ``path``, with its meshes in its folder or below.

    Raises InputError for damaged files, entities, parts that are not read, and numbers that are not finite.
    """
    try:
        text = read_text(path, MAX_BYTES, what="model")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; check its name") from None
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(f"{path}: declares entities, which no model needs; remove them")
    try:
        root = ElementTree.fromstring(text)  # noqa: S314  entities are refused above
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: not readable as XML ({error})") from None
    if root.tag not in ("mujoco", "robot"):
        raise InputError(f"{path}: its root is {root.tag[:40]!r}: give a model of MuJoCo (mujoco) or URDF (robot)")
    if sum(1 for _ in root.iter()) > 20 * MAX_PARTS:
        raise InputError(f"{path}: has more than {20 * MAX_PARTS} elements; split the model")
    reader = _Mjcf(path, root) if root.tag == "mujoco" else _Urdf(path, root)
    with np.errstate(all="ignore"):
        model = reader.read()
    if not model.bodies:
        raise InputError(f"{path}: has no body with a shape; add geoms (or visuals and collisions)")
    for body in model.bodies:
        weight = [body.inertia.mass, *body.inertia.centre, *body.inertia.tensor.ravel()]
        if not (np.isfinite(weight).all() and np.abs(body.vertices).max() < 1e6):
            raise InputError(f"{path}: body {body.name!r} has numbers that are not finite, or beyond 1,000 km")
        if body.free and not 1e-9 < body.inertia.mass < 1e9:
            raise InputError(f"{path}: body {body.name!r} has a mass of {body.inertia.mass:.3g} kg: give one above 0")
    return model


class _Reader:
    """What both formats share."""

    def __init__(self, path: Path, root: ElementTree.Element) -> None:
        self.path, self.root, self.notes = path, root, list[str]()
        self.parts = 0

    def fail(self, what: str) -> InputError:
        return InputError(f"{self.path}: {what}")

    def numbers(
        self, item: ElementTree.Element | Mapping[str, str], key: str, count: int | None, default: Any
    ) -> Array:
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
        self.parts += 1
        if self.parts > MAX_PARTS:
            raise self.fail(f"has more than {MAX_PARTS} bodies and shapes; split the model")

    def mesh(self, name: str, scale: Array) -> tuple[Array, NDArray[np.int64]]:
        try:
            mesh = read_mesh(inside(self.path.parent, name))
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from None
        faces = np.asarray(mesh.faces, dtype=np.int64)
        return np.asarray(mesh.vertices) * scale, faces[:, ::-1] if np.prod(scale) < 0 else faces


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


def _hull(kind: str, size: Sequence[float] | Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the triangles of a shape."""
    from trimesh import creation

    if kind == "box":
        mesh = creation.box(2 * np.asarray(size[:3]))
    elif kind == "cylinder":
        mesh = creation.cylinder(size[0], 2 * size[1], sections=ROUND)
    elif kind == "capsule":
        mesh = creation.capsule(2 * size[1], size[0], count=[ROUND, ROUND])
        mesh.apply_translation((0, 0, -mesh.bounds.mean(axis=0)[2]))
    else:
        mesh = creation.icosphere(subdivisions=3, radius=1.0)
        mesh.apply_scale(np.broadcast_to(size, 3) if kind == "sphere" else np.asarray(size[:3]))
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _pose(turn: Array, place: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, place
    return matrix


def _rotation(kind: str, values: Array, degrees: bool = False) -> Array:
    from scipy.spatial.transform import Rotation

    if kind == "quat":
        return np.asarray(Rotation.from_quat(np.roll(values, -1)).as_matrix())
    return np.asarray(Rotation.from_euler(kind, values, degrees=degrees).as_matrix())


class _Mjcf(_Reader):
    def read(self) -> RigidModel:
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
        fixed = _Collected(name="fixed", free=False)
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
            return _rotation("quat", q)
        if item.get("euler") is not None:
            return _rotation(
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
        return _pose(self._orientation(item), self.numbers(item, "pos", 3, (0.0, 0.0, 0.0)))

    def _body(
        self, item: ElementTree.Element, pose: Array, owner: _Collected, bodies: list[_Collected], kind: str, depth: int
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
                into = _Collected(name=name, free=True)
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

    def _geom(self, item: ElementTree.Element, pose: Array, owner: _Collected, kind: str, *, weighs: bool) -> None:
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
                place = _pose(_from_z(way), ends.mean(axis=0))
                radius = size[:1]
                size = np.array([*radius, half] if shape in ("capsule", "cylinder") else [*radius, *radius, half])
            if len(size) < SIZES[shape] or not (size[: SIZES[shape]] > 0).all():
                raise self.fail(f"size of a {shape} is {values.get('size', '')[:40]!r}: give {SIZES[shape]} above 0")
            vertices, faces = _hull(shape, size)
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


class _Urdf(_Reader):
    def read(self) -> RigidModel:
        links = {item.get("name", ""): item for item in self.root.findall("link")}
        joints: dict[str, list[tuple[str, Array, str]]] = {}
        children = set()
        for item in self.root.findall("joint"):
            parent, child = (
                (end.get("link", "") if (end := item.find(tag)) is not None else "") for tag in ("parent", "child")
            )
            if parent not in links or child not in links or child in children:
                raise self.fail(f"joint {item.get('name', '')[:60]!r} has no parent or child, or its child has two")
            children.add(child)
            joints.setdefault(parent, []).append((child, self._origin(item), item.get("type", "fixed")))
        roots = [name for name in links if name not in children]
        bodies: list[_Collected] = []
        for name in roots:
            free = name != "world"
            owner = _Collected(name=name or "body", free=free)
            bodies.append(owner)
            for link, pose in self._below(name, joints, owner):
                self._link(links[link], pose, owner)
        found = [body for each in bodies if (body := each.body(self.path)) is not None]
        if found:
            low = min(float(body.vertices[:, 2].min()) for body in found)
            if any(body.free for body in found) and low != 0:
                self.notes.append(f"URDF has no ground: moved up by {-low:.4g} m onto z = 0")
                for body in found:
                    body.vertices = body.vertices - [0, 0, low]
                    body.inertia = body.inertia.placed(_pose(np.eye(3), np.array([0.0, 0.0, -low])))
        return RigidModel(bodies=found, notes=self.notes)

    def _below(
        self, name: str, joints: Mapping[str, list[tuple[str, Array, str]]], owner: _Collected
    ) -> Iterator[tuple[str, Array]]:
        waiting = [(name, np.eye(4))]
        while waiting:
            link, pose = waiting.pop()
            self.count()
            yield link, pose
            for child, origin, kind in joints.get(link, []):
                if kind != "fixed":
                    self.notes.append(f"the {kind[:20]} joint of {child[:60]} is frozen: it is part of {owner.name}")
                waiting.append((child, pose @ origin))

    def _origin(self, item: ElementTree.Element) -> Array:
        origin = item.find("origin")
        if origin is None:
            return np.eye(4)
        turn = _rotation("xyz", self.numbers(origin, "rpy", 3, (0.0, 0.0, 0.0)))
        return _pose(turn, self.numbers(origin, "xyz", 3, (0.0, 0.0, 0.0)))

    def _link(self, item: ElementTree.Element, pose: Array, owner: _Collected) -> None:
        inertial = item.find("inertial")
        if inertial is not None:
            mass, tensor = inertial.find("mass"), inertial.find("inertia")
            weight = 0.0 if mass is None else float(self.numbers(mass, "value", 1, (0.0,))[0])
            moments: ElementTree.Element | dict[str, str] = {} if tensor is None else tensor
            xx, xy, xz, yy, yz, zz = (
                float(self.numbers(moments, key, 1, (0.0,))[0]) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
            )
            found = Inertia(mass=weight, tensor=np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
            owner.inertia += found.placed(pose @ self._origin(inertial))
        for tag in ("collision", "visual"):
            for shape in item.findall(tag):
                geometry = shape.find("geometry")
                if geometry is None or not len(geometry):
                    raise self.fail(f"a {tag} of {item.get('name', '')[:60]!r} has no geometry")
                vertices, faces = self._shape(geometry[0])
                at = pose @ self._origin(shape)
                owner.shapes.append((vertices @ at[:3, :3].T + at[:3, 3], faces, tag == "collision"))

    def _shape(self, item: ElementTree.Element) -> tuple[Array, NDArray[np.int64]]:
        self.count()
        if item.tag == "mesh":
            name = item.get("filename", "")
            if name.startswith("package://"):
                name = name.removeprefix("package://").partition("/")[2]
            return self.mesh(name, self.numbers(item, "scale", 3, (1.0, 1.0, 1.0)))
        if item.tag == "box":
            size = self.numbers(item, "size", 3, ()) / 2
        elif item.tag in ("cylinder", "sphere", "capsule"):
            size = np.append(self.numbers(item, "radius", 1, ()), self.numbers(item, "length", 1, ()) / 2)
        else:
            raise self.fail(f"geometry {item.tag[:40]!r} is not read: give box, cylinder, capsule, sphere or mesh")
        if len(size) < SIZES[item.tag] or not (size > 0).all():
            raise self.fail(f"a {item.tag} has no size above 0")
        return _hull(item.tag, size)
